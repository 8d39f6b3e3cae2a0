//! Converts files from one format to another, without smoothing.

use std::path::Path;

use planish_core::{
    Camera, DepthFrame, DepthImage, DepthView, Error, FormatError, IoError, OrganizedCloud, Outputs, PointCloud,
    PointsView, Precision, RangeRule, doubt_about_lens,
};

use super::{
    CloudRef, Contents, Encoding, FileRead, Format, adapt_fields, check_writable, losses, quoted, write_cloud,
    write_depth, write_depth_metres,
};

/// Maximum ratio between a camera's focal length and the focal length implied by a cloud's points, in either
/// direction.
const FOCAL_LENGTH_FACTOR: f64 = 1.25;

/// Default number of raw depth units per metre, if neither the options nor the camera state it.
const MILLIMETRES: f64 = 1000.0;

/// Options of [`convert`].
#[derive(Debug, Clone, Default)]
#[non_exhaustive]
pub struct ConvertOptions {
    /// The camera, required to convert depth images to points.
    pub camera: Option<Camera>,
    /// Raw units per metre of the written depth image [default: the camera's, or 1000].
    pub depth_units_per_metre: Option<f64>,
    /// True to drop holes; an organized cloud then loses its grid.
    pub drop_holes: bool,
    /// The fields to keep besides x, y and z; `None` for all.
    pub fields: Option<Vec<String>>,
    /// The encoding of PCD and PLY; `None` to keep the input's encoding.
    pub encoding: Option<Encoding>,
    /// The precision of coordinates; `None` to choose it by the output format ([`adapt_fields`]).
    pub precision: Option<Precision>,
}

impl ConvertOptions {
    /// Sets the camera.
    pub fn with_camera(self, camera: Option<Camera>) -> Self {
        Self { camera, ..self }
    }

    /// Sets the raw units per metre of the written depth image.
    pub fn with_depth_units_per_metre(self, depth_units_per_metre: Option<f64>) -> Self {
        Self { depth_units_per_metre, ..self }
    }

    /// Sets whether holes are dropped.
    pub fn with_drop_holes(self, drop_holes: bool) -> Self {
        Self { drop_holes, ..self }
    }

    /// Sets the fields to keep.
    pub fn with_fields(self, fields: Option<Vec<String>>) -> Self {
        Self { fields, ..self }
    }

    /// Sets the encoding.
    pub fn with_encoding(self, encoding: Option<Encoding>) -> Self {
        Self { encoding, ..self }
    }

    /// Sets the precision of coordinates.
    pub fn with_precision(self, precision: Option<Precision>) -> Self {
        Self { precision, ..self }
    }
}

/// Report on a converted file.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct ConvertReport {
    /// The format that was read.
    pub from: Format,
    /// The format that was written.
    pub to: Format,
    /// Width and height of the output; without a grid, the number of points and 1.
    pub shape: (usize, usize),
    /// Number of pixels or points that are not holes.
    pub valid: usize,
    /// Notes for users on dropped, changed and guessed data, one clause each.
    pub notes: Vec<String>,
}

