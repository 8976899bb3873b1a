//! The encodings of strings in ISO 10303-21.

/// Decodes the directives of a string: `\X\`, `\X2\`, `\X4\`, `\S\` and `\\`. Bytes beyond ASCII
/// are UTF-8, or ISO 8859-1 if they are no UTF-8. Directives that are wrong stay as they are.
pub(crate) fn decoded(raw: &[u8]) -> String {
    let text: String = match std::str::from_utf8(raw) {
        Ok(text) => text.to_owned(),
        Err(_) => raw.iter().map(|byte| char::from(*byte)).collect(),
    };
    let mut all = String::with_capacity(text.len());
    let mut rest = text.as_str();
    while let Some(at) = rest.find('\\') {
        let (before, behind) = rest.split_at(at);
        all.push_str(before);
        match directive(behind) {
            Some((read, left)) => {
                all.push_str(&read);
                rest = left;
            }
            None => {
                all.push('\\');
                rest = behind.get(1..).unwrap_or_default();
            }
        }
    }
    all.push_str(rest);
    all
}

/// Reads a directive. Returns its text and the rest behind it.
fn directive(text: &str) -> Option<(String, &str)> {
    if let Some(rest) = text.strip_prefix("\\\\") {
        return Some(("\\".to_owned(), rest));
    }
    if let Some(rest) = text.strip_prefix("\\S\\") {
        let mut chars = rest.chars();
        let code = u32::from(chars.next().filter(char::is_ascii)?);
        let read = char::from_u32(code + 128)?;
        return Some((read.to_string(), chars.as_str()));
    }
    if let Some(rest) = text.strip_prefix("\\X\\") {
        let (digits, rest) = rest.split_at_checked(2)?;
        let code = u8::from_str_radix(digits, 16).ok()?;
        return Some((char::from(code).to_string(), rest));
    }
    if let Some(rest) = text.strip_prefix("\\X2\\") {
        let (digits, rest) = rest.split_once("\\X0\\")?;
        let units: Option<Vec<u16>> = groups(digits, 4)
            .map(|group| u16::from_str_radix(group?, 16).ok())
            .collect();
        return Some((String::from_utf16_lossy(&units?), rest));
    }
    if let Some(rest) = text.strip_prefix("\\X4\\") {
        let (digits, rest) = rest.split_once("\\X0\\")?;
        let read: Option<String> = groups(digits, 8)
            .map(|group| char::from_u32(u32::from_str_radix(group?, 16).ok()?))
            .collect();
        return Some((read?, rest));
    }
    // `\PA\` chooses a page of ISO 8859 for `\S\`.
    let rest = text.strip_prefix("\\P")?;
    let (page, rest) = rest.split_once('\\')?;
    (page.len() == 1).then(|| (String::new(), rest))
}

/// Returns pieces of a length in bytes; `None` for a piece within a character, or too short.
fn groups(text: &str, length: usize) -> impl Iterator<Item = Option<&str>> {
    let starts = (0..text.len()).step_by(length);
    starts.map(move |start| text.get(start..start + length))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directives_are_characters() {
        for (raw, expected) in [
            (&b"plain"[..], "plain"),
            (b"a\\\\b", "a\\b"),
            (b"\\X\\E4", "\u{e4}"),
            (b"\\S\\d", "\u{e4}"),
            (b"\\PA\\x", "x"),
            (b"\\X2\\00E4D83DDE00\\X0\\!", "\u{e4}\u{1f600}!"),
            (b"\\X4\\0001F600\\X0\\", "\u{1f600}"),
            (b"\\X2\\00E", "\\X2\\00E"),
            (b"\xe4", "\u{e4}"),
            ("\u{e4}".as_bytes(), "\u{e4}"),
        ] {
            assert_eq!(decoded(raw), expected, "{raw:?}");
        }
    }
}
