//! Several bridges of a space that carry different namespaces.
//!
//! Each bridge announces its namespaces and its name every second. If two bridges announce the same
//! namespace, the bridge that started first keeps it, and the other bridge carries nothing in it.
//! Both know the name of the other.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::SpaceId;
use uadp::{EncodeError, NetworkMessage, Scalar, Timestamp};

use crate::bridge_message;
use crate::settings::Now;

/// The announcement of the namespaces that a bridge of a space carries.
///
/// It is a DataSetMessage of the PublisherId of the space without a WriterGroupId, as the heartbeat
/// of redundant bridges.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct PartAnnouncement {
    /// The carried namespaces.
    pub(crate) namespaces: BTreeSet<u16>,
    /// The name of the program for users.
    pub(crate) name: String,
    /// The start of the program: the bridge that started first keeps a namespace.
    started: i64,
    instance: u32,
}

impl PartAnnouncement {
    /// Appends the NetworkMessage.
    pub(crate) fn encode(
        &self,
        space: SpaceId,
        utc: Timestamp,
        out: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        let namespaces: Vec<u8> = self
            .namespaces
            .iter()
            .flat_map(|namespace| namespace.to_le_bytes())
            .collect();
        let fields = [
            Scalar::UInt32(self.instance),
            Scalar::Int64(self.started),
            Scalar::String(Some(&self.name)),
            Scalar::ByteString(Some(&namespaces)),
        ];
        bridge_message::encode((space, utc), MARK, fields, out)
    }

    /// Reads the announcement of a bridge of any space; `None` for all other messages.
    pub(crate) fn decode(message: &NetworkMessage<'_>) -> Option<(SpaceId, Self)> {
        let (space, mut fields) = bridge_message::decode(message, MARK)?;
        let Scalar::UInt32(instance) = fields.scalar()? else {
            return None;
        };
        let Scalar::Int64(started) = fields.scalar()? else {
            return None;
        };
        let Scalar::String(Some(name)) = fields.scalar()? else {
            return None;
        };
        let Scalar::ByteString(Some(namespaces)) = fields.scalar()? else {
            return None;
        };
        let (namespaces, _) = namespaces.as_chunks::<2>();
        if name.len() > LONGEST_NAME || namespaces.len() > MOST_NAMESPACES {
            return None;
        }
        let name: String = name.chars().filter(|one| !one.is_control()).collect();
        let announcement = Self {
            namespaces: namespaces
                .iter()
                .map(|of| u16::from_le_bytes(*of))
                .collect(),
            name,
            started,
            instance,
        };
        Some((space, announcement))
    }
}

/// The namespaces that this bridge carries.
#[derive(Debug)]
pub(crate) struct OwnPart {
    own: PartAnnouncement,
    /// The time of the next announcement.
    next: Instant,
}

impl OwnPart {
    pub(crate) fn new(
        namespaces: BTreeSet<u16>,
        name: String,
        (instance, now): (u32, Now),
    ) -> Self {
        let started = now.utc.unix_nanos() / 1_000_000;
        Self {
            own: PartAnnouncement {
                namespaces,
                name,
                started: i64::try_from(started).unwrap_or(i64::MAX),
                instance,
            },
            next: now.monotonic,
        }
    }

    pub(crate) const fn announcement(&self) -> &PartAnnouncement {
        &self.own
    }

    pub(crate) fn has(&self, namespace: u16) -> bool {
        self.own.namespaces.contains(&namespace)
    }

    pub(crate) const fn due(&self) -> Instant {
        self.next
    }

    /// Returns whether an announcement is due.
    pub(crate) fn poll(&mut self, now: Instant) -> bool {
        let is_due = now >= self.next;
        if is_due {
            self.next = now + PERIOD;
        }
        is_due
    }

    /// Returns the namespaces that another bridge carries too, and whether that bridge keeps them.
    /// Announces the own namespaces soon if this bridge keeps them.
    pub(crate) fn overlap(&mut self, other: &PartAnnouncement, now: Instant) -> (Vec<u16>, bool) {
        if other.instance == self.own.instance {
            return (Vec::new(), false);
        }
        let common = self.own.namespaces.intersection(&other.namespaces);
        let common: Vec<u16> = common.copied().collect();
        let is_theirs = (other.started, other.instance) < (self.own.started, self.own.instance);
        if !common.is_empty() && !is_theirs {
            self.next = self.next.min(now + SOON);
        }
        (common, is_theirs)
    }
}

/// The bridges of other spaces that carry a part of their space.
#[derive(Debug, Default)]
pub(crate) struct OtherParts {
    of: BTreeMap<(SpaceId, u16), (SocketAddr, Instant)>,
}

impl OtherParts {
    /// Records an announcement. A namespace stays with its bridge as long as it is announced.
    pub(crate) fn meet(
        &mut self,
        space: SpaceId,
        announced: &PartAnnouncement,
        (from, now): (SocketAddr, Instant),
    ) {
        self.of
            .retain(|_, (_, at)| now.saturating_duration_since(*at) < LOST);
        for namespace in &announced.namespaces {
            let key = (space, *namespace);
            if self.of.len() >= MOST_PARTS && !self.of.contains_key(&key) {
                return;
            }
            let (known, at) = self.of.entry(key).or_insert((from, now));
            if *known == from {
                *at = now;
            }
        }
    }

    /// Returns whether the sender carries the namespace of a space.
    pub(crate) fn is_carrier(&self, of: (SpaceId, u16), from: SocketAddr) -> bool {
        self.of.get(&of).is_some_and(|(known, _)| *known == from)
    }
}

/// The first field of an announcement.
const MARK: &str = "ua-bridge part 1";
/// The period of the announcements.
const PERIOD: Duration = Duration::from_secs(1);
/// The time to the answer to the announcement of a bridge that started later.
const SOON: Duration = Duration::from_millis(20);
/// The time after which a bridge without announcements is lost.
pub(crate) const LOST: Duration = Duration::from_secs(5);
const LONGEST_NAME: usize = 256;
const MOST_NAMESPACES: usize = 1_024;
/// The maximum number of known namespaces of other spaces. It is limited, because any sender in an
/// unsecured group can send announcements.
const MOST_PARTS: usize = 4_096;
