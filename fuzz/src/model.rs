//! Fuzzes SysML models, XMI and the textual notation, with arbitrary text.

/// Reads a model, which has topics or findings with lines of the file.
pub fn model(input: &[u8]) {
    let Ok(content) = std::str::from_utf8(input) else {
        return;
    };
    match ua_space::read_model(content) {
        Ok(found) => assert!(found > 0),
        Err(lines) => {
            assert!(!lines.is_empty());
            assert!(lines.is_sorted(), "{lines:?}");
            let last = content.split('\n').count() + 1;
            assert!(
                lines.iter().all(|line| (1..=last).contains(line)),
                "{lines:?}"
            );
        }
    }
}
