//! A source that prepares frames for smoothing.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::{OwnedFrame, Source};
use planish_core::{Camera, Error, Preparation, SensorModel};

/// A source that prepares its frames: limits their range, removes floating pixels, reduces their resolution.
pub struct PreparedSource {
    source: Box<dyn Source>,
    steps: Preparation,
    sensor: SensorModel,
    camera: Option<Camera>,
}

impl PreparedSource {
    /// Wraps a source. The sensor's noise is used to distinguish surfaces.
    pub fn new(source: Box<dyn Source>, steps: Preparation, sensor: SensorModel) -> Self {
        Self { source, steps, sensor, camera: None }
    }

    /// Sets the camera for clouds without their own; it is scaled when the resolution of the clouds is reduced.
    pub fn with_camera(self, camera: Option<Camera>) -> Self {
        Self { camera, ..self }
    }
}

impl Source for PreparedSource {
    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        self.source.end_with(ended);
    }

    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let mut frame = self.source.next_frame()?;
        match &mut frame {
            Some(OwnedFrame::Depth(depth)) => {
                self.steps.depth(depth, &self.sensor)?;
            }
            Some(OwnedFrame::Cloud { cloud, .. }) => {
                let shape = (cloud.width(), cloud.height());
                cloud.camera = cloud.camera.or(self.camera.map(|camera| camera.with_shape(shape)));
                self.steps.cloud(cloud, &self.sensor)?;
            }
            _ => {}
        }
        Ok(frame)
    }

    fn frame_name(&self) -> Option<String> {
        self.source.frame_name()
    }

    fn description(&self) -> Option<String> {
        self.source.description()
    }

    fn dropped(&self) -> u64 {
        self.source.dropped()
    }

    fn is_live(&self) -> bool {
        self.source.is_live()
    }
}

#[cfg(test)]
mod tests {
    use planish_core::{DepthFrame, Settings};

    use super::*;
    use crate::stream::{Frames, StreamOptions};

    /// A source of one frame.
    struct Steps(Option<DepthFrame>);

    impl Source for Steps {
        fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
            Ok(self.0.take().map(OwnedFrame::Depth))
        }
    }

    #[test]
    fn streams_remove_floating_pixels_if_their_settings_say_so() {
        let camera = Camera::kinect_v1().with_shape((64, 48));
        // Two walls, and a pixel that floats between them.
        let depth = |i: usize| match i % 64 {
            _ if i == 24 * 64 + 32 => 1500,
            0..32 => 1000,
            _ => 2000,
        };
        let frame = DepthFrame::new(camera, (0..64 * 48).map(depth).collect()).unwrap();
        let holes_of = |settings: &str| {
            let settings: Settings = settings.parse().unwrap();
            let options = StreamOptions::from_settings(settings).unwrap();
            let mut frames = Frames::start(Box::new(Steps(Some(frame.clone()))), options).unwrap();
            let smoothed = frames.next().unwrap().unwrap();
            let OwnedFrame::Depth(measured) = &smoothed.source else { panic!("depth") };
            measured.raw.iter().filter(|raw| **raw == 0).count()
        };
        assert_eq!(holes_of("engine=cpu outputs=points"), 0);
        assert_eq!(holes_of("engine=cpu outputs=points remove_floating=true"), 1);
        assert_eq!(holes_of("engine=cpu outputs=points max_range_m=1.8"), 48 * 32 - 1);
        let settings: Settings = "engine=cpu decimate=2".parse().unwrap();
        let options = StreamOptions::from_settings(settings).unwrap();
        let mut frames = Frames::start(Box::new(Steps(Some(frame.clone()))), options).unwrap();
        let smoothed = frames.next().unwrap().unwrap();
        assert_eq!((smoothed.smoothed.width, smoothed.source.shape()), (32, (32, 24)));
        let auto: Settings = "sensor=auto remove_floating=true".parse().unwrap();
        assert!(StreamOptions::from_settings(auto).unwrap_err().to_string().contains("sensor"));
    }
}
