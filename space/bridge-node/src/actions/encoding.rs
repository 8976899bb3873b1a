//! Encoding of the calls and values of an action that is executed here, on the wire of its port.

use std::sync::Arc;

use bytes::Bytes;
use messages::{ActionCalls, Wire};

use super::block;
use super::graph::{GraphCancelResponse, GraphGoalId};
use super::wire::{self, CancelSelection, GoalAnswer};

/// The encoding of an action.
#[derive(Debug, Clone)]
pub(super) enum Encoding {
    /// ROS 1 or ROS 2 messages of these types.
    Ros(Wire, Arc<ActionCalls>),
    /// Blocks of OPC UA fields.
    Fields {
        /// The fields of an empty result.
        empty_result: Bytes,
    },
}

impl Encoding {
    /// Splits a request into the id and the goal behind it.
    pub(super) fn split(&self, request: &[u8]) -> Option<(GraphGoalId, Bytes)> {
        match self {
            Self::Ros(wire, _) => wire::split(*wire, request),
            Self::Fields { .. } => block::split(request),
        }
    }

    /// Joins an id and the feedback behind it.
    pub(super) fn join(&self, id: GraphGoalId, body: &[u8]) -> Option<Bytes> {
        match self {
            Self::Ros(wire, _) => wire::join(*wire, id, body),
            Self::Fields { .. } => block::join(id, body),
        }
    }

    pub(super) fn goal_answer(&self, answer: &GoalAnswer) -> Bytes {
        match self {
            Self::Ros(wire, _) => wire::goal_answer(*wire, answer),
            Self::Fields { .. } => block::goal_answer(answer),
        }
    }

    pub(super) fn read_result_request(&self, request: &[u8]) -> Option<GraphGoalId> {
        match self {
            Self::Ros(wire, _) => wire::read_result_request(*wire, request),
            Self::Fields { .. } => block::split(request).map(|(id, _)| id),
        }
    }

    pub(super) fn read_cancel_request(&self, request: &[u8]) -> Option<CancelSelection> {
        match self {
            Self::Ros(wire, _) => wire::read_cancel_request(*wire, request),
            Self::Fields { .. } => block::read_cancel_request(request),
        }
    }

    pub(super) fn cancel_answer(&self, answer: &GraphCancelResponse) -> Bytes {
        match self {
            Self::Ros(wire, _) => wire::cancel_answer(*wire, answer),
            Self::Fields { .. } => block::cancel_answer(answer),
        }
    }

    /// Encodes the response with a result. Returns `None` if the result does not have this
    /// encoding.
    pub(super) fn result_answer(&self, said: (i8, &str), result: &[u8]) -> Option<Bytes> {
        match self {
            Self::Ros(wire, _) => wire::result_answer(*wire, said, result),
            Self::Fields { .. } => block::result_answer(said, result),
        }
    }

    /// Encodes the response without a result: all fields of the result are zero or empty. Returns
    /// `None` if the response cannot be encoded.
    pub(super) fn empty_result_answer(&self, said: (i8, &str)) -> Option<Bytes> {
        match self {
            Self::Ros(wire, calls) => wire::empty_result_answer(*wire, calls, said).ok(),
            Self::Fields { empty_result } => block::result_answer(said, empty_result),
        }
    }

    /// Encodes the value with the goal statuses.
    pub(super) fn statuses(&self, goals: &[(GraphGoalId, i8)]) -> Bytes {
        match self {
            Self::Ros(wire, _) => wire::statuses(*wire, goals),
            Self::Fields { .. } => block::statuses(goals),
        }
    }
}
