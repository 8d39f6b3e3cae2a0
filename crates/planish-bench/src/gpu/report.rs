//! The report of `bench gpu`.

use serde::Serialize;

use crate::timing::Spread;

#[derive(Serialize)]
pub(super) struct Report {
    pub(super) adapter: String,
    pub(super) input: String,
    pub(super) frames: u32,
    pub(super) kernels: Vec<KernelRow>,
    pub(super) one_at_a_time: Vec<LatencyRow>,
    pub(super) in_flight: Vec<ThroughputRow>,
    pub(super) over_time: Vec<OverTimeRow>,
    pub(super) batches: Vec<BatchRow>,
    pub(super) fleets: Vec<FleetRow>,
    /// Time to open a smoother on an open device, including compilation and allocation.
    pub(super) open_ms: f64,
    pub(super) first_frame_ms: f64,
}

#[derive(Serialize)]
pub(super) struct KernelRow {
    pub(super) window: u32,
    pub(super) stride: u32,
    pub(super) degree: u32,
    pub(super) keeps_edges: bool,
    pub(super) kernel_us: Spread,
    /// Kernel time with the shader's bounds checks.
    pub(super) checked_kernel_us: Spread,
}

#[derive(Serialize)]
pub(super) struct LatencyRow {
    pub(super) setting: &'static str,
    pub(super) what: &'static str,
    pub(super) transfer: String,
    pub(super) microseconds: Spread,
}

#[derive(Serialize)]
pub(super) struct ThroughputRow {
    pub(super) setting: &'static str,
    pub(super) what: &'static str,
    pub(super) transfer: String,
    pub(super) slots: usize,
    pub(super) frames_per_second: f64,
}

/// Kernel time, and rates in frames per second with six frames in flight; `None` if results cannot be read in place.
#[derive(Serialize)]
pub(super) struct OverTimeRow {
    pub(super) way: &'static str,
    pub(super) transfer: String,
    pub(super) kernel_us: Spread,
    pub(super) points_in_place: f64,
    pub(super) points_copied: f64,
    pub(super) depth_in_place: f64,
}

#[derive(Serialize)]
pub(super) struct FleetRow {
    pub(super) setting: &'static str,
    pub(super) what: &'static str,
    pub(super) devices: usize,
    pub(super) frames_per_second: f64,
    /// Ratio of the rate to that of the first device alone.
    pub(super) times: f64,
    /// Number of frames that each device computed.
    pub(super) shares: Vec<u64>,
}

#[derive(Clone, Serialize)]
pub(super) struct BatchRow {
    pub(super) setting: &'static str,
    pub(super) frames: usize,
    pub(super) kernel_us: f64,
    pub(super) kernel_us_a_frame: f64,
}

pub(super) fn print_text(report: &Report) {
    crate::outln!("{}, {}, 640x480, medians of {} frames", report.adapter, report.input, report.frames);
    crate::outln!(
        "every setting agrees with the reference; opening a smoother takes {:.0} ms, its first frame {:.2} ms",
        report.open_ms,
        report.first_frame_ms
    );
    if report.kernels.is_empty() {
        return print_fleets(&report.fleets);
    }
    crate::outln!(
        "\n| window, stride, degree | edges | kernel, µs (p5 to p95) | with bounds checks, µs |\n|---|---|---|---|"
    );
    for row in &report.kernels {
        let Spread { p5, median, p95, .. } = row.kernel_us;
        crate::outln!(
            "| {}, {}, {} | {} | {median:.1} ({p5:.1} to {p95:.1}) | {:.1} |",
            row.window,
            row.stride,
            row.degree,
            if row.keeps_edges { "robust" } else { "off" },
            row.checked_kernel_us.median
        );
    }
    crate::outln!("\n| one frame at a time | setting | transfer | p50, µs | p99, µs |\n|---|---|---|---|---|");
    for LatencyRow { setting, what, transfer, microseconds } in &report.one_at_a_time {
        crate::outln!("| {what} | {setting} | {transfer} | {:.0} | {:.0} |", microseconds.median, microseconds.p99);
    }
    crate::outln!("\n| frames in flight | setting | transfer | slots | frames per second |\n|---|---|---|---|---|");
    for ThroughputRow { setting, what, transfer, slots, frames_per_second } in &report.in_flight {
        crate::outln!("| {what} | {setting} | {transfer} | {slots} | {frames_per_second:.0} |");
    }
    crate::outln!(
        "\n| default | transfer | kernel, µs | points in place, frames per second | points copied | depth in \
         place |\n|---|---|---|---|---|---|"
    );
    for OverTimeRow { way, transfer, kernel_us, points_in_place, points_copied, depth_in_place } in &report.over_time {
        let rates = format!("{points_in_place:.0} | {points_copied:.0} | {depth_in_place:.0}");
        crate::outln!("| {way} | {transfer} | {:.1} | {rates} |", kernel_us.median);
    }
    print_fleets(&report.fleets);
    crate::outln!("\n| batch | setting | kernel, µs | kernel per frame, µs |\n|---|---|---|---|");
    for BatchRow { setting, frames, kernel_us, kernel_us_a_frame } in &report.batches {
        crate::outln!("| {frames} | {setting} | {kernel_us:.0} | {kernel_us_a_frame:.1} |");
    }
}

fn print_fleets(rows: &[FleetRow]) {
    if !rows.is_empty() {
        crate::outln!(
            "\n| shared by devices | setting | devices | frames per second | times one | each \
             |\n|---|---|---|---|---|---|"
        );
    }
    for FleetRow { setting, what, devices, frames_per_second, times, shares } in rows {
        crate::outln!("| {what} | {setting} | {devices} | {frames_per_second:.0} | {times:.2} | {shares:?} |");
    }
}
