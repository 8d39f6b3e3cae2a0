//! Messages in JSON, with bytes in base64.

use std::borrow::Cow;
use std::fmt;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use serde::de::{DeserializeOwned, Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::value::{RawValue, to_raw_value};

use super::{Codec, CompressedImage, MOST_FIELDS, field_of, in_one_row, type_of};
use crate::ros::{CameraInfo, Header, Image, PointCloud2, Time};
use planish_core::FormatError;
use planish_io::internal::{brief, quoted};

/// Maximum number of fields of a message.
const MOST_MEMBERS: usize = 1000;
/// Maximum length of the JSON of a number, a string or a list of numbers, in bytes.
const LONGEST_VALUE: usize = 1 << 20;

pub(super) struct Json;

/// A message: its fields in order, as text. Fields that Foxglove does not define are not parsed.
struct Message<'a>(Vec<(Cow<'a, str>, Cow<'a, RawValue>)>);

impl<'de> Deserialize<'de> for Message<'de> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Members;
        impl<'de> Visitor<'de> for Members {
            type Value = Message<'de>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Message<'de>, A::Error> {
                let mut members = Vec::new();
                while let Some((name, value)) = map.next_entry::<String, &RawValue>()? {
                    if members.len() == MOST_MEMBERS {
                        return Err(A::Error::custom(format!("more than {MOST_MEMBERS} fields")));
                    }
                    members.push((Cow::Owned(name), Cow::Borrowed(value)));
                }
                Ok(Message(members))
            }
        }
        deserializer.deserialize_map(Members)
    }
}

impl Serialize for Message<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(name, value)| (name, value)))
    }
}

/// A time in JSON. Writers may omit zeros, and write whole numbers with decimals.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Stamp {
    sec: f64,
    nsec: f64,
}

/// A field of a cloud in JSON, which may omit zeros.
#[derive(Default, Serialize, Deserialize)]
#[serde(default)]
struct PackedElementField {
    name: String,
    #[serde(deserialize_with = "count")]
    offset: u32,
    #[serde(deserialize_with = "count")]
    r#type: u32,
}

/// Returns a whole number, which JavaScript may write with decimals.
fn whole(value: f64) -> Option<u32> {
    (value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&value)).then_some(value as u32)
}

fn count<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    whole(f64::deserialize(deserializer)?).ok_or_else(|| D::Error::custom("not a whole number below 2^32"))
}

fn unreadable(name: &str, text: &str, expected: &str) -> FormatError {
    FormatError::Malformed(format!("the field {name} of a message is {}; expected {expected}", quoted(&brief(text))))
}

impl<'a> Message<'a> {
    fn parse(message: &'a [u8]) -> Result<Self, FormatError> {
        serde_json::from_slice(message).map_err(|error| {
            FormatError::Malformed(format!("damaged Foxglove message in JSON: {}", brief(&error.to_string())))
        })
    }

    /// Returns the text of a field's value; `None` if the field is missing or null.
    fn value(&self, name: &str) -> Option<&str> {
        let (_, value) = self.0.iter().rev().find(|(found, _)| found == name)?;
        Some(value.get()).filter(|text| *text != "null")
    }

    /// Returns the value of a field; the default if it is missing.
    fn read<T: DeserializeOwned + Default>(&self, name: &str, expected: &str) -> Result<T, FormatError> {
        let Some(text) = self.value(name) else { return Ok(T::default()) };
        let value = if text.len() <= LONGEST_VALUE { serde_json::from_str(text).ok() } else { None };
        value.ok_or_else(|| unreadable(name, text, expected))
    }

    /// Returns the bytes of the message with the values of these fields replaced.
    fn with<const N: usize>(mut self, fields: [(&str, Box<RawValue>); N]) -> Result<Vec<u8>, FormatError> {
        for (name, value) in fields {
            self.0.retain(|(other, _)| other != name);
            self.0.push((Cow::Owned(name.to_owned()), Cow::Owned(value)));
        }
        serde_json::to_vec(&self).map_err(cannot_encode)
    }

    fn text(&self, name: &str) -> Result<String, FormatError> {
        self.read(name, "a string")
    }

