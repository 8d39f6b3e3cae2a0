//! Writes files atomically: each file gets a temporary name in the same folder, and is renamed when it is complete.
//!
//! A temporary file's name contains identifiers of the machine and the process that writes it, so a later process can
//! delete the leftovers of a killed one.

use std::collections::HashSet;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError, TryLockError};
use std::time::{Duration, Instant};

use super::FormatResult;
use planish_core::FormatError;

const PREFIX: &str = ".planish-";
const SUFFIX: &str = ".tmp";
/// Maximum number of symbolic links to follow, the same as in Linux.
const MOST_LINKS: usize = 40;

/// Maximum time to wait for the lock on [`KNOWN`] when the process ends.
const PATIENCE: Duration = Duration::from_secs(2);

/// The temporary files being written, and the folders whose stale temporary files have been removed.
struct Known {
    temporaries: Option<HashSet<PathBuf>>,
    swept: Option<HashSet<PathBuf>>,
    /// Output folders, in which no file is written through a link.
    folders: Option<HashSet<PathBuf>>,
    /// True once the process is about to end.
    is_over: bool,
}

static REPLACES_READ_ONLY: AtomicBool = AtomicBool::new(false);

/// Allows this process to replace read-only files, which is an error by default.
pub fn replace_read_only_files() {
    REPLACES_READ_ONLY.store(true, Ordering::Relaxed);
}

/// Returns true if a file exists and is read-only.
pub fn is_read_only(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|metadata| metadata.is_file() && metadata.permissions().readonly())
}

static KNOWN: Mutex<Known> = Mutex::new(Known { temporaries: None, swept: None, folders: None, is_over: false });

fn known() -> MutexGuard<'static, Known> {
    KNOWN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes this process's temporary files. Call it when the process is about to end: afterwards, creating a temporary
/// file fails.
pub fn remove_temporaries() {
    // If the process ends because memory ran out, this thread may already hold the lock.
    let deadline = Instant::now() + PATIENCE;
    let mut known = loop {
        match KNOWN.try_lock() {
            Ok(known) => break known,
            Err(TryLockError::Poisoned(known)) => break known.into_inner(),
            Err(TryLockError::WouldBlock) if Instant::now() > deadline => return,
            Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(1)),
        }
    };
    known.is_over = true;
    for file in known.temporaries.take().into_iter().flatten() {
        let _ = fs::remove_file(file);
    }
}

/// Creates an output folder, if it does not exist. From then on, files in it are not written through links, because
/// the user named only the folder, and other users may have placed links in it.
pub fn create_output_folder(folder: &Path) -> std::io::Result<()> {
    fs::create_dir_all(folder)?;
    known().folders.get_or_insert_default().insert(folder.to_path_buf());
    Ok(())
}

/// Appends text to a file, which is created if it does not exist. Fails if a path in an output folder leads through a
/// link.
pub fn append_to(path: &Path, text: &str) -> FormatResult<()> {
    check_links(path)?;
    let mut file = fs::OpenOptions::new().create(true).append(true).open(path)?;
    Ok(file.write_all(text.as_bytes())?)
}

/// Returns an error if a path in an output folder leads through a link.
fn check_links(path: &Path) -> FormatResult<()> {
    let folders: Vec<PathBuf> =
        known().folders.iter().flatten().filter(|folder| path.starts_with(folder)).cloned().collect();
    for folder in folders {
        // A missing folder is reported later.
        let (Ok(within), Ok(folder)) = (folder_of(path).canonicalize(), folder.canonicalize()) else { continue };
        if path.is_symlink() || !within.starts_with(folder) {
            let text = "the path leads through a link, and files in an output folder are not written through links; \
                        remove the link";
            return Err(FormatError::Unsupported(text.into()));
        }
    }
    Ok(())
}

/// Writes a file atomically: writes it under a temporary name in the same folder, then renames it. Links are followed.
/// A replaced file keeps its permissions and, if this process may set it, its owner. The old file stays in place until
/// the new one is on the disk. Replacing a read-only file is an error, except after [`replace_read_only_files`].
pub fn write_whole(path: &Path, bytes: &[u8]) -> FormatResult<()> {
    let whole = AtomicFile::new(path)?;
    let mut file = whole.file();
    file.write_all(bytes)?;
    whole.finish()
}

/// A file being written under a temporary name, as in [`write_whole`]. It is removed when dropped before
/// [`finish`](Self::finish).
pub struct AtomicFile {
    temporary: Temporary,
    path: PathBuf,
    replaced: bool,
}

impl AtomicFile {
    /// Creates a temporary file in the folder of `path`.
    pub fn new(path: &Path) -> FormatResult<Self> {
        check_links(path)?;
        let path = behind_links(path)?;
        let replaced = check_place(&path)?;
        let temporary = Temporary::new(folder_of(&path))?;
        if let Some(metadata) = &replaced {
            keep_owner(temporary.file(), metadata);
            temporary.file().set_permissions(metadata.permissions())?;
        }
        Ok(Self { temporary, replaced: replaced.is_some(), path })
    }

