//! Properties of a value at the cell's server: maximum age and confirmation.

use std::time::Duration;

use crate::topic::TopicId;

/// Times after which the cell's server shows a value as uncertain or bad, because no newer value
/// comes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ages {
    /// The value is uncertain if no newer value has come for this long; `None` as long as its
    /// writer is not lost.
    pub uncertain_after: Option<Duration>,
    /// The value is bad if it has been uncertain for this long; `None` for never.
    pub bad_after: Option<Duration>,
    /// The longest time between two values, which each program checks; `None` for no limit.
    pub deadline: Option<Duration>,
}

impl Ages {
    /// Returns the ages, with the default for an age that is not given.
    #[must_use]
    pub fn or(self, bad_after: Option<Duration>) -> Self {
        Self {
            bad_after: self.bad_after.or(bad_after),
            ..self
        }
    }
}

/// Value of the robot that confirms that a value written by a client has arrived.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Confirm {
    /// Topic of the value that confirms.
    pub by: TopicId,
    /// Longest time for the confirmation.
    pub within: Duration,
    /// Values that are a confirmation.
    pub answer: ConfirmingValues,
}

/// Values that confirm a written value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ConfirmingValues {
    /// A value that equals the written value.
    Same,
    /// Every value that comes.
    Any,
    /// This value: `true` or `false`, a number, or a text.
    Equals(String),
}

/// Size of the server's history.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct History {
    /// Number of values of each variable without a number of its own.
    pub values: u16,
    /// Bytes of all values together.
    pub bytes: usize,
}

impl Default for History {
    fn default() -> Self {
        Self {
            values: 1_000,
            bytes: 64 << 20,
        }
    }
}
