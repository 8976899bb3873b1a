//! Formats JSON for people: short parts on one line, long parts indented.

/// Breaks compact JSON into lines of 100 columns; a text or a list of plain values may be longer.
pub(crate) fn lines(compact: &str) -> String {
    let mut out = String::with_capacity(compact.len() * 2);
    let mut rest = compact;
    match read(&mut rest) {
        Some(node) => node.write(0, 0, &mut out),
        None => out.push_str(compact),
    }
    out
}

/// A part of the JSON, with its text and its parts.
struct LayoutNode<'a> {
    text: &'a str,
    /// The parts of an array or object; in an object with their keys and colons.
    parts: Vec<(&'a str, Self)>,
}

impl LayoutNode<'_> {
    /// Writes the part; `before` is the number of columns already used on the line.
    fn write(&self, indent: usize, before: usize, out: &mut String) {
        let plain_list =
            self.text.starts_with('[') && self.parts.iter().all(|(_, part)| part.parts.is_empty());
        if plain_list || before + self.text.len() < WIDTH {
            out.push_str(self.text);
            return;
        }
        let (open, close) = match self.text.starts_with('{') {
            true => ('{', '}'),
            false => ('[', ']'),
        };
        if self.parts.is_empty() {
            out.push_str(self.text);
            return;
        }
        out.push(open);
        for ((key, part), index) in self.parts.iter().zip(0..) {
            if index != 0 {
                out.push(',');
            }
            out.push('\n');
            out.push_str(&" ".repeat(indent + 1));
            out.push_str(key);
            if !key.is_empty() {
                out.push(' ');
            }
            part.write(indent + 1, indent + 2 + key.len(), out);
        }
        out.push('\n');
        out.push_str(&" ".repeat(indent));
        out.push(close);
    }
}

/// Parses one value from the front.
fn read<'a>(rest: &mut &'a str) -> Option<LayoutNode<'a>> {
    let start = *rest;
    let mut parts = Vec::new();
    match start.as_bytes().first()? {
        b'{' | b'[' => {
            let object = start.starts_with('{');
            *rest = start.get(1..)?;
            while !rest.starts_with(['}', ']']) {
                *rest = rest.strip_prefix(',').unwrap_or(rest);
                let from = *rest;
                if object {
                    skip_string(rest)?;
                    *rest = rest.strip_prefix(':')?;
                }
                let key = taken(from, rest)?;
                parts.push((key, read(rest)?));
            }
            *rest = rest.get(1..)?;
        }
        b'"' => skip_string(rest)?,
        _ => {
            let end = start.find([',', '}', ']']).unwrap_or(start.len());
            *rest = start.get(end..)?;
        }
    }
    Some(LayoutNode {
        text: taken(start, rest)?,
        parts,
    })
}

fn skip_string(rest: &mut &str) -> Option<()> {
    let mut escaped = true;
    for (at, character) in rest.char_indices() {
        // The first quote opens the string.
        match character {
            '"' if !escaped => {
                *rest = rest.get(at + 1..)?;
                return Some(());
            }
            '\\' => escaped = !escaped,
            _ => escaped = false,
        }
    }
    None
}

/// Returns the text between the starts of `start` and `rest`.
fn taken<'a>(start: &'a str, rest: &str) -> Option<&'a str> {
    start.get(..start.len() - rest.len())
}

const WIDTH: usize = 100;

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn short_parts_stay_on_one_line_and_long_ones_are_broken() {
        let json = json!({
            "a": { "b": [1, 2], "c": "x\"],}\\" },
            "list": (0..60).collect::<Vec<_>>(),
            "objects": (0..8).map(|n| json!({ "number": n })).collect::<Vec<_>>(),
        });
        let numbers = json["list"].to_string();
        let text = lines(&json.to_string());
        assert_eq!(
            text,
            format!(
                "{{\n \"a\": {},\n \"list\": {numbers},\n \"objects\": [\n{}\n ]\n}}",
                json["a"],
                (0..8)
                    .map(|n| format!("  {{\"number\":{n}}}"))
                    .collect::<Vec<_>>()
                    .join(",\n")
            )
        );
        assert_eq!(serde_json::from_str::<Value>(&text).unwrap(), json);
    }

    #[test]
    fn what_is_short_is_left_alone() {
        for text in [
            "{}",
            "[]",
            "3.5",
            "null",
            "\"a\\\\\"",
            "{\"a\":[{\"b\":1}]}",
        ] {
            assert_eq!(lines(text), text);
        }
    }
}
