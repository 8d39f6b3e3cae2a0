//! `planish bench general`: measures unorganized clouds, from points in host memory to points and normals in host
//! memory.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use planish::agreement::Agreement;
use planish::{
    CloudParams, CloudRadius, Edges, Engine, Error, GpuOptions, Outputs, PointCloud, PointsView, SimdLevel, Smoothed,
    Smoother, SmootherOptions, Xyz, auto_choice, gpu_adapters,
};
use serde::Serialize;

use super::timing::{Spread, Timing, milliseconds};

/// Maximum number of points compared with the reference engine, which takes about a second for 10,000 points.
const CHECKED_POINTS: usize = 10_000;
/// Time after which no further run begins.
const LONGEST: Duration = Duration::from_secs(20);

/// Options of the benchmark on unorganized clouds.
#[derive(Debug, Clone)]
pub struct GeneralOptions {
    /// Clouds with their names.
    pub clouds: Vec<(String, PointCloud)>,
    /// Number of points of each simulated scan.
    pub scans: Vec<usize>,
    /// The radii to measure.
    pub radii: Vec<CloudRadius>,
    /// Degree of the polynomial.
    pub degree: u32,
    /// Handling of edges.
    pub edges: Edges,
    /// The engines to measure. If empty or containing `Auto`: the CPU engine, and the GPU engine if there is a real
    /// GPU.
    pub engines: Vec<Engine>,
    /// True to measure the CPU engine at every SIMD level instead of only the widest.
    pub every_simd: bool,
    /// Threads of the CPU engine.
    pub threads: Option<usize>,
    /// The GPU, by index or part of its name; by default the first real one.
    pub adapter: Option<String>,
    /// Maximum number of points on the GPU at once; `None` for the device's limit.
    pub points_at_once: Option<usize>,
    /// Maximum number of runs per figure.
    pub runs: usize,
    /// True to print the figures as one JSON array.
    pub json: bool,
}

#[derive(Serialize)]
struct Row {
    cloud: String,
    points: usize,
    radius: String,
    degree: u32,
    mean_neighbours: f64,
    engine: String,
    timing: Timing,
    /// Median time of the kernels on the device, in milliseconds, if the engine reports it.
    kernel_ms: Option<f64>,
    /// Size of the engine's buffers in bytes per point.
    bytes_a_point: f64,
    /// Distances from the points of the first engine, in metres: 99.9th percentile and maximum.
    from_first_m: Option<[f64; 2]>,
}

/// Measures and prints the figures.
///
/// # Errors
/// If a requested engine is unavailable, or a result is wrong.
pub fn run(options: &GeneralOptions) -> Result<()> {
    let mut rows = Vec::new();
    let scans = options.scans.iter().map(|&points| ("a simulated scan".to_owned(), scan(points)));
    for (name, cloud) in options.clouds.iter().cloned().chain(scans) {
        for &radius in &options.radii {
            let params =
                CloudParams::default().with_radius(radius).with_degree(options.degree).with_edges(options.edges);
            rows.extend(measure(options, &name, &cloud, params).with_context(|| format!("{name}, {radius:?}"))?);
        }
    }
    if options.json {
        crate::outln!("{}", serde_json::to_string(&rows)?);
        return Ok(());
    }
    crate::outln!(
        "| cloud | points | radius | neighbours | engine | ms | kernels, ms | bytes per point | distance from the \
         first engine |"
    );
    crate::outln!("|---|---|---|---|---|---|---|---|---|");
    for row in rows {
        let kernel = row.kernel_ms.map_or_else(String::new, milliseconds);
        let from =
            row.from_first_m.map_or_else(String::new, |[most, all]| format!("99.9 % {most:.1e} m, all {all:.1e} m"));
        crate::outln!(
            "| {} | {} | {} | {:.0} | {} | {} | {kernel} | {:.0} | {from} |",
            row.cloud,
            row.points,
            row.radius,
            row.mean_neighbours,
            row.engine,
            row.timing.cell(),
            row.bytes_a_point
        );
    }
    Ok(())
}

/// Returns the engines to measure, each with its SIMD level if every level is measured.
fn engines(options: &GeneralOptions) -> Vec<(Engine, Option<SimdLevel>)> {
    let engines = if !options.engines.is_empty() && !options.engines.contains(&Engine::Auto) {
        options.engines.clone()
    } else {
        match auto_choice(&gpu_adapters()).0 {
            Engine::Gpu => vec![Engine::Cpu, Engine::Gpu],
            _ => vec![Engine::Cpu],
        }
    };
    let levels = |engine| match engine {
        Engine::Cpu if options.every_simd => SimdLevel::available().map(|level| (engine, Some(level))).collect(),
        _ => vec![(engine, None)],
    };
    engines.into_iter().flat_map(levels).collect()
}

