//! Smooths messages of any shape.

use std::collections::BTreeMap;

use super::{DepthMessage, DepthPixels, Header, Image, PointCloud2};
use planish_core::{
    Camera, CloudParams, DepthImage, DepthView, Engine, Error, FormatError, Frame, FrameError, FrameParams, Outputs,
    ParamError, PointsView, SensorPose, Session, SessionEvent, Settings, Smoothed, SmootherOptions, Xyz,
};
use planish_io::{ReadOptions, Work};

/// Reason why a message was not smoothed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MessageError {
    /// The message is malformed or unsupported; the next message may be fine.
    #[error(transparent)]
    Message(#[from] FormatError),
    /// A parameter or an engine failed; the next message will fail, too.
    #[error(transparent)]
    Engine(Error),
}

impl From<Error> for MessageError {
    fn from(error: Error) -> Self {
        match error {
            Error::Frame(error) => Self::Message(error.into()),
            error => Self::Engine(error),
        }
    }
}

impl From<FrameError> for MessageError {
    fn from(error: FrameError) -> Self {
        Self::Message(error.into())
    }
}

/// A smoother for successive depth images and clouds of any shape.
pub struct MessageSmoother {
    session: Session,
    /// The topic that `session` smooths; set only for smoothing over time.
    topic: Option<String>,
    /// The sessions of other topics; only smoothing over time needs one session per topic.
    others: BTreeMap<String, Session>,
    events: Vec<SessionEvent>,
    /// The fields that are added to clouds.
    outputs: Outputs,
    read: ReadOptions,
    smoothed: Smoothed,
    wants_normals_image: bool,
    /// Normals of the last message, if they were requested only as an image.
    normals: Option<Xyz>,
    /// Warning about lost points, which is issued only once; `None` once it is taken.
    warning: Option<String>,
    warned: bool,
}

/// Returns an error if the settings request steps before smoothing.
fn check_no_preparation(settings: &Settings) -> Result<(), ParamError> {
    let allowed = "messages keep their grid and camera_info, so these steps apply only to files and streams \
                   (remove_floating, min_range_m, max_range_m, decimate)";
    match settings.preparation().is_empty() {
        true => Ok(()),
        false => Err(ParamError { field: "settings", value: "steps before smoothing".into(), allowed }),
    }
}

fn session_of(settings: Settings) -> Result<Session, Error> {
    check_no_preparation(&settings)?;
    Ok(Session::new(settings)?.with_kept_sensor(true).with_cloud_estimates(false))
}

impl MessageSmoother {
    /// Creates a smoother; the settings' outputs are the fields added to clouds.
    ///
    /// # Errors
    /// If settings are outside their ranges or contradict each other, or a device does not exist.
    pub fn new(settings: Settings) -> Result<Self, Error> {
        let outputs = settings.outputs.unwrap_or_default();
        Ok(Self::of(session_of(settings)?, outputs))
    }

    /// Creates a smoother with explicit parameters.
    ///
    /// # Errors
    /// If a parameter is outside its range.
    pub fn with_params(frame: FrameParams, cloud: CloudParams, options: SmootherOptions) -> Result<Self, Error> {
        let outputs = options.outputs;
        Ok(Self::of(Session::with_params(frame, cloud, options, Vec::new())?, outputs))
    }

    fn of(session: Session, outputs: Outputs) -> Self {
        Self {
            session,
            topic: None,
            others: BTreeMap::new(),
            events: Vec::new(),
            outputs,
            read: ReadOptions::default(),
            smoothed: Smoothed::default(),
            wants_normals_image: false,
            normals: None,
            warning: None,
            warned: false,
        }
    }

    /// Sets the memory limit per message.
    pub fn with_read_options(self, read: ReadOptions) -> Self {
        Self { read, ..self }
    }

    /// Sets the settings for the following messages; their outputs are the fields added to clouds.
    ///
    /// # Errors
    /// Same as [`new`](Self::new).
    pub fn set_settings(&mut self, settings: Settings) -> Result<(), Error> {
        let outputs = settings.outputs.unwrap_or_default();
        check_no_preparation(&settings)?;
        self.session.set_settings(settings)?;
        self.others.clear();
        self.outputs = outputs;
        Ok(())
    }

    /// Sets the topic of the next messages. Smoothing over time uses one session and engine per topic; otherwise this
    /// has no effect.
    ///
    /// # Errors
    /// Same as [`new`](Self::new).
    pub fn set_topic(&mut self, topic: &str) -> Result<(), Error> {
        let Some(settings) = self.session.settings().filter(|settings| settings.temporal_params().is_some()) else {
            return Ok(());
        };
        match &self.topic {
            Some(current) if current == topic => return Ok(()),
            Some(current) => {
                let next = match self.others.remove(topic) {
                    Some(session) => session,
                    None => session_of(settings.clone())?,
                };
                let mut before = std::mem::replace(&mut self.session, next);
                self.events.extend(before.take_events());
                self.others.insert(current.clone(), before);
            }
            None => {}
        }
        self.topic = Some(topic.to_owned());
        Ok(())
    }

