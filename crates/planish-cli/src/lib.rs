//! The command `planish`: parses arguments, calls the library and prints. It is a library so that the Python wheel can
//! include it.
//!
//! Exit codes: 0 done, 1 some frames failed, 2 bad arguments or input, 130 ended by a signal.

mod args;
mod commands;
mod exit;
mod signals;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::ffi::OsString;
use std::sync::atomic::{AtomicBool, AtomicPtr, Ordering};

use clap::{ArgAction, CommandFactory, FromArgMatches};
use planish_bench::errln;

use args::{Args, Command};

/// Runs the command with the given arguments, which begin with the program's name, and returns its exit code. Bad
/// arguments and `--help` end the process.
pub fn run(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    quiet_caught_panics();
    if let Err(error) = signals::install() {
        errln!("warning: {error:#}");
    }
    let command = parse(arguments).command;
    let started = planish::start_shared_threads().map_err(planish::Error::from).map_err(anyhow::Error::from);
    let result = started.and_then(|()| run_command(command));
    match result {
        Ok(code) => code.number(),
        Err(error) => {
            signals::wait_if_ending();
            errln!("error: {error:#}");
            2
        }
    }
}

fn run_command(command: Command) -> anyhow::Result<exit::ExitCode> {
    match command {
        Command::Demo(args) => commands::demo::run(&args),
        Command::Smooth(args) => commands::smooth::run(&args),
        Command::Clean(args) => commands::clean::run(&args),
        Command::Convert(args) => commands::convert::convert(&args),
        Command::Compare(args) => commands::convert::compare(&args),
        Command::Merge(args) => commands::convert::merge(&args),
        Command::Mesh(args) => commands::mesh::run(&args),
        Command::Info(args) => commands::info::run(&args),
        Command::Render(args) => commands::render::run(&args),
        Command::View(args) => commands::view::run(&args),
        Command::Stream(args) => commands::stream(&args),
        Command::Rig(args) => commands::rig::run(&args),
        Command::Record(args) => commands::record::run(&args),
        Command::Recover(args) => commands::recover::run(&args),
        Command::Devices(args) => commands::devices::run(&args),
        Command::Evaluate(args) => commands::evaluate::run(&args),
        Command::Bench(args) => commands::bench::run(&args),
        Command::Completions(args) => commands::manual::completions(&args),
        Command::Man(args) => commands::manual::man(&args),
    }
}

/// Parses the arguments. A negative number is passed to its option instead of being parsed as another option.
fn parse(arguments: impl IntoIterator<Item = OsString>) -> Args {
    fn with_negative_numbers(command: clap::Command) -> clap::Command {
        let takes_value = |argument: &clap::Arg| {
            argument.get_long().is_some() && matches!(argument.get_action(), ArgAction::Set | ArgAction::Append)
        };
        command
            .mut_args(|argument| if takes_value(&argument) { argument.allow_negative_numbers(true) } else { argument })
            .mut_subcommands(with_negative_numbers)
    }
    let arguments: Vec<OsString> = arguments.into_iter().collect();
    let is_plain =
        |argument: &OsString| argument.to_str().is_some_and(|text| planish::io::printable_line(text) == text);
    let matches = with_negative_numbers(Args::command()).try_get_matches_from(&arguments).unwrap_or_else(|error| {
        if arguments.iter().all(is_plain) {
            error.exit();
        }
        // The message quotes the arguments. Line breaks in them must not look like line breaks of the message.
        let message = arguments.iter().fold(error.render().to_string(), |message, argument| {
            let argument = argument.to_string_lossy();
            // The message may quote only the value of an option.
            let value = argument.split_once('=').map_or(&*argument, |(_, value)| value);
            let message = message.replace(&*argument, &planish::io::printable_line(&argument));
            message.replace(value, &planish::io::printable_line(value))
        });
        message.lines().for_each(|line| errln!("{line}"));
        std::process::exit(error.exit_code());
    });
    Args::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
}

