//! Permissions on the nodes of the server.

use crate::code::Code;
use crate::document::{
    AnonymousEntry, CallPermissionsEntry, PermissionsEntry, RoleEntry, RoleList, SecurityEntry,
    ServerEntry,
};
use crate::findings::MappingFindings;
use crate::permission::{Anonymous, Permissions, Role};
use crate::read::{OptionalKey, given};
use crate::server::Server;
use crate::topic::SpaceId;

/// Returns `None` for a faulty entry, which is noted.
pub(super) fn of_variable(
    field: &OptionalKey<PermissionsEntry>,
    origin: Option<SpaceId>,
    findings: &mut MappingFindings,
) -> Option<Permissions> {
    let Some(at) = field else {
        return Some(Permissions::default());
    };
    let entry = at.value.as_ref()?;
    if let Some(write) = &entry.write
        && origin.is_some_and(|origin| origin != SpaceId::UA)
    {
        let message = "clients cannot write this variable: its value is produced in another space";
        findings
            .warning(Code::Permissions, write.place, message)
            .help("`write` requires `origin: 0`");
    }
    let read = roles(&entry.read, findings)?;
    let write = roles(&entry.write, findings)?;
    Some(Permissions { read, write })
}

/// Returns the roles that may call; the outer `None` marks a faulty entry.
pub(super) fn of_call(
    field: &OptionalKey<CallPermissionsEntry>,
    findings: &mut MappingFindings,
) -> Option<Option<Vec<Role>>> {
    let Some(at) = field else { return Some(None) };
    roles(&at.value.as_ref()?.call, findings)
}

/// Returns the roles; the outer `None` marks a faulty entry, the inner an entry that is left out.
fn roles(
    field: &OptionalKey<RoleList>,
    findings: &mut MappingFindings,
) -> Option<Option<Vec<Role>>> {
    let Some(at) = field else { return Some(None) };
    let RoleList(entries) = at.value.as_ref()?;
    if entries.is_empty() {
        findings
            .error(
                Code::Permissions,
                at.place,
                "without a role no user has the permission",
            )
            .help("give observer, operator, engineer or security_admin, a single role or a list");
        return None;
    }
    let mut roles = Vec::new();
    for entry in entries {
        let role = role(*entry.value.as_ref()?);
        if roles.contains(&role) {
            let message = format!("the role {} is listed twice", role.name());
            findings
                .warning(Code::Permissions, entry.place, message)
                .help("remove it here");
        } else {
            roles.push(role);
        }
    }
    Some(Some(roles))
}

const fn role(entry: RoleEntry) -> Role {
    match entry {
        RoleEntry::Observer => Role::Observer,
        RoleEntry::Operator => Role::Operator,
        RoleEntry::Engineer => Role::Engineer,
        RoleEntry::SecurityAdmin => Role::SecurityAdmin,
    }
}

/// Returns the permission of anonymous users.
pub(super) fn anonymous(entry: &ServerEntry) -> Anonymous {
    match given(&entry.anonymous) {
        None => Anonymous::Usual,
        Some((AnonymousEntry::Off, _)) => Anonymous::Refused,
        Some((AnonymousEntry::Observer, _)) => Anonymous::Has(Role::Observer),
        Some((AnonymousEntry::Operator, _)) => Anonymous::Has(Role::Operator),
        Some((AnonymousEntry::Engineer, _)) => Anonymous::Has(Role::Engineer),
    }
}

/// Reports permissions that are open to other hosts that reach the server.
pub(super) fn left_open(entry: &ServerEntry, server: &Server, findings: &mut MappingFindings) {
    if server.is_local() {
        return;
    }
    if let Some((entries, _)) = given(&entry.security)
        && let Some(none) = entries
            .iter()
            .find(|at| at.value == Some(SecurityEntry::None))
    {
        let message = "other hosts can reach the server, and with None messages can be read and changed on the network";
        findings
            .warning(Code::OpenServer, none.place, message)
            .help("remove None; without `security`, a server that other hosts can reach does not offer it");
    }
    if let Some((AnonymousEntry::Operator | AnonymousEntry::Engineer, place)) =
        given(&entry.anonymous)
    {
        let message = "other hosts can reach the server, and anonymous users may write and call";
        findings
            .warning(Code::OpenServer, place, message)
            .help("add a user with this permission: `ua-server user add NAME --role operator`");
    }
}
