//! SecurityGroups, and the messages that are not secured beside them.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use super::quantity::duration;
use super::required;
use crate::call::Call;
use crate::code::Code;
use crate::document::{
    Document, GroupEntry, GroupModeEntry, GroupPolicyEntry, KeysEntry, ReplayEntry, SksEntry,
};
use crate::endpoint::Endpoint;
use crate::findings::MappingFindings;
use crate::key_text::is_key;
use crate::mapping::Mapping;
use crate::read::{Located, given, short};
use crate::remote::ServerSecurityPolicy;
use crate::security::{GroupMode, GroupPolicy, KeySource, Replay, SecurityGroup, ServedKeys};
use crate::server::Server;
use crate::tree::TextSpan;

/// Maximum number of groups of a document.
const MAX_GROUPS: usize = 64;
/// Default lifetime of a key.
const LIFETIME: Duration = Duration::from_secs(3600);
/// Shortest lifetime of a key: programs need time to get the next one.
const LEAST_LIFETIME: Duration = Duration::from_secs(2);

/// Checks the groups. `server` is the cell's own server.
pub(super) fn check(
    entries: &[Located<GroupEntry>],
    server: &Server,
    findings: &mut MappingFindings,
) -> Vec<SecurityGroup> {
    if let Some(first) = entries.get(MAX_GROUPS) {
        let message = format!("{} groups; at most {MAX_GROUPS} are read", entries.len());
        findings.error(Code::TooLarge, first.place, message);
        return Vec::new();
    }
    let mut ids: BTreeMap<String, TextSpan> = BTreeMap::new();
    let mut taken: BTreeMap<Option<u16>, TextSpan> = BTreeMap::new();
    let mut groups = Vec::new();
    for at in entries {
        let Some(entry) = &at.value else { continue };
        let Some(group) = group(entry, at.place, server, findings) else {
            continue;
        };
        if let Some(first) = ids.insert(group.id.clone(), at.place) {
            let line = findings.line(first, at.place);
            let message = format!("the group `{}` is listed twice", short(&group.id));
            findings
                .error(Code::SecurityGroup, at.place, message)
                .label(format!("first at {line}"))
                .help("use one entry with all its namespaces");
            continue;
        }
        claim(entry, at.place, &mut taken, findings);
        groups.push(group);
    }
    groups
}

/// Notes namespaces that two groups claim.
fn claim(
    entry: &GroupEntry,
    owner: TextSpan,
    taken: &mut BTreeMap<Option<u16>, TextSpan>,
    findings: &mut MappingFindings,
) {
    let listed = entry.namespaces.as_ref().and_then(|at| at.value.as_deref());
    let listed: Vec<(Option<u16>, TextSpan)> = match listed {
        Some(list) => {
            let sound = list.iter().filter(|at| at.value.is_some());
            sound.map(|at| (at.value, at.place)).collect()
        }
        None => vec![(None, owner)],
    };
    for (namespace, place) in listed {
        let Some(first) = taken.insert(namespace, place) else {
            continue;
        };
        let line = findings.line(first, place);
        let message = match namespace {
            Some(namespace) => format!("namespace {namespace} is in two groups"),
            None => "two groups have no `namespaces`".to_owned(),
        };
        findings
            .error(Code::SecurityGroup, place, message)
            .label(format!("first at {line}"));
    }
}

fn group(
    entry: &GroupEntry,
    owner: TextSpan,
    server: &Server,
    findings: &mut MappingFindings,
) -> Option<SecurityGroup> {
    let (id, place) = required(&entry.group, "group", "the entry", owner, findings)?;
    if id.is_empty() || id.chars().count() > 128 || id.chars().any(char::is_control) {
        let message = "a SecurityGroupId has 1 to 128 characters without control characters";
        findings.error(Code::SecurityGroup, place, message);
        return None;
    }
    let mode = match given(&entry.mode) {
        Some((GroupModeEntry::None, _)) => GroupMode::None,
        Some((GroupModeEntry::Sign, _)) => GroupMode::Sign,
        Some((GroupModeEntry::SignAndEncrypt, _)) | None => GroupMode::SignAndEncrypt,
    };
    let policy = match given(&entry.policy) {
        Some((GroupPolicyEntry::Aes128, _)) => GroupPolicy::Aes128,
        Some((GroupPolicyEntry::Aes256, _)) | None => GroupPolicy::Aes256,
    };
    let replay = match given(&entry.replay) {
        Some((ReplayEntry::Publisher, _)) => Replay::Publisher,
        Some((ReplayEntry::Uncounted, _)) => Replay::Uncounted,
        Some((ReplayEntry::Sender, _)) | None => Replay::Sender,
    };
    let namespaces = entry.namespaces.as_ref().and_then(|at| at.value.as_deref());
    let mut listed = Vec::new();
    for at in namespaces.unwrap_or_default() {
        match at.value {
            Some(0) => {
                let message = "namespace 0 belongs to OPC UA and is not a WriterGroupId";
                findings.error(Code::SecurityGroup, at.place, message);
            }
            Some(namespace) => listed.push(namespace),
            None => {}
        }
    }
    if let Some(at) = &entry.namespaces
        && at.value.as_ref().is_some_and(Vec::is_empty)
    {
        let message = "a group with an empty list of namespaces has no effect";
        findings
            .error(Code::SecurityGroup, at.place, message)
            .help("without this key the group has all namespaces that no other group lists");
    }
    let keys = keys(entry, (mode, owner), server, findings);
    Some(SecurityGroup {
        id: id.clone(),
        mode,
        policy,
        keys,
        namespaces: listed,
        replay,
    })
}

