//! The OPC UA server of the cell.

use std::path::PathBuf;

use super::cell::is_uri;
use super::permissions;
use super::quantity::{duration, within};
use crate::code::Code;
use crate::document::{HistoryEntry, LimitsEntry, SecurityEntry, ServerEntry};
use crate::endpoint::Endpoint;
use crate::findings::MappingFindings;
use crate::quality::History;
use crate::read::{Located, OptionalKey, given, short};
use crate::remote::ServerSecurityPolicy;
use crate::secret::has_user;
use crate::server::{Server, ServerLimits};
use crate::tree::TextSpan;

/// Returns the server, with defaults for faulty keys, which are noted.
pub(super) fn check(
    entry: Option<&Located<ServerEntry>>,
    findings: &mut MappingFindings,
) -> Server {
    let default = Server::default();
    let Some(entry) = entry.and_then(|at| at.value.as_ref()) else {
        return default;
    };
    let endpoint = given(&entry.endpoint).and_then(|(text, place)| {
        let endpoint = Endpoint::parse(text);
        if endpoint.is_none() {
            let message = format!("`{}` is not an endpoint", short(text));
            let mut note = findings.error(Code::Endpoint, place, message);
            if has_user(text) {
                note = note.label("remove the user name and the password");
            }
            note.help(format!("for example {}", default.endpoint));
        }
        endpoint
    });
    let application_uri = given(&entry.application_uri).and_then(|(text, place)| {
        if is_uri(text) {
            return Some(text.clone());
        }
        let message = format!("`{}` is not an ApplicationUri", short(text));
        let mut note = findings.error(Code::ApplicationUri, place, message);
        if has_user(text) {
            note = note.label("every client can read it: remove the user name and the password");
        }
        note.help(format!("for example {}", default.application_uri));
        None
    });
    let security =
        given(&entry.security).and_then(|(entries, place)| security(entries, place, findings));
    let redundant = redundant(&entry.redundant, findings);
    let redundant_endpoints =
        redundant_endpoints(&entry.redundant_endpoints, redundant.len(), findings);
    let server = Server {
        endpoint: endpoint.unwrap_or(default.endpoint),
        application_uri: application_uri.unwrap_or(default.application_uri),
        redundant,
        redundant_endpoints,
        security,
        anonymous: permissions::anonymous(entry),
        refuse_other_hosts: given(&entry.refuse_other_hosts).is_some_and(|(refuse, _)| *refuse),
        bad_after: duration(&entry.bad_after, findings),
        publisher_alarms: given(&entry.publisher_alarms).is_some_and(|(on, _)| *on),
        reverse_connect: reverse_connect(&entry.reverse_connect, findings),
        history: history(&entry.history, findings),
        history_file: given(&entry.history)
            .and_then(|(history, _)| given(&history.file))
            .map(|(file, _)| PathBuf::from(file)),
        limits: limits(&entry.limits, findings),
        find_skills: None,
        nodesets: Vec::new(),
    };
    permissions::left_open(entry, &server, findings);
    server
}

/// Reads the ApplicationUris of redundant servers.
fn redundant(
    field: &OptionalKey<Vec<Located<String>>>,
    findings: &mut MappingFindings,
) -> Vec<String> {
    let Some((entries, place)) = given(field) else {
        return Vec::new();
    };
    let mut uris: Vec<String> = Vec::new();
    for entry in entries {
        let Some(text) = entry.value.as_ref() else {
            return Vec::new();
        };
        if !is_uri(text) || uris.contains(text) {
            let message = if uris.contains(text) {
                format!("`{}` is the ApplicationUri of two servers", short(text))
            } else {
                format!("`{}` is not an ApplicationUri", short(text))
            };
            findings
                .error(Code::ApplicationUri, entry.place, message)
                .help("redundant: [\"urn:cell:server-1\", \"urn:cell:server-2\"]");
            return Vec::new();
        }
        uris.push(text.clone());
    }
    if !(2..=3).contains(&uris.len()) {
        let message = format!("{} redundant servers; 2 or 3 are possible", uris.len());
        findings
            .error(Code::ApplicationUri, place, message)
            .help("redundant: [\"urn:cell:server-1\", \"urn:cell:server-2\"]");
        return Vec::new();
    }
    uris
}

/// Reads the endpoints of redundant servers, one for each of their ApplicationUris.
fn redundant_endpoints(
    field: &OptionalKey<Vec<Located<String>>>,
    servers: usize,
    findings: &mut MappingFindings,
) -> Vec<Endpoint> {
    let Some((entries, place)) = given(field) else {
        return Vec::new();
    };
    let mut endpoints: Vec<Endpoint> = Vec::new();
    for Located { place, value } in entries {
        let Some(text) = value else {
            return Vec::new();
        };
        let Some(endpoint) = remote_endpoint(text, *place, findings) else {
            return Vec::new();
        };
        if endpoints.contains(&endpoint) {
            let message = format!("{endpoint} is the endpoint of two redundant servers");
            let note = findings.error(Code::Endpoint, *place, message);
            note.help("give each server an endpoint of its own");
            return Vec::new();
        }
        endpoints.push(endpoint);
    }
    if endpoints.len() != servers {
        let message = format!(
            "{} endpoints for {servers} servers of `redundant`",
            endpoints.len()
        );
        let note = findings.error(Code::Endpoint, place, message);
        note.help("list an endpoint for each ApplicationUri of `redundant`, in the same order");
        return Vec::new();
    }
    endpoints
}

