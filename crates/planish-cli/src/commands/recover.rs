//! `planish recover`: completes a recording that was cut off.

use crate::exit::ExitCode;
use anyhow::Result;

use crate::args::RecoverArgs;

#[cfg(feature = "mcap")]
pub fn run(args: &RecoverArgs) -> Result<ExitCode> {
    use planish_bench::outln;

    #[derive(serde::Serialize)]
    struct Report {
        path: String,
        was_whole: bool,
        messages: u64,
        dropped_bytes: u64,
        damaged_chunks: u64,
    }

    let found = planish::bag::recover(&args.file, &args.memory.options())?;
    let path = found.path.display().to_string();
    if args.json {
        let planish::bag::Recovered { was_whole, messages, dropped_bytes, damaged_chunks, .. } = found;
        outln!("{}", serde_json::to_string(&Report { path, was_whole, messages, dropped_bytes, damaged_chunks })?);
    } else {
        outln!(
            "{path}: {} messages, {}",
            found.messages,
            if found.was_whole { "already complete" } else { "now complete" }
        );
        if found.dropped_bytes > 0 {
            outln!("  dropped {} bytes of incomplete data at the end", found.dropped_bytes);
        }
    }
    if found.damaged_chunks > 0 {
        planish_bench::errln!("warning: {} chunks are damaged; their messages may be lost", found.damaged_chunks);
    }
    Ok(if found.damaged_chunks > 0 { ExitCode::from(1) } else { ExitCode::SUCCESS })
}

#[cfg(not(feature = "mcap"))]
pub fn run(args: &RecoverArgs) -> Result<ExitCode> {
    anyhow::bail!("{}: this planish was built without the feature mcap", args.file.display())
}
