//! One frame: read, smoothed, written. `cargo run --release --example 01_one_frame -- frame.pcd smooth.pcd`

use planish::io::{Encoding, write_cloud};
use planish::{Engine, Error, FrameParams, OrganizedCloud, Outputs, Smoothed, Smoother};

fn main() -> Result<(), Error> {
    let files: Vec<String> = std::env::args().skip(1).collect();
    let [input, output] = &files[..] else {
        eprintln!("usage: 01_one_frame FRAME.pcd SMOOTH.pcd");
        std::process::exit(2);
    };
    let mut cloud = planish::io::read_organized(input.as_ref())?;
    let params = FrameParams::default().at_resolution_of(&cloud);
    let mut smoother = Smoother::open(params, Engine::Auto, (cloud.width(), cloud.height()))?;
    let mut smoothed = Smoothed::default();
    smoother.smooth(&cloud, &mut smoothed)?;
    cloud.points.apply(&smoothed, Outputs::POINTS)?;
    write_cloud(output.as_ref(), &cloud, Encoding::Binary)?;
    println!("{} points by the {} engine", cloud.points.valid_points(), smoother.engine().name());
    Ok(())
}
