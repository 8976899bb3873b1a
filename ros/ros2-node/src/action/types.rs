//! The types that the messages of every action share: goal ids, statuses, and cancel requests.

use std::fmt;

use crate::clock::Ros2Time;

/// The id of a goal, chosen by its client (`unique_identifier_msgs/UUID`).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct GoalId([u8; 16]);

impl GoalId {
    /// Creates an id from its 16 bytes.
    #[must_use]
    pub const fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(bytes)
    }

    /// Returns the 16 bytes of the id.
    #[must_use]
    pub const fn to_bytes(self) -> [u8; 16] {
        self.0
    }
}

/// Formats the id as `ros2 action` does: 32 hexadecimal digits.
impl fmt::Display for GoalId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for GoalId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// The status of a goal (`action_msgs/GoalStatus`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum GoalStatusCode {
    /// The goal is unknown.
    Unknown,
    /// The goal is accepted, and its execution has not started.
    Accepted,
    /// The goal is executing.
    Executing,
    /// The goal is being canceled: a client requested it and the server agreed.
    Canceling,
    /// The goal has ended successfully.
    Succeeded,
    /// The goal has ended as canceled.
    Canceled,
    /// The goal has ended with a failure.
    Aborted,
}

impl GoalStatusCode {
    /// Returns the code used in messages.
    #[must_use]
    pub const fn code(self) -> i8 {
        match self {
            Self::Unknown => 0,
            Self::Accepted => 1,
            Self::Executing => 2,
            Self::Canceling => 3,
            Self::Succeeded => 4,
            Self::Canceled => 5,
            Self::Aborted => 6,
        }
    }

    /// Returns the status with this code; `None` for an unknown code.
    #[must_use]
    pub const fn from_code(code: i8) -> Option<Self> {
        Some(match code {
            0 => Self::Unknown,
            1 => Self::Accepted,
            2 => Self::Executing,
            3 => Self::Canceling,
            4 => Self::Succeeded,
            5 => Self::Canceled,
            6 => Self::Aborted,
            _ => return None,
        })
    }

    /// Returns whether the status is terminal.
    #[must_use]
    pub const fn is_terminal(self) -> bool {
        matches!(self, Self::Succeeded | Self::Canceled | Self::Aborted)
    }
}

/// A goal and the time of its acceptance by the clock of its server (`action_msgs/GoalInfo`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GoalInfo {
    /// The id of the goal.
    pub id: GoalId,
    /// The time of acceptance.
    pub stamp: Ros2Time,
}

/// Selects goals to cancel (`action_msgs/CancelGoal`, request).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CancelWhat {
    /// All goals.
    All,
    /// The goal with this id.
    Goal(GoalId),
    /// All goals accepted at or before this time of the server's clock.
    Until(Ros2Time),
    /// The goal with this id and all goals accepted at or before this time.
    GoalAndUntil(GoalId, Ros2Time),
}

/// The server's response code to a cancel request (`action_msgs/CancelGoal`, `return_code`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CancelCode {
    /// The named goals are being canceled; the list may be empty if the request selected goals
    /// other than by a single id.
    None,
    /// The server cancels no goal.
    Rejected,
    /// The goal is unknown.
    UnknownGoal,
    /// The goal has ended, or is being canceled already.
    Terminated,
}

impl CancelCode {
    /// Returns the code used in messages.
    #[must_use]
    pub const fn code(self) -> i8 {
        match self {
            Self::None => 0,
            Self::Rejected => 1,
            Self::UnknownGoal => 2,
            Self::Terminated => 3,
        }
    }

    /// Returns the response code with this number; `None` for an unknown number.
    #[must_use]
    pub const fn from_code(code: i8) -> Option<Self> {
        Some(match code {
            0 => Self::None,
            1 => Self::Rejected,
            2 => Self::UnknownGoal,
            3 => Self::Terminated,
            _ => return None,
        })
    }
}

/// The response to a cancel request (`action_msgs/CancelGoal`, response).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CancelAnswer {
    /// The response code.
    pub code: CancelCode,
    /// The goals that are being canceled. Their results report their ends.
    pub goals: Vec<GoalInfo>,
}

impl CancelAnswer {
    /// Adjusts the response to the request. A server of rclpy that refuses to cancel a goal only
    /// leaves the goal out of the list of canceled goals.
    pub(super) fn to(self, what: CancelWhat) -> Self {
        match what {
            CancelWhat::Goal(id)
                if self.code == CancelCode::None && self.goals.iter().all(|info| info.id != id) =>
            {
                let code = CancelCode::Rejected;
                Self { code, ..self }
            }
            CancelWhat::Goal(_)
            | CancelWhat::All
            | CancelWhat::Until(_)
            | CancelWhat::GoalAndUntil(..) => self,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_goal_that_is_not_among_those_cancelled_is_rejected() {
        let [one, other] = [1, 2].map(|byte| GoalId::from_bytes([byte; 16]));
        let answer = |code, id: Option<GoalId>| {
            let stamp = Ros2Time::default();
            let goals = id.map(|id| GoalInfo { id, stamp });
            let goals = goals.into_iter().collect();
            CancelAnswer { code, goals }
        };
        let code = |said: CancelAnswer, what| said.to(what).code;
        let none = answer(CancelCode::None, None);
        assert_eq!(
            code(none.clone(), CancelWhat::Goal(one)),
            CancelCode::Rejected
        );
        // A request that may select several goals may select none.
        assert_eq!(code(none.clone(), CancelWhat::All), CancelCode::None);
        assert_eq!(
            code(none, CancelWhat::Until(Ros2Time::default())),
            CancelCode::None
        );
        let known = answer(CancelCode::None, Some(one));
        assert_eq!(code(known.clone(), CancelWhat::Goal(one)), CancelCode::None);
        assert_eq!(code(known, CancelWhat::Goal(other)), CancelCode::Rejected);
        let ended = answer(CancelCode::Terminated, None);
        assert_eq!(code(ended, CancelWhat::Goal(one)), CancelCode::Terminated);
    }
}
