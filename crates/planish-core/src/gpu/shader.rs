//! Strips comment lines and indentation from the files of `shaders/`, so that a browser does not have to load them.

/// Includes a shader file without its comment lines and indentation.
macro_rules! shader {
    ($path:literal) => {{
        const SOURCE: &[u8] = include_str!($path).as_bytes();
        const CODE: [u8; $crate::gpu::shader::code_len(SOURCE)] = $crate::gpu::shader::code(SOURCE);
        const TEXT: &str = match std::str::from_utf8(&CODE) {
            Ok(text) => text,
            Err(_) => panic!("a shader is not UTF-8"),
        };
        TEXT
    }};
}
pub(super) use shader;

/// Returns the index of the first character after the indentation of the line that starts at `start`, the index after
/// the line, and whether the line is a comment.
const fn line(source: &[u8], start: usize) -> (usize, usize, bool) {
    let mut at = start;
    while at < source.len() && source[at] == b' ' {
        at += 1;
    }
    let first = at;
    let is_comment = at + 1 < source.len() && source[at] == b'/' && source[at + 1] == b'/';
    while at < source.len() && source[at] != b'\n' {
        at += 1;
    }
    (first, if at < source.len() { at + 1 } else { at }, is_comment)
}

/// Returns the number of bytes of all lines except comments, without indentation.
pub(super) const fn code_len(source: &[u8]) -> usize {
    let (mut at, mut len) = (0, 0);
    while at < source.len() {
        let (first, end, is_comment) = line(source, at);
        if !is_comment {
            len += end - first;
        }
        at = end;
    }
    len
}

/// Returns all lines except comments, without indentation.
pub(super) const fn code<const LEN: usize>(source: &[u8]) -> [u8; LEN] {
    let mut code = [0; LEN];
    let (mut at, mut len) = (0, 0);
    while at < source.len() {
        let (first, end, is_comment) = line(source, at);
        at = first;
        while at < end {
            if !is_comment {
                code[len] = source[at];
                len += 1;
            }
            at += 1;
        }
    }
    code
}

#[cfg(test)]
mod tests {
    use super::{code, code_len};

    #[test]
    fn only_lines_of_comments_and_indentation_go() {
        const SOURCE: &[u8] = b"// a\nfn f() { // kept\n    // b\n    return; }\n//";
        const CODE: [u8; code_len(SOURCE)] = code(SOURCE);
        assert_eq!(std::str::from_utf8(&CODE).unwrap(), "fn f() { // kept\nreturn; }\n");
    }
}
