//! What became of the samples that were offered to an outlet.

/// The progress of the samples that were offered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutletProgress {
    /// The topic has no reader.
    NoReader,
    /// Samples wait for readers or for room in the send window, or were dropped because a reader is
    /// out of reach.
    Waiting,
    /// Every sample was written.
    Written,
}

/// The reason for which a sample was not delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutletRefusal {
    /// The send window and the queue are full: the oldest waiting sample was dropped for this
    /// sample.
    Overflow,
    /// Larger than this number of bytes, which readers of this topic certainly receive
    /// ([`limits`](crate::limits)). Not written.
    TooLarge(usize),
    /// An event without a present reader.
    NoReader,
    /// The sample expired while it waited for its readers.
    Late,
    /// RustDDS failed, which happens only when one of its threads has died.
    Failed,
}

impl OutletRefusal {
    /// Returns the label under which the refusal is counted.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Overflow => "subscriber too slow",
            Self::TooLarge(_) => "too large for DDS",
            Self::NoReader => "no subscriber is present",
            Self::Late => "subscriber not ready in time",
            Self::Failed => "DDS writer failed",
        }
    }
}