/// Converts the contents of a file, and writes them in the format given by the extension of `output`.
///
/// Depth images stay depth images if the output format supports them, and become organized clouds otherwise. An
/// organized cloud can be written as a depth image if it is in its sensor's frame.
///
/// # Errors
/// If the camera is missing or does not fit, the format cannot represent the contents, or the file cannot be written.
pub fn convert(file: FileRead, output: &Path, options: &ConvertOptions) -> Result<ConvertReport, Error> {
    let at_output = |problem: FormatError| Error::from(IoError::at(output)(problem));
    let FileRead { format: from, encoding, contents, mut notes, .. } = file;
    let to = Format::of_output(output).map_err(at_output)?;
    let is_image = matches!(to, Format::DepthPng | Format::DepthTiff);
    let stays_depth = is_image || (to == Format::Npy && contents.is_depth());
    if let Some(camera) = options.camera.filter(|_| contents.is_depth() && !stays_depth) {
        let (width, height) = contents.shape();
        notes.extend(doubt_about_lens(&camera.with_shape((width, height))).map(|doubt| doubt.to_string()));
    }
    let shape @ (width, height) = contents.shape();
    if stays_depth {
        if options.drop_holes || options.fields.is_some() {
            let reason = "dropping holes and choosing fields apply only to point clouds, not to depth images";
            return Err(at_output(FormatError::Unsupported(reason.into())));
        }
        let valid = match contents {
            Contents::Depth(image) => {
                write_depth(output, &image)?;
                image.raw.iter().filter(|&&raw| raw != 0 && raw != planish_core::SATURATED_DEPTH).count()
            }
            Contents::DepthMetres { depth_m, .. } if to == Format::Npy => {
                write_depth_metres(output, width, &depth_m)?;
                depth_m.iter().filter(|depth_m| depth_m.is_finite() && **depth_m > 0.0).count()
            }
            Contents::DepthMetres { depth_m, .. } => write_raw(output, shape, &depth_m, options, &mut notes)?,
            contents => {
                let cloud = contents.into_organized(options.camera.as_ref()).map_err(at_output)?;
                let view = PointsView::from_organized(&cloud)?;
                if !view.seen_from().is_some_and(|(_, is_depth)| is_depth) {
                    let reason = "z is not depth, since the points are not in the camera's frame; write a point cloud";
                    return Err(at_output(FormatError::Unsupported(reason.into())));
                }
                let z = |i: usize| cloud.points.coordinate(2, i) as f32;
                let depth_m: Vec<f32> = (0..cloud.points.len()).map(z).collect();
                write_raw(output, shape, &depth_m, options, &mut notes)?
            }
        };
        return Ok(ConvertReport { from, to, shape, valid, notes });
    }
    let (mut points, grid) = match contents {
        Contents::General(cloud) => (cloud, None),
        contents => {
            let cloud = contents.into_organized(options.camera.as_ref()).map_err(at_output)?;
            (cloud.points, Some((width, height)))
        }
    };
    let grid = grid.filter(|_| !options.drop_holes);
    if options.drop_holes {
        let kept: Vec<usize> = (0..points.len()).filter(|&i| points.positions.is_finite(i)).collect();
        if kept.len() < points.len() {
            notes.push(format!("{} holes are dropped", points.len() - kept.len()));
            points = points.select(&kept);
        }
    }
    if let Some(fields) = &options.fields {
        keep_fields(&mut points, fields).map_err(at_output)?;
    }
    notes.extend(adapt_fields(&mut points, from, to, options.precision));
    notes.extend(losses(&points, to));
    if grid.is_some() && !matches!(to, Format::Pcd | Format::Ply | Format::Npy | Format::Npz) {
        notes.push(format!("the grid is lost, since {} cannot store it", to.name()));
    }
    let encoding = options.encoding.or(encoding).unwrap_or_default();
    let valid = points.valid_points();
    let written = match grid {
        Some((width, height)) => {
            let cloud = OrganizedCloud::new(width, height, points)?;
            check_writable(output, &cloud, Outputs::POINTS)?;
            write_cloud(output, CloudRef::Organized(&cloud), encoding)?;
            (width, height)
        }
        None => {
            check_writable(output, &points, Outputs::POINTS)?;
            write_cloud(output, CloudRef::General(&points), encoding)?;
            (points.len(), 1)
        }
    };
    Ok(ConvertReport { from, to, shape: written, valid, notes })
}

/// Adapts a merged cloud to the format given by the extension of `output`, and writes it. Returns notes for users on
/// changed and dropped data, one clause each.
///
/// # Errors
/// If the format cannot represent the cloud, or the file cannot be written.
pub fn write_merged(
    output: &Path,
    merged: &mut PointCloud,
    encoding: Encoding,
    precision: Option<Precision>,
) -> Result<Vec<String>, IoError> {
    let to = Format::of_output(output).map_err(IoError::at(output))?;
    // Merged colours have separate channels, as in PLY.
    let mut notes = adapt_fields(merged, Format::Ply, to, precision);
    notes.extend(losses(merged, to));
    write_cloud(output, CloudRef::General(merged), encoding)?;
    Ok(notes)
}

