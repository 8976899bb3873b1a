//! Existing OPC UA servers, and their nodes that are values of the cell.

use std::fmt;
use std::num::NonZeroU16;
use std::ops::RangeInclusive;
use std::time::Duration;

use crate::endpoint::Endpoint;
use crate::node_id::ExpandedNodeIdText;

/// An existing OPC UA server, such as that of a PLC: an entry of `servers`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteServer {
    /// Name in the mapping.
    pub name: String,
    /// Endpoint, security and user of the server.
    pub access: Access,
    /// Place of its skills in the space, if they are shown there.
    pub skills: Option<SkillsPlace>,
}

/// Place in the space of the skills of a server that does not know the space.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SkillsPlace {
    /// Namespace of the skills, reserved for them.
    pub namespace: u16,
    /// `true` if other hosts may run the skills too.
    pub open: bool,
}

/// Rule for the servers with skills that get a place in the space when discovery finds them:
/// `server.find_skills`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FindSkills {
    /// ApplicationUris of the servers; with `*` at its end a URI stands for all URIs with this
    /// beginning.
    pub uris: Vec<String>,
    /// Namespace of the first server, 2..=65535.
    pub first: u16,
    /// Number of servers that get a place, with consecutive namespaces up to 65535.
    /// 1..=[`LIMIT`](Self::LIMIT).
    pub most: u16,
    /// Security policy of the sessions; `None` for the best policy that each server offers and both
    /// sides know.
    pub security: Option<ServerSecurityPolicy>,
    /// `true` if other hosts may run the skills too.
    pub open: bool,
    /// IPv4 networks outside the subnets of the interface whose servers are accepted too, such as
    /// 10.77.0.0/16.
    pub networks: Vec<String>,
}

impl FindSkills {
    /// Default number of servers that get a place.
    pub const MOST: u16 = 8;
    /// Largest number of servers that get a place.
    pub const LIMIT: u16 = 64;

    /// Returns `true` if the rule accepts a server with the ApplicationUri.
    #[must_use]
    pub fn wants(&self, application_uri: &str) -> bool {
        let mut uris = self.uris.iter();
        uris.any(|uri| match uri.strip_suffix('*') {
            Some(begins) => application_uri.starts_with(begins),
            None => application_uri == uri,
        })
    }

    /// Returns the namespaces of the servers in the space.
    #[must_use]
    pub const fn namespaces(&self) -> RangeInclusive<u16> {
        self.first..=self.first.saturating_add(self.most.saturating_sub(1))
    }
}

/// A SecurityPolicy of OPC 10000-7.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ServerSecurityPolicy {
    /// Neither signed nor encrypted.
    None,
    /// `http://opcfoundation.org/UA/SecurityPolicy#Basic256Sha256`
    Basic256Sha256,
    /// `http://opcfoundation.org/UA/SecurityPolicy#Aes128_Sha256_RsaOaep`
    Aes128Sha256RsaOaep,
    /// `http://opcfoundation.org/UA/SecurityPolicy#Aes256_Sha256_RsaPss`
    Aes256Sha256RsaPss,
}

impl ServerSecurityPolicy {
    /// Every policy, in ascending order of strength.
    pub const ALL: &'static [Self] = &[
        Self::None,
        Self::Aes128Sha256RsaOaep,
        Self::Basic256Sha256,
        Self::Aes256Sha256RsaPss,
    ];

    /// Returns the fragment of the URI.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "None",
            Self::Basic256Sha256 => "Basic256Sha256",
            Self::Aes128Sha256RsaOaep => "Aes128_Sha256_RsaOaep",
            Self::Aes256Sha256RsaPss => "Aes256_Sha256_RsaPss",
        }
    }
}

/// Endpoint of an OPC UA server, and security and user of the session.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Access {
    /// Endpoint of the server.
    pub endpoint: Endpoint,
    /// Security policy of the session; `None` for the best policy that the server offers and both
    /// sides know.
    pub security: Option<ServerSecurityPolicy>,
    /// User of the session; anonymous without a user.
    pub user: Option<User>,
}

impl Access {
    /// Returns the access of an anonymous user with the best security.
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
    /// Password of the user.
    pub password: Password,
}

/// A password; `Debug` does not show it.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct Password(String);

impl Password {
    pub(crate) const fn new(text: String) -> Self {
        Self(text)
    }

    /// Returns the password in clear, for the server.
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

/// Node of another server that a value comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeSource {
    /// Name of the server in `servers`.
    pub server: String,
    /// Node at the server.
    pub node: ExpandedNodeIdText,
    /// Period in which the server samples the value (SamplingInterval: OPC 10000-4, 5.13.1.2).
    pub sampling: Duration,
    /// Number of values that the server queues until they are sent; the oldest values of a full
    /// queue are dropped.
    pub queue: NonZeroU16,
    /// Deadband, as bits; 0 for no deadband.
    deadband: u64,
}

impl NodeSource {
    /// Default sampling interval.
    pub const SAMPLING: Duration = Duration::from_millis(100);
    /// Default queue size.
    pub const QUEUE: NonZeroU16 = NonZeroU16::MIN.saturating_add(9);

    /// Creates the source; `deadband` is 0 or greater.
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

    /// Returns the difference up to which a number equals the last reported number and is not
    /// reported (an absolute deadband: OPC 10000-4, 7.22.2); 0 if every change is reported.
    #[must_use]
    pub const fn deadband(&self) -> f64 {
        f64::from_bits(self.deadband)
    }
}

/// Node of another server that a value is written to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeTarget {
    /// Name of the server in `servers`.
    pub server: String,
    /// Node at the server.
    pub node: ExpandedNodeIdText,
}
