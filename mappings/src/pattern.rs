//! Patterns: ROS topics that become variables without being named, and the nodes that they become.

use std::fmt::Write as _;
use std::num::NonZeroU16;

use messages::{Selection, TypeName};

use crate::node_id::NodeIdText;
use crate::topic::{SpaceId, TopicId};

/// Rule that makes variables of ROS topics when they appear.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern {
    pub(crate) topics: Glob,
    pub(crate) exclude: Vec<Glob>,
    pub(crate) origin: SpaceId,
    pub(crate) node: NameTemplate,
    pub(crate) alias: Option<NameTemplate>,
    pub(crate) name: NameTemplate,
    pub(crate) message_type: Option<TypeName>,
    pub(crate) selection: Selection,
}

/// Variable that a topic becomes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PatternVariable {
    /// Origin, namespace index, and the node's numeric identifier or alias.
    pub topic: TopicId,
    /// The OPC UA node.
    pub node: NodeIdText,
    /// BrowseName and DisplayName of the node.
    pub name: String,
    /// Type that the topic must have; `None` for any type.
    pub message_type: Option<TypeName>,
    /// Part of the message that is the value.
    pub selection: Selection,
}

/// Reason that a topic that matches a pattern becomes no variable.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{ros_topic}` matches the pattern `{pattern}`, but {why}")]
pub struct PatternFault {
    /// The topic.
    pub ros_topic: String,
    /// The pattern as it is written.
    pub pattern: String,
    /// Fault of the variable.
    pub why: PatternReason,
}

/// Fault of a variable that a pattern makes of a topic.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PatternReason {
    /// The text with the captures in it is not a node id.
    #[error("`{0}` is not a node id")]
    Node(String),
    /// The identifier or alias with the captures in it is not a number from 1 to 65535.
    #[error("`{0}` is not a number from 1 to 65535")]
    Number(String),
    /// The name is empty or longer than 512 characters.
    #[error("its name would not have 1 to 512 characters")]
    Name,
    /// A variable or call of the mapping has the same topic of the space or the same node.
    #[error("`{0}` is already `{1}` of the mapping")]
    Taken(TopicId, String),
}

impl Pattern {
    /// Returns the space of the topics.
    #[must_use]
    pub const fn origin(&self) -> SpaceId {
        self.origin
    }

    /// Returns the pattern as it is written.
    #[must_use]
    pub fn topics(&self) -> &str {
        &self.topics.text
    }

    /// Returns the variable that a topic of the space [`Pattern::origin`] becomes; `None` if the
    /// pattern does not match it.
    ///
    /// # Errors
    /// The captured texts make no node of the space. The caller has to detect two topics that
    /// become the same node; [`Mapping::matching`](crate::Mapping::matching) detects the nodes of
    /// the mapping.
    #[must_use]
    pub fn matches(&self, ros_topic: &str) -> Option<Result<PatternVariable, PatternFault>> {
        let captures = self.topics.captures(ros_topic)?;
        if self
            .exclude
            .iter()
            .any(|glob| glob.captures(ros_topic).is_some())
        {
            return None;
        }
        let made = self.variable(&captures);
        Some(made.map_err(|why| self.fault(ros_topic, why)))
    }

    pub(crate) fn fault(&self, ros_topic: &str, why: PatternReason) -> PatternFault {
        PatternFault {
            ros_topic: ros_topic.to_owned(),
            pattern: self.topics.text.clone(),
            why,
        }
    }

    fn variable(&self, captures: &[String]) -> Result<PatternVariable, PatternReason> {
        let text = self.node.render(captures);
        let node: NodeIdText = text
            .parse()
            .map_err(|_| PatternReason::Node(text.clone()))?;
        let identifier = match &self.alias {
            Some(alias) => {
                let alias = alias.render(captures);
                number(&alias).ok_or(PatternReason::Number(alias))?
            }
            None => node.writer_id().ok_or(PatternReason::Number(text))?,
        };
        let name = self.name.render(captures);
        if name.trim().is_empty() || name.chars().count() > 512 {
            return Err(PatternReason::Name);
        }
        // The check of the pattern refuses namespace 0.
        let namespace = NonZeroU16::new(node.namespace).ok_or(PatternReason::Name)?;
        let topic = TopicId {
            space: self.origin,
            namespace,
            identifier,
        };
        Ok(PatternVariable {
            topic,
            node,
            name,
            message_type: self.message_type.clone(),
            selection: self.selection.clone(),
        })
    }
}

