//! The values that clients write, from the write to its confirmation.

use std::collections::VecDeque;
use std::sync::Arc;

use bridge_node::{ConfirmedArrival, PortEvent, Reason, Router, Verdict};
use mappings::{Mapping, SpaceId, TopicId};
use tokio::sync::mpsc;

use crate::arrivals::PendingWrite;
use crate::commanders::{Commander, Commanders};
use crate::confirm::Confirms;
use crate::layout::Layout;
use crate::leaving::{Departure, Leaving};
use crate::nodes::ClientWrite;

/// The values that clients write.
pub(super) struct ClientWrites {
    writes: mpsc::Receiver<ClientWrite>,
    /// Topics that clients can write, with a start or end of production that is not reported yet.
    live: VecDeque<(TopicId, bool)>,
    /// Writes that wait for a confirmation.
    confirms: Arc<Confirms>,
    /// The sessions that wrote commands. Their topics are stopped when the session is lost.
    commanders: Commanders,
    /// The written values that are not sent yet.
    leaving: Leaving,
}

impl ClientWrites {
    /// Creates the state for the topics of the layout that clients can write.
    pub(super) fn new(
        (mapping, layout): (&Mapping, &Layout),
        writes: mpsc::Receiver<ClientWrite>,
        confirms: Arc<Confirms>,
    ) -> Self {
        let topics = written(layout.topics.iter().map(|node| node.topic));
        Self {
            writes,
            live: topics.map(|topic| (topic, true)).collect(),
            confirms,
            commanders: Commanders::new(mapping),
            leaving: Leaving::default(),
        }
    }

    /// Returns whether the results of written values are to be polled.
    pub(super) fn polls(&mut self) -> bool {
        self.leaving.polls()
    }

    /// Records the verdict of the run loop for the reported value.
    pub(super) fn handled(&mut self, topic: TopicId, verdict: Verdict, router: &Router) {
        self.leaving.handled(topic, verdict, router.unsent(topic));
    }

    /// Records the result of sending a datagram.
    pub(super) fn left(&mut self, topic: TopicId, sent: Result<(), Reason>, router: &Router) {
        self.leaving.left(topic, sent, router.unsent(topic));
    }

    /// Records that the run loop has sent all values that do not wait.
    pub(super) fn drained(&mut self, is_muted: bool, router: &Router) {
        self.leaving.drained(is_muted, |topic| router.unsent(topic));
    }

    /// Returns the next start or end of the production of a topic.
    pub(super) fn next_live(&mut self) -> Option<PortEvent> {
        let (topic, live) = self.live.pop_front()?;
        Some(PortEvent::Live { topic, live })
    }

    /// Waits for a write. Returns `None` after the end of commands, which
    /// [`next_live`](Self::next_live) then returns. Cancel-safe.
    pub(super) async fn recv(&mut self) -> Option<ClientWrite> {
        tokio::select! {
            Some(write) = self.writes.recv() => return Some(write),
            lost = self.commanders.lost() => {
                // The bridges publish `on_loss` when the writer goes silent.
                self.live.extend(lost.into_iter().map(|topic| (topic, false)));
            }
            () = self.confirms.called() => {
                let taken_back = self.confirms.take_back().into_iter();
                self.live.extend(taken_back.map(|topic| (topic, false)));
            }
        }
        None
    }

    /// Begins the way of a write to the group. `departure` receives the result of sending, and
    /// `awaited` the confirmation.
    pub(super) fn begin(
        &mut self,
        (topic, commander): (TopicId, Commander),
        departure: Departure,
        awaited: Option<PendingWrite>,
    ) {
        self.commanders.wrote(topic, commander);
        self.leaving.add(departure);
        self.confirms.supersede(topic);
        self.confirms.arrivals.sent(topic, awaited);
    }

    /// Records the outcome of a write.
    pub(super) fn settled(&self, topic: TopicId, arrival: &ConfirmedArrival) {
        self.confirms.arrivals.settled(topic, arrival);
    }

    /// Records that a client enabled or disabled the writer of a topic.
    pub(super) fn switch(&mut self, topic: TopicId, on: bool) {
        self.live.push_back((topic, on));
    }

    /// Follows a change of the mapping.
    pub(super) fn follow(&mut self, mapping: &Mapping) {
        self.confirms.follow(mapping);
        self.commanders.follow(mapping);
    }

    /// Follows a change of the topics of the address space.
    pub(super) fn exchange(&mut self, gone: &[TopicId], new: Vec<TopicId>) {
        self.live.retain(|(topic, _)| !gone.contains(topic));
        let new = written(new.into_iter());
        self.live.extend(new.map(|topic| (topic, true)));
    }
}

/// Returns the topics that clients can write.
fn written(topics: impl Iterator<Item = TopicId>) -> impl Iterator<Item = TopicId> {
    topics.filter(|topic| topic.space == SpaceId::UA)
}
