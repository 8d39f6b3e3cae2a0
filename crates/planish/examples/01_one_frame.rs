//! Reads, smooths and writes one frame. `cargo run --release --example 01_one_frame -- frame.pcd smooth.pcd`

use planish::io::{Encoding, read_organized, write_cloud};
use planish::{Error, Outputs, Settings};

fn main() -> Result<(), Error> {
    let files: Vec<String> = std::env::args().skip(1).collect();
    let [input, output] = &files[..] else {
        eprintln!("usage: 01_one_frame FRAME.pcd SMOOTH.pcd");
        std::process::exit(2);
    };
    let mut cloud = read_organized(input.as_ref())?;
    let smoothed = planish::smooth(&cloud, &Settings::default())?;
    cloud.points.apply(&smoothed, Outputs::POINTS)?;
    write_cloud(output.as_ref(), &cloud, Encoding::Binary)?;
    println!("{} points", cloud.points.valid_points());
    Ok(())
}
