//! Messages in CDR. The fields are in the order of the definitions of `foxglove_msgs`.

use serde::{Deserialize, Serialize};

use super::{Codec, CompressedImage, field_of, in_one_row, type_of};
use crate::ros::{CameraInfo, Header, Image, PointCloud2, Time, few, from_cdr, to_cdr};
use planish_core::FormatError;

pub(super) struct Cdr;

#[derive(Serialize, Deserialize)]
struct RawImage {
    timestamp: Time,
    frame_id: String,
    width: u32,
    height: u32,
    encoding: String,
    step: u32,
    #[serde(with = "serde_bytes")]
    data: Vec<u8>,
}

#[derive(Serialize, Deserialize)]
struct Compressed {
    timestamp: Time,
    frame_id: String,
    #[serde(with = "serde_bytes")]
    data: Vec<u8>,
    format: String,
}

#[derive(Serialize, Deserialize)]
struct PointCloud {
    timestamp: Time,
    frame_id: String,
    position: [f64; 3],
    orientation: [f64; 4],
    point_stride: u32,
    #[serde(deserialize_with = "few")]
    fields: Vec<PackedElementField>,
    #[serde(with = "serde_bytes")]
    data: Vec<u8>,
}

#[derive(Serialize, Deserialize)]
struct PackedElementField {
    name: String,
    offset: u32,
    kind: u8,
}

#[derive(Serialize, Deserialize)]
struct CameraCalibration {
    timestamp: Time,
    frame_id: String,
    width: u32,
    height: u32,
    distortion_model: String,
    d: Vec<f64>,
    k: [f64; 9],
    r: [f64; 9],
    p: [f64; 12],
}

impl Codec for Cdr {
    fn image(&self, message: &[u8]) -> Result<Image, FormatError> {
        let RawImage { timestamp: stamp, frame_id, width, height, encoding, step, data } = from_cdr(message)?;
        Ok(Image { header: Header { stamp, frame_id }, height, width, encoding, is_bigendian: 0, step, data })
    }

    fn compressed_image(&self, message: &[u8]) -> Result<CompressedImage, FormatError> {
        let Compressed { timestamp: stamp, frame_id, data, format } = from_cdr(message)?;
        Ok(CompressedImage { header: Header { stamp, frame_id }, format, data })
    }

    fn cloud(&self, message: &[u8]) -> Result<PointCloud2, FormatError> {
        let PointCloud { timestamp: stamp, frame_id, point_stride, fields, data, .. } = from_cdr(message)?;
        let fields = fields.into_iter().map(|field| field_of(field.name, field.offset, field.kind.into())).collect();
        let header = Header { stamp, frame_id };
        in_one_row(PointCloud2 { header, fields, point_step: point_stride, data, ..PointCloud2::default() })
    }

    fn camera(&self, message: &[u8]) -> Result<CameraInfo, FormatError> {
        let CameraCalibration { timestamp: stamp, frame_id, width, height, distortion_model, d, k, r, p } =
            from_cdr(message)?;
        let header = Header { stamp, frame_id };
        Ok(CameraInfo { header, height, width, distortion_model, d, k, r, p, ..CameraInfo::default() })
    }

    fn with_image(&self, original: &[u8], image: &Image) -> Result<Vec<u8>, FormatError> {
        let original: RawImage = from_cdr(original)?;
        to_cdr(&RawImage { step: image.step, data: image.data.clone(), ..original })
    }

    fn with_png(&self, original: &[u8], png: &[u8]) -> Result<Vec<u8>, FormatError> {
        let original: Compressed = from_cdr(original)?;
        to_cdr(&Compressed { data: png.to_vec(), ..original })
    }

    fn with_cloud(&self, original: &[u8], cloud: &PointCloud2) -> Result<Vec<u8>, FormatError> {
        let original: PointCloud = from_cdr(original)?;
        let fields = cloud.fields.iter().map(|field| {
            Ok(PackedElementField { name: field.name.clone(), offset: field.offset, kind: type_of(field)? })
        });
        let fields = fields.collect::<Result<_, FormatError>>()?;
        to_cdr(&PointCloud { point_stride: cloud.point_step, fields, data: cloud.data.clone(), ..original })
    }
}
