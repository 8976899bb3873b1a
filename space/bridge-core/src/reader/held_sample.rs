//! A sample that waits for its local type.

use std::time::Instant;

use uadp::Timestamp;

/// A sample received before its local type was known. Only the newest sample is held.
#[derive(Debug)]
pub(crate) struct HeldSample {
    pub(crate) fields: Vec<u8>,
    pub(crate) source: Option<Timestamp>,
    pub(crate) instance: Option<Timestamp>,
    pub(crate) status: u16,
    pub(crate) lasting: bool,
    /// The time at which an event is too old for delivery, and at which a large sample is removed.
    pub(crate) until: Instant,
}

impl HeldSample {
    /// Returns whether the sample counts towards the limit for large samples.
    pub(crate) const fn is_large(&self) -> bool {
        self.fields.len() > MAX_SMALL
    }

    /// Returns the time at which the sample is removed, if it is large.
    pub(crate) fn expires(&self) -> Option<Instant> {
        self.is_large().then_some(self.until)
    }
}

/// The maximum size of a sample that may wait for its local type in each topic. It is small,
/// because any sender in the group can invent topics, and all of them together must not occupy more
/// than some megabytes.
const MAX_SMALL: usize = 4_096;
