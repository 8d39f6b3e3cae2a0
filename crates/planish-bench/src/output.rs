//! Standard output and standard error of a command. `println!` would panic if they were closed or full.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write};
use std::process::exit;
use std::sync::atomic::{AtomicBool, Ordering};

/// The exit code for output that cannot be written, the same as for bad input.
const FAILED: i32 = 2;

/// True once the reader of standard output has closed it.
static CLOSED: AtomicBool = AtomicBool::new(false);

/// Writes to standard output. If the reader has closed it, as `head` does, the command continues silently; any other
/// failure ends the process with an error.
pub fn print(text: Arguments<'_>) {
    if CLOSED.load(Ordering::Relaxed) {
        return;
    }
    if let Err(error) = write(&mut std::io::stdout().lock(), text) {
        if error.kind() == ErrorKind::BrokenPipe {
            CLOSED.store(true, Ordering::Relaxed);
            return;
        }
        print_error(format_args!("error: cannot write to standard output: {error}"));
        exit(FAILED);
    }
}

/// Writes a line to standard error; ignores failures. Line breaks in the text are escaped, since they may come from the
/// name of a file and imitate another message.
pub fn print_error(text: Arguments<'_>) {
    let text = text.to_string();
    let line = planish::io::printable_line(&text) + "\n";
    let _ = std::io::stderr().lock().write_all(line.as_bytes());
}

/// Writes a text in one call, without terminal control characters.
fn write(to: &mut impl Write, text: Arguments<'_>) -> std::io::Result<()> {
    match text.as_str() {
        Some(text) => to.write_all(planish::io::printable(text).as_bytes()),
        None => to.write_all(planish::io::printable(&text.to_string()).as_bytes()),
    }
}

/// Same as `println!`, but does not panic.
#[macro_export]
macro_rules! outln {
    () => { $crate::output::print(format_args!("\n")) };
    ($($text:tt)*) => { $crate::output::print(format_args!("{}\n", format_args!($($text)*))) };
}

/// Same as `print!`, but does not panic.
#[macro_export]
macro_rules! out {
    ($($text:tt)*) => { $crate::output::print(format_args!($($text)*)) };
}

/// Same as `eprintln!`, but does not panic.
#[macro_export]
macro_rules! errln {
    ($($text:tt)*) => { $crate::output::print_error(format_args!($($text)*)) };
}
