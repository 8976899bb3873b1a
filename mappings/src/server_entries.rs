//! `servers` of the document, and the keys of variables that refer to them.

use crate::document::{DURATION, EXPANDED_NODE_ID, SecurityEntry};
use crate::read::{At, document};

document! {
    /// An OPC UA server that exists already, such as that of a PLC. The cell's own server is its client.
    struct RemoteServerEntry {
        /// What the mapping calls it: letters, digits, `_`, `-` and `.`.
        #[schemars(required, regex(pattern = r"^[A-Za-z0-9_.-]{1,64}$"))]
        name: String,
        /// Where it is, as opc.tcp://192.168.0.10:4840.
        #[schemars(required, regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// Security policy of the session. Left out: the best that the server offers, which may be None; every other one is signed
        /// and encrypted, or there is no session.
        security: SecurityEntry,
        /// User name. Left out: anonymous.
        #[schemars(length(min = 1, max = 256))]
        user: String,
        /// The user's password, as ${PLC_PASSWORD:-}: the environment of ua-server has it, and not the file; other programs need none.
        password: String,
        /// The namespace of `namespaces`, which nothing else is in, that its skills have in the space: ua-server shows them there and has
        /// them run, as a component does its own. Left out: they are not looked for.
        #[schemars(range(min = 1, max = 65_535))]
        skills: u16,
        /// Whether these skills are run for other hosts too where the group is not secured; default false.
        open: bool,
    }

    /// Servers with skills that discovery finds. Each has a namespace of its own in the space.
    struct FindSkillsEntry {
        /// Which, by their ApplicationUris; with `*` at its end one stands for all that begin so, as urn:vendor:*. 1 to 64.
        #[schemars(required, length(min = 1, max = 64))]
        uris: Vec<At<String>>,
        /// The first namespace for them. Those from here on are theirs, and nothing else is in them. One that `namespaces` gives an
        /// ApplicationUri is kept for that server; the others are given out as servers are found.
        #[schemars(required, range(min = 2, max = 65_535))]
        first: u16,
        /// How many servers have a place, 1 to 64; default 8. Those that are found beyond them are told in the log.
        #[schemars(range(min = 1, max = 64))]
        most: u16,
        /// Security policy of the sessions, which are those of an anonymous user. Left out: the best that each server offers, which may
        /// be None.
        security: SecurityEntry,
        /// Whether these skills are run for other hosts too where the group is not secured; default false.
        open: bool,
        /// Networks behind routers, as 10.77.0.0/16, whose servers are accepted too. Left out: only servers with addresses in the
        /// subnets of the interface, since anyone on the network can announce any address.
        networks: Vec<At<String>>,
    }

    /// The node of another server that the value comes from.
    struct FromEntry {
        /// The server, by its `name` among `servers`.
        #[schemars(required)]
        server: String,
        /// The variable there, as nsu=urn:plc;s=Line.Speed: its namespace by the URI, which holds when the server numbers its
        /// namespaces anew, or by the index there, as ns=3;i=7.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        node: String,
        /// How often the server is to look whether it has changed; default 100ms. Servers may do so less often.
        #[schemars(regex(pattern = DURATION))]
        sampling: String,
        /// How many changes the server keeps until it tells them, 1 to 1000; default 10. Of more the oldest go.
        #[schemars(range(min = 1, max = 1000))]
        queue: u16,
        /// Numbers have to differ by more than this to be told.
        deadband: f64,
    }

    /// The node of another server that values are written to.
    struct ToEntry {
        /// The server, by its `name` among `servers`.
        #[schemars(required)]
        server: String,
        /// The variable there, as in `from`.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        node: String,
    }
}
