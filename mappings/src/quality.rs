//! What the server of the cell is to know of a value: how old it may become, and what confirms it.

use std::time::Duration;

use crate::topic::TopicId;

/// When the cell's server no longer shows a value as good, because no newer one comes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ages {
    /// It is uncertain when no newer one has come for this long; `None` while its writer is heard.
    pub uncertain_after: Option<Duration>,
    /// It is bad when it has been uncertain for this long; `None` never.
    pub bad_after: Option<Duration>,
}

impl Ages {
    /// The same, with the default for what is not said.
    #[must_use]
    pub fn or(self, bad_after: Option<Duration>) -> Self {
        Self {
            bad_after: self.bad_after.or(bad_after),
            ..self
        }
    }
}

/// The value of the robot that says that a value which a client wrote has arrived.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Confirm {
    /// The value that answers.
    pub by: TopicId,
    /// How long that may take.
    pub within: Duration,
    /// Which value of it is an answer.
    pub answer: Answer,
}

/// Which value confirms what was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer {
    /// One that equals it.
    Same,
    /// Each that comes.
    Any,
    /// That one: `true` or `false`, a number, or a text.
    Equals(String),
}

/// How much the server keeps of what was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct History {
    /// Values of each variable that says nothing else.
    pub values: u16,
    /// Bytes of all of them together.
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
