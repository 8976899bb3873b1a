//! Hexadecimal text: parses pasted digits, and shows the bytes around a fault.

use std::fmt::Write as _;

/// A character that is not valid in hexadecimal text.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}, column {column}: {what}")]
pub(crate) struct HexError {
    line: usize,
    column: usize,
    what: String,
}

/// Parses pairs of digits. Blanks and commas may separate bytes, `0x` may precede them, and `#`
/// starts a comment.
pub(crate) fn parse(text: &str) -> Result<Vec<u8>, HexError> {
    let mut bytes = Vec::with_capacity(text.len() / 2);
    for (line, number) in text.lines().zip(1..) {
        parse_line(line, number, &mut bytes)?;
    }
    Ok(bytes)
}

/// Parses a line of such text; `number` is the line number.
pub(crate) fn parse_line(line: &str, number: usize, bytes: &mut Vec<u8>) -> Result<(), HexError> {
    let digits = line.split('#').next().unwrap_or_default();
    let mut column = 1;
    for word in digits.split([' ', '\t', '\r', ',']) {
        let at = column;
        column += word.chars().count() + 1;
        let bare = word.strip_prefix("0x").or_else(|| word.strip_prefix("0X"));
        parse_word(bare.unwrap_or(word), bytes).map_err(|(offset, what)| HexError {
            line: number,
            column: at + offset + bare.map_or(0, |_| 2),
            what,
        })?;
    }
    Ok(())
}

/// Parses a word; an error has the index of the character in the word.
fn parse_word(word: &str, bytes: &mut Vec<u8>) -> Result<(), (usize, String)> {
    let mut high = None;
    for (character, at) in word.chars().zip(0..) {
        let Some(digit) = character.to_digit(16) else {
            return Err((at, format!("`{character}` is no hexadecimal digit")));
        };
        let digit = u8::try_from(digit).unwrap_or_default();
        match high.take() {
            None => high = Some(digit),
            Some(high) => bytes.push(high << 4 | digit),
        }
    }
    match high {
        None => Ok(()),
        Some(_) => Err((
            word.chars().count() - 1,
            format!("`{word}` has a digit without its pair"),
        )),
    }
}

/// Formats bytes in lower case, without blanks.
pub(crate) fn text(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a String does not fail.
        let _written = write!(text, "{byte:02x}");
        text
    })
}

/// Returns the lines of 16 bytes around `at`, each with the offset of its first byte, and a caret
/// below the byte at `at`.
pub(crate) fn around(bytes: &[u8], at: usize) -> String {
    let line = at / LINE;
    let mut out = String::new();
    for (chunk, number) in bytes.chunks(LINE).zip(0..) {
        if number + 1 >= line && number <= line + 1 {
            let hex: Vec<_> = chunk.chunks(1).map(text).collect();
            let _written = writeln!(out, "  {:04x}  {}", number * LINE, hex.join(" "));
        }
        if number == line {
            let _written = writeln!(out, "{}^^", " ".repeat(MARGIN + at % LINE * 3));
        }
    }
    if at == bytes.len() && at.is_multiple_of(LINE) {
        // The position after a full last line.
        let _written = writeln!(out, "  {at:04x}\n{}^^", " ".repeat(MARGIN));
    }
    out
}

const LINE: usize = 16;
/// Number of columns before the first byte.
const MARGIN: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_are_read_whatever_stands_between_them() {
        let bytes = [0xF1, 0x01, 0xBA, 0x08];
        for text in [
            "f101ba08",
            "F1 01\tBA\r\n08\n",
            "0xf1, 0x01, 0xBA,0x08",
            "0xF101BA08",
            "# a header\nf101 # version 1\n\n ba08#f1",
        ] {
            assert_eq!(parse(text), Ok(bytes.to_vec()), "{text}");
        }
        assert_eq!(parse("# nothing"), Ok(Vec::new()));
    }

    #[test]
    fn what_is_no_digit_is_named_with_its_place() {
        for (text, message) in [
            ("f1 0g", "line 1, column 5: `g` is no hexadecimal digit"),
            (
                "f1\n 0x1",
                "line 2, column 4: `1` has a digit without its pair",
            ),
            (
                "f1 012",
                "line 1, column 6: `012` has a digit without its pair",
            ),
            ("{\"a\"", "line 1, column 1: `{` is no hexadecimal digit"),
        ] {
            assert_eq!(parse(text).unwrap_err().to_string(), message, "{text}");
        }
    }

    #[test]
    fn the_caret_stands_below_its_byte() {
        let bytes: Vec<u8> = (0..40).collect();
        assert_eq!(
            around(&bytes, 18),
            "  0000  00 01 02 03 04 05 06 07 08 09 0a 0b 0c 0d 0e 0f\n\
             \x20 0010  10 11 12 13 14 15 16 17 18 19 1a 1b 1c 1d 1e 1f\n\
             \x20             ^^\n\
             \x20 0020  20 21 22 23 24 25 26 27\n"
        );
        assert_eq!(
            around(&bytes[..32], 32),
            "  0010  10 11 12 13 14 15 16 17 18 19 1a 1b 1c 1d 1e 1f\n\
             \x20 0020\n\
             \x20       ^^\n"
        );
        assert_eq!(around(&[7], 1), "  0000  07\n           ^^\n");
    }
}
