//! The samples of a topic that wait for readers or for the send window.

use std::collections::VecDeque;

use rustdds::Timestamp;
use tokio::time::Instant;

use crate::raw::Payload;

/// A sample for the readers of a topic.
#[derive(Debug, Clone)]
pub(super) struct WaitingSample {
    pub(super) payload: Payload,
    pub(super) source: Option<Timestamp>,
    /// Whether late readers receive the sample.
    pub(super) lasting: bool,
    /// The time at which the sample expires.
    pub(super) until: Option<Instant>,
}

/// The waiting samples, oldest first.
#[derive(Debug, Default)]
pub(super) struct UnsentSamples {
    samples: VecDeque<WaitingSample>,
    /// A time before which no waiting sample expires.
    expires: Option<Instant>,
    /// Whether an expired sample was dropped and not reported yet.
    has_late: bool,
}

impl UnsentSamples {
    pub(super) fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    pub(super) fn len(&self) -> usize {
        self.samples.len()
    }

    /// Returns the size of all waiting samples.
    pub(super) fn bytes(&self) -> usize {
        self.samples.iter().map(|s| s.payload.len()).sum()
    }

    /// Adds the newest sample.
    pub(super) fn push(&mut self, sample: WaitingSample) {
        self.expires = self.expires.into_iter().chain(sample.until).min();
        self.samples.push_back(sample);
    }

    /// Takes the oldest sample.
    pub(super) fn pop(&mut self) -> Option<WaitingSample> {
        self.samples.pop_front()
    }

    /// Returns the oldest sample, which could not be written.
    pub(super) fn put_back(&mut self, sample: WaitingSample) {
        self.samples.push_front(sample);
    }

    /// Takes the newest sample, and drops all others.
    pub(super) fn take_newest(&mut self) -> Option<WaitingSample> {
        self.samples.drain(..).next_back()
    }

    pub(super) fn clear(&mut self) {
        self.samples.clear();
    }

    /// Withholds the samples from late readers.
    pub(super) fn forget(&mut self) {
        for sample in &mut self.samples {
            sample.lasting = false;
        }
    }

    /// Drops the samples that have expired. Looks at them only if one can have expired, since this
    /// is called for each sample.
    pub(super) fn drop_expired(&mut self, now: Instant) {
        let is_over = |until: Option<Instant>| until.is_some_and(|until| until <= now);
        if !is_over(self.expires) {
            return;
        }
        let before = self.samples.len();
        self.samples.retain(|sample| !is_over(sample.until));
        self.has_late |= self.samples.len() < before;
        self.expires = self.samples.iter().filter_map(|sample| sample.until).min();
    }

    /// Returns whether samples have expired since the last call.
    pub(super) fn take_late(&mut self) -> bool {
        std::mem::take(&mut self.has_late)
    }
}
