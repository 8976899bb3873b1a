//! `servers`, and the variables that come from them or are written to them.

use std::collections::HashMap;
use std::num::NonZeroU16;

use super::nodes::CheckedNamespaces;
use super::quantity::duration;
use super::server::{is_own, policy, remote_endpoint};
use super::{Declared, required};
use crate::call::Call;
use crate::code::Code;
use crate::document::{FromEntry, RemoteServerEntry, ToEntry};
use crate::endpoint::Endpoint;
use crate::findings::MappingFindings;
use crate::mapping::Variable;
use crate::node_id::ExpandedNodeIdText;
use crate::read::{Located, OptionalKey, given, short};
use crate::remote::{
    Access, NodeSource, NodeTarget, Password, RemoteServer, ServerSecurityPolicy, SkillsPlace, User,
};
use crate::server::Server;

use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// Maximum number of entries of `servers`.
const MAX_SERVERS: usize = 256;

pub(super) type Servers = Declared<Vec<RemoteServer>>;

/// Checks the servers; `own` is the cell's own server.
pub(super) fn check(
    entries: Option<&Located<Vec<Located<RemoteServerEntry>>>>,
    (own, namespaces): (&Server, &CheckedNamespaces),
    findings: &mut MappingFindings,
) -> Servers {
    let mut servers = Servers {
        known: Vec::new(),
        partial: false,
    };
    let Some(entries) = entries else {
        return servers;
    };
    let Some(entries) = &entries.value else {
        servers.partial = true;
        return servers;
    };
    if let Some(first) = entries.get(MAX_SERVERS) {
        let message = format!("{} servers; at most {MAX_SERVERS} are read", entries.len());
        findings.error(Code::TooLarge, first.place, message);
        servers.partial = true;
        return servers;
    }
    let mut names: HashMap<String, TextSpan> = HashMap::new();
    let mut numbers: HashMap<u16, TextSpan> = HashMap::new();
    for at in entries {
        let entry = at.value.as_ref();
        let known = (own, namespaces, &mut numbers);
        let server = entry.and_then(|entry| server(entry, at.place, known, findings));
        let Some((server, place)) = server else {
            servers.partial = true;
            continue;
        };
        if let Some(first) = names.insert(server.name.clone(), place) {
            let line = findings.line(first, place);
            let message = format!("two servers are named `{}`", short(&server.name));
            let note = findings.error(Code::Servers, place, message);
            note.label(format!("first at {line}"));
            continue;
        }
        servers.known.push(server);
    }
    servers
}

fn server(
    entry: &RemoteServerEntry,
    place: TextSpan,
    (own, namespaces, numbers): (&Server, &CheckedNamespaces, &mut HashMap<u16, TextSpan>),
    findings: &mut MappingFindings,
) -> Option<(RemoteServer, TextSpan)> {
    const OF: &str = "the server";
    let name = required(&entry.name, "name", OF, place, findings)
        .and_then(|(name, place)| Some((name_of(name, place, findings)?, place)));
    let endpoint = required(&entry.endpoint, "endpoint", OF, place, findings)
        .and_then(|(text, place)| other_endpoint((text, place), own, findings));
    let security = given(&entry.security).map(|(entry, place)| (policy(*entry), place));
    let skills = skills(entry, namespaces, numbers, findings);
    let user = user(entry, findings)?;
    if let (Some((ServerSecurityPolicy::None, place)), Some(_)) = (security, &user) {
        let message = "the password of a user is sent in a session without security";
        findings
            .warning(Code::OpenUser, place, message)
            .help("security: Basic256Sha256");
    }
    let (name, place) = name?;
    let access = Access {
        endpoint: endpoint?,
        security: security.map(|(security, _)| security),
        user,
    };
    let server = RemoteServer {
        name,
        access,
        skills: skills?,
    };
    Some((server, place))
}

