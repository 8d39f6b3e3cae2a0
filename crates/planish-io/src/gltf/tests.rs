//! Tests of the glTF reader.

use super::*;

/// Returns a document whose scene places one mesh twice. The mesh has two vertices with normals and colours.
fn document(buffer: &str) -> String {
    format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0,1]}}],
        "nodes":[{{"mesh":0,"translation":[10,0,0]}},{{"children":[2],"scale":[2,2,2]}},
                 {{"mesh":0,"rotation":[0,0,0.7071067811865476,0.7071067811865476]}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"NORMAL":1,"COLOR_0":2}}}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":2,"type":"VEC3"}},
                     {{"bufferView":0,"byteOffset":12,"componentType":5126,"count":2,"type":"VEC3"}},
                     {{"bufferView":1,"componentType":5121,"normalized":true,"count":2,"type":"VEC4"}}],
        "bufferViews":[{{"buffer":0,"byteLength":48,"byteStride":24}},{{"buffer":0,"byteOffset":48,"byteLength":8}}],
        "buffers":[{buffer}]}}"#
    )
}

fn data() -> Vec<u8> {
    let floats = [1.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0];
    floats.into_iter().flat_map(f32::to_le_bytes).chain([255, 0, 0, 255, 0, 51, 0, 255]).collect()
}

fn glb(json: &str, data: &[u8]) -> Vec<u8> {
    unpadded_glb(&format!("{json:<width$}", width = json.len().next_multiple_of(4)), data)
}

fn unpadded_glb(json: &str, data: &[u8]) -> Vec<u8> {
    let chunk =
        |kind: u32, bytes: &[u8]| [&(bytes.len() as u32).to_le_bytes()[..], &kind.to_le_bytes(), bytes].concat();
    let body = [chunk(JSON, json.as_bytes()), chunk(BINARY, data)].concat();
    [MAGIC, &2u32.to_le_bytes(), &(12 + body.len() as u32).to_le_bytes(), &body].concat()
}

fn read(bytes: &[u8]) -> FormatResult<PointCloud> {
    decode(bytes, None, &ReadOptions::default(), &mut Vec::new())
}

#[test]
fn vertices_stand_where_their_nodes_place_them() {
    let cloud = read(&glb(&document(r#"{"byteLength":56}"#), &data())).unwrap();
    // The nodes of the scene are visited from the last to the first.
    let expected = [[0.0, 2.0, 0.0], [-4.0, 0.0, 0.0], [11.0, 0.0, 0.0], [10.0, 2.0, 0.0]];
    for (i, place) in expected.iter().enumerate() {
        let off = (0..3).map(|axis| (cloud.coordinate(axis, i) - place[axis]).abs()).fold(0.0, f64::max);
        assert!(off < 1e-6, "{i}: {:?}", cloud.positions.get(i));
    }
    let value = |name: &str, i: usize| {
        cloud.attributes.iter().find(|attribute| attribute.name == name).unwrap().values.get_f64(i)
    };
    assert!((value("normal_y", 0) - 1.0).abs() < 1e-6 && (value("normal_x", 2) - 1.0).abs() < 1e-6);
    assert_eq!((value("red", 0), value("green", 1), value("blue", 3)), (255.0, 51.0, 0.0));
}

#[test]
fn only_the_transforms_that_place_points_must_be_valid() {
    let replaced = |pairs: &[(&str, &str)]| {
        let mut document = document(r#"{"byteLength":56}"#);
        for (before, after) in pairs {
            assert_eq!(document.matches(before).count(), 1, "{before}");
            document = document.replace(before, after);
        }
        read(&glb(&document, &data()))
    };
    const TURN: &str = "[0,0,0.7071067811865476,0.7071067811865476]";
    let light = TURN.to_owned() + r#"},{"rotation":[0,0,0,0]"#;
    assert_eq!(replaced(&[(r#""nodes":[0,1]"#, r#""nodes":[0,1,3]"#), (TURN, &light)]).unwrap().len(), 4);

    let error = replaced(&[(TURN, "[0,0,0,0]")]).unwrap_err().to_string();
    assert!(error.contains("quaternion of length 1"), "{error}");
    let large = r#""scale":[1e200,1e200,1e200]"#;
    let inner = format!("{large},\"rotation\":{TURN}");
    let rotation = format!("\"rotation\":{TURN}");
    let error = replaced(&[(r#""scale":[2,2,2]"#, large), (&rotation, &inner)]).unwrap_err().to_string();
    assert!(error.contains("range of f64"), "{error}");
}

#[test]
fn chunks_may_lack_their_padding() {
    let mut json = document(r#"{"byteLength":56}"#);
    let padded = read(&glb(&json, &data())).unwrap();
    for _ in 0..4 {
        json.push(' ');
        assert_eq!(read(&unpadded_glb(&json, &data())).unwrap(), padded, "{} bytes", json.len());
    }
}

#[test]
fn buffers_are_read_from_the_text_and_from_files_below_and_from_no_others() {
    let text = base64::engine::general_purpose::STANDARD.encode(data());
    let inside = format!(r#"{{"byteLength":56,"uri":"data:application/octet-stream;base64,{text}"}}"#);
    assert_eq!(read(document(&inside).as_bytes()).unwrap().len(), 4);
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("mesh 1.bin"), data()).unwrap();
    let beside = |uri: &str| {
        let json = document(&format!(r#"{{"byteLength":56,"uri":"{uri}"}}"#));
        decode(json.as_bytes(), Some(folder.path()), &ReadOptions::default(), &mut Vec::new())
    };
    assert_eq!(beside("mesh%201.bin").unwrap().len(), 4);
    for (uri, problem) in [("other.bin", "other.bin"), ("../mesh.bin", "one file"), ("/etc/passwd", "one file")] {
        assert!(beside(uri).unwrap_err().to_string().contains(problem), "{uri}");
    }
}

#[test]
fn what_cannot_be_read_is_refused() {
    let whole = glb(&document(r#"{"byteLength":56}"#), &data());
    assert!((0..whole.len()).all(|length| read(&whole[..length]).is_err()));
    for (from, to, problem) in [
        (r#""count":2"#, r#""count":3"#, "does not fit its buffer"),
        (r#""count":2"#, r#""count":18446744073709551615"#, "does not fit its buffer"),
        (r#""byteStride":24"#, r#""byteStride":4"#, "does not fit its buffer"),
        (r#""children":[2]"#, r#""children":[1]"#, "a loop"),
        (r#""mesh":0"#, r#""mesh":7"#, "mesh 7 does not exist"),
        (r#""componentType":5126"#, r#""componentType":5123"#, "expected floats"),
        (r#""scene":0"#, r#""extensionsRequired":["KHR_draco_mesh_compression"]"#, "KHR_draco"),
        (r#""byteOffset":48"#, r#""byteOffset":49"#, "outside its buffer"),
        (r#""version":"2.0""#, r#""version":"1.0","profile":{}"#, "glTF version 1.0"),
    ] {
        let json = document(r#"{"byteLength":56}"#).replace(from, to);
        let error = read(&glb(&json, &data())).unwrap_err().to_string();
        assert!(error.contains(problem), "{to}: {error}");
    }
}
