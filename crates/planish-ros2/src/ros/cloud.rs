//! Clouds: smoothing replaces the positions of a `PointCloud2` and keeps everything else unchanged.

use super::{Header, PointCloud2, PointField};
use planish_core::{FormatError, PointLayout, PointsView, Scalar, Smoothed, Status, Xyz};
use planish_io::internal::quoted;

/// Type number of uint8 fields.
pub(super) const U8: u8 = 2;
/// Type number of float32 fields.
pub(super) const F32: u8 = 7;
/// Type number of float64 fields.
pub(super) const F64: u8 = 8;

/// Magnitude in metres above which f64 coordinates are smoothed relative to a point of the cloud.
const FAR_M: f64 = 1000.0;

/// Maximum point size in bytes that is accepted although the data are shorter: the last point may lack its padding.
const MOST_PADDING: u64 = 4096;

/// Name of the field with the number of frames averaged per point.
const FRAMES: &str = "frames";
/// Name of the field with the status codes.
const STATUS: &str = "status";
/// Name of the field with the standard errors.
const SIGMA: &str = "sigma";

const NORMALS: [&str; 3] = ["normal_x", "normal_y", "normal_z"];

/// Returns the size in bytes of a value with this type number; `None` for an invalid type number.
pub(super) fn scalar_bytes(datatype: u8) -> Option<usize> {
    match datatype {
        1 | 2 => Some(1),
        3 | 4 => Some(2),
        5..=7 => Some(4),
        8 => Some(8),
        _ => None,
    }
}

