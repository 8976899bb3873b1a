//! Network namespaces for the system tests, and the permission to create them.

use std::{ffi::OsStr, process::Command};

use crate::shell::succeeds;

/// The way in which a program gets the permission to create network namespaces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NamespacePermission {
    /// The user has the permission.
    Allowed,
    /// The program runs in a user namespace with the user as root.
    AsRootOfTheirOwn,
    /// This machine does not permit it.
    Refused,
}

impl NamespacePermission {
    /// Tests the permissions of this user on this machine.
    pub(crate) fn try_out() -> Self {
        if succeeds("unshare", &["--net", "true"]) {
            Self::Allowed
        } else if succeeds("unshare", &["--map-root-user", "--net", "true"]) {
            Self::AsRootOfTheirOwn
        } else {
            Self::Refused
        }
    }

    /// Returns a command that starts `program` with the permission to create namespaces, if this is
    /// possible.
    pub(crate) fn command(self, program: impl AsRef<OsStr>) -> Command {
        match self {
            Self::Allowed | Self::Refused => Command::new(program),
            Self::AsRootOfTheirOwn => {
                let mut command = Command::new("unshare");
                command.args(["--map-root-user", "--"]).arg(program);
                command
            }
        }
    }

    /// Returns a command that starts `program` in a network of its own, which has a loopback
    /// interface with multicast only.
    pub(crate) fn alone(self, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new("unshare");
        if self == Self::AsRootOfTheirOwn {
            command.arg("--map-root-user");
        }
        command
            .args(["--net", "--", "sh", "-c", LOOPBACK])
            .arg(program);
        command
    }
}

const LOOPBACK: &str = "ip link set lo up && ip link set lo multicast on && ip route add 224.0.0.0/4 dev lo \
    && exec \"$0\" \"$@\"";

/// The reason why tests that need a network of their own cannot run.
pub(crate) const REFUSED: &str = "this user may make no network namespace, not even in a user namespace of their own \
    (unshare --map-root-user --net); run as root, or let users have them: sysctl kernel.unprivileged_userns_clone=1";