    fn number(&self, name: &str) -> Result<u32, FormatError> {
        let expected = "a whole number below 2^32";
        let value: f64 = self.read(name, expected)?;
        whole(value).ok_or_else(|| unreadable(name, &value.to_string(), expected))
    }

    fn numbers(&self, name: &str) -> Result<Vec<f64>, FormatError> {
        self.read(name, "a list of numbers")
    }

    /// Returns a matrix; all zeros if it is missing.
    fn matrix<const N: usize>(&self, name: &str) -> Result<[f64; N], FormatError>
    where
        [f64; N]: Default,
    {
        let numbers = self.numbers(name)?;
        match numbers.len() {
            0 => Ok(Default::default()),
            count => numbers.try_into().map_err(|_| {
                FormatError::Malformed(format!("the field {name} of a message has {count} numbers; expected {N}"))
            }),
        }
    }

    fn bytes(&self, name: &str) -> Result<Vec<u8>, FormatError> {
        let Some(text) = self.value(name) else { return Ok(Vec::new()) };
        let text: Cow<'_, str> = serde_json::from_str(text).map_err(|_| unreadable(name, text, "bytes in base64"))?;
        BASE64_STANDARD
            .decode(&*text)
            .map_err(|error| FormatError::Malformed(format!("the field {name} of a message is not base64: {error}")))
    }

    fn header(&self) -> Result<Header, FormatError> {
        let expected = "seconds (sec, up to 2038) and nanoseconds (nsec)";
        let stamp = match self.read::<Option<Stamp>>("timestamp", expected)? {
            None => Time::default(),
            Some(Stamp { sec, nsec }) => {
                let seconds = (sec.fract() == 0.0 && sec.abs() <= f64::from(i32::MAX)).then_some(sec as i32);
                let time = seconds.zip(whole(nsec)).map(|(sec, nanosec)| Time { sec, nanosec });
                time.ok_or_else(|| unreadable("timestamp", &format!("{sec} s and {nsec} ns"), expected))?
            }
        };
        Ok(Header { stamp, frame_id: self.text("frame_id")? })
    }
}

fn raw(value: &impl Serialize) -> Result<Box<RawValue>, FormatError> {
    to_raw_value(value).map_err(cannot_encode)
}

fn cannot_encode(error: serde_json::Error) -> FormatError {
    FormatError::Unsupported(format!("cannot encode this message as JSON: {error}"))
}

impl Codec for Json {
    fn image(&self, message: &[u8]) -> Result<Image, FormatError> {
        let message = Message::parse(message)?;
        Ok(Image {
            header: message.header()?,
            height: message.number("height")?,
            width: message.number("width")?,
            encoding: message.text("encoding")?,
            is_bigendian: 0,
            step: message.number("step")?,
            data: message.bytes("data")?,
        })
    }

    fn compressed_image(&self, message: &[u8]) -> Result<CompressedImage, FormatError> {
        let message = Message::parse(message)?;
        let (format, data) = (message.text("format")?, message.bytes("data")?);
        Ok(CompressedImage { header: message.header()?, format, data })
    }

