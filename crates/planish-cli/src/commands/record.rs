//! `planish record`: frames as they come, into a data set.

use crate::exit::ExitCode;
use std::sync::atomic::Ordering;
use std::time::Instant;

use anyhow::{Result, bail};
use planish::source::{SourceFrame, TumRecorder};
use planish_bench::outln;
use serde::Serialize;

use super::stream::open_source;
use crate::args::RecordArgs;
use crate::signals::stop_flag;

#[derive(Serialize)]
struct Report {
    frames: u64,
    /// Frames of a camera that came while others were written.
    dropped: u64,
    seconds: f64,
}

pub fn run(args: &RecordArgs) -> Result<ExitCode> {
    let longest = args.limits.max_duration()?;
    let stop = stop_flag();
    let mut source = open_source(&args.source, &args.camera, &args.limits, &stop)?;
    let mut recorder = TumRecorder::create(&args.folder)?;
    let start = Instant::now();
    let mut frames = 0;
    let is_over = |frames| {
        stop.load(Ordering::Relaxed)
            || args.limits.frames.is_some_and(|most| frames >= most)
            || longest.is_some_and(|longest| start.elapsed() >= longest)
    };
    while !is_over(frames) {
        match source.next_frame()? {
            None => break,
            Some(SourceFrame::Depth(frame)) => recorder.add(&frame)?,
            Some(_) => {
                bail!("{}: gives clouds; a data set in TUM layout has depth images", args.source)
            }
        }
        frames += 1;
    }
    let report = Report { frames, dropped: source.dropped(), seconds: start.elapsed().as_secs_f64() };
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        outln!("{frames} frames in {:.1} s, {} dropped -> {}", report.seconds, report.dropped, args.folder.display());
    }
    Ok(ExitCode::SUCCESS)
}
