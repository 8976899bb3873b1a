//! Renders a plan as YAML.

use std::collections::BTreeMap;
use std::ops::Range;

use mappings::{Motion, SpaceId};

use super::plan::{BoundTopic, Proposal, ProposedVariable};
use super::topics::ValueForm;
use super::yaml::{comment, scalar, wrapped};
use crate::survey::UaSource;

/// The lines of the variables of a plan, and the line range of each entry.
pub(super) struct Variables {
    pub(super) lines: Vec<String>,
    pub(super) entries: Vec<Range<usize>>,
}

/// Returns the head of a new file; `sources` are the inspected sources.
pub(super) fn head(sources: &[String]) -> Vec<String> {
    let mut lines = vec![
        "# yaml-language-server: $schema=schema.json".to_owned(),
        "#".to_owned(),
        "# Written by `ua-space init` after a look at".to_owned(),
    ];
    lines.extend(sources.iter().map(|one| format!("#   {}", comment(one))));
    let rest = [
        "# All programs of the cell read this file. You may change it: `ua-space init --merge` adds new",
        "# entries and keeps the others. Check the entries that are marked as a guess.",
        "#   ua-space check FILE                  prints all findings",
        "#   ua-space check --environment FILE    compares it with the running robots and servers",
        "#   ua-space schema > schema.json        is for editors, which then complete its keys",
    ];
    lines.extend(rest.map(str::to_owned));
    lines
}

/// Returns the lines of the ROS spaces.
pub(super) fn spaces(plan: &Proposal, indent: &str) -> Vec<String> {
    let space = |(id, domain): &(SpaceId, Option<u16>)| match domain {
        Some(domain) => format!("{indent}- {{id: {id}, domain: {domain}}}"),
        None => format!("{indent}- {{id: {id}}}"),
    };
    plan.spaces.iter().map(space).collect()
}

/// Returns the lines of the network settings, with their default values.
pub(super) fn network(plan: &Proposal) -> Vec<String> {
    let mut lines = [
        "",
        "# The network of the values. For several hosts name the interface that connects them.",
        "pubsub:",
        "  address: opc.udp://239.192.0.40:4840",
        "  # interface: eth0",
    ]
    .map(str::to_owned)
    .to_vec();
    if let Some(endpoint) = &plan.endpoint {
        lines.extend([
            String::new(),
            "server:".to_owned(),
            format!("  endpoint: {}", scalar(endpoint)),
        ]);
    }
    lines
}

/// Returns the lines of the existing servers.
pub(super) fn servers(plan: &Proposal, indent: &str) -> Vec<String> {
    let all = plan.servers.iter();
    all.map(|(name, endpoint)| {
        let endpoint = scalar(endpoint);
        format!("{indent}- {{name: {}, endpoint: {endpoint}}}", scalar(name))
    })
    .collect()
}

/// Returns the lines of the namespace indexes.
pub(super) fn namespaces(plan: &Proposal, indent: &str) -> Vec<String> {
    let all = plan.namespaces.iter();
    all.map(|(index, uri)| format!("{indent}{index}: {}", scalar(uri)))
        .collect()
}

/// Returns the variables, grouped under headings, and the topics left out.
pub(super) fn variables(plan: &Proposal, indent: &str) -> Variables {
    let mut lines = Vec::new();
    let mut entries = Vec::new();
    let mut group: Option<&str> = None;
    for entry in &plan.entries {
        if group != Some(&entry.group) {
            lines.push(String::new());
            match entry.group.as_str() {
                "" if group.is_none() => {}
                "" => lines.push(format!("{indent}# others")),
                name => lines.push(format!("{indent}# {}", comment(name))),
            }
            group = Some(&entry.group);
        }
        let from = lines.len();
        self::entry(entry, indent, &mut lines);
        entries.push(from..lines.len());
    }
    let lead = format!("{indent}#   ");
    if !plan.proposals.is_empty() {
        lines.extend([
            String::new(),
            format!("{indent}# Could be bound to what is there:"),
        ]);
        let proposals = plan.proposals.iter();
        lines.extend(proposals.map(|one| format!("{lead}{}", comment(one))));
    }
    let mut by_reason: BTreeMap<_, Vec<String>> = BTreeMap::new();
    for ((space, why), topics) in &plan.left_out {
        let topics = topics.iter().map(|topic| comment(topic));
        let all = by_reason.entry((*why, *space)).or_default();
        all.extend(topics);
    }
    for ((why, space), topics) in by_reason {
        let heading = why.heading();
        lines.extend([
            String::new(),
            format!("{indent}# Left out in space {space}: {heading}"),
        ]);
        lines.extend(wrapped(&lead, topics));
    }
    Variables { lines, entries }
}

fn entry(entry: &ProposedVariable, indent: &str, lines: &mut Vec<String>) {
    let mark = if entry.faulty.is_some() { "# " } else { "" };
    let mut say = |text: String| lines.push(format!("{indent}{text}"));
    let faulty = entry.faulty.iter().flat_map(|why| why.lines());
    for note in faulty.chain(entry.notes.iter().map(String::as_str)) {
        say(format!("# {}", comment(note)));
    }
    say(format!("{mark}- node: {}", scalar(&entry.node.to_string())));
    if let Some(alias) = entry.alias {
        say(format!("{mark}  alias: {alias}"));
    }
    say(format!("{mark}  name: {}", scalar(&entry.name)));
    if let Some((builtin, array)) = entry.value {
        let array = if array { "[]" } else { "" };
        say(format!("{mark}  type: {}{array}", builtin.name()));
    }
    say(format!("{mark}  origin: {}", entry.origin));
    if let Some(UaSource { server, node }) = &entry.source {
        let word = match entry.origin {
            SpaceId::UA => "from",
            _ => "to",
        };
        let (server, node) = (scalar(server), scalar(node));
        say(format!(
            "{mark}  {word}: {{server: {server}, node: {node}}}"
        ));
    }
    let commanded = entry
        .bindings
        .iter()
        .filter(|one| one.space != entry.origin);
    match commanded.filter_map(|one| Motion::of(&one.kind)).next() {
        Some(Motion::ByZero) => say(format!("{mark}  on_loss: zero")),
        Some(Motion::NotByZero) => say(
            "  # on_loss: zero is a movement of this type; name the fields that stop the robot, or a call"
                .to_owned(),
        ),
        None => {}
    }
    match entry.bindings.as_slice() {
        [] => {}
        [one] => say(format!(
            "{mark}  ros: {}",
            binding(one, entry.origin, false)
        )),
        several => {
            say(format!("{mark}  ros:"));
            for one in several {
                say(format!("{mark}    - {}", binding(one, entry.origin, true)));
            }
        }
    }
}

fn binding(bound: &BoundTopic, origin: SpaceId, named: bool) -> String {
    let BoundTopic {
        space,
        topic,
        kind,
        form,
    } = bound;
    let space = if named || *space != origin {
        format!("space: {space}, ")
    } else {
        String::new()
    };
    let form = match form {
        ValueForm::Field(path, _) => format!(", field: {}", scalar(path)),
        ValueForm::Whole => String::new(),
        ValueForm::Bytes => ", as: bytes".to_owned(),
    };
    format!("{{{space}topic: {}, type: {kind}{form}}}", scalar(topic))
}
