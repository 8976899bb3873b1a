//! Counters of samples: forwarded samples, and dropped samples by reason.

use std::fmt;

/// The reason why a sample or datagram was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Reason {
    /// The sample returned to the space that produced it. Each sample that a bridge receives from
    /// itself is looped.
    Looped,
    /// Another sender uses the PublisherId of the own space: two bridges serve the same space.
    SpaceTaken,
    /// The ids of the datagram do not identify a topic: not a number, out of range, or zero.
    NotInSpace,
    /// The PublisherId has the number of the own space in another width than UInt16 (OPC 10000-14
    /// 7.2.4.4.2).
    PublisherWidth,
    /// The bytes violate their encoding.
    Malformed,
    /// The message is well-formed, but of an unsupported kind.
    Unsupported,
    /// The valid bit of the DataSetMessage is cleared.
    Invalid,
    /// The local message type of the topic is unknown.
    Untyped,
    /// The value does not match the message type of the topic.
    Mismatch,
    /// The source of the value is lost: its status is Bad, and it has no value of the message type
    /// of the topic.
    NoValue,
    /// The sequence number was already received.
    Duplicate,
    /// The sample is older than the last delivered sample.
    Stale,
    /// A key frame repeated for late joiners, which was already delivered.
    Repeat,
    /// The oldest sample was dropped from the full queue of the topic.
    Overflow,
    /// The message exceeds the maximum size for sending or for reassembly from chunks.
    TooBig,
    /// Chunks of a large message are missing.
    Incomplete,
    /// A large message was given up, because others needed the memory for messages that are
    /// incomplete or wait for their type.
    NoRoom,
    /// The maximum number of topics is reached.
    TooManyTopics,
    /// The maximum number of latched publishers of a topic is reached.
    TooManyPublishers,
    /// A delta frame without a complete key frame to which it can be applied.
    NoKeyFrame,
    /// The message cannot be read without the DataSetMetaData of its writer, which was not
    /// received.
    Undescribed,
    /// A metadata announcement, not a sample: a received announcement is not accepted, or an own
    /// announcement cannot be sent.
    MetaData,
    /// The local side did not accept the sample.
    NotPublished,
    /// An event without a subscriber on the local side.
    NoSubscriber,
    /// The socket did not accept the datagram.
    NotSent,
    /// A service did not accept the value, or did not respond.
    CallFailed,
    /// Not a sample: the QoS policies of a publisher or subscriber are incompatible with the local
    /// side.
    IncompatibleQos,
    /// The value is unchanged, and its topic is published on change or has a deadband.
    Unchanged,
    /// A newer value replaced the value before it could be published: the rate limit of the topic
    /// did not allow it yet, or it was not yet known whether another program writes the namespace.
    Outpaced,
    /// A request that is not executed because of its content, its source, or the number of
    /// requests; or a response that is not sent.
    CallRefused,
    /// A request for another executor, or a response for another requestor. Both are sent to the
    /// whole group.
    NotAsked,
    /// A response from a sender that does not execute the call.
    Forged,
    /// A destination bridge has not confirmed the event in time. Its arrival is unknown.
    Unconfirmed,
    /// A broker delivered the message after its time, or the message carries no time.
    Late,
    /// The message is not secured, but the group is.
    Unsecured,
    /// The message is signed only, but the group encrypts; or it is encrypted and not signed.
    Downgraded,
    /// The message was not signed with the key of the group, or it was changed.
    Signature,
    /// The message was already received, or is so far from the newest message of its sender that
    /// this cannot be determined.
    Replayed,
    /// The message is secured with an unknown or expired key.
    UnknownKey,
    /// There is no key to secure the message.
    NoKeys,
    /// A takeover between redundant bridges: an own sample that may not have been sent, an event
    /// that the former active bridge may have delivered, or a message of a bridge that is not
    /// active.
    Takeover,
}

impl Reason {
    /// All reasons in the order of their counters.
    pub const ALL: [Self; 41] = [
        Self::Looped,
        Self::SpaceTaken,
        Self::NotInSpace,
        Self::PublisherWidth,
        Self::Malformed,
        Self::Unsupported,
        Self::Invalid,
        Self::Untyped,
        Self::Mismatch,
        Self::NoValue,
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
        Self::Late,
        Self::Unsecured,
        Self::Downgraded,
        Self::Signature,
        Self::Replayed,
        Self::UnknownKey,
        Self::NoKeys,
        Self::Takeover,
    ];

