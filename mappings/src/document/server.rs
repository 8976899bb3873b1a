//! The OPC UA server of the cell in the document.

use super::patterns::DURATION;
use super::servers::{FindSkillsEntry, SecurityEntry};
use crate::read::{Located, choice, document};

document! {
    /// The OPC UA server of the cell.
    struct ServerEntry {
        /// Where clients connect; default opc.tcp://127.0.0.1:4840.
        #[schemars(regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// ApplicationUri; default urn:ua-bridge:server.
        application_uri: String,
        /// ApplicationUris of two or three redundant servers, by their `--rank`, instead of
        /// `application_uri`.
        redundant: Vec<Located<String>>,
        /// Endpoints of the servers of `redundant`, in the same order. Each server has the endpoint
        /// of its rank unless `--endpoint` gives another, and lists the others in FindServers.
        redundant_endpoints: Vec<Located<String>>,
        /// Security policies that the server offers. Default: all, and `None` only if the endpoint
        /// is a loopback address.
        security: Vec<Located<SecurityEntry>>,
        /// Role of anonymous users: `off` (refused), `observer`, `operator` or `engineer`. Default:
        /// observer; operator if the endpoint is a loopback address and the server has no users.
        anonymous: AnonymousEntry,
        /// Whether other servers are refused if their trusted certificates do not include the host
        /// of the URL, as after a new DHCP lease; default false: the server connects to them and
        /// logs a warning.
        refuse_other_hosts: bool,
        /// A value of another program becomes bad (BadNoCommunication) after being uncertain for
        /// this time, unless its own `quality` gives another time. Default: it stays uncertain.
        #[schemars(regex(pattern = DURATION))]
        bad_after: String,
        /// Whether the server has alarms for the publishers of the space: lost, dropped values,
        /// another clock. Default false.
        publisher_alarms: bool,
        /// Clients to which the server connects, so that they reach it through a firewall that
        /// permits no connections to it (ReverseHello, OPC 10000-6): their listening addresses, such
        /// as opc.tcp://192.168.0.30:4841; at most 16. With hosts other than this one, the defaults
        /// of `security` and `anonymous` are those of an endpoint that other hosts reach.
        #[schemars(length(max = 16))]
        reverse_connect: Vec<Located<String>>,
        /// Limits of the history of the server.
        history: HistoryEntry,
        /// Limits for clients.
        limits: LimitsEntry,
        /// Servers with skills that discovery finds and that do not take part in the space:
        /// ua-server shows their skills in the space and runs them, like the skills of `servers`
        /// with `skills`. Default: no search.
        find_skills: FindSkillsEntry,
        /// NodeSet2 files with further nodes of the server, in any order, relative to this file; at
        /// most 64. A variable whose `node` is one of these nodes gives it values; `namespaces`
        /// lists its namespace.
        nodesets: Vec<Located<String>>,
    }

    /// Limits of the history that the server keeps in memory, and its file.
    struct HistoryEntry {
        /// Values of each variable without its own `history`, 0 to 65535; default 1000.
        values: u16,
        /// MiB of all of them together, 1 to 16384; default 64.
        #[schemars(range(min = 1, max = 16384))]
        megabytes: u16,
        /// File in which ua-server stores the history and the states of alarms, so that they
        /// survive a restart, relative to this file; it is created if it is missing. Without it,
        /// they are in memory only.
        file: String,
    }

    /// Limits for clients of the server. Requests above a limit are refused.
    struct LimitsEntry {
        /// Simultaneous sessions; default 50. At the limit, the oldest session that was never
        /// activated is closed for a new one; without such a session, the new one gets
        /// BadTooManySessions.
        #[schemars(range(min = 1, max = 10000))]
        sessions: u16,
        /// Sessions of a client address, enforced only while less than an eighth of the sessions is
        /// free; default half of the sessions. SCADA hosts and gateways run many clients on an
        /// address.
        #[schemars(range(min = 1, max = 10000))]
        sessions_per_address: u16,
        /// Connections; default four times the sessions and 100 more. At the limit, the oldest
        /// connection without an activated session is closed.
        #[schemars(range(min = 1, max = 65535))]
        connections: u16,
        /// Connections of a client address; default twice the sessions and 50 more.
        #[schemars(range(min = 1, max = 65535))]
        connections_per_address: u16,
        /// Subscriptions of a session; default 50.
        #[schemars(range(min = 1, max = 1000))]
        subscriptions: u16,
        /// Monitored items of a subscription; default 10000.
        #[schemars(range(min = 1, max = 65535))]
        items: u16,
        /// Nodes that a request reads or writes, or monitored items that it creates; default 10000
        /// and 1000.
        #[schemars(range(min = 1, max = 65535))]
        operations: u16,
    }
}

choice! {
    enum AnonymousEntry {
        /// Anonymous users are refused.
        Off = "off",
        /// Anonymous users read.
        Observer = "observer",
        /// Anonymous users read, write and call.
        Operator = "operator",
        /// Anonymous users have the permissions of engineers.
        Engineer = "engineer",
    }
}
