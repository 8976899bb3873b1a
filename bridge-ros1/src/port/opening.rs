//! Events of topics that were advertised a moment ago: they wait for subscribers to connect.

use std::time::Duration;

use bridge_node::policy::NO_SUBSCRIBER;
use bridge_node::{PortEvent, Reason};
use mappings::TopicId;
use tokio::time::{Instant, sleep_until};

use super::Ros1Port;

impl Ros1Port {
    /// Publishes events that need not wait for subscribers any longer.
    pub(super) fn flush(&mut self) {
        let now = bridge_node::now().monotonic;
        let mut unheard = Vec::new();
        let sinks = &mut self.sinks;
        self.opening.retain(|topic| {
            let sink = sinks.get_mut(topic);
            let Some(open) = sink.and_then(|sink| sink.open.as_mut()) else {
                return false;
            };
            unheard.push((*topic, open.look_at_opening(now)));
            open.opening.as_ref().is_some_and(|of| !of.is_empty())
        });
        for (topic, count) in unheard {
            self.unheard(topic, count);
        }
        self.flush_at = (!self.opening.is_empty()).then(|| Instant::now() + FLUSH);
    }

    /// Drops events that wait for subscribers, because another bridge publishes.
    pub(super) fn drop_opening(&mut self) {
        for (topic, sink) in &mut self.sinks {
            let opening = sink.open.as_mut().and_then(|open| open.opening.as_mut());
            let count = opening.map_or(0, |opening| opening.drop_waiting());
            if count > 0 {
                self.events.push_back(PortEvent::Lost {
                    topic: Some(*topic),
                    reason: Reason::Takeover,
                    why: "waited for a subscriber",
                    count,
                });
            }
        }
        self.flush_at = None;
        self.opening.clear();
    }

    /// Reports events that no subscriber was there for.
    pub(super) fn unheard(&mut self, topic: TopicId, count: u64) {
        if count > 0 {
            self.events.push_back(PortEvent::Lost {
                topic: Some(topic),
                reason: Reason::NoSubscriber,
                why: NO_SUBSCRIBER,
                count,
            });
        }
    }
}

/// Returns at that time, or never.
pub(super) async fn until(at: Option<Instant>) {
    match at {
        Some(at) => sleep_until(at).await,
        None => std::future::pending().await,
    }
}

/// How often events look for the subscribers that they wait for.
pub(super) const FLUSH: Duration = Duration::from_millis(10);
