//! Outputs that cannot be written.

use std::fs;

use planish::io;

use super::{ok, refused, str};

#[test]
fn what_cannot_be_written_is_refused_before_anything_is_smoothed() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = folder.path().join("cloud.csv");
    let line = |i: usize| format!("{},{},0,20.5\n", i % 30, i / 30);
    fs::write(&cloud, format!("x,y,z,temperature\n{}", (0..900).map(line).collect::<String>())).unwrap();
    for (name, said) in [
        ("a.bin", "temperature"),
        ("a.png", "an image cannot store points"),
        ("a.obj", "can be read but not written"),
        ("none/a.ply", "does not exist"),
    ] {
        let output = folder.path().join(name);
        let message = refused(&["smooth", str(&cloud), str(&output)]);
        assert!(message.contains(name.rsplit('/').next().unwrap()) && message.contains(said), "{message}");
        assert!(!message.contains("neighbours per point"), "before it is smoothed: {message}");
        let message = refused(&["clean", "--voxel", "0.5", str(&cloud), str(&output)]);
        assert!(message.contains(name.rsplit('/').next().unwrap()) && message.contains(said), "{message}");
        assert!(!output.exists());
    }
    // The format cannot hold added fields, but points can always be removed.
    let lidar = folder.path().join("lidar.bin");
    fs::write(&lidar, [1.0f32, 2.0, 3.0, 0.5].map(f32::to_le_bytes).concat().repeat(100)).unwrap();
    let message = refused(&["smooth", str(&lidar), str(&folder.path().join("n.bin")), "--fields", "normals"]);
    assert!(message.contains("normal_x") && !message.contains("neighbours per point"), "{message}");
    let outlier = folder.path().join("outlier.csv");
    fs::write(&outlier, "x,y,z,intensity\n9,9,9,1000000000\n0,0,0,5\n0,1,0,6\n").unwrap();
    ok(&["clean", str(&outlier), str(&folder.path().join("o.las")), "--crop=-1,-1,-1,2,2,2"]);
    // For an option with two values, the error names the invalid one.
    let output = folder.path().join("o.ply");
    let wrong = |value: &str| refused(&["clean", str(&cloud), str(&output), "--statistical", value]);
    assert!(wrong("0,2").contains("K of --statistical = 0") && wrong("5,-1").contains("R of --statistical = -1"));
}

#[cfg(unix)]
#[test]
fn a_limit_on_the_size_of_files_leaves_no_half_of_one() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = folder.path().join("cloud.xyz");
    let line = |i: usize| format!("{} {} 0\n", i % 100, i / 100);
    fs::write(&cloud, (0..10_000).map(line).collect::<String>()).unwrap();
    // `ulimit -f` counts in blocks of 512 or 1024 bytes, depending on the shell.
    let limited = "ulimit -f 8; exec \"$0\" smooth \"$1\" \"$2\"";
    let output = folder.path().join("out.ply");
    let ended = std::process::Command::new("sh")
        .args(["-c", limited, env!("CARGO_BIN_EXE_planish"), str(&cloud), str(&output)])
        .output()
        .unwrap();
    let message = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.code() == Some(2) && message.contains("out.ply"), "{:?} {message}", ended.status);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "the cloud alone");
}

#[test]
fn clouds_without_a_grid_of_a_recording_become_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let mut writer = planish::bag::BagWriter::create(&path("lidar.mcap")).unwrap();
    for message in 0..3usize {
        let ring = |i: usize| (0.02 * i as f32).sin_cos();
        let positions = (0..2000).map(|i| [4.0 * ring(i).0, 4.0 * ring(i).1, 0.002 * (i + message) as f32]);
        let mut cloud = planish::PointCloud::new(positions.collect());
        cloud.set_attribute("ring", (0..2000u16).map(|i| i % 32).collect::<Vec<_>>());
        writer.add_cloud(&cloud, None, Some(message as f64)).unwrap();
    }
    writer.finish().unwrap();
    let (input, output) = (path("lidar.mcap"), path("clouds"));
    let said = ok(&["smooth", str(&input), str(&output)]);
    assert!(said.contains("3 clouds smoothed"), "{said}");
    for name in ["000000.pcd", "000001.pcd", "000002.pcd"] {
        let io::Contents::General(cloud) = io::read(&output.join(name)).unwrap().1 else { panic!("points") };
        assert_eq!((cloud.len(), cloud.attributes.len()), (2000, 1));
    }
    assert!(refused(&["smooth", str(&input), str(&output)]).contains("--overwrite"));
    ok(&["smooth", str(&input), str(&output), "--overwrite", "--format", "ply"]);
    assert!(output.join("000002.ply").exists());
    assert!(refused(&["smooth", str(&input), str(&path("p")), "--format", "png"]).contains("pcd or ply"));
}
