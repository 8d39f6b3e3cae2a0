//! Writes triangle meshes as PLY, OBJ, STL and glTF (GLB).

use std::fmt::Write;
use std::path::Path;

use glam::DVec3;
use planish_core::{FormatError, IoError};

use super::triangles::TriangleMesh;
use super::write::check_f32;
use super::{FormatResult, write_whole};

/// The extensions of mesh formats that can be written, for messages.
pub const WRITTEN_MESHES: &str = ".ply, .obj, .stl or .glb";

/// Writes a mesh in the format given by the path's extension: PLY (binary), OBJ, STL (binary) or GLB. STL stores only
/// the triangles. The other formats also store normals and colours; OBJ and GLB also store texture coordinates. GLB is
/// rotated to make y point up, as glTF requires.
///
/// # Errors
/// If the mesh contains no triangles, the extension is unknown, or the file cannot be written.
pub fn write_mesh(path: &Path, mesh: &TriangleMesh) -> Result<(), IoError> {
    let extension = path.extension().and_then(|extension| extension.to_str()).map(str::to_ascii_lowercase);
    let encode = || match extension.as_deref() {
        _ if mesh.triangles.is_empty() => Err(FormatError::Unsupported(
            "the mesh has no triangles, since no pixels are connected; nothing is written".into(),
        )),
        Some("ply") => Ok(ply(mesh)),
        Some("obj") => Ok(obj(mesh).into_bytes()),
        Some("stl") => check_f32(mesh.origin_m, mesh.positions.iter()).map(|()| stl(mesh)),
        Some("glb") => glb(mesh),
        _ => Err(FormatError::Unsupported(format!("unsupported mesh extension; expected {WRITTEN_MESHES}"))),
    };
    encode().and_then(|bytes| write_whole(path, &bytes)).map_err(IoError::at(path))
}

impl TriangleMesh {
    fn has_origin(&self) -> bool {
        self.origin_m != [0.0; 3]
    }

    fn coordinate(&self, i: usize) -> [f64; 3] {
        let position = self.positions.get(i);
        [0, 1, 2].map(|axis| self.origin_m[axis] + f64::from(position[axis]))
    }
}

fn ply(mesh: &TriangleMesh) -> Vec<u8> {
    let number = if mesh.has_origin() { "double" } else { "float" };
    let (vertices, faces) = (mesh.positions.len(), mesh.triangles.len());
    let mut header = format!("ply\nformat binary_little_endian 1.0\ncomment planish\nelement vertex {vertices}\n");
    for name in ["x", "y", "z"] {
        header += &format!("property {number} {name}\n");
    }
    for name in ["nx", "ny", "nz"] {
        header += &format!("property float {name}\n");
    }
    if mesh.colours.is_some() {
        for name in ["red", "green", "blue"] {
            header += &format!("property uchar {name}\n");
        }
    }
    header += &format!("element face {faces}\nproperty list uchar int vertex_indices\nend_header\n");
    let mut bytes = header.into_bytes();
    for i in 0..vertices {
        match mesh.has_origin() {
            true => mesh.coordinate(i).iter().for_each(|value| bytes.extend(value.to_le_bytes())),
            false => mesh.positions.get(i).iter().for_each(|value| bytes.extend(value.to_le_bytes())),
        }
        mesh.normals.get(i).iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        bytes.extend(mesh.colours.iter().flat_map(|colours| colours[i]));
    }
    for triangle in &mesh.triangles {
        bytes.push(3);
        triangle.iter().for_each(|index| bytes.extend(index.to_le_bytes()));
    }
    bytes
}

fn obj(mesh: &TriangleMesh) -> String {
    let mut text = String::from("# planish\n");
    for i in 0..mesh.positions.len() {
        let [x, y, z] = mesh.coordinate(i);
        // Writing to a String cannot fail.
        let _ = match mesh.has_origin() {
            true => write!(text, "v {x} {y} {z}"),
            false => write!(text, "v {} {} {}", x as f32, y as f32, z as f32),
        };
        if let Some(colours) = &mesh.colours {
            let [r, g, b] = colours[i].map(|channel| f32::from(channel) / 255.0);
            let _ = write!(text, " {r:.4} {g:.4} {b:.4}");
        }
        text.push('\n');
    }
    for [u, v] in &mesh.texture {
        let _ = writeln!(text, "vt {u} {}", 1.0 - v);
    }
    for [x, y, z] in mesh.normals.iter() {
        let _ = writeln!(text, "vn {x} {y} {z}");
    }
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|index| index + 1);
        let _ = writeln!(text, "f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}");
    }
    text
}

