//! A rig whose GPU is lost.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use planish::rig::{Rig, RigCamera, RigEvent, RigFrame, RigOptions, RigSink, RigStream, RigWay};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::source::Source;
use planish::{DepthFrame, Engine, Error, GpuOptions, Outputs, SensorPose, Smoothed, Smoother, SmootherOptions, Xyz};
use planish_tests::data::skip;
use planish_tests::engines::test_adapter;
use planish_tests::scenes::small_camera;
use planish_tests::sources::OneByOne;

const MOMENTS: u64 = 9;

/// Counts moments and keeps their points.
struct Kept(Arc<AtomicU64>, Arc<Mutex<Vec<[Xyz; 2]>>>);

impl RigSink for Kept {
    fn name(&self) -> String {
        "kept".to_owned()
    }

    fn write(&mut self, frame: &RigFrame) -> Result<(), Error> {
        let points = |i: usize| frame.cameras[i].as_ref().unwrap().smoothed.points.clone();
        self.1.lock().unwrap().push([points(0), points(1)]);
        self.0.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }
}

#[test]
fn a_rig_s_lost_gpu_is_opened_once_more_and_then_the_cpu_takes_over_with_every_frame() {
    let _alone = crate::alone();
    let Some(adapter) = test_adapter() else {
        skip("a rig whose GPU is lost: no adapter");
        return;
    };
    let camera = small_camera();
    let frames = [1, 2].map(|seed| {
        let (scene, pose) = Scene::tabletop(seed);
        let truth = scene.render(&camera, &pose);
        DepthSimulator::new(DepthNoise::default(), camera, seed).frame(&truth, 0).unwrap()
    });
    let rig = Rig::new(["a", "b"].map(|name| RigCamera::new(name, SensorPose::IDENTITY)).to_vec()).unwrap();
    let (count, kept) = (Arc::new(AtomicU64::new(0)), Arc::new(Mutex::new(Vec::new())));
    let source = |(i, frame): (usize, &DepthFrame)| {
        let source = OneByOne::new(frame.clone(), MOMENTS, Arc::clone(&count));
        let lost_before: &[u64] = if i == 0 { &[3, 6] } else { &[] };
        Box::new(source.losing_gpus_before(lost_before)) as Box<dyn Source>
    };
    let sources = frames.iter().enumerate().map(source).collect();
    let gpu = GpuOptions::default().with_adapter(adapter.index.to_string());
    let options = SmootherOptions::new(Engine::Gpu, Outputs::POINTS).with_gpu(gpu);
    let options = RigOptions::new(&rig, RigWay::Each, options);
    let (mut warnings, mut gpu_moments) = (Vec::new(), 0);
    let sinks: Vec<Box<dyn RigSink>> = vec![Box::new(Kept(Arc::clone(&count), Arc::clone(&kept)))];
    let statistics = RigStream::new(&rig, sources, options.clone())
        .with_sinks(sinks)
        .with_events(|event| match event {
            RigEvent::Warning(warning) => warnings.push(warning),
            RigEvent::Moment(statistics) => gpu_moments += u64::from(statistics.moments.engine == Engine::Gpu),
            _ => {}
        })
        .run()
        .unwrap();
    assert_eq!(
        (statistics.moments.frames_out, statistics.complete, gpu_moments),
        (MOMENTS, MOMENTS, 6),
        "{warnings:?}"
    );
    assert_eq!(warnings.len(), 2, "{warnings:?}");
    assert!(warnings[0].contains("reopening") && warnings[1].contains("CPU"), "{warnings:?}");
    // Each camera's results, from the GPU and later from the CPU, equal those of the CPU alone.
    for (i, frame) in frames.iter().enumerate() {
        let mut alone = Smoothed::default();
        Smoother::open(options.params[i].at_resolution_of(frame), Engine::Cpu, (160, 120))
            .unwrap()
            .smooth(frame, &mut alone)
            .unwrap();
        for moment in kept.lock().unwrap().iter() {
            let apart =
                alone.points.z().iter().zip(moment[i].z()).filter(|(a, b)| a.is_finite() && (**a - **b).abs() > 1e-5);
            assert!(apart.count() * 1000 < alone.points.len());
        }
    }
}
