//! `opcua` of a call: the Method of another OPC UA server.

use super::Checker;
use crate::call::MethodTarget;
use crate::check::network::parse_endpoint;
use crate::check::required;
use crate::code::Code;
use crate::document::{CallEntry, MethodEntry};
use crate::findings::Findings;
use crate::mapping::Endpoint;
use crate::node_id::{ExpandedNodeIdText, NodeIdText};
use crate::read::{At, Field, given, short};
use crate::secret::has_user;
use crate::topic::SpaceId;
use crate::tree::Place;

/// Something of it is faulty, which is noted.
pub(super) struct Faulty;

impl Checker<'_> {
    /// The Method that executes a call, if one does.
    pub(super) fn method(
        &self,
        entry: &CallEntry,
        node: Option<&(NodeIdText, Place)>,
        origin: Option<(SpaceId, Place)>,
        findings: &mut Findings,
    ) -> Result<Option<MethodTarget>, Faulty> {
        let Some(At { place, value }) = &entry.opcua else {
            return Ok(None);
        };
        let target = value
            .as_ref()
            .and_then(|method| self.target(method, *place, findings));
        let mut sound = true;
        if let Some((origin, at)) = origin
            && origin != SpaceId::UA
        {
            let message = format!("the call is executed in space {origin}, and not by a Method");
            findings
                .error(Code::MethodTarget, at, message)
                .help("the cell's OPC UA server calls Methods: `origin: 0`");
            sound = false;
        }
        if let Some((node, at)) = node
            && node.namespace == 0
        {
            let message = "the cell's server shows no Method in namespace 0";
            findings
                .error(Code::MethodTarget, *at, message)
                .help("take a node of a namespace of `namespaces`");
            sound = false;
        }
        match target {
            Some(target) if sound => Ok(Some(target)),
            Some(_) | None => Err(Faulty),
        }
    }

    fn target(
        &self,
        entry: &MethodEntry,
        place: Place,
        findings: &mut Findings,
    ) -> Option<MethodTarget> {
        let endpoint = required(&entry.endpoint, "endpoint", "`opcua`", place, findings)
            .and_then(|(text, place)| self.endpoint(text, place, findings));
        let object = node(&entry.object, "object", place, findings);
        let method = node(&entry.method, "method", place, findings);
        Some(MethodTarget {
            endpoint: endpoint?,
            object: object?,
            method: method?,
        })
    }

    fn endpoint(&self, text: &str, place: Place, findings: &mut Findings) -> Option<Endpoint> {
        let Some(endpoint) = parse_endpoint(text) else {
            let message = format!("`{}` is no endpoint", short(text));
            let mut note = findings.error(Code::Endpoint, place, message);
            if has_user(text) {
                note = note.label("it has no user name or password");
            }
            note.help("for example opc.tcp://192.168.0.10:4840");
            return None;
        };
        let own = self.known.server;
        if endpoint.host.eq_ignore_ascii_case(&own.host) && endpoint.port == own.port {
            let message = "the endpoint is that of the cell's own server";
            findings
                .error(Code::MethodTarget, place, message)
                .help("the server shows what is executed in the cell; name the server that has the Method");
            return None;
        }
        Some(endpoint)
    }
}

fn node(
    field: &Field<String>,
    key: &str,
    owner: Place,
    findings: &mut Findings,
) -> Option<ExpandedNodeIdText> {
    required(field, key, "`opcua`", owner, findings)?;
    let (text, place) = given(field)?;
    match text.parse() {
        Ok(node) => Some(node),
        Err(error) => {
            let message = format!("`{}` is no node id", short(text));
            findings.error(Code::NodeId, place, message).help(format!(
                "{error}; of another server best with the URI of its namespace, as nsu=urn:plc;s=Line.Reset"
            ));
            None
        }
    }
}
