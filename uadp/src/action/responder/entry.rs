//! A remembered request.

use alloc::boxed::Box;
use core::time::Duration;

use super::{KeptFields, RequestOrigin};
use crate::action::{ActionAddress, ActionDialect, ActionFields, ActionMessage};
use crate::{OwnedPublisherId, StatusCode};

/// Identity of a request (OPC 10000-14, 6.2.11.2.2).
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct ActionRequestKey {
    pub(super) requestor_id: Option<OwnedPublisherId>,
    pub(super) correlation_data: Option<Box<[u8]>>,
    pub(super) request_id: u16,
}

/// A request, from its first message until it expires.
#[derive(Debug)]
pub(super) struct RequestEntry<P> {
    pub(super) key: ActionRequestKey,
    pub(super) address: ActionAddress,
    pub(super) dialect: ActionDialect,
    pub(super) origin: RequestOrigin<P>,
    /// Hash that distinguishes its arguments from other arguments.
    pub(super) arguments: u64,
    pub(super) phase: Phase,
    /// Time of the last message or change.
    pub(super) touched: Duration,
    pub(super) last_sent: Option<Duration>,
    pub(super) next_send: Option<Duration>,
    pub(super) answer_bytes: usize,
    pub(super) wake: Duration,
}

#[derive(Debug)]
pub(super) enum Phase {
    Executing {
        deadline: Duration,
        /// The Requestor has abandoned the request.
        abandoned: bool,
        /// The passed deadline was recorded.
        overdue: bool,
    },
    Done {
        status: StatusCode,
        fields: KeptFields,
        /// Remaining number of unprompted repetitions.
        left: u32,
    },
    /// Acknowledged or ended. Remembered so that a late repetition does not count as a new request.
    Closed,
}

impl ActionRequestKey {
    pub(super) fn of(request: &ActionMessage<'_>) -> Self {
        Self {
            requestor_id: request.action.requestor_id.map(Into::into),
            correlation_data: request.action.correlation_data.map(Into::into),
            request_id: request.request_id,
        }
    }

    /// Returns the bytes that an entry uses, without its response.
    pub(super) fn cost(&self) -> usize {
        let id = match &self.requestor_id {
            Some(OwnedPublisherId::String(id)) => id.len(),
            Some(
                OwnedPublisherId::Byte(_)
                | OwnedPublisherId::UInt16(_)
                | OwnedPublisherId::UInt32(_)
                | OwnedPublisherId::UInt64(_),
            )
            | None => 0,
        };
        let correlation_data = self.correlation_data.as_ref().map_or(0, |data| data.len());
        // Key and id are stored in the entry and in the index.
        BOOKKEEPING + 2 * (id + correlation_data)
    }
}

impl Phase {
    pub(super) fn done(status: StatusCode, fields: ActionFields<'_>, left: u32) -> Self {
        Self::Done {
            status,
            fields: fields.into(),
            left,
        }
    }
}

impl<P> RequestEntry<P> {
    /// Schedules the state to be sent again, at least an interval after the last transmission.
    pub(super) fn answer(&mut self, now: Duration, interval: Duration) {
        if !self.can_be_said() {
            return;
        }
        let free = self
            .last_sent
            .map_or(now, |last| last.saturating_add(interval))
            .max(now);
        self.next_send = Some(self.next_send.map_or(free, |at| at.min(free)));
    }

    /// Returns true if the dialect can express the state. The UA-.NETStandard dialect has good
    /// responses only.
    fn can_be_said(&self) -> bool {
        match (self.dialect, &self.phase) {
            (ActionDialect::Standard, _) => true,
            (ActionDialect::UaNetStandard(_), Phase::Done { status, .. }) => {
                *status == StatusCode::GOOD
            }
            (ActionDialect::UaNetStandard(_), Phase::Executing { .. } | Phase::Closed) => false,
        }
    }

    /// Records that the state was sent, and schedules the next transmission.
    pub(super) fn sent(&mut self, now: Duration, interval: Duration) {
        self.last_sent = Some(now);
        let again = now.saturating_add(interval);
        self.next_send = match &mut self.phase {
            Phase::Executing {
                deadline,
                abandoned: false,
                ..
            } if again < *deadline => Some(again),
            Phase::Done { left, .. } if *left > 0 && self.dialect == ActionDialect::Standard => {
                *left -= 1;
                Some(again)
            }
            Phase::Executing { .. } | Phase::Done { .. } | Phase::Closed => None,
        };
    }

    /// Returns true once after the deadline of the execution has passed.
    pub(super) fn is_overdue(&mut self, now: Duration) -> bool {
        match &mut self.phase {
            Phase::Executing {
                deadline, overdue, ..
            } if now >= *deadline => !core::mem::replace(overdue, true),
            Phase::Executing { .. } | Phase::Done { .. } | Phase::Closed => false,
        }
    }

    /// Returns the time at which the request is forgotten.
    pub(super) fn expires(&self, remember: Duration) -> Duration {
        let since = match self.phase {
            Phase::Executing { deadline, .. } => deadline.max(self.touched),
            Phase::Done { .. } | Phase::Closed => self.touched,
        };
        since.saturating_add(remember)
    }

    pub(super) fn next_wake(&self, remember: Duration) -> Duration {
        let mut next = self.expires(remember);
        if let Phase::Executing {
            deadline,
            overdue: false,
            ..
        } = self.phase
        {
            next = next.min(deadline);
        }
        self.next_send.map_or(next, |at| at.min(next))
    }
}

/// Approximate bytes that an entry uses in all maps.
const BOOKKEEPING: usize = 384;
