//! Reads values from a tree. Each error is recorded, and reading continues.

use std::time::Duration;

use super::findings::{Findings, YamlFinding, YamlFindingCode};
use super::{DocumentKind, DocumentNode, Place, nearest, parse};
use crate::parameters::shortened;

/// Reads a document with `read`, which returns `None` for a faulty document. All errors are
/// reported together.
///
/// # Errors
/// The findings in the document.
pub fn read_document<T>(
    text: &str,
    read: impl FnOnce(&DocumentNode, &mut YamlReader<'_>) -> Option<T>,
) -> Result<T, Findings> {
    let mut findings = Findings::default();
    let read = match parse(text) {
        Ok(root) => read(&root, &mut YamlReader::new(&mut findings)),
        Err(finding) => {
            findings.push(finding);
            None
        }
    };
    read.filter(|_| findings.is_empty()).ok_or(findings)
}

/// Returns the value of an optional key; `None` if the value is invalid.
pub fn whole<T>(read: Option<Option<T>>) -> Option<Option<T>> {
    read.map_or(Some(None), |value| value.map(Some))
}

/// Reads values from nodes and records errors.
#[derive(Debug)]
pub struct YamlReader<'f> {
    findings: &'f mut Findings,
}

impl<'f> YamlReader<'f> {
    /// Creates a reader that records errors in `findings`.
    pub fn new(findings: &'f mut Findings) -> Self {
        Self { findings }
    }

    /// Returns the recorded errors.
    pub fn findings(&mut self) -> &mut Findings {
        self.findings
    }