/// Returns the clients to which the server connects.
fn reverse_connect(
    field: &OptionalKey<Vec<Located<String>>>,
    findings: &mut MappingFindings,
) -> Vec<Endpoint> {
    let Some((entries, place)) = given(field) else {
        return Vec::new();
    };
    if entries.len() > MAX_REVERSE {
        let message = format!("{} clients; at most {MAX_REVERSE}", entries.len());
        findings.error(Code::TooLarge, place, message);
        return Vec::new();
    }
    let mut clients: Vec<Endpoint> = Vec::new();
    for Located { place, value } in entries {
        let Some(text) = value else { continue };
        let Some(client) = remote_endpoint(text, *place, findings) else {
            continue;
        };
        if clients.contains(&client) {
            let message = format!("the client {client} is listed twice");
            findings.error(Code::Endpoint, *place, message);
            continue;
        }
        clients.push(client);
    }
    clients
}

/// Maximum number of clients to which the server connects.
const MAX_REVERSE: usize = 16;

fn history(field: &OptionalKey<HistoryEntry>, findings: &mut MappingFindings) -> History {
    let usual = History::default();
    let Some((entry, _)) = given(field) else {
        return usual;
    };
    let megabytes = within(&entry.megabytes, 1..=16_384, "MiB", findings);
    History {
        values: given(&entry.values).map_or(usual.values, |(count, _)| *count),
        bytes: megabytes.map_or(usual.bytes, |mebibytes| usize::from(mebibytes) << 20),
    }
}

fn limits(field: &OptionalKey<LimitsEntry>, findings: &mut MappingFindings) -> ServerLimits {
    let Some((entry, _)) = given(field) else {
        return ServerLimits::default();
    };
    ServerLimits {
        sessions: within(&entry.sessions, 1..=10_000, "sessions", findings),
        sessions_per_address: within(
            &entry.sessions_per_address,
            1..=10_000,
            "sessions of an address",
            findings,
        ),
        connections: within(&entry.connections, 1..=u16::MAX, "connections", findings),
        connections_per_address: within(
            &entry.connections_per_address,
            1..=u16::MAX,
            "connections of an address",
            findings,
        ),
        subscriptions: within(&entry.subscriptions, 1..=1_000, "subscriptions", findings),
        items: within(&entry.items, 1..=u16::MAX, "items", findings),
        operations: within(&entry.operations, 1..=u16::MAX, "operations", findings),
    }
}

/// Reads the endpoint of another server. Returns `None` for a faulty endpoint, which is noted.
pub(super) fn remote_endpoint(
    text: &str,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Endpoint> {
    let endpoint = Endpoint::parse(text);
    if endpoint.is_none() {
        let message = format!("`{}` is not an endpoint", short(text));
        let mut note = findings.error(Code::Endpoint, place, message);
        if has_user(text) {
            note = note.label("remove the user name and the password");
        }
        note.help("use an endpoint such as opc.tcp://192.168.0.10:4840");
    }
    endpoint
}

/// Returns `true` for the endpoint of the cell's own server.
pub(super) fn is_own(endpoint: &Endpoint, own: &Server) -> bool {
    own.endpoints()
        .any(|own| endpoint.host.eq_ignore_ascii_case(&own.host) && endpoint.port == own.port)
}

fn security(
    entries: &[Located<SecurityEntry>],
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Vec<ServerSecurityPolicy>> {
    if entries.is_empty() {
        let message = "a server without a security policy has no endpoint";
        findings
            .error(Code::WrongValue, place, message)
            .help("security: [None, Basic256Sha256]");
        return None;
    }
    let mut policies = Vec::new();
    for entry in entries {
        let Some(policy) = entry.value.map(policy) else {
            continue;
        };
        if policies.contains(&policy) {
            let message = format!("the security policy {} is listed twice", policy.name());
            findings
                .warning(Code::WrongValue, entry.place, message)
                .help("remove it here");
        } else {
            policies.push(policy);
        }
    }
    Some(policies)
}

pub(super) const fn policy(entry: SecurityEntry) -> ServerSecurityPolicy {
    match entry {
        SecurityEntry::None => ServerSecurityPolicy::None,
        SecurityEntry::Basic256Sha256 => ServerSecurityPolicy::Basic256Sha256,
        SecurityEntry::Aes128Sha256RsaOaep => ServerSecurityPolicy::Aes128Sha256RsaOaep,
        SecurityEntry::Aes256Sha256RsaPss => ServerSecurityPolicy::Aes256Sha256RsaPss,
    }
}