    /// Sets the pose of the camera of the next message, for smoothing over time with a moving camera; `None` if it is
    /// unknown. Call it after [`set_topic`](Self::set_topic).
    ///
    /// # Errors
    /// If the pose is invalid, or the settings estimate the motion.
    pub fn set_camera_pose(&mut self, pose: Option<SensorPose>) -> Result<(), Error> {
        self.session.set_camera_pose(pose)
    }

    /// Returns the settings; `None` for a smoother with explicit parameters.
    pub fn settings(&self) -> Option<&Settings> {
        self.session.settings()
    }

    /// Sets whether [`normals_image`](Self::normals_image) returns normals for frames on a grid. The normal fields of
    /// clouds are not affected.
    pub fn set_normals_image(&mut self, wanted: bool) {
        self.wants_normals_image = wanted;
    }

    /// Returns the normals of the last message in the camera's optical frame, as a 32FC3 image; `None` if they were not
    /// requested, or for a cloud without a grid.
    pub fn normals_image(&self, header: Header) -> Option<Image> {
        let normals = self.normals.as_ref().or(self.smoothed.normals.as_ref()).filter(|_| self.wants_normals_image)?;
        let Smoothed { width, height, .. } = self.smoothed;
        (height > 1).then(|| Image::of_normals(header, (width, height), normals))
    }

    /// Returns the pixel origins of the last depth image as a mono8 image: 0 for holes, 85 for filled pixels, 170 for
    /// pixels carried over from the previous frame, 255 for measured pixels. `None` if the settings neither fill
    /// holes nor smooth over time: all values are then measured.
    pub fn origin_image(&self, header: Header) -> Option<Image> {
        let Smoothed { width, height, .. } = self.smoothed;
        let mask = self.smoothed.origin_mask().filter(|_| self.flags_origins() && height > 1)?;
        Some(Image::of_origins(header, (width, height), mask))
    }

    /// Returns true if pixels may have values that were not measured.
    pub(crate) fn flags_origins(&self) -> bool {
        self.session.settings().is_some_and(Settings::flags_origins)
    }

    /// Returns the engine that smoothed the last message.
    pub fn engine(&self) -> Option<Engine> {
        self.session.engine()
    }

    /// Takes the session's events, such as a change of the engine or an estimated sensor.
    pub fn take_events(&mut self) -> Vec<SessionEvent> {
        let mut events = std::mem::take(&mut self.events);
        events.extend(self.session.take_events());
        events
    }

    /// Takes the warning about the first message that lost more than 1 % of its points.
    pub fn take_warning(&mut self) -> Option<String> {
        self.warning.take()
    }

    /// Returns the result of the last message.
    pub fn smoothed(&self) -> &Smoothed {
        &self.smoothed
    }

    /// Smooths a depth image with the camera that `camera` returns for its width and height. Returns the smoothed
    /// depth in the unit of the image. If `points` is set, [`smoothed`](Self::smoothed) then returns points and the
    /// additional fields.
    ///
    /// # Errors
    /// If the message is not a depth image, the camera has another shape, or the engine fails.
    pub fn smooth_depth(
        &mut self,
        message: &DepthMessage,
        camera: impl FnOnce((usize, usize)) -> Result<Camera, FormatError>,
        points: bool,
    ) -> Result<DepthPixels, MessageError> {
        let pixels = self.smooth_pixels(message, camera, true, points)?;
        let (width, height) = pixels.shape();
        Ok(match pixels {
            DepthPixels::Millimetres(_) => {
                let raw = self.smoothed.depth.clone().unwrap_or_default();
                DepthPixels::Millimetres(DepthImage { width, height, raw })
            }
            DepthPixels::Metres { .. } => {
                let depth_m = self.smoothed.depth_m.clone().unwrap_or_default();
                DepthPixels::Metres { width, height, depth_m }
            }
        })
    }

    /// Smooths a depth image only for its normals ([`normals_image`](Self::normals_image)).
    ///
    /// # Errors
    /// Same as [`smooth_depth`](Self::smooth_depth).
    pub fn smooth_depth_to_normals(
        &mut self,
        message: &DepthMessage,
        camera: impl FnOnce((usize, usize)) -> Result<Camera, FormatError>,
    ) -> Result<(), MessageError> {
        self.smooth_pixels(message, camera, false, false).map(drop)
    }

