//! Data sets in the layout of the TUM RGB-D benchmark: PNGs in depth/ and rgb/, and lists of timestamps and files.
//!
//! Depth has 5000 units per metre. The camera is the caller's; otherwise the one in `camera.json` next to the lists,
//! which [`TumRecorder`] writes; otherwise the benchmark's default of 525, 525, 319.5, 239.5.

use std::path::{Component, Path, PathBuf};

use super::files::{file_stem, read_frame};
use super::{OwnedFrame, Source, malformed, with_shape};
use crate::new_folder::refuse_used;
use planish_core::{Camera, DepthFrame, DepthImage, Error, FormatError, IoError, SATURATED_DEPTH};
use planish_io::internal::{append_to, create_output_folder, quoted};
use planish_io::{self as io, ReadOptions, RgbImage};

/// The benchmark's depth units per metre.
const UNITS_PER_METRE: f64 = 5000.0;

/// Width and height of frames for which a Kinect's camera is assumed.
const KINECT_SHAPE: (usize, usize) = (640, 480);

/// Maximum time in seconds between paired colour and depth images, as in the benchmark's own tools.
const NEAR_IN_TIME_S: f64 = 0.02;

/// A source that reads a data set in TUM layout, in order.
pub struct TumSource {
    folder: PathBuf,
    camera: Camera,
    /// Whether the camera is unknown, and a Kinect's is assumed.
    is_assumed: bool,
    entries: Vec<Entry>,
    next: usize,
    read: ReadOptions,
}

struct Entry {
    timestamp_s: f64,
    depth: PathBuf,
    rgb: Option<PathBuf>,
}

impl TumSource {
    /// Opens a folder that has depth.txt and optionally rgb.txt, or associations.txt.
    ///
    /// Depth has 5000 units per metre, regardless of `camera`, unless `units_per_metre` or the data set's own
    /// camera.json states otherwise.
    pub fn open(folder: &Path, camera: Option<Camera>, units_per_metre: Option<f64>) -> Result<Self, Error> {
        Self::open_within(folder, camera, units_per_metre, ReadOptions::default())
    }

    /// Same as [`Self::open`], with options for reading the lists and images.
    pub(super) fn open_within(
        folder: &Path,
        camera: Option<Camera>,
        units_per_metre: Option<f64>,
        read: ReadOptions,
    ) -> Result<Self, Error> {
        let lists = ["associations.txt", "associate.txt"].map(|name| folder.join(name));
        let entries = match lists.iter().find(|list| list.is_file()) {
            Some(list) => associated(list, &read)?,
            None => joined(folder, &read)?,
        };
        if entries.is_empty() {
            return Err(malformed(folder, "the data set lists no depth images").into());
        }
        let file = folder.join("camera.json");
        let own = if file.is_file() { Some(io::read_camera(&file, None)?) } else { None };
        let units = units_per_metre.or(own.map(|own| own.depth_units_per_metre)).unwrap_or(UNITS_PER_METRE);
        let is_assumed = camera.is_none() && own.is_none();
        let camera = camera.or(own).unwrap_or(Camera::kinect_v1().with_shape((0, 0)));
        let camera = camera.with_depth_units_per_metre(units);
        Ok(Self { folder: folder.to_path_buf(), camera, is_assumed, entries, next: 0, read })
    }
}

impl Source for TumSource {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let Some(entry) = self.entries.get(self.next) else { return Ok(None) };
        self.next += 1;
        let file = self.folder.join(&entry.depth);
        let mut frame = read_frame(&file, Some(self.camera), &self.read)?;
        let shape = frame.shape();
        if self.is_assumed && shape != KINECT_SHAPE {
            let problem = format!(
                "the image is {}x{}, but TUM data sets assume a Kinect's {}x{}; give the camera, or add a camera.json \
                 to the folder",
                shape.0, shape.1, KINECT_SHAPE.0, KINECT_SHAPE.1
            );
            return Err(malformed(&file, problem).into());
        }
        self.camera = with_shape(self.camera, shape);
        if let OwnedFrame::Depth(depth) = &mut frame {
            depth.timestamp_s = Some(entry.timestamp_s);
            if let Some(rgb) = &entry.rgb {
                let file = self.folder.join(rgb);
                let image = planish_io::internal::read_rgb_png_with(&file, &self.read)?;
                if (image.width, image.height) != (depth.camera.width, depth.camera.height) {
                    let problem = format!(
                        "the colour image is {}x{}, but the depth image has a different size",
                        image.width, image.height
                    );
                    return Err(malformed(&file, problem).into());
                }
                depth.rgb = Some(image.rgb);
            }
        }
        Ok(Some(frame))
    }

    fn frame_name(&self) -> Option<String> {
        file_stem(&self.entries.get(self.next.checked_sub(1)?)?.depth)
    }
}