fn open(
    options: &GeneralOptions,
    (engine, simd): (Engine, Option<SimdLevel>),
    params: CloudParams,
    outputs: Outputs,
) -> Result<Smoother> {
    let gpu = GpuOptions::default().with_adapter(options.adapter.clone()).with_timestamps(engine == Engine::Gpu);
    let gpu = gpu.with_points_at_once(options.points_at_once);
    let opened = SmootherOptions::new(engine, outputs).with_threads(options.threads).with_simd(simd).with_gpu(gpu);
    Ok(Smoother::open_clouds(params, &opened)?)
}

fn measure(options: &GeneralOptions, name: &str, cloud: &PointCloud, params: CloudParams) -> Result<Vec<Row>> {
    let radius_m = match params.radius {
        CloudRadius::Fixed { radius_m } => f64::from(radius_m),
        _ => 0.0,
    };
    let checked = cut(&cloud.positions);
    let mut expected = Smoothed::default();
    open(options, (Engine::Reference, None), params, Outputs::ALL)?.smooth(view(&checked)?, &mut expected)?;
    let mut first: Option<Smoothed> = None;
    let mut rows = Vec::new();
    for (engine, simd) in engines(options) {
        let mut found = Smoothed::default();
        let mut smoother = open(options, (engine, simd), params, Outputs::ALL)?;
        smoother.smooth(view(&checked)?, &mut found)?;
        let mut agreement = Agreement::default();
        agreement.add(&found, &expected, |_| radius_m);
        let misses = agreement.misses();
        if !misses.is_empty() {
            bail!("the result is wrong, so it is not timed: {}: {}", engine.name(), misses.join("; "));
        }
        smoother.smooth(view(&cloud.positions)?, &mut found)?;
        let neighbours = found.neighbours.iter().flatten().map(|&count| f64::from(count)).sum::<f64>();
        let from_first_m = first.as_ref().map(|first| {
            let both = found.points.iter().zip(first.points.iter());
            let square = |(a, b): ([f32; 3], [f32; 3])| (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>();
            let mut distances_m: Vec<f64> =
                both.map(square).filter(|square| square.is_finite()).map(f64::sqrt).collect();
            distances_m.sort_by(f64::total_cmp);
            let of_share = |share: f64| {
                let place = (distances_m.len() as f64 * share) as usize;
                distances_m.get(place).or(distances_m.last()).copied().unwrap_or(0.0)
            };
            [of_share(0.999), of_share(1.0)]
        });
        first.get_or_insert(found);
        drop(smoother);

        let mut smoother = open(options, (engine, simd), params, Outputs::POINTS.with_normals(true))?;
        let mut smoothed = Smoothed::default();
        let (mut times_ms, mut kernels_ms) = (Vec::new(), Vec::new());
        // The first run allocates the buffers and is not counted.
        smoother.smooth(view(&cloud.positions)?, &mut smoothed)?;
        let begun = Instant::now();
        while times_ms.is_empty() || (times_ms.len() < options.runs && begun.elapsed() < LONGEST) {
            let start = Instant::now();
            smoother.smooth(view(&cloud.positions)?, &mut smoothed)?;
            times_ms.push(1e3 * start.elapsed().as_secs_f64());
            kernels_ms.extend(smoother.timings().map(|timings| 1e3 * timings.kernel.as_secs_f64()));
        }
        let valid = cloud.valid_points().max(1) as f64;
        rows.push(Row {
            cloud: name.to_owned(),
            points: cloud.valid_points(),
            radius: match params.radius {
                CloudRadius::Fixed { radius_m } => format!("{} cm", 100.0 * radius_m),
                _ => "by density".to_owned(),
            },
            degree: params.fit.degree,
            mean_neighbours: neighbours / valid,
            engine: match (smoother.gpu_name(), simd) {
                (Some(gpu), _) => format!("gpu, {gpu}"),
                (None, Some(simd)) => format!("{}, {}", engine.name(), simd.name()),
                (None, None) => engine.name().to_owned(),
            },
            timing: Timing::of(times_ms),
            kernel_ms: (!kernels_ms.is_empty()).then(|| Spread::of(kernels_ms).median),
            bytes_a_point: smoother.buffer_bytes() as f64 / valid,
            from_first_m,
        });
    }
    Ok(rows)
}

fn view(positions: &Xyz) -> Result<PointsView<'_>> {
    Ok(PointsView::from_planes(positions.x(), positions.y(), positions.z()).map_err(Error::from)?)
}