/// Reads a number; each number has one spelling.
fn number(text: &str) -> Option<NonZeroU16> {
    let plain = text.bytes().all(|b| b.is_ascii_digit()) && !text.starts_with('0');
    text.parse().ok().filter(|_| plain)
}

/// Topic name with `*` for one or more characters of a part, and at most one part `**` for any
/// number of parts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Glob {
    text: String,
    before: Vec<Vec<String>>,
    /// The parts after `**`, if the pattern contains it.
    after: Option<Vec<Vec<String>>>,
}

impl Glob {
    /// Reads a pattern. `Err` is the fault.
    pub(crate) fn parse(text: &str) -> Result<Self, &'static str> {
        let parts = text.strip_prefix('/').ok_or("it does not begin with `/`")?;
        if text.len() > MAX_TOPIC {
            return Err("it is longer than a topic name");
        }
        let strange = |c: char| !c.is_ascii_alphanumeric() && !"/_*".contains(c);
        if text.contains(strange) {
            return Err("use only letters, digits, underscores, slashes and `*`");
        }
        let mut before = Vec::new();
        let mut after: Option<Vec<Vec<String>>> = None;
        for part in parts.split('/') {
            match part {
                "" => return Err("a part between slashes is empty"),
                "**" if after.is_some() => return Err("it has more than one part `**`"),
                "**" => after = Some(Vec::new()),
                _ if part.contains("**") => return Err("`**` is a part of its own"),
                _ => {
                    let pieces = part.split('*').map(str::to_owned).collect();
                    after.as_mut().unwrap_or(&mut before).push(pieces);
                }
            }
        }
        Ok(Self {
            text: text.to_owned(),
            before,
            after,
        })
    }

    /// Returns the number of captured texts.
    pub(crate) fn wildcards(&self) -> usize {
        let stars = |parts: &[Vec<String>]| -> usize {
            parts
                .iter()
                .map(|pieces| pieces.len().saturating_sub(1))
                .sum()
        };
        stars(&self.before) + self.after.as_ref().map_or(0, |after| 1 + stars(after))
    }

    /// Returns the text that each wildcard captures, in order.
    fn captures(&self, topic: &str) -> Option<Vec<String>> {
        let parts: Vec<&str> = topic.strip_prefix('/')?.split('/').collect();
        let (first, rest) = parts.split_at_checked(self.before.len())?;
        let mut found = Vec::new();
        take_parts(&self.before, first, &mut found)?;
        match &self.after {
            None => rest.is_empty().then_some(found),
            Some(after) => {
                let middle = rest.len().checked_sub(after.len())?;
                let (middle, last) = rest.split_at_checked(middle)?;
                found.push(middle.join("/"));
                take_parts(after, last, &mut found)?;
                Some(found)
            }
        }
    }
}

const MAX_TOPIC: usize = 247;

fn take_parts(pattern: &[Vec<String>], parts: &[&str], found: &mut Vec<String>) -> Option<()> {
    pattern
        .iter()
        .zip(parts)
        .try_for_each(|(pieces, part)| take_part(pieces, part, found))
}

/// Matches each piece at the first possible position, and the last piece at the end. If any choice
/// of positions matches, this choice does.
fn take_part(pieces: &[String], part: &str, found: &mut Vec<String>) -> Option<()> {
    let (first, others) = pieces.split_first()?;
    let mut rest = part.strip_prefix(first.as_str())?;
    let Some((last, between)) = others.split_last() else {
        return rest.is_empty().then_some(());
    };
    for piece in between {
        let mut starts = rest.char_indices().skip(1).map(|(at, _)| at);
        let at = starts.find(|at| {
            rest.get(*at..)
                .is_some_and(|rest| rest.starts_with(piece.as_str()))
        })?;
        let (captured, after) = rest.split_at_checked(at)?;
        found.push(captured.to_owned());
        rest = after.strip_prefix(piece.as_str())?;
    }
    let captured = rest.strip_suffix(last.as_str())?;
    found.push(captured.to_owned());
    (!captured.is_empty()).then_some(())
}

