//! Sources as the command opens them: waited for, opened again, without floating pixels.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use planish::source::{self, OwnedFrame, Source, SourceOptions};
use planish::{DeviceError, Error, SensorModel};
use planish_bench::errln;

use crate::args::{LimitArgs, SourceArgs};

/// Opens a source; one that is to come back is waited for until `stop` is set.
pub fn open_source(args: &SourceArgs, stop: &Arc<AtomicBool>) -> Result<Box<dyn Source>> {
    let SourceArgs { topics, camera, align, mode, limits, .. } = args;
    if topics.topic.len() > 1 {
        bail!("--topic: a stream has only one topic; `planish smooth` accepts several");
    }
    let options = SourceOptions::default()
        .with_topics(topics.topic.first().cloned(), topics.camera_info_topic.clone())
        .with_camera(camera.camera_of_any_shape()?)
        .with_tum_units_per_metre(camera.depth_units_per_metre)
        .with_alignment(align.map(Into::into))
        .with_mode(*mode)
        .with_fps(limits.fps)
        .with_frames(limits.frames);
    if limits.reconnect && !source::is_camera(args.name()) {
        bail!("--reconnect applies to cameras; {} is not one", args.name());
    }
    open_named(args.name(), options, limits, stop)
}

impl SourceArgs {
    /// Returns the source; empty where a rig stands instead.
    pub fn name(&self) -> &str {
        self.name.as_deref().unwrap_or_default()
    }
}

/// Opens a source by its name; one that is to come back is waited for until `stop` is set.
pub fn open_named(
    name: &str,
    options: SourceOptions,
    limits: &LimitArgs,
    stop: &Arc<AtomicBool>,
) -> Result<Box<dyn Source>> {
    if name == "synthetic" || name.starts_with("synthetic:") {
        errln!("{name}: rendering its frames");
    }
    let source = match source::open(name, &options) {
        Err(Error::Device(error @ DeviceError::NotFound { .. })) if limits.reconnect => {
            errln!("{error}; waiting for it");
            None
        }
        opened => Some(opened?),
    };
    if let Some(description) = source.as_ref().and_then(|source| source.description()) {
        errln!("{description}");
    }
    // Times beyond the clock's range count as no limit.
    let until = limits.max_duration()?.and_then(|longest| Instant::now().checked_add(longest));
    let source = match source {
        Some(source) if !limits.reconnect => return Ok(source),
        source => source,
    };
    let name = name.to_owned();
    let open = move || source::open(&name, &options);
    let retry = Duration::from_secs(1);
    let (stop, ended) = (Arc::clone(stop), Arc::default());
    Ok(Box::new(Reconnecting { open, source, stop, ended, until, retry, dropped_before: 0 }))
}

/// A source whose floating pixels are holes.
pub struct WithoutFloating {
    pub source: Box<dyn Source>,
    pub sensor: SensorModel,
}

impl Source for WithoutFloating {
    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        self.source.end_with(ended);
    }

    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let mut frame = self.source.next_frame()?;
        match &mut frame {
            Some(OwnedFrame::Depth(depth)) => {
                depth.remove_floating(&self.sensor);
            }
            Some(OwnedFrame::Cloud { cloud, .. }) => {
                cloud.remove_floating(&self.sensor);
            }
            _ => {}
        }
        Ok(frame)
    }

    fn frame_name(&self) -> Option<String> {
        self.source.frame_name()
    }

    fn dropped(&self) -> u64 {
        self.source.dropped()
    }

    fn is_live(&self) -> bool {
        self.source.is_live()
    }
}

/// A camera that is opened again when it comes back.
struct Reconnecting<Open> {
    open: Open,
    source: Option<Box<dyn Source>>,
    /// Set by the user, who wants no more frames.
    stop: Arc<AtomicBool>,
    /// Set by the stream, which has ended.
    ended: Arc<AtomicBool>,
    /// It is not waited for longer than this.
    until: Option<Instant>,
    /// How long to wait before it is looked for again.
    retry: Duration,
    /// Frames that the camera dropped before it went.
    dropped_before: u64,
}

impl<Open: FnMut() -> Result<Box<dyn Source>, Error> + Send> Source for Reconnecting<Open> {
    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        if let Some(source) = &mut self.source {
            source.end_with(Arc::clone(&ended));
        }
        self.ended = ended;
    }

    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let is_set = |flag: &AtomicBool| flag.load(Ordering::Relaxed);
        while !is_set(&self.stop) && !is_set(&self.ended) && self.until.is_none_or(|until| Instant::now() < until) {
            if let Some(source) = &mut self.source {
                match source.next_frame() {
                    Err(Error::Device(DeviceError::Gone { what })) => {
                        errln!("{what}; waiting for it to return");
                        self.dropped_before += source.dropped();
                        self.source = None;
                    }
                    other => return other,
                }
            }
            match (self.open)() {
                Ok(mut source) => {
                    errln!("{}", source.description().unwrap_or_else(|| "the camera is connected".to_owned()));
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

    fn dropped(&self) -> u64 {
        self.dropped_before + self.source.as_ref().map_or(0, |source| source.dropped())
    }

    fn is_live(&self) -> bool {
        true
    }
}

impl LimitArgs {
    pub fn max_duration(&self) -> Result<Option<Duration>> {
        let duration = |seconds| {
            let duration = Duration::try_from_secs_f64(seconds).ok();
            duration.with_context(|| format!("--duration {seconds:?}: a number of seconds, 0 or more, is expected"))
        };
        self.duration.map(duration).transpose()
    }
}

#[cfg(test)]
mod tests {
    use planish::{Camera, DepthFrame};

    use super::*;

    /// Gives some frames, then is unplugged.
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
    fn a_camera_that_comes_back_goes_on_and_one_that_does_not_is_waited_for_until_the_end() {
        let mut attempts = 0;
        let open = move || -> Result<Box<dyn Source>, Error> {
            attempts += 1;
            match attempts {
                // Not there at the first look, back at the second, and never again after that.
                2 => Ok(Box::new(Unplugged { frames: 3 })),
                _ => Err(DeviceError::Failed { what: "no camera".into() }.into()),
            }
        };
        let stop = Arc::new(AtomicBool::new(false));
        let mut source = Reconnecting {
            open,
            source: Some(Box::new(Unplugged { frames: 2 })),
            stop: Arc::clone(&stop),
            ended: Arc::default(),
            until: Some(Instant::now() + Duration::from_millis(300)),
            retry: Duration::from_millis(5),
            dropped_before: 0,
        };
        for _ in 0..5 {
            assert!(source.next_frame().unwrap().is_some());
        }
        assert!(source.next_frame().unwrap().is_none());
        source.until = None;
        stop.store(true, Ordering::Relaxed);
        assert!(source.next_frame().unwrap().is_none());
        stop.store(false, Ordering::Relaxed);
        source.end_with(Arc::new(AtomicBool::new(true)));
        assert!(source.next_frame().unwrap().is_none());
    }
}
