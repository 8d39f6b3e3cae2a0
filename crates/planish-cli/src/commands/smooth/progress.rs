//! A progress bar for smoothing one large cloud.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use planish::Progress;

/// Runs `work`, and shows a progress bar if the work takes long and standard error is a terminal.
pub fn with_progress<T>(progress: Option<Arc<Progress>>, work: impl FnOnce() -> T) -> T {
    /// Time after which the bar appears.
    const PATIENCE: Duration = Duration::from_secs(1);
    const STEP: Duration = Duration::from_millis(100);
    const STEPS: u64 = 1000;
    let Some(progress) = progress.filter(|_| std::io::stderr().is_terminal()) else { return work() };
    let is_done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let show = || {
            let start = Instant::now();
            let style = ProgressStyle::with_template("{bar:40} {percent} %, {eta} left");
            let bar = ProgressBar::hidden().with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.set_length(STEPS);
            while !is_done.load(Ordering::Relaxed) {
                std::thread::park_timeout(STEP);
                if start.elapsed() >= PATIENCE {
                    bar.set_draw_target(ProgressDrawTarget::stderr());
                    bar.set_position((progress.share() * STEPS as f32) as u64);
                }
            }
            bar.finish_and_clear();
        };
        let watch = std::thread::Builder::new().spawn_scoped(scope, show);
        let result = work();
        is_done.store(true, Ordering::Relaxed);
        if let Ok(watch) = watch {
            watch.thread().unpark();
        }
        result
    })
}
