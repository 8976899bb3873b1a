//! One request that is remembered.

use std::time::Duration;

use super::{KeptFields, RequestOrigin};
use crate::action::{ActionAddress, ActionDialect, ActionFields, ActionMessage};
use crate::{OwnedPublisherId, StatusCode};

/// What a request is known by (OPC 10000-14, 6.2.11.2.2).
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Key {
    pub(super) requestor_id: Option<OwnedPublisherId>,
    pub(super) correlation_data: Option<Box<[u8]>>,
    pub(super) request_id: u16,
}

/// A request, from when it is first heard until it is forgotten.
#[derive(Debug)]
pub(super) struct Entry<P> {
    pub(super) key: Key,
    pub(super) address: ActionAddress,
    pub(super) dialect: ActionDialect,
    pub(super) origin: RequestOrigin<P>,
    /// Tells its arguments from others.
    pub(super) arguments: u64,
    pub(super) phase: Phase,
    /// When it was heard of or changed last.
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
        /// The Requestor wants it forgotten.
        abandoned: bool,
        /// That the deadline is past was told.
        overdue: bool,
    },
    Done {
        status: StatusCode,
        fields: KeptFields,
        /// How often it is said without being asked.
        left: u32,
    },
    /// Acknowledged or taken back. Remembered so that a late repetition is not taken for a new request.
    Closed,
}

impl Key {
    pub(super) fn of(request: &ActionMessage<'_>) -> Self {
        Self {
            requestor_id: request.action.requestor_id.map(Into::into),
            correlation_data: request.action.correlation_data.map(Into::into),
            request_id: request.request_id,
        }
    }

    /// Bytes an entry takes up, without its answer.
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
        // Key and id stand in the entry and beside it.
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

impl<P> Entry<P> {
    /// Says the state once more, but not within an interval of the last time.
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

    /// The one-shot dialect knows nothing but good answers.
    fn can_be_said(&self) -> bool {
        match (self.dialect, &self.phase) {
            (ActionDialect::Standard, _) => true,
            (ActionDialect::UaNetStandard(_), Phase::Done { status, .. }) => {
                *status == StatusCode::GOOD
            }
            (ActionDialect::UaNetStandard(_), Phase::Executing { .. } | Phase::Closed) => false,
        }
    }

    /// Notes that the state was said, and when it is said again.
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

    /// True once, when the deadline of the execution is past.
    pub(super) fn is_overdue(&mut self, now: Duration) -> bool {
        match &mut self.phase {
            Phase::Executing {
                deadline, overdue, ..
            } if now >= *deadline => !std::mem::replace(overdue, true),
            Phase::Executing { .. } | Phase::Done { .. } | Phase::Closed => false,
        }
    }

    /// When it is forgotten.
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

/// About what an entry takes up in the maps it stands in.
const BOOKKEEPING: usize = 384;
