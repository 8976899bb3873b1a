//! The carriers of a mapping that lists several, or one other than UDP and MQTT, and the names that
//! are forwarded between them.

use std::fmt;
use std::net::SocketAddr;
use std::str::FromStr;

use crate::broker::Broker;
use crate::ethernet::EthernetGroup;
use crate::topic::{NamePart, SpaceId, TopicError, decimal};

/// A carrier of a mapping that lists its carriers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfiguredCarrier {
    /// The network.
    pub medium: CarrierMedium,
    /// Names of publishers at this carrier; their messages are forwarded to the other carriers.
    pub forward: Vec<ForwardedName>,
}

/// The network of a carrier.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CarrierMedium {
    /// UDP multicast or unicast.
    Udp(UdpGroup),
    /// An MQTT broker.
    Mqtt(Box<Broker>),
    /// Ethernet frames.
    Ethernet(EthernetGroup),
    /// Shared memory between programs of this host.
    SharedMemory(SharedMemoryGroup),
}

/// The name of a group of programs of one host that exchange messages in shared memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SharedMemoryGroup(String);

impl SharedMemoryGroup {
    /// The beginning of the address of a group, as `shm:cell`.
    pub const SCHEME: &str = "shm:";
    /// The longest name in bytes.
    pub const LONGEST: usize = 64;

    /// Returns the group with a name: letters, digits, `-` and `_`.
    #[must_use]
    pub fn new(name: &str) -> Option<Self> {
        let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_');
        let is_short = (1..=Self::LONGEST).contains(&name.len());
        (is_short && name.bytes().all(is_allowed)).then(|| Self(name.to_owned()))
    }

    /// Returns the name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.0
    }
}

impl Default for SharedMemoryGroup {
    fn default() -> Self {
        Self("cell".to_owned())
    }
}

/// A UDP group or host, and how datagrams reach it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UdpGroup {
    /// Group or host, and its port.
    pub address: SocketAddr,
    /// Name or address of the network interface; `None` lets the operating system choose.
    pub interface: Option<String>,
    /// Hops a multicast datagram may travel.
    pub ttl: u8,
    /// Hosts that datagrams are sent to instead of `address`, which is then an address of this
    /// host.
    pub peers: Vec<SocketAddr>,
}

/// A space, a namespace of a space, or a topic: `ua_1`, `ua_1_2` or `ua_1_2_10`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ForwardedName {
    space: SpaceId,
    namespace: Option<u16>,
    identifier: Option<u16>,
}

impl ForwardedName {
    /// Returns whether the name contains messages of this publisher, group and writer. A message
    /// without a group or writer belongs to names that do not need it.
    #[must_use]
    pub fn covers(self, publisher: u16, group: Option<u16>, writer: Option<u16>) -> bool {
        u16::from(self.space.get()) == publisher
            && (self.namespace.is_none() || self.namespace == group)
            && (self.identifier.is_none() || self.identifier == writer)
    }

    /// Returns whether some topics have both names.
    #[must_use]
    pub fn overlaps(self, other: Self) -> bool {
        let meets = |a: Option<u16>, b: Option<u16>| a.is_none() || b.is_none() || a == b;
        self.space == other.space
            && meets(self.namespace, other.namespace)
            && meets(self.identifier, other.identifier)
    }

    /// Returns the space of the publisher.
    #[must_use]
    pub const fn space(self) -> SpaceId {
        self.space
    }

    /// Returns whether the name is that of a whole space.
    #[must_use]
    pub const fn is_whole_space(self) -> bool {
        self.namespace.is_none()
    }
}

impl FromStr for ForwardedName {
    type Err = TopicError;

    fn from_str(text: &str) -> Result<Self, TopicError> {
        let rest = text.strip_prefix("ua_").ok_or(TopicError::Prefix)?;
        let mut parts = rest.split('_');
        let space = decimal(NamePart::Space, parts.next().unwrap_or_default())?;
        let mut number = |part| match parts.next().map(|text| decimal(part, text)) {
            None => Ok(None),
            Some(Ok(0)) => Err(TopicError::Range(part)),
            Some(Ok(number)) => Ok(Some(number)),
            Some(Err(error)) => Err(error),
        };
        let name = Self {
            space: SpaceId::new(space).ok_or(TopicError::Range(NamePart::Space))?,
            namespace: number(NamePart::Namespace)?,
            identifier: number(NamePart::Identifier)?,
        };
        match parts.next() {
            None => Ok(name),
            Some(_) => Err(TopicError::Parts),
        }
    }
}

impl fmt::Display for ForwardedName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ua_{}", self.space)?;
        for number in [self.namespace, self.identifier].into_iter().flatten() {
            write!(f, "_{number}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> ForwardedName {
        text.parse().unwrap()
    }

    #[test]
    fn a_name_is_a_space_a_namespace_or_a_topic() {
        for text in ["ua_0", "ua_1_2", "ua_232_65535_1"] {
            assert_eq!(name(text).to_string(), text);
        }
        for text in [
            "",
            "ua_",
            "ua_1_",
            "ua_1_0",
            "ua_1_2_0",
            "ua_01",
            "ua_1_2_3_4",
            "1_2",
            "ua_233",
            "ua_1_*",
        ] {
            assert!(text.parse::<ForwardedName>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_name_covers_its_parts_only() {
        assert!(name("ua_1").covers(1, None, None));
        assert!(name("ua_1_2").covers(1, Some(2), Some(10)));
        assert!(name("ua_1_2_10").covers(1, Some(2), Some(10)));
        assert!(!name("ua_1_2").covers(1, None, None));
        assert!(!name("ua_1_2").covers(2, Some(2), None));
        assert!(!name("ua_1_2_10").covers(1, Some(2), None));
        assert!(!name("ua_1_2_10").covers(1, Some(2), Some(11)));
    }

    #[test]
    fn names_overlap_if_a_topic_has_both() {
        assert!(name("ua_1").overlaps(name("ua_1_2_10")));
        assert!(name("ua_1_2_10").overlaps(name("ua_1_2")));
        assert!(!name("ua_1_2").overlaps(name("ua_1_3")));
        assert!(!name("ua_1").overlaps(name("ua_2")));
        assert!(!name("ua_1_2_10").overlaps(name("ua_1_2_11")));
    }
}
