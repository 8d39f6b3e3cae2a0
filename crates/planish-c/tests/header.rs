//! Checks that the committed header matches the source. To update the header: `PLANISH_WRITE_HEADER=1 cargo test -p
//! planish-c --test header`.

use std::fs;
use std::path::Path;

#[test]
fn the_header_is_generated_from_the_source() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config::from_file(folder.join("cbindgen.toml")).unwrap();
    let mut builder = cbindgen::Builder::new().with_config(config);
    for file in ["cuda", "error", "frame", "output", "result", "session", "smooth"] {
        builder = builder.with_src(folder.join("src").join(file).with_extension("rs"));
    }
    let mut header = Vec::new();
    builder.generate().unwrap().write(&mut header);
    let header = without_safety(&String::from_utf8(header).unwrap());
    let path = folder.join("include/planish/planish.h");
    if std::env::var_os("PLANISH_WRITE_HEADER").is_some() {
        fs::write(&path, &header).unwrap();
    }
    let committed = fs::read_to_string(&path).unwrap_or_default();
    assert!(committed == header, "write it again: PLANISH_WRITE_HEADER=1 cargo test -p planish-c --test header");
}

/// Removes the `# Safety` sections, which Rust requires for unsafe functions; the top of the header states the rules.
fn without_safety(header: &str) -> String {
    let mut kept: Vec<&str> = Vec::new();
    let mut is_safety = false;
    for line in header.lines() {
        let comment = line.trim_start().starts_with("//");
        is_safety = comment && (is_safety || line.contains("# Safety"));
        if !is_safety {
            kept.push(line);
            continue;
        }
        // Remove the empty line before the section, too.
        if line.contains("# Safety") && kept.last().is_some_and(|last| last.trim() == "//" || last.trim() == "///") {
            kept.pop();
        }
    }
    kept.join("\n") + "\n"
}
