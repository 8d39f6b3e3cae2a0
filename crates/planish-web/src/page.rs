//! The state of a page: its frames, plans and results.

use std::collections::BTreeMap;
use std::path::Path;
use std::rc::Rc;

use planish::io::{
    Contents, Encoding, Format, ReadOptions, Work, camera_to_json, decode_with, encode_cloud, encode_depth,
    parse_settings, settings_to_json,
};
use planish::render::{DistantView, normals_of};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::webgpu::{Plan, WebGpuLimits};
use planish::{
    Camera, DepthImage, Engine, FormatError, FrameError, OrganizedCloud, Outputs, Params, PointCloud, Preset,
    SensorModel, Settings, Smoothed, Status, Xyz,
};
use serde_json::{Value, json};

use crate::camera::CameraGiven;
use crate::frame::PageFrame;
use crate::picture::{colours_of, colours_of_general, depth_range, rgba};
use crate::request::{PictureKind, Reply, Request, Side};

/// Memory limit for reading a file, in bytes. The module has at most 4 GiB, which must hold the frame, a copy, the
/// result and pictures.
const MAX_MEMORY_BYTES: u64 = 1 << 29;
/// The longer side of a picture of an unorganized cloud, in pixels.
const GENERAL_PICTURE_PX: usize = 640;

/// Part of the library's message about formats whose features are not built in.
const LEFT_OUT: &str = "this build does not include";

type Answer = Result<(Value, Vec<u8>), String>;

/// A result and its frame.
struct Outcome {
    frame: u32,
    /// The frame itself, since the page may release a frame before its results.
    held: Rc<PageFrame>,
    smoothed: Smoothed,
}

/// A plan and its frame.
struct Planned {
    frame: u32,
    held: Rc<PageFrame>,
    plan: Plan,
}

/// Frames, plans and results by their numbers.
#[derive(Default)]
pub struct Page {
    next: u32,
    frames: BTreeMap<u32, Rc<PageFrame>>,
    plans: BTreeMap<u32, Planned>,
    results: BTreeMap<u32, Outcome>,
    /// Session of the CPU engine, which keeps its buffers from frame to frame.
    smoother: Option<planish::Session>,
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

impl Page {
    /// Answers a request; `bytes` accompany it.
    pub fn handle(&mut self, request: &str, bytes: &[u8]) -> Reply {
        let answer = serde_json::from_str(request)
            .map_err(|error| format!("invalid request: {error}"))
            .and_then(|request| self.answer(request, bytes));
        match answer {
            Ok((ok, bytes)) => Reply { ok: Some(ok), error: None, bytes },
            Err(error) => Reply { ok: None, error: Some(error), bytes: Vec::new() },
        }
    }

    fn answer(&mut self, request: Request, bytes: &[u8]) -> Answer {
        match request {
            Request::About => Ok((about(), Vec::new())),
            Request::Continue { after } => {
                self.next = after;
                Ok((json!({}), Vec::new()))
            }
            Request::ReadCamera { frame, camera } => {
                let camera = camera.camera(self.frame(frame)?.contents.shape())?;
                let read: Value = serde_json::from_str(&camera_to_json(&camera)).map_err(text)?;
                Ok((read, Vec::new()))
            }
            Request::ReadSettings { text: file } => {
                let settings = parse_settings(&file).map_err(text)?;
                Ok((serde_json::to_value(&settings).map_err(text)?, Vec::new()))
            }
            Request::WriteSettings { settings } => Ok((json!({ "text": settings_to_json(&settings) }), Vec::new())),
            Request::Open { name } => self.open(&name, bytes),
            Request::Depth { width, height } => {
                let raw = numbers(bytes, width, height, 2, |bytes| u16::from_le_bytes([bytes[0], bytes[1]]))?;
                self.hold(Contents::Depth(DepthImage { width, height, raw }), "depth")
            }
            Request::Points { width, height } => {
                let float = |bytes: &[u8]| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                let xyz = |bytes: &[u8]| [float(bytes), float(&bytes[4..]), float(&bytes[8..])];
                let positions: Xyz = numbers(bytes, width, height, 12, xyz)?.into_iter().collect();
                let cloud = OrganizedCloud::from_positions(width, height, positions).map_err(text)?;
                self.hold(Contents::Organized(cloud), "points")
            }
            Request::Simulate { seed, width, height } => self.simulate(seed, width, height),
            Request::Smooth { frame, settings, camera } => self.smooth(frame, &settings, camera.as_ref()),
            Request::Plan { frame, settings, camera, limits: [workgroup_bytes, buffer_bytes, workgroups] } => {
                let limits = WebGpuLimits::new(workgroup_bytes, buffer_bytes, workgroups);
                self.plan(frame, &settings, camera.as_ref(), &limits)
            }
            Request::Finish { plan } => self.finish(plan, bytes),
            Request::Arrays { result } => self.arrays(result),
            Request::Picture { frame, side, kind, camera } => self.picture(frame, side, kind, camera.as_ref()),
            Request::Cloud { frame, side, kind, camera } => self.cloud(frame, side, kind, camera.as_ref()),
            Request::Write { result, format, camera } => self.write(result, &format, camera.as_ref()),
            Request::Release { ids } => {
                for id in ids {
                    self.frames.remove(&id);
                    self.plans.remove(&id);
                    self.results.remove(&id);
                }
                Ok((json!({}), Vec::new()))
            }
        }
    }

