//! Smooths the unorganized clouds of a recording, and writes one file per cloud.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use planish::bag::BagSource;
use planish::io::internal::create_output_folder;
use planish::io::{self, Encoding};
use planish::source::unreadable_warning;
use planish::{Outputs, PointCloud, Session, Settings, Smoothed};
use planish_bench::{errln, outln};

use crate::args::SmoothArgs;
use crate::exit::ExitCode;
use crate::signals::{INTERRUPTED, stop_flag};

/// Smooths the clouds of a recording's topic into a folder; returns `None` if the first readable message is not an
/// unorganized cloud.
pub(super) fn smooth_clouds(args: &SmoothArgs, input: &Path, settings: &Settings) -> Result<Option<ExitCode>> {
    let topic = args.topics.topic.first().map(String::as_str);
    let camera_topic = args.topics.camera_info_topic.as_deref();
    let camera = args.camera.camera_of_any_shape()?;
    let read = args.reading.read_options();
    let is_without_grid = BagSource::open_with(input, topic, camera_topic, camera, read)?.has_clouds_without_grid();
    if !is_without_grid {
        return Ok(None);
    }
    let extension = match args.format.as_deref().unwrap_or("pcd") {
        "png" => {
            bail!("{}: clouds without a grid cannot be written as images; use --format pcd or ply", input.display())
        }
        format => format.to_ascii_lowercase(),
    };
    create_output_folder(&args.output).with_context(|| args.output.display().to_string())?;
    let mut source = BagSource::open_with(input, topic, camera_topic, camera, read)?;
    let outputs = args.outputs();
    let mut session = Session::new(settings.clone())?;
    session.set_outputs(outputs.with_status(true));
    let (stop, start) = (stop_flag(), Instant::now());
    let (mut written, mut unreadable, mut result) = (0usize, 0usize, Smoothed::default());
    while !stop.load(Ordering::Relaxed) {
        let cloud = match source.next_cloud() {
            Ok(Some((cloud, _))) => cloud,
            Ok(None) => break,
            Err(error) => {
                unreadable += 1;
                if let Some(warning) = unreadable_warning(&error, unreadable as u64) {
                    errln!("warning: {warning}");
                }
                continue;
            }
        };
        let output = args.output.join(format!("{:06}.{extension}", written + unreadable));
        if output.exists() && !args.overwrite {
            bail!("{}: already exists; add --overwrite to replace it", output.display());
        }
        let smoothed = smooth(&mut session, cloud, outputs, &mut result);
        session.take_events().iter().for_each(|event| errln!("{}: {event}", output.display()));
        let cloud = smoothed.with_context(|| format!("{}: message {}", input.display(), written + unreadable))?;
        io::write_cloud(&output, &cloud, Encoding::Binary)?;
        written += 1;
    }
    report(args, &session, (written, unreadable), start.elapsed().as_secs_f64());
    if stop.load(Ordering::Relaxed) {
        errln!("{}: stopped; the clouds so far were written", args.output.display());
        return Ok(Some(ExitCode::from(INTERRUPTED)));
    }
    if written == 0 {
        bail!("{}: the recording has no readable clouds", input.display());
    }
    Ok(Some(if unreadable > 0 { ExitCode::from(1) } else { ExitCode::SUCCESS }))
}

fn smooth(
    session: &mut Session,
    mut cloud: PointCloud,
    outputs: Outputs,
    result: &mut Smoothed,
) -> Result<PointCloud, planish::Error> {
    session.smooth(&cloud, result)?;
    cloud.apply(result, outputs)?;
    Ok(cloud)
}

fn report(args: &SmoothArgs, session: &Session, (written, unreadable): (usize, usize), seconds: f64) {
    let engine = session.engine().unwrap_or_default().name();
    let output: &PathBuf = &args.output;
    if args.json {
        let report = serde_json::json!({
            "input": args.input, "output": output, "engine": engine, "frames": written,
            "unreadable": unreadable, "seconds": seconds,
        });
        outln!("{report}");
    } else {
        let clouds = if written == 1 { "1 cloud" } else { &format!("{written} clouds") };
        outln!("{clouds} smoothed in {seconds:.1} s, engine {engine} -> {}", output.display());
    }
}
