//! The changes between two versions of the YAML of a component.

use std::fmt;

use super::Component;
use crate::yaml::{DocumentKind, DocumentNode, parse};

/// A change of the YAML of a component.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct YamlChange {
    /// The path of the changed part, as `skills.Grasp.driver`.
    pub path: String,
    /// The kind of change.
    pub kind: ChangeKind,
    /// When it takes effect.
    pub takes: Takes,
}

/// The kind of a change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChangeKind {
    /// Only the later version has the part.
    Added,
    /// The versions differ in the part.
    Changed,
    /// Only the earlier version has the part.
    Removed,
}

/// When a change takes effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Takes {
    /// At the next run of each skill.
    NextRun,
    /// At a restart of the server, which can wait until no skill runs: the address space changes.
    Restart,
    /// At a restart by the operator: the identity or the address of the component changes.
    Operator,
}

impl fmt::Display for YamlChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match self.kind {
            ChangeKind::Added => "added",
            ChangeKind::Changed => "changed",
            ChangeKind::Removed => "removed",
        };
        let takes = match self.takes {
            Takes::NextRun => "from the next run on",
            Takes::Restart => "at the restart when no skill runs and no client holds the lease",
            Takes::Operator => "at a restart by the operator",
        };
        write!(f, "{}: {kind}, {takes}", self.path)
    }
}

impl Component {
    /// Returns the changes between two versions of the YAML, which both are read without findings.
    #[must_use]
    pub fn changes(before: &str, after: &str) -> Vec<YamlChange> {
        let (Ok(before), Ok(after)) = (parse(before), parse(after)) else {
            return Vec::new();
        };
        let mut changes = Vec::new();
        for (key, kind) in compared(Some(&before), Some(&after)) {
            let (was, is) = (before.get(&key), after.get(&key));
            match key.as_str() {
                "skills" => skills(was, is, &mut changes),
                "values" | "configurable" => {
                    changes.extend(entries(&key, was, is).map(|(path, kind)| YamlChange {
                        path,
                        kind,
                        takes: Takes::Restart,
                    }));
                }
                _ => changes.push(YamlChange {
                    takes: takes(&key),
                    path: key,
                    kind,
                }),
            }
        }
        changes
    }
}

/// Returns when a change of a key of the document takes effect.
fn takes(key: &str) -> Takes {
    match key {
        "world" => Takes::NextRun,
        "component" | "application_uri" | "namespace" | "endpoint" | "security" | "lds" => {
            Takes::Operator
        }
        _ => Takes::Restart,
    }
}

/// Returns the keys of two maps with different values.
fn compared(
    before: Option<&DocumentNode>,
    after: Option<&DocumentNode>,
) -> Vec<(String, ChangeKind)> {
    let keys = |node: Option<&DocumentNode>| -> Vec<String> {
        let Some(DocumentKind::Map(pairs)) = node.map(|node| &node.kind) else {
            return Vec::new();
        };
        let keys = pairs.iter().filter_map(|(key, _)| key.text());
        keys.map(str::to_owned).collect()
    };
    let (was, mut all) = (keys(before), keys(after));
    let removed: Vec<String> = was.into_iter().filter(|key| !all.contains(key)).collect();
    all.extend(removed);
    let differing = all.into_iter().filter_map(|key| {
        let value = |node: Option<&DocumentNode>| node.and_then(|node| node.get(&key)).cloned();
        let kind = kind_of(value(before).as_ref(), value(after).as_ref())?;
        Some((key, kind))
    });
    differing.collect()
}

fn kind_of(before: Option<&DocumentNode>, after: Option<&DocumentNode>) -> Option<ChangeKind> {
    match (before, after) {
        (Some(before), Some(after)) if before.has_same_content(after) => None,
        (Some(_), Some(_)) => Some(ChangeKind::Changed),
        (Some(_), None) => Some(ChangeKind::Removed),
        (None, Some(_)) => Some(ChangeKind::Added),
        (None, None) => None,
    }
}

/// Returns the entries of a list by their names, each with its number from 1. Entries without a
/// name, such as `device: all`, have their number as name.
fn named(list: Option<&DocumentNode>) -> Vec<(String, usize, &DocumentNode)> {
    let Some(DocumentKind::List(nodes)) = list.map(|list| &list.kind) else {
        return Vec::new();
    };
    let named = (1..).zip(nodes).map(|(number, node)| {
        let name = node.get("name").and_then(DocumentNode::text);
        let name = name.map_or_else(|| number.to_string(), str::to_owned);
        (name, number, node)
    });
    named.collect()
}

/// Returns the entries of two lists that differ. An entry with another number differs, because its
/// identifiers follow its number.
fn entries(
    list: &str,
    before: Option<&DocumentNode>,
    after: Option<&DocumentNode>,
) -> impl Iterator<Item = (String, ChangeKind)> {
    let (was, is) = (named(before), named(after));
    let mut changes = Vec::new();
    for (name, number, node) in &is {
        let kind = match was.iter().find(|(known, ..)| known == name) {
            None => Some(ChangeKind::Added),
            Some((_, at, known)) if at == number && known.has_same_content(node) => None,
            Some(_) => Some(ChangeKind::Changed),
        };
        changes.extend(kind.map(|kind| (format!("{list}.{name}"), kind)));
    }
    let removed = was
        .iter()
        .filter(|(name, ..)| !is.iter().any(|(known, ..)| known == name));
    changes.extend(removed.map(|(name, ..)| (format!("{list}.{name}"), ChangeKind::Removed)));
    changes.into_iter()
}