/// A text with `{1}`, `{2}`... for captured texts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct NameTemplate(Vec<Piece>);

#[derive(Clone, Debug, PartialEq, Eq)]
enum Piece {
    Text(String),
    /// Index of the capture, from 0.
    Capture(usize),
}

impl NameTemplate {
    /// Reads a template. `captures` is the number of captures. `Err` is the faulty part of the
    /// text.
    pub(crate) fn parse(text: &str, captures: usize) -> Result<Self, String> {
        let mut pieces = Vec::new();
        let mut rest = text;
        while let Some((before, after)) = rest.split_once('{') {
            let (inner, after) = after.split_once('}').ok_or_else(|| format!("{{{after}"))?;
            let capture = number(inner).map(|number| usize::from(number.get()));
            let capture = capture.filter(|number| *number <= captures);
            let capture = capture.ok_or_else(|| format!("{{{inner}}}"))?;
            pieces.push(Piece::Text(before.to_owned()));
            pieces.push(Piece::Capture(capture - 1));
            rest = after;
        }
        pieces.push(Piece::Text(rest.to_owned()));
        Ok(Self(pieces))
    }

    /// Returns `true` if the text differs from topic to topic.
    pub(crate) fn varies(&self) -> bool {
        self.0
            .iter()
            .any(|piece| matches!(piece, Piece::Capture(_)))
    }

    pub(crate) fn render(&self, captures: &[String]) -> String {
        let mut text = String::new();
        for piece in &self.0 {
            let piece = match piece {
                Piece::Text(text) => text,
                Piece::Capture(at) => captures.get(*at).map_or("", String::as_str),
            };
            // A write to a String cannot fail.
            _ = text.write_str(piece);
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn captures(glob: &str, topic: &str) -> Option<Vec<String>> {
        Glob::parse(glob).unwrap().captures(topic)
    }

    #[test]
    fn a_star_is_part_of_a_name_and_two_are_any_number_of_parts() {
        for (glob, topic, wanted) in [
            ("/robot*/joints", "/robot1/joints", Some(vec!["1"])),
            ("/robot*/joints", "/robot/joints", None),
            ("/robot*/joints", "/robot1/a/joints", None),
            ("/robot*/joints", "/robot1/joints/x", None),
            ("/*/*", "/a/b", Some(vec!["a", "b"])),
            ("/a*b*c", "/axbybzc", Some(vec!["x", "ybz"])),
            ("/a*b*c", "/abc", None),
            ("/**/image", "/image", Some(vec![""])),
            ("/**/image", "/a/b/image", Some(vec!["a/b"])),
            ("/cell*/**/io*", "/cell1/x/io7", Some(vec!["1", "x", "7"])),
            ("/**", "/a/b", Some(vec!["a/b"])),
            ("/a/**/b/c", "/a/b/c", Some(vec![""])),
            ("/a/**/b/c", "/a/c", None),
        ] {
            let found = captures(glob, topic);
            let wanted: Option<Vec<String>> =
                wanted.map(|texts| texts.into_iter().map(str::to_owned).collect());
            assert_eq!(found, wanted, "{glob} {topic}");
        }
    }

    #[test]
    fn a_glob_that_is_none_is_refused() {
        for text in ["", "a", "/a//b", "/a**", "/**/a/**", "/a-b", "/a/", "/{x}"] {
            assert!(Glob::parse(text).is_err(), "{text}");
        }
        assert_eq!(Glob::parse("/a*b*/**/c").unwrap().wildcards(), 3);
        assert_eq!(Glob::parse("/a/b").unwrap().wildcards(), 0);
    }

    #[test]
    fn a_template_names_captures_that_exist() {
        let template = NameTemplate::parse("ns=2;i=10{1}_{2}{1}", 2).unwrap();
        let captures = ["a".to_owned(), "b".to_owned()];
        assert_eq!(template.render(&captures), "ns=2;i=10a_ba");
        assert!(template.varies() && !NameTemplate::parse("x", 2).unwrap().varies());
        for text in ["{0}", "{3}", "{}", "{x}", "{01}"] {
            assert_eq!(NameTemplate::parse(text, 2), Err(text.to_owned()));
        }
        assert_eq!(NameTemplate::parse("a{1", 2), Err("{1".to_owned()));
    }
}