fn keys(
    entry: &GroupEntry,
    (mode, owner): (GroupMode, TextSpan),
    server: &Server,
    findings: &mut MappingFindings,
) -> Option<KeySource> {
    let Some(at) = &entry.keys else {
        if mode != GroupMode::None {
            findings
                .error(Code::GroupKeys, owner, "a secured group without `keys`")
                .help(
                    "add keys: {file: cell.keys}, and make the file with `ua-space keys cell.keys`",
                );
        }
        return None;
    };
    let keys = at.value.as_ref()?;
    if mode == GroupMode::None {
        findings
            .error(
                Code::GroupKeys,
                at.place,
                "the group has keys, but is not secured",
            )
            .help("remove `mode: none`, or the keys");
        return None;
    }
    source(keys, at.place, server, findings)
}

fn source(
    keys: &KeysEntry,
    place: TextSpan,
    server: &Server,
    findings: &mut MappingFindings,
) -> Option<KeySource> {
    let count = usize::from(keys.file.is_some())
        + usize::from(keys.credential.is_some())
        + usize::from(keys.sks.is_some());
    if count != 1 {
        findings
            .error(
                Code::GroupKeys,
                place,
                "`keys` needs exactly one of `file`, `credential` and `sks`",
            )
            .help("keys cannot be part of the mapping, because every reader of the mapping would have them");
        return None;
    }
    if let Some((file, place)) = given(&keys.file) {
        if file.is_empty() || is_key(file) {
            findings
                .error(Code::GroupKeys, place, "this is not a file name")
                .help("put the keys into a separate file that only its owner can read (chmod 600)");
            return None;
        }
        return Some(KeySource::File(PathBuf::from(file)));
    }
    if let Some((name, place)) = given(&keys.credential) {
        if name.is_empty() || name.contains('/') || name.starts_with('.') || is_key(name) {
            findings
                .error(
                    Code::GroupKeys,
                    place,
                    "this is not the name of a credential",
                )
                .help("use the ID in LoadCredential=ID:PATH of the unit");
            return None;
        }
        return Some(KeySource::Credential(name.clone()));
    }
    given(&keys.sks).and_then(|(sks, place)| service(sks, place, server, findings))
}

fn service(
    entry: &SksEntry,
    place: TextSpan,
    server: &Server,
    findings: &mut MappingFindings,
) -> Option<KeySource> {
    let lifetime = duration(&entry.key_lifetime, findings);
    if let Some(short) = lifetime.filter(|time| *time < LEAST_LIFETIME)
        && let Some((_, at)) = given(&entry.key_lifetime)
    {
        let message = format!("a key is used for {LEAST_LIFETIME:?} at least, not {short:?}");
        findings
            .error(Code::KeyService, at, message)
            .help("programs request keys at half of the lifetime, and every program needs the next key in time");
    }
    let members = entry.members.as_ref().and_then(|at| at.value.as_deref());
    let members: Vec<String> = members
        .unwrap_or_default()
        .iter()
        .filter_map(|at| at.value.clone())
        .collect();
    let own = || {
        KeySource::Own(ServedKeys {
            endpoint: server.first_endpoint().clone(),
            lifetime: lifetime.unwrap_or(LIFETIME),
            members: members.clone(),
        })
    };
    let Some((text, at)) = given(&entry.endpoint) else {
        return entry.endpoint.is_none().then(own);
    };
    let Some(endpoint) = Endpoint::parse(text) else {
        let message = format!("`{}` is not an endpoint", short(text));
        findings
            .error(Code::Endpoint, at, message)
            .help("use an endpoint such as opc.tcp://sks.local:4840");
        return None;
    };
    if endpoint == *server.first_endpoint() {
        return Some(own());
    }
    if server.redundant_endpoints.contains(&endpoint) {
        let message = "only the first server of a redundant set creates keys";
        findings
            .error(Code::KeyService, at, message)
            .help("without an endpoint, the keys are those of the first server: sks: {}");
        return None;
    }
    if entry.key_lifetime.is_some() || entry.members.is_some() {
        findings
            .error(
                Code::KeyService,
                place,
                "`key_lifetime` and `members` belong to the other service",
            )
            .help("use them only with the server of the cell: sks: {}");
        return None;
    }
    Some(KeySource::Sks(endpoint))
}

