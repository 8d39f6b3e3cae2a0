//! Reads the vertices of glTF 2.0 files (JSON or GLB) with normals and colours, transformed by the nodes of the scene.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use base64::Engine as _;
use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;

use super::columns::cloud_from_columns;
use super::{FormatResult, ReadOptions, brief, quoted, read_bytes};
use planish_core::{Attribute, FormatError, PointCloud, Precision};

const MAGIC: &[u8] = b"glTF";
const JSON: u32 = 0x4e4f_534a;
const BINARY: u32 = 0x004e_4942;

/// Maximum nesting depth of nodes; deeper nesting is treated as a loop.
const DEEPEST: usize = 64;
/// Maximum number of nodes in a file without a scene, in which the root nodes must be searched for.
const MOST_UNROOTED: usize = 1 << 12;
/// Maximum number of nodes in a scene, and of mesh primitives in these nodes.
const MOST_PLACED: usize = 1 << 16;
/// Memory per vertex in bytes, for normals, colours, and coordinates in f64. While coordinates are converted to
/// columns, memory contains them twice.
const BYTES_PER_VERTEX: usize = 160;

const BYTE: u32 = 5121;
const SHORT: u32 = 5123;
const FLOAT: u32 = 5126;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    #[serde(default)]
    buffers: Vec<Buffer>,
    #[serde(default)]
    buffer_views: Vec<View>,
    #[serde(default)]
    accessors: Vec<Accessor>,
    #[serde(default)]
    meshes: Vec<Mesh>,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    scenes: Vec<Scene>,
    scene: Option<usize>,
    #[serde(default)]
    extensions_required: Vec<String>,
    #[serde(default)]
    extensions_used: Vec<String>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    uri: Option<String>,
    byte_length: usize,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
    sparse: Option<serde_json::Value>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    #[serde(default)]
    attributes: Attributes,
}

#[derive(Deserialize, Default)]
struct Attributes {
    #[serde(rename = "POSITION")]
    position: Option<usize>,
    #[serde(rename = "NORMAL")]
    normal: Option<usize>,
    #[serde(rename = "COLOR_0")]
    colour: Option<usize>,
    #[serde(flatten)]
    others: BTreeMap<String, serde_json::Value>,
}

#[derive(Deserialize)]
struct Node {
    mesh: Option<usize>,
    skin: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

/// The version of a document, parsed first because the rest of the document depends on it.
#[derive(Deserialize)]
struct Stated {
    #[serde(default)]
    asset: Asset,
}

#[derive(Deserialize, Default)]
struct Asset {
    version: Option<String>,
}

fn other_version(version: &str) -> FormatError {
    FormatError::Unsupported(format!("glTF version {} is not supported; expected version 2", brief(version)))
}

fn malformed(what: impl std::fmt::Display) -> FormatError {
    FormatError::Malformed(format!("damaged glTF: {}", brief(&what.to_string())))
}

/// Returns true if the contents are a GLB.
pub(super) fn is_gltf(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC)
}

