//! `planish-ros`: a ROS 2 node that smooths depth images and clouds. It does not need a ROS installation.

mod arguments;
mod diagnostics;
mod inbox;
mod node;
mod poses;
mod settings;

use std::io::{self, Write};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use arguments::{Arguments, NODE_NAME};

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if arguments.iter().any(|argument| argument == "--help" || argument == "-h") {
        // A reader that has seen enough may close the pipe.
        let _ = print_help();
        return ExitCode::SUCCESS;
    }
    if arguments.iter().any(|argument| argument == "--version") {
        println!("planish-ros {}", env!("CARGO_PKG_VERSION"));
        return ExitCode::SUCCESS;
    }
    set_up_memory();
    // SAFETY: no other thread is running yet.
    unsafe { planish::silence_vulkan_drivers() };
    end_on_panics();
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    let run = || {
        planish::start_shared_threads()?;
        ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed))?;
        node::run(&Arguments::parse(arguments)?, &stop)
    };
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", planish::io::printable(&format!("{error:#}")));
            ExitCode::FAILURE
        }
    }
}

/// Ends the process when any thread panics, so that a launch file can restart it. Without its DDS threads, the node
/// would continue to run without any effect.
fn end_on_panics() {
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        // Some decoders panic on damaged messages, which the library catches.
        if !planish::io::internal::catches_panics() {
            usual(panic);
            std::process::exit(101);
        }
    }));
}

/// Configures the allocator in two ways. The memory of freed messages returns to the system. Otherwise the process
/// would keep about a gigabyte, since messages are freed by a different thread from the one that allocated them. The
/// heap grows in large steps, so that a message can grow within one step while it is written, and the pages need not be
/// cleared for each message.
fn set_up_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        const M_TOP_PAD: i32 = -2;
        const M_MMAP_THRESHOLD: i32 = -3;
        unsafe extern "C" {
            fn mallopt(parameter: i32, value: i32) -> i32;
        }
        for (parameter, bytes) in [(M_MMAP_THRESHOLD, 128 << 10), (M_TOP_PAD, 64 << 20)] {
            // SAFETY: the C library's own function, with parameters that it defines; no other thread runs yet.
            unsafe { mallopt(parameter, bytes) };
        }
    }
}

fn print_help() -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(
        out,
        "A ROS 2 node that smooths depth images and clouds.

Usage: planish-ros [--ros-args [-r FROM:=TO]... [-p NAME:=VALUE]... [--params-file FILE]...]

Topics, all of which can be remapped (-r); the node is /{NODE_NAME} (-r __node:=, -r __ns:=):
  image_rect       in: depth, 16UC1 (millimetres) or 32FC1 (metres)
  camera_info      in: its camera
  input            in: clouds, with -p input:=points
  /tf, /tf_static  in: the camera's poses, with -p poses:=tf; /tf_static with -p poses:=odometry, too
  odom             in: the robot's poses, with -p poses:=odometry
  pose             in: the camera's poses, with -p poses:=pose or pose_with_covariance
  points           out: smoothed clouds
  image_smoothed   out: smoothed depth, with -p publish_depth:=true
  normals          out: an image of normals, with -p publish_normals:=true
  origin           out: with fill or temporal and publish_depth, where each pixel of image_smoothed comes from (mono8):
                   0 a hole, 85 filled, 170 carried over from the previous frame, 255 measured
  /diagnostics     out: rates, drops and latencies

Parameters (-p, * can be changed while the node runs):"
    )?;
    for (name, default, changes, what) in settings::declared() {
        let mark = if changes { "*" } else { " " };
        writeln!(out, "  {mark} {name:16} {what} [{}]", shown(&default))?;
    }
    Ok(())
}

fn shown(value: &ros2_client::ParameterValue) -> String {
    use ros2_client::ParameterValue::{Boolean, Double, Integer, String};
    match value {
        Boolean(value) => value.to_string(),
        Integer(value) => value.to_string(),
        Double(value) => value.to_string(),
        String(value) => value.clone(),
        other => format!("{other:?}"),
    }
}