fn stl(mesh: &TriangleMesh) -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes[..7].copy_from_slice(b"planish");
    bytes.extend((mesh.triangles.len() as u32).to_le_bytes());
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|index| DVec3::from_array(mesh.coordinate(index as usize)));
        let normal = (b - a).cross(c - a).normalize_or_zero();
        for value in [normal, a, b, c].iter().flat_map(|vector| vector.as_vec3().to_array()) {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend([0; 2]);
    }
    bytes
}

/// Encodes a mesh as glTF 2.0 in a single binary file: a header, JSON, and the arrays.
fn glb(mesh: &TriangleMesh) -> FormatResult<Vec<u8>> {
    const FLOAT: u32 = 5126;
    const UNSIGNED_BYTE: u32 = 5121;
    const UNSIGNED_INT: u32 = 5125;
    const ARRAY: u32 = 34962;
    const ELEMENT_ARRAY: u32 = 34963;
    let mut data: Vec<u8> = Vec::new();
    let (mut views, mut accessors) = (Vec::new(), Vec::new());
    let mut add = |bytes: Vec<u8>, target: u32, accessor: serde_json::Value| {
        let view = serde_json::json!({
            "buffer": 0, "byteOffset": data.len(), "byteLength": bytes.len(), "target": target,
        });
        data.extend(bytes);
        let mut accessor = accessor;
        accessor["bufferView"] = views.len().into();
        views.push(view);
        accessors.push(accessor);
        accessors.len() - 1
    };
    let floats = |values: &mut dyn Iterator<Item = f32>| values.flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let count = mesh.positions.len();
    let bound = |start: f32, pick: fn(f32, f32) -> f32| {
        mesh.positions.as_slices().map(|values| values.iter().copied().fold(start, pick))
    };
    let (low, high) = (bound(f32::INFINITY, f32::min), bound(f32::NEG_INFINITY, f32::max));
    let mut attributes = serde_json::Map::new();
    let position = add(
        floats(&mut mesh.positions.iter().flatten()),
        ARRAY,
        serde_json::json!({ "componentType": FLOAT, "count": count, "type": "VEC3", "min": low, "max": high }),
    );
    attributes.insert("POSITION".into(), position.into());
    let normal = add(
        floats(&mut mesh.normals.iter().flatten()),
        ARRAY,
        serde_json::json!({ "componentType": FLOAT, "count": count, "type": "VEC3" }),
    );
    attributes.insert("NORMAL".into(), normal.into());
    let texture = add(
        floats(&mut mesh.texture.iter().copied().flatten()),
        ARRAY,
        serde_json::json!({ "componentType": FLOAT, "count": count, "type": "VEC2" }),
    );
    attributes.insert("TEXCOORD_0".into(), texture.into());
    if let Some(colours) = &mesh.colours {
        let rgba = colours.iter().flat_map(|&[r, g, b]| [r, g, b, u8::MAX]).collect();
        let accessor = serde_json::json!({
            "componentType": UNSIGNED_BYTE, "normalized": true, "count": count, "type": "VEC4",
        });
        attributes.insert("COLOR_0".into(), add(rgba, ARRAY, accessor).into());
    }
    let indices = mesh.triangles.iter().flatten().flat_map(|index| index.to_le_bytes()).collect();
    let indices = add(
        indices,
        ELEMENT_ARRAY,
        serde_json::json!({ "componentType": UNSIGNED_INT, "count": 3 * mesh.triangles.len(), "type": "SCALAR" }),
    );
    // In the sensor's frame y is down and z points forward, so the mesh is rotated by half a turn about x.
    let [x, y, z] = mesh.origin_m;
    let description = serde_json::json!({
        "asset": { "version": "2.0", "generator": "planish" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "rotation": [1, 0, 0, 0], "translation": [x, -y, -z] }],
        "meshes": [{ "primitives": [{ "attributes": attributes, "indices": indices, "material": 0 }] }],
        "materials": [{ "doubleSided": true, "pbrMetallicRoughness": { "metallicFactor": 0, "roughnessFactor": 0.9 } }],
        "buffers": [{ "byteLength": data.len() }],
        "bufferViews": views,
        "accessors": accessors,
    });
    let mut text = description.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    data.resize(data.len().next_multiple_of(4), 0);
    let total = 12 + 8 + text.len() + 8 + data.len();
    let length = |len: usize| {
        u32::try_from(len)
            .map_err(|_| FormatError::Unsupported("the mesh exceeds 4 GB, the limit of GLB; write .ply".into()))
    };
    let mut bytes = Vec::with_capacity(total);
    bytes.extend(b"glTF");
    bytes.extend(2u32.to_le_bytes());
    bytes.extend(length(total)?.to_le_bytes());
    for (kind, part) in [(b"JSON", &text), (b"BIN\0", &data)] {
        bytes.extend(length(part.len())?.to_le_bytes());
        bytes.extend(kind);
        bytes.extend(part);
    }
    Ok(bytes)
}