    /// Returns the temporary file.
    pub fn file(&self) -> &fs::File {
        self.temporary.file()
    }

    /// Moves the file to its target path.
    pub fn finish(self) -> FormatResult<()> {
        if self.replaced {
            // Without this, a crash of the machine could leave an empty file in place of the old one.
            self.file().sync_all()?;
        }
        Ok(self.temporary.persist(&self.path)?)
    }
}

/// A file under a temporary name, removed when it is dropped or when the process is about to end.
pub(crate) struct Temporary {
    file: tempfile::NamedTempFile,
    /// Dropped after `file`, because until then a signal must remove the file.
    _noted: Noted,
}

/// The registration of a temporary file's name while the file is being written.
struct Noted(PathBuf);

impl Temporary {
    pub fn new(folder: &Path) -> FormatResult<Self> {
        sweep(folder);
        let prefix = format!("{PREFIX}{}-{}-", machine(), std::process::id());
        let mut builder = tempfile::Builder::new();
        builder.prefix(&prefix).suffix(SUFFIX);
        #[cfg(unix)]
        {
            // Request the usual permissions of a new file, to which the process's umask applies.
            use std::os::unix::fs::PermissionsExt;
            builder.permissions(fs::Permissions::from_mode(0o666));
        }
        // Create and register the file under one lock, because a signal in between would leave it behind.
        let mut known = known();
        if known.is_over {
            return Err(std::io::Error::from(std::io::ErrorKind::Interrupted).into());
        }
        let file = builder.tempfile_in(folder)?;
        let path = file.path().to_path_buf();
        known.temporaries.get_or_insert_default().insert(path.clone());
        Ok(Self { file, _noted: Noted(path) })
    }

    pub fn file(&self) -> &fs::File {
        self.file.as_file()
    }

    fn persist(self, path: &Path) -> std::io::Result<()> {
        self.file.persist(path).map(drop).map_err(|error| error.error)
    }
}

impl Drop for Noted {
    fn drop(&mut self) {
        if let Some(temporaries) = &mut known().temporaries {
            temporaries.remove(&self.0);
        }
    }
}

/// Returns the metadata of an existing file at a path, or an error if no file can be written there.
fn check_place(path: &Path) -> FormatResult<Option<fs::Metadata>> {
    let folder = folder_of(path);
    if !folder.is_dir() {
        return Err(FormatError::Unsupported(format!("the folder {} does not exist", folder.display())));
    }
    let replaced = fs::metadata(path).ok();
    if replaced.as_ref().is_some_and(fs::Metadata::is_dir) {
        return Err(FormatError::Unsupported("the path is a folder; choose a file name".into()));
    }
    let is_read_only = |metadata: &fs::Metadata| metadata.permissions().readonly();
    if replaced.as_ref().is_some_and(is_read_only) && !REPLACES_READ_ONLY.load(Ordering::Relaxed) {
        return Err(FormatError::Unsupported(
            "the file is read-only; make it writable, or write to another file".into(),
        ));
    }
    if replaced.as_ref().is_some_and(|metadata| !metadata.is_file()) {
        return Err(FormatError::Unsupported("the path is a pipe or a device; choose a file name".into()));
    }
    Ok(replaced)
}

/// Returns an error if no file can be written at a path, for example because the folder is missing or read-only, or
/// because the path names a folder.
pub fn check_target(path: &Path) -> FormatResult<()> {
    check_links(path)?;
    let path = behind_links(path)?;
    check_place(&path)?;
    Temporary::new(folder_of(&path)).map(drop)
}

/// Gives a new file the owner and group of the file that it replaces. Only root may set both; other users may only set
/// a group that they belong to.
fn keep_owner(file: &fs::File, replaced: &fs::Metadata) {
    #[cfg(unix)]
    {
        use std::os::unix::fs::{MetadataExt, fchown};
        if fchown(file, Some(replaced.uid()), Some(replaced.gid())).is_err() {
            let _ = fchown(file, None, Some(replaced.gid()));
        }
    }
    #[cfg(not(unix))]
    let _ = (file, replaced);
}

/// Returns the folder that contains a file.
pub fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// Resolves symbolic links; the final file need not exist.
fn behind_links(path: &Path) -> FormatResult<PathBuf> {
    let mut path = path.to_path_buf();
    for _ in 0..MOST_LINKS {
        let Ok(target) = fs::read_link(&path) else { return Ok(path) };
        // A relative target is relative to the link's folder.
        path = path.parent().map_or_else(|| target.clone(), |folder| folder.join(&target));
    }
    Err(FormatError::Unsupported("the link points to itself; choose another file name".into()))
}