/// Ends the process after an allocation of `bytes` bytes has failed: prints an error, finishes recordings and removes
/// unfinished files.
#[cold]
pub fn end_without_memory(bytes: usize) -> ! {
    thread_local! {
        static IS_ENDING: Cell<bool> = const { Cell::new(false) };
    }
    static IS_CLAIMED: AtomicBool = AtomicBool::new(false);
    if IS_ENDING.replace(true) {
        // The steps below ran out of memory themselves. Recordings stay in their part files.
        end_now();
    }
    if IS_CLAIMED.swap(true, Ordering::Relaxed) {
        // Another thread is ending the process.
        loop {
            std::thread::park();
        }
    }
    release_reserve();
    print_unlocked(format_args!(
        "error: out of memory: cannot allocate {} KiB; see --max-memory\n",
        bytes.div_ceil(1024)
    ));
    #[cfg(feature = "mcap")]
    planish::bag::finish_recordings();
    planish::io::remove_temporaries();
    end_now();
}

/// Size of the memory reserve in bytes, for the steps that end the process when the system has no memory left.
const RESERVE_BYTES: usize = 1 << 20;
static RESERVE: AtomicPtr<u8> = AtomicPtr::new(std::ptr::null_mut());

fn reserve_layout() -> Option<Layout> {
    Layout::from_size_align(RESERVE_BYTES, 1).ok()
}

/// Allocates the memory reserve, for programs whose allocator calls [`end_without_memory`]. The reserve is never
/// written, so it occupies only address space.
pub fn keep_reserve() {
    if let Some(layout) = reserve_layout()
        && RESERVE.load(Ordering::Relaxed).is_null()
    {
        // SAFETY: the layout's size is not 0. If the allocation fails, the program runs without a reserve.
        RESERVE.store(unsafe { System.alloc(layout) }, Ordering::Relaxed);
    }
}

fn release_reserve() {
    let reserve = RESERVE.swap(std::ptr::null_mut(), Ordering::Relaxed);
    if let Some(layout) = reserve_layout().filter(|_| !reserve.is_null()) {
        // SAFETY: the reserve was allocated with this layout, and only this call has the pointer.
        unsafe { System.dealloc(reserve, layout) };
    }
}

/// Ends the process with exit code 2 and without any cleanup. Cleanup takes locks of the standard library, and a thread
/// that ran out of memory while it started may hold one.
fn end_now() -> ! {
    #[cfg(unix)]
    {
        unsafe extern "C" {
            fn _exit(code: std::ffi::c_int) -> !;
        }
        // SAFETY: the function has this signature on every Unix.
        unsafe { _exit(2) }
    }
    #[cfg(not(unix))]
    std::process::exit(2)
}

/// Prints to standard error without its lock, which a thread that waits for memory may never release.
fn print_unlocked(text: std::fmt::Arguments<'_>) {
    #[cfg(unix)]
    {
        use std::io::Write;
        use std::os::fd::FromRawFd;
        // SAFETY: the descriptor stays open until the process ends, and is never closed here.
        let mut file = std::mem::ManuallyDrop::new(unsafe { std::fs::File::from_raw_fd(2) });
        let _ = file.write_fmt(text);
    }
    #[cfg(not(unix))]
    eprint!("{text}");
}

/// Suppresses the messages of panics that the library catches: some decoders panic on damaged files, which the
/// library reports as errors. A panic because a new thread lacks memory ends the process like a failed allocation.
fn quiet_caught_panics() {
    /// Part of the standard library's message if a thread gets no memory for its signal stack.
    const NO_SIGNAL_STACK: &str = "alternative stack";
    /// Size of a signal stack in bytes.
    const SIGNAL_STACK: usize = 8 << 10;
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let message = panic.payload().downcast_ref::<String>().map_or("", String::as_str);
        if message.contains(NO_SIGNAL_STACK) {
            end_without_memory(SIGNAL_STACK);
        }
        if !planish::io::internal::catches_panics() {
            usual(panic);
        }
    }));
}