/// Returns at most [`CHECKED_POINTS`] points: those nearest to the point in the middle of the file.
fn cut(positions: &Xyz) -> Xyz {
    let mut points: Vec<[f32; 3]> = positions.iter().filter(|p| p.iter().all(|value| value.is_finite())).collect();
    let Some(&middle) = points.get(points.len() / 2) else { return Xyz::default() };
    let square = |p: &[f32; 3]| (0..3).map(|axis| (p[axis] - middle[axis]).powi(2)).sum::<f32>();
    if points.len() > CHECKED_POINTS {
        points.select_nth_unstable_by(CHECKED_POINTS, |a, b| square(a).total_cmp(&square(b)));
        points.truncate(CHECKED_POINTS);
    }
    points.into_iter().collect()
}

/// Returns a terrestrial scan of a yard: ground with waves, four walls and twelve pillars around a scanner 1.8 m up,
/// with 2 mm of noise in range. Points at the walls are tens of times sparser than points at the scanner's foot.
fn scan(points: usize) -> PointCloud {
    let columns = (2.0 * points as f64).sqrt().round().max(1.0) as usize;
    let mut state = 1u64;
    let mut uniform = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let positions = (0..points).map(|i| {
        let turn = std::f64::consts::TAU * ((i % columns) as f64 + uniform()) / columns as f64;
        let up = (-50.0 + 80.0 * ((i / columns) as f64 + uniform()) * columns as f64 / points as f64).to_radians();
        let ray = [up.cos() * turn.cos(), up.cos() * turn.sin(), up.sin()];
        let noise: f64 = (0..12).map(|_| uniform() - 0.5).sum();
        let range_m = range_m(ray) + 0.002 * noise;
        ray.map(|value| (range_m * value) as f32)
    });
    PointCloud::new(positions.collect())
}

/// Returns the distance to the yard's surface along a unit ray.
fn range_m(ray: [f64; 3]) -> f64 {
    let [x, y, z] = ray;
    let wall = 20.0 / x.abs().max(1e-9);
    let gable = 35.0 / y.abs().max(1e-9);
    let mut nearest = wall.min(gable);
    if z < 0.0 {
        let flat = -1.8 / z;
        nearest = nearest.min((-1.8 + 0.1 * (0.7 * flat * x).sin() * (0.5 * flat * y).cos()) / z);
    }
    for pillar in 0..12 {
        let angle = std::f64::consts::TAU * f64::from(pillar) / 12.0;
        let (centre, radius) = ([9.0 * angle.cos(), 9.0 * angle.sin()], 0.25);
        // Distances to pillars are measured in the horizontal plane, in which the ray is shorter by this ratio.
        let flat = x.hypot(y).max(1e-9);
        let along = (x * centre[0] + y * centre[1]) / flat;
        let beside = (81.0 - along * along).max(0.0);
        if along > 0.0 && beside < radius * radius {
            nearest = nearest.min((along - (radius * radius - beside).sqrt()) / flat);
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scan_is_uneven_and_of_its_size() {
        let cloud = scan(5000);
        assert_eq!((cloud.len(), cloud.valid_points()), (5000, 5000));
        let range = |p: [f32; 3]| p.iter().map(|value| value * value).sum::<f32>().sqrt();
        let near = cloud.positions.iter().filter(|&p| range(p) < 4.0).count();
        let far = cloud.positions.iter().filter(|&p| range(p) > 15.0).count();
        assert!(near > 1000 && far > 1000, "{near} {far}");
    }

    #[test]
    fn a_cut_is_of_the_nearest_points() {
        let points: Xyz = (0..3 * CHECKED_POINTS).map(|i| [i as f32, 0.0, 0.0]).collect();
        let cut = cut(&points);
        let (low, high) = cut.x().iter().fold((f32::MAX, f32::MIN), |(low, high), &x| (low.min(x), high.max(x)));
        assert_eq!((cut.len(), (high - low) as usize + 1), (CHECKED_POINTS, CHECKED_POINTS));
    }
}