/// Returns the text of a list. Checks the memory for its entries.
fn text_of(list: &Path, read: &ReadOptions) -> Result<String, IoError> {
    /// Memory for a line and for its entry.
    const BYTES_PER_ENTRY: usize = 160;
    let text = io::read_bytes(list, read).and_then(|bytes| {
        read.check(bytes.iter().filter(|byte| **byte == b'\n').count(), BYTES_PER_ENTRY)?;
        let text = String::from_utf8(bytes).map_err(|_| FormatError::Malformed("the list is not text".into()))?;
        Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
    });
    text.map_err(IoError::at(list))
}

/// Returns the lines of a list without comments.
fn lines(text: &str) -> impl Iterator<Item = &str> {
    text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'))
}

/// Returns the path of a file that a list names. It must be in the data set's folder.
fn file_in(list: &Path, name: &str) -> Result<PathBuf, IoError> {
    let is_part = |part| matches!(part, Component::Normal(_) | Component::CurDir);
    if Path::new(name).components().all(is_part) {
        return Ok(name.into());
    }
    Err(malformed(list, format!("{} is outside the data set's folder", quoted(name))))
}

fn timestamp_s(list: &Path, word: &str) -> Result<f64, IoError> {
    let number = word.parse::<f64>().ok().filter(|number| number.is_finite());
    number.ok_or_else(|| {
        malformed(list, format!("{} is not a timestamp; expected lines of the form: seconds file", quoted(word)))
    })
}

/// Returns the timestamp in seconds and the file of each line.
fn stamped(list: &Path, read: &ReadOptions) -> Result<Vec<(f64, PathBuf)>, IoError> {
    let entry = |line: &str| match line.split_whitespace().collect::<Vec<_>>()[..] {
        [seconds, file] => Ok((timestamp_s(list, seconds)?, file_in(list, file)?)),
        _ => Err(malformed(list, format!("invalid line {}; expected: seconds file", quoted(line)))),
    };
    lines(&text_of(list, read)?).map(entry).collect()
}

/// Returns pairs of depth and colour from lines that list them in either order; the name of the colour image begins
/// with `rgb`.
fn associated(list: &Path, read: &ReadOptions) -> Result<Vec<Entry>, IoError> {
    let entry = |line: &str| {
        let [first_s, first, second_s, second] = line.split_whitespace().collect::<Vec<_>>()[..] else {
            let problem = format!("invalid line {}; expected: seconds file seconds file", quoted(line));
            return Err(malformed(list, problem));
        };
        let (seconds, depth, rgb) =
            if first.starts_with("rgb") { (second_s, second, first) } else { (first_s, first, second) };
        let timestamp_s = timestamp_s(list, seconds)?;
        Ok(Entry { timestamp_s, depth: file_in(list, depth)?, rgb: Some(file_in(list, rgb)?) })
    };
    lines(&text_of(list, read)?).map(entry).collect()
}

/// Pairs every line of depth.txt with the colour image nearest to it in time, if that is within [`NEAR_IN_TIME_S`].
fn joined(folder: &Path, read: &ReadOptions) -> Result<Vec<Entry>, IoError> {
    let depths = stamped(&folder.join("depth.txt"), read)?;
    let list = folder.join("rgb.txt");
    let mut colours = if list.is_file() { stamped(&list, read)? } else { Vec::new() };
    colours.sort_by(|a, b| a.0.total_cmp(&b.0));
    let nearest = |seconds: f64| {
        let at = colours.partition_point(|(other, _)| *other < seconds);
        let around = colours[at.saturating_sub(1)..(at + 1).min(colours.len())].iter();
        let near = around.filter(|(other, _)| (other - seconds).abs() <= NEAR_IN_TIME_S);
        near.min_by(|a, b| (a.0 - seconds).abs().total_cmp(&(b.0 - seconds).abs())).map(|(_, file)| file.clone())
    };
    let entry = |(seconds, depth)| Entry { timestamp_s: seconds, depth, rgb: nearest(seconds) };
    Ok(depths.into_iter().map(entry).collect())
}

/// A writer of a data set in TUM layout. Depth files have 16 bits and the layout's 5000 units per metre if the
/// camera's unit is a whole multiple of 0.2 mm, such as a millimetre. Other units are kept, and `camera.json` states
/// them.
///
/// Files are named by their timestamps in seconds, with six decimals. A timestamp that repeats or goes back is
/// replaced by the previous one plus 1 us.
pub struct TumRecorder {
    folder: PathBuf,
    units: Option<Units>,
    frames: u64,
    last_s: f64,
    too_far: u64,
}

/// Depth units of the camera and of the files, set by the first frame.
#[derive(Clone, Copy)]
struct Units {
    of_camera: f64,
    of_files: f64,
    /// Number of file units per camera unit.
    factor: u32,
}