impl PointCloud2 {
    /// Returns a view of the points in the message.
    ///
    /// # Errors
    /// If x, y and z are not all float32 or all float64, the fields reach beyond a point, the data are too short, or
    /// the byte order is not this machine's ([`into_native`](Self::into_native) converts it).
    pub fn view(&self) -> Result<PointsView<'_>, FormatError> {
        let layout = self.layout()?;
        if self.is_bigendian != cfg!(target_endian = "big") {
            return Err(FormatError::Unsupported("the cloud's byte order differs from this machine's".into()));
        }
        let view = PointsView::from_bytes(&self.data, layout, (self.width as usize, self.height as usize))?;
        Ok(match self.origin_m() {
            [0.0, 0.0, 0.0] => view,
            origin_m => view.with_origin(origin_m)?,
        })
    }

    /// Returns true if the points are on a grid.
    pub fn is_organized(&self) -> bool {
        self.height > 1
    }

    /// Checks the sizes of fields, points and rows; returns the layout of x, y and z.
    fn layout(&self) -> Result<PointLayout, FormatError> {
        for field in &self.fields {
            let bytes = scalar_bytes(field.datatype).ok_or_else(|| {
                FormatError::Malformed(format!(
                    "field {} has the unknown type {}; expected 1 to 8",
                    quoted(&field.name),
                    field.datatype
                ))
            })?;
            let end = u64::from(field.offset) + bytes as u64 * u64::from(field.count.max(1));
            if end > u64::from(self.point_step) {
                return Err(FormatError::Malformed(format!(
                    "field {} ends at byte {end}, but a point has {} bytes",
                    quoted(&field.name),
                    self.point_step
                )));
            }
        }
        let (step, row) = (u64::from(self.point_step), u64::from(self.point_step) * u64::from(self.width));
        let is_short = self.height > 1 && row > u64::from(self.row_step);
        // Only the padding after the last point may be missing.
        if is_short || step > (self.data.len() as u64).max(MOST_PADDING) {
            return Err(FormatError::Malformed(format!(
                "sizes contradict each other: points of {step} bytes, {} points in a row of {} bytes, and {} bytes of \
                 data",
                self.width,
                self.row_step,
                self.data.len()
            )));
        }
        let [Some(x), Some(y), Some(z)] = ["x", "y", "z"].map(|name| self.field(name)) else {
            let names: Vec<_> = self.fields.iter().map(|field| field.name.as_str()).collect();
            return Err(FormatError::Malformed(format!(
                "the cloud has no x, y and z; its fields are {}",
                quoted(&names.join(" "))
            )));
        };
        let scalar = match [x, y, z].map(|field| field.datatype) {
            [F32, F32, F32] => Scalar::F32,
            [F64, F64, F64] => Scalar::F64,
            _ => return Err(FormatError::Unsupported("x, y and z must be all float32 or all float64".into())),
        };
        Ok(PointLayout {
            scalar,
            offsets: [x, y, z].map(|field| field.offset as usize),
            point_stride: self.point_step as usize,
            row_stride: self.row_step as usize,
        })
    }

    fn field(&self, name: &str) -> Option<&PointField> {
        self.fields.iter().find(|field| field.name == name)
    }

    /// Returns the origin of the smoothed positions. Each coordinate is 0 or, if the first finite point has an f64
    /// coordinate larger than [`FAR_M`] in magnitude, that coordinate, truncated to whole metres.
    fn origin_m(&self) -> [f64; 3] {
        let Ok(PointLayout { scalar: Scalar::F64, offsets, .. }) = self.layout() else { return [0.0; 3] };
        let mut points = self.point_offsets();
        let first = points.find_map(|at| {
            let point = offsets.map(|offset| read(&self.data, at + offset).map_or(f64::NAN, f64::from_ne_bytes));
            point.iter().all(|value| value.is_finite()).then_some(point)
        });
        first.unwrap_or_default().map(|value| if value.abs() > FAR_M { value.trunc() } else { 0.0 })
    }

    /// Returns the offsets of the points in the data, in bytes.
    pub(super) fn point_offsets(&self) -> impl Iterator<Item = usize> + use<> {
        let (width, step, row_step) = (self.width as usize, self.point_step as usize, self.row_step as usize);
        // The row step of a single row is meaningless.
        let row_step = if self.height > 1 { row_step } else { 0 };
        (0..self.height as usize).flat_map(move |v| (0..width).map(move |u| v * row_step + u * step))
    }

    /// Converts values to this machine's byte order.
    pub fn into_native(mut self) -> Result<Self, FormatError> {
        if self.is_bigendian == cfg!(target_endian = "big") {
            return Ok(self);
        }
        // Check that each field is within its point, and each point within the data.
        self.is_bigendian = cfg!(target_endian = "big");
        self.view()?;
        // Fields may share their bytes, as rgb and rgba do, so each value is swapped once, even if thousands of fields
        // claim the same bytes.
        let mut bytes_at = vec![0u8; self.point_step as usize];
        for field in &self.fields {
            let bytes = scalar_bytes(field.datatype).unwrap_or(1);
            let values = (0..field.count.max(1) as usize).map(|k| field.offset as usize + k * bytes);
            for offset in values.filter(|_| bytes > 1) {
                if let Some(known) = bytes_at.get_mut(offset) {
                    *known = (*known).max(bytes as u8);
                }
            }
        }
        let swapped = bytes_at.iter().enumerate().filter(|(_, bytes)| **bytes > 1);
        let swapped: Vec<(usize, usize)> = swapped.map(|(offset, bytes)| (offset, usize::from(*bytes))).collect();
        for at in self.point_offsets() {
            for &(offset, bytes) in &swapped {
                if let Some(value) = self.data.get_mut(at + offset..at + offset + bytes) {
                    value.reverse();
                }
            }
        }
        Ok(self)
    }

    /// Returns the cloud with its smoothed positions; holes are NaN. Normals, curvature, frames, statuses and
    /// standard errors of the result replace the fields with their names, or are appended. Existing fields `frames`,
    /// `status` and `sigma` of another type are kept. All other bytes are unchanged.
    ///
    /// # Errors
    /// If the result belongs to another cloud, or a field for normals or curvature exists with another type.
    pub fn with_smoothed(&self, smoothed: &Smoothed) -> Result<Self, FormatError> {
        // The view checks the layout; it fails for the other byte order.
        let points = self.view()?.len();
        smoothed.points.check_len("the smoothed points", points)?;
        let origin_m = self.origin_m();
        let mut cloud = self.clone();
        let PointLayout { scalar, offsets, .. } = cloud.layout()?;
        for (at, i) in cloud.point_offsets().zip(0..) {
            for (axis, values) in smoothed.points.as_slices().into_iter().enumerate() {
                match scalar {
                    Scalar::F64 => write(
                        &mut cloud.data,
                        at + offsets[axis],
                        (origin_m[axis] + f64::from(values[i])).to_ne_bytes(),
                    ),
                    Scalar::F32 => write(&mut cloud.data, at + offsets[axis], values[i].to_ne_bytes()),
                }
            }
        }
        let normals = smoothed.normals.as_ref().map(Xyz::as_slices);
        let normals = normals.into_iter().flat_map(|axes| NORMALS.into_iter().zip(axes));
        let columns: Vec<(&str, &[f32])> =
            normals.chain(smoothed.curvature.as_deref().map(|values| ("curvature", values))).collect();
        for (name, values) in columns {
            cloud.set_field(name, values)?;
        }
        // Fields with these names that belong to other programs are kept.
        if let Some(frames) = smoothed.frames.as_deref().filter(|_| cloud.may_set(FRAMES, F32)) {
            cloud.set_field(FRAMES, frames)?;
        }
        if let Some(status) = smoothed.status.as_deref().filter(|_| cloud.may_set(STATUS, U8)) {
            cloud.set_codes(STATUS, status)?;
        }
        if let Some(sigma) = smoothed.sigma.as_deref().filter(|_| cloud.may_set(SIGMA, F32)) {
            cloud.set_field(SIGMA, sigma)?;
        }
        cloud.is_dense = (0..points).all(|i| smoothed.points.is_finite(i));
        Ok(cloud)
    }

    /// Writes a scalar field in its existing type; a missing field is appended as float32.
    fn set_field(&mut self, name: &str, values: &[f32]) -> Result<(), FormatError> {
        let (offset, datatype) = match self.field(name) {
            Some(field) if field.count <= 1 && matches!(field.datatype, F32 | F64) => (field.offset, field.datatype),
            Some(_) => {
                let text = format!("field {name} exists with a different type and would be duplicated");
                return Err(FormatError::Unsupported(text));
            }
            None => {
                let offset = self.point_step.next_multiple_of(4);
                self.widen(offset + 4)?;
                self.fields.push(PointField { name: name.to_owned(), offset, datatype: F32, count: 1 });
                (offset, F32)
            }
        };
        for (at, value) in self.point_offsets().zip(values) {
            let at = at + offset as usize;
            match datatype {
                F64 => write(&mut self.data, at, f64::from(*value).to_ne_bytes()),
                _ => write(&mut self.data, at, value.to_ne_bytes()),
            }
        }
        Ok(())
    }

    /// Returns true if a field is missing, or is a scalar of this type.
    fn may_set(&self, name: &str, datatype: u8) -> bool {
        self.field(name).is_none_or(|field| field.count <= 1 && field.datatype == datatype)
    }

    /// Writes status codes; a missing field is appended as uint8.
    fn set_codes(&mut self, name: &str, status: &[Status]) -> Result<(), FormatError> {
        let offset = match self.field(name) {
            Some(field) => field.offset,
            None => {
                let offset = self.point_step;
                // Keep the points aligned to 4 bytes.
                self.widen((offset + 1).next_multiple_of(4))?;
                self.fields.push(PointField { name: name.to_owned(), offset, datatype: U8, count: 1 });
                offset
            }
        };
        for (at, &status) in self.point_offsets().zip(status) {
            write(&mut self.data, at + offset as usize, [status as u8]);
        }
        Ok(())
    }

    /// Increases the size of a point, and removes padding at the end of rows.
    fn widen(&mut self, point_step: u32) -> Result<(), FormatError> {
        let Some(row_step) = self.width.checked_mul(point_step) else {
            let text = format!("{} points of {point_step} bytes do not fit into a row", self.width);
            return Err(FormatError::Unsupported(text));
        };
        let old = self.point_step as usize;
        let mut data = Vec::with_capacity(row_step as usize * self.height as usize);
        for at in self.point_offsets() {
            // The last point may lack its padding.
            let end = (at + old).min(self.data.len());
            let next = data.len() + point_step as usize;
            data.extend_from_slice(self.data.get(at..end).unwrap_or_default());
            data.resize(next, 0);
        }
        (self.data, self.point_step, self.row_step) = (data, point_step, row_step);
        Ok(())
    }

    /// Creates the cloud of a smoothed frame with float32 fields, laid out as in the structs of PCL: x, y, z in 16
    /// bytes per point, or in 32 bytes with normals and curvature. Frames (float32) and statuses (uint8) take 8 more
    /// bytes, standard errors (float32) another 4.
    pub fn of_smoothed(header: Header, smoothed: &Smoothed) -> Self {
        let with_normals = smoothed.normals.is_some() || smoothed.curvature.is_some();
        let of_pcl: u32 = if with_normals { 32 } else { 16 };
        let is_of_video = smoothed.frames.is_some() || smoothed.status.is_some();
        let before_sigma = if is_of_video { of_pcl + 8 } else { of_pcl };
        let point_step = if smoothed.sigma.is_some() { before_sigma + 4 } else { before_sigma };
        let names = ["x", "y", "z"].into_iter().zip([0, 4, 8]);
        let more = NORMALS.into_iter().chain(["curvature"]).zip([16, 20, 24, 28]).filter(|_| with_normals);
        let more = more.chain(smoothed.frames.as_ref().map(|_| (FRAMES, of_pcl)));
        let more = more.chain(smoothed.sigma.as_ref().map(|_| (SIGMA, before_sigma)));
        let field = |(name, offset): (&str, u32)| PointField { name: name.into(), offset, datatype: F32, count: 1 };
        let code = |name: &str, offset| PointField { name: name.into(), offset, datatype: U8, count: 1 };
        let codes = smoothed.status.as_ref().map(|_| code(STATUS, of_pcl + 4));
        let (width, height) = (smoothed.width as u32, smoothed.height as u32);
        let mut data = Vec::with_capacity(smoothed.points.len() * point_step as usize);
        let nan = Xyz::default();
        let normals = smoothed.normals.as_ref().unwrap_or(&nan);
        let curvature = smoothed.curvature.as_deref().unwrap_or_default();
        for (i, [x, y, z]) in smoothed.points.iter().enumerate() {
            let row: [f32; 4] = [x, y, z, 1.0];
            data.extend_from_slice(bytemuck::cast_slice(&row));
            if with_normals {
                let of = |values: &[f32]| values.get(i).copied().unwrap_or(f32::NAN);
                let row: [f32; 4] = [of(normals.x()), of(normals.y()), of(normals.z()), of(curvature)];
                data.extend_from_slice(bytemuck::cast_slice(&row));
            }
            if is_of_video {
                let frames = smoothed.frames.as_ref().map_or(0.0, |frames| frames[i]);
                let status = smoothed.status.as_ref().map_or(0, |status| status[i] as u8);
                data.extend_from_slice(&frames.to_ne_bytes());
                data.extend_from_slice(&[status, 0, 0, 0]);
            }
            if let Some(sigma) = &smoothed.sigma {
                data.extend_from_slice(&sigma[i].to_ne_bytes());
            }
        }
        Self {
            header,
            height,
            width,
            fields: names.chain(more).map(field).chain(codes).collect(),
            is_bigendian: cfg!(target_endian = "big"),
            point_step,
            row_step: width * point_step,
            data,
            is_dense: (0..smoothed.points.len()).all(|i| smoothed.points.is_finite(i)),
        }
    }
}