    fn number(&mut self) -> u32 {
        self.next += 1;
        self.next
    }

    fn hold(&mut self, contents: Contents, format: &'static str) -> Answer {
        let held = PageFrame { contents, format };
        let mut described = held.describe();
        let number = self.number();
        described["frame"] = number.into();
        self.frames.insert(number, Rc::new(held));
        Ok((described, Vec::new()))
    }

    fn frame(&self, number: u32) -> Result<&Rc<PageFrame>, String> {
        self.frames.get(&number).ok_or_else(|| format!("frame {number} does not exist or was released"))
    }

    fn result(&self, number: u32) -> Result<&Outcome, String> {
        self.results.get(&number).ok_or_else(|| format!("result {number} does not exist or was released"))
    }

    fn open(&mut self, name: &str, bytes: &[u8]) -> Answer {
        let options = ReadOptions::default().with_max_memory_bytes(MAX_MEMORY_BYTES);
        let announced = Format::of_extension(Path::new(name));
        let (format, contents) = decode_with(bytes, announced, &options).map_err(|error| match error {
            FormatError::Unsupported(what) if what.contains(LEFT_OUT) => {
                let format = what.split(',').next().unwrap_or_default();
                format!(
                    "{name}: the browser cannot read {format}, but the command can; convert it to PCD, PLY, NPY or a \
                     16-bit PNG"
                )
            }
            error => format!("{name}: {error}"),
        })?;
        let work = ReadOptions::default().check_work_on(Work::Smooth, &contents);
        work.map_err(|error| format!("{name}: {error}"))?;
        self.hold(contents, format.name())
    }

    fn simulate(&mut self, seed: u64, width: usize, height: usize) -> Answer {
        let focal = 525.0 * width as f64 / 640.0;
        let centre = [width, height].map(|n| (n as f64 - 1.0) / 2.0);
        let camera = Camera::new((width, height), [focal; 2], centre);
        camera.validate().map_err(text)?;
        let (scene, pose) = Scene::tabletop(seed);
        let truth = scene.render(&camera, &pose);
        let frame = DepthSimulator::new(DepthNoise::default(), camera, seed).frame(&truth, 0).map_err(text)?;
        self.hold(Contents::Depth(DepthImage { width, height, raw: frame.raw }), "simulated")
    }

    fn smooth(&mut self, number: u32, settings: &Settings, given: Option<&CameraGiven>) -> Answer {
        let held = Rc::clone(self.frame(number)?);
        let camera = held.camera(given)?;
        let outputs = held.outputs();
        let mut smoothed = Smoothed::default();
        let smoother = self.smoother_for(settings)?;
        smoother.set_outputs(outputs);
        held.with(camera.as_ref(), |frame| smoother.smooth(frame, &mut smoothed))?;
        self.keep(number, held, smoothed)
    }

    /// Returns the session of the CPU engine, with these settings.
    fn smoother_for(&mut self, settings: &Settings) -> Result<&mut planish::Session, String> {
        let mut settings = settings.clone();
        (settings.engine, settings.threads) = (settings.engine.or(Some(Engine::Cpu)), Some(1));
        match &mut self.smoother {
            Some(smoother) => {
                if smoother.settings() != Some(&settings) {
                    smoother.set_settings(settings).map_err(text)?;
                }
                Ok(smoother)
            }
            none => Ok(none.insert(planish::Session::new(settings).map_err(text)?)),
        }
    }

