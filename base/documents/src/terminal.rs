//! Foreign texts on a terminal.

use std::fmt::Write as _;

/// Returns `true` if a terminal obeys a character instead of showing it: control characters of
/// ASCII and of ISO 6429 (U+0080 to U+009F), and the marks that change the direction of the text
/// around them.
#[must_use]
pub fn is_obeyed(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Escapes the characters of a JSON document that a terminal obeys (`\u009b`). Line breaks stay.
/// The document means the same, because such characters occur only inside its strings.
#[must_use]
pub fn harmless_json(json: &str) -> String {
    let mut escaped = String::with_capacity(json.len());
    for c in json.chars() {
        if is_obeyed(c) && !matches!(c, '\n' | '\r' | '\t') {
            // Writing to a `String` cannot fail.
            let _written = write!(escaped, "\\u{:04x}", u32::from(c));
        } else {
            escaped.push(c);
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_keeps_its_meaning_without_what_a_terminal_obeys() {
        let json = "{\"a\u{9b}2J\":\n\t\"\u{202e}b\u{2028}\u{61c}\u{7f}ü€😀\\u001b\"}";
        let wanted = "{\"a\\u009b2J\":\n\t\"\\u202eb\\u2028\\u061c\\u007fü€😀\\u001b\"}";
        assert_eq!(harmless_json(json), wanted);
    }
}
