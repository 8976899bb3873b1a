//! `from` and `to` of a variable.

use super::servers::{self, Servers};
use super::types::ValueType;
use crate::code::Code;
use crate::document::VariableEntry;
use crate::findings::MappingFindings;
use crate::node_id::NodeIdText;
use crate::read::given;
use crate::remote::{NodeSource, NodeTarget};
use crate::topic::SpaceId;

/// Source and target of a variable at other servers.
pub(super) type RemoteKeys = (Option<Box<NodeSource>>, Option<Box<NodeTarget>>);

/// Properties of the variable that are known.
pub(super) struct RemoteVariable<'s> {
    pub(super) origin: Option<SpaceId>,
    pub(super) node: Option<&'s NodeIdText>,
    /// `true` for a variable with one value, and for a variable whose fields are not known.
    pub(super) single: bool,
    pub(super) value_type: Option<ValueType>,
    /// `true` if ROS or a service produces its values.
    pub(super) produced: bool,
}

/// Returns `None` for a faulty entry, which is noted.
pub(super) fn check(
    entry: &VariableEntry,
    subject: &RemoteVariable<'_>,
    servers: &Servers,
    findings: &mut MappingFindings,
) -> Option<RemoteKeys> {
    let from = match &entry.from {
        None => None,
        Some(at) => {
            let source = servers::source(at, servers, findings);
            let sound = may_come(entry, subject, findings);
            Some(source.filter(|_| sound)?)
        }
    };
    let to = match &entry.to {
        None => None,
        Some(at) => {
            let target = servers::target(at, servers, findings)?;
            if !subject.single {
                findings
                    .error(
                        Code::RemoteNode,
                        at.place,
                        "a value with several fields cannot be written to a node",
                    )
                    .help("bind one `field` of the message, or use `as: bytes`");
                return None;
            }
            if let Some(from) = &from
                && from.server == target.server
                && from.node == target.node
            {
                findings
                    .error(
                        Code::RemoteNode,
                        at.place,
                        "the value is written to the node that it comes from",
                    )
                    .help("remove `to`");
                return None;
            }
            Some(target)
        }
    };
    Some((from.map(Box::new), to.map(Box::new)))
}

/// Returns `true` if its values can come from another server.
fn may_come(
    entry: &VariableEntry,
    subject: &RemoteVariable<'_>,
    findings: &mut MappingFindings,
) -> bool {
    let Some(place) = entry.from.as_ref().map(|at| at.place) else {
        return true;
    };
    let mut sound = true;
    let mut fault = |place, message: String, help: &str| {
        findings.error(Code::RemoteNode, place, message).help(help);
        sound = false;
    };
    if let Some(origin) = subject.origin.filter(|origin| *origin != SpaceId::UA) {
        let at = entry.origin.as_ref().map_or(place, |at| at.place);
        let message = format!("the value comes from an OPC UA server, not from space {origin}");
        fault(at, message, "origin: 0");
    } else if subject.produced {
        fault(
            place,
            "the value comes from a node and from a ROS service".to_owned(),
            "remove one of them",
        );
    }
    if subject.node.is_some_and(|node| node.namespace == 0) {
        let at = entry.node.as_ref().map_or(place, |at| at.place);
        fault(
            at,
            "the server of the cell shows no such value in namespace 0".to_owned(),
            "use a node of a namespace of `namespaces`",
        );
    }
    if entry.ua_field.is_some() {
        fault(
            place,
            "the value comes from a node, not from a publisher with several fields".to_owned(),
            "remove `ua_field`",
        );
    }
    let deadband = entry.from.as_ref().and_then(|at| at.value.as_ref());
    if let Some((_, at)) = deadband.and_then(|from| given(&from.deadband))
        && subject
            .value_type
            .is_some_and(|(builtin, array)| array || !builtin.is_number())
    {
        let message = "a deadband of a server requires a single number".to_owned();
        fault(at, message, "remove it: the server reports every change");
    }
    sound
}
