//! Texts in YAML.

use std::fmt::Write as _;

/// A scalar that is read back as `text`: as it is where nothing in it means anything in YAML, else in quotes.
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
    // What would stand for a variable of the environment.
    for c in text.replace("${", "$${").chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_ascii() && !c.is_control() => quoted.push(c),
            // Signs as the degree's; the soft hyphen is not to be seen.
            '\u{a1}'..='\u{ac}' | '\u{ae}'..='\u{ff}' => quoted.push(c),
            c if c.is_alphanumeric() => quoted.push(c),
            // A write to a String cannot fail.
            c => _ = write!(quoted, "\\U{:08x}", u32::from(c)),
        }
    }
    quoted.push('"');
    quoted
}

/// A text that stays within its comment and steers no terminal.
pub(super) fn comment(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect()
}

/// Words in comments of at most [`WIDTH`] characters, each line beginning with `lead`.
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
