//! What the command ends with.

/// An exit code: 0 done, 1 some frames failed, 2 bad arguments or input, 130 ended by a signal. That of the standard
/// library does not tell its number, which Python's side needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExitCode(u8);

impl ExitCode {
    /// All is done.
    pub const SUCCESS: Self = Self(0);

    /// Its number.
    pub fn number(self) -> u8 {
        self.0
    }
}

impl From<u8> for ExitCode {
    fn from(number: u8) -> Self {
        Self(number)
    }
}
