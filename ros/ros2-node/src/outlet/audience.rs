//! The readers that an outlet knows.

use super::settling::Settling;
use super::waiting::WaitingSample;

/// The readers of the topic.
#[derive(Debug)]
pub(super) enum TopicReaders {
    /// No reader. The history holds only the last state, for transient-local readers that appear
    /// later; volatile readers receive nothing that was written before. The history of the
    /// published RustDDS would keep all values without acknowledgement, so with it the state is
    /// held back until only transient-local readers have appeared.
    Nobody { held: Option<WaitingSample> },
    /// At least one reader, which receives samples of up to this size.
    Present {
        /// Set until written samples reach the readers.
        settling: Option<Settling>,
        /// The number of discovered readers.
        seen: usize,
        sample_size: usize,
    },
}