/// Reports the parts of a partly secured cell that are not secured.
pub(super) fn left_open(mapping: &Mapping, document: &Document, findings: &mut MappingFindings) {
    own_service(mapping, document, findings);
    let secured = |group: &SecurityGroup| group.mode != GroupMode::None;
    let Some(at) = &document.security else { return };
    if !mapping.security().iter().any(secured) {
        return;
    }
    for namespace in mapping.namespaces().keys() {
        if mapping.group_of(*namespace).is_none() {
            let message = format!(
                "namespace {namespace} is not in a group: every host of the network can read and write its values"
            );
            findings
                .warning(Code::HalfSecured, at.place, message)
                .help("a group without `namespaces` has all namespaces that no other group lists; confirm \
                       an unsecured namespace with `mode: none`");
        }
    }
    for call in mapping.calls() {
        let (_, namespace, _) = call.topic.triple();
        let open = !mapping.group_of(namespace).is_some_and(secured);
        if open {
            let call_place = place_of(document, call).unwrap_or(at.place);
            let message = format!(
                "the call {} is not in a secured group, but other namespaces are: every program of this \
                 host can request the call{}",
                short(&call.name),
                if call.open {
                    ", and every host of the network"
                } else {
                    ""
                }
            );
            findings
                .warning(Code::OpenCall, call_place, message)
                .help("add its namespace to a secured group");
        }
    }
}

/// Reports a configuration that keeps programs from getting the keys of the cell's own server.
fn own_service(mapping: &Mapping, document: &Document, findings: &mut MappingFindings) {
    let own = |group: &&SecurityGroup| matches!(group.keys, Some(KeySource::Own(_)));
    let (Some(at), Some(group)) = (&document.security, mapping.security().iter().find(own)) else {
        return;
    };
    let server = mapping.server();
    for entry in at.value.iter().flatten() {
        let name = entry.value.as_ref().and_then(|entry| given(&entry.group));
        let mut groups = mapping.security().iter();
        if let Some((name, _)) = name
            && let Some(group) = groups.find(|group| group.id == *name)
        {
            without_members(entry.place, group, server, findings);
        }
    }
    if server.policies(server.is_local()) == [ServerSecurityPolicy::None] {
        let message = format!(
            "the server provides the keys of the group `{}` over encrypted sessions only, but offers no encryption",
            short(&group.id)
        );
        findings
            .error(Code::KeyService, at.place, message)
            .help("set server: {security: [Basic256Sha256]}");
    }
    if !server.redundant.is_empty() && server.redundant_endpoints.is_empty() {
        let message = format!(
            "each server of a redundant set would create its own keys of the group `{}`",
            short(&group.id)
        );
        findings.error(Code::KeyService, at.place, message).help(
            "set server: {redundant_endpoints: [\"opc.tcp://HOST-1:4840\", \"opc.tcp://HOST-2:4840\"]}: the first \
             server creates the keys, and the others request them there",
        );
    }
    let (endpoint, key) = match server.redundant_endpoints.first() {
        Some(first) => (first, "server.redundant_endpoints"),
        None => (&server.endpoint, "server.endpoint"),
    };
    if matches!(endpoint.host.as_str(), "0.0.0.0" | "::") {
        let message = format!(
            "programs request the keys of the group `{}` at `{key}`, but other hosts cannot reach {endpoint}",
            short(&group.id)
        );
        findings.warning(Code::KeyService, at.place, message).help(
            "set server: {endpoint: \"opc.tcp://NAME:4840\"} with the name or address of its host; \
                   ua-server --endpoint sets the listening address",
        );
    }
}

/// Reports a group without `members`: only programs of the cell get its keys.
fn without_members(
    place: TextSpan,
    group: &SecurityGroup,
    server: &Server,
    findings: &mut MappingFindings,
) {
    let Some(KeySource::Own(served)) = &group.keys else {
        return;
    };
    if !served.members.is_empty() {
        return;
    }
    let message = format!(
        "only the server and the bridges of the cell get the keys of the group `{}`, because it has no `members`",
        short(&group.id)
    );
    let help = format!(
        "for other programs, list the ApplicationUris of their certificates: sks: {{members: [\"{}\", \
         \"urn:HOST:ua-bridge:bridge-ros1\", \"urn:HOST:ua-bridge:bridge-ros2\"]}}",
        short(&server.application_uri)
    );
    findings
        .warning(Code::KeyService, place, message)
        .help(help);
}

/// Returns the position of a call.
fn place_of(document: &Document, call: &Call) -> Option<TextSpan> {
    let entries = document.calls.as_ref()?.value.as_deref()?;
    let mut named = entries
        .iter()
        .filter_map(|at| given(&at.value.as_ref()?.name));
    named
        .find(|(name, _)| **name == call.name)
        .map(|(_, place)| place)
}