/// Reads all vertices of the scene. `folder` is the folder in which external buffers are looked up.
pub(super) fn decode(
    bytes: &[u8],
    folder: Option<&Path>,
    options: &ReadOptions,
    notes: &mut Vec<String>,
) -> FormatResult<PointCloud> {
    let (json, binary) = if is_gltf(bytes) { chunks(bytes)? } else { (bytes, None) };
    check_json(json, options)?;
    let Stated { asset } = serde_json::from_slice(json).map_err(malformed)?;
    if let Some(version) = asset.version.filter(|version| !version.starts_with("2.")) {
        return Err(other_version(&version));
    }
    let document: Document = serde_json::from_slice(json).map_err(malformed)?;
    if let Some(extension) = document.extensions_required.iter().find(|name| !is_of_looks(name)) {
        return Err(FormatError::Unsupported(format!(
            "the glTF requires the unsupported extension {}; export it without extensions (compression, quantization)",
            quoted(extension)
        )));
    }
    if document.extensions_used.iter().any(|name| name == "EXT_mesh_gpu_instancing") {
        notes.push("all instances but one (EXT_mesh_gpu_instancing) are dropped".into());
    }
    let primitives = || document.meshes.iter().flat_map(|mesh| &mesh.primitives);
    let others: BTreeSet<&str> = primitives().flat_map(|primitive| primitive.attributes.own()).collect();
    if !others.is_empty() {
        let others: Vec<&str> = others.into_iter().collect();
        notes.push(format!("vertex attributes are dropped: {}", brief(&others.join(", "))));
    }
    let mut left = options.max_memory_bytes;
    let mut buffers = Vec::new();
    for (i, buffer) in document.buffers.iter().enumerate() {
        let data = match &buffer.uri {
            None if i == 0 => Cow::Borrowed(binary.unwrap_or_default()),
            None => return Err(malformed(format!("buffer {i} has no data"))),
            Some(uri) => Cow::Owned(contents_of(uri, folder, &options.with_max_memory_bytes(left))?),
        };
        if data.len() < buffer.byte_length {
            return Err(malformed(format!(
                "buffer {i} is truncated: it has {} of {} bytes",
                data.len(),
                buffer.byte_length
            )));
        }
        if matches!(data, Cow::Owned(_)) {
            left = left.saturating_sub(data.len() as u64);
        }
        buffers.push(data);
    }
    let options = &options.with_max_memory_bytes(left);
    let file = File { document: &document, buffers: &buffers, options };
    let mut vertices = Vertices::default();
    let placed = file.placed()?;
    let mut steps = 0;
    for (mesh, placing) in &placed {
        let mesh = document.meshes.get(*mesh).ok_or_else(|| malformed(format!("mesh {mesh} does not exist")))?;
        steps += mesh.primitives.len();
        if steps > MOST_PLACED {
            return Err(malformed(format!("the scene has more than {MOST_PLACED} mesh primitives")));
        }
        // Primitives with different materials may share their vertices.
        let mut seen = BTreeSet::new();
        for primitive in mesh.primitives.iter().filter(|primitive| seen.insert(primitive.attributes.position)) {
            file.add(primitive, placing, &mut vertices)?;
        }
    }
    vertices.cloud(notes)
}

/// Returns an error if the document could exceed the memory limit: objects and lists take far more memory than text.
fn check_json(json: &[u8], options: &ReadOptions) -> FormatResult<()> {
    /// Size of the largest object, with its lists.
    const BYTES_PER_OBJECT: usize = 400;
    /// Size of an element of a list, which grows by doubling.
    const BYTES_PER_ELEMENT: usize = 40;
    let count = |of: &[u8]| json.iter().filter(|byte| of.contains(byte)).count();
    options.check(BYTES_PER_OBJECT * count(b"{[") + BYTES_PER_ELEMENT * count(b","), 1)
}

/// Returns the JSON chunk and the binary chunk of a GLB.
fn chunks(bytes: &[u8]) -> FormatResult<(&[u8], Option<&[u8]>)> {
    let number = |at: usize| {
        let four = bytes.get(at..at + 4).and_then(|four| <[u8; 4]>::try_from(four).ok());
        four.map(u32::from_le_bytes).ok_or_else(|| malformed("the file is truncated"))
    };
    let version = number(4)?;
    if version != 2 {
        return Err(other_version(&version.to_string()));
    }
    let (mut json, mut binary, mut at) = (None, None, 12);
    while at < bytes.len() {
        let (length, kind) = (number(at)? as usize, number(at + 4)?);
        let chunk = bytes.get(at + 8..at + 8 + length).ok_or_else(|| malformed("the file is truncated"))?;
        match kind {
            JSON => json = json.or(Some(chunk)),
            BINARY => binary = binary.or(Some(chunk)),
            _ => {}
        }
        // Chunks begin at multiples of four bytes, but some writers omit the padding.
        let is_chunk = |at: usize| matches!(number(at + 4), Ok(JSON | BINARY));
        at += 8 + if is_chunk(at + 8 + length) { length } else { length.next_multiple_of(4) };
    }
    json.map(|json| (json, binary)).ok_or_else(|| malformed("the JSON chunk is missing"))
}

/// Returns true for extensions of materials, textures and lights, which do not change vertices.
fn is_of_looks(extension: &str) -> bool {
    ["KHR_materials", "KHR_technique", "KHR_texture", "EXT_texture", "MSFT_texture", "KHR_lights"]
        .iter()
        .any(|prefix| extension.starts_with(prefix))
}

