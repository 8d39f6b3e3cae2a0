//! Tells the program its own commit and compiler, which results are worth little without.

use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=..");
    println!("cargo::rerun-if-changed=../../.git/HEAD");
    println!("cargo::rerun-if-changed=../../.git/refs/heads");
    let first_line = |program: &str, arguments: &[&str]| {
        let output = Command::new(program).args(arguments).output().ok().filter(|output| output.status.success())?;
        String::from_utf8(output.stdout).ok()?.lines().next().map(str::to_owned)
    };
    // A package from a registry has no repository of its own, but may lie in another.
    let in_repository = Path::new("../../.git").exists();
    let commit =
        in_repository.then(|| first_line("git", &["describe", "--always", "--dirty=+", "--exclude=*"])).flatten();
    let version = std::env::var("CARGO_PKG_VERSION").unwrap_or_default();
    let version = commit.map_or(version.clone(), |commit| format!("{version} ({commit})"));
    println!("cargo::rustc-env=PLANISH_VERSION={version}");
    let rustc = std::env::var("RUSTC").unwrap_or("rustc".to_owned());
    let rustc = first_line(&rustc, &["--version"]).unwrap_or("rustc".to_owned());
    println!("cargo::rustc-env=PLANISH_RUSTC={rustc}");
}
