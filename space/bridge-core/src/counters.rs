//! What happened to each sample: forwarded, or dropped for a named reason and counted.

use std::fmt;

/// Why a sample or datagram did not cross.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Reason {
    /// It came back to where it was produced, as every sample does that a bridge hears of itself.
    Looped,
    /// Somebody else sends under our space's PublisherId: two bridges serve one space.
    SpaceTaken,
    /// A datagram whose triple is none of the space (no number, out of range, or zero).
    NotInSpace,
    /// The PublisherId has our number but another width than UInt16 (OPC 10000-14 7.2.4.4.2).
    PublisherWidth,
    /// Bytes that break the encoding they claim to have.
    Malformed,
    /// Well-formed, but of a kind that is not read.
    Unsupported,
    /// A DataSetMessage whose valid bit is clear.
    Invalid,
    /// No local message type is known for the topic.
    Untyped,
    /// The value is not what the topic's message type holds.
    Mismatch,
    /// A sequence number that was there already.
    Duplicate,
    /// Older than what was delivered.
    Stale,
    /// A key frame repeated for late joiners, which we delivered before.
    Repeat,
    /// The topic's queue was full and its oldest sample gave way.
    Overflow,
    /// Larger than is sent or put together from chunks.
    TooBig,
    /// A large message of which chunks never came.
    Incomplete,
    /// A large message given up since others took up the room for those that are unfinished or wait for their type.
    NoRoom,
    /// More topics than are tracked.
    TooManyTopics,
    /// More latched publishers of one topic than are kept for late joiners.
    TooManyPublishers,
    /// A delta frame that cannot be put over a key frame of which nothing is missing.
    NoKeyFrame,
    /// A message that is read with the DataSetMetaData of its writer, which have not come.
    Undescribed,
    /// No sample, but what a topic is announced to consist of: nothing that is believed, or nothing that can be announced.
    MetaData,
    /// The local side did not take it.
    NotPublished,
    /// An event, and no subscriber is present on the local side.
    NoSubscriber,
    /// The socket did not take it.
    NotSent,
    /// A service did not take the value, or did not answer.
    CallFailed,
    /// No sample, but a publisher or subscriber that the local side cannot be matched with, as their qualities of service
    /// exclude each other.
    IncompatibleQos,
    /// The value says nothing new, and its topic is published on change or has a deadband.
    Unchanged,
    /// A newer value took its place before its topic's rate let it go.
    Outpaced,
    /// A request that is not executed, for what it is, where it comes from, or because there are too many; or a response that
    /// is not told.
    CallRefused,
    /// A request that somebody else is to execute, or a response that nobody here waits for: both go to the whole group.
    NotAsked,
    /// A response of somebody who does not execute the call.
    Forged,
    /// An event that a bridge it is for has not confirmed in time: whether it has arrived is unknown.
    Unconfirmed,
    /// In clear, where the group is secured.
    Unsecured,
    /// Signed alone, where the group encrypts; or encrypted and not signed.
    Downgraded,
    /// Not written with the key of the group, or changed since.
    Signature,
    /// It was there before, or is so far from the newest of its sender that nothing tells whether it was.
    Replayed,
    /// Secured with a key that is not known here, or is out of use.
    UnknownKey,
    /// There is no key to secure with what is to be sent.
    NoKeys,
}

impl Reason {
    /// All of them, in the order of their counters.
    pub const ALL: [Self; 38] = [
        Self::Looped,
        Self::SpaceTaken,
        Self::NotInSpace,
        Self::PublisherWidth,
        Self::Malformed,
        Self::Unsupported,
        Self::Invalid,
        Self::Untyped,
        Self::Mismatch,
        Self::Duplicate,
        Self::Stale,
        Self::Repeat,
        Self::Overflow,
        Self::TooBig,
        Self::Incomplete,
        Self::NoRoom,
        Self::TooManyTopics,
        Self::TooManyPublishers,
        Self::NoKeyFrame,
        Self::Undescribed,
        Self::MetaData,
        Self::NotPublished,
        Self::NoSubscriber,
        Self::NotSent,
        Self::CallFailed,
        Self::IncompatibleQos,
        Self::Unchanged,
        Self::Outpaced,
        Self::CallRefused,
        Self::NotAsked,
        Self::Forged,
        Self::Unconfirmed,
        Self::Unsecured,
        Self::Downgraded,
        Self::Signature,
        Self::Replayed,
        Self::UnknownKey,
        Self::NoKeys,
    ];

