//! Confirmations: a bridge confirms that an event of another space has reached a subscriber or a
//! service.
//!
//! A confirmation is an Action response without a request (OPC 10000-14, 7.2.4.5.10). The
//! PublisherId is the confirming space, WriterGroupId and DataSetWriterId are the ids of the event,
//! and the RequestorId is the PublisherId of the event. The ActionTargetId is 0, the RequestId is
//! the sequence number of the event, and the CorrelationData is its Timestamp and PicoSeconds.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::{SpaceId, TopicId, Variable};
use uadp::action::{
    ActionAddress, ActionDialect, ActionEncoder, ActionFields, ActionHeader, ActionKind,
    ActionMessage, ActionState, ActionToSend,
};
use uadp::{
    DateTime, EncodeError, Extras, NetworkHeader, OwnedPublisherId, PublisherId, Timestamp,
};

/// The outcome of an event that bridges confirm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ConfirmedArrival {
    /// Each space in the mapping of the event has confirmed it.
    Confirmed,
    /// These spaces have not confirmed the event in time. Its arrival there is unknown.
    Unknown(Vec<SpaceId>),
    /// The event was not sent.
    NotSent,
}

/// The state of a value that the local side accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Handover {
    /// At least one present subscriber, or the service of the value, has received it.
    Done,
    /// Unknown so far.
    Waiting,
    /// There is no subscriber or service.
    Nobody,
}

/// The spaces that confirm the events of a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Confirming {
    /// The time for which an event is repeated.
    pub(crate) within: Duration,
    pub(crate) spaces: Vec<SpaceId>,
}

/// An event of the own space that is not confirmed yet.
#[derive(Debug)]
pub(crate) struct AwaitedEvent {
    mark: Mark,
    /// The time at which the event is given up.
    pub(crate) until: Instant,
    /// The spaces that have not confirmed the event.
    pub(crate) spaces: Vec<SpaceId>,
}

/// The identity of an event among all events of its topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Mark {
    pub(crate) sequence: u16,
    /// Timestamp and PicoSeconds of its DataSetMessage.
    pub(crate) stamp: Timestamp,
}

/// The newest event of another space. The next event replaces it.
#[derive(Debug)]
pub(crate) struct Receipt {
    pub(crate) mark: Mark,
    /// The time at which the event was first received.
    since: Instant,
    state: State,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// The local side has not received it yet.
    Queued,
    /// The local side accepted it.
    Taken(Handover),
}

/// The reaction to a repetition of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Reply {
    /// Confirm it again.
    Confirm,
    /// Ask the local side for its handover.
    Ask,
    /// Pass the event to the local side again.
    HandOver,
    /// No reaction.
    Nothing,
}

/// The sender of the confirmations of a space.
#[derive(Debug)]
pub(crate) struct Confirmer {
    from: SocketAddr,
    /// Other senders that announced the space, the newest last.
    others: VecDeque<SocketAddr>,
    /// The time of the first confirmation of another sender after the last confirmation of `from`.
    doubted: Option<Instant>,
}

impl Confirming {
    /// Returns `None` if no space confirms the values of the variable.
    pub(crate) fn of(variable: Option<&Variable>) -> Option<Box<Self>> {
        let variable = variable?;
        let within = variable.confirmed_within?;
        let mut spaces: Vec<SpaceId> = variable.destinations().collect();
        spaces.sort_unstable();
        spaces.dedup();
        (!spaces.is_empty()).then(|| Box::new(Self { within, spaces }))
    }

    /// Returns the time in which the bridges have to confirm.
    pub(crate) const fn within(&self) -> Duration {
        self.within
    }

    pub(crate) fn await_event(&self, mark: Mark, now: Instant) -> AwaitedEvent {
        AwaitedEvent {
            mark,
            until: now + self.within,
            spaces: self.spaces.clone(),
        }
    }
}

impl AwaitedEvent {
    /// Returns whether the space has not confirmed the event yet.
    pub(crate) fn is_awaited(&self, mark: Mark, space: SpaceId) -> bool {
        self.mark == mark && self.spaces.contains(&space)
    }

    /// Records a confirmation, and returns whether it is the last missing confirmation.
    pub(crate) fn confirm(&mut self, space: SpaceId) -> bool {
        self.spaces.retain(|awaited| *awaited != space);
        self.spaces.is_empty()
    }
}

impl Receipt {
    pub(crate) const fn new(mark: Mark, now: Instant) -> Self {
        Self {
            mark,
            since: now,
            state: State::Queued,
        }
    }

    /// Records the handover.
    pub(crate) const fn handed(&mut self, handover: Handover) {
        self.state = State::Taken(handover);
    }

