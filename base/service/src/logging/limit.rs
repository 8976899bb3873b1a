//! Limits the log lines that one callsite writes. Messages of peers cause most log lines, so a peer
//! in a loop could fill a disk. A callsite that knows the cause limits by it with `LogLimit`; this
//! is the general limit.

use std::cell::Cell;
use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use log_limit::Throttle;
use tracing::callsite::Identifier;
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::layer::{Context, Filter};

use crate::clock::now;

/// Admits [`MOST`] messages per callsite and [`PERIOD`]. Debug and trace levels are not limited,
/// because the operator has enabled them.
#[derive(Debug, Default)]
pub(super) struct PerCallsite {
    throttles: Mutex<HashMap<Identifier, Throttle>>,
    /// Whether the count of suppressed messages is for [`take_suppressed`].
    is_counted: bool,
}

impl PerCallsite {
    /// Returns the limit for the layer that also writes the number of suppressed messages.
    pub(super) fn counted() -> Self {
        Self {
            is_counted: true,
            ..Self::default()
        }
    }
}

impl<S: Subscriber> Filter<S> for PerCallsite {
    fn enabled(&self, _: &Metadata<'_>, _: &Context<'_, S>) -> bool {
        true
    }

    fn event_enabled(&self, event: &Event<'_>, _: &Context<'_, S>) -> bool {
        let metadata = event.metadata();
        if *metadata.level() > Level::INFO {
            return true;
        }
        let mut throttles = self
            .throttles
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let throttle = throttles
            .entry(metadata.callsite())
            .or_insert_with(|| Throttle::several(MOST, PERIOD));
        let admitted = throttle.admit(now());
        drop(throttles);
        if self.is_counted {
            SUPPRESSED.set(admitted.unwrap_or_default());
        }
        admitted.is_some()
    }
}

/// Returns the number of messages that were suppressed before the message that this thread writes.
pub(super) fn take_suppressed() -> u64 {
    SUPPRESSED.take()
}

thread_local! {
    /// An event is filtered and written on the same thread.
    static SUPPRESSED: Cell<u64> = const { Cell::new(0) };
}

/// The maximal number of messages of one callsite in a [`PERIOD`].
pub(super) const MOST: u32 = 300;
const PERIOD: Duration = Duration::from_secs(60);
