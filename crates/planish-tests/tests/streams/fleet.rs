//! Fleets of several CPUs: order, shares, errors of frames, and lost devices.

use std::sync::Arc;

use planish::internal::lose_fleet_device;
use planish::{
    Engine, EngineError, Error, Fleet, FleetDevice, FrameError, FrameParams, GpuOptions, OrganizedCloud, Outputs,
    PointCloud, Smoothed, SmoothedView, SmootherOptions, Xyz,
};

const SHAPE: (usize, usize) = (32, 24);

/// Returns a wall at the given distance in metres.
fn wall(z_m: f32) -> Arc<OrganizedCloud> {
    let points: Xyz = (0..SHAPE.0 * SHAPE.1).map(|i| [0.002 * (i % 32) as f32, 0.002 * (i / 32) as f32, z_m]).collect();
    Arc::new(OrganizedCloud::from_positions(SHAPE.0, SHAPE.1, points).unwrap())
}

fn on_cpus(count: usize) -> Fleet {
    let slots = GpuOptions::default().with_slots(3);
    let options = SmootherOptions::new(Engine::Cpu, Outputs::POINTS).with_threads(Some(1)).with_gpu(slots);
    Fleet::open(FrameParams::paper(), &options, &vec![FleetDevice::Cpu; count], SHAPE).unwrap()
}

fn middle(view: &SmoothedView) -> f32 {
    view.points().unwrap()[2][SHAPE.0 * SHAPE.1 / 2 + 16]
}

#[test]
fn results_come_in_the_order_of_submission_and_every_device_has_its_share() {
    let mut fleet = on_cpus(3);
    assert_eq!(fleet.max_in_flight(), 18);
    let (mut next, mut submitted) = (0, 0);
    while next < 200 {
        if submitted < 200 && fleet.in_flight() < fleet.max_in_flight() {
            let frame = wall(1.0 + 0.01 * submitted as f32);
            if submitted % 2 == 0 {
                fleet.submit(frame, Smoothed::default()).unwrap();
            } else {
                fleet.submit_in_place(frame).unwrap();
            }
            submitted += 1;
        } else {
            let view = fleet.receive().unwrap().unwrap();
            assert!((middle(&view) - (1.0 + 0.01 * next as f32)).abs() < 1e-5, "{next}");
            next += 1;
        }
    }
    assert!(fleet.receive().unwrap().is_none());
    let members = fleet.members();
    assert_eq!(members.iter().map(|member| member.frames).sum::<u64>(), 200);
    assert!(members.iter().all(|member| member.frames > 0 && member.lost.is_none()), "{members:?}");
}

#[test]
fn what_is_wrong_with_a_frame_is_said_at_once_or_in_its_place() {
    let mut fleet = on_cpus(2);
    let general = Arc::new(PointCloud::new(Xyz::default()));
    assert!(matches!(fleet.submit_in_place(general), Err(Error::Frame(FrameError::GridMismatch { .. }))));
    for z_m in [1.0, 2.0] {
        fleet.submit_in_place(wall(z_m)).unwrap();
    }
    assert_eq!(fleet.in_flight(), 2);
    for z_m in [1.0, 2.0] {
        assert!((middle(&fleet.receive().unwrap().unwrap()) - z_m).abs() < 1e-5);
    }
    // Fill the fleet before any result is received; a further frame is refused.
    (0..fleet.max_in_flight()).for_each(|_| fleet.submit_in_place(wall(1.0)).unwrap());
    assert!(matches!(fleet.submit_in_place(wall(1.0)), Err(Error::Engine(EngineError::Full { in_flight: 12 }))));
    let depth = SmootherOptions::new(Engine::Cpu, Outputs::DEPTH);
    let mut fleet = Fleet::open(FrameParams::paper(), &depth, &[FleetDevice::Cpu], SHAPE).unwrap();
    fleet.submit_in_place(wall(1.0)).unwrap();
    assert!(matches!(fleet.receive(), Err(Error::Frame(FrameError::MissingCamera { .. }))));
    assert!(matches!(fleet.receive(), Ok(None)));
    assert!(Fleet::open(FrameParams::paper(), &depth, &[], SHAPE).is_err());
}

#[test]
fn a_device_that_is_lost_hands_its_frames_to_the_others() {
    let mut fleet = on_cpus(2);
    let lost = || EngineError::Lost { device: "one".into(), reason: "by a test".into() };
    (0..8).for_each(|i| fleet.submit_in_place(wall(1.0 + 0.01 * i as f32)).unwrap());
    lose_fleet_device(&fleet, 1, &lost());
    assert_eq!(fleet.max_in_flight(), 12);
    for i in 0..8 {
        let view = fleet.receive().unwrap().unwrap();
        assert!((middle(&view) - (1.0 + 0.01 * i as f32)).abs() < 1e-5, "{i}");
    }
    assert_eq!(fleet.members()[1].lost, Some(lost()));
    // If the last device is lost too, every frame reports the loss, and no call waits forever.
    fleet.submit_in_place(wall(1.0)).unwrap();
    lose_fleet_device(&fleet, 0, &lost());
    let result = fleet.receive();
    assert!(matches!(result, Ok(Some(_)) | Err(Error::Engine(EngineError::Lost { .. }))));
    assert!(matches!(fleet.submit_in_place(wall(1.0)), Err(Error::Engine(EngineError::Lost { .. }))));
    assert!(matches!(fleet.receive(), Ok(None)));
}