/// Writes depth in metres as an image of integers; returns the number of pixels with depth.
fn write_raw(
    output: &Path,
    (width, height): (usize, usize),
    depth_m: &[f32],
    options: &ConvertOptions,
    notes: &mut Vec<String>,
) -> Result<usize, Error> {
    let of_camera = options.camera.map(|camera| camera.depth_units_per_metre);
    let units = options.depth_units_per_metre.or(of_camera).unwrap_or(MILLIMETRES);
    let camera = Camera::new((width, height), [1.0; 2], [0.0; 2]).with_depth_units_per_metre(units);
    let raw: Vec<u16> = depth_m.iter().map(|&depth_m| camera.raw_depth(depth_m)).collect();
    let valid = raw.iter().filter(|&&raw| raw > 0).count();
    let measured = depth_m.iter().filter(|depth_m| depth_m.is_finite() && **depth_m != 0.0).count();
    let lost = measured - valid;
    if lost > 0 {
        notes.push(format!("{lost} pixels became holes: their depth is not within 1 to 65534 units of 1/{units} m"));
    }
    if valid == 0 && measured > 0 {
        let reason = format!("no depth is within 1 to 65534 units of 1/{units} m; nothing is written");
        return Err(IoError::at(output)(FormatError::Unsupported(reason)).into());
    }
    write_depth(output, &DepthImage { width, height, raw })?;
    Ok(valid)
}

/// Keeps only the named fields. Returns an error for an unknown name.
fn keep_fields(cloud: &mut PointCloud, fields: &[String]) -> Result<(), FormatError> {
    if let Some(unknown) = fields.iter().find(|name| cloud.attribute(name).is_none()) {
        let names: Vec<&str> = cloud.attributes.iter().map(|field| field.name.as_str()).collect();
        let there = if names.is_empty() {
            "it has no fields".to_owned()
        } else {
            format!("its fields are {}", names.join(" "))
        };
        return Err(FormatError::Unsupported(format!("the input has no field {}; {there}", quoted(unknown))));
    }
    cloud.attributes.retain(|field| fields.contains(&field.name));
    Ok(())
}

impl Contents {
    /// Converts a depth image to points if its camera is given, and sets the camera of an organized cloud. Other
    /// contents are unchanged.
    ///
    /// # Errors
    /// If the camera contradicts the contents.
    pub fn with_points(self, camera: Option<&Camera>) -> Result<Self, FormatError> {
        match camera {
            Some(_) if !matches!(self, Self::General(_)) => Ok(Self::Organized(self.into_organized(camera)?)),
            _ => Ok(self),
        }
    }

    /// Returns the points as an organized cloud. A depth image requires a camera; in a cloud, the given camera replaces
    /// its own.
    ///
    /// # Errors
    /// If a depth image has no camera, the camera contradicts the points, or there is no grid.
    pub fn into_organized(self, camera: Option<&Camera>) -> Result<OrganizedCloud, FormatError> {
        let unsupported = |reason: String| Err(FormatError::Unsupported(reason));
        let (width, height) = self.shape();
        match self {
            Self::Organized(mut cloud) => {
                if let Some(camera) = camera {
                    check_camera(&cloud, camera)?;
                    cloud.camera = Some(*camera);
                }
                Ok(cloud)
            }
            Self::General(cloud) => unsupported(format!(
                "the cloud of {} points is unorganized (height 1); expected an organized cloud or a depth image",
                cloud.len()
            )),
            depth => {
                let Some(camera) = camera else {
                    return unsupported(format!("a depth image of {width}x{height} needs its camera"));
                };
                Ok(match depth {
                    Self::Depth(image) => DepthFrame::from_image(*camera, image)?.deproject()?,
                    Self::DepthMetres { depth_m, .. } => DepthView::from_metres(&depth_m, camera)?.deproject()?,
                    _ => return unsupported("the contents are neither depth nor points".to_owned()),
                })
            }
        }
    }
}

/// Returns an error if the camera contradicts the points of the cloud.
fn check_camera(cloud: &OrganizedCloud, camera: &Camera) -> Result<(), FormatError> {
    let contradicts = |reason: String| Err(FormatError::Unsupported(reason));
    match PointsView::from_organized(cloud)?.range_rule() {
        RangeRule::Depth { pitch_at_1m: Some(pitch) } => {
            let ratio = camera.fx * pitch;
            if (1.0 / FOCAL_LENGTH_FACTOR..=FOCAL_LENGTH_FACTOR).contains(&ratio) {
                return Ok(());
            }
            contradicts(format!(
                "the camera has fx = {}, but the points imply fx = {:.1}; give the camera of this cloud, or none",
                camera.fx,
                1.0 / pitch
            ))
        }
        RangeRule::Depth { .. } => Ok(()),
        _ => contradicts(
            "the points do not match the pixel grid of a camera at the origin; give the sensor's pose, or no camera"
                .to_owned(),
        ),
    }
}
