//! Opens sources from the options of the command.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use planish::source::{self, Reconnecting, Source, SourceOptions};
use planish_bench::errln;

use crate::args::{LimitArgs, SourceArgs};

/// Opens a source. With --reconnect, waits for a missing camera until `stop` is set.
pub fn open_source(args: &SourceArgs, stop: &Arc<AtomicBool>) -> Result<Box<dyn Source>> {
    let SourceArgs { topics, camera, align, mode, limits, .. } = args;
    if topics.topic.len() > 1 {
        bail!("--topic: a stream reads only one topic; `planish smooth` accepts several");
    }
    let options = SourceOptions::default()
        .with_topics(topics.topic.first().cloned(), topics.camera_info_topic.clone())
        .with_camera(camera.camera_of_any_shape()?)
        .with_tum_units_per_metre(camera.depth_units_per_metre)
        .with_alignment(align.map(Into::into))
        .with_mode(*mode)
        .with_fps(limits.fps)
        .with_frames(limits.frames)
        .with_read_options(args.memory.options());
    if limits.reconnect && !source::is_camera(args.name()) {
        bail!("--reconnect applies only to cameras; {} is not a camera", args.name());
    }
    open_named(args.name(), options, limits, stop)
}

impl SourceArgs {
    /// Returns the name of the source; empty with --rig.
    pub fn name(&self) -> &str {
        self.name.as_deref().unwrap_or_default()
    }
}

/// Opens a source by its name. With --reconnect, waits for a missing camera until `stop` is set.
pub fn open_named(
    name: &str,
    options: SourceOptions,
    limits: &LimitArgs,
    stop: &Arc<AtomicBool>,
) -> Result<Box<dyn Source>> {
    if name == "synthetic" || name.starts_with("synthetic:") {
        errln!("{name}: rendering its frames");
    }
    if limits.reconnect {
        // Times beyond the clock's range count as no limit.
        let until = limits.max_duration()?.and_then(|longest| Instant::now().checked_add(longest));
        let source = Reconnecting::open(name, options, |text| errln!("{text}"))?;
        return Ok(Box::new(source.with_stop(Arc::clone(stop)).with_end_at(until)));
    }
    let source = source::open(name, &options)?;
    if let Some(description) = source.description() {
        errln!("{description}");
    }
    Ok(source)
}

impl LimitArgs {
    pub fn max_duration(&self) -> Result<Option<Duration>> {
        let duration = |seconds| {
            let duration = Duration::try_from_secs_f64(seconds).ok();
            duration.with_context(|| format!("--duration {seconds:?}: expected a number of seconds, at least 0"))
        };
        self.duration.map(duration).transpose()
    }
}
