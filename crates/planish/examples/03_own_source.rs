//! Uses your own camera as a source, in 30 lines. `cargo run --release --example 03_own_source`

use planish::source::{OwnedFrame, Source};
use planish::stream::{self, StreamOptions};
use planish::{Camera, DepthFrame, Error, FrameParams, SmootherOptions};

/// A camera that faces a wall moving back and forth.
struct MyCamera {
    camera: Camera,
    frames: u32,
}

impl Source for MyCamera {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        if self.frames == 90 {
            return Ok(None);
        }
        self.frames += 1;
        // A real source would query its driver here. Raw values are in the camera's unit, a millimetre; 0 is a hole.
        let Camera { width, height, .. } = self.camera;
        let wall = 1500.0 + 50.0 * f64::from(self.frames).sin();
        let raw = vec![wall as u16; width * height];
        let mut frame = DepthFrame::new(self.camera, raw)?;
        frame.timestamp_s = Some(f64::from(self.frames) / 30.0);
        Ok(Some(OwnedFrame::Depth(frame)))
    }

    /// Returns true for a camera that produces frames whether or not they are read.
    fn is_live(&self) -> bool {
        false
    }
}

fn main() -> Result<(), Error> {
    let source = MyCamera { camera: Camera::kinect_v1(), frames: 0 };
    let options = StreamOptions::new(FrameParams::default(), SmootherOptions::default());
    let statistics = stream::Stream::new(Box::new(source), options).run()?;
    println!("{} frames, {:.1} frames/s", statistics.frames_out, statistics.fps());
    Ok(())
}
