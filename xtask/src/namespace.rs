//! Who may make network namespaces, which the system tests live in.

use std::{ffi::OsStr, process::Command};

use crate::shell::succeeds;

/// How a program gets the right to make network namespaces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Namespaces {
    /// It has it already.
    Allowed,
    /// In a user namespace where the user is root.
    AsRootOfTheirOwn,
    /// Not on this machine.
    Refused,
}

impl Namespaces {
    /// Tries what this machine lets this user do.
    pub(crate) fn try_out() -> Self {
        if succeeds("unshare", &["--net", "true"]) {
            Self::Allowed
        } else if succeeds("unshare", &["--map-root-user", "--net", "true"]) {
            Self::AsRootOfTheirOwn
        } else {
            Self::Refused
        }
    }

    /// `program`, started so that it may make namespaces where that can be had.
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

    /// `program` in a network of its own, with nothing in it but a loopback that carries multicast.
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

/// Why the tests that need a network of their own cannot run.
pub(crate) const REFUSED: &str = "this user may make no network namespace, not even in a user namespace of their own \
    (unshare --map-root-user --net); run as root, or let users have them: sysctl kernel.unprivileged_userns_clone=1";
