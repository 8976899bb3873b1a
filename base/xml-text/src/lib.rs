//! Decodes XML documents (XML 1.0, 4.3.3 and appendix F). The encoding is that of the byte order
//! mark, or else of the declaration, or else UTF-8.
//!
//! Engineering tools export UTF-16 and ISO-8859-1 as well as UTF-8. The parsers of the workspace
//! read text only, and compare the attributes of an element pairwise, so that
//! [`has_more_attributes`] limits their number. [`walk`] reads the elements of a document one after
//! the other.

mod walk;

use std::borrow::Cow;

use quick_xml::escape::escape;
pub use walk::{LocatedXmlFault, XmlAttributeFault, XmlElement, XmlFault, XmlVisitor, walk};

/// Error of decoding a document.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodingError {
    /// The bytes do not match the declared encoding.
    #[error("line {line}: the bytes are not {encoding}; save the file as UTF-8")]
    Malformed {
        /// Line of the first wrong byte, from 1.
        line: usize,
        /// Name of the encoding.
        encoding: &'static str,
    },
    /// The declaration names an encoding that is not supported.
    #[error("the encoding `{0}` is not supported; save the file as UTF-8")]
    Unsupported(String),
}

/// Returns text for the content or an attribute of an XML document: with its special characters
/// escaped, and without the control characters that XML does not allow.
#[must_use]
pub fn xml_printable(text: &str) -> String {
    let is_allowed = |c: &char| !c.is_control() && !matches!(c, '\u{FFFE}' | '\u{FFFF}');
    let text: String = text.chars().filter(is_allowed).collect();
    escape(text).into_owned()
}

/// Decodes a document. The byte order mark is omitted, the declaration stays unchanged.
///
/// # Errors
/// [`EncodingError`] if the encoding is unknown, or the bytes do not match it.
pub fn decode(bytes: &[u8]) -> Result<Cow<'_, str>, EncodingError> {
    let (encoding, bytes) = detect(bytes)?;
    let malformed = |before: usize| EncodingError::Malformed {
        line: before + 1,
        encoding: encoding.name(),
    };
    match encoding {
        Encoding::Utf8 => std::str::from_utf8(bytes)
            .map(Cow::Borrowed)
            .map_err(|error| {
                let before = bytes.get(..error.valid_up_to()).unwrap_or_default();
                malformed(before.iter().filter(|byte| **byte == b'\n').count())
            }),
        Encoding::Utf16(order) => {
            let (units, rest) = bytes.as_chunks::<2>();
            let units = units.iter().map(|unit| match order {
                Order::Little => u16::from_le_bytes(*unit),
                Order::Big => u16::from_be_bytes(*unit),
            });
            let mut text = String::with_capacity(bytes.len() / 2);
            for unit in char::decode_utf16(units) {
                let lines = |text: &str| text.matches('\n').count();
                text.push(unit.map_err(|_| malformed(lines(&text)))?);
            }
            match rest {
                [] => Ok(Cow::Owned(text)),
                _ => Err(malformed(text.matches('\n').count())),
            }
        }
        Encoding::Latin1 => Ok(Cow::Owned(
            bytes.iter().map(|byte| char::from(*byte)).collect(),
        )),
        Encoding::Windows1252 => Ok(Cow::Owned(
            bytes.iter().map(|byte| windows(*byte)).collect(),
        )),
    }
}

/// Returns whether a tag of a document has more than `most` attributes, in linear time.
///
/// Parsers compare the attributes of an element pairwise. Declarations of namespaces count too.
/// The document need not be well-formed.
#[must_use]
pub fn has_more_attributes(document: &str, most: usize) -> bool {
    let mut rest = document;
    while let Some((_, markup)) = rest.split_once('<') {
        rest = match behind_other(markup) {
            Some(behind) => behind,
            None => {
                let (count, behind) = attributes(markup);
                if count > most {
                    return true;
                }
                behind
            }
        };
    }
    false
}

/// Returns the text behind a comment, CDATA section or instruction. The markup begins after `<`.
fn behind_other(markup: &str) -> Option<&str> {
    let kinds = [("!--", "-->"), ("![CDATA[", "]]>"), ("?", "?>")];
    kinds.into_iter().find_map(|(start, end)| {
        let inside = markup.strip_prefix(start)?;
        Some(inside.split_once(end).map_or("", |(_, behind)| behind))
    })
}

