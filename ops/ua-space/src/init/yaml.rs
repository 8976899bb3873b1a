//! Writes text in YAML.

use std::fmt::Write as _;

/// Returns a scalar that parses as `text`: plain if no character is special in YAML, otherwise
/// quoted.
pub(super) fn scalar(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_/=;.-+: ".contains(c);
    let begins = text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '/');
    let word = matches!(
        text.to_ascii_lowercase().as_str(),
        "null" | "true" | "false" | "yes" | "no" | "on" | "off" | "y" | "n"
    );
    let is_key = text.contains(": ") || text.ends_with(':');
    if begins && !text.ends_with(' ') && !is_key && !word && text.chars().all(plain) {
        return text.to_owned();
    }
    let mut quoted = String::from('"');
    // `${` would start an environment variable.
    for c in text.replace("${", "$${").chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_ascii() && !c.is_control() => quoted.push(c),
            // Signs such as the degree sign; the soft hyphen is invisible.
            '\u{a1}'..='\u{ac}' | '\u{ae}'..='\u{ff}' => quoted.push(c),
            c if c.is_alphanumeric() => quoted.push(c),
            // Writing to a String does not fail.
            c => _ = write!(quoted, "\\U{:08x}", u32::from(c)),
        }
    }
    quoted.push('"');
    quoted
}

/// Replaces control characters, so the text stays within its comment and sends no commands to a
/// terminal.
pub(super) fn comment(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect()
}

/// Joins words to comment lines of at most [`WIDTH`] characters, each starting with `lead`.
pub(super) fn wrapped(lead: &str, words: impl IntoIterator<Item = String>) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in words {
        match lines.last_mut() {
            Some(line) if line.len() + 1 + word.len() <= WIDTH => {
                line.push(' ');
                line.push_str(&word);
            }
            _ => lines.push(format!("{lead}{word}")),
        }
    }
    lines
}

const WIDTH: usize = 110;

#[cfg(test)]
mod tests {
    use mappings::Mapping;
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn what_is_plain_has_no_quotes() {
        for text in [
            "/conveyor/running",
            "ns=2;i=10",
            "urn:my-plant:line",
            "Running.Left 2",
        ] {
            assert_eq!(scalar(text), text);
        }
        for text in [
            "a: b", "a:", "true", "No", "1", "", "a #b", " a", "a ", "-", "[a", "\u{85}",
        ] {
            assert!(scalar(text).starts_with('"'), "{text:?}");
        }
    }

    proptest! {
        #[test]
        fn every_text_is_read_as_it_was(text in "\\PC{1,20}|[ -~]{1,20}|\\s{0,3}[:#{},a-c\"\\\\\n]{1,9}") {
            let text = format!("ns=2;s={text}");
            let document = format!(
                "namespaces: {{2: urn:a}}\nvariables:\n  - {{node: {}, alias: 1, name: a, origin: 0}}\n",
                scalar(&text)
            );
            let checked = Mapping::from_yaml(&document, "x");
            let mapping = checked.mapping.ok_or_else(|| TestCaseError::fail(document.clone()))?;
            let node = mapping.variables().first().map(|one| one.node.to_string());
            prop_assert_eq!(node, Some(text));
        }
    }
}
