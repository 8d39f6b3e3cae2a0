//! Prepares text from files for use in messages.

use std::borrow::Cow;

/// Escapes control characters and direction marks in the form that JSON uses, such as `\u001b`, so that text is safe to
/// print to a terminal. Keeps line breaks and tabs. Use it for all printed text.
pub fn printable(text: &str) -> Cow<'_, str> {
    escaped(text, |c| is_hidden(c) && !matches!(c, '\n' | '\t'))
}

/// Like [`printable`], but also escapes line breaks and tabs, so that a name from a file cannot imitate a line of
/// output.
pub fn printable_line(text: &str) -> Cow<'_, str> {
    escaped(text, is_hidden)
}

fn is_hidden(c: char) -> bool {
    c.is_control() || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

fn escaped(text: &str, is_hidden: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_hidden) {
        return Cow::Borrowed(text);
    }
    let escaped = text.chars().map(|c| if is_hidden(c) { format!("\\u{:04x}", c as u32) } else { c.to_string() });
    Cow::Owned(escaped.collect())
}

/// Returns up to 80 characters of a text from a file, in quotes, for error messages.
pub fn quoted(text: &str) -> String {
    const MOST: usize = 80;
    match text.char_indices().nth(MOST) {
        Some((end, _)) => format!("{:?}...", &text[..end]),
        None => format!("{text:?}"),
    }
}

/// Returns up to 160 characters of a message that may quote a file, on one line.
pub fn brief(message: &str) -> String {
    const MOST: usize = 160;
    // Each word has at least one character, so this many words suffice.
    let message = message.split_whitespace().take(MOST).collect::<Vec<_>>().join(" ");
    match message.char_indices().nth(MOST) {
        Some((end, _)) => format!("{}...", &message[..end]),
        None => message,
    }
}

/// Decodes UTF-8, falling back to Latin-1.
pub(crate) fn text_of(bytes: &[u8]) -> Cow<'_, str> {
    match std::str::from_utf8(bytes) {
        Ok(text) => text.into(),
        Err(_) => bytes.iter().map(|&byte| char::from(byte)).collect::<String>().into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_controls_a_terminal_is_written_out_and_other_text_is_kept() {
        assert!(matches!(printable("Höhe 試 \t\"x\"\n"), Cow::Borrowed(_)));
        assert_eq!(printable("a\u{1b}[2Jb\r\u{9b}c\u{7f}"), "a\\u001b[2Jb\\u000d\\u009bc\\u007f");
        assert_eq!(printable("exe\u{202e}dcp"), "exe\\u202edcp");
        assert_eq!(printable_line("/a\n/b\tc"), "/a\\u000a/b\\u0009c");
    }

    #[test]
    fn long_messages_are_cut_and_their_words_joined() {
        assert_eq!((brief(""), brief(" a\n\tb  c ")), (String::new(), "a b c".to_owned()));
        let words = "é ".repeat(80);
        assert_eq!(brief(&words), words.trim_end());
        assert_eq!(brief(&format!("{words}éé")), format!("{words}..."));
        let whole = "é".repeat(160);
        assert_eq!((brief(&whole), brief(&format!("{whole} ")), brief(&format!("{whole} b"))), {
            (whole.clone(), whole.clone(), format!("{whole}..."))
        });
        assert_eq!(brief(&"é".repeat(1 << 20)), whole + "...");
    }
}
