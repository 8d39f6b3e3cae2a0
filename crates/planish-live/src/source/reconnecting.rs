//! Cameras that are reopened after they were unplugged.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::{OwnedFrame, Source, SourceOptions};
use planish_core::{DeviceError, Error};

/// Time between two attempts to open a camera.
const RETRY_AFTER: Duration = Duration::from_secs(1);

/// A function that opens a camera, or returns the reason for the failure.
type Open = Box<dyn FnMut() -> Result<Box<dyn Source>, Error> + Send>;

/// A camera that is reopened after it was missing. The source waits until the camera returns.
pub struct Reconnecting {
    open: Open,
    source: Option<Box<dyn Source>>,
    /// Set by the caller when it wants no more frames.
    stop: Arc<AtomicBool>,
    /// Set by the stream when it ends.
    ended: Arc<AtomicBool>,
    until: Option<Instant>,
    retry: Duration,
    /// Number of frames that the camera dropped before it was unplugged.
    dropped_before: u64,
    tell: Box<dyn FnMut(&str) + Send>,
}

impl Reconnecting {
    /// Opens a camera by its name, or waits for it if it is missing. `tell` receives messages for users: that the
    /// source waits, and the description of each opened camera.
    ///
    /// # Errors
    /// If the camera exists and cannot be opened, or the name or the options are not allowed.
    pub fn open(
        name: &str,
        options: SourceOptions,
        mut tell: impl FnMut(&str) + Send + 'static,
    ) -> Result<Self, Error> {
        let source = match super::open(name, &options) {
            Err(Error::Device(error @ DeviceError::NotFound { .. })) => {
                tell(&format!("{error}; waiting for the camera"));
                None
            }
            opened => Some(opened?),
        };
        if let Some(description) = source.as_ref().and_then(|source| source.description()) {
            tell(&description);
        }
        let name = name.to_owned();
        let open: Open = Box::new(move || super::open(&name, &options));
        let (stop, ended) = (Arc::default(), Arc::default());
        Ok(Self { open, source, stop, ended, until: None, retry: RETRY_AFTER, dropped_before: 0, tell: Box::new(tell) })
    }

    /// Sets a flag that ends the source.
    pub fn with_stop(self, stop: Arc<AtomicBool>) -> Self {
        Self { stop, ..self }
    }

    /// Sets the time at which the source ends; `None` for no limit.
    pub fn with_end_at(self, until: Option<Instant>) -> Self {
        Self { until, ..self }
    }

    fn is_over(&self) -> bool {
        let is_set = |flag: &AtomicBool| flag.load(Ordering::Relaxed);
        is_set(&self.stop) || is_set(&self.ended) || self.until.is_some_and(|until| Instant::now() >= until)
    }
}

impl Source for Reconnecting {
    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        if let Some(source) = &mut self.source {
            source.end_with(Arc::clone(&ended));
        }
        self.ended = ended;
    }

    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        while !self.is_over() {
            if let Some(source) = &mut self.source {
                match source.next_frame() {
                    Err(Error::Device(DeviceError::Gone { what })) => {
                        (self.tell)(&format!("{what}; waiting for the camera to return"));
                        self.dropped_before += source.dropped();
                        self.source = None;
                    }
                    other => return other,
                }
            }
            match (self.open)() {
                Ok(mut source) => {
                    (self.tell)(source.description().as_deref().unwrap_or("the camera is connected"));
                    source.end_with(Arc::clone(&self.ended));
                    self.source = Some(source);
                }
                Err(_) => std::thread::sleep(self.retry),
            }
        }
        Ok(None)
    }

    fn frame_name(&self) -> Option<String> {
        self.source.as_ref().and_then(|source| source.frame_name())
    }

    fn description(&self) -> Option<String> {
        self.source.as_ref().and_then(|source| source.description())
    }

    fn dropped(&self) -> u64 {
        self.dropped_before + self.source.as_ref().map_or(0, |source| source.dropped())
    }

    fn is_live(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use planish_core::{Camera, DepthFrame};

    use super::*;

    /// A camera that delivers some frames and is then unplugged.
    struct Unplugged {
        frames: u32,
    }

    impl Source for Unplugged {
        fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
            if self.frames == 0 {
                return Err(DeviceError::Gone { what: "the test's camera".into() }.into());
            }
            self.frames -= 1;
            let camera = Camera::kinect_v1().with_shape((4, 3));
            Ok(Some(OwnedFrame::Depth(DepthFrame::new(camera, vec![1000; 12]).unwrap())))
        }
    }

    #[test]
    fn a_camera_that_returns_continues_and_a_missing_one_is_waited_for_until_the_end() {
        let mut attempts = 0;
        let open = move || -> Result<Box<dyn Source>, Error> {
            attempts += 1;
            match attempts {
                // The camera is missing at the first attempt, back at the second, and missing from then on.
                2 => Ok(Box::new(Unplugged { frames: 3 })),
                _ => Err(DeviceError::Failed { what: "no camera".into() }.into()),
            }
        };
        let (stop, told) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(Vec::new())));
        let kept = Arc::clone(&told);
        let mut source = Reconnecting {
            open: Box::new(open),
            source: Some(Box::new(Unplugged { frames: 2 })),
            stop: Arc::clone(&stop),
            ended: Arc::default(),
            until: Some(Instant::now() + Duration::from_millis(300)),
            retry: Duration::from_millis(5),
            dropped_before: 0,
            tell: Box::new(move |text| kept.lock().unwrap().push(text.to_owned())),
        };
        for _ in 0..5 {
            assert!(source.next_frame().unwrap().is_some());
        }
        assert!(source.next_frame().unwrap().is_none());
        let gone = "the test's camera; waiting for the camera to return";
        assert_eq!(*told.lock().unwrap(), [gone, "the camera is connected", gone]);
        source.until = None;
        stop.store(true, Ordering::Relaxed);
        assert!(source.next_frame().unwrap().is_none());
        stop.store(false, Ordering::Relaxed);
        source.end_with(Arc::new(AtomicBool::new(true)));
        assert!(source.next_frame().unwrap().is_none());
    }
}