    fn plan(&mut self, number: u32, settings: &Settings, given: Option<&CameraGiven>, limits: &WebGpuLimits) -> Answer {
        let held = Rc::clone(self.frame(number)?);
        let camera = held.camera(given)?;
        let outputs = held.outputs();
        let (plan, upload) = held.with(camera.as_ref(), |frame| {
            let Params::Frame(params) = settings.resolve(frame)?.params else {
                return Err(FrameError::GridMismatch {
                    found: "is an unorganized cloud".to_owned(),
                    expected: "frames on a grid (WebGPU cannot smooth unorganized clouds, but the CPU engine can)"
                        .to_owned(),
                }
                .into());
            };
            let mut plan = Plan::new(params, outputs, frame, limits)?;
            let upload = plan.upload(frame)?;
            Ok((plan, upload))
        })?;
        let passes: Vec<Value> = plan
            .passes()
            .into_iter()
            .map(|pass| json!({ "entry_point": pass.entry_point, "wgsl": pass.wgsl, "workgroups": pass.workgroups }))
            .collect();
        let id = self.number();
        let described = json!({
            "plan": id, "passes": passes, "uniform": plan.uniform(), "output_bytes": plan.output_bytes(),
            "kept_bytes": plan.kept_bytes(),
        });
        self.plans.insert(id, Planned { frame: number, held, plan });
        Ok((described, upload))
    }

    fn finish(&mut self, plan: u32, bytes: &[u8]) -> Answer {
        let missing = || format!("plan {plan} does not exist, or was finished or released");
        let Planned { frame, held, plan } = self.plans.remove(&plan).ok_or_else(missing)?;
        let mut smoothed = Smoothed::default();
        plan.read(bytes, &mut smoothed).map_err(text)?;
        self.keep(frame, held, smoothed)
    }

    fn keep(&mut self, frame: u32, held: Rc<PageFrame>, smoothed: Smoothed) -> Answer {
        let counts = smoothed.status_counts().unwrap_or_default();
        let number = self.number();
        let described = json!({
            "result": number, "width": smoothed.width, "height": smoothed.height,
            "points": (0..smoothed.points.len()).filter(|&i| smoothed.points.is_finite(i)).count(),
            "status_counts": counts,
        });
        self.results.insert(number, Outcome { frame, held, smoothed });
        Ok((described, Vec::new()))
    }

    fn arrays(&self, result: u32) -> Answer {
        let smoothed = &self.result(result)?.smoothed;
        let mut bytes = Vec::with_capacity(25 * smoothed.points.len());
        for vectors in [Some(&smoothed.points), smoothed.normals.as_ref()].into_iter().flatten() {
            vectors.iter().flatten().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
        }
        bytes.extend(smoothed.status.iter().flatten().map(|&status| status as u8));
        Ok((json!({ "width": smoothed.width, "height": smoothed.height }), bytes))
    }

    /// Returns the points of a frame, raw or smoothed, and the normals of a smoothed frame, if it has any.
    fn points(&self, frame: u32, side: Side, camera: Option<&Camera>) -> Result<(PointCloud, Option<Xyz>), String> {
        let no_points = || "the frame has no points".to_owned();
        let Side::Result(result) = side else {
            return Ok((self.frame(frame)?.points(camera).ok_or_else(no_points)?, None));
        };
        let outcome = self.result(result)?;
        if outcome.frame != frame {
            return Err(format!("result {result} belongs to another frame"));
        }
        let mut points = outcome.held.points(camera).ok_or_else(no_points)?;
        points.apply(&outcome.smoothed, Outputs::POINTS.with_normals(true)).map_err(text)?;
        Ok((points, outcome.smoothed.normals.clone()))
    }

    fn picture(&self, number: u32, side: Side, kind: PictureKind, given: Option<&CameraGiven>) -> Answer {
        let held = self.frame(number)?;
        let camera = held.camera(given)?;
        let (points, normals) = self.points(number, side, camera.as_ref())?;
        let is_general = matches!(held.contents, Contents::General(_));
        let (cloud, normals) = if let Contents::General(raw) = &held.contents {
            // The view from above is the same for raw and smoothed points.
            let view = DistantView::of(raw, [0.0, 0.0, 1.0], GENERAL_PICTURE_PX).map_err(text)?;
            let cloud = view.see(&points).map_err(text)?;
            let normals = normals_of(&cloud);
            (cloud, Some(normals))
        } else {
            let (width, height) = held.contents.shape();
            (OrganizedCloud::new(width, height, points).map_err(text)?, normals)
        };
        // The depth range of the raw points determines the colours of both the raw and the smoothed picture.
        let raw = held.points(camera.as_ref()).map(|raw| depth_range(&raw.positions));
        // Seen from above, depth increases as z decreases.
        let range = raw.map_or([0.0, 1.0], |[near, far]| if is_general { [-far, -near] } else { [near, far] });
        let colours = colours_of(&cloud, normals.as_ref(), kind, range, is_general);
        let bytes = rgba(&colours, cloud.positions());
        Ok((json!({ "width": cloud.width(), "height": cloud.height(), "depth_range_m": range }), bytes))
    }