/// Returns the number of attributes of a tag, and the text behind it. The tag begins after `<`.
fn attributes(tag: &str) -> (usize, &str) {
    let mut count = 0;
    let mut quote = None;
    for (at, byte) in tag.bytes().enumerate() {
        match (quote, byte) {
            (Some(open), _) if byte == open => quote = None,
            (Some(_), _) => {}
            (None, b'"' | b'\'') => quote = Some(byte),
            (None, b'=') => count += 1,
            (None, b'>') => return (count, tag.get(at + 1..).unwrap_or_default()),
            (None, _) => {}
        }
    }
    (count, "")
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Utf8,
    Utf16(Order),
    Latin1,
    Windows1252,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Order {
    Little,
    Big,
}

impl Encoding {
    const fn name(self) -> &'static str {
        match self {
            Self::Utf8 => "UTF-8",
            Self::Utf16(_) => "UTF-16",
            Self::Latin1 => "ISO-8859-1",
            Self::Windows1252 => "windows-1252",
        }
    }
}

/// Returns the encoding, and the bytes after the byte order mark.
fn detect(bytes: &[u8]) -> Result<(Encoding, &[u8]), EncodingError> {
    Ok(match bytes {
        [0xEF, 0xBB, 0xBF, rest @ ..] => (Encoding::Utf8, rest),
        [0xFF, 0xFE, rest @ ..] => (Encoding::Utf16(Order::Little), rest),
        [0xFE, 0xFF, rest @ ..] => (Encoding::Utf16(Order::Big), rest),
        // `<?` without a byte order mark.
        [b'<', 0, b'?', 0, ..] => (Encoding::Utf16(Order::Little), bytes),
        [0, b'<', 0, b'?', ..] => (Encoding::Utf16(Order::Big), bytes),
        _ => (declared(bytes)?, bytes),
    })
}

/// Returns the encoding in the declaration of a document in an ASCII-compatible encoding.
fn declared(bytes: &[u8]) -> Result<Encoding, EncodingError> {
    let start = bytes.get(..LONGEST_DECLARATION.min(bytes.len()));
    let start = String::from_utf8_lossy(start.unwrap_or_default());
    let declaration = start
        .strip_prefix("<?xml")
        .and_then(|rest| Some(rest.split_once("?>")?.0));
    let name = declaration.and_then(|declaration| {
        let (_, value) = declaration.split_once("encoding")?;
        let value = value.trim_start().strip_prefix('=')?.trim_start();
        let quote = value.chars().next().filter(|c| matches!(c, '"' | '\''))?;
        value.get(1..)?.split(quote).next()
    });
    let Some(name) = name else {
        return Ok(Encoding::Utf8);
    };
    match name.to_ascii_lowercase().as_str() {
        // A document that was converted often keeps the name of its previous encoding.
        "utf-8" | "utf8" | "us-ascii" | "ascii" | "utf-16" | "utf16" => Ok(Encoding::Utf8),
        "iso-8859-1" | "iso8859-1" | "latin1" | "latin-1" => Ok(Encoding::Latin1),
        "windows-1252" | "cp1252" => Ok(Encoding::Windows1252),
        _ => Err(EncodingError::Unsupported(name.chars().take(40).collect())),
    }
}

/// Returns the character of a byte in windows-1252, which differs from ISO-8859-1 in 32 bytes.
fn windows(byte: u8) -> char {
    let at = usize::from(byte).checked_sub(0x80);
    let special = at.and_then(|at| WINDOWS.get(at));
    special.copied().unwrap_or_else(|| char::from(byte))
}

/// The characters of 0x80 to 0x9F. Five bytes have no character.
const WINDOWS: [char; 32] = [
    '€', '\u{FFFD}', '‚', 'ƒ', '„', '…', '†', '‡', 'ˆ', '‰', 'Š', '‹', 'Œ', '\u{FFFD}', 'Ž',
    '\u{FFFD}', '\u{FFFD}', '‘', '’', '“', '”', '•', '–', '—', '˜', '™', 'š', '›', 'œ', '\u{FFFD}',
    'ž', 'Ÿ',
];
/// Limit of the length of a declaration, in bytes.
const LONGEST_DECLARATION: usize = 200;

