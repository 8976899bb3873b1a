//! Instance names of DNS-SD (RFC 6763, 4.1.1).

/// Returns a unique name from the requested name, the host and the port. It can be announced at
/// once, without the three probes of RFC 6762, 8.1, which take 0.75 s.
#[must_use]
pub fn instance_name(wish: &str, host: &str, port: u16) -> String {
    let tail = format!("-{}-{port}", cut(&clean(host), MAX_HOST));
    format!("{}{tail}", cut(&clean(wish), MAX_LABEL - tail.len()))
}

/// Returns the next name after a conflict with another host (RFC 6762, 9): `arm (2)` after `arm`,
/// `arm (3)` after `arm (2)`.
#[must_use]
pub fn renamed(name: &str) -> String {
    let counted = name.strip_suffix(')').and_then(|rest| {
        let (base, count) = rest.rsplit_once(" (")?;
        Some((base, count.parse::<u32>().ok()?))
    });
    let (base, count) = counted.unwrap_or((name, 1));
    let tail = format!(" ({})", count.saturating_add(1));
    format!("{}{tail}", cut(base, MAX_LABEL - tail.len()))
}

/// Returns a text as one label of DNS: without control characters, and of at most 63 bytes.
#[must_use]
pub fn label(text: &str) -> String {
    cut(&clean(text), MAX_LABEL).to_owned()
}

/// Removes control characters, which must not appear on pages and in logs.
fn clean(text: &str) -> String {
    text.chars().filter(|letter| !letter.is_control()).collect()
}

/// Returns the longest prefix of whole characters within a number of bytes.
fn cut(text: &str, most: usize) -> &str {
    let end = (0..=most.min(text.len()))
        .rev()
        .find(|end| text.is_char_boundary(*end));
    text.get(..end.unwrap_or(0)).unwrap_or_default()
}

/// Maximum length of a label of DNS.
const MAX_LABEL: usize = 63;
const MAX_HOST: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_tells_the_server_the_host_and_the_port() {
        assert_eq!(
            instance_name("gripper", "cell-pc", 4841),
            "gripper-cell-pc-4841"
        );
        let long = instance_name(&"ü".repeat(80), &"h".repeat(80), 65535);
        assert!(long.len() <= 63 && long.ends_with("h-65535"), "{long}");
        assert_eq!(instance_name("a\nb", "h", 1), "ab-h-1");
    }

    #[test]
    fn a_name_that_is_taken_is_counted_on() {
        assert_eq!(renamed("arm"), "arm (2)");
        assert_eq!(renamed("arm (2)"), "arm (3)");
        assert_eq!(renamed("arm (left)"), "arm (left) (2)");
        let long = renamed(&"ä".repeat(31));
        assert!(long.len() <= 63 && long.ends_with(" (2)"), "{long}");
    }
}
