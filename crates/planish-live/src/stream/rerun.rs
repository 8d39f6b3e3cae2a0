//! A Rerun sink [feature `rerun`]: the raw and the smoothed cloud side by side, the depth image, latency and rate, in
//! the viewer or as a file for it.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, Horizontal, SelectionPanel, Spatial2DView, Spatial3DView,
    TimePanel, TimeSeriesView, Vertical, components::PanelState,
};
use rerun::{DepthImage, Points3D, RecordingStream, RecordingStreamBuilder, Scalars, SpawnOptions, ViewCoordinates};

use super::{Sink, StreamFrame};
use crate::source::OwnedFrame;
use planish_core::{DeviceError, Error, FormatError, FrameError, IoError, OrganizedCloud, Outputs, Xyz};
use planish_eval::render::{difference_normals, relief};

/// Number of results over which the rate is averaged.
const RATE_FRAMES: usize = 30;

/// Maximum time without accepting data after which a viewer counts as gone.
const SILENCE: Duration = Duration::from_secs(5);

/// A sink that shows every result in Rerun. The stream's outputs must include points.
///
/// A 640x480 frame takes about 7 MB. Clouds without colours are shaded as relief.
pub struct RerunSink {
    recording: Recording,
    results: VecDeque<Instant>,
}

impl RerunSink {
    /// The outputs that a stream must compute for this sink.
    pub const OUTPUTS: Outputs = Outputs::POINTS;

    /// Starts the viewer, the program `rerun` (version 0.36), and shows results in it.
    pub fn spawn() -> Result<Self, Error> {
        Self::start(Recording::spawn()?)
    }

    /// Writes a file for Rerun's viewer, named `FILE.partial` until it is closed. If the process is killed before
    /// that, the viewer can open the part that was written.
    pub fn save(file: &Path) -> Result<Self, Error> {
        Self::start(Recording::save(file)?)
    }

    fn start(recording: Recording) -> Result<Self, Error> {
        for cloud in ["raw", "smoothed"] {
            recording.with(|recording| recording.log_static(cloud, &ViewCoordinates::RDF()))?;
        }
        recording.with(|recording| layout().send(recording, BlueprintActivation::default()))?;
        Ok(Self { recording, results: VecDeque::new() })
    }

    /// Returns the current rate in results per second.
    fn fps(&mut self, at: Instant) -> Option<f64> {
        self.results.push_back(at);
        if self.results.len() > RATE_FRAMES {
            self.results.pop_front();
        }
        let span = at.checked_duration_since(*self.results.front()?)?.as_secs_f64();
        (span > 0.0).then(|| (self.results.len() - 1) as f64 / span)
    }
}

/// A Rerun recording that is shown by a viewer or saved to a file.
pub(crate) struct Recording {
    pub(crate) name: String,
    /// `None` once closed.
    stream: Option<RecordingStream>,
    /// The path of the file, and its temporary path until it is complete.
    file: Option<(PathBuf, PathBuf)>,
}

impl Recording {
    pub(crate) fn spawn() -> Result<Self, Error> {
        let options = SpawnOptions { hide_welcome_screen: true, ..SpawnOptions::default() };
        let stream = RecordingStreamBuilder::new("planish").spawn_opts(&options);
        let stream = stream.map_err(|error| DeviceError::Driver {
            what: format!("Rerun's viewer does not start: {}", error.to_string().trim()),
            help: "install it (pip install rerun-sdk==0.36.3), or write a .rrd file",
        })?;
        Ok(Self { name: "Rerun".to_owned(), stream: Some(stream), file: None })
    }

    pub(crate) fn save(file: &Path) -> Result<Self, Error> {
        let mut partial = file.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        let stream = RecordingStreamBuilder::new("planish").save(&partial);
        let stream = stream.map_err(|error| IoError {
            path: file.to_path_buf(),
            problem: FormatError::Unsupported(error.to_string()),
        })?;
        let name = file.display().to_string();
        Ok(Self { name, stream: Some(stream), file: Some((file.to_path_buf(), partial)) })
    }

    /// Logs data, unless the recording is closed.
    pub(crate) fn with<E: std::fmt::Display>(
        &self,
        log: impl FnOnce(&RecordingStream) -> Result<(), E>,
    ) -> Result<(), DeviceError> {
        let failed = |error| DeviceError::Failed { what: format!("Rerun: {error}") };
        self.stream.as_ref().map_or(Ok(()), |stream| log(stream).map_err(failed))
    }

    /// Sets the time of the next entries.
    pub(crate) fn set_time(&self, frame: u64, seconds: Option<f64>) {
        let Some(stream) = &self.stream else { return };
        stream.set_time_sequence("frame", i64::try_from(frame).unwrap_or(i64::MAX));
        if let Some(seconds) = seconds {
            stream.set_duration_secs("camera time", seconds);
        }
    }

    /// Waits until the viewer has received everything, so that the stream drops and counts results for which the
    /// viewer is too slow.
    pub(crate) fn flush(&self) -> Result<(), DeviceError> {
        let gone = |error| DeviceError::Gone { what: format!("{} cannot store more frames: {error}", self.name) };
        self.stream.as_ref().map_or(Ok(()), |stream| stream.flush_with_timeout(SILENCE).map_err(gone))
    }

