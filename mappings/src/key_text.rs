//! Keys in places that are not secret, such as the document itself.

use std::borrow::Cow;

/// Number of hexadecimal digits in a row that are taken for a key: 16 bytes.
const DIGITS: usize = 32;

/// Returns `true` if the text is a key, alone or as the last part of a path.
pub(crate) fn is_key(text: &str) -> bool {
    let text = text.rsplit('/').next().unwrap_or_default();
    text.len() >= DIGITS && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Masks possible keys in a text, with as many characters as before.
pub(crate) fn without_keys(text: Cow<'_, str>) -> Cow<'_, str> {
    let is_digit = |c: char| c.is_ascii_hexdigit();
    if !text.split(|c| !is_digit(c)).any(|run| run.len() >= DIGITS) {
        return text;
    }
    let mut out = String::with_capacity(text.len());
    let mut rest = &*text;
    while !rest.is_empty() {
        let end = rest.find(|c| !is_digit(c)).unwrap_or(rest.len());
        let (run, behind) = rest.split_at(end);
        if run.len() >= DIGITS {
            out.extend(run.chars().map(|_| '*'));
        } else {
            out.push_str(run);
        }
        let next = behind.find(is_digit).unwrap_or(behind.len());
        let (between, behind) = behind.split_at(next);
        out.push_str(between);
        rest = behind;
    }
    Cow::Owned(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_not_shown_and_all_else_is() {
        let key = "0a".repeat(16);
        let stars = "*".repeat(32);
        for (text, told) in [
            (
                format!("keys: {{file: {key}}}"),
                format!("keys: {{file: {stars}}}"),
            ),
            (format!("{key}, {key}"), format!("{stars}, {stars}")),
            (format!("ä{key}.keys"), format!("ä{stars}.keys")),
            ("file: abc.keys".to_owned(), "file: abc.keys".to_owned()),
            ("0a".repeat(15), "0a".repeat(15)),
        ] {
            assert_eq!(without_keys(Cow::Borrowed(&text)), told);
        }
        assert!(is_key(&format!("keys/{key}")) && !is_key("cell.keys"));
    }
}
