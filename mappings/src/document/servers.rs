//! `servers` of the document, and the keys of variables that refer to them.

use super::patterns::{DURATION, EXPANDED_NODE_ID};
use crate::read::{Located, choice, document};

document! {
    /// An existing OPC UA server, such as the server of a PLC. The server of the cell is its
    /// client.
    struct RemoteServerEntry {
        /// Its name in the mapping: letters, digits, `_`, `-` and `.`.
        #[schemars(required, regex(pattern = r"^[A-Za-z0-9_.-]{1,64}$"))]
        name: String,
        /// Its endpoint, such as opc.tcp://192.168.0.10:4840.
        #[schemars(required, regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// Security policy of the session. Default: the best policy of the server, which may be
        /// None; with every other policy, messages are signed and encrypted.
        security: SecurityEntry,
        /// User name. Default: anonymous.
        #[schemars(length(min = 1, max = 256))]
        user: String,
        /// Password of the user, such as ${PLC_PASSWORD:-}: set in the environment of ua-server,
        /// not in the file; other programs do not need it.
        password: String,
        /// The namespace of `namespaces` for its skills in the space, used for nothing else:
        /// ua-server shows the skills there and runs them like the skills of a component. Default:
        /// its skills are not used.
        #[schemars(range(min = 1, max = 65_535))]
        skills: u16,
        /// Whether other hosts can also run these skills if the group is not secured; default
        /// false.
        open: bool,
    }

    /// Servers with skills that discovery finds. Each has a namespace of its own in the space.
    struct FindSkillsEntry {
        /// The ApplicationUris of the servers; `*` at the end matches any characters, as in
        /// urn:vendor:*. 1 to 64.
        #[schemars(required, length(min = 1, max = 64))]
        uris: Vec<Located<String>>,
        /// The first of the namespaces that are reserved for their skills. A namespace with an
        /// ApplicationUri in `namespaces` belongs to the server with this URI; the others are
        /// assigned when servers are found.
        #[schemars(required, range(min = 2, max = 65_535))]
        first: u16,
        /// Maximum number of servers, 1 to 64; default 8. Further servers are logged.
        #[schemars(range(min = 1, max = 64))]
        most: u16,
        /// Security policy of the sessions, which are anonymous. Default: the best policy of each
        /// server, which may be None.
        security: SecurityEntry,
        /// Whether other hosts can also run these skills if the group is not secured; default
        /// false.
        open: bool,
        /// Networks behind routers, such as 10.77.0.0/16, with servers that are also accepted.
        /// Default: only servers with addresses in the subnets of the interface, because any host
        /// can announce any address.
        networks: Vec<Located<String>>,
    }

    /// The node of another server that the value comes from.
    struct FromEntry {
        /// The server, by its `name` among `servers`.
        #[schemars(required)]
        server: String,
        /// The variable there, such as nsu=urn:plc;s=Line.Speed: its namespace by the URI, which
        /// stays valid if the indexes of the server change, or by the index there, such as
        /// ns=3;i=7.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        node: String,
        /// Sampling interval of the server; default 100ms. Servers may sample less often.
        #[schemars(regex(pattern = DURATION))]
        sampling: String,
        /// Number of changes that the server queues, 1 to 1000; default 10. If the queue is full,
        /// the oldest are dropped.
        #[schemars(range(min = 1, max = 1000))]
        queue: u16,
        /// Numbers are reported only if they differ by more than this.
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

choice! {
    enum SecurityEntry {
        /// Neither signed nor encrypted.
        None = "None",
        /// Signed, or signed and encrypted.
        Basic256Sha256 = "Basic256Sha256",
        /// Signed, or signed and encrypted with AES of 128 bits.
        Aes128Sha256RsaOaep = "Aes128_Sha256_RsaOaep",
        /// Signed with RSA-PSS, or signed so and encrypted.
        Aes256Sha256RsaPss = "Aes256_Sha256_RsaPss",
    }
}