    /// The label of its counter.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Looped => "looped",
            Self::SpaceTaken => "space_taken",
            Self::NotInSpace => "not_in_space",
            Self::PublisherWidth => "publisher_width",
            Self::Malformed => "malformed",
            Self::Unsupported => "unsupported",
            Self::Invalid => "invalid",
            Self::Untyped => "untyped",
            Self::Mismatch => "mismatch",
            Self::Duplicate => "duplicate",
            Self::Stale => "stale",
            Self::Repeat => "repeat",
            Self::Overflow => "overflow",
            Self::TooBig => "too_big",
            Self::Incomplete => "incomplete",
            Self::NoRoom => "no_room",
            Self::TooManyTopics => "too_many_topics",
            Self::TooManyPublishers => "too_many_publishers",
            Self::NoKeyFrame => "no_key_frame",
            Self::Undescribed => "undescribed",
            Self::MetaData => "metadata",
            Self::NotPublished => "not_published",
            Self::NoSubscriber => "no_subscriber",
            Self::NotSent => "not_sent",
            Self::CallFailed => "call_failed",
            Self::IncompatibleQos => "incompatible_qos",
            Self::Unchanged => "unchanged",
            Self::Outpaced => "outpaced",
            Self::CallRefused => "call_refused",
            Self::NotAsked => "not_asked",
            Self::Forged => "forged",
            Self::Unconfirmed => "unconfirmed",
            Self::Unsecured => "unsecured",
            Self::Downgraded => "downgraded",
            Self::Signature => "signature",
            Self::Replayed => "replayed",
            Self::UnknownKey => "unknown_key",
            Self::NoKeys => "no_keys",
        }
    }

    /// Whether it leaves a topic of another space with an older value than its writer has sent.
    pub(crate) const fn is_loss(self) -> bool {
        matches!(
            self,
            Self::Malformed
                | Self::Unsupported
                | Self::Invalid
                | Self::Mismatch
                | Self::Duplicate
                | Self::Stale
                | Self::TooBig
                | Self::Incomplete
                | Self::NoRoom
                | Self::NoKeyFrame
                | Self::Undescribed
                | Self::NotPublished
        )
    }

    /// Whether it belongs to normal traffic, so that nobody needs to be told; or is told by who counts it.
    #[must_use]
    pub const fn is_routine(self) -> bool {
        matches!(
            self,
            Self::Looped
                | Self::Repeat
                | Self::NotInSpace
                | Self::NoSubscriber
                | Self::IncompatibleQos
                | Self::Unchanged
                | Self::Outpaced
                | Self::NotAsked
        )
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}

/// What became of one sample.
#[must_use]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// It waits in the topic's queue for `poll_output`.
    Forward,
    /// It waits in the queue, and the oldest one there was dropped for it.
    ForwardAfterDroppingOldest,
    /// It does not cross.
    Drop(Reason),
}

/// Counts of one topic, or of the datagrams that belong to none.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Counters {
    /// Samples of our own space that were handed out as NetworkMessages.
    pub sent: u64,
    /// Samples of other spaces that were handed out to the local side.
    pub delivered: u64,
    /// Key frames repeated for late joiners.
    pub repeated: u64,
    /// DataSetMessages of other spaces that never came, by the gaps in their sequence numbers.
    pub missing: u64,
    /// How often what the topic consists of was announced.
    pub announced: u64,
    /// What the writer of another space announced its topic to be, where that was new.
    pub described: u64,
    /// Keep-alives sent.
    pub keep_alives: u64,
    /// How often values of another space came from another address than the one before.
    pub sender_changed: u64,
    /// Of the causes that occurred, in their order: most topics have few.
    dropped: Vec<(Cause, u64)>,
}

