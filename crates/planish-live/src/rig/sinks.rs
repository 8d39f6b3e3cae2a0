//! Sinks for a rig's results.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::{Rig, RigCamera, RigFrame, rig_to_json};
use crate::new_folder::refuse_used;
use crate::stream::{Consumer, FolderSink, Sink, SinkFormat};
use planish_core::{Error, FormatError, IoError, Outputs};
use planish_io::internal::{append_to, create_output_folder};
use planish_io::{self as io, CloudRef, Encoding};

/// A consumer of a rig's results, one moment after another.
pub trait RigSink: Send {
    /// Returns the name of the sink for messages.
    fn name(&self) -> String;

    /// Consumes one moment.
    fn write(&mut self, frame: &RigFrame) -> Result<(), Error>;

    /// Finishes the output. Called after the last moment.
    fn close(&mut self) -> Result<(), Error> {
        Ok(())
    }
}

impl Consumer<RigFrame> for Box<dyn RigSink> {
    fn name(&self) -> String {
        RigSink::name(&**self)
    }

    fn write(&mut self, frame: &Arc<RigFrame>) -> Result<(), Error> {
        RigSink::write(&mut **self, frame)
    }

    fn close(&mut self) -> Result<(), Error> {
        RigSink::close(&mut **self)
    }
}

/// A sink that writes the fused cloud of every moment to a folder, as `000000.pcd` and so on, each file atomically.
/// `points.txt` lists the files with their times; `rig.json` describes the rig.
pub struct FusedSink {
    folder: PathBuf,
    format: SinkFormat,
}

const POINTS_LIST: &str = "points.txt";
const RIG_FILE: &str = "rig.json";

impl FusedSink {
    /// Creates the folder. Refuses non-empty folders, and depth image formats: a fused cloud stores only points.
    pub fn create(folder: &Path, format: SinkFormat, rig: &Rig) -> Result<Self, Error> {
        if format == SinkFormat::DepthPng {
            let problem =
                FormatError::Unsupported("a fused cloud has no depth image; save each camera's frames".into());
            return Err(IoError { path: folder.to_path_buf(), problem }.into());
        }
        create_folder(folder, rig, |_| None)?;
        Ok(Self { folder: folder.to_path_buf(), format })
    }
}

/// Creates a folder for the results of a rig, with a `rig.json` in which each camera has the source that `source`
/// returns.
fn create_folder(folder: &Path, rig: &Rig, source: impl Fn(&RigCamera) -> Option<String>) -> Result<(), IoError> {
    let at = |error: std::io::Error| IoError { path: folder.to_path_buf(), problem: error.into() };
    refuse_used(folder)?;
    create_output_folder(folder).map_err(at)?;
    let mut saved = rig.clone();
    saved.cameras.iter_mut().for_each(|camera| {
        camera.source = source(camera);
        // The source has its own camera file.
        if camera.source.is_some() {
            (camera.camera, camera.depth_units_per_metre) = (None, None);
            (camera.alignment, camera.mode) = (None, None);
        }
    });
    let path = folder.join(RIG_FILE);
    io::write_whole(&path, rig_to_json(&saved).as_bytes()).map_err(IoError::at(&path))
}

impl RigSink for FusedSink {
    fn name(&self) -> String {
        self.folder.display().to_string()
    }

    fn write(&mut self, frame: &RigFrame) -> Result<(), Error> {
        let fused = frame.fused()?;
        let file = format!("{:06}.{}", frame.index, self.format.extension());
        let path = self.folder.join(&file);
        if self.format == SinkFormat::Ply {
            let mut unpacked = fused.clone();
            unpacked.unpack_colour();
            io::write_cloud(&path, CloudRef::General(&unpacked), Encoding::Binary)?;
        } else {
            io::write_cloud(&path, CloudRef::General(fused), Encoding::Binary)?;
        }
        let path = self.folder.join(POINTS_LIST);
        append_to(&path, &format!("{:.6} {file}\n", frame.time_s)).map_err(|problem| IoError { path, problem })?;
        Ok(())
    }
}

/// A sink that writes each camera's frames to a separate folder, as [`FolderSink`] does, and a `rig.json`. If the
/// frames are data sets of depth images, the `rig.json` can be streamed again.
pub struct CamerasSink {
    folder: PathBuf,
    format: SinkFormat,
    outputs: Outputs,
    cameras: HashMap<usize, FolderSink>,
}

impl CamerasSink {
    /// Creates the folder. Refuses a non-empty folder.
    pub fn create(folder: &Path, format: SinkFormat, outputs: Outputs, rig: &Rig) -> Result<Self, Error> {
        // Other formats do not keep the frames' times.
        let is_data_set = format == SinkFormat::DepthPng;
        create_folder(folder, rig, |camera| is_data_set.then(|| format!("./{}", camera.name)))?;
        Ok(Self { folder: folder.to_path_buf(), format, outputs, cameras: HashMap::new() })
    }
}

impl RigSink for CamerasSink {
    fn name(&self) -> String {
        self.folder.display().to_string()
    }

    fn write(&mut self, frame: &RigFrame) -> Result<(), Error> {
        for (i, camera) in frame.cameras.iter().enumerate() {
            let Some(of_camera) = camera else { continue };
            let sink = match self.cameras.entry(i) {
                std::collections::hash_map::Entry::Occupied(sink) => sink.into_mut(),
                std::collections::hash_map::Entry::Vacant(none) => {
                    let folder = self.folder.join(&frame.rig.cameras[i].name);
                    none.insert(FolderSink::create(&folder, self.format, self.outputs)?)
                }
            };
            sink.write(of_camera)?;
        }
        Ok(())
    }
}