/// Returns the place of the server's skills in the space. `None` for a faulty entry, which is
/// noted.
#[expect(clippy::option_option, reason = "faulty, left out or present")]
fn skills(
    entry: &RemoteServerEntry,
    namespaces: &CheckedNamespaces,
    numbers: &mut HashMap<u16, TextSpan>,
    findings: &mut MappingFindings,
) -> Option<Option<SkillsPlace>> {
    let open = match (&entry.open, given(&entry.open)) {
        (None, _) => false,
        (Some(_), given) => *given?.0,
    };
    let Some(at) = &entry.skills else {
        if let Some(open) = &entry.open {
            let message =
                "`open` requires `skills`: it controls which hosts may run skills of the server";
            findings.error(Code::Servers, open.place, message);
            return None;
        }
        return Some(None);
    };
    let (namespace, place) = (*at.value.as_ref()?, at.place);
    if !namespaces.known.contains_key(&namespace) && !namespaces.partial {
        let message =
            format!("the skills are in namespace {namespace}, which `namespaces` does not list");
        findings
            .error(Code::UndeclaredNamespace, place, message)
            .help(format!(
                "add namespaces: {{{namespace}: urn:...}} with the ApplicationUri of the server"
            ));
        return None;
    }
    if let Some(first) = numbers.insert(namespace, place) {
        let line = findings.line(first, place);
        let message = format!("the skills of another server are also in namespace {namespace}");
        findings
            .error(Code::Servers, place, message)
            .label(format!("first at {line}"))
            .help("the names of skills are ua_0_<namespace>_<100 for each skill>: each server needs a namespace of its own");
        return None;
    }
    Some(Some(SkillsPlace { namespace, open }))
}

/// Notes variables and calls in the namespaces of skills, which are reserved: the skills determine
/// the identifiers there.
pub(super) fn alone(
    servers: &Servers,
    variables: &[Variable],
    calls: &[Call],
    entries: Option<&Located<Vec<Located<RemoteServerEntry>>>>,
    findings: &mut MappingFindings,
) {
    let all = variables
        .iter()
        .map(|variable| (variable.topic, &variable.name))
        .chain(calls.iter().map(|call| (call.topic, &call.name)));
    let all: Vec<_> = all.collect();
    let entries = entries.and_then(|entries| entries.value.as_deref());
    for entry in entries.unwrap_or_default() {
        let at = entry.value.as_ref().and_then(|entry| given(&entry.skills));
        let Some((namespace, place)) = at else {
            continue;
        };
        let is_in = servers
            .known
            .iter()
            .any(|server| server.skills.is_some_and(|of| of.namespace == *namespace));
        let other = all
            .iter()
            .find(|(topic, _)| topic.space == SpaceId::UA && topic.namespace.get() == *namespace);
        if let (true, Some((topic, name))) = (is_in, other) {
            let message = format!(
                "namespace {namespace} belongs to the skills of a server, but `{}` ({topic}) is in it",
                short(name)
            );
            findings
                .error(Code::Servers, place, message)
                .help("give the skills a namespace of their own");
        }
    }
}

fn name_of(name: &str, place: TextSpan, findings: &mut MappingFindings) -> Option<String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
    if !name.is_empty() && name.len() <= 64 && name.chars().all(plain) {
        return Some(name.to_owned());
    }
    let message = format!("`{}` is not the name of a server", short(name));
    let note = findings.error(Code::Servers, place, message);
    note.help("use 1 to 64 letters, digits, `_`, `-` and `.`, such as plc or press_2");
    None
}

/// Reads an endpoint that differs from the endpoints of the cell's own server.
fn other_endpoint(
    (text, place): (&str, TextSpan),
    own: &Server,
    findings: &mut MappingFindings,
) -> Option<Endpoint> {
    let endpoint = remote_endpoint(text, place, findings)?;
    if is_own(&endpoint, own) {
        findings
            .error(Code::Servers, place, "the endpoint belongs to the server of the cell")
            .help("give another server here, or change `server.endpoint`: the server of the cell already \
                   shows the cell");
        return None;
    }
    Some(endpoint)
}

/// Returns `None` for a faulty entry, which is noted.
#[expect(clippy::option_option, reason = "faulty, left out or present")]
fn user(entry: &RemoteServerEntry, findings: &mut MappingFindings) -> Option<Option<User>> {
    match (&entry.user, &entry.password) {
        (None, None) => Some(None),
        (Some(user), Some(password)) => {
            let (name, text) = (user.value.as_ref()?, password.value.as_ref()?);
            if name.is_empty() || name.len() > 256 {
                findings
                    .error(Code::Servers, user.place, "the user name is not valid")
                    .help("use 1 to 256 bytes; without `user` the session is anonymous");
                return None;
            }
            // The password is empty here if only the environment of another program has it.
            if !text.is_empty() && !findings.is_hidden(text) {
                findings
                    .warning(Code::Secret, password.place, "this is a password in plain text")
                    .help("write ${NAME:-}, and set the variable for ua-server only; other programs do not need it");
            }
            Some(Some(User {
                name: name.clone(),
                password: Password::new(text.clone()),
            }))
        }
        (Some(one), None) => {
            let message = "the user has no `password`";
            findings
                .error(Code::Servers, one.place, message)
                .help("add password: ${PLC_PASSWORD:-}");
            None
        }
        (None, Some(one)) => {
            let message = "the password has no `user`";
            findings.error(Code::Servers, one.place, message);
            None
        }
    }
}

