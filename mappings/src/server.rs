//! The OPC UA server of the cell: [`Server`].

use std::path::PathBuf;
use std::time::Duration;

use crate::endpoint::Endpoint;
use crate::permission::Anonymous;
use crate::quality::History;
use crate::remote::{FindSkills, ServerSecurityPolicy};

/// The OPC UA server of the cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Server {
    /// Endpoint for clients.
    pub endpoint: Endpoint,
    /// ApplicationUri of the server.
    pub application_uri: String,
    /// ApplicationUris of redundant servers by their rank, which counts from 1; empty without
    /// redundancy.
    pub redundant: Vec<String>,
    /// Endpoints of the redundant servers by their rank; empty if the document names none.
    pub redundant_endpoints: Vec<Endpoint>,
    /// Security policies that it offers, without repetition and not empty; `None` if the document
    /// names none.
    pub security: Option<Vec<ServerSecurityPolicy>>,
    /// Permission of anonymous users.
    pub anonymous: Anonymous,
    /// `true` if the server refuses other servers at hosts that their trusted certificates do not
    /// name.
    pub refuse_other_hosts: bool,
    /// Time after which uncertain values of other programs are bad, if a variable names no other
    /// time.
    pub bad_after: Option<Duration>,
    /// `true` if it has alarms for the publishers of the space.
    pub publisher_alarms: bool,
    /// Listening addresses of the clients to which the server connects.
    pub reverse_connect: Vec<Endpoint>,
    /// Size of the history.
    pub history: History,
    /// File of the history.
    pub history_file: Option<PathBuf>,
    /// Limits for clients.
    pub limits: ServerLimits,
    /// Rule for the servers with skills that it represents when they are found, if any.
    pub find_skills: Option<FindSkills>,
    /// NodeSet2 files of nodes that it has beside the nodes of the mapping.
    pub nodesets: Vec<PathBuf>,
}

impl Server {
    /// Returns the security policies that it offers. If the document names none, these are all
    /// policies, and [`ServerSecurityPolicy::None`] only for a server that listens on a loopback
    /// address.
    #[must_use]
    pub fn policies(&self, is_loopback: bool) -> Vec<ServerSecurityPolicy> {
        if let Some(told) = &self.security {
            return told.clone();
        }
        let all = ServerSecurityPolicy::ALL.iter().copied();
        all.filter(|policy| is_loopback || *policy != ServerSecurityPolicy::None)
            .collect()
    }

    /// Returns `true` if the server, or each server of a redundant set, is reached and connects on
    /// its own host only.
    #[must_use]
    pub fn is_local(&self) -> bool {
        self.endpoints().all(Endpoint::is_loopback) && self.connects_to_own_host_only()
    }

    /// Returns the endpoints of the server, or of all servers of a redundant set.
    pub fn endpoints(&self) -> impl Iterator<Item = &Endpoint> {
        std::iter::once(&self.endpoint).chain(&self.redundant_endpoints)
    }

    /// Returns the endpoint of the server, or of the first server of a redundant set. This server
    /// creates the keys of secured groups.
    #[must_use]
    pub fn first_endpoint(&self) -> &Endpoint {
        self.redundant_endpoints.first().unwrap_or(&self.endpoint)
    }

    /// Returns whether the server creates the keys of secured groups, by its ApplicationUri. The
    /// other servers of a redundant set request them.
    #[must_use]
    pub fn creates_keys(&self) -> bool {
        let rank = self
            .redundant
            .iter()
            .position(|uri| *uri == self.application_uri);
        rank.is_none_or(|rank| rank == 0)
    }

    /// Returns `true` if the server connects to no client of another host.
    #[must_use]
    pub fn connects_to_own_host_only(&self) -> bool {
        self.reverse_connect.iter().all(Endpoint::is_loopback)
    }
}

impl Default for Server {
    fn default() -> Self {
        Self {
            endpoint: Endpoint::default(),
            application_uri: "urn:ua-bridge:server".to_owned(),
            redundant: Vec::new(),
            redundant_endpoints: Vec::new(),
            security: None,
            anonymous: Anonymous::Usual,
            refuse_other_hosts: false,
            bad_after: None,
            publisher_alarms: false,
            reverse_connect: Vec::new(),
            history: History::default(),
            history_file: None,
            limits: ServerLimits::default(),
            find_skills: None,
            nodesets: Vec::new(),
        }
    }
}

/// Limits for clients of the server; the server chooses for `None`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ServerLimits {
    /// Sessions at the same time.
    pub sessions: Option<u16>,
    /// Sessions of one client address, enforced while less than an eighth of the sessions is free.
    pub sessions_per_address: Option<u16>,
    /// Connections.
    pub connections: Option<u16>,
    /// Maximum number of connections of a client address.
    pub connections_per_address: Option<u16>,
    /// Subscriptions of a session.
    pub subscriptions: Option<u16>,
    /// Monitored items of a subscription.
    pub items: Option<u16>,
    /// Nodes that one request reads or writes, or items that it creates.
    pub operations: Option<u16>,
}