impl Units {
    fn of(camera: &Camera) -> Self {
        let of_camera = camera.depth_units_per_metre;
        let factor = UNITS_PER_METRE / of_camera;
        if factor.fract() == 0.0 && (1.0..=UNITS_PER_METRE).contains(&factor) {
            Self { of_camera, of_files: UNITS_PER_METRE, factor: factor as u32 }
        } else {
            Self { of_camera, of_files: of_camera, factor: 1 }
        }
    }

    /// Converts a raw depth value to the files' unit: 0 for both kinds of holes, `None` if the result is too large.
    fn convert(self, raw: u16) -> Option<u16> {
        match raw {
            SATURATED_DEPTH => Some(0),
            raw => u16::try_from(u32::from(raw) * self.factor).ok().filter(|&raw| raw != SATURATED_DEPTH),
        }
    }
}

impl TumRecorder {
    /// Starts a recording; refuses a non-empty folder. The folder is created with the first frame.
    pub fn create(folder: &Path) -> Result<Self, Error> {
        refuse_used(folder)?;
        Ok(Self { folder: folder.to_path_buf(), units: None, frames: 0, last_s: f64::NEG_INFINITY, too_far: 0 })
    }

    /// Returns the number of pixels that became holes because they were too far for 16 bits: more than 13.1 m at 5000
    /// units per metre.
    pub fn too_far(&self) -> u64 {
        self.too_far
    }

    /// Returns the depth units per metre of the files; `None` before the first frame.
    pub fn depth_units_per_metre(&self) -> Option<f64> {
        self.units.map(|units| units.of_files)
    }

    fn create_folders(&self) -> Result<(), IoError> {
        let at_folder = |error: std::io::Error| IoError { path: self.folder.clone(), problem: error.into() };
        create_output_folder(&self.folder).map_err(at_folder)?;
        for name in ["depth", "rgb"] {
            let path = self.folder.join(name);
            create_output_folder(&path).map_err(|error| IoError { path, problem: error.into() })?;
        }
        for (name, what) in [("depth.txt", "depth"), ("rgb.txt", "color")] {
            self.write(name, &format!("# {what} images\n# timestamp filename\n"))?;
        }
        Ok(())
    }

    /// Adds a frame, which must have the depth unit of the first.
    pub fn add(&mut self, frame: &DepthFrame) -> Result<(), Error> {
        let camera = frame.camera;
        let units = match self.units {
            Some(units) => units,
            None => {
                self.create_folders()?;
                *self.units.insert(Units::of(&camera))
            }
        };
        if camera.depth_units_per_metre != units.of_camera {
            let [found, before] = [camera.depth_units_per_metre, units.of_camera];
            let problem =
                format!("depth has {found} units per metre, but had {before} before; a data set needs one unit");
            return Err(malformed(&self.folder, problem).into());
        }
        let converted = |&raw: &u16| {
            units.convert(raw).unwrap_or_else(|| {
                self.too_far += 1;
                0
            })
        };
        let raw: Vec<u16> = frame.raw.iter().map(converted).collect();
        let seconds = frame.timestamp_s.unwrap_or(self.frames as f64 / 30.0);
        // Names are timestamps: a clock that stands still or jumps back must not overwrite earlier files.
        let name_of = |seconds: f64| format!("{seconds:.6}");
        let is_used = seconds <= self.last_s || name_of(seconds) == name_of(self.last_s);
        // For large timestamps, adding 1 us may not change the f64.
        let seconds = if is_used { (self.last_s + 1e-6).max(self.last_s.next_up()) } else { seconds };
        self.last_s = seconds;
        let name = name_of(seconds);
        let depth = format!("depth/{name}.png");
        io::write_depth(&self.folder.join(&depth), &DepthImage { width: camera.width, height: camera.height, raw })?;
        if let Some(rgb) = &frame.rgb {
            let file = format!("rgb/{name}.png");
            let image = RgbImage { width: camera.width, height: camera.height, rgb: rgb.clone() };
            planish_io::write_rgb_png(&self.folder.join(&file), &image)?;
            self.append("rgb.txt", &format!("{name} {file}\n"))?;
        }
        // Written after its images, so that an interrupted recording is complete up to its last line.
        self.append("depth.txt", &format!("{name} {depth}\n"))?;
        if self.frames == 0 {
            let camera = camera.with_depth_units_per_metre(units.of_files);
            self.write("camera.json", &io::camera_to_json(&camera))?;
        }
        self.frames += 1;
        Ok(())
    }

    fn append(&self, name: &str, line: &str) -> Result<(), IoError> {
        let path = self.folder.join(name);
        append_to(&path, line).map_err(|problem| IoError { path, problem })
    }

    fn write(&self, name: &str, text: &str) -> Result<(), IoError> {
        let path = self.folder.join(name);
        io::write_whole(&path, text.as_bytes()).map_err(|problem: FormatError| IoError { path, problem })
    }
}
