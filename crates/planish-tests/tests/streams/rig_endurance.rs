//! Eight live cameras for ten minutes, one of them unplugged for a while. The test takes too long for `.ci/run`, and
//! needs more than a few cores.
//!
//! `cargo test --release -p planish-tests --test streams -- --ignored --nocapture`; `PLANISH_ENDURANCE_S` sets the
//! duration in seconds, `PLANISH_ENDURANCE_PX` the width of the frames in pixels.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use planish::rig::{Rig, RigCamera, RigEvent, RigFrame, RigOptions, RigSink, RigStream, RigWay};
use planish::simulate::{DepthNoise, DepthSimulator, RigScene};
use planish::source::{OwnedFrame, Source};
use planish::{Camera, DepthFrame, Engine, Error, Outputs, SensorPose, SmootherOptions};

const CAMERAS: usize = 8;
const UNPLUGGED: usize = 3;
const INTERVAL: Duration = Duration::from_nanos(1_000_000_000 / 30);

/// Plays frames repeatedly at their due times; drops frames that are requested too late, and gives no frames while
/// unplugged.
struct Live {
    frames: Vec<DepthFrame>,
    start: Instant,
    next: u32,
    dropped: u64,
    unplugged: Option<(Duration, Duration)>,
    ended: Arc<AtomicBool>,
}

impl Source for Live {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        loop {
            let due = self.next * INTERVAL;
            let late = self.start.elapsed().saturating_sub(due);
            let is_unplugged = self.unplugged.is_some_and(|(from, until)| (from..until).contains(&due));
            if self.ended.load(Ordering::Relaxed) {
                return Ok(None);
            }
            if late > INTERVAL || is_unplugged {
                self.dropped += u64::from(!is_unplugged);
                self.next += 1;
                if is_unplugged {
                    thread::sleep(due.saturating_sub(self.start.elapsed()));
                }
                continue;
            }
            thread::sleep(due.saturating_sub(self.start.elapsed()));
            let frame = self.frames[self.next as usize % self.frames.len()].clone();
            self.next += 1;
            return Ok(Some(OwnedFrame::Depth(frame.with_timestamp_s(due.as_secs_f64()))));
        }
    }

    fn dropped(&self) -> u64 {
        self.dropped
    }

    fn is_live(&self) -> bool {
        true
    }

    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        self.ended = ended;
    }
}

/// Fuses every moment and counts the points.
struct Fused(Arc<AtomicU64>);

impl RigSink for Fused {
    fn name(&self) -> String {
        "fused".to_owned()
    }

    fn write(&mut self, frame: &RigFrame) -> Result<(), Error> {
        self.0.fetch_add(frame.fused()?.len() as u64, Ordering::Relaxed);
        Ok(())
    }
}

/// Returns the resident memory of this process in MiB, or `None` if the system does not report it.
fn resident_mb() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? / 1024)
}

#[test]
#[ignore = "takes ten minutes"]
fn eight_cameras_lose_nothing_but_the_frames_of_the_one_that_is_unplugged_and_memory_stays() {
    let number = |name: &str, default: f64| std::env::var(name).map_or(default, |text| text.parse().unwrap());
    let duration = Duration::from_secs_f64(number("PLANISH_ENDURANCE_S", 600.0));
    let width = number("PLANISH_ENDURANCE_PX", 640.0) as usize;
    let scale = width as f64 / 640.0;
    let camera = Camera::new((width, width * 3 / 4), [525.0 * scale; 2], [319.5 * scale, 239.5 * scale]);
    let scene = RigScene::tabletop(1, CAMERAS);
    let rig = Rig::new((0..CAMERAS).map(|i| RigCamera::new(&format!("camera{i}"), SensorPose::IDENTITY)).collect());
    let frames: Vec<Vec<DepthFrame>> = scene
        .poses
        .iter()
        .zip(0..)
        .map(|(pose, seed)| {
            let truth = scene.scene.render(&camera, pose);
            let simulator = DepthSimulator::new(DepthNoise::default(), camera, seed);
            (0..4).map(|i| simulator.frame(&truth, i).unwrap()).collect()
        })
        .collect();
    let start = Instant::now();
    let source = |(i, frames): (usize, Vec<DepthFrame>)| {
        let unplugged = (i == UNPLUGGED).then_some((duration / 3, duration / 2));
        Box::new(Live { frames, start, next: 0, dropped: 0, unplugged, ended: Arc::default() }) as Box<dyn Source>
    };
    let sources = frames.into_iter().enumerate().map(source).collect();
    let (rig, points) = (rig.unwrap(), Arc::new(AtomicU64::new(0)));
    let options = RigOptions::new(&rig, RigWay::Each, SmootherOptions::new(Engine::Auto, Outputs::POINTS))
        .with_max_duration(Some(duration));
    let sinks: Vec<Box<dyn RigSink>> = vec![Box::new(Fused(Arc::clone(&points)))];
    let (mut memory, mut next, mut warnings) = (Vec::new(), Duration::ZERO, Vec::new());
    let statistics = RigStream::new(&rig, sources, options)
        .with_sinks(sinks)
        .with_events(|event| match event {
            RigEvent::Warning(warning) => warnings.push(warning),
            _ if start.elapsed() >= next => {
                next += duration / 20;
                memory.extend(resident_mb());
            }
            _ => {}
        })
        .run()
        .unwrap();
    let of = &statistics.moments;
    let (latency, mean_ms) = (of.latency(), 1e3 * of.time_in_sinks.as_secs_f64() / of.frames_out.max(1) as f64);
    eprintln!("{} moments, {} complete; {latency:?}; {mean_ms:.1} ms in the sink", of.frames_out, statistics.complete);
    eprintln!("{:#?}\nmemory, MB: {memory:?}", statistics.cameras);
    eprintln!("{} points; {warnings:?}", points.load(Ordering::Relaxed));
    assert_eq!((of.dropped, of.dropped_by_sinks, of.failed_sinks), (0, 0, 0));
    for (i, camera) in statistics.cameras.iter().enumerate() {
        assert_eq!((camera.dropped, camera.unreadable, camera.out_of_order), (0, 0, 0), "{camera:?}");
        let expected = if i == UNPLUGGED { 5.0 / 6.0 } else { 1.0 } * duration.as_secs_f64() * 30.0;
        assert!(camera.frames_out as f64 > 0.98 * expected - 90.0, "{camera:?}");
    }
    // After the first fifth of the time everything is open, so memory must stay about constant.
    let settled = &memory[memory.len() / 5..];
    let (least, most) = (settled.iter().min(), settled.iter().max());
    assert!(least.zip(most).is_none_or(|(least, most)| most - least < 50 + least / 10), "{memory:?}");
}