    /// Returns the values of a map in the order of `keys`; a key without a value counts as missing.
    /// Unknown keys are recorded as errors; a misspelt key is then read as the key that it
    /// resembles. Returns `None` if the node is not a map.
    pub fn map<'n, const N: usize>(
        &mut self,
        node: &'n DocumentNode,
        keys: [&str; N],
    ) -> Option<[Option<&'n DocumentNode>; N]> {
        let DocumentKind::Map(pairs) = &node.kind else {
            self.wrong(node, &format!("a map with {}", list(&keys)));
            return None;
        };
        let mut values = [None; N];
        let mut seen: Vec<&str> = Vec::new();
        let mut misspelt = Vec::new();
        for (key, value) in pairs {
            let DocumentKind::Scalar(text) = &key.kind else {
                self.wrong(key, "a key");
                continue;
            };
            if seen.contains(&text.as_str()) {
                let message = format!("the key `{}` is repeated", shortened(text));
                self.findings
                    .error(YamlFindingCode::DuplicateKey, key.place, message);
                continue;
            }
            seen.push(text);
            match keys
                .iter()
                .zip(&mut values)
                .find(|(known, _)| **known == text)
            {
                Some((_, slot)) => {
                    *slot = Some(value).filter(|value| value.kind != DocumentKind::Null)
                }
                None => {
                    let message = format!("unknown key `{}`", shortened(text));
                    let near = nearest(text, keys);
                    misspelt.extend(near.map(|near| (near, value)));
                    let help = match near {
                        Some(near) => {
                            format!("did you mean `{near}`? Known here are {}", list(&keys))
                        }
                        None => format!("known here are {}", list(&keys)),
                    };
                    self.findings
                        .error_with(YamlFindingCode::UnknownKey, key.place, message, help);
                }
            }
        }
        for (near, value) in misspelt {
            let mut slots = keys.iter().zip(&mut values);
            if let Some((_, slot @ None)) = slots.find(|(known, _)| **known == near) {
                *slot = Some(value).filter(|value| value.kind != DocumentKind::Null);
            }
        }
        Some(values)
    }

    /// Requires a key.
    pub fn needed<'n>(
        &mut self,
        value: Option<&'n DocumentNode>,
        key: &str,
        of: Place,
    ) -> Option<&'n DocumentNode> {
        if value.is_none() {
            self.findings.error(
                YamlFindingCode::MissingKey,
                of,
                format!("`{key}` is missing"),
            );
        }
        value
    }

    /// Returns a scalar as written.
    pub fn text<'n>(&mut self, node: &'n DocumentNode, wanted: &str) -> Option<&'n str> {
        let DocumentKind::Scalar(text) = &node.kind else {
            self.wrong(node, wanted);
            return None;
        };
        Some(text)
    }

    /// Returns a list; a scalar counts as a list with one element.
    pub fn list<'n>(&mut self, node: &'n DocumentNode) -> &'n [DocumentNode] {
        match &node.kind {
            DocumentKind::List(nodes) => nodes,
            DocumentKind::Scalar(_) => std::slice::from_ref(node),
            DocumentKind::Null => &[],
            DocumentKind::Map(_) => {
                self.wrong(node, "a list (each entry begins with `- `)");
                &[]
            }
        }
    }

    /// Reads `true` or `false`.
    pub fn boolean(&mut self, node: &DocumentNode) -> Option<bool> {
        match self.text(node, "true or false")? {
            "true" => Some(true),
            "false" => Some(false),
            other => self.refuse(
                node,
                YamlFindingCode::WrongValue,
                format!("expected true or false, found `{}`", shortened(other)),
            ),
        }
    }

    /// Reads a number within a range.
    pub fn number(&mut self, node: &DocumentNode, (low, high): (f64, f64)) -> Option<f64> {
        let text = self.text(node, "a number")?;
        // Rust also parses `inf` and `nan` as numbers.
        let number = text
            .parse()
            .ok()
            .filter(|_| text.contains(|c: char| c.is_ascii_digit()));
        let number = number.filter(|number| (low..=high).contains(number));
        number.or_else(|| {
            let message = format!(
                "expected a number from {low} to {high}, found `{}`",
                shortened(text)
            );
            self.refuse(node, YamlFindingCode::WrongValue, message)
        })
    }

    /// Reads a duration with its unit, from 1 ms to 24 h.
    pub fn duration(&mut self, node: &DocumentNode) -> Option<Duration> {
        let text = self.text(node, "a duration")?;
        parse_duration(text).or_else(|| {
            let message = format!(
                "expected a duration from 1 ms to 24 h, found `{}`",
                shortened(text)
            );
            let finding = YamlFinding::error(YamlFindingCode::Duration, node.place, message);
            self.findings
                .push(finding.with_help("a number with its unit: 400 ms, 2.5 s, 10 min"));
            None
        })
    }

    /// Records an error at a node. Returns `None`.
    pub fn refuse<T>(
        &mut self,
        node: &DocumentNode,
        code: YamlFindingCode,
        message: String,
    ) -> Option<T> {
        self.findings.error(code, node.place, message);
        None
    }

    /// Records that `wanted` (with its article) is expected.
    pub fn wrong(&mut self, node: &DocumentNode, wanted: &str) {
        let message = format!("expected {wanted}, found {}", node.kind.name());
        self.findings
            .error(YamlFindingCode::WrongValue, node.place, message);
    }
}

fn parse_duration(text: &str) -> Option<Duration> {
    let at = text.find(|c: char| !(c.is_ascii_digit() || c == '.'))?;
    let (number, unit) = text.split_at_checked(at)?;
    let seconds = match unit.trim() {
        "ms" => 0.001,
        "s" => 1.0,
        "min" => 60.0,
        "h" => 3600.0,
        _ => return None,
    };
    let seconds = number.parse::<f64>().ok()? * seconds;
    let duration = Duration::try_from_secs_f64(seconds).ok()?;
    (Duration::from_millis(1)..=Duration::from_secs(24 * 3600))
        .contains(&duration)
        .then_some(duration)
}

/// Formats names as a list: `a`, `b`, `c`.
fn list(names: &[&str]) -> String {
    let names: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_duration_has_a_unit_and_is_of_a_sensible_length() {
        assert_eq!(parse_duration("400 ms"), Some(Duration::from_millis(400)));
        assert_eq!(parse_duration("2.5s"), Some(Duration::from_millis(2500)));
        assert_eq!(parse_duration("10 min"), Some(Duration::from_secs(600)));
        for wrong in [
            "400", "s", "", "1.2.3 s", "0 ms", "25 h", "-1 s", "1 day", "1e9 s",
        ] {
            assert_eq!(parse_duration(wrong), None, "{wrong}");
        }
    }
}
