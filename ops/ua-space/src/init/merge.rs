//! Inserts lines into an existing document without changing any other byte.

/// Inserts `block`, entries of the top-level key `key`, after the existing entries. A missing key
/// is appended to the document.
///
/// Returns the text and the line, from 0, at which the block begins. Returns `None` if the value of
/// the key is written in braces or brackets, because nothing can be inserted there.
pub(super) fn append(text: &str, key: &str, block: &[String]) -> Option<(String, usize)> {
    let newline = if text.contains("\r\n") { "\r\n" } else { "\n" };
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let is_key = |line: &&str| {
        let rest = line
            .strip_prefix(key)
            .and_then(|rest| rest.strip_prefix(':'));
        rest.is_some_and(|rest| rest.starts_with([' ', '\t', '\r', '\n', '#']) || rest.is_empty())
    };
    let at = lines.iter().position(is_key);
    let mut before: Vec<String> = Vec::new();
    let mut emptied = None;
    let place = match at {
        None => {
            before.extend([String::new(), format!("{key}:")]);
            lines.len()
        }
        Some(at) => {
            let (_, rest) = lines.get(at)?.split_once(':')?;
            let rest = rest.trim();
            // An empty list, which `init` writes if all entries are comments.
            let behind = rest.strip_prefix("[]").map(str::trim_start);
            if let Some(behind) = behind.filter(|behind| is_comment(behind)) {
                let space = if behind.is_empty() { "" } else { " " };
                emptied = Some((at, format!("{key}:{space}{behind}{newline}")));
            } else if !is_comment(rest) {
                return None;
            }
            let after = lines.iter().enumerate().skip(at + 1);
            let mut last = at;
            for (number, line) in after {
                let inside = line.starts_with([' ', '\t', '-']);
                if inside && !line.trim().is_empty() {
                    last = number;
                } else if !line.trim().is_empty() && !line.starts_with('#') {
                    break;
                }
            }
            last + 1
        }
    };
    let kept = lines.iter().enumerate().take(place);
    let mut merged: String = kept
        .map(|(number, line)| match &emptied {
            Some((at, key)) if *at == number => key.as_str(),
            Some(_) | None => *line,
        })
        .collect();
    if !merged.is_empty() && !merged.ends_with('\n') {
        merged.push_str(newline);
    }
    let start = place + before.len();
    for line in before.iter().chain(block) {
        merged.push_str(line);
        merged.push_str(newline);
    }
    merged.extend(lines.iter().skip(place).copied());
    Some((merged, start))
}

fn is_comment(text: &str) -> bool {
    text.is_empty() || text.starts_with('#')
}

/// Returns the indentation of the entries of the key.
pub(super) fn indent(text: &str, key: &str) -> String {
    let key = format!("{key}:");
    let mut inside = text
        .lines()
        .skip_while(|line| !line.starts_with(&key))
        .skip(1);
    let first = inside.find(|line| {
        let line = line.trim_start();
        !line.is_empty() && !line.starts_with('#')
    });
    let found = first.map(|line| line.chars().take_while(|c| *c == ' ').collect());
    found
        .filter(|_| first.is_some_and(|line| line.starts_with([' ', '-'])))
        .unwrap_or_else(|| "  ".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block() -> Vec<String> {
        vec!["  - b".to_owned()]
    }

    #[test]
    fn lines_go_behind_the_last_entry_of_their_key() {
        let text = "a:\n  - a\n  # of a\n\n# of c\nc:\n  - c\n";
        let (merged, at) = append(text, "a", &block()).unwrap();
        assert_eq!(merged, "a:\n  - a\n  # of a\n  - b\n\n# of c\nc:\n  - c\n");
        assert_eq!(at, 3);
        let (merged, at) = append(text, "c", &block()).unwrap();
        assert_eq!((merged.as_str(), at), (&*format!("{text}  - b\n"), 7));
    }

    #[test]
    fn a_key_that_is_missing_is_put_at_the_end() {
        let (merged, at) = append("a:\n  - a", "c", &block()).unwrap();
        assert_eq!((merged.as_str(), at), ("a:\n  - a\n\nc:\n  - b\n", 4));
    }

    #[test]
    fn line_ends_stay_and_nothing_is_put_into_brackets() {
        let (merged, _) = append("a:\r\n- a\r\n", "a", &block()).unwrap();
        assert_eq!(merged, "a:\r\n- a\r\n  - b\r\n");
        assert_eq!(append("a: [1]\n", "a", &block()), None);
        assert_eq!(append("a: # comment\n  - a\n", "a", &block()).unwrap().1, 2);
    }

    #[test]
    fn an_empty_list_is_opened() {
        let (merged, at) = append("a: []\n\n  # c\nb: 1\n", "a", &block()).unwrap();
        assert_eq!((merged.as_str(), at), ("a:\n\n  # c\n  - b\nb: 1\n", 3));
        let (merged, _) = append("a: [] # none\n", "a", &block()).unwrap();
        assert_eq!(merged, "a: # none\n  - b\n");
    }

    #[test]
    fn entries_are_indented_as_those_before() {
        assert_eq!(indent("a:\n\n  # c\n    - a\n", "a"), "    ");
        assert_eq!(indent("a:\n- a\n", "a"), "");
        assert_eq!(indent("b: 1\n", "a"), "  ");
        assert_eq!(indent("a:\n    2: urn:x\n", "a"), "    ");
        assert_eq!(indent("a:\nb: 1\n", "a"), "  ");
    }
}