/// Decodes the percent-encoding of a URI; `None` if the result is not UTF-8.
fn without_escapes(uri: &str) -> Option<String> {
    let (mut bytes, mut rest) = (Vec::new(), uri.as_bytes());
    while let [byte, behind @ ..] = rest {
        let digits = behind.first_chunk::<2>().filter(|_| *byte == b'%');
        let escaped = digits.and_then(|two| u8::from_str_radix(std::str::from_utf8(two).ok()?, 16).ok());
        bytes.push(escaped.unwrap_or(*byte));
        rest = if escaped.is_some() { &behind[2..] } else { behind };
    }
    String::from_utf8(bytes).ok()
}

/// Returns the bytes of a buffer, from a data URI, or from a file in the document's folder or below it.
fn contents_of(uri: &str, folder: Option<&Path>, options: &ReadOptions) -> FormatResult<Vec<u8>> {
    if let Some(data) = uri.strip_prefix("data:") {
        let (_, text) = data.split_once(";base64,").ok_or_else(|| malformed("a data URI is not base64"))?;
        options.check(text.len(), 1)?;
        let padding = base64::engine::DecodePaddingMode::Indifferent;
        let config = base64::engine::GeneralPurposeConfig::new().with_decode_padding_mode(padding);
        let decoder = base64::engine::GeneralPurpose::new(&base64::alphabet::STANDARD, config);
        return decoder.decode(text).map_err(malformed);
    }
    let name = without_escapes(uri).ok_or_else(|| malformed(format!("the URI {} is not UTF-8", quoted(uri))))?;
    let is_part = |part| matches!(part, Component::Normal(_) | Component::CurDir);
    let path = folder.filter(|_| Path::new(&name).components().all(is_part)).map(|folder| folder.join(&name));
    // Links must not lead out of the folder.
    let real = |path: &Path| path.canonicalize().ok();
    let is_below = |path: &PathBuf| match (real(path), folder.and_then(|folder| real(&folder.join(".")))) {
        (Some(path), Some(folder)) => path.starts_with(folder),
        _ => true,
    };
    match path.filter(is_below) {
        Some(path) => read_bytes(&path, options).map_err(|error| match error {
            FormatError::TooLarge { .. } => error,
            error => {
                FormatError::Unsupported(format!("its points are in {}, which cannot be read: {error}", quoted(&name)))
            }
        }),
        _ => Err(FormatError::Unsupported(format!(
            "its points are in another file, {}; save it as one file (GLB)",
            quoted(&name)
        ))),
    }
}

struct File<'a> {
    document: &'a Document,
    buffers: &'a [Cow<'a, [u8]>],
    options: &'a ReadOptions,
}

