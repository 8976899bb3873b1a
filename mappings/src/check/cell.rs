//! Spaces and namespaces.

use std::collections::BTreeMap;

use super::{Declared, required};
use crate::code::Code;
use crate::document::{Namespaces, SpaceEntry};
use crate::findings::MappingFindings;
use crate::mapping::Space;
use crate::read::{Located, given};
use crate::secret::has_user;
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// Highest DDS domain with ports that fit into 16 bits (DDSI-RTPS 2.3, 9.6.1.1).
const MAX_DOMAIN: u16 = 232;

pub(super) fn spaces(
    entries: Option<&Located<Vec<Located<SpaceEntry>>>>,
    findings: &mut MappingFindings,
) -> Declared<Vec<Space>> {
    let mut declared = Declared {
        known: Vec::new(),
        partial: false,
    };
    let Some(entries) = entries else {
        return declared;
    };
    let mut ids = BTreeMap::new();
    let mut domains = BTreeMap::new();
    declared.partial = entries.value.is_none();
    for at in entries.value.iter().flatten() {
        let Some(entry) = &at.value else {
            declared.partial = true;
            continue;
        };
        let Some((id, place)) = id(entry, at.place, findings) else {
            declared.partial = true;
            continue;
        };
        if let Some(first) = ids.insert(id, place) {
            let line = findings.line(first, place);
            let note = findings.error(
                Code::SpaceTwice,
                place,
                format!("space {id} is declared twice"),
            );
            note.label(format!("first at {line}"));
            continue;
        }
        let (domain, place) = domain(entry, id, place, findings);
        if let Some(domain) = domain
            && let Some((other, first)) = domains.insert(domain, (id, place))
        {
            let line = findings.line(first, place);
            let message = format!("spaces {other} and {id} are both in DDS domain {domain}");
            let note = findings.error(Code::DomainTwice, place, message);
            note.label(format!("space {other} at {line}"))
                .help("give one of them a `domain` of its own");
        }
        declared.known.push(Space { id, domain });
    }
    declared.known.sort_by_key(|space| space.id);
    declared
}

fn id(
    entry: &SpaceEntry,
    owner: TextSpan,
    findings: &mut MappingFindings,
) -> Option<(SpaceId, TextSpan)> {
    let (number, place) = required(&entry.id, "id", "the space", owner, findings)?;
    let Some(id) = SpaceId::new(*number).filter(|id| *id != SpaceId::UA) else {
        let what = if *number == 0 {
            "0 is the OPC UA side"
        } else {
            "the highest id is 232"
        };
        let note = findings.error(
            Code::SpaceId,
            place,
            format!("{number} cannot be the id of a ROS space"),
        );
        note.label(what)
            .help("1 is the ROS 1 space, 2 to 232 are ROS 2 spaces");
        return None;
    };
    let expected = if id.is_ros2() { 2 } else { 1 };
    if let Some((version, place)) = given(&entry.ros)
        && *version != expected
    {
        let message = match version {
            1 | 2 => format!("space {id} is a ROS {expected} space, not ROS {version}"),
            _ => format!("there is no ROS {version}"),
        };
        findings
            .error(Code::SpaceId, place, message)
            .help("1 is the ROS 1 space, 2 to 232 are ROS 2 spaces");
    }
    Some((id, place))
}

fn domain(
    entry: &SpaceEntry,
    id: SpaceId,
    owner: TextSpan,
    findings: &mut MappingFindings,
) -> (Option<u16>, TextSpan) {
    let default = id.is_ros2().then_some(u16::from(id));
    let Some((domain, place)) = given(&entry.domain) else {
        return (default, owner);
    };
    if !id.is_ros2() {
        let note = findings.error(Code::Domain, place, "ROS 1 has no DDS domain");
        note.help("remove `domain`; ROS_MASTER_URI gives the address of the master");
        return (None, place);
    }
    if *domain > MAX_DOMAIN {
        let message = format!("the DDS domain {domain} does not exist");
        findings
            .error(Code::Domain, place, message)
            .label(format!("0 to {MAX_DOMAIN}"));
        return (None, place);
    }
    (Some(*domain), place)
}

pub(super) fn namespaces(
    entries: Option<&Located<Namespaces>>,
    findings: &mut MappingFindings,
) -> Declared<BTreeMap<u16, String>> {
    let mut declared = Declared {
        known: BTreeMap::new(),
        partial: false,
    };
    let Some(entries) = entries else {
        return declared;
    };
    declared.partial = entries.value.is_none();
    let mut uris: BTreeMap<&str, (u16, TextSpan)> = BTreeMap::new();
    let mut places: BTreeMap<u16, TextSpan> = BTreeMap::new();
    for (index, uri) in entries.value.iter().flatten() {
        let (Some(number), Some(text)) = (index.value, uri.value.as_deref()) else {
            declared.partial = true;
            // The index is declared even if its URI is faulty.
            declared
                .known
                .extend(index.value.map(|number| (number, String::new())));
            continue;
        };
        if number == 0 {
            let message = "namespace 0 belongs to OPC UA and always exists";
            findings
                .error(Code::Namespace, index.place, message)
                .help("leave it out");
            continue;
        }
        if !is_uri(text) {
            let message = format!("`{}` is not a namespace URI", crate::read::short(text));
            let mut note = findings.error(Code::Namespace, uri.place, message);
            if has_user(text) {
                note =
                    note.label("every client can read it: remove the user name and the password");
            }
            note.help("use a URI such as urn:my-plant:line-1");
        }
        if let Some((other, first)) = uris.insert(text, (number, index.place)) {
            let line = findings.line(first, uri.place);
            let message = format!("namespaces {other} and {number} have the same URI");
            findings
                .error(Code::Namespace, uri.place, message)
                .label(format!("first at {line}"));
        }
        let first = places.insert(number, index.place);
        declared.known.insert(number, text.to_owned());
        if let Some(first) = first {
            let line = findings.line(first, index.place);
            let message = format!("namespace {number} is declared twice");
            findings
                .error(Code::Namespace, index.place, message)
                .label(format!("first at {line}"))
                .help("use each index once; 01 and 1 are the same index");
        }
    }
    declared
}

/// Returns `true` for a URI by the few rules of RFC 3986 that detect mistakes: a scheme, a colon,
/// and a rest without spaces. A user name or password is refused, because every program can read
/// the URI.
pub(super) fn is_uri(text: &str) -> bool {
    let Some((scheme, rest)) = text.split_once(':') else {
        return false;
    };
    scheme.starts_with(|c: char| c.is_ascii_alphabetic())
        && scheme
            .bytes()
            .all(|b| b.is_ascii_alphanumeric() || b"+-.".contains(&b))
        && !rest.is_empty()
        && text.len() <= 4096
        && !has_user(text)
        && !rest.contains(|c: char| c.is_whitespace() || c.is_control())
}
