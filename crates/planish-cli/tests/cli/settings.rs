//! Settings from a file, and options that override them.

use std::fs;
use std::path::Path;

use super::{ok, planish, refused, str, text, with_frame};

#[test]
fn settings_come_from_a_file_and_options_override_them() {
    let (folder, _, path) = with_frame();
    let [file, by_file, by_options] = ["wall.yaml", "file.pcd", "options.pcd"].map(|name| folder.path().join(name));
    let smooth = |output: &Path, more: &[&str]| {
        ok(&[&["smooth", str(&path), str(output), "--engine", "cpu"], more].concat());
        fs::read(output).unwrap()
    };
    fs::write(&file, "preset: light\nedges: off\nradius_m: 0.05\n").unwrap();
    let options = ["--preset", "light", "--edges", "off", "--radius", "0.05"];
    assert!(smooth(&by_file, &["--settings", str(&file)]) == smooth(&by_options, &options));
    // A strength replaces the file's preset, and options win over its values.
    let given = smooth(&by_file, &["--settings", str(&file), "--strength", "1", "--edges", "robust"]);
    assert!(given == smooth(&by_options, &["--strength", "1", "--edges", "robust", "--radius", "0.05"]));
    // A setting of the file that contradicts an option is dropped.
    fs::write(&file, "engine: gpu\nadapter: \"7\"\nremove_floating: true\noutputs: [status]\n").unwrap();
    let settings = ["--settings", str(&file)];
    let plain = smooth(&by_file, &[&settings[..], &["--remove-floating=false", "--fields", "none"]].concat());
    assert!(plain == smooth(&by_options, &[]));
    let with_status = smooth(&by_file, &[&settings[..], &["--remove-floating=false"]].concat());
    assert!(with_status == smooth(&by_options, &["--fields", "status"]));
    // The command reports settings without effect, and never writes over the settings file.
    fs::write(&file, "remove_isolated: true\n").unwrap();
    let stderr = text(&planish(&["smooth", str(&path), str(&by_file), "--settings", str(&file)]).stderr);
    assert!(stderr.contains("remove_isolated has no effect on frames"), "{stderr}");
    let own = folder.path().join("settings.pcd");
    fs::copy(&file, &own).unwrap();
    let stderr = refused(&["smooth", str(&path), str(&own), "--settings", str(&own)]);
    assert!(
        stderr.contains("is also read (settings, camera or poses)")
            && fs::read(&own).unwrap() == fs::read(&file).unwrap()
    );
    let twice = [("radius: 0.1\nradius_m: 0.1", "given twice"), ("bandwidth: 0.1\nbandwidth_m: 0.1", "given twice")];
    let wrong = [("window: 9", "window = 9"), ("speed: 2", "speed"), ("[1]", "settings"), ("{", "settings")];
    for (text, said) in wrong.into_iter().chain(twice) {
        fs::write(&file, text).unwrap();
        let stderr = refused(&["smooth", str(&path), str(&by_file), "--settings", str(&file)]);
        assert!(stderr.contains("wall.yaml") && stderr.contains(said), "{stderr}");
    }
}
