//! `planish record`: writes frames to a data set or recording as they arrive.

use crate::exit::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use anyhow::{Result, bail};
use planish::Error;
use planish::source::{OwnedFrame, TumRecorder, unreadable_warning};
use planish_bench::{errln, outln};
use serde::Serialize;

use super::sources::open_source;
use crate::args::RecordArgs;
use crate::signals::stop_by;

#[derive(Serialize)]
struct Report {
    frames: u64,
    /// Number of camera frames that arrived while others were being written.
    dropped: u64,
    /// Number of frames that could not be read.
    unreadable: u64,
    seconds: f64,
}

/// Number of consecutive failures after which the recording ends with an error.
const MOST_FAILURES: u32 = 100;

/// The destination of a recording.
enum Recorder {
    /// A data set of depth images in TUM layout.
    Tum(TumRecorder),
    #[cfg(feature = "mcap")]
    Bag(Box<planish::bag::BagWriter>),
}

impl Recorder {
    fn create(output: &std::path::Path) -> Result<Self> {
        if super::checks::is_mcap(output) {
            super::checks::check_is_new(output)?;
            #[cfg(feature = "mcap")]
            return Ok(Self::Bag(Box::new(planish::bag::BagWriter::create(output)?)));
            #[cfg(not(feature = "mcap"))]
            bail!("{}: this planish was built without the feature mcap", output.display());
        }
        Ok(Self::Tum(TumRecorder::create(output)?))
    }

    /// Returns the same errors as [`Self::create`], but creates nothing.
    fn check(output: &std::path::Path) -> Result<()> {
        if super::checks::is_mcap(output) {
            return super::checks::check_is_new(output);
        }
        Ok(TumRecorder::create(output).map(drop)?)
    }

    fn add(&mut self, source: &str, frame: &OwnedFrame) -> Result<()> {
        match (self, frame) {
            (Self::Tum(recorder), OwnedFrame::Depth(frame)) => Ok(recorder.add(frame)?),
            (Self::Tum(_), _) => {
                bail!(
                    "{source}: the source delivers clouds, which a data set in TUM layout cannot store; write a \
                     recording (.mcap) instead"
                )
            }
            #[cfg(feature = "mcap")]
            (Self::Bag(writer), frame) => Ok(writer.add(frame)?),
        }
    }

    /// Returns a note on unusual depth units or on pixels beyond the layout's range, if there are any.
    fn note(&self) -> Option<String> {
        let recorder = match self {
            Self::Tum(recorder) => recorder,
            #[cfg(feature = "mcap")]
            Self::Bag(_) => return None,
        };
        let units = recorder.depth_units_per_metre().filter(|&units| units != 5000.0);
        match (units, recorder.too_far()) {
            (Some(units), _) => {
                Some(format!("depth has {units} units per metre, as camera.json states; TUM's tools expect 5000"))
            }
            (None, 1..) => Some(format!(
                "warning: {} pixels beyond 13.1 m, the layout's limit, became holes; a recording (.mcap) keeps them",
                recorder.too_far()
            )),
            (None, 0) => None,
        }
    }

    fn finish(self) -> Result<()> {
        match self {
            Self::Tum(_) => Ok(()),
            #[cfg(feature = "mcap")]
            Self::Bag(writer) => Ok(writer.finish()?),
        }
    }
}

pub fn run(args: &RecordArgs) -> Result<ExitCode> {
    let longest = args.source.limits.max_duration()?;
    super::checks::check_not_input(std::path::Path::new(args.source.name()), &args.folder, None)?;
    Recorder::check(&args.folder)?;
    // Opening may take seconds. Until it is done, a signal ends the command at once.
    let stop = Arc::default();
    let mut source = open_source(&args.source, &stop)?;
    stop_by(&stop);
    source.end_with(Arc::clone(&stop));
    let mut recorder = Recorder::create(&args.folder)?;
    let start = Instant::now();
    let mut frames = 0;
    let is_over = |frames| {
        stop.load(Ordering::Relaxed)
            || args.source.limits.frames.is_some_and(|most| frames >= most)
            || longest.is_some_and(|longest| start.elapsed() >= longest)
    };
    let (mut unreadable, mut failures_in_a_row) = (0, 0);
    let mut result = Ok(());
    while !is_over(frames) {
        match source.next_frame() {
            Ok(None) => break,
            Ok(Some(frame)) => {
                failures_in_a_row = 0;
                if let Err(error) = recorder.add(args.source.name(), &frame) {
                    result = Err(error);
                    break;
                }
                frames += 1;
            }
            // An unreadable frame is skipped; a disconnected camera ends the recording, which keeps its frames.
            Err(error) => {
                failures_in_a_row += 1;
                if matches!(error, Error::Device(_)) || failures_in_a_row == MOST_FAILURES {
                    result = Err(error.into());
                    break;
                }
                unreadable += 1;
                if let Some(warning) = unreadable_warning(&error, unreadable) {
                    errln!("warning: {warning}");
                }
            }
        }
    }
    let note = recorder.note();
    if frames > 0 || result.is_ok() {
        match (recorder.finish(), &result) {
            (Ok(()), Ok(())) => {}
            (Ok(()), Err(_)) => errln!("{} contains {frames} complete frames", args.folder.display()),
            (Err(error), Ok(())) => result = Err(error),
            // A full disk may have no room for the index either.
            (Err(error), Err(_)) => {
                let name = args.folder.display();
                errln!("{error:#}; {name}.part contains {frames} frames: run `planish recover {name}.part`");
            }
        }
    }
    if let Some(note) = note {
        errln!("{note}");
    }
    result?;
    let report = Report { frames, dropped: source.dropped(), unreadable, seconds: start.elapsed().as_secs_f64() };
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else if frames > 0 {
        outln!("{frames} frames in {:.1} s, {} dropped -> {}", report.seconds, report.dropped, args.folder.display());
    }
    if frames == 0 {
        errln!("{}: the source delivered no frames; nothing was recorded", args.source.name());
    }
    let is_empty = frames == 0 && !stop.load(Ordering::Relaxed);
    Ok(if unreadable > 0 || is_empty { ExitCode::from(1) } else { ExitCode::SUCCESS })
}
