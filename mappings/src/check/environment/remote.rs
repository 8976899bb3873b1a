//! Checks that the nodes of other servers exist that variables come from or are written to.

use crate::code::Code;
use crate::document::VariableEntry;
use crate::environment::{Environment, LiveRemote};
use crate::findings::MappingFindings;
use crate::mapping::Variable;
use crate::read::{given, short};
use crate::tree::TextSpan;

use super::types;

pub(super) fn check(
    entry: &VariableEntry,
    variable: &Variable,
    environment: &Environment,
    findings: &mut MappingFindings,
) {
    if let Some(from) = &variable.from
        && let Some(live) = environment.remote(&from.server, &from.node)
    {
        let place = given(&entry.from).and_then(|(from, _)| given(&from.node));
        let place = place.map(|(_, place)| place);
        let about = About {
            server: &from.server,
            node: from.node.to_string(),
            written: false,
        };
        node(entry, variable, (&about, live), place, findings);
    }
    if let Some(to) = &variable.to
        && let Some(live) = environment.remote(&to.server, &to.node)
    {
        let place = given(&entry.to).and_then(|(to, _)| given(&to.node));
        let place = place.map(|(_, place)| place);
        let about = About {
            server: &to.server,
            node: to.node.to_string(),
            written: true,
        };
        node(entry, variable, (&about, live), place, findings);
    }
}

/// A node of a server, and whether it is written.
struct About<'a> {
    server: &'a str,
    node: String,
    written: bool,
}

fn node(
    entry: &VariableEntry,
    variable: &Variable,
    (about, live): (&About<'_>, LiveRemote),
    place: Option<TextSpan>,
    findings: &mut MappingFindings,
) {
    let Some(place) = place else {
        return;
    };
    let (server, text) = (about.server, short(&about.node));
    let LiveRemote::Variable {
        value,
        readable,
        writable,
    } = live
    else {
        let message = format!("the server `{server}` has no variable `{text}`");
        findings.warning(Code::RemoteNodeAway, place, message).help(
            "this value is bad until the server has the variable; other values are not affected",
        );
        return;
    };
    let (able, word) = if about.written {
        (writable, "written")
    } else {
        (readable, "read")
    };
    if !able {
        let message = format!("`{text}` of the server `{server}` cannot be {word}");
        findings
            .warning(Code::RemoteNodeAway, place, message)
            .help("by this user, according to its UserAccessLevel");
    }
    if let (Some(live), Some(declared)) = (value, variable.value_type)
        && live != declared
    {
        let message = format!(
            "`{text}` is {} here and {} in the server `{server}`",
            types::print(declared),
            types::print(live)
        );
        let place = given(&entry.r#type).map_or(place, |(_, place)| place);
        findings
            .warning(Code::LiveNodeDiffers, place, message)
            .help(format!("type: {}", types::print(live)));
    }
}