impl File<'_> {
    /// Returns the index of each mesh placed in the scene, with its transform. In a file without nodes, all meshes get
    /// the identity.
    fn placed(&self) -> FormatResult<Vec<(usize, DMat4)>> {
        let Document { scenes, scene, nodes, meshes, .. } = self.document;
        let children: BTreeSet<usize> = nodes.iter().flat_map(|node| &node.children).copied().collect();
        let roots: Vec<usize> = match (scenes.get(scene.unwrap_or(0)), scene) {
            (Some(scene), _) => scene.nodes.clone(),
            (None, Some(scene)) => return Err(malformed(format!("scene {scene} does not exist"))),
            (None, None) if nodes.is_empty() => {
                return Ok((0..meshes.len().min(MOST_PLACED)).map(|mesh| (mesh, DMat4::IDENTITY)).collect());
            }
            (None, None) if nodes.len() > MOST_UNROOTED => {
                return Err(malformed("the file has too many nodes without a scene"));
            }
            (None, None) => (0..nodes.len()).filter(|i| !children.contains(i)).collect(),
        };
        let mut found = Vec::new();
        let mut open: Vec<(usize, DMat4, usize)> = roots.into_iter().map(|root| (root, DMat4::IDENTITY, 0)).collect();
        let mut visits = 0;
        while let Some((i, parent, depth)) = open.pop() {
            let node = nodes.get(i).ok_or_else(|| malformed(format!("node {i} does not exist")))?;
            visits += 1 + node.children.len();
            if depth > DEEPEST || visits > MOST_PLACED {
                return Err(malformed("too many nodes, or they form a loop"));
            }
            // Cameras, lights and joints place no points. A skinned mesh is placed by its joints; the transform of its
            // node is ignored.
            if node.children.is_empty() && (node.mesh.is_none() || node.skin.is_some()) {
                found.extend(node.mesh.map(|mesh| (mesh, DMat4::IDENTITY)));
                continue;
            }
            let place = parent * node.place()?;
            if !place.is_finite() {
                return Err(malformed("the matrices of the nodes exceed the range of f64"));
            }
            found.extend(node.mesh.map(|mesh| (mesh, if node.skin.is_some() { DMat4::IDENTITY } else { place })));
            open.extend(node.children.iter().map(|child| (*child, place, depth + 1)));
        }
        Ok(found)
    }

    fn add(&self, primitive: &Primitive, place: &DMat4, vertices: &mut Vertices) -> FormatResult<()> {
        let Attributes { position, normal, colour, .. } = primitive.attributes;
        let Some(position) = position else { return Ok(()) };
        let positions = self.values(position, &[FLOAT], &["VEC3"])?;
        let count = positions.len() / 3;
        self.options.check(vertices.positions.len() / 3 + count, BYTES_PER_VERTEX)?;
        let same = |values: Vec<f64>, components: usize| {
            if values.len() == components * count {
                Ok(values)
            } else {
                Err(malformed("vertex attributes have different lengths"))
            }
        };
        for xyz in positions.as_chunks::<3>().0 {
            vertices.positions.extend(place.transform_point3(DVec3::from(*xyz)).to_array());
        }
        let before = vertices.positions.len() / 3 - count;
        if let Some(normal) = normal {
            let normals = same(self.values(normal, &[FLOAT], &["VEC3"])?, 3)?;
            let turn = glam::DMat3::from_mat4(*place).inverse().transpose();
            vertices.normals.resize(3 * before, f32::NAN);
            for xyz in normals.as_chunks::<3>().0 {
                let turned = (turn * DVec3::from(*xyz)).normalize_or_zero();
                vertices.normals.extend(turned.to_array().map(|value| value as f32));
            }
        }
        if let Some(colour) = colour {
            let components = if self.accessor(colour)?.kind == "VEC4" { 4 } else { 3 };
            let colours = same(self.values(colour, &[FLOAT, BYTE, SHORT], &["VEC3", "VEC4"])?, components)?;
            vertices.colours.resize(3 * before, 0);
            let bytes = colours.chunks_exact(components).flat_map(|all| &all[..3]);
            vertices.colours.extend(bytes.map(|value| (255.0 * value).round() as u8));
            vertices.coloured += count;
        }
        Ok(())
    }

    fn accessor(&self, i: usize) -> FormatResult<&Accessor> {
        self.document.accessors.get(i).ok_or_else(|| malformed(format!("accessor {i} does not exist")))
    }

    /// Returns an accessor's numbers; integers are divided by the largest value of their type.
    fn values(&self, i: usize, types: &[u32], kinds: &[&str]) -> FormatResult<Vec<f64>> {
        let accessor = self.accessor(i)?;
        let Accessor { buffer_view, byte_offset, component_type, count, kind, sparse } = accessor;
        if !types.contains(component_type) || !kinds.contains(&&kind[..]) {
            return Err(FormatError::Unsupported(format!(
                "unsupported glTF vertex attribute {} of component type {component_type}; expected floats",
                quoted(kind)
            )));
        }
        if sparse.is_some() {
            return Err(FormatError::Unsupported(
                "sparse glTF accessors are not supported; export the file again without them".into(),
            ));
        }
        let components = if kind == "VEC4" { 4 } else { 3 };
        let size = match *component_type {
            BYTE => 1,
            SHORT => 2,
            _ => 4,
        };
        let view = buffer_view.and_then(|view| self.document.buffer_views.get(view));
        let view = view.ok_or_else(|| {
            FormatError::Unsupported(format!(
                "accessor {i} of the glTF has no data; export the file without compression"
            ))
        })?;
        let data = self.buffers.get(view.buffer).and_then(|data| {
            data.get(view.byte_offset..view.byte_offset.checked_add(view.byte_length)?)?.get(*byte_offset..)
        });
        let data = data.ok_or_else(|| malformed(format!("accessor {i} is outside its buffer")))?;
        let each = components * size;
        let stride = view.byte_stride.unwrap_or(each);
        // The last element may be shorter than the stride.
        let before_last = stride.checked_mul(count.saturating_sub(1));
        let needed = before_last.and_then(|bytes| bytes.checked_add(each)).unwrap_or(usize::MAX);
        if *count == 0 || stride < each || needed > data.len() {
            return Err(malformed(format!("accessor {i} with {count} elements does not fit its buffer")));
        }
        self.options.check(*count, 8 * components)?;
        let mut values = Vec::with_capacity(count * components);
        for element in (0..*count).map(|k| &data[k * stride..k * stride + each]) {
            values.extend(element.chunks_exact(size).map(|bytes| match *bytes {
                [byte] => f64::from(byte) / 255.0,
                [a, b] => f64::from(u16::from_le_bytes([a, b])) / 65535.0,
                [a, b, c, d] => f64::from(f32::from_le_bytes([a, b, c, d])),
                _ => f64::NAN,
            }));
        }
        Ok(values)
    }
}

