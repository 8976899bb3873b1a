//! What the messages of every action say: ids, statuses, and requests to cancel.

use std::fmt;

use crate::clock::RosTime;

/// Tells a goal from all others, as its client has chosen it (`unique_identifier_msgs/UUID`).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct GoalId([u8; 16]);

impl GoalId {
    /// Of its 16 bytes.
    #[must_use]
    pub const fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(bytes)
    }

    /// Its 16 bytes.
    #[must_use]
    pub const fn to_bytes(self) -> [u8; 16] {
        self.0
    }
}

/// As `ros2 action` prints it: 32 hexadecimal digits.
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

/// How far a goal is (`action_msgs/GoalStatus`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Status {
    /// Nobody knows the goal.
    Unknown,
    /// Accepted, and work has not begun.
    Accepted,
    /// At work.
    Executing,
    /// At work to end it as cancelled, which a client asked for and the server agreed to.
    Canceling,
    /// Ended: reached.
    Succeeded,
    /// Ended: cancelled.
    Canceled,
    /// Ended: failed.
    Aborted,
}

impl Status {
    /// The code in messages.
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

    /// Of the code in a message; `None` for one that is none.
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

    /// Whether nothing follows.
    #[must_use]
    pub const fn is_terminal(self) -> bool {
        matches!(self, Self::Succeeded | Self::Canceled | Self::Aborted)
    }
}

/// A goal, and when it was accepted by the clock of its server (`action_msgs/GoalInfo`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GoalInfo {
    /// The goal.
    pub id: GoalId,
    /// When it was accepted.
    pub stamp: RosTime,
}

/// Which goals to cancel (`action_msgs/CancelGoal`, request).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CancelWhat {
    /// All.
    All,
    /// This one.
    Goal(GoalId),
    /// All that were accepted then or before, by the clock of the server.
    Until(RosTime),
    /// Both this one and all that were accepted then or before.
    GoalAndUntil(GoalId, RosTime),
}

/// What a server says to a request to cancel (`action_msgs/CancelGoal`, `return_code`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CancelCode {
    /// The goals named are being cancelled; there may be none where no one goal was asked for.
    None,
    /// The server goes on with all of them.
    Rejected,
    /// There is no such goal.
    UnknownGoal,
    /// The goal has ended, or is being cancelled already.
    Terminated,
}

impl CancelCode {
    /// The code in messages.
    #[must_use]
    pub const fn code(self) -> i8 {
        match self {
            Self::None => 0,
            Self::Rejected => 1,
            Self::UnknownGoal => 2,
            Self::Terminated => 3,
        }
    }

    /// Of the code in a message; `None` for one that is none.
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

/// The answer to a request to cancel (`action_msgs/CancelGoal`, response).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CancelAnswer {
    /// What the server says.
    pub code: CancelCode,
    /// The goals that are being cancelled now. How they end is told with their results.
    pub goals: Vec<GoalInfo>,
}

impl CancelAnswer {
    /// The answer to that request. A server of rclpy that goes on with a goal says no more than which goals it cancels,
    /// and that is not among them.
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
            let stamp = RosTime::default();
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
        // Where more than one may be meant, none may be there.
        assert_eq!(code(none.clone(), CancelWhat::All), CancelCode::None);
        assert_eq!(
            code(none, CancelWhat::Until(RosTime::default())),
            CancelCode::None
        );
        let known = answer(CancelCode::None, Some(one));
        assert_eq!(code(known.clone(), CancelWhat::Goal(one)), CancelCode::None);
        assert_eq!(code(known, CancelWhat::Goal(other)), CancelCode::Rejected);
        let ended = answer(CancelCode::Terminated, None);
        assert_eq!(code(ended, CancelWhat::Goal(one)), CancelCode::Terminated);
    }
}
