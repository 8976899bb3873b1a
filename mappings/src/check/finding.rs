//! `server.find_skills`: the servers with skills that discovery finds.

use std::net::Ipv4Addr;

use super::cell::is_uri;
use super::quantity::within;
use super::required;
use super::server::policy;
use super::servers::Servers;
use crate::call::Call;
use crate::code::Code;
use crate::document::ServerEntry;
use crate::findings::MappingFindings;
use crate::mapping::Variable;
use crate::read::{Located, given, short};
use crate::remote::FindSkills;
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// Returns the rule for the servers with skills that the cell's server represents when they are
/// found. `None` for a faulty entry, which is noted.
pub(super) fn check(
    of: Option<&Located<ServerEntry>>,
    findings: &mut MappingFindings,
) -> Option<FindSkills> {
    const OF: &str = "`find_skills`";
    let server = of?.value.as_ref()?;
    let (entry, owner) = given(&server.find_skills)?;
    let uris = required(&entry.uris, "uris", OF, owner, findings)
        .and_then(|(uris, place)| application_uris(uris, place, findings));
    let first = required(&entry.first, "first", OF, owner, findings).map(|(first, _)| *first);
    let most = match &entry.most {
        None => Some(FindSkills::MOST),
        Some(_) => within(&entry.most, 1..=FindSkills::LIMIT, "servers", findings),
    };
    let networks = match given(&entry.networks) {
        Some((entries, place)) => networks(entries, place, findings),
        None => Some(Vec::new()),
    };
    let (uris, first, most, networks) = (uris?, first?, most?, networks?);
    if first < 2 || first.checked_add(most - 1).is_none() {
        let message = format!("{most} servers from namespace {first}");
        findings
            .error(Code::Servers, owner, message)
            .help("each server takes a namespace from `first` on, within 2 to 65535");
        return None;
    }
    Some(FindSkills {
        uris,
        first,
        most,
        security: given(&entry.security).map(|(entry, _)| policy(*entry)),
        open: given(&entry.open).is_some_and(|(open, _)| *open),
        networks,
    })
}

/// Reads IPv4 networks of at most 65536 addresses. Returns `None` for a faulty network, which is
/// noted.
fn networks(
    entries: &[Located<String>],
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Vec<String>> {
    if entries.len() > MOST_NETWORKS {
        let message = format!(
            "{} networks; at most {MOST_NETWORKS} are read",
            entries.len()
        );
        findings.error(Code::Servers, place, message);
        return None;
    }
    let mut networks = Vec::new();
    for entry in entries {
        let text = entry.value.as_ref()?;
        let (address, prefix) = text.split_once('/').unwrap_or((text, "32"));
        let is_address = address.parse::<Ipv4Addr>().is_ok();
        if !is_address
            || !prefix
                .parse()
                .is_ok_and(|prefix: u8| (16..=32).contains(&prefix))
        {
            let message = format!("`{}` is not an IPv4 network", short(text));
            findings
                .error(Code::Servers, entry.place, message)
                .help("for example networks: [10.77.0.0/16], at most 65536 addresses each");
            return None;
        }
        networks.push(text.clone());
    }
    Some(networks)
}

/// Reads ApplicationUris, or prefixes of them. Returns `None` for a faulty entry, which is noted.
fn application_uris(
    entries: &[Located<String>],
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Vec<String>> {
    if entries.is_empty() || entries.len() > MOST_URIS {
        let message = format!(
            "{} ApplicationUris; 1 to {MOST_URIS} are read",
            entries.len()
        );
        findings
            .error(Code::Servers, place, message)
            .help("uris: [\"urn:vendor:*\"]");
        return None;
    }
    let mut uris = Vec::new();
    for entry in entries {
        let text = entry.value.as_ref()?;
        let begins = text.strip_suffix('*').unwrap_or(text);
        let is_pattern = begins.len() < text.len();
        if begins.contains('*') || !(is_pattern || is_uri(begins)) || begins.contains(' ') {
            let message = format!(
                "`{}` is not an ApplicationUri or the beginning of one",
                short(text)
            );
            findings
                .error(Code::Servers, entry.place, message)
                .help("for example urn:vendor:press, or urn:vendor:* for all with this beginning");
            return None;
        }
        uris.push(text.clone());
    }
    Some(uris)
}

/// Notes variables, calls and servers in the namespaces that are reserved for servers that are
/// found.
pub(super) fn alone(
    (entry, found): (Option<&Located<ServerEntry>>, Option<&FindSkills>),
    servers: &Servers,
    (variables, calls): (&[Variable], &[Call]),
    findings: &mut MappingFindings,
) {
    let entry = entry.and_then(|at| at.value.as_ref());
    let place = entry.and_then(|entry| given(&entry.find_skills));
    let (Some(found), Some((_, place))) = (found, place) else {
        return;
    };
    let namespaces = found.namespaces();
    let named = servers.known.iter().filter_map(|server| {
        let skills = server.skills?;
        Some((
            skills.namespace,
            format!("belongs to the skills of `{}`", short(&server.name)),
        ))
    });
    let topics = variables
        .iter()
        .map(|variable| (variable.topic, &variable.name))
        .chain(calls.iter().map(|call| (call.topic, &call.name)));
    let topics = topics
        .filter(|(topic, _)| topic.space == SpaceId::UA)
        .map(|(topic, name)| {
            (
                topic.namespace.get(),
                format!("has `{}` ({topic})", short(name)),
            )
        });
    let other = named
        .chain(topics)
        .find(|(namespace, _)| namespaces.contains(namespace));
    if let Some((namespace, what)) = other {
        let (first, last) = (namespaces.start(), namespaces.end());
        let message = format!(
            "namespaces {first} to {last} are reserved for found servers, but {namespace} {what}"
        );
        findings
            .error(Code::Servers, place, message)
            .help("set `first` to a free range, or reduce `most`");
    }
}

/// Maximum number of entries of `networks`.
const MOST_NETWORKS: usize = 64;
/// Maximum number of entries of `uris`.
const MOST_URIS: usize = 64;
