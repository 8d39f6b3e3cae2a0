//! Reads the depth channel of OpenEXR images, in metres, as renderers write it.

use std::io::Cursor;

use exr::image::{AnyChannel, AnyChannels, FlatSamples, Layer};
use exr::meta::MetaData;
use exr::prelude::{ReadChannels, ReadLayers};

use super::{Contents, FormatResult, ReadOptions, brief, quoted};
use planish_core::{FormatError, validate_shape};

/// Depth in metres at and above which a pixel is a hole. If a ray hits nothing, renderers write 1e10 or the largest
/// value of the type.
const NOTHING: f32 = 1e9;
/// Depth in metres at and above which a pixel with a 16-bit float is a hole: the type's largest value.
const NOTHING_IN_HALF: f32 = 65504.0;

/// Memory per pixel in bytes, for the depth and the points computed from it.
const BYTES_PER_PIXEL: usize = 24;

fn damaged(error: exr::error::Error) -> FormatError {
    FormatError::Malformed(format!("damaged or unsupported EXR: {}", brief(&error.to_string())))
}

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<Contents> {
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(damaged)?;
    let mut needed = 0u64;
    for header in &meta.headers {
        if header.deep {
            return Err(FormatError::Unsupported(
                "EXR files with deep pixels are not supported; render a flat depth channel".into(),
            ));
        }
        let (width, height) = (header.layer_size.0, header.layer_size.1);
        validate_shape(width, height)?;
        needed = needed.saturating_add((width * height) as u64 * header.channels.bytes_per_pixel as u64);
    }
    options.check(usize::try_from(needed).unwrap_or(usize::MAX), 2)?;
    let image = exr::image::read::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .non_parallel()
        .from_buffered(Cursor::new(bytes))
        .map_err(damaged)?;
    let (layer, channel) = channel_of_depth(&image.layer_data)?;
    if (channel.sampling.0, channel.sampling.1) != (1, 1) {
        return Err(FormatError::Unsupported(
            "the EXR's depth channel has fewer pixels than the image; save it at full resolution".into(),
        ));
    }
    let others: Vec<String> = names(&image.layer_data).filter(|name| *name != full_name(layer, channel)).collect();
    if !others.is_empty() {
        let (read, dropped) = (full_name(layer, channel), others.join(", "));
        notes.push(format!("depth read from the channel {}; dropped: {}", quoted(&read), brief(&dropped)));
    }
    let nothing = if matches!(channel.sample_data, FlatSamples::F16(_)) { NOTHING_IN_HALF } else { NOTHING };
    // The stored window may be smaller than the image, or extend beyond it.
    let window = image.attributes.display_window;
    let (width, height) = (window.size.0, window.size.1);
    validate_shape(width, height)?;
    options.check(width * height, BYTES_PER_PIXEL)?;
    let offset = layer.attributes.layer_position - window.position;
    let stored = layer.size.0.max(1);
    let mut depth_m = vec![f32::NAN; width * height];
    let mut outside = 0;
    for (i, value) in channel.sample_data.values_as_f32().enumerate() {
        let (u, v) = ((i % stored) as i64 + i64::from(offset.0), (i / stored) as i64 + i64::from(offset.1));
        let is_inside = (0..width as i64).contains(&u) && (0..height as i64).contains(&v);
        if is_inside && value < nothing {
            depth_m[v as usize * width + u as usize] = value;
        }
        outside += usize::from(!is_inside && value < nothing);
    }
    if outside > 0 {
        notes.push(format!("{outside} pixels outside the display window of {width}x{height} are dropped"));
    }
    Ok(Contents::DepthMetres { width, height, depth_m })
}

type Channel = AnyChannel<FlatSamples>;
type ChannelLayer = Layer<AnyChannels<FlatSamples>>;

fn full_name(layer: &ChannelLayer, channel: &Channel) -> String {
    match &layer.attributes.layer_name {
        Some(name) if name.as_slice() != b"" => format!("{name}.{}", channel.name),
        _ => channel.name.to_string(),
    }
}

fn channels(layers: &[ChannelLayer]) -> impl Iterator<Item = (&ChannelLayer, &Channel)> {
    layers.iter().flat_map(|layer| layer.channel_data.list.iter().map(move |channel| (layer, channel)))
}

fn names(layers: &[ChannelLayer]) -> impl Iterator<Item = String> {
    channels(layers).map(|(layer, channel)| full_name(layer, channel))
}