    /// Returns the label of the counter.
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
            Self::NoValue => "no_value",
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
            Self::Late => "late",
            Self::Unsecured => "unsecured",
            Self::Downgraded => "downgraded",
            Self::Signature => "signature",
            Self::Replayed => "replayed",
            Self::UnknownKey => "unknown_key",
            Self::NoKeys => "no_keys",
            Self::Takeover => "takeover",
        }
    }

    /// Returns the meaning of the reason for users.
    #[must_use]
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::Looped => "the sample returned to the space that produced it",
            Self::SpaceTaken => "another program sends in the name of this space",
            Self::NotInSpace => "the ids of the message do not make a topic",
            Self::PublisherWidth => "the PublisherId is not a UInt16",
            Self::Malformed => "the bytes violate their encoding",
            Self::Unsupported => "the message is of an unsupported kind",
            Self::Invalid => "the writer marked the message as invalid",
            Self::Untyped => "the local message type of the topic is not known",
            Self::Mismatch => "the value does not fit the message type of the topic",
            Self::NoValue => "the source of the value is lost",
            Self::Duplicate => "the sequence number was already received",
            Self::Stale => "the sample is older than the last delivered sample",
            Self::Repeat => "a repetition for late joiners, which was already delivered",
            Self::Overflow => "the queue of the topic was full, and the oldest sample gave way",
            Self::TooBig => "the message is larger than the maximum size",
            Self::Incomplete => "parts of a large message are missing",
            Self::NoRoom => "the memory for incomplete messages was needed by others",
            Self::TooManyTopics => "the maximum number of topics is reached",
            Self::TooManyPublishers => "the maximum number of latched publishers is reached",
            Self::NoKeyFrame => "a delta frame came before its key frame",
            Self::Undescribed => "the metadata of the writer has not been received",
            Self::MetaData => "a metadata announcement was not accepted or not sent",
            Self::NotPublished => "the local side did not accept the sample",
            Self::NoSubscriber => "an event without a subscriber on the local side",
            Self::NotSent => "the socket did not accept the datagram",
            Self::CallFailed => "the service did not accept the value, or did not respond",
            Self::IncompatibleQos => "the QoS policies of a peer are incompatible",
            Self::Unchanged => "the value is unchanged, and the mapping publishes changes only",
            Self::Outpaced => "a newer value replaced it within the rate limit",
            Self::CallRefused => "the request is not executed",
            Self::NotAsked => "the message is for another program",
            Self::Forged => "the sender is not the one that announced itself",
            Self::Unconfirmed => {
                "a bridge has not confirmed the command in time: its outcome is unknown"
            }
            Self::Late => "the broker delivered the message after its time",
            Self::Unsecured => "the message is not secured, but the group is",
            Self::Downgraded => "the message is secured less than the group demands",
            Self::Signature => "the signature is not of the group, or the message was changed",
            Self::Replayed => "the secured message was already received",
            Self::UnknownKey => "the message is secured with an unknown or expired key",
            Self::NoKeys => "there is no key to secure the message",
            Self::Takeover => "the other bridge may have sent or delivered it at a takeover",
        }
    }

    /// Returns whether the drop leaves a topic of another space with an older value than its writer
    /// has sent.
    pub(crate) const fn is_loss(self) -> bool {
        matches!(
            self,
            Self::Malformed
                | Self::Unsupported
                | Self::Invalid
                | Self::Mismatch
                | Self::NoValue
                | Self::Duplicate
                | Self::Stale
                | Self::Late
                | Self::TooBig
                | Self::Incomplete
                | Self::NoRoom
                | Self::NoKeyFrame
                | Self::Undescribed
                | Self::NotPublished
        )
    }

    /// Returns whether the drop belongs to normal traffic and needs no log entry, or is logged
    /// where it is counted.
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

/// The result for a sample.
#[must_use]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The sample waits in the queue of the topic for `poll_output`.
    Forward,
    /// The sample waits in the queue, and the oldest sample was dropped for it.
    ForwardAfterDroppingOldest,
    /// The sample is dropped.
    Drop(Reason),
}

/// The counters of a topic, or of datagrams without a topic.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Counters {
    /// Samples of the own space that were output as NetworkMessages.
    pub sent: u64,
    /// Samples of other spaces that were output to the local side.
    pub delivered: u64,
    /// Key frames repeated for late joiners.
    pub repeated: u64,
    /// DataSetMessages of other spaces that were not received, from the gaps in their sequence
    /// numbers.
    pub missing: u64,
    /// Metadata announcements sent.
    pub announced: u64,
    /// New metadata announcements received from the writer of another space.
    pub described: u64,
    /// Keep-alives sent.
    pub keep_alives: u64,
    /// Changes of the source address of values of another space.
    pub sender_changed: u64,
    /// Values that came later than the deadline after the value before.
    pub deadline_missed: u64,
    /// The drops by cause, sorted. A list, because most topics have few causes.
    dropped: Vec<(DropCause, u64)>,
}

/// The cause of a drop: the counted reason, and a case that the log distinguishes. Frequent drops
/// of one case do not hide rare drops of another case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct DropCause {
    pub(crate) reason: Reason,
    pub(crate) case: &'static str,
}

impl From<Reason> for DropCause {
    fn from(reason: Reason) -> Self {
        Self { reason, case: "" }
    }
}

impl From<(Reason, &'static str)> for DropCause {
    fn from((reason, case): (Reason, &'static str)) -> Self {
        Self { reason, case }
    }
}

impl Counters {
    /// Returns the number of drops for `reason`.
    #[must_use]
    pub fn dropped(&self, reason: Reason) -> u64 {
        self.drops()
            .find_map(|(each, count)| (each == reason).then_some(count))
            .unwrap_or_default()
    }

    /// Returns each reason that occurred with its count.
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

    /// Adds `count` drops and returns the total for the cause.
    pub(crate) fn add(&mut self, cause: impl Into<DropCause>, count: u64) -> u64 {
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

    /// Adds the counters of a topic that was removed.
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
            deadline_missed,
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
        self.deadline_missed += deadline_missed;
        for (DropCause { reason, .. }, count) in dropped {
            // A separate case, so that the inherited total does not delay the log entries of other
            // cases.
            self.add((*reason, "of a topic before"), *count);
        }
    }
}

/// Returns whether the `total`th occurrence is logged: the 1st, 10th, 100th and so on, so that a
/// flood causes few log entries.
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
