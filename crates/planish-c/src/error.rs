//! Error codes, and the error messages of each thread.

use std::cell::RefCell;
use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};

use planish::{EngineError, Error, FrameError, ParamError};

/// The return value of a function: 0, or an error code.
pub type planish_code = i32;

/// Success.
pub const PLANISH_OK: planish_code = 0;
/// A required pointer is null.
pub const PLANISH_NULL: planish_code = 1;
/// Sizes, strides or buffers contradict each other, or a frame cannot be smoothed.
pub const PLANISH_ARGUMENT: planish_code = 2;
/// A setting is unknown, out of range, or contradicts another one.
pub const PLANISH_SETTING: planish_code = 3;
/// The engine cannot be opened, or it failed.
pub const PLANISH_ENGINE: planish_code = 4;
/// Another thread is using the session or the CUDA smoother.
pub const PLANISH_BUSY: planish_code = 5;
/// The handle does not exist, or was freed.
pub const PLANISH_HANDLE: planish_code = 6;
/// planish_session_stop ended the call.
pub const PLANISH_STOPPED: planish_code = 7;
/// An internal error of planish. Free the session, and report the error.
pub const PLANISH_INTERNAL: planish_code = 8;

/// An error with its text.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) code: planish_code,
    pub(crate) text: String,
}

pub(crate) type Done<T> = Result<T, Failure>;

pub(crate) fn failure<T>(code: planish_code, text: impl Into<String>) -> Done<T> {
    Err(Failure { code, text: text.into() })
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let code = match &error {
            Error::Engine(EngineError::Stopped) => PLANISH_STOPPED,
            Error::Engine(EngineError::Full { .. }) => PLANISH_ARGUMENT,
            Error::Engine(_) => PLANISH_ENGINE,
            Error::Param(_) => PLANISH_SETTING,
            _ => PLANISH_ARGUMENT,
        };
        Self { code, text: error.to_string() }
    }
}

impl From<FrameError> for Failure {
    fn from(error: FrameError) -> Self {
        Self { code: PLANISH_ARGUMENT, text: error.to_string() }
    }
}

impl From<ParamError> for Failure {
    fn from(error: ParamError) -> Self {
        Self { code: PLANISH_SETTING, text: error.to_string() }
    }
}

thread_local! {
    static LAST: RefCell<CString> = RefCell::new(CString::default());
}

/// Runs the body of a C function and returns its code. Stores the message of an error for `planish_last_error`.
pub(crate) fn guarded(body: impl FnOnce() -> Done<()>) -> planish_code {
    // A session that panicked refuses further calls: its lock is poisoned.
    let done = catch_unwind(AssertUnwindSafe(body))
        .unwrap_or_else(|_| failure(PLANISH_INTERNAL, "planish had an internal error; please report it"));
    let Err(Failure { code, text }) = done else { return PLANISH_OK };
    let text = CString::new(text.replace('\0', " ")).unwrap_or_default();
    // Fails only while the thread ends.
    let _ = LAST.try_with(|last| last.replace(text));
    code
}

/// Returns the message of this thread's last error in UTF-8; it is empty if there was none. The pointer is valid
/// until the next error on this thread.
#[unsafe(no_mangle)]
pub extern "C" fn planish_last_error() -> *const c_char {
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

/// Returns the version of the library, such as "0.1.0".
#[unsafe(no_mangle)]
pub extern "C" fn planish_version() -> *const c_char {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    VERSION.as_ptr().cast()
}
