//! The plans that are committed are those that the library makes.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

#[test]
fn the_committed_plans_are_those_of_the_library() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../web/plans");
    let of_file = |entry: std::io::Result<fs::DirEntry>| {
        let path = entry.unwrap().path();
        (path.file_name().unwrap().to_str().unwrap().to_owned(), fs::read_to_string(&path).unwrap())
    };
    let committed: BTreeMap<String, String> = fs::read_dir(&folder).unwrap().map(of_file).collect();
    let made: BTreeMap<String, String> = planish_web::usual_plans().unwrap().into_iter().collect();
    let names = |files: &BTreeMap<String, String>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&committed), names(&made));
    for (name, text) in &made {
        assert!(committed[name] == *text, "{name} is out of date: cargo run -p planish-web --example write_plans");
    }
}