    /// Smooths a depth image into a cloud only.
    ///
    /// # Errors
    /// Same as [`smooth_depth`](Self::smooth_depth).
    pub fn smooth_depth_to_cloud(
        &mut self,
        message: &DepthMessage,
        camera: impl FnOnce((usize, usize)) -> Result<Camera, FormatError>,
    ) -> Result<PointCloud2, MessageError> {
        self.smooth_pixels(message, camera, false, true)?;
        Ok(PointCloud2::of_smoothed(message.header().clone(), &self.smoothed))
    }

    /// Smooths a depth image into `self.smoothed`, with the outputs that `depth` and `points` select. Returns its
    /// decoded, unsmoothed pixels.
    fn smooth_pixels(
        &mut self,
        message: &DepthMessage,
        camera: impl FnOnce((usize, usize)) -> Result<Camera, FormatError>,
        depth: bool,
        points: bool,
    ) -> Result<DepthPixels, MessageError> {
        /// Ratio of the memory for smoothing a pixel to the four bytes for decoding it.
        const SMOOTHING: u64 = 60;
        // A compressed image of a few bytes may claim a decoded size of a gigabyte.
        let decoding = self.read.with_max_memory_bytes(self.read.max_memory_bytes / SMOOTHING);
        let pixels = message.pixels(&decoding).map_err(|error| match error {
            FormatError::TooLarge { needed, .. } => {
                FormatError::TooLarge { needed: needed.saturating_mul(SMOOTHING), allowed: self.read.max_memory_bytes }
            }
            error => error,
        })?;
        self.session.set_frame_time(Some(message.header().stamp.seconds()));
        let camera = camera(pixels.shape())?;
        camera.check_shape(pixels.shape())?;
        let outputs = if points { self.cloud_outputs(true) } else { Outputs::POINTS.with_points(false) };
        let outputs = outputs.with_status(outputs.status || self.flags_origins());
        match &pixels {
            DepthPixels::Millimetres(image) => {
                // Messages are in millimetres, whatever the unit of the camera.
                let camera = camera.with_depth_units_per_metre(1000.0);
                self.smooth(Frame::Depth(DepthView::new(&image.raw, &camera)?), outputs.with_depth(depth), 0)?;
            }
            DepthPixels::Metres { depth_m, .. } => {
                self.smooth(Frame::Depth(DepthView::from_metres(depth_m, &camera)?), outputs.with_depth_m(depth), 0)?;
            }
        }
        Ok(pixels)
    }

    /// Smooths a cloud, organized or not, and keeps all its fields.
    ///
    /// # Errors
    /// If the message is malformed, or the engine fails.
    pub fn smooth_cloud(&mut self, cloud: PointCloud2) -> Result<PointCloud2, MessageError> {
        self.read.check(cloud.data.len(), 2)?;
        let cloud = cloud.into_native()?;
        self.session.set_frame_time(Some(cloud.header.stamp.seconds()));
        let view: PointsView<'_> = cloud.view()?;
        if view.is_empty() {
            return Ok(cloud);
        }
        let outputs = self.cloud_outputs(view.grid().is_some());
        self.smooth(Frame::Points(view), outputs, cloud.point_step as usize)?;
        Ok(cloud.with_smoothed(&self.smoothed)?)
    }

    /// Returns the outputs for a cloud: the requested normals, curvature, status and, on a grid, standard errors.
    /// Smoothing a grid over time also needs status and frames.
    fn cloud_outputs(&self, is_on_grid: bool) -> Outputs {
        let Outputs { normals, curvature, status, sigma, .. } = self.outputs;
        let is_over_time = self.session.settings().is_some_and(|settings| settings.temporal_params().is_some());
        let is_video = is_on_grid && is_over_time;
        let outputs = Outputs::POINTS.with_normals(normals).with_curvature(curvature);
        outputs.with_status(status || is_video).with_frames(is_video).with_sigma(sigma && is_on_grid)
    }

    fn smooth(&mut self, frame: Frame<'_>, outputs: Outputs, field_bytes: usize) -> Result<(), MessageError> {
        self.read.check_work_on_frame(Work::Smooth, frame, field_bytes)?;
        let grid = frame.grid();
        let has_normals = outputs.normals;
        let outputs = outputs.with_normals(has_normals || self.wants_normals_image && grid.is_some());
        self.smoothed.normals = self.smoothed.normals.take().or(self.normals.take());
        self.session.set_outputs(outputs);
        self.session.smooth(frame, &mut self.smoothed)?;
        if !has_normals {
            // Normals left in the result would be added to clouds.
            self.normals = self.smoothed.normals.take();
        }
        self.note_lost_points(frame);
        Ok(())
    }

    fn note_lost_points(&mut self, frame: Frame<'_>) {
        if self.warned {
            return;
        }
        self.warning = self.smoothed.lost_points_warning(frame);
        self.warned = self.warning.is_some();
    }
}
