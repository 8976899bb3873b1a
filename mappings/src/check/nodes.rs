//! The nodes of variables and calls: their NodeIds, names and spaces.

use std::collections::BTreeMap;
use std::num::NonZeroU16;

use super::Declared;
use crate::code::Code;
use crate::findings::MappingFindings;
use crate::mapping::Space;
use crate::node_id::NodeIdText;
use crate::read::short;
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// WriterGroupId of nodes of namespace 0, because index 0 is the null value: the highest number,
/// which no server uses as an index.
pub(super) const NAMESPACE_ZERO: NonZeroU16 = NonZeroU16::MAX;

pub(super) type CheckedNamespaces = Declared<BTreeMap<u16, String>>;
pub(super) type Spaces = Declared<Vec<Space>>;

pub(super) fn node_id(
    text: &str,
    place: TextSpan,
    namespaces: &CheckedNamespaces,
    findings: &mut MappingFindings,
) -> Option<(NodeIdText, TextSpan)> {
    let node: NodeIdText = match text.parse() {
        Ok(node) => node,
        Err(error) => {
            let message = format!("`{}` is not a node id", short(text));
            findings
                .error(Code::NodeId, place, message)
                .help(error.to_string());
            return None;
        }
    };
    let index = node.namespace;
    if index != 0 && !namespaces.partial && !namespaces.known.contains_key(&index) {
        let message = format!(
            "namespace {index} of node `{}` is not declared",
            short(text)
        );
        let note = findings.error(Code::UndeclaredNamespace, place, message);
        note.help(format!(
            "add it with its URI: `namespaces: {{{index}: urn:my-plant:line}}`"
        ));
    }
    Some((node, place))
}

/// Returns the OPC UA side, or a declared space.
pub(super) fn space(
    number: u16,
    place: TextSpan,
    key: &str,
    spaces: &Spaces,
    findings: &mut MappingFindings,
) -> Option<SpaceId> {
    let Some(id) = SpaceId::new(number) else {
        let message = format!("{key} {number} is not a space");
        findings
            .error(Code::SpaceId, place, message)
            .label("0 to 232");
        return None;
    };
    if id == SpaceId::UA || spaces.partial || spaces.known.iter().any(|space| space.id == id) {
        return Some(id);
    }
    let message = format!("{key} {number} is not one of the declared spaces");
    let note = findings.error(Code::UndeclaredSpace, place, message);
    let known: Vec<String> = spaces
        .known
        .iter()
        .map(|space| space.id.to_string())
        .collect();
    let known = if known.is_empty() {
        "none but 0".to_owned()
    } else {
        format!("0, {}", known.join(", "))
    };
    note.help(format!(
        "declared are {known}; add `- {{id: {number}}}` to `spaces`"
    ));
    None
}

pub(super) fn checked_name(
    name: &str,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<String> {
    let fault = if name.trim().is_empty() {
        "is empty"
    } else if name.chars().count() > 512 {
        "is longer than 512 characters"
    } else if name.contains(char::is_control) {
        "holds a control character"
    } else {
        return Some(name.to_owned());
    };
    findings
        .error(Code::Name, place, format!("the name {fault}"))
        .help("use a name such as ConveyorRunning");
    None
}
