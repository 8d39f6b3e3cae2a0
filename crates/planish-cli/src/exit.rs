//! Exit codes of the command.

/// An exit code: 0 done, 1 some frames failed, 2 bad arguments or input, 130 ended by a signal. The standard library's
/// type does not expose its number, which the Python package needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExitCode(u8);

impl ExitCode {
    /// Success.
    pub const SUCCESS: Self = Self(0);

    /// Returns the exit code as a number.
    pub fn number(self) -> u8 {
        self.0
    }
}

impl From<u8> for ExitCode {
    fn from(number: u8) -> Self {
        Self(number)
    }
}