fn skills(
    before: Option<&DocumentNode>,
    after: Option<&DocumentNode>,
    changes: &mut Vec<YamlChange>,
) {
    let (was, is) = (named(before), named(after));
    for (path, kind) in entries("skills", before, after) {
        let name = path.strip_prefix("skills.").unwrap_or(&path);
        let find = |all: &[(String, usize, &DocumentNode)]| {
            let found = all.iter().find(|(known, ..)| known == name);
            found.map(|(_, number, node)| (*number, DocumentNode::clone(node)))
        };
        let (Some((at, was)), Some((number, is))) = (find(&was), find(&is)) else {
            changes.push(YamlChange {
                path,
                kind,
                takes: Takes::Restart,
            });
            continue;
        };
        if at != number {
            changes.push(YamlChange {
                path: format!("{path}.number"),
                kind,
                takes: Takes::Restart,
            });
        }
        for (key, kind) in compared(Some(&was), Some(&is)) {
            // The address space shows the partners of a composite.
            let shows_partners = [&was, &is].iter().any(|skill| {
                let driver = skill.get("driver");
                driver.is_some_and(|driver| {
                    driver.text() == Some(COMPOSITE) || driver.get(COMPOSITE).is_some()
                })
            });
            let takes = match key.as_str() {
                "driver" if !shows_partners => Takes::NextRun,
                "timeout" => Takes::NextRun,
                _ => Takes::Restart,
            };
            changes.push(YamlChange {
                path: format!("{path}.{key}"),
                kind,
                takes,
            });
        }
    }
}

/// The driver of composites.
const COMPOSITE: &str = "pick_and_place";

#[cfg(test)]
mod tests {
    use super::*;

    const BEFORE: &str = "component: a\nnamespace: 9\nworld: {part: {pose: [0, 0, 0, 0, 0, 0]}}\nskills:\n\
        - {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 1 s}}}\n\
        - {name: Release, type: ReleaseSkillType, driver: simulated, timeout: 5 s}\n\
        - {name: Handle, type: PickAndPlaceSkillType, driver: pick_and_place}\n\
        values:\n  - {name: Runs, runs: all}\n";

    fn changed(after: &str) -> Vec<String> {
        let changes = Component::changes(BEFORE, after);
        let shown = changes.iter().map(|change| {
            let takes = match change.takes {
                Takes::NextRun => "run",
                Takes::Restart => "restart",
                Takes::Operator => "operator",
            };
            format!("{} {:?} {takes}", change.path, change.kind)
        });
        shown.collect()
    }

    #[test]
    fn places_comments_and_the_order_of_keys_are_no_changes() {
        let after = BEFORE.replace(
            "component: a\nnamespace: 9\n",
            "# new\nnamespace: 9\n\ncomponent: a\n",
        );
        assert_eq!(changed(&after), Vec::<String>::new());
    }

    #[test]
    fn values_without_a_name_are_compared_by_their_numbers() {
        let before = "values:\n  - {device: Force}\n  - {device: Speed}\n";
        assert_eq!(Component::changes(before, before), Vec::<YamlChange>::new());
        let after = before.replace("Speed", "Current");
        let paths = Component::changes(before, &after);
        let paths: Vec<String> = paths.into_iter().map(|change| change.path).collect();
        assert_eq!(paths, ["values.2"]);
    }

    #[test]
    fn each_change_says_when_it_takes_effect() {
        for (from, to, expected) in [
            ("1 s", "2 s", "skills.Grasp.driver Changed run"),
            (", timeout: 5 s", "", "skills.Release.timeout Removed run"),
            ("[0, 0, 0", "[1, 0, 0", "world Changed run"),
            (
                "driver: pick_and_place",
                "driver: {pick_and_place: {robot: x}}",
                "skills.Handle.driver Changed restart",
            ),
            (
                "type: ReleaseSkillType",
                "type: MoveGripperSkillType",
                "skills.Release.type Changed restart",
            ),
            ("runs: all", "failures: all", "values.Runs Changed restart"),
            (
                "namespace: 9",
                "namespace: 9\nlease: 5 s",
                "lease Added restart",
            ),
            ("namespace: 9", "namespace: 8", "namespace Changed operator"),
        ] {
            let after = BEFORE.replace(from, to);
            assert_eq!(changed(&after), [expected], "{from}");
        }
    }

    #[test]
    fn a_skill_that_moves_up_has_another_number() {
        let first = "- {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 1 s}}}\n";
        let expected = [
            "skills.Release.number Changed restart",
            "skills.Handle.number Changed restart",
            "skills.Grasp Removed restart",
        ];
        assert_eq!(changed(&BEFORE.replace(first, "")), expected);
    }
}
