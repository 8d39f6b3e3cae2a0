//! Runs the command with limits and measures its memory.

use std::fs::{self, File};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::thread;
use std::time::{Duration, Instant, SystemTime};

/// Returns the command that the environment variable `PLANISH_COMMAND` names, or otherwise the command of this build.
///
/// The command of this build is compiled first unless it is newer than all sources. Cargo passes a test only the
/// programs of the test's package, but `cargo test --workspace` has compiled the command already.
pub fn planish() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        if let Some(named) = std::env::var_os("PLANISH_COMMAND") {
            return named.into();
        }
        let test = std::env::current_exe().unwrap();
        let folder = test.ancestors().nth(2).unwrap();
        let program = folder.join("planish");
        let crates = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
        if modified(&program).is_some_and(|built| newest(crates) < Some(built)) {
            return program;
        }
        let mut cargo = Command::new(env!("CARGO"));
        cargo.args(["build", "--quiet", "--locked", "-p", "planish-cli"]);
        cargo.current_dir(env!("CARGO_MANIFEST_DIR"));
        if folder.ends_with("release") {
            cargo.arg("--release");
        }
        assert!(cargo.status().unwrap().success(), "the command does not compile");
        program
    })
}

fn modified(path: &Path) -> Option<SystemTime> {
    fs::metadata(path).and_then(|metadata| metadata.modified()).ok()
}

/// Returns the modification time of the newest source in a folder and its subfolders.
fn newest(folder: &Path) -> Option<SystemTime> {
    let is_source = |path: &Path| path.extension().is_some_and(|extension| extension == "rs" || extension == "wgsl");
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let of = |path: PathBuf| match path.is_dir() {
        true => newest(&path),
        false => modified(&path).filter(|_| is_source(&path)),
    };
    entries.filter_map(of).max()
}

/// The end of a run.
pub struct Ended {
    pub status: ExitStatus,
    pub stdout: String,
    pub stderr: String,
    pub peak_bytes: u64,
    /// True if the process was killed because it took too long.
    pub too_long: bool,
}

/// A process that runs in a folder.
pub struct Running {
    id: i32,
    folder: PathBuf,
}

/// Returns the peak memory of a process in bytes; 0 if it has ended.
fn peak_bytes_of(id: i32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{id}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib = line.and_then(|line| line.trim().strip_suffix(" kB")?.parse::<u64>().ok());
    kib.map_or(0, |kib| 1024 * kib)
}

/// Starts the command in a folder, with its output in files there.
pub fn start(folder: &Path, arguments: &[String], stdin: Option<&Path>, address_space_kib: u64) -> Running {
    let script = format!("ulimit -v {address_space_kib}; exec \"$0\" \"$@\"");
    let mut command = Command::new("sh");
    command.args(["-c", &script]).arg(planish()).args(arguments).current_dir(folder);
    command.stdin(stdin.map_or(Stdio::null(), |path| File::open(path).unwrap().into()));
    command.stdout(File::create(folder.join("stdout")).unwrap()).stderr(File::create(folder.join("stderr")).unwrap());
    // Tests that run in the background ignore SIGHUP and SIGINT. The command would inherit this, so reset both signals
    // to their defaults.
    // SAFETY: `signal` may be called between fork and exec.
    unsafe {
        command.pre_exec(|| {
            for number in [libc::SIGHUP, libc::SIGINT] {
                libc::signal(number, libc::SIG_DFL);
            }
            Ok(())
        })
    };
    // `wait4` waits for the process and returns its memory.
    #[allow(clippy::zombie_processes)]
    let child = command.spawn().unwrap();
    Running { id: i32::try_from(child.id()).unwrap(), folder: folder.to_owned() }
}

impl Running {
    /// Sends SIGINT once stdout contains `text`, the process has ended, or `longest` has passed.
    pub fn interrupt_after(&self, text: &str, longest: Duration) {
        let start = Instant::now();
        let has_printed = || {
            fs::read(self.folder.join("stdout")).is_ok_and(|printed| String::from_utf8_lossy(&printed).contains(text))
        };
        while !has_printed() && !self.has_ended() && start.elapsed() < longest {
            thread::sleep(Duration::from_millis(2));
        }
        self.signal(libc::SIGINT);
    }

    fn has_ended(&self) -> bool {
        // SAFETY: zeros are a valid value, and the pointer is valid. WNOWAIT leaves the process waitable.
        unsafe {
            let mut information: libc::siginfo_t = std::mem::zeroed();
            let options = libc::WEXITED | libc::WNOHANG | libc::WNOWAIT;
            libc::waitid(libc::P_PID, self.id.cast_unsigned(), &raw mut information, options) == 0
                && information.si_pid() != 0
        }
    }

    /// Waits until the process ends, and kills it after `longest`.
    pub fn wait(self, longest: Duration) -> Ended {
        let start = Instant::now();
        let id = self.id;
        let (mut too_long, mut raw, mut seen_bytes) = (false, 0, 0);
        // SAFETY: zeros are a valid value of a struct of integers.
        let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
        loop {
            // SAFETY: both pointers are valid. Nothing else waits for this process.
            let ended = unsafe { libc::wait4(id, &raw mut raw, libc::WNOHANG, &raw mut usage) };
            assert!(ended >= 0, "wait4: {}", std::io::Error::last_os_error());
            if ended == id {
                break;
            }
            seen_bytes = seen_bytes.max(peak_bytes_of(id));
            if start.elapsed() > longest && !too_long {
                too_long = true;
                self.signal(libc::SIGKILL);
            }
            thread::sleep(Duration::from_millis(2));
        }
        let output = |name: &str| String::from_utf8_lossy(&fs::read(self.folder.join(name)).unwrap()).into_owned();
        Ended {
            status: ExitStatus::from_raw(raw),
            stdout: output("stdout"),
            stderr: output("stderr"),
            // The kernel counts the memory of this process, from which the command was forked, as well.
            peak_bytes: match usage.ru_maxrss as u64 * 1024 {
                peak_bytes if peak_bytes > peak_bytes_of(std::process::id().cast_signed()) => peak_bytes,
                _ => seen_bytes,
            },
            too_long,
        }
    }

    /// Sends a signal to the process, which may have ended.
    pub fn signal(&self, number: i32) {
        // SAFETY: nothing has waited for this process, so its ID has not been reused.
        unsafe { libc::kill(self.id, number) };
    }
}