#[cfg(test)]
mod tests {
    use super::*;

    fn utf16(text: &str, bytes_of: fn(u16) -> [u8; 2]) -> Vec<u8> {
        text.encode_utf16().flat_map(bytes_of).collect()
    }

    #[test]
    fn documents_are_decoded_by_mark_then_declaration_then_as_utf8() {
        let text =
            |encoding: &str| format!("<?xml version='1.0' encoding=\"{encoding}\"?>\n<a>°Cö</a>");
        let latin = |encoding: &str| -> Vec<u8> {
            let text = text(encoding);
            text.chars()
                .map(|c| u8::try_from(u32::from(c)).unwrap())
                .collect()
        };
        let wide = text("utf-16");
        for (bytes, expected) in [
            (text("UTF-8").into_bytes(), text("UTF-8")),
            (
                format!("\u{feff}{}", text("utf-8")).into_bytes(),
                text("utf-8"),
            ),
            ("<a>ö</a>".into(), "<a>ö</a>".to_owned()),
            (
                utf16(&format!("\u{feff}{wide}"), u16::to_le_bytes),
                wide.clone(),
            ),
            (
                utf16(&format!("\u{feff}{wide}"), u16::to_be_bytes),
                wide.clone(),
            ),
            (utf16(&wide, u16::to_le_bytes), wide.clone()),
            (utf16(&wide, u16::to_be_bytes), wide.clone()),
            (wide.clone().into_bytes(), wide.clone()),
            (latin("ISO-8859-1"), text("ISO-8859-1")),
            (latin("Windows-1252"), text("Windows-1252")),
            (vec![], String::new()),
        ] {
            assert_eq!(decode(&bytes).unwrap(), expected);
        }
        let euro = b"<?xml version='1.0' encoding='windows-1252'?><a>\x80\x9f</a>";
        assert!(decode(euro).unwrap().ends_with("<a>€Ÿ</a>"));
    }

    #[test]
    fn printable_text_is_escaped_and_has_no_control_characters() {
        assert_eq!(
            xml_printable("a<b>&\"c\"\u{7}\u{85}\u{FFFE} ö"),
            "a&lt;b&gt;&amp;&quot;c&quot; ö"
        );
    }

    #[test]
    fn attributes_are_counted_in_tags_only() {
        for (document, count) in [
            ("", 0),
            ("<a/>", 0),
            ("<a b='1'/>", 1),
            (
                "<?xml version='1.0'?><a b='1' xmlns:c = \"urn:c\">= = =</a>",
                2,
            ),
            ("<a b='= > <' c=\"'=\"><d e='1'/></a>", 2),
            ("<!-- <a b='' c='' d=''> ' --><a b=''/>", 1),
            ("<a><![CDATA[<b c='' d=''>\"]]></a>", 0),
            ("<a>it's<b c='ö' d='ü'>'</b></a>", 2),
            // Unfinished markup.
            ("<a b='1' c='", 2),
            ("<a b='1'><!-- <a b='' c=''>", 1),
            ("a<", 0),
        ] {
            assert!(!has_more_attributes(document, count), "{document}");
            let fewer = count.checked_sub(1);
            let is_more = fewer.is_none_or(|fewer| has_more_attributes(document, fewer));
            assert!(is_more, "{document}");
        }
    }

    #[test]
    fn bytes_that_do_not_fit_are_refused_with_their_line() {
        let line = |bytes: &[u8]| match decode(bytes) {
            Err(EncodingError::Malformed { line, encoding }) => (line, encoding),
            other => (0, if other.is_ok() { "read" } else { "unsupported" }),
        };
        assert_eq!(line(b"<a>\n\n\xf6</a>"), (3, "UTF-8"));
        // Half a pair of surrogates, half a unit.
        assert_eq!(line(b"\xff\xfe<\0\n\0\0\xd8<\0"), (2, "UTF-16"));
        assert_eq!(line(b"\xff\xfe<\0\n\0<"), (2, "UTF-16"));
        assert_eq!(
            decode(b"<?xml version='1.0' encoding='EBCDIC'?><a/>"),
            Err(EncodingError::Unsupported("EBCDIC".to_owned()))
        );
    }
}
