//! Converts frames to words of the upload buffer (layout.rs).

use bytemuck::{bytes_of, cast_slice};

use super::layout::{BY_DISTANCE, FrameHeader, InputKind, Layout, ON_RAY};
use crate::camera::{Rays, RowRaysY};
use crate::frame::{DepthSamples, DepthView, Frame, PointsView};
use crate::params::{Edges, EngineParams};
use crate::range::RangeRules;
use crate::smoothing_engine::AdmittedFrame;

/// Writes frames, reusing its scratch buffers.
pub(super) struct Uploader {
    params: EngineParams,
    rays: Rays,
    raw: Vec<u16>,
    row: [Vec<f32>; 3],
}

impl Uploader {
    pub(super) fn new(params: EngineParams) -> Self {
        Self { params, rays: Rays::default(), raw: Vec::new(), row: Default::default() }
    }

    /// Writes a frame by calling `put` with word indices and bytes.
    pub(super) fn write(&mut self, layout: &Layout, admitted: &AdmittedFrame<'_>, put: &mut dyn FnMut(usize, &[u8])) {
        let camera = admitted.frame.camera();
        if let Some(camera) = camera.filter(|_| layout.kind != InputKind::Points) {
            // Depth from a distorted lens is uploaded as points.
            self.rays.set(camera);
            let at = layout.rays();
            put(at.start, cast_slice(&self.rays.x));
            put(at.start + layout.width, cast_slice(&self.rays.y));
        }
        put(0, bytes_of(&self.header(admitted)));
        let samples = layout.rays().end;
        match admitted.frame {
            Frame::Points(points) => self.write_points(layout, &points, samples, put),
            Frame::Depth(depth) if layout.kind == InputKind::Points => {
                self.rays.set(depth.camera());
                self.write_deprojected(layout, &depth, samples, put);
            }
            Frame::Depth(depth) => self.write_depth(layout, &depth, samples, put),
        }
    }

    /// Writes an unorganized cloud: its header, and its points starting at word `samples`.
    #[cfg(feature = "gpu")]
    pub(super) fn write_general(
        &mut self,
        layout: &Layout,
        admitted: &AdmittedFrame<'_>,
        samples: usize,
        put: &mut dyn FnMut(usize, &[u8]),
    ) {
        put(0, bytes_of(&self.header(admitted)));
        if let Frame::Points(points) = admitted.frame {
            self.write_points(layout, &points, samples, put);
        }
    }

    fn header(&self, admitted: &AdmittedFrame<'_>) -> FrameHeader {
        let rules = RangeRules::new(&self.params, &admitted.geometry);
        let on_ray = admitted.geometry.is_on_rays(self.params.project);
        let mut header = FrameHeader {
            radius_linear: rules.linear,
            radius: rules.radius,
            block_linear: rules.block_linear,
            block: rules.block,
            sigma: if self.params.edges == Edges::Off { [0.0; 3] } else { rules.sigma },
            bandwidth: self.params.bandwidth_m.unwrap_or(0.0),
            ridge: self.params.ridge,
            flags: if rules.by_distance { BY_DISTANCE } else { 0 } | if on_ray { ON_RAY } else { 0 },
            ..FrameHeader::default()
        };
        if let Some(camera) = admitted.frame.camera() {
            header.metres_per_unit = camera.metres_per_unit();
            header.units_per_metre = camera.depth_units_per_metre as f32;
        }
        header.position = admitted.geometry.sensor_position().as_vec3().to_array();
        header.axis = admitted.geometry.sensor_axis().as_vec3().to_array();
        header
    }

    fn write_points(
        &mut self,
        layout: &Layout,
        points: &PointsView<'_>,
        samples: usize,
        put: &mut dyn FnMut(usize, &[u8]),
    ) {
        if let Some(planes) = points.plain_planes() {
            for (channel, values) in planes.into_iter().enumerate() {
                put(samples + channel * layout.pixels(), cast_slice(values));
            }
            return;
        }
        for v in 0..layout.height {
            let [x, y, z] = self.row_of(layout.width);
            points.copy_to(v * layout.width..(v + 1) * layout.width, x, y, z);
            self.put_row(layout, v, samples, put);
        }
    }

    /// Writes depth from a distorted lens as points.
    fn write_deprojected(
        &mut self,
        layout: &Layout,
        depth: &DepthView<'_>,
        samples: usize,
        put: &mut dyn FnMut(usize, &[u8]),
    ) {
        for v in 0..layout.height {
            self.row_of(layout.width);
            let [x, y, z] = &mut self.row;
            let rays = self.rays.row(v);
            let rays_y = if let RowRaysY::Each(rays_y) = rays.y { rays_y } else { &[] };
            for (u, (ray_x, ray_y)) in rays.x.iter().zip(rays_y).enumerate() {
                z[u] = depth.depth_m(u, v);
                (x[u], y[u]) = (ray_x * z[u], ray_y * z[u]);
            }
            self.put_row(layout, v, samples, put);
        }
    }

    fn write_depth(
        &mut self,
        layout: &Layout,
        depth: &DepthView<'_>,
        samples: usize,
        put: &mut dyn FnMut(usize, &[u8]),
    ) {
        match depth.contiguous() {
            Some(DepthSamples::F32(metres)) => put(samples, cast_slice(metres)),
            Some(DepthSamples::U16(raw)) => put_raw(raw, samples, put),
            None => {
                self.raw.clear();
                for v in 0..layout.height {
                    match depth.row(v) {
                        DepthSamples::F32(metres) => put(samples + v * layout.width, cast_slice(metres)),
                        DepthSamples::U16(raw) => self.raw.extend_from_slice(raw),
                    }
                }
                put_raw(&self.raw, samples, put);
            }
        }
    }

    fn row_of(&mut self, width: usize) -> [&mut [f32]; 3] {
        self.row.each_mut().map(|values| {
            values.resize(width, 0.0);
            &mut values[..]
        })
    }

    fn put_row(&self, layout: &Layout, v: usize, samples: usize, put: &mut dyn FnMut(usize, &[u8])) {
        for (channel, values) in self.row.iter().enumerate() {
            put(samples + channel * layout.pixels() + v * layout.width, cast_slice(values));
        }
    }
}

/// Writes two raw values per word.
fn put_raw(raw: &[u16], samples: usize, put: &mut dyn FnMut(usize, &[u8])) {
    let (pairs, rest) = raw.split_at(raw.len() / 2 * 2);
    put(samples, cast_slice(pairs));
    if let [last] = rest {
        put(samples + pairs.len() / 2, bytes_of(&[*last, 0]));
    }
}
