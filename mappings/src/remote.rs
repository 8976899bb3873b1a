//! OPC UA servers that exist already, and which of their nodes are values of the cell.

use std::fmt;
use std::num::NonZeroU16;
use std::ops::RangeInclusive;
use std::time::Duration;

use crate::endpoint::Endpoint;
use crate::mapping::SecurityPolicy;
use crate::node_id::ExpandedNodeIdText;

/// An OPC UA server that exists already, such as that of a PLC: an entry of `servers`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteServer {
    /// What the mapping calls it.
    pub name: String,
    /// How it is reached.
    pub access: Access,
    /// Where its skills are in the space, if they are to be.
    pub skills: Option<SkillsPlace>,
}

/// The place in the space that the skills of a server have which knows nothing of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SkillsPlace {
    /// Their namespace, which is theirs alone.
    pub namespace: u16,
    /// Whether they are run for other hosts too.
    pub open: bool,
}

/// Which servers with skills, of those that discovery finds, have a place in the space: `server.find_skills`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FindSkills {
    /// Their ApplicationUris; with `*` at its end one stands for all that begin so.
    pub uris: Vec<String>,
    /// The namespace of the first one, 2..=65535.
    pub first: u16,
    /// How many have a place: their namespaces follow each other, up to 65535. 1..=[`LIMIT`](Self::LIMIT).
    pub most: u16,
    /// The security policy of the sessions; without one the best that each server offers and both sides know.
    pub security: Option<SecurityPolicy>,
    /// Whether their skills are run for other hosts too.
    pub open: bool,
    /// IPv4 networks outside the subnets of the interface whose servers are accepted too, as 10.77.0.0/16.
    pub networks: Vec<String>,
}

impl FindSkills {
    /// How many have a place where nothing is said.
    pub const MOST: u16 = 8;
    /// How many may have a place.
    pub const LIMIT: u16 = 64;

    /// Whether a server with that ApplicationUri is one of them.
    #[must_use]
    pub fn wants(&self, application_uri: &str) -> bool {
        let mut uris = self.uris.iter();
        uris.any(|uri| match uri.strip_suffix('*') {
            Some(begins) => application_uri.starts_with(begins),
            None => application_uri == uri,
        })
    }

    /// The namespaces that they have in the space.
    #[must_use]
    pub const fn namespaces(&self) -> RangeInclusive<u16> {
        self.first..=self.first.saturating_add(self.most.saturating_sub(1))
    }
}

/// How an OPC UA server is reached, and as whom.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Access {
    /// Where it is.
    pub endpoint: Endpoint,
    /// The security policy of the session; without one the best that the server offers and both sides know.
    pub security: Option<SecurityPolicy>,
    /// As whom; anonymous without.
    pub user: Option<User>,
}

impl Access {
    /// As anybody, with the best security there is.
    #[must_use]
    pub const fn anonymous(endpoint: Endpoint) -> Self {
        Self {
            endpoint,
            security: None,
            user: None,
        }
    }
}

/// A user of an OPC UA server (a UserNameIdentityToken: OPC 10000-4, 7.41.4).
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct User {
    /// The user name.
    pub name: String,
    /// What proves it.
    pub password: Password,
}

/// A password, which no log shows.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct Password(String);

impl Password {
    pub(crate) const fn new(text: String) -> Self {
        Self(text)
    }

    /// As the server is told.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Password {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("***")
    }
}

/// The node of another server that a value comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeSource {
    /// The name of the server among `servers`.
    pub server: String,
    /// The node there.
    pub node: ExpandedNodeIdText,
    /// How often the server looks at the value (SamplingInterval: OPC 10000-4, 5.13.1.2).
    pub sampling: Duration,
    /// How many values the server keeps until they are sent; of more the oldest go.
    pub queue: NonZeroU16,
    /// By its bits; 0 for none.
    deadband: u64,
}

impl NodeSource {
    /// The sampling interval where none is said.
    pub const SAMPLING: Duration = Duration::from_millis(100);
    /// The queue where none is said.
    pub const QUEUE: NonZeroU16 = NonZeroU16::MIN.saturating_add(9);

    /// `deadband` is 0 or greater.
    #[must_use]
    pub const fn new(
        server: String,
        node: ExpandedNodeIdText,
        (sampling, queue, deadband): (Duration, NonZeroU16, f64),
    ) -> Self {
        Self {
            server,
            node,
            sampling,
            queue,
            deadband: deadband.to_bits(),
        }
    }

    /// By how much a number may differ from the one told last without being told itself (an absolute deadband:
    /// OPC 10000-4, 7.22.2); 0 where every change is told.
    #[must_use]
    pub const fn deadband(&self) -> f64 {
        f64::from_bits(self.deadband)
    }
}

/// The node of another server that a value is written to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeTarget {
    /// The name of the server among `servers`.
    pub server: String,
    /// The node there.
    pub node: ExpandedNodeIdText,
}