    pub(crate) fn close(&mut self) -> Result<(), Error> {
        let Some(stream) = self.stream.take() else { return Ok(()) };
        let flushed = stream.flush_with_timeout(SILENCE);
        // The end of the file is written once the last handle is dropped.
        stream.finalize_deferred_sinks();
        drop(stream);
        match &self.file {
            None => Ok(()),
            Some((file, partial)) => {
                let failed = |problem| IoError { path: file.clone(), problem };
                flushed.map_err(|error| failed(FormatError::Unsupported(error.to_string())))?;
                Ok(std::fs::rename(partial, file).map_err(|error| failed(error.into()))?)
            }
        }
    }
}

impl Sink for RerunSink {
    fn name(&self) -> String {
        self.recording.name.clone()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        let fps = self.fps(frame.received);
        let cloud = match &frame.source {
            OwnedFrame::Depth(depth) => &depth.deproject()?,
            OwnedFrame::Cloud { cloud, .. } => cloud,
        };
        let expected = cloud.points.len();
        if frame.smoothed.points.len() != expected {
            let (what, len) = ("the smoothed points for Rerun".to_owned(), frame.smoothed.points.len());
            return Err(FrameError::LengthMismatch { what, len, expected }.into());
        }
        let recording = &self.recording;
        recording.set_time(frame.index, frame.source.timestamp_s());
        recording.with(|to| to.log("raw", &points(cloud, cloud.positions())))?;
        recording.with(|to| to.log("smoothed", &points(cloud, &frame.smoothed.points)))?;
        recording.with(|to| to.log("depth", &depth_image(&frame.source)))?;
        recording.with(|to| to.log("latency/ms", &Scalars::single(1e3 * frame.latency.as_secs_f64())))?;
        if let Some(flicker) = frame.flicker {
            let figures = [
                ("flicker/jitter as measured, mm", 1e3 * flicker.measured_m),
                ("flicker/jitter smoothed, mm", 1e3 * flicker.smoothed_m),
                ("flicker/restarted, %", 1e2 * flicker.restarted),
                ("flicker/carried, %", 1e2 * flicker.carried),
            ];
            for (name, value) in figures {
                recording.with(|to| to.log(name, &Scalars::single(value)))?;
            }
        }
        if let Some(fps) = fps {
            recording.with(|to| to.log("rate/frames per second", &Scalars::single(fps)))?;
        }
        Ok(recording.flush()?)
    }

    fn close(&mut self) -> Result<(), Error> {
        self.recording.close()
    }
}

/// Returns the layout: clouds above; depth, latency, rate and flicker below.
fn layout() -> Blueprint {
    let clouds = Horizontal::new([
        Spatial3DView::new("raw").with_origin("raw").into(),
        Spatial3DView::new("smoothed").with_origin("smoothed").into(),
    ]);
    let measures = Horizontal::new([
        Spatial2DView::new("depth").with_origin("depth").into(),
        TimeSeriesView::new("latency, ms").with_origin("latency").into(),
        TimeSeriesView::new("frames per second").with_origin("rate").into(),
        TimeSeriesView::new("flicker").with_origin("flicker").into(),
    ]);
    Blueprint::new(Vertical::new([clouds.into(), measures.into()]).with_row_shares([2.0, 1.0]))
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(TimePanel::new().with_state(PanelState::Collapsed).with_timeline("frame"))
}

/// Returns the valid points, with the cloud's colours or shaded as relief. Their radius is half the pixel spacing.
fn points(cloud: &OrganizedCloud, positions: &Xyz) -> Points3D {
    let colours = cloud.points.shown_rgb().unwrap_or_else(|| {
        let (width, height) = (cloud.width(), cloud.height());
        let shades = relief(width, height, &difference_normals(width, height, positions)).rgb;
        shades.chunks_exact(3).map(|rgb| [rgb[0], rgb[1], rgb[2]]).collect()
    });
    let half_pitch_at_1m = 0.5 * cloud.pixel_pitch_at_1m().unwrap_or(2e-3) as f32;
    let valid = || (0..positions.len()).filter(|&i| positions.is_finite(i));
    Points3D::new(valid().map(|i| positions.get(i)))
        .with_colors(valid().map(|i| colours[i]))
        .with_radii(valid().map(|i| positions.z()[i].abs() * half_pitch_at_1m))
}

fn depth_image(source: &OwnedFrame) -> DepthImage {
    let (width, height) = source.shape();
    let shape = [width as u32, height as u32];
    match source {
        OwnedFrame::Depth(depth) => {
            let bytes: Vec<u8> = depth.raw.iter().flat_map(|raw| raw.to_le_bytes()).collect();
            DepthImage::from_gray16(bytes, shape).with_meter(depth.camera.depth_units_per_metre as f32)
        }
        OwnedFrame::Cloud { cloud, .. } => {
            let metres = cloud.positions().z().iter().map(|&z| if z.is_finite() { z } else { 0.0 });
            let bytes: Vec<u8> = metres.flat_map(f32::to_le_bytes).collect();
            DepthImage::from_data_type_and_bytes(bytes, shape, rerun::ChannelDatatype::F32).with_meter(1.0)
        }
    }
}