    fn cloud(&self, number: u32, side: Side, kind: PictureKind, given: Option<&CameraGiven>) -> Answer {
        let held = self.frame(number)?;
        let camera = held.camera(given)?;
        let (points, normals) = self.points(number, side, camera.as_ref())?;
        let colours = match &held.contents {
            Contents::General(raw) => colours_of_general(&points, normals.as_ref(), kind, depth_range(&raw.positions)),
            contents => {
                let (width, height) = contents.shape();
                let cloud = OrganizedCloud::new(width, height, points.clone()).map_err(text)?;
                let raw = held.points(camera.as_ref()).unwrap_or_else(|| points.clone());
                colours_of(&cloud, normals.as_ref(), kind, depth_range(&raw.positions), false)
            }
        };
        let finite = || (0..points.len()).filter(|&i| points.positions.is_finite(i));
        let count = finite().count();
        let mut bytes = Vec::with_capacity(16 * count);
        for i in finite() {
            points.positions.get(i).iter().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
        }
        finite().for_each(|i| bytes.extend_from_slice(&[colours[i][0], colours[i][1], colours[i][2], 255]));
        Ok((json!({ "points": count }), bytes))
    }

    fn write(&self, result: u32, format: &str, given: Option<&CameraGiven>) -> Answer {
        let outcome = self.result(result)?;
        let held = &outcome.held;
        let unknown = || format!("the browser cannot write {format}; use pcd, ply, npy, xyz, or png for depth");
        let name = format!("frame.{format}");
        let kind = Format::of_extension(Path::new(&name)).ok_or_else(unknown)?;
        let camera = held.camera(given)?;
        let bytes = if kind == Format::DepthPng {
            let no_depth = || "this frame has points but no camera, which depth needs; save it as PCD or PLY";
            let depth = match (&outcome.smoothed.depth, &camera) {
                (Some(raw), _) => {
                    DepthImage { width: outcome.smoothed.width, height: outcome.smoothed.height, raw: raw.clone() }
                }
                (None, Some(camera)) => outcome.smoothed.to_depth(camera).map_err(text)?,
                (None, None) => return Err(no_depth().to_owned()),
            };
            encode_depth(kind, &depth).map_err(text)?
        } else {
            let (mut points, _) = self.points(outcome.frame, Side::Result(result), camera.as_ref())?;
            match kind {
                Format::Ply => points.unpack_colour(),
                Format::Pcd => points.pack_colour(),
                _ => {}
            }
            match &held.contents {
                Contents::General(_) => encode_cloud(kind, &points, Encoding::Binary),
                contents => {
                    let (width, height) = contents.shape();
                    let cloud = OrganizedCloud::new(width, height, points).map_err(text)?;
                    encode_cloud(kind, &cloud, Encoding::Binary)
                }
            }
            .map_err(text)?
        };
        Ok((json!({ "format": kind.name() }), bytes))
    }
}

fn about() -> Value {
    let sensors: Vec<&str> = SensorModel::NAMED.iter().map(|&(name, _)| name).collect();
    let statuses: Vec<String> = Status::ALL.iter().map(|status| format!("{status:?}")).collect();
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "presets": Preset::NAMED.map(|(name, _)| name),
        "settings": Settings::NAMES,
        "sensors": sensors,
        "statuses": statuses,
        "simd": planish::SimdLevel::best().name(),
    })
}

/// Decodes one value per pixel with `of`, each from `size` bytes.
fn numbers<T>(
    bytes: &[u8],
    width: usize,
    height: usize,
    size: usize,
    of: impl Fn(&[u8]) -> T,
) -> Result<Vec<T>, String> {
    let expected = width.checked_mul(height).and_then(|pixels| pixels.checked_mul(size));
    if expected != Some(bytes.len()) {
        return Err(format!("expected {width} x {height} pixels of {size} bytes, but received {} bytes", bytes.len()));
    }
    Ok(bytes.chunks_exact(size).map(of).collect())
}