/// Why something is dropped: the reason that is counted, and which case of it, where the log tells cases apart. A case
/// that is frequent then does not hide one that is rare.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Cause {
    pub(crate) reason: Reason,
    pub(crate) case: &'static str,
}

impl From<Reason> for Cause {
    fn from(reason: Reason) -> Self {
        Self { reason, case: "" }
    }
}

impl From<(Reason, &'static str)> for Cause {
    fn from((reason, case): (Reason, &'static str)) -> Self {
        Self { reason, case }
    }
}

impl Counters {
    /// How many were dropped for `reason`.
    #[must_use]
    pub fn dropped(&self, reason: Reason) -> u64 {
        self.drops()
            .find_map(|(each, count)| (each == reason).then_some(count))
            .unwrap_or_default()
    }

    /// Every reason that occurred, with its count.
    pub fn drops(&self) -> impl Iterator<Item = (Reason, u64)> {
        let reasons = self.dropped.chunk_by(|(a, _), (b, _)| a.reason == b.reason);
        reasons.filter_map(|cases| {
            let (cause, _) = cases.first()?;
            let count = cases
                .iter()
                .fold(0, |sum: u64, (_, count)| sum.saturating_add(*count));
            Some((cause.reason, count))
        })
    }

    /// Adds `count` drops and says how many of that cause there are now.
    pub(crate) fn add(&mut self, cause: impl Into<Cause>, count: u64) -> u64 {
        let cause = cause.into();
        let place = self.dropped.binary_search_by_key(&cause, |(each, _)| *each);
        if let Err(before) = place
            && count > 0
        {
            self.dropped.insert(before, (cause, count));
            return count;
        }
        let known = place.ok().and_then(|found| self.dropped.get_mut(found));
        known.map_or(0, |(_, total)| {
            *total = total.saturating_add(count);
            *total
        })
    }

    /// Takes over what was counted of a topic that is no longer followed.
    pub(crate) fn absorb(&mut self, other: &Self) {
        let Self {
            sent,
            delivered,
            repeated,
            missing,
            announced,
            described,
            keep_alives,
            sender_changed,
            dropped,
        } = other;
        self.sent += sent;
        self.delivered += delivered;
        self.repeated += repeated;
        self.missing += missing;
        self.announced += announced;
        self.described += described;
        self.keep_alives += keep_alives;
        self.sender_changed += sender_changed;
        for (Cause { reason, .. }, count) in dropped {
            // A case of its own: what is told of the others is not to be as late as if it were theirs.
            self.add((*reason, "of a topic before"), *count);
        }
    }
}

/// Whether the `total`th occurrence is told: the 1st, 10th, 100th and so on, so that a flood stays a few lines.
pub(crate) fn is_told(total: u64) -> bool {
    total
        .checked_ilog10()
        .is_some_and(|digits| total == 10_u64.pow(digits))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_told_once_per_decade() {
        let told: Vec<u64> = (0..=1000).filter(|total| is_told(*total)).collect();
        assert_eq!(told, [1, 10, 100, 1000]);
    }

    #[test]
    fn every_reason_has_its_own_counter_and_label() {
        let mut counters = Counters::default();
        for (index, reason) in Reason::ALL.into_iter().enumerate() {
            counters.add(reason, index as u64 + 1);
        }
        for (index, reason) in Reason::ALL.into_iter().enumerate() {
            assert_eq!(counters.dropped(reason), index as u64 + 1, "{reason}");
        }
        counters.add((Reason::Overflow, "read too slowly"), 5);
        let overflow = Reason::ALL.iter().position(|r| *r == Reason::Overflow);
        let overflow = overflow.unwrap() as u64 + 1;
        assert_eq!(counters.dropped(Reason::Overflow), overflow + 5);
        assert_eq!(counters.drops().count(), Reason::ALL.len());
        assert_eq!(
            counters.add(Reason::Overflow, 1),
            overflow + 1,
            "of its own"
        );
        let labels: std::collections::BTreeSet<_> =
            Reason::ALL.iter().map(|reason| reason.label()).collect();
        assert_eq!(labels.len(), Reason::ALL.len());
    }
}