impl Attributes {
    /// Returns the names of custom attributes; those of textures and skins are not included.
    fn own(&self) -> impl Iterator<Item = &str> {
        self.others.keys().map(String::as_str).filter(|name| name.starts_with('_'))
    }
}

impl Node {
    /// Returns the transform of the node.
    ///
    /// # Errors
    /// If the matrix is zero or not finite, or the length of the quaternion is not 1.
    fn place(&self) -> FormatResult<DMat4> {
        const LENGTH_TOLERANCE: f64 = 0.01;
        let Self { matrix, translation, rotation, scale, .. } = self;
        let place = match matrix {
            Some(matrix) => DMat4::from_cols_array(matrix),
            None => {
                let rotation = DQuat::from_array(rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
                // False if the length is NaN.
                let is_unit = (rotation.length() - 1.0).abs() <= LENGTH_TOLERANCE;
                if !is_unit {
                    return Err(malformed("the rotation of a node is not a quaternion of length 1"));
                }
                DMat4::from_scale_rotation_translation(
                    DVec3::from(scale.unwrap_or([1.0; 3])),
                    rotation.normalize(),
                    DVec3::from(translation.unwrap_or_default()),
                )
            }
        };
        if !place.is_finite() || *matrix == Some([0.0; 16]) {
            return Err(malformed("the matrix of a node is zero or not finite"));
        }
        Ok(place)
    }
}

/// The vertices read so far. There may be fewer normals and colours than positions.
#[derive(Default)]
struct Vertices {
    positions: Vec<f64>,
    normals: Vec<f32>,
    colours: Vec<u8>,
    coloured: usize,
}

impl Vertices {
    fn cloud(mut self, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
        let count = self.positions.len() / 3;
        if count == 0 {
            return Err(FormatError::Malformed("the glTF has no vertices".into()));
        }
        let axis = |values: &[f64], axis: usize| values.iter().skip(axis).step_by(3).copied().collect::<Vec<f64>>();
        let mut columns = Vec::new();
        for (k, name) in ["x", "y", "z"].into_iter().enumerate() {
            columns.push(Attribute { name: name.into(), count: 1, values: axis(&self.positions, k).into() });
        }
        if !self.normals.is_empty() {
            self.normals.resize(3 * count, f32::NAN);
            for (k, name) in ["normal_x", "normal_y", "normal_z"].into_iter().enumerate() {
                let values: Vec<f32> = self.normals.iter().skip(k).step_by(3).copied().collect();
                columns.push(Attribute { name: name.into(), count: 1, values: values.into() });
            }
        }
        if !self.colours.is_empty() {
            self.colours.resize(3 * count, 0);
            if self.coloured < count {
                notes.push(format!("{} of {count} vertices have no colour; they are black", count - self.coloured));
            }
            for (k, name) in ["red", "green", "blue"].into_iter().enumerate() {
                let values: Vec<u8> = self.colours.iter().skip(k).step_by(3).copied().collect();
                columns.push(Attribute { name: name.into(), count: 1, values: values.into() });
            }
        }
        let mut cloud = cloud_from_columns(columns)?;
        cloud.position_columns.precision = Precision::AsNeeded;
        Ok(cloud)
    }
}

#[cfg(test)]
mod tests;