    fn cloud(&self, message: &[u8]) -> Result<PointCloud2, FormatError> {
        let message = Message::parse(message)?;
        let fields: Vec<PackedElementField> =
            message.read("fields", "a list of at most 1000 fields with name, offset and type")?;
        if fields.len() > MOST_FIELDS {
            return Err(unreadable("fields", &format!("{} fields", fields.len()), "at most 1000"));
        }
        in_one_row(PointCloud2 {
            header: message.header()?,
            fields: fields.into_iter().map(|field| field_of(field.name, field.offset, field.r#type.into())).collect(),
            point_step: message.number("point_stride")?,
            data: message.bytes("data")?,
            ..PointCloud2::default()
        })
    }

    fn camera(&self, message: &[u8]) -> Result<CameraInfo, FormatError> {
        let message = Message::parse(message)?;
        Ok(CameraInfo {
            header: message.header()?,
            height: message.number("height")?,
            width: message.number("width")?,
            distortion_model: message.text("distortion_model")?,
            d: message.numbers("D")?,
            k: message.matrix("K")?,
            r: message.matrix("R")?,
            p: message.matrix("P")?,
            ..CameraInfo::default()
        })
    }

    fn with_image(&self, original: &[u8], image: &Image) -> Result<Vec<u8>, FormatError> {
        let data = BASE64_STANDARD.encode(&image.data);
        Message::parse(original)?.with([("step", raw(&image.step)?), ("data", raw(&data)?)])
    }

    fn with_png(&self, original: &[u8], png: &[u8]) -> Result<Vec<u8>, FormatError> {
        Message::parse(original)?.with([("data", raw(&BASE64_STANDARD.encode(png))?)])
    }

    fn with_cloud(&self, original: &[u8], cloud: &PointCloud2) -> Result<Vec<u8>, FormatError> {
        let fields = cloud.fields.iter().map(|field| {
            Ok(PackedElementField { name: field.name.clone(), offset: field.offset, r#type: type_of(field)?.into() })
        });
        let fields = fields.collect::<Result<Vec<_>, FormatError>>()?;
        let data = BASE64_STANDARD.encode(&cloud.data);
        Message::parse(original)?.with([
            ("point_stride", raw(&cloud.point_step)?),
            ("fields", raw(&fields)?),
            ("data", raw(&data)?),
        ])
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    const CAMERA: &str = r#"{"timestamp":{"sec":7,"nsec":5},"width":64.0,"height":48,"K":[1,0,2,0,3,4,0,0,1]}"#;

    #[test]
    fn values_of_another_type_are_errors_that_name_the_field() {
        let info = Json.camera(CAMERA.as_bytes()).unwrap();
        assert_eq!((info.width, info.k[0], info.p[0], info.header.stamp.sec), (64, 1.0, 0.0, 7));
        for (before, after, field) in [
            ("64.0", "\"64\"", "width"),
            ("64.0", "64.5", "width"),
            ("64.0", "-1", "width"),
            ("[1,", "[null,", "K"),
            ("[1,", "[\"1\",", "K"),
            ("[1,0,", "[1,", "K"),
            ("{\"sec\":7,\"nsec\":5}", "\"2026-01-01T00:00:00Z\"", "timestamp"),
            ("\"sec\":7", "\"sec\":3000000000", "timestamp"),
        ] {
            let error = Json.camera(CAMERA.replace(before, after).as_bytes()).unwrap_err().to_string();
            assert!(error.contains(&format!("the field {field} ")), "{error}");
        }
        let omitted = CAMERA.replace("\"sec\":7,\"nsec\":5", "\"sec\":7.0");
        assert_eq!(Json.camera(omitted.as_bytes()).unwrap().header.stamp, Time { sec: 7, nanosec: 0 });
        let cloud = r#"{"point_stride":8,"fields":[{"name":"x","type":7},{"name":"y","offset":4.0,"type":7}]}"#;
        let fields = Json.cloud(cloud.as_bytes()).unwrap().fields;
        assert_eq!(fields.iter().map(|field| field.offset).collect::<Vec<_>>(), [0, 4]);
        let error = Json.image(br#"{"data":"a=b"}"#).unwrap_err().to_string();
        assert!(error.contains("base64"), "{error}");
    }

    #[test]
    fn unknown_fields_are_copied_without_being_parsed() {
        let original = format!(r#"{{"own":[{}1],"step":2,"data":"AAA=","µ":"ü"}}"#, "[],".repeat(1000));
        let image = Image { step: 64, data: vec![1, 2, 3], ..Image::default() };
        let copy = String::from_utf8(Json.with_image(original.as_bytes(), &image).unwrap()).unwrap();
        assert!(copy.contains(&"[],".repeat(1000)) && copy.contains(r#""µ":"ü""#), "{copy}");
        assert!(copy.contains(r#""step":64"#) && copy.contains(r#""data":"AQID""#) && !copy.contains("AAA="), "{copy}");
        let many = format!("{{{}}}", (0..2000).map(|i| format!("\"a{i}\":0")).collect::<Vec<_>>().join(","));
        assert!(Json.image(many.as_bytes()).unwrap_err().to_string().contains("1000 fields"));
    }
}
