//! Embeds the commit and compiler version, so that benchmark results can be traced.

use std::path::{Path, PathBuf};
use std::process::Command;

fn first_line(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).output().ok().filter(|output| output.status.success())?;
    String::from_utf8(output.stdout).ok()?.lines().next().map(str::to_owned)
}

/// Writes the list of files to embed for `planish view`: those in the folder that PLANISH_PAGE names, or none if it
/// is not set.
fn embed_page() {
    println!("cargo::rerun-if-env-changed=PLANISH_PAGE");
    let mut files = Vec::new();
    let mut folders: Vec<PathBuf> = std::env::var_os("PLANISH_PAGE")
        .map(|folder| Path::new(&folder).canonicalize().expect("PLANISH_PAGE is the folder of the page"))
        .into_iter()
        .collect();
    let root = folders.first().cloned().unwrap_or_default();
    while let Some(folder) = folders.pop() {
        println!("cargo::rerun-if-changed={}", folder.display());
        let entries = std::fs::read_dir(&folder).expect("PLANISH_PAGE is the folder of the page");
        for path in entries.map(|entry| entry.expect("a readable folder").path()) {
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(&root).expect("below the folder").to_string_lossy().replace('\\', "/");
                files.push(format!("({name:?}, include_bytes!({path:?}).as_slice()), "));
            }
        }
    }
    // The order must be the same on every machine.
    files.sort();
    let list = files.concat();
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("set by Cargo"));
    std::fs::write(out.join("page.rs"), format!("&[{list}]")).expect("a folder for output");
}

fn main() {
    embed_page();
    let version = std::env::var("CARGO_PKG_VERSION").unwrap_or_default();
    // A package from a registry has no repository of its own, but may be inside an unrelated one.
    let own_repository = Path::new("../../.git").exists() && Path::new("../planish/Cargo.toml").exists();
    let git_folder = own_repository.then(|| first_line("git", &["rev-parse", "--git-common-dir"])).flatten();
    let commit = match git_folder {
        None => {
            println!("cargo::rerun-if-changed=build.rs");
            None
        }
        Some(folder) => {
            let head = first_line("git", &["rev-parse", "--absolute-git-dir"]).unwrap_or_else(|| folder.clone());
            for path in
                ["..", "../../Cargo.toml", "../../Cargo.lock", &format!("{head}/HEAD"), &format!("{folder}/refs/heads")]
            {
                println!("cargo::rerun-if-changed={path}");
            }
            // Consider only the program's sources, not the documents that it generates.
            let sources = ["diff", "--quiet", "HEAD", "--", "..", "../../Cargo.toml", "../../Cargo.lock"];
            let clean = Command::new("git").args(sources).status().is_ok_and(|status| status.success());
            let commit = first_line("git", &["rev-parse", "--short", "HEAD"]);
            commit.map(|commit| commit + if clean { "" } else { "+" })
        }
    };
    println!(
        "cargo::rustc-env=PLANISH_VERSION={}",
        commit.map_or(version.clone(), |commit| format!("{version} ({commit})"))
    );
    let rustc = std::env::var("RUSTC").unwrap_or_else(|_| "rustc".to_owned());
    println!("cargo::rustc-env=PLANISH_RUSTC={}", first_line(&rustc, &["--version"]).unwrap_or(rustc));
}
