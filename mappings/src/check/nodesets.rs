//! NodeSet2 files that the server loads, and their nodes in the mapping.

use std::path::PathBuf;

use super::types::{print, value_type};
use crate::code::Code;
use crate::document::{Document, ServerEntry, VariableEntry};
use crate::findings::MappingFindings;
use crate::mapping::{Mapping, Variable};
use crate::nodesets::{NodeSetNode, NodeSets};
use crate::read::{Located, given, short};
use crate::surroundings::Surroundings;
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// Returns the files and their positions. Faulty entries are left out.
pub(super) fn files(
    entry: Option<&Located<ServerEntry>>,
    findings: &mut MappingFindings,
) -> (Vec<PathBuf>, Vec<TextSpan>) {
    let entries = entry.and_then(|at| given(&at.value.as_ref()?.nodesets));
    let entries = entries.map_or(&[][..], |(entries, _)| entries);
    if let Some(first) = entries.get(MOST) {
        let message = format!("{} NodeSets; at most {MOST} are loaded", entries.len());
        findings.error(Code::TooLarge, first.place, message);
    }
    let sound = entries
        .iter()
        .take(MOST)
        .filter_map(|at| Some((at.value.as_ref()?, at.place)));
    sound
        .filter(|(path, place)| {
            if path.is_empty() {
                findings.error(Code::WrongValue, *place, "the path is empty");
            }
            !path.is_empty()
        })
        .map(|(path, place)| (PathBuf::from(path), place))
        .unzip()
}

/// Reads the files if this program can read them, and compares their nodes with the mapping. Only
/// the server needs the files.
pub(super) fn check(
    document: &Document,
    mapping: &Mapping,
    places: &[TextSpan],
    around: &dyn Surroundings,
    findings: &mut MappingFindings,
) {
    let files = &mapping.server().nodesets;
    if files.is_empty() {
        return;
    }
    let Some(mut sets) = around.nodesets(files) else {
        return;
    };
    findings.of_part([SpaceId::UA]);
    let mut is_whole = true;
    for fault in sets.faults() {
        let Some(place) = places.get(fault.file) else {
            continue;
        };
        is_whole &= !fault.is_fatal;
        let note = if fault.is_fatal {
            findings.error(Code::NodeSet, *place, fault.what)
        } else {
            findings.warning(Code::NodeSet, *place, fault.what)
        };
        note.help(fault.help);
    }
    if is_whole {
        own_namespace(mapping, places, sets.as_ref(), findings);
        nodes(document, mapping, sets.as_ref(), findings);
    }
    findings.of_part(None);
}

/// Notes a file with nodes of the server's own namespace, which is reserved for the server.
fn own_namespace(
    mapping: &Mapping,
    places: &[TextSpan],
    sets: &dyn NodeSets,
    findings: &mut MappingFindings,
) {
    let own = &mapping.server().application_uri;
    if let Some(place) = places.first()
        && sets.has(own)
    {
        let message = format!(
            "a NodeSet has nodes of `{}`, the namespace of the server itself",
            short(own)
        );
        let note = findings.error(Code::NodeSet, *place, message);
        note.help("give the server another `application_uri`");
    }
}

/// Compares the mapping's nodes with the nodes of the files. Checks nothing if an entry is faulty.
fn nodes(
    document: &Document,
    mapping: &Mapping,
    sets: &dyn NodeSets,
    findings: &mut MappingFindings,
) {
    if !document.has_all_of(mapping) {
        return;
    }
    let entries = document.variables.as_ref().and_then(|at| at.value.as_ref());
    for (at, one) in entries.into_iter().flatten().zip(mapping.variables()) {
        let (Some(entry), Some(uri)) = (&at.value, mapping.namespaces().get(&one.node.namespace))
        else {
            continue;
        };
        if sets.has(uri) {
            let place = given(&entry.node).map_or(at.place, |(_, place)| place);
            match sets.node(uri, &one.node.identifier) {
                Some(node) => variable(entry, one, (node, place), findings),
                None => created(&one.node.to_string(), uri, place, findings),
            }
        }
    }
    let entries = document.calls.as_ref().and_then(|at| at.value.as_ref());
    for (at, call) in entries.into_iter().flatten().zip(mapping.calls()) {
        let uri = mapping.namespaces().get(&call.node.namespace);
        let node = uri.and_then(|uri| sets.node(uri, &call.node.identifier));
        if let (Some(entry), Some(node)) = (&at.value, node)
            && node != NodeSetNode::Method
        {
            let message = format!(
                "`{}` is not a Method in its NodeSet",
                short(&call.node.to_string())
            );
            let place = given(&entry.node).map_or(at.place, |(_, place)| place);
            let note = findings.error(Code::NodeSetNode, place, message);
            note.help("name a Method");
        }
    }
}

fn created(node: &str, uri: &str, place: TextSpan, findings: &mut MappingFindings) {
    let message = format!(
        "no NodeSet has a node `{}` of `{}`",
        short(node),
        short(uri)
    );
    let note = findings.warning(Code::NodeSetNode, place, message);
    note.help(
        "the server adds a node for the value: correct the node id, or use another namespace",
    );
}

fn variable(
    entry: &VariableEntry,
    one: &Variable,
    (node, place): (NodeSetNode, TextSpan),
    findings: &mut MappingFindings,
) {
    let id = one.node.to_string();
    let NodeSetNode::Variable(..) = node else {
        let message = format!("`{}` is not a Variable in its NodeSet", short(&id));
        let note = findings.error(Code::NodeSetNode, place, message);
        note.help("use a Variable; the NodeSet adds the objects and types around it");
        return;
    };
    let fields: Vec<_> = one.fields.iter().map(value_type).collect();
    let value = match (one.value_type, &fields[..]) {
        (Some(value), _) => value,
        (None, [only]) => *only,
        (None, [_, _, ..]) => {
            let message = format!(
                "the value has {} fields, but the Variable `{}` of a NodeSet takes one value",
                fields.len(),
                short(&id)
            );
            let note = findings.error(Code::NodeSetNode, place, message);
            note.help("bind one `field` of the message");
            return;
        }
        (None, []) => {
            if let Some(wanted) = node.value_type() {
                let message = format!(
                    "the type of the value is not given; `{}` is {}",
                    short(&id),
                    print(wanted)
                );
                let note = findings.error(Code::NodeSetNode, place, message);
                note.help(format!("type: {}", print(wanted)));
            }
            return;
        }
    };
    if node.takes(value) {
        return;
    }
    let wanted = node.value_type();
    let is = wanted.map_or_else(
        || "does not accept such a value".to_owned(),
        |wanted| format!("is {}", print(wanted)),
    );
    let message = format!(
        "`{}` is {} here, but in its NodeSet it {is}",
        short(&id),
        print(value)
    );
    let place = given(&entry.r#type).map_or(place, |(_, place)| place);
    let note = findings.error(Code::NodeSetNode, place, message);
    if let Some(wanted) = wanted {
        note.help(format!("type: {}", print(wanted)));
    }
}

/// Maximum number of files.
const MOST: usize = 64;
