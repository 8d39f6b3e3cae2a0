//! Reads a folder of frames, a file with several frames, or one file repeatedly.

use std::path::{Path, PathBuf};

use super::{OwnedFrame, Source, malformed, with_shape};
use planish_core::{Camera, DepthFrame, DepthView, Error, IoError};
use planish_io::{self as io, Contents, ReadOptions, Stack, Work};

/// A source that reads the frame files of a folder in the order of the numbers in their names, or repeats one file
/// endlessly. A file with several images (pages of a TIFF, a NumPy array of shape [N, H, W]) yields them one by one.
pub struct FileSource {
    files: Vec<PathBuf>,
    camera: Option<Camera>,
    next: usize,
    /// The last file, if it has several images, and the number of images taken from it.
    stack: Option<(Stack, usize)>,
    /// The frame of the repeated file.
    repeated: Option<OwnedFrame>,
    repeats: bool,
    read: ReadOptions,
}

impl FileSource {
    /// Reads every frame file of a folder once, in the order of the numbers in their names. Depth images need a camera.
    ///
    /// # Errors
    /// If the folder is unreadable or empty, or if the first frame is a depth image and no camera is given.
    pub fn folder(folder: &Path, camera: Option<Camera>) -> Result<Self, Error> {
        Self::folder_within(folder, camera, ReadOptions::default())
    }

    /// Same as [`Self::folder`], with explicit read options.
    pub(super) fn folder_within(folder: &Path, camera: Option<Camera>, read: ReadOptions) -> Result<Self, Error> {
        let files = io::frame_files(folder)?;
        let Some(first) = files.first() else {
            return Err(malformed(folder, "the folder has no frames (.pcd, .ply, .png, .tiff, .npy)").into());
        };
        // Without a camera, every depth image would fail, so fail now, before anything is written.
        if camera.is_none()
            && let Ok((_, contents @ (Contents::Depth(_) | Contents::DepthMetres { .. }))) = io::read_with(first, &read)
        {
            return Err(needs_camera(first, contents.shape()).into());
        }
        Ok(Self { files, camera, next: 0, stack: None, repeated: None, repeats: false, read })
    }

    /// Reads one file: its images once if it has several, or otherwise its only frame, repeated endlessly.
    pub fn repeat(file: &Path, camera: Option<Camera>) -> Self {
        let read = ReadOptions::default();
        Self { files: vec![file.to_path_buf()], camera, next: 0, stack: None, repeated: None, repeats: true, read }
    }

    /// Sets the options for reading files.
    pub fn with_read_options(self, read: ReadOptions) -> Self {
        Self { read, ..self }
    }
}

impl FileSource {
    /// Returns the next image of a file with several, if any is left. A truncated file ends with an error.
    fn next_image(&mut self) -> Option<Result<OwnedFrame, Error>> {
        let (stack, image) = self.stack.as_mut()?;
        let file = &self.files[self.next - 1];
        *image += 1;
        if *image > stack.images() {
            let is_told = *image > stack.images() + 1;
            let text = format!("the file is truncated after image {}", stack.images());
            return (stack.is_cut() && !is_told).then(|| Err(malformed(file, text).into()));
        }
        let contents = stack.image(*image).and_then(|contents| {
            // The other images stay in memory.
            self.read.beside(stack.bytes(), |left| left.check_work_on(Work::Stream, &contents))?;
            Ok(contents)
        });
        let contents = contents.map_err(IoError::at(file)).map_err(Error::from);
        let frame = contents.and_then(|contents| frame_of(file, contents, self.camera, &self.read));
        Some(frame.inspect(|frame| self.camera = self.camera.map(|camera| with_shape(camera, frame.shape()))))
    }
}

impl Source for FileSource {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        if let Some(frame) = &self.repeated {
            return Ok(Some(frame.clone()));
        }
        if let Some(frame) = self.next_image() {
            return frame.map(Some);
        }
        let Some(file) = self.files.get(self.next) else { return Ok(None) };
        // Advanced first, so that a caller that continues after an error gets the next file.
        self.next += 1;
        // The last file leaves memory before the next one is read.
        self.stack = None;
        self.stack =
            if self.read.image.is_none() { Stack::open(file, &self.read)?.map(|stack| (stack, 0)) } else { None };
        if self.stack.is_some() {
            self.repeats = false;
            return self.next_frame();
        }
        let frame = read_frame(file, self.camera, &self.read)?;
        // Intrinsics are valid for one image size.
        self.camera = self.camera.map(|camera| with_shape(camera, frame.shape()));
        if self.repeats {
            self.next = 0;
            self.repeated = Some(frame.clone());
        }
        Ok(Some(frame))
    }

    fn frame_name(&self) -> Option<String> {
        // A repeated file would give every frame the same name.
        let last = self.next.checked_sub(1).filter(|_| !self.repeats)?;
        let stem = file_stem(self.files.get(last)?)?;
        Some(match &self.stack {
            Some((stack, image)) => format!("{stem}_{:04}", image.min(&stack.images())),
            None => stem,
        })
    }
}

/// Returns the name of a file without its extension; `None` if it is not UTF-8.
pub(super) fn file_stem(file: &Path) -> Option<String> {
    file.file_stem()?.to_str().map(str::to_owned)
}

fn needs_camera(file: &Path, (width, height): (usize, usize)) -> IoError {
    malformed(file, format!("a depth image of {width}x{height} needs its camera (fx, fy, cx, cy)"))
}

/// Reads one frame file; depth needs a camera.
pub(super) fn read_frame(file: &Path, camera: Option<Camera>, read: &ReadOptions) -> Result<OwnedFrame, Error> {
    let (_, contents) = io::read_with(file, read)?;
    frame_of(file, contents, camera, read)
}

/// Returns the frame in a file's contents; depth needs a camera.
fn frame_of(file: &Path, contents: Contents, camera: Option<Camera>, read: &ReadOptions) -> Result<OwnedFrame, Error> {
    let shape = contents.shape();
    read.check_work_on(Work::Stream, &contents).map_err(IoError::at(file))?;
    let of_shape = |camera: Camera| {
        let camera = with_shape(camera, shape);
        camera.check_shape(shape).map_err(|error| malformed(file, error.to_string()))?;
        Ok::<_, Error>(camera)
    };
    let known = || of_shape(camera.ok_or_else(|| needs_camera(file, shape))?);
    match contents {
        Contents::Depth(image) => Ok(OwnedFrame::Depth(DepthFrame::from_image(known()?, image)?)),
        Contents::DepthMetres { depth_m, .. } => {
            let cloud = DepthView::from_metres(&depth_m, &known()?)?.deproject()?;
            Ok(OwnedFrame::Cloud { cloud, timestamp_s: None })
        }
        Contents::Organized(mut cloud) => {
            cloud.camera = camera.map(of_shape).transpose()?;
            Ok(OwnedFrame::Cloud { cloud, timestamp_s: None })
        }
        _ => Err(malformed(file, "the cloud is unorganized; a stream needs frames on a grid").into()),
    }
}
