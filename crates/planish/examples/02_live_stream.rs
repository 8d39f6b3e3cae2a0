//! Smooths five seconds of a live stream from the named source, such as a Kinect. The default source is the simulator.
//! `cargo run --release --example 02_live_stream -- kinect`

use std::time::Duration;

use planish::source::{self, SourceOptions};
use planish::stream::{Frames, StreamOptions};
use planish::{Error, FrameParams, SmootherOptions};

fn main() -> Result<(), Error> {
    let name = std::env::args().nth(1).unwrap_or_else(|| "synthetic".to_owned());
    // Simulated frames are delivered at a camera's frame rate.
    let fps = (!name.starts_with("kinect")).then_some(30.0);
    let source = source::open(&name, &SourceOptions::default().with_fps(fps))?;
    let options = StreamOptions::new(FrameParams::default(), SmootherOptions::default())
        .with_max_duration(Some(Duration::from_secs(5)));
    let mut frames = Frames::start(source, options)?;
    for frame in &mut frames {
        let frame = frame?;
        let depths = frame.smoothed.points.z().iter().filter(|z| z.is_finite());
        let (count, sum) = depths.fold((0, 0.0), |(count, sum), z| (count + 1, sum + z));
        println!(
            "frame {}: {count} points, mean depth {:.3} m, {:?} old",
            frame.index,
            sum / count as f32,
            frame.latency
        );
    }
    frames.take_warnings().iter().for_each(|warning| eprintln!("{warning}"));
    if let Some(statistics) = frames.statistics() {
        println!("{:.1} frames/s, latency {:?}", statistics.fps(), statistics.latency());
    }
    Ok(())
}