pub(super) fn read<const N: usize>(data: &[u8], at: usize) -> Option<[u8; N]> {
    data.get(at..)?.first_chunk::<N>().copied()
}

fn write<const N: usize>(data: &mut [u8], at: usize, bytes: [u8; N]) {
    if let Some(to) = data.get_mut(at..at + N) {
        to.copy_from_slice(&bytes);
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    fn field(name: &str, offset: u32, datatype: u8) -> PointField {
        PointField { name: name.into(), offset, datatype, count: 1 }
    }

    /// Returns 3x2 points of 24 bytes: rgb, x, y, z and a ring, with two bytes of padding at the end of each row.
    pub fn cloud() -> PointCloud2 {
        let fields = vec![
            field("rgb", 0, F32),
            field("x", 4, F32),
            field("y", 8, F32),
            field("z", 12, F32),
            field("ring", 18, 4),
        ];
        let mut data = Vec::new();
        for i in 0..6u16 {
            data.extend(f32::from_bits(0x0010_2030 + u32::from(i)).to_ne_bytes());
            for value in [f32::from(i), 10.0 + f32::from(i), 20.0 + f32::from(i)] {
                data.extend(value.to_ne_bytes());
            }
            data.extend([7, 7]);
            data.extend(i.to_ne_bytes());
            data.extend([8; 4]);
            data.extend([9; 2].iter().filter(|_| i % 3 == 2));
        }
        let header = Header { frame_id: "lens".into(), ..Header::default() };
        let (point_step, row_step) = (24, 74);
        PointCloud2 {
            header,
            height: 2,
            width: 3,
            fields,
            is_bigendian: false,
            point_step,
            row_step,
            data,
            is_dense: true,
        }
    }

    fn smoothed(hole: usize) -> Smoothed {
        let mut points: Xyz = (0..6).map(|i| [0.5 + i as f32, -1.0, 3.0]).collect();
        points.set(hole, [f32::NAN; 3]);
        Smoothed { width: 3, height: 2, points, ..Smoothed::default() }
    }

    #[test]
    fn smoothing_changes_positions_and_no_other_byte() {
        let before = cloud();
        let after = before.with_smoothed(&smoothed(4)).unwrap();
        assert!(!after.is_dense);
        for (i, at) in before.point_offsets().enumerate() {
            assert_eq!(after.data[at..at + 4], before.data[at..at + 4]);
            assert_eq!(after.data[at + 16..at + 24], before.data[at + 16..at + 24]);
            let x = f32::from_ne_bytes(read(&after.data, at + 4).unwrap());
            assert!(if i == 4 { x.is_nan() } else { x == 0.5 + i as f32 });
        }
        assert_eq!((after.data.len(), after.data[72], &after.fields), (before.data.len(), 9, &before.fields));
        let other = Smoothed { points: Xyz::filled(5, 0.0), ..smoothed(4) };
        assert!(before.with_smoothed(&other).is_err());
    }

    #[test]
    fn normals_are_added_once_and_then_replaced() {
        let with_normals = Smoothed { normals: Some(Xyz::filled(6, 0.5)), ..smoothed(0) };
        let once = cloud().with_smoothed(&with_normals).unwrap();
        assert_eq!((once.point_step, once.row_step, once.data.len()), (36, 108, 216));
        let organized = once.to_organized().unwrap();
        assert_eq!(organized.points.attribute("normal_y").unwrap().values, vec![0.5f32; 6].into());
        assert_eq!(organized.points.attribute("ring").unwrap().values, (0..6).collect::<Vec<u16>>().into());
        let twice = once.with_smoothed(&Smoothed { normals: Some(Xyz::filled(6, 0.25)), ..smoothed(0) }).unwrap();
        assert_eq!((twice.point_step, &twice.fields), (36, &once.fields));
        assert_eq!(twice.to_cloud().unwrap().attribute("normal_x").unwrap().values, vec![0.25f32; 6].into());
    }

    #[test]
    fn frames_and_statuses_of_a_video_are_added_unless_others_have_their_names() {
        let (frames, status) = (vec![1.0, 2.0, 16.0, 1.0, 0.0, 5.5], vec![Status::Carried; 6]);
        let of_video = Smoothed { frames: Some(frames.clone()), status: Some(status), ..smoothed(4) };
        let codes = vec![Status::Carried as u8; 6];
        for cloud in [cloud().with_smoothed(&of_video).unwrap(), PointCloud2::of_smoothed(cloud().header, &of_video)] {
            assert_eq!(cloud.data.len(), 6 * cloud.point_step as usize);
            let twice = cloud.with_smoothed(&of_video).unwrap();
            assert_eq!((twice.point_step, &twice.fields), (cloud.point_step, &cloud.fields));
            let back = twice.to_cloud().unwrap();
            assert_eq!(back.attribute("frames").unwrap().values, frames.clone().into());
            assert_eq!(back.attribute("status").unwrap().values, codes.clone().into());
            assert_eq!(back.positions.get(5), [5.5, -1.0, 3.0]);
        }
        // Here, "ring" stands for another program's status.
        let mut other = cloud();
        other.fields[4].name = "status".into();
        let kept = other.with_smoothed(&of_video).unwrap().to_cloud().unwrap();
        assert_eq!(kept.attribute("status").unwrap().values, (0..6).collect::<Vec<u16>>().into());
    }

    #[test]
    fn a_last_point_without_its_padding_is_kept() {
        let mut cloud = cloud();
        // The last row ends with the last field of its last point.
        cloud.data.truncate(74 + 3 * 24 - 4);
        let with_normals = Smoothed { normals: Some(Xyz::filled(6, 0.5)), ..smoothed(0) };
        let wider = cloud.with_smoothed(&with_normals).unwrap();
        assert_eq!(wider.data.len(), 6 * 36);
        let back = wider.to_cloud().unwrap();
        assert_eq!(back.positions.get(5), [5.5, -1.0, 3.0]);
        assert_eq!(back.attribute("ring").unwrap().values, (0..6).collect::<Vec<u16>>().into());
    }

    #[test]
    fn a_cloud_of_the_other_byte_order_becomes_native() {
        let native = cloud();
        let mut other = native.clone();
        for at in native.point_offsets() {
            for field in &native.fields {
                let bytes = scalar_bytes(field.datatype).unwrap();
                other.data[at + field.offset as usize..][..bytes].reverse();
            }
        }
        other.is_bigendian = true;
        assert!(other.view().is_err());
        assert_eq!(other.into_native().unwrap(), native);
    }

    #[test]
    fn far_coordinates_in_f64_keep_their_digits() {
        let fields = vec![field("x", 0, F64), field("y", 8, F64), field("z", 16, F64)];
        let points = [[400_000.25, 5_000_000.5, 12.0], [400_001.0, 5_000_001.0, 13.0]];
        let data = points.as_flattened().iter().flat_map(|value: &f64| value.to_ne_bytes()).collect();
        let cloud =
            PointCloud2 { height: 1, width: 2, fields, point_step: 24, row_step: 48, data, ..PointCloud2::default() };
        // Relative to (400000, 5000000, 0).
        let points = Xyz::from(vec![[0.125, 0.5, 12.0], [1.0, 1.0, 13.0]]);
        let after = cloud.with_smoothed(&Smoothed { width: 2, height: 1, points, ..Smoothed::default() }).unwrap();
        assert_eq!(f64::from_ne_bytes(read(&after.data, 0).unwrap()), 400_000.125);
        assert_eq!(after.data[8..], cloud.data[8..]);
    }

    #[test]
    fn what_a_cloud_says_wrongly_is_refused() {
        let refused = |cloud: PointCloud2| cloud.view().unwrap_err().to_string();
        let with = |change: &dyn Fn(&mut PointCloud2)| {
            let mut cloud = cloud();
            change(&mut cloud);
            refused(cloud)
        };
        assert!(with(&|cloud| cloud.fields[1].name = "X".into()).contains("no x, y and z"));
        assert!(with(&|cloud| cloud.fields[1].offset = 21).contains("ends at byte 25"));
        assert!(with(&|cloud| cloud.fields[4].datatype = 9).contains("type 9"));
        assert!(with(&|cloud| cloud.fields[1].datatype = 6).contains("float32"));
        assert!(with(&|cloud| cloud.data.truncate(137)).contains("137"));
        assert!(with(&|cloud| cloud.row_step = 71).contains("71 bytes"));
        assert!(with(&|cloud| (cloud.width, cloud.height, cloud.point_step) = (1, 1, u32::MAX)).contains("4294967295"));
        assert!(with(&|cloud| cloud.height = u32::MAX).contains("pixels"));
    }
}