/// Removes temporary files that killed processes of this user and this machine left in a folder. Each folder is swept
/// only once.
fn sweep(folder: &Path) {
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_path_buf());
    if !known().swept.get_or_insert_default().insert(folder.clone()) {
        return;
    }
    let Ok(entries) = fs::read_dir(&folder) else { return };
    for entry in entries.flatten() {
        let name = entry.file_name();
        let stale = name.to_str().and_then(process_of).is_some_and(|process| !is_alive(process));
        if stale && entry.metadata().is_ok_and(|metadata| metadata.is_file() && is_own(&metadata)) {
            let _ = fs::remove_file(entry.path());
        }
    }
}

/// Returns the ID of the process that wrote a temporary file; `None` if another machine wrote it, or it is not a
/// temporary file of planish.
fn process_of(name: &str) -> Option<u32> {
    let (of, rest) = name.strip_prefix(PREFIX)?.strip_suffix(SUFFIX)?.split_once('-')?;
    (of == machine()).then_some(())?;
    rest.split_once('-')?.0.parse().ok()
}

/// Returns a short identifier of the machine and, on Linux, the container, within which process IDs are unique.
fn machine() -> String {
    let host = fs::read("/proc/sys/kernel/hostname").unwrap_or_default();
    let container = fs::read_link("/proc/self/ns/pid").unwrap_or_default();
    let bytes = host.iter().chain(container.as_os_str().as_encoded_bytes());
    // FNV-1a.
    let hash = bytes.fold(0x811c_9dc5_u32, |hash, &byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193));
    format!("{hash:08x}")
}

/// Returns true if a file belongs to this process's user. Other users' processes may be invisible in /proc.
fn is_own(metadata: &fs::Metadata) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        fs::metadata("/proc/self").is_ok_and(|process| process.uid() == metadata.uid())
    }
    #[cfg(not(unix))]
    {
        let _ = metadata;
        true
    }
}

/// Returns true if a process is running, or if that cannot be determined.
fn is_alive(process: u32) -> bool {
    let processes = Path::new("/proc");
    !processes.join("self").exists() || processes.join(process.to_string()).exists()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_killed_process_left_behind_is_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.path().join(name);
        // No process has an ID this high (the kernel's limit is 2^22).
        let stale = file(&format!(".planish-{}-4294967295-a1b2c3.tmp", machine()));
        let own = file(&format!(".planish-{}-{}-a1b2c3.tmp", machine(), std::process::id()));
        let elsewhere = ".planish-00000000-4294967295-a1b2c3.tmp";
        let others = [file(".planish-notes.tmp"), file("x.tmp"), file(".planish-12"), file(elsewhere)];
        for path in [&stale, &own].into_iter().chain(&others) {
            fs::write(path, "x").unwrap();
        }
        write_whole(&file("result"), b"whole").unwrap();
        assert!(!stale.exists() && own.exists() && others.iter().all(|path| path.exists()));
        assert_eq!(fs::read(file("result")).unwrap(), b"whole");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 6);
    }

    #[cfg(unix)]
    #[test]
    fn links_in_an_output_folder_are_refused() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().unwrap();
        let [output, outside] = ["output", "outside"].map(|name| folder.path().join(name));
        fs::create_dir(&outside).unwrap();
        fs::write(outside.join("list"), "mine").unwrap();
        create_output_folder(&output).unwrap();
        symlink(outside.join("list"), output.join("list")).unwrap();
        symlink(&outside, output.join("sub")).unwrap();
        for path in ["list", "sub/list"].map(|name| output.join(name)) {
            for result in [append_to(&path, "more"), write_whole(&path, b"new"), check_target(&path)] {
                assert!(result.unwrap_err().to_string().contains("through a link"));
            }
        }
        assert_eq!(fs::read(outside.join("list")).unwrap(), b"mine");
        append_to(&output.join("own"), "1").unwrap();
        append_to(&output.join("own"), "2").unwrap();
        assert_eq!(fs::read(output.join("own")).unwrap(), b"12");
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_permissions_kept() {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.path().join(name);
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        fs::create_dir(file("data")).unwrap();
        fs::write(file("data/target"), "old").unwrap();
        fs::set_permissions(file("data/target"), fs::Permissions::from_mode(0o600)).unwrap();
        symlink("data/target", file("link")).unwrap();
        symlink("data/new", file("dangling")).unwrap();
        symlink("loop", file("loop")).unwrap();
        write_whole(&file("link"), b"new").unwrap();
        write_whole(&file("dangling"), b"made").unwrap();
        assert!(fs::symlink_metadata(file("link")).unwrap().is_symlink());
        assert_eq!(fs::read(file("data/target")).unwrap(), b"new");
        assert_eq!((mode(&file("data/target")), fs::read(file("data/new")).unwrap()), (0o600, b"made".to_vec()));
        assert!(write_whole(&file("loop"), b"x").is_err());
    }
}
