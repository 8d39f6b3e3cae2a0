//! Compares the time of a C call with that of the Rust call (depth to points in the caller's buffer), in alternating
//! runs.
//!
//! `cargo bench -p planish-c` checks that the results are equal, then prints both medians and their ratio.

use std::ffi::c_void;
use std::ptr;
use std::time::Instant;

use planish::{Camera, DepthView, Session, SmoothedMut};
use planish_c::{
    PLANISH_DEPTH_U16, PLANISH_OK, planish_camera, planish_frame, planish_output, planish_session,
    planish_session_free, planish_session_new, planish_smooth,
};

const RUNS: usize = 100;

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn main() {
    // `cargo test` also runs benchmarks, to check that they work; one run is enough for that.
    let runs = if std::env::args().any(|argument| argument == "--bench") { RUNS } else { 1 };
    let camera = Camera::kinect_v1();
    let (width, height) = (camera.width, camera.height);
    let raw: Vec<u16> = (0..width * height).map(|i| 1500 + ((i * 7919) % 9) as u16 + (i % width / 4) as u16).collect();
    let mut session = Session::new("engine=cpu".parse().unwrap()).unwrap();
    let mut of_rust = vec![[0f32; 3]; raw.len()];
    let mut of_c = vec![[0f32; 3]; raw.len()];

    let given = planish_camera {
        size: size_of::<planish_camera>(),
        width,
        height,
        fx: camera.fx,
        fy: camera.fy,
        cx: camera.cx,
        cy: camera.cy,
        depth_units_per_metre: 1000.0,
        distortion_model: ptr::null(),
        distortion: ptr::null(),
        distortion_count: 0,
    };
    let frame = planish_frame {
        size: size_of::<planish_frame>(),
        kind: PLANISH_DEPTH_U16,
        width,
        height,
        data: raw.as_ptr().cast::<c_void>(),
        row_stride: 0,
        point_stride: 0,
        offsets: [0; 3],
        planes: [ptr::null(); 3],
        camera: &given,
        pose: ptr::null(),
        origin_m: ptr::null(),
        rgb: ptr::null(),
    };
    let output = planish_output {
        size: size_of::<planish_output>(),
        count: raw.len(),
        points: of_c.as_mut_ptr().cast(),
        points_stride: 0,
        normals: ptr::null_mut(),
        normals_stride: 0,
        curvature: ptr::null_mut(),
        status: ptr::null_mut(),
        neighbours: ptr::null_mut(),
        depth: ptr::null_mut(),
        depth_m: ptr::null_mut(),
        frames: ptr::null_mut(),
        sigma: ptr::null_mut(),
        gaps_from: ptr::null(),
    };
    let mut handle: *mut planish_session = ptr::null_mut();
    // SAFETY: the text ends with a zero, and the handle is writable.
    assert_eq!(unsafe { planish_session_new(c"engine=cpu".as_ptr(), &mut handle) }, PLANISH_OK);

    let (mut rust_ms, mut c_ms) = (Vec::new(), Vec::new());
    for run in 0..runs + 3 {
        let start = Instant::now();
        let out = SmoothedMut::new().with_points(&mut of_rust);
        session.smooth_into(DepthView::new(&raw, &camera).unwrap(), out).unwrap();
        let rust = 1e3 * start.elapsed().as_secs_f64();
        let start = Instant::now();
        // SAFETY: the structs are complete, and their memory lives as long as the call.
        let code = unsafe { planish_smooth(handle, &frame, &output) };
        let c = 1e3 * start.elapsed().as_secs_f64();
        assert_eq!(code, PLANISH_OK);
        if run >= 3 {
            rust_ms.push(rust);
            c_ms.push(c);
        }
    }
    let bits = |points: &[[f32; 3]]| points.iter().map(|point| point.map(f32::to_bits)).collect::<Vec<_>>();
    assert!(bits(&of_rust) == bits(&of_c), "the results differ");
    assert_eq!(planish_session_free(handle), PLANISH_OK);
    if runs > 1 {
        let (rust, c) = (median(rust_ms), median(c_ms));
        println!("{width}x{height}, default: Rust {rust:.3} ms, C {c:.3} ms, ratio {:.4}", c / rust);
    }
}
