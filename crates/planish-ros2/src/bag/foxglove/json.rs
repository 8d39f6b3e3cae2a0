//! Messages in JSON, with bytes in base64.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use serde_json::{Map, Value, json};

use super::{Codec, CompressedImage, field_of, in_one_row, type_of};
use crate::ros::{CameraInfo, Header, Image, PointCloud2, Time};
use planish_core::FormatError;
use planish_io::internal::brief;

pub(super) struct Json;

/// A message, as its fields.
struct Message(Map<String, Value>);

impl Message {
    fn parse(message: &[u8]) -> Result<Self, FormatError> {
        serde_json::from_slice(message).map(Self).map_err(|error| {
            FormatError::Malformed(format!("damaged Foxglove message in JSON: {}", brief(&error.to_string())))
        })
    }

    /// Returns the bytes of the message with other values of these fields.
    fn with<const N: usize>(mut self, fields: [(&str, Value); N]) -> Result<Vec<u8>, FormatError> {
        self.0.extend(fields.map(|(name, value)| (name.to_owned(), value)));
        serde_json::to_vec(&self.0)
            .map_err(|error| FormatError::Unsupported(format!("cannot encode this message as JSON: {error}")))
    }

    /// Returns a text; empty if it is missing.
    fn text(&self, name: &str) -> String {
        self.0.get(name).and_then(Value::as_str).unwrap_or_default().to_owned()
    }

    /// Returns a count; 0 if it is missing, and the largest number if it is larger.
    fn number(&self, name: &str) -> u32 {
        of_u32(self.0.get(name))
    }

    /// Returns numbers; empty if they are missing.
    fn numbers(&self, name: &str) -> Vec<f64> {
        self.0.get(name).and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_f64).collect()
    }

    fn bytes(&self, name: &str) -> Result<Vec<u8>, FormatError> {
        let text = self.0.get(name).and_then(Value::as_str).unwrap_or_default();
        BASE64_STANDARD
            .decode(text)
            .map_err(|error| FormatError::Malformed(format!("the field {name} of a message is not base64: {error}")))
    }

    fn header(&self) -> Header {
        let time = self.0.get("timestamp");
        let part = |name: &str| time.and_then(|time| time.get(name)).and_then(Value::as_i64).unwrap_or_default();
        let stamp = Time {
            sec: i32::try_from(part("sec")).unwrap_or_default(),
            nanosec: u32::try_from(part("nsec")).unwrap_or_default(),
        };
        Header { stamp, frame_id: self.text("frame_id") }
    }
}

fn of_u32(value: Option<&Value>) -> u32 {
    value.and_then(Value::as_u64).map_or(0, |value| u32::try_from(value).unwrap_or(u32::MAX))
}

impl Codec for Json {
    fn image(&self, message: &[u8]) -> Result<Image, FormatError> {
        let message = Message::parse(message)?;
        Ok(Image {
            header: message.header(),
            height: message.number("height"),
            width: message.number("width"),
            encoding: message.text("encoding"),
            is_bigendian: 0,
            step: message.number("step"),
            data: message.bytes("data")?,
        })
    }

    fn compressed_image(&self, message: &[u8]) -> Result<CompressedImage, FormatError> {
        let message = Message::parse(message)?;
        let (format, data) = (message.text("format"), message.bytes("data")?);
        Ok(CompressedImage { header: message.header(), format, data })
    }

    fn cloud(&self, message: &[u8]) -> Result<PointCloud2, FormatError> {
        let message = Message::parse(message)?;
        let fields = message.0.get("fields").and_then(Value::as_array).into_iter().flatten().map(|field| {
            let name = field.get("name").and_then(Value::as_str).unwrap_or_default().to_owned();
            field_of(name, of_u32(field.get("offset")), of_u32(field.get("type")).into())
        });
        in_one_row(PointCloud2 {
            header: message.header(),
            fields: fields.collect(),
            point_step: message.number("point_stride"),
            data: message.bytes("data")?,
            ..PointCloud2::default()
        })
    }

    fn camera(&self, message: &[u8]) -> Result<CameraInfo, FormatError> {
        let message = Message::parse(message)?;
        Ok(CameraInfo {
            header: message.header(),
            height: message.number("height"),
            width: message.number("width"),
            distortion_model: message.text("distortion_model"),
            d: message.numbers("D"),
            k: message.numbers("K").try_into().unwrap_or_default(),
            r: message.numbers("R").try_into().unwrap_or_default(),
            p: message.numbers("P").try_into().unwrap_or_default(),
            ..CameraInfo::default()
        })
    }

    fn with_image(&self, original: &[u8], image: &Image) -> Result<Vec<u8>, FormatError> {
        let data = BASE64_STANDARD.encode(&image.data);
        Message::parse(original)?.with([("step", image.step.into()), ("data", data.into())])
    }

    fn with_png(&self, original: &[u8], png: &[u8]) -> Result<Vec<u8>, FormatError> {
        Message::parse(original)?.with([("data", BASE64_STANDARD.encode(png).into())])
    }

    fn with_cloud(&self, original: &[u8], cloud: &PointCloud2) -> Result<Vec<u8>, FormatError> {
        let fields = cloud
            .fields
            .iter()
            .map(|field| Ok(json!({ "name": field.name, "offset": field.offset, "type": type_of(field)? })));
        let fields = fields.collect::<Result<Vec<Value>, FormatError>>()?;
        let data = BASE64_STANDARD.encode(&cloud.data);
        let stride = cloud.point_step;
        Message::parse(original)?.with([
            ("point_stride", stride.into()),
            ("fields", fields.into()),
            ("data", data.into()),
        ])
    }
}