/// Finds the depth channel by its name. Otherwise, returns the only channel, or the first if all are equal. Ignores
/// alpha.
fn channel_of_depth(layers: &[ChannelLayer]) -> FormatResult<(&ChannelLayer, &Channel)> {
    let lower = |(layer, channel): &(&ChannelLayer, &Channel)| full_name(layer, channel).to_ascii_lowercase();
    let all_names: Vec<String> = channels(layers).map(|both| lower(&both)).collect();
    let parts = |name: &str| match name.rsplit_once('.') {
        Some((before, last)) => (before.to_owned(), last.to_owned()),
        None => (String::new(), name.to_owned()),
    };
    let is_depth = |name: &str| {
        let (before, last) = parts(name);
        last == "depth" || matches!(&last[..], "z" | "v" | "y" | "r") && before.rsplit('.').next() == Some("depth")
    };
    // If there are also channels x and y, z is a component of normals or positions.
    let is_z = |name: &str| {
        let (before, last) = parts(name);
        let sibling = |axis: &str| if before.is_empty() { axis.to_owned() } else { format!("{before}.{axis}") };
        last == "z" && !["x", "y"].iter().all(|axis| all_names.contains(&sibling(axis)))
    };
    let named = |is_wanted: &dyn Fn(&str) -> bool| channels(layers).find(|both| is_wanted(&lower(both)));
    if let Some(found) = named(&is_depth).or_else(|| named(&is_z)) {
        return Ok(found);
    }
    let mut all = channels(layers).filter(|(_, channel)| !matches!(&channel.name.to_string()[..], "A" | "a"));
    let same = |a: &Channel, b: &Channel| {
        a.sample_data.values_as_f32().map(f32::to_bits).eq(b.sample_data.values_as_f32().map(f32::to_bits))
    };
    if let Some(first) = all.next()
        && all.all(|(_, other)| same(first.1, other))
    {
        return Ok(first);
    }
    let names: Vec<String> = names(layers).collect();
    Err(FormatError::Unsupported(format!(
        "no clear depth channel among the EXR channels {}; expected one channel, or one named Z, Depth or depth.V",
        quoted(&names.join(", "))
    )))
}

#[cfg(test)]
mod tests {
    use exr::prelude::{Encoding, IntegerBounds, LayerAttributes, Vec2, WritableImage};

    use super::*;

    fn image(channels: &[(&str, FlatSamples)], size: (usize, usize), display: IntegerBounds) -> Vec<u8> {
        let list = channels.iter().map(|(name, samples)| AnyChannel::new(*name, samples.clone())).collect();
        let attributes = LayerAttributes { layer_position: Vec2(1, 0), ..LayerAttributes::default() };
        let layer = Layer::new(size, attributes, Encoding::SMALL_FAST_LOSSLESS, AnyChannels::sort(list));
        let mut image = exr::image::Image::from_layer(layer);
        image.attributes.display_window = display;
        let mut bytes = Cursor::new(Vec::new());
        image.write().non_parallel().to_buffered(&mut bytes).unwrap();
        bytes.into_inner()
    }

    fn read(bytes: &[u8]) -> FormatResult<(Vec<f32>, Vec<String>)> {
        let mut notes = Vec::new();
        match decode(bytes, &ReadOptions::default(), &mut notes)? {
            Contents::DepthMetres { depth_m, .. } => Ok((depth_m, notes)),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_channel_of_depth_is_found_and_placed_in_the_image() {
        let floats = |values: [f32; 4]| FlatSamples::F32(values.to_vec());
        let whole = IntegerBounds::new((1, 0), (2, 2));
        let z = ("View.Depth.Z", floats([1.0, 2.0, 3.0, 1e10]));
        let bytes = image(&[("R", floats([0.0; 4])), z.clone()], (2, 2), whole);
        let (depth_m, notes) = read(&bytes).unwrap();
        assert!(depth_m[..3] == [1.0, 2.0, 3.0] && depth_m[3].is_nan());
        assert!(notes[0].contains("View.Depth.Z") && notes[0].contains('R'), "{notes:?}");
        // An image of which only a window was rendered, and a single channel with an arbitrary name.
        let bytes = image(&[("Y", floats([1.0, 2.0, 3.0, 4.0]))], (2, 2), IntegerBounds::new((0, 0), (3, 2)));
        let (depth_m, notes) = read(&bytes).unwrap();
        assert_eq!((depth_m.len(), &depth_m[1..3], &depth_m[4..]), (6, &[1.0, 2.0][..], &[3.0, 4.0][..]));
        assert!(depth_m[0].is_nan() && notes.is_empty());
        // Normals also have a z.
        let normals = ["N.X", "N.Y", "N.Z"].map(|name| (name, floats([0.5; 4])));
        let with_z: Vec<_> = normals.iter().cloned().chain([("Z", floats([1.0, 2.0, 3.0, 4.0]))]).collect();
        assert_eq!(read(&image(&with_z, (2, 2), whole)).unwrap().0, [1.0, 2.0, 3.0, 4.0]);
        let of_normals = [normals[0].clone(), normals[1].clone(), ("N.Z", floats([0.1; 4]))];
        assert!(read(&image(&of_normals, (2, 2), whole)).unwrap_err().to_string().contains("N.Z"));
        let grey: Vec<_> = ["R", "G", "B"].map(|name| (name, floats([1.0, 2.0, 3.0, 4.0]))).into();
        assert_eq!(read(&image(&grey, (2, 2), whole)).unwrap().0, [1.0, 2.0, 3.0, 4.0]);
    }

    #[test]
    fn colours_and_damage_are_refused() {
        let colour: Vec<_> =
            [("R", 1.0), ("G", 2.0), ("B", 3.0)].map(|(name, value)| (name, FlatSamples::F32(vec![value; 4]))).into();
        let bytes = image(&colour, (2, 2), IntegerBounds::new((1, 0), (2, 2)));
        assert!(read(&bytes).unwrap_err().to_string().contains("B, G, R"));
        for at in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0xff;
            let _ = read(&damaged);
            assert!(read(&bytes[..at]).is_err(), "cut at {at}");
        }
    }
}
