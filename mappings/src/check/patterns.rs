//! Patterns: topics that become variables when they appear.

use messages::{Selection, TypeName};

use super::nodes::{CheckedNamespaces, Spaces, space};
use super::required;
use super::selection::{self, SelectionKeys};
use super::shaping::ValueDirection;
use super::types::{MessageTypes, dialect};
use crate::code::Code;
use crate::document::PatternEntry;
use crate::findings::MappingFindings;
use crate::node_id::NodeIdText;
use crate::pattern::{Glob, NameTemplate, Pattern};
use crate::read::{Located, given, short};
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// Maximum number of patterns of one document: each pattern is matched with every topic.
const MAX_PATTERNS: usize = 1000;

pub(super) fn check(
    entries: &[Located<PatternEntry>],
    (spaces, namespaces): (&Spaces, &CheckedNamespaces),
    types: &mut MessageTypes,
    findings: &mut MappingFindings,
) -> Vec<Pattern> {
    if let Some(first) = entries.get(MAX_PATTERNS) {
        let message = format!(
            "{} patterns; at most {MAX_PATTERNS} are read",
            entries.len()
        );
        findings.error(Code::TooLarge, first.place, message);
        return Vec::new();
    }
    let mut patterns: Vec<Pattern> = Vec::new();
    let mut places = Vec::new();
    for at in entries {
        let Some(entry) = &at.value else { continue };
        let origin = required(&entry.origin, "origin", "the pattern", at.place, findings);
        let origin = origin.and_then(|(number, place)| origin_of(*number, place, spaces, findings));
        let texts = texts(entry, at.place, namespaces, findings);
        findings.of_part(origin);
        let kind = kind((entry, at.place), origin, types, findings);
        findings.of_part(None);
        let (Some(origin), Some(texts), Some((message_type, selection))) = (origin, texts, kind)
        else {
            continue;
        };
        let first = patterns.iter().zip(&places).find(|(first, _)| {
            first.origin == origin
                && first.topics == texts.topics
                && first.exclude == texts.exclude
                && (first.message_type.is_none() || first.message_type == message_type)
        });
        if let Some((first, place)) = first {
            let message = format!("the pattern `{}` is repeated", first.topics());
            let label = format!("first at {}", findings.line(*place, at.place));
            let note = findings.warning(Code::TopicPattern, at.place, message);
            note.label(label)
                .help("the first matching pattern applies, so this pattern has no effect");
        }
        places.push(at.place);
        patterns.push(Pattern {
            topics: texts.topics,
            exclude: texts.exclude,
            origin,
            node: texts.node,
            alias: texts.alias,
            name: texts.name,
            message_type,
            selection,
        });
    }
    patterns
}

fn origin_of(
    number: u16,
    place: TextSpan,
    spaces: &Spaces,
    findings: &mut MappingFindings,
) -> Option<SpaceId> {
    let origin = space(number, place, "origin", spaces, findings)?;
    if origin == SpaceId::UA {
        let message = "space 0 is the OPC UA side and has no ROS topics";
        findings
            .error(Code::OpcUaBinding, place, message)
            .help("a pattern matches the topics of a ROS space");
        return None;
    }
    Some(origin)
}

struct Texts {
    topics: Glob,
    exclude: Vec<Glob>,
    node: NameTemplate,
    alias: Option<NameTemplate>,
    name: NameTemplate,
}

fn texts(
    entry: &PatternEntry,
    owner: TextSpan,
    namespaces: &CheckedNamespaces,
    findings: &mut MappingFindings,
) -> Option<Texts> {
    let topics = required(&entry.topics, "topics", "the pattern", owner, findings);
    let node = required(&entry.node, "node", "the pattern", owner, findings);
    let name = required(&entry.name, "name", "the pattern", owner, findings);
    let topics = topics.and_then(|(text, place)| {
        let topics = glob(text, place, findings)?;
        if topics.wildcards() == 0 {
            let message = format!("`{text}` has no wildcard, so it is a single topic");
            findings
                .error(Code::TopicPattern, place, message)
                .help("use `*` for a part of the name, or add the topic to `variables`");
            return None;
        }
        Some(topics)
    });
    let excluded = entry.exclude.as_ref().and_then(|at| at.value.as_ref());
    let excluded = excluded.into_iter().flatten();
    let exclude: Vec<Glob> = excluded
        .filter_map(|at| glob(at.value.as_ref()?, at.place, findings))
        .collect();
    let topics = topics?;
    let captures = topics.wildcards();
    let node = node.and_then(|(text, place)| {
        let alias = entry.alias.is_some();
        self::node(text, place, (captures, alias), namespaces, findings)
    });
    let alias = match given(&entry.alias) {
        Some((text, place)) => Some(numbered(text, place, captures, findings)?),
        None => None,
    };
    let name = name.and_then(|(text, place)| template(text, place, captures, findings));
    Some(Texts {
        topics,
        exclude,
        node: node?,
        alias,
        name: name?,
    })
}

