//! `opcua` of a call: the Method of another OPC UA server.

use super::Checker;
use crate::call::MethodTarget;
use crate::check::server::{is_own, remote_endpoint};
use crate::check::servers::{named, node};
use crate::code::Code;
use crate::document::{CallEntry, MethodEntry};
use crate::endpoint::Endpoint;
use crate::findings::MappingFindings;
use crate::node_id::NodeIdText;
use crate::read::Located;
use crate::remote::Access;
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// A part of the entry is faulty, which is noted.
pub(super) struct Faulty;

impl Checker<'_> {
    /// Returns the Method that executes a call, if `opcua` names one.
    pub(super) fn method(
        &self,
        entry: &CallEntry,
        node: Option<&(NodeIdText, TextSpan)>,
        origin: Option<(SpaceId, TextSpan)>,
        findings: &mut MappingFindings,
    ) -> Result<Option<MethodTarget>, Faulty> {
        let Some(Located { place, value }) = &entry.opcua else {
            return Ok(None);
        };
        let target = value
            .as_ref()
            .and_then(|method| self.target(method, *place, findings));
        let mut sound = true;
        if let Some((origin, at)) = origin
            && origin != SpaceId::UA
        {
            let message = format!("the call is executed in space {origin}, not by a Method");
            findings
                .error(Code::MethodTarget, at, message)
                .help("the OPC UA server of the cell calls Methods: set `origin: 0`");
            sound = false;
        }
        if let Some((node, at)) = node
            && node.namespace == 0
        {
            let message = "the server of the cell shows no Method in namespace 0";
            findings
                .error(Code::MethodTarget, *at, message)
                .help("use a node of a namespace of `namespaces`");
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
        place: TextSpan,
        findings: &mut MappingFindings,
    ) -> Option<MethodTarget> {
        let reached = self.reached(entry, place, findings);
        let object = node(&entry.object, ("object", "`opcua`"), place, findings);
        let method = node(&entry.method, ("method", "`opcua`"), place, findings);
        let (access, server) = reached?;
        Some(MethodTarget {
            access,
            server,
            object: object?,
            method: method?,
        })
    }

    /// Returns the access to the server, and its name if it has one.
    fn reached(
        &self,
        entry: &MethodEntry,
        place: TextSpan,
        findings: &mut MappingFindings,
    ) -> Option<(Access, Option<String>)> {
        match (&entry.server, &entry.endpoint) {
            (Some(at), None) => {
                let name = at.value.as_ref()?;
                let server = named(name, at.place, self.known.servers, findings)?;
                Some((server.access.clone(), Some(server.name.clone())))
            }
            (None, Some(at)) => {
                let endpoint = self.endpoint(at.value.as_ref()?, at.place, findings)?;
                Some((Access::anonymous(endpoint), None))
            }
            (Some(_), Some(at)) => {
                findings
                    .error(Code::MethodTarget, at.place, "a server and an endpoint")
                    .help("`server` already gives the address: remove `endpoint`");
                None
            }
            (None, None) => {
                findings
                    .error(Code::MissingKey, place, "`opcua` has no `server`")
                    .help("give the name of one of `servers`, or an `endpoint`");
                None
            }
        }
    }

    fn endpoint(
        &self,
        text: &str,
        place: TextSpan,
        findings: &mut MappingFindings,
    ) -> Option<Endpoint> {
        let endpoint = remote_endpoint(text, place, findings)?;
        if is_own(&endpoint, self.known.server) {
            let message = "the endpoint belongs to the server of the cell";
            findings.error(Code::MethodTarget, place, message).help(
                "give the server that has the Method; the server of the cell shows calls that are \
                       executed in the cell",
            );
            return None;
        }
        Some(endpoint)
    }
}
