//! Real frames from the folder `shared/data` next to the checkout, if present. The project does not include them.

use std::io::Write;
use std::path::{Path, PathBuf};

use planish::io::{self, Contents};
use planish::{Camera, OrganizedCloud};

/// Reports that a test is skipped. The test runner would hide the output of `println!` in a passing test.
pub fn skip(what: &str) {
    // A closed standard error is not a reason to fail.
    let _ = writeln!(std::io::stderr(), "SKIP {what}");
}

/// Returns PCL's test cloud, 397 points of the Stanford bunny; its licence is next to the file.
///
/// # Panics
/// If the file cannot be read.
pub fn bunny() -> planish::PointCloud {
    general_cloud(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/data")), "bun0.pcd")
}

/// Returns the folder of real data; prints SKIP and returns `None` if it is absent.
///
/// # Panics
/// If the folder is absent and the environment variable PLANISH_REQUIRE_DATA is set.
pub fn folder(test: &str) -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    if folder.is_dir() {
        Some(folder)
    } else {
        assert!(std::env::var_os("PLANISH_REQUIRE_DATA").is_none(), "no real data at {}", folder.display());
        skip(&format!("{test}: no real data at {}", folder.display()));
        None
    }
}

/// A real frame and its name.
pub struct RealFrame {
    /// Path of the file in the data folder.
    pub name: &'static str,
    /// The cloud; depth images are deprojected.
    pub cloud: OrganizedCloud,
}

fn primesense(depth_units_per_metre: f64) -> Camera {
    Camera::kinect_v1().with_depth_units_per_metre(depth_units_per_metre)
}

/// Returns real frames of every kind: near and far Kinect clouds, and depth images of four sensors and data sets.
///
/// # Panics
/// If a file cannot be read; data that are present must be complete.
pub fn real_frames(test: &str) -> Vec<RealFrame> {
    let Some(folder) = folder(test) else { return Vec::new() };
    let clouds = [
        "kinect/office1.pcd",
        "kinect/milk_cartoon_all_small_clorox.pcd",
        "kinect/capture0001.pcd",
        "kinect/region_growing_rgb_tutorial.pcd",
    ];
    let icl = Camera::new((640, 480), [481.2, 480.0], [319.5, 239.5]).with_depth_units_per_metre(5000.0);
    // The RealSense's intrinsics are not known; these are a D435's at 640x480.
    let realsense = Camera::new((640, 480), [615.0; 2], [320.0, 240.0]);
    let depths = [
        ("tum/TUM_depth.png", primesense(5000.0)),
        ("redwood/depth/00000.png", primesense(1000.0)),
        ("icl/depth_1.png", icl),
        ("realsense/0.png", realsense),
    ];
    let cloud = |name: &'static str| RealFrame {
        name,
        cloud: planish::io::read_organized(&folder.join(name)).expect("a whole file"),
    };
    let depth = |(name, camera): (&'static str, Camera)| {
        let frame = planish::io::read_depth_frame(&folder.join(name), camera).expect("a whole file");
        RealFrame { name, cloud: frame.deproject().expect("a valid frame") }
    };
    clouds.map(cloud).into_iter().chain(depths.map(depth)).collect()
}

/// Reads the file `name` in `folder`, which must be an unorganized cloud.
///
/// # Panics
/// If the file cannot be read or is not an unorganized cloud.
pub fn general_cloud(folder: &Path, name: &str) -> planish::PointCloud {
    match io::read(&folder.join(name)).expect("a whole file").1 {
        Contents::General(cloud) => cloud,
        _ => panic!("{name} is not an unorganized cloud"),
    }
}