fn glob(text: &str, place: TextSpan, findings: &mut MappingFindings) -> Option<Glob> {
    match Glob::parse(text) {
        Ok(glob) => Some(glob),
        Err(why) => {
            let message = format!("`{}` is not a pattern of topic names", short(text));
            findings
                .error(Code::TopicPattern, place, message)
                .label(why);
            None
        }
    }
}

fn template(
    text: &str,
    place: TextSpan,
    captures: usize,
    findings: &mut MappingFindings,
) -> Option<NameTemplate> {
    match NameTemplate::parse(text, captures) {
        Ok(template) => Some(template),
        Err(piece) => {
            let message = format!("`{}` does not refer to a wildcard", short(&piece));
            findings
                .error(Code::PatternCapture, place, message)
                .help(format!(
                    "the pattern has {captures}: {{1}} refers to the first"
                ));
            None
        }
    }
}

/// Reads a text that has to differ from topic to topic.
fn numbered(
    text: &str,
    place: TextSpan,
    captures: usize,
    findings: &mut MappingFindings,
) -> Option<NameTemplate> {
    let template = template(text, place, captures, findings)?;
    if !template.varies() {
        let message = format!("`{}` is the same for every topic", short(text));
        findings
            .error(Code::PatternCapture, place, message)
            .help("each topic needs its own node: use the text of a wildcard in the number, such as 10{1}");
        return None;
    }
    Some(template)
}

fn node(
    text: &str,
    place: TextSpan,
    (captures, alias): (usize, bool),
    namespaces: &CheckedNamespaces,
    findings: &mut MappingFindings,
) -> Option<NameTemplate> {
    let template = numbered(text, place, captures, findings)?;
    let example = template.render(&vec!["1".to_owned(); captures]);
    let fixed = text.split(';').next().is_some_and(|ns| !ns.contains('{'));
    let Some(node) = example.parse::<NodeIdText>().ok().filter(|_| fixed) else {
        let message = format!("`{}` does not give a node id", short(text));
        findings
            .error(Code::NodeId, place, message)
            .help("use a node id such as ns=2;i=10{1}, with a fixed namespace index");
        return None;
    };
    let index = node.namespace;
    if !alias && node.writer_id().is_none() || index == 0 {
        let message = format!("`{}` does not give the number of a topic", short(text));
        findings
            .error(Code::AliasNeeded, place, message)
            .help("use a node such as ns=2;i=10{1}, or add `alias: \"10{1}\"`");
        return None;
    }
    if !namespaces.partial && !namespaces.known.contains_key(&index) {
        let message = format!(
            "namespace {index} of node `{}` is not declared",
            short(text)
        );
        findings
            .error(Code::UndeclaredNamespace, place, message)
            .help(format!(
                "add it with its URI: `namespaces: {{{index}: urn:my-plant:line}}`"
            ));
    }
    Some(template)
}

/// Returns type and selection.
fn kind(
    (entry, owner): (&PatternEntry, TextSpan),
    origin: Option<SpaceId>,
    types: &mut MessageTypes,
    findings: &mut MappingFindings,
) -> Option<(Option<TypeName>, Selection)> {
    let chosen = SelectionKeys::from(entry);
    let chosen_at = |or: TextSpan| chosen.place().unwrap_or(or);
    // A pattern makes values of its own space, without a declared type.
    let way = ValueDirection {
        reads: true,
        declared: None,
        alone: false,
    };
    let Some(at) = &entry.r#type else {
        let selection = chosen.selection(None, (chosen_at(owner), way), findings)?;
        return Some((None, selection));
    };
    let text = at.value.as_ref()?;
    let Ok(name) = text.parse::<TypeName>() else {
        let message = format!("`{}` is not a message type name", short(text));
        findings
            .error(Code::MessageTypeName, at.place, message)
            .help("give package and name, such as std_msgs/Bool");
        return None;
    };
    let known =
        origin.and_then(|origin| types.get((dialect(origin), at.place), &name, findings).ok());
    let place = chosen_at(at.place);
    let selection = chosen.selection(known.as_deref(), (place, way), findings)?;
    if let Some(known) = known {
        selection::leaves(&known, &selection, (place, way), findings)?;
    }
    Some((Some(name), selection))
}
