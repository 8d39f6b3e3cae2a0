//! Links, names and cameras that others prepared.

use std::fs;

use planish::DepthImage;

use super::{CAMERA, ok, planish, refused, small_frame, str, text};

fn image() -> DepthImage {
    DepthImage { width: 160, height: 120, raw: small_frame(1).raw }
}

#[cfg(unix)]
#[test]
fn links_in_an_output_folder_are_not_followed() {
    use std::os::unix::fs::symlink;
    let folder = tempfile::tempdir().unwrap();
    let [input, output, victim] = ["in", "out", "victim.png"].map(|name| folder.path().join(name));
    fs::create_dir(&input).unwrap();
    fs::create_dir(&output).unwrap();
    planish::io::write_depth(&input.join("1.png"), &image()).unwrap();
    fs::write(&victim, "mine").unwrap();
    let manual = folder.path().join("manual");
    fs::create_dir(&manual).unwrap();
    symlink(&victim, output.join("1.png")).unwrap();
    symlink(&victim, manual.join("planish.1")).unwrap();
    for arguments in [
        &["smooth", str(&input), str(&output), "--camera", CAMERA][..],
        &["smooth", str(&input), str(&output), "--camera", CAMERA, "--overwrite"],
        &["man", str(&manual)],
    ] {
        let result = planish(arguments);
        let error = text(&result.stderr);
        assert!(!result.status.success() && error.contains("link"), "{arguments:?}: {error}");
        assert_eq!(fs::read(&victim).unwrap(), b"mine", "{arguments:?}");
    }
    // A link named on the command line is the user's own, and so is the folder.
    let [alias, linked] = ["alias", "linked.ply"].map(|name| folder.path().join(name));
    symlink(folder.path(), &alias).unwrap();
    symlink(folder.path().join("target.ply"), &linked).unwrap();
    ok(&["convert", str(&input.join("1.png")), str(&linked), "--camera", CAMERA]);
    assert!(folder.path().join("target.ply").is_file());
    ok(&["smooth", str(&input), str(&alias.join("new")), "--camera", CAMERA]);
    assert!(folder.path().join("new/1.png").is_file());
}

#[test]
fn names_with_line_breaks_imitate_no_message() {
    let folder = tempfile::tempdir().unwrap();
    let missing = folder.path().join("nope\nerror: the disk is gone\u{2028}x.pcd");
    for arguments in [
        &["info", str(&missing)][..],
        &["info", "a.pcd", str(&missing)],
        &["info", "a.pcd", "--max-memory=5\nerror: the disk is gone\u{2028}"],
    ] {
        let error = refused(arguments);
        assert!(!error.contains('\u{2028}') && error.contains("\\u000a"), "{error:?}");
        assert!(!error.lines().any(|line| line.starts_with("error: the disk")), "{error:?}");
    }
}

#[test]
fn every_command_reports_a_lens_that_loses_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let [depth, lens, ply, png] = ["d.png", "lens.json", "o.ply", "o.png"].map(|name| folder.path().join(name));
    planish::io::write_depth(&depth, &image()).unwrap();
    let distortion = "[100, -100, 50, 50, 1000, 3, 3, 3]";
    let text_of = format!("{{\"fx\": 131, \"fy\": 131, \"cx\": 79.5, \"cy\": 59.5, \"distortion\": {distortion}}}");
    fs::write(&lens, text_of).unwrap();
    for arguments in [
        &["smooth", str(&depth), str(&ply)][..],
        &["convert", str(&depth), str(&folder.path().join("c.ply"))],
        &["clean", str(&depth), str(&folder.path().join("v.ply")), "--voxel", "0.01"],
        &["render", str(&depth), str(&png)],
        &["info", str(&depth)],
    ] {
        let result = planish(&[arguments, &["--camera-file", str(&lens)]].concat());
        let printed = text(&result.stdout) + &text(&result.stderr);
        assert_eq!(printed.matches("lens model").count(), 1, "{arguments:?}: {printed}");
    }
}

#[cfg(unix)]
#[test]
fn a_read_only_recording_is_not_completed() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.mcap");
    fs::write(&path, b"\x89MCAP0\r\n").unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o400)).unwrap();
    assert!(refused(&["recover", str(&path)]).contains("read-only"));
    assert_eq!(fs::read(&path).unwrap().len(), 8);
}

#[test]
fn depth_images_are_compared_within_the_limit_of_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("large.png");
    let (width, height) = (3000, 2000);
    planish::io::write_depth(&path, &DepthImage { width, height, raw: vec![1500; width * height] }).unwrap();
    assert!(refused(&["compare", str(&path), str(&path), "--max-memory", "60M"]).contains("memory"));
    ok(&["compare", str(&path), str(&path), "--max-memory", "200M"]);
}