    /// Returns the reaction to a repetition. After `within` the writer has given the event up, so a
    /// delivery would be too late.
    pub(crate) fn repeated(&mut self, within: Duration, now: Instant) -> Reply {
        match self.state {
            State::Taken(Handover::Done) => Reply::Confirm,
            _ if now.saturating_duration_since(self.since) >= within => Reply::Nothing,
            State::Taken(Handover::Waiting) => Reply::Ask,
            State::Taken(Handover::Nobody) => {
                self.state = State::Queued;
                Reply::HandOver
            }
            State::Queued => Reply::Nothing,
        }
    }
}

impl Confirmer {
    pub(crate) const fn new(from: SocketAddr) -> Self {
        Self {
            from,
            others: VecDeque::new(),
            doubted: None,
        }
    }

    /// Records a sender that announces the space.
    pub(crate) fn announced(&mut self, from: SocketAddr) {
        if from == self.from {
            return;
        }
        self.others.retain(|other| *other != from);
        if self.others.len() >= MOST_OTHERS {
            self.others.pop_front();
        }
        self.others.push_back(from);
    }

    /// Returns whether a confirmation of an awaited event counts: its sender is the first that
    /// announced the space. Another sender that announced the space takes over when the first
    /// sender confirms nothing for [`SILENT`], as after a restart.
    pub(crate) fn counts(&mut self, from: SocketAddr, now: Instant) -> bool {
        if from == self.from {
            self.doubted = None;
            return true;
        }
        if !self.others.contains(&from) {
            return false;
        }
        let since = *self.doubted.get_or_insert(now);
        let passed = now.saturating_duration_since(since);
        if passed > FORGOTTEN {
            self.doubted = Some(now);
            return false;
        }
        if passed < SILENT {
            return false;
        }
        self.others.retain(|other| *other != from);
        let before = std::mem::replace(&mut self.from, from);
        self.announced(before);
        self.doubted = None;
        true
    }
}

/// Writes a confirmation of an event by the space `own`.
pub(crate) fn encode(
    own: SpaceId,
    (topic, mark): (TopicId, Mark),
    out: &mut Vec<u8>,
) -> Result<(), EncodeError> {
    let (space, namespace, writer_id) = topic.triple();
    let DateTime(ticks) = mark.stamp.time;
    let mut correlation = ticks.to_le_bytes().to_vec();
    correlation.extend_from_slice(&mark.stamp.picoseconds.to_le_bytes());
    let address = ActionAddress {
        publisher_id: OwnedPublisherId::UInt16(own.into()),
        writer_group_id: Some(namespace),
        writer_id,
        target_id: NO_TARGET,
    };
    let confirmation = ActionToSend {
        address: &address,
        action: ActionHeader {
            correlation_data: Some(&correlation),
            requestor_id: Some(PublisherId::UInt16(space)),
            ..ActionHeader::new(ActionKind::Response)
        },
        left: None,
        request_id: mark.sequence,
        call: 0,
        state: ActionState::Done,
        status: None,
        fields: ActionFields::NONE,
        dialect: ActionDialect::Standard,
    };
    confirmation
        .encode(out, &NetworkHeader::default(), &Extras::default())
        .and_then(ActionEncoder::finish)
}

/// Reads the event that a response confirms; `None` for a response to a request.
pub(crate) fn decode(response: &ActionMessage<'_>) -> Option<(TopicId, Mark)> {
    let Some(PublisherId::UInt16(space)) = response.action.requestor_id else {
        return None;
    };
    let correlation: &[u8; 10] = response.action.correlation_data?.try_into().ok()?;
    let (ticks, picoseconds) = correlation.split_first_chunk::<8>()?;
    let is_confirmation = response.action.kind == ActionKind::Response
        && response.target_id == NO_TARGET
        && response.state == ActionState::Done;
    let topic = TopicId::new(space, response.writer_group_id?, response.writer_id)?;
    let mark = Mark {
        sequence: response.request_id,
        stamp: Timestamp {
            time: DateTime(i64::from_le_bytes(*ticks)),
            picoseconds: u16::from_le_bytes(picoseconds.try_into().ok()?),
        },
    };
    is_confirmation.then_some((topic, mark))
}

/// The ActionTargetId of no Action.
const NO_TARGET: u16 = 0;
/// The time without a confirmation after which another sender takes over.
const SILENT: Duration = Duration::from_millis(300);
/// The maximum age of a doubt. An older doubt concerns another event.
const FORGOTTEN: Duration = Duration::from_secs(2);
/// The maximum number of recorded senders. It is limited, because each sender in the group can
/// announce a space.
const MOST_OTHERS: usize = 8;
