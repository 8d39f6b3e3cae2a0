//! A live stream for five seconds: a Kinect if its name is given, else the simulator.
//! `cargo run --release --example 02_live_stream -- kinect`

use std::sync::atomic::AtomicBool;
use std::time::Duration;

use planish::source::{self, SourceOptions};
use planish::stream::{self, Sink, StreamEvent, StreamFrame, StreamOptions};
use planish::{Error, FrameParams, SmootherOptions};

/// What to do with each result.
struct MeanDepth;

impl Sink for MeanDepth {
    fn name(&self) -> String {
        "mean depth".to_owned()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        let depths = frame.smoothed.points.z.iter().filter(|z| z.is_finite());
        let (count, sum) = depths.fold((0, 0.0), |(count, sum), z| (count + 1, sum + z));
        println!(
            "frame {}: {count} points, {:.3} m in the mean, {:?} old",
            frame.index,
            sum / count as f32,
            frame.latency
        );
        Ok(())
    }
}

fn main() -> Result<(), Error> {
    let name = std::env::args().nth(1).unwrap_or_else(|| "synthetic".to_owned());
    // Paced as a camera, where the source is none.
    let fps = (!name.starts_with("kinect")).then_some(30.0);
    let source = source::open(&name, &SourceOptions::default().with_fps(fps))?;
    let options = StreamOptions::new(FrameParams::default(), SmootherOptions::default())
        .with_max_duration(Some(Duration::from_secs(5)));
    let statistics = stream::run(source, &options, vec![Box::new(MeanDepth)], &AtomicBool::new(false), |event| {
        if let StreamEvent::Warning(warning) = event {
            eprintln!("{warning}");
        }
    })?;
    println!("{:.1} frames a second, {:?}", statistics.fps(), statistics.latency());
    Ok(())
}