/// Returns the server of that name. `None` if no server has it, which is noted.
pub(super) fn named<'s>(
    name: &str,
    place: TextSpan,
    servers: &'s Servers,
    findings: &mut MappingFindings,
) -> Option<&'s RemoteServer> {
    let found = servers.known.iter().find(|server| server.name == name);
    // A faulty entry may have had the missing name.
    if found.is_none() && !servers.partial {
        let message = format!("no server is named `{}`", short(name));
        let note = findings.error(Code::RemoteNode, place, message);
        let names = servers.known.iter().map(|server| server.name.as_str());
        note.help(match documents::nearest(name, names) {
            Some(near) => format!("did you mean `{near}`?"),
            None => format!(
                "add it: `servers: [{{name: {}, endpoint: opc.tcp://192.168.0.10:4840}}]`",
                short(name)
            ),
        });
    }
    found
}

/// Reads a node of another server. Returns `None` for a faulty node, which is noted.
pub(super) fn node(
    field: &OptionalKey<String>,
    (key, of): (&str, &str),
    owner: TextSpan,
    findings: &mut MappingFindings,
) -> Option<ExpandedNodeIdText> {
    let (text, place) = required(field, key, of, owner, findings)?;
    match text.parse() {
        Ok(node) => Some(node),
        Err(error) => {
            let message = format!("`{}` is not a node id", short(text));
            findings.error(Code::NodeId, place, message).help(format!(
                "{error}; for another server, prefer the namespace URI, such as nsu=urn:plc;s=Line.Reset"
            ));
            None
        }
    }
}

/// Reads `from` of a variable. Returns `None` for a faulty entry, which is noted.
pub(super) fn source(
    at: &Located<FromEntry>,
    servers: &Servers,
    findings: &mut MappingFindings,
) -> Option<NodeSource> {
    let entry = at.value.as_ref()?;
    let server = required(&entry.server, "server", "`from`", at.place, findings);
    let server = server.and_then(|(name, place)| named(name, place, servers, findings));
    let node = node(&entry.node, ("node", "`from`"), at.place, findings);
    let sampling = match &entry.sampling {
        Some(_) => duration(&entry.sampling, findings),
        None => Some(NodeSource::SAMPLING),
    };
    let queue = match given(&entry.queue) {
        None if entry.queue.is_some() => None,
        None => Some(NodeSource::QUEUE),
        Some((number, place)) => {
            let sound = NonZeroU16::new(*number).filter(|number| number.get() <= 1000);
            if sound.is_none() {
                findings
                    .error(
                        Code::WrongValue,
                        place,
                        format!("a queue of {number} values"),
                    )
                    .help("1 to 1000");
            }
            sound
        }
    };
    let deadband = match given(&entry.deadband) {
        None if entry.deadband.is_some() => None,
        None => Some(0.0),
        Some((width, place)) => {
            let sound = Some(*width).filter(|width| *width > 0.0 && width.is_finite());
            if sound.is_none() {
                findings
                    .error(Code::Publish, place, format!("a deadband of {width}"))
                    .help("give a number above 0, in the unit of the value");
            }
            sound
        }
    };
    let name = server?.name.clone();
    Some(NodeSource::new(name, node?, (sampling?, queue?, deadband?)))
}

/// Reads `to` of a variable. Returns `None` for a faulty entry, which is noted.
pub(super) fn target(
    at: &Located<ToEntry>,
    servers: &Servers,
    findings: &mut MappingFindings,
) -> Option<NodeTarget> {
    let entry = at.value.as_ref()?;
    let server = required(&entry.server, "server", "`to`", at.place, findings);
    let server = server.and_then(|(name, place)| named(name, place, servers, findings));
    let node = node(&entry.node, ("node", "`to`"), at.place, findings);
    Some(NodeTarget {
        server: server?.name.clone(),
        node: node?,
    })
}
