//! The values of topics on their way through the program.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, HashMap, VecDeque};
use std::sync::Arc;
use std::time::Instant;

use mappings::{Mapping, SpaceId, TopicId};

use super::claims::Claims;
use super::follow::MAX_STRAYS;
use super::inquiries::Inquiries;
use super::redundant::Redundant;
use super::tap::Tap;
use crate::confirm::Confirmer;
use crate::counters::Counters;
use crate::description::Described;
use crate::hops::Hops;
use crate::layout::Layout;
use crate::learned::Learned;
use crate::loop_rule::Owned;
use crate::output::Output;
use crate::pace::Pace;
use crate::plans::Plans;
use crate::room::Room;
use crate::settings::{Relay, Settings};
use crate::topic::Topic;

/// The topics of the space with their queues, turns and timers, and the outputs about them.
#[derive(Debug)]
pub(super) struct Values {
    pub(super) settings: Settings,
    pub(super) owned: Owned,
    pub(super) mapping: Arc<Mapping>,
    pub(super) topics: HashMap<TopicId, Topic>,
    /// The limit for topics that are unknown to the mapping and the local side.
    pub(super) room: Room,
    pub(super) plans: Plans,
    /// Topics with items to poll, served in turn, so that a topic with large messages does not
    /// block a topic with small messages.
    pub(super) ready: VecDeque<TopicId>,
    /// Topics with a partly sent large message, which wait for `pace`.
    pub(super) paced: VecDeque<TopicId>,
    pub(super) pace: Pace,
    pub(super) claims: Claims,
    /// The redundancy of the own space; `None` without redundancy.
    pub(super) redundant: Option<Box<Redundant>>,
    /// The broker between the programs; `None` for a network that does not store messages.
    pub(super) relay: Option<Relay>,
    /// The sender of the confirmations of each other space.
    pub(super) confirmers: BTreeMap<SpaceId, Confirmer>,
    /// The announced types of topics of other spaces.
    pub(super) learned: Learned<Described>,
    /// The announced fields, for messages that do not describe their fields.
    pub(super) layouts: Learned<Layout>,
    /// The probes that became necessary.
    pub(super) inquiries: Inquiries,
    /// The number of bytes that security adds to a datagram.
    pub(super) overhead: usize,
    /// Own topics with an outcome of the newest event that is not reported yet.
    pub(super) settled: VecDeque<TopicId>,
    /// Outputs other than samples and calls.
    pub(super) told: VecDeque<Output>,
    /// Topics of other spaces with notifications for the port, without duplicates.
    pub(super) news: VecDeque<TopicId>,
    /// Whether `news` is polled before `ready` next time.
    pub(super) news_first: bool,
    pub(super) timers: BinaryHeap<Reverse<(Instant, TopicId)>>,
    /// The size in bytes of the key frames stored for delta frames.
    pub(super) base_bytes: usize,
    /// Topics with a large sample that may wait for its local type.
    pub(super) large_held: Vec<TopicId>,
    /// The tapped topics; `None` without tapped topics.
    pub(super) tap: Option<Box<Tap>>,
    /// Buffers for reuse.
    pub(super) spare: Vec<Vec<u8>>,
    /// Counters of datagrams and messages without a topic, and of removed topics.
    pub(super) others: Counters,
    pub(super) hops: Hops,
}

impl Values {
    pub(super) fn new(settings: Settings, mapping: Arc<Mapping>, overhead: usize) -> Self {
        Self {
            settings,
            owned: Owned::All,
            mapping,
            topics: HashMap::new(),
            room: Room::new(MAX_STRAYS),
            plans: Plans::default(),
            ready: VecDeque::new(),
            paced: VecDeque::new(),
            pace: Pace::default(),
            claims: Claims::default(),
            redundant: None,
            relay: None,
            confirmers: BTreeMap::new(),
            learned: Learned::default(),
            layouts: Learned::default(),
            inquiries: Inquiries::default(),
            overhead,
            settled: VecDeque::new(),
            told: VecDeque::new(),
            news: VecDeque::new(),
            news_first: false,
            timers: BinaryHeap::new(),
            base_bytes: 0,
            large_held: Vec::new(),
            tap: None,
            spare: Vec::new(),
            others: Counters::default(),
            hops: Hops::new(),
        }
    }
}
