//! Colour fields: PCL packs colour into one 4-byte field (`rgb`, `rgba`); PLY has `red`, `green`, `blue` (and `alpha`).

use crate::cloud::{Attribute, AttributeValues, PointCloud};

const CHANNELS: [&str; 4] = ["red", "green", "blue", "alpha"];

/// Returns the bits of a packed colour field, 0xAARRGGBB for each point; `None` for fields of other types.
pub(crate) fn packed(attribute: &Attribute) -> Option<Vec<u32>> {
    if attribute.count != 1 {
        return None;
    }
    match &attribute.values {
        AttributeValues::F32(values) => Some(values.iter().map(|value| value.to_bits()).collect()),
        AttributeValues::U32(values) => Some(values.clone()),
        AttributeValues::I32(values) => Some(values.iter().map(|&value| value as u32).collect()),
        _ => None,
    }
}

impl PointCloud {
    /// Returns the index of the packed colour field and its bits.
    fn packed_colour(&self) -> Option<(usize, Vec<u32>)> {
        let index = self.attributes.iter().position(|a| a.name == "rgb" || a.name == "rgba")?;
        Some((index, packed(&self.attributes[index])?))
    }

    /// Returns red, green and blue of each point from a packed field or separate ones; `None` without 8-bit colours.
    pub fn rgb(&self) -> Option<Vec<[u8; 3]>> {
        if let Some((_, packed)) = self.packed_colour() {
            return Some(packed.iter().map(|bits| [(bits >> 16) as u8, (bits >> 8) as u8, *bits as u8]).collect());
        }
        let [r, g, b] = [0, 1, 2].map(|channel| self.channel(channel));
        Some(r?.iter().zip(g?).zip(b?).map(|((&r, &g), &b)| [r, g, b]).collect())
    }

    /// Returns the colour of each point in 8 bits per channel; `None` for a cloud without colours. For 16-bit colours
    /// (LAS), the upper 8 bits are returned, or the lower 8 bits if no value in the cloud exceeds 255. Fractions from 0
    /// to 1 (Open3D) are multiplied by 255.
    pub fn shown_rgb(&self) -> Option<Vec<[u8; 3]>> {
        self.rgb().or_else(|| self.wide_rgb())
    }

    fn wide_rgb(&self) -> Option<Vec<[u8; 3]>> {
        let channel = |k: usize| self.attribute(CHANNELS[k]).filter(|attribute| attribute.count == 1);
        let channels = [channel(0)?, channel(1)?, channel(2)?].map(|attribute| &attribute.values);
        let largest = (0..self.len()).flat_map(|i| channels.map(|values| values.get_f64(i))).fold(0.0, f64::max);
        let is_fraction =
            |values: &AttributeValues| matches!(values, AttributeValues::F32(_) | AttributeValues::F64(_));
        let scale = if channels.into_iter().all(|values| matches!(values, AttributeValues::U16(_))) {
            if largest > 255.0 { 1.0 / 256.0 } else { 1.0 }
        } else if channels.into_iter().all(is_fraction) && largest <= 1.0 {
            255.0
        } else {
            return None;
        };
        // The cast truncates, and turns NaN into 0.
        Some((0..self.len()).map(|i| channels.map(|values| (scale * values.get_f64(i)) as u8)).collect())
    }

    fn channel(&self, channel: usize) -> Option<&Vec<u8>> {
        match self.attribute(CHANNELS[channel])? {
            Attribute { count: 1, values: AttributeValues::U8(values), .. } => Some(values),
            _ => None,
        }
    }

    /// Converts fractional intensities from 0 to 1 to 16-bit integers, as in LAS; NaN becomes 0. Returns true if the
    /// field was converted.
    pub fn scale_intensity(&mut self) -> bool {
        let Some(Attribute { count: 1, values, .. }) = self.attribute("intensity") else { return false };
        let is_float = matches!(values, AttributeValues::F32(_) | AttributeValues::F64(_));
        let all = || (0..values.len()).map(|i| values.get_f64(i));
        let is_allowed = |value: f64| value.is_nan() || (0.0..=1.0).contains(&value);
        if !is_float || !all().all(is_allowed) || !all().any(|value| value.fract() > 0.0) {
            return false;
        }
        let scaled: Vec<u16> = all().map(|value| (value * f64::from(u16::MAX)).round() as u16).collect();
        self.set_attribute("intensity", scaled);
        true
    }

    /// Replaces a packed colour by the fields `red`, `green` and `blue` (the names in PLY files), and `alpha` from
    /// `rgba`.
    pub fn unpack_colour(&mut self) {
        let Some((index, packed)) = self.packed_colour() else { return };
        let channels = if self.attributes[index].name == "rgba" { 4 } else { 3 };
        let shifts = [16, 8, 0, 24];
        let channel = |k: usize| Attribute {
            name: CHANNELS[k].to_owned(),
            count: 1,
            values: packed.iter().map(|bits| (bits >> shifts[k]) as u8).collect::<Vec<u8>>().into(),
        };
        self.attributes.splice(index..=index, (0..channels).map(channel));
    }

