//! The cost of interleaved points and normals in the caller's buffers, compared with separate planes.
//!
//! Run `cargo bench -p planish-tests --bench buffers`. The layouts alternate frame by frame, so changes in the
//! machine's speed affect all layouts alike. The ratio is the median over the rounds.

use std::time::Instant;

use planish::{FrameParams, Outputs, SimdLevel, Smoothed, SmoothedMut, Smoother, SmootherOptions, Xyz};
use planish_tests::engines::TestEngine;
use planish_tests::scenes::simulated;

const ROUNDS: usize = 200;

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    let camera = planish::Camera::kinect_v1();
    let outputs = Outputs::POINTS.with_normals(true);
    let options = SmootherOptions::new(planish::Engine::Cpu, outputs);
    for (scene, cloud) in [("table", simulated(1, false, camera)), ("room", simulated(1, true, camera))] {
        for (setting, params) in [("paper", FrameParams::paper()), ("default", FrameParams::default())] {
            let shape = (cloud.width(), cloud.height());
            let mut smoother = Smoother::open_with(params, &options, shape).expect("the CPU engine");
            let len = cloud.points.len();
            let mut owned = Smoothed::default();
            let (mut points, mut normals) = (Xyz::filled(len, 0.0), Xyz::filled(len, 0.0));
            let (mut rows, mut normal_rows) = (vec![[0f32; 3]; len], vec![[0f32; 3]; len]);
            let (mut rows4, mut normal_rows4) = (vec![[0f32; 4]; len], vec![[0f32; 4]; len]);
            let mut times_ms: [Vec<f64>; 4] = Default::default();
            for round in 0..ROUNDS + 5 {
                for turn in 0..4 {
                    // Each round begins with a different layout.
                    let layout = (turn + round) % 4;
                    let start = Instant::now();
                    let result = match layout {
                        0 => smoother.smooth(&cloud, &mut owned),
                        1 => smoother.smooth_into(
                            &cloud,
                            SmoothedMut::new().with_points(&mut points).with_normals(&mut normals),
                        ),
                        2 => smoother.smooth_into(
                            &cloud,
                            SmoothedMut::new().with_points(&mut rows).with_normals(&mut normal_rows),
                        ),
                        _ => smoother.smooth_into(
                            &cloud,
                            SmoothedMut::new().with_points(&mut rows4).with_normals(&mut normal_rows4),
                        ),
                    };
                    let time_ms = start.elapsed().as_secs_f64() * 1e3;
                    result.expect("a result");
                    if round >= 5 {
                        times_ms[layout].push(time_ms);
                    }
                }
            }
            let expected = TestEngine::cpu(SimdLevel::best()).smooth_to(&cloud, params, outputs);
            let bits = |v: [f32; 3]| v.map(f32::to_bits);
            for i in 0..len {
                let [x, y, z, _] = rows4[i];
                let found = [owned.points.get(i), points.get(i), rows[i], [x, y, z]];
                assert!(found.iter().all(|v| bits(*v) == bits(expected.points.get(i))), "a wrong result");
            }
            println!("{scene}, {setting}: our planes {:.2} ms", median(times_ms[0].clone()));
            for (layout, name) in [(1, "the caller's planes"), (2, "rows of three"), (3, "rows of four")] {
                let ratios = times_ms[layout].iter().zip(&times_ms[0]).map(|(time, own)| time / own).collect();
                println!("  {name}: {:.3} times", median(ratios));
            }
        }
    }
}
