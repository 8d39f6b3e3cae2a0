//! The colours of a frame's pixels, as their owner stores them.

use crate::cloud::{AttributeValues, PointCloud};

/// Borrowed colours, one per pixel or point.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Colours<'a> {
    /// Red, green and blue bytes.
    Bytes(&'a [u8]),
    /// PCL's packed field, 0xAARRGGBB.
    Packed(&'a AttributeValues),
    /// Red, green and blue in separate channels.
    Channels([&'a [u8]; 3]),
}

impl<'a> Colours<'a> {
    /// Returns the colours of a cloud: a packed field `rgb` or `rgba`, or byte fields `red`, `green` and `blue`.
    /// `None` without such fields.
    pub(crate) fn of_cloud(cloud: &'a PointCloud) -> Option<Self> {
        let field = |name: &str| cloud.attribute(name).filter(|field| field.count == 1).map(|field| &field.values);
        let is_packed = |values: &&AttributeValues| {
            matches!(values, AttributeValues::F32(_) | AttributeValues::U32(_) | AttributeValues::I32(_))
        };
        let packed = field("rgb").or_else(|| field("rgba")).filter(is_packed).map(Self::Packed);
        let channel = |name: &str| match field(name)? {
            AttributeValues::U8(values) => Some(values.as_slice()),
            _ => None,
        };
        packed.or_else(|| Some(Self::Channels([channel("red")?, channel("green")?, channel("blue")?])))
    }

    /// Returns the colour of pixel `i`; black if `i` is out of range.
    pub(crate) fn at(self, i: usize) -> [u8; 3] {
        let of_bits = |bits: Option<u32>| {
            let [_, r, g, b] = bits.unwrap_or(0).to_be_bytes();
            [r, g, b]
        };
        match self {
            Self::Bytes(bytes) => bytes.get(3 * i..3 * i + 3).map_or([0; 3], |rgb| [rgb[0], rgb[1], rgb[2]]),
            Self::Channels(channels) => channels.map(|values| values.get(i).copied().unwrap_or(0)),
            Self::Packed(AttributeValues::F32(values)) => of_bits(values.get(i).map(|value| value.to_bits())),
            Self::Packed(AttributeValues::U32(values)) => of_bits(values.get(i).copied()),
            Self::Packed(AttributeValues::I32(values)) => of_bits(values.get(i).map(|&value| value as u32)),
            Self::Packed(_) => [0; 3],
        }
    }
}
