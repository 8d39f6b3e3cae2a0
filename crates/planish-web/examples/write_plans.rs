//! Writes the folder web/plans: the kernels and layouts of the usual settings.
//!
//! Run `cargo run -p planish-web --example write_plans`.

use std::fs;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../web/plans");
    if folder.is_dir() {
        fs::remove_dir_all(&folder)?;
    }
    fs::create_dir(&folder)?;
    for (name, text) in planish_web::usual_plans()? {
        fs::write(folder.join(name), text)?;
    }
    Ok(())
}