    /// Replaces the fields `red`, `green` and `blue` by PCL's packed `rgb`, or by `rgba` if there is an `alpha`.
    pub fn pack_colour(&mut self) {
        let Some(index) = self.attributes.iter().position(|a| a.name == "red") else { return };
        // A field with the name of the packed colour may already exist.
        if self.attribute("rgb").or(self.attribute("rgba")).is_some() {
            return;
        }
        let Some(rgb) = self.rgb() else { return };
        let alpha = self.channel(3).cloned();
        let bits = |i: usize| u32::from_be_bytes([alpha.as_ref().map_or(0, |a| a[i]), rgb[i][0], rgb[i][1], rgb[i][2]]);
        let bits = (0..rgb.len()).map(bits);
        let packed = if alpha.is_some() {
            Attribute { name: "rgba".into(), count: 1, values: bits.collect::<Vec<u32>>().into() }
        } else {
            Attribute { name: "rgb".into(), count: 1, values: bits.map(f32::from_bits).collect::<Vec<f32>>().into() }
        };
        self.attributes[index] = packed;
        self.attributes.retain(|a| !CHANNELS.contains(&a.name.as_str()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xyz::Xyz;

    #[test]
    fn packed_and_separate_colours_convert_both_ways_in_place() {
        for (name, values) in [
            ("rgb", AttributeValues::F32(vec![f32::from_bits(0x00ff_8001), f32::from_bits(0x0000_0203)])),
            ("rgba", AttributeValues::U32(vec![0xffff_8001, 0x8000_0203])),
        ] {
            let mut cloud = PointCloud::new(Xyz::filled(2, 1.0));
            cloud.set_attribute(name, values);
            cloud.set_attribute("label", vec![7u16, 8]);
            let original = cloud.clone();
            assert_eq!(cloud.rgb().unwrap(), [[255, 128, 1], [0, 2, 3]]);
            cloud.unpack_colour();
            assert_eq!(cloud.attribute("green").unwrap().values, AttributeValues::U8(vec![128, 2]));
            assert_eq!(cloud.attributes.last().unwrap().name, "label");
            assert_eq!(cloud.rgb(), original.rgb());
            cloud.pack_colour();
            assert_eq!(cloud, original);
        }
    }

    #[test]
    fn colours_of_16_bits_and_fractions_are_seen_and_kept() {
        let mut cloud = PointCloud::new([[0.0; 3]; 2].into_iter().collect());
        let mut rgb_of = |channels: [AttributeValues; 3]| {
            for (name, values) in CHANNELS.iter().zip(channels) {
                cloud.set_attribute(name, values);
            }
            cloud.pack_colour();
            assert!(cloud.attribute("rgb").is_none(), "digits would be lost");
            cloud.shown_rgb()
        };
        let wide = [vec![0xff00u16, 0x0180].into(), vec![0u16, 0x8000].into(), vec![7u16, 0xffff].into()];
        assert_eq!(rgb_of(wide), Some(vec![[255, 0, 0], [1, 128, 255]]));
        let narrow = [vec![255u16, 1].into(), vec![0u16, 128].into(), vec![7u16, 255].into()];
        assert_eq!(rgb_of(narrow), Some(vec![[255, 0, 7], [1, 128, 255]]));
        let fractions = [vec![1f32, 0.0].into(), vec![0.5f32, 1.0].into(), vec![0f32, f32::NAN].into()];
        assert_eq!(rgb_of(fractions), Some(vec![[255, 127, 0], [0, 255, 0]]));
        assert_eq!(rgb_of([vec![1f32, 2.0].into(), vec![0f32; 2].into(), vec![0f32; 2].into()]), None);
    }

    #[test]
    fn intensities_from_0_to_1_become_integers_and_others_stay() {
        let mut cloud = PointCloud::new([[0.0; 3]; 3].into_iter().collect());
        let mut scaled = |values: AttributeValues| {
            cloud.set_attribute("intensity", values);
            (cloud.scale_intensity(), cloud.attribute("intensity").unwrap().values.clone())
        };
        assert_eq!(scaled(vec![f32::NAN, 0.5, 1.0].into()), (true, vec![0u16, 32768, 65535].into()));
        let others: [AttributeValues; 3] =
            [vec![0.0f32, 1.0, 1.0].into(), vec![0.5f64, 2.0, 0.0].into(), vec![7u16, 0, 1].into()];
        for other in others {
            assert_eq!(scaled(other.clone()), (false, other));
        }
    }
}
