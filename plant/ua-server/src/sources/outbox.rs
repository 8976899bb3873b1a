//! What waits to be written to one server.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use bytes::Bytes;
use mappings::{Overflow, TopicId};
use opcua::sync::Mutex;
use tokio::sync::Notify;

use super::state::{State, Way};
use super::{Plan, Write};

/// Values on their way to one server, as fields. Of a state the newest waits, also for a server that is away, and is written
/// anew when it comes back; events are written while the server is there, or not at all.
pub(super) struct Outbox {
    waiting: Mutex<Waiting>,
    /// Something waits.
    pub(super) filled: Notify,
    pub(super) state: Arc<State>,
}

#[derive(Default)]
struct Waiting {
    topics: HashMap<TopicId, Lane>,
    /// Whose turn it is.
    turns: VecDeque<TopicId>,
    up: bool,
}

/// One variable.
struct Lane {
    write: Arc<Write>,
    values: VecDeque<Bytes>,
    /// The last value of a state.
    last: Option<Bytes>,
}

impl Outbox {
    pub(super) fn new(state: Arc<State>) -> Self {
        Self {
            waiting: Mutex::default(),
            filled: Notify::new(),
            state,
        }
    }

    /// Goes over to what another mapping wants. What waits for the same node goes on waiting.
    pub(super) fn plan(&self, plan: &Plan) {
        let mut waiting = self.waiting.lock();
        let mut before = std::mem::take(&mut waiting.topics);
        for write in &plan.writes {
            let lane = before.remove(&write.topic);
            let lane = lane.filter(|lane| lane.write == *write).unwrap_or(Lane {
                write: Arc::clone(write),
                values: VecDeque::new(),
                last: None,
            });
            waiting.topics.insert(write.topic, lane);
        }
        let Waiting { topics, turns, .. } = &mut *waiting;
        turns.retain(|topic| topics.contains_key(topic));
    }

    /// A value to be written.
    pub(super) fn put(&self, topic: TopicId, block: &[u8]) {
        let mut waiting = self.waiting.lock();
        let up = waiting.up;
        let Some(lane) = waiting.topics.get_mut(&topic) else {
            return;
        };
        let block = Bytes::copy_from_slice(block);
        let mut dropped = 0;
        match lane.write.overflow {
            Overflow::KeepLatest => {
                dropped = lane.values.len();
                lane.values.clear();
                lane.last = Some(block.clone());
                lane.values.push_back(block);
            }
            Overflow::DropOldest(depth) if up => {
                lane.values.push_back(block);
                let depth = usize::from(depth.get()).min(MOST_EVENTS);
                while lane.values.len() > depth {
                    lane.values.pop_front();
                    dropped += 1;
                }
            }
            Overflow::DropOldest(_) => dropped = 1,
        }
        if !waiting.turns.contains(&topic) {
            waiting.turns.push_back(topic);
        }
        drop(waiting);
        if dropped > 0 {
            self.state.not_written(count(dropped));
        }
        self.filled.notify_one();
    }

    /// The last value of a topic is not to be written again.
    pub(super) fn forget(&self, topic: TopicId) {
        if let Some(lane) = self.waiting.lock().topics.get_mut(&topic) {
            lane.last = None;
        }
    }

    /// The server is there, or there again: it is told the state of the cell.
    pub(super) fn up(&self) {
        let mut waiting = self.waiting.lock();
        waiting.up = true;
        let Waiting { topics, turns, .. } = &mut *waiting;
        for (topic, lane) in topics {
            if lane.values.is_empty() {
                lane.values.extend(lane.last.clone());
            }
            if !lane.values.is_empty() && !turns.contains(topic) {
                turns.push_back(*topic);
            }
        }
        self.filled.notify_one();
    }

    /// The server is away: no event waits for it.
    pub(super) fn down(&self) {
        let mut waiting = self.waiting.lock();
        waiting.up = false;
        let mut dropped = 0;
        for lane in waiting.topics.values_mut() {
            if lane.write.overflow != Overflow::KeepLatest {
                dropped += lane.values.len();
                lane.values.clear();
            }
        }
        drop(waiting);
        if dropped > 0 {
            self.state.not_written(count(dropped));
        }
    }

    /// The next values to be written, each of another variable.
    pub(super) fn take(&self, most: usize) -> Vec<(Arc<Write>, Bytes)> {
        let mut waiting = self.waiting.lock();
        let mut taken = Vec::new();
        for _ in 0..waiting.turns.len().min(most) {
            let Some(topic) = waiting.turns.pop_front() else {
                break;
            };
            let Some(lane) = waiting.topics.get_mut(&topic) else {
                continue;
            };
            let Some(value) = lane.values.pop_front() else {
                continue;
            };
            taken.push((Arc::clone(&lane.write), value));
            if !lane.values.is_empty() {
                waiting.turns.push_back(topic);
            }
        }
        taken
    }

    /// A value that may not have reached the server: a state is written again unless there is a newer one, an event is not.
    pub(super) fn untold(&self, write: &Write) {
        if write.overflow != Overflow::KeepLatest {
            self.state.not_written(1);
        }
    }

    /// A value that the server did not take.
    pub(super) fn refused(&self, write: &Write, why: &str) {
        self.state.not_written(1);
        self.state.fault(&write.name, Way::To, why);
    }
}

fn count(many: usize) -> u64 {
    u64::try_from(many).unwrap_or(u64::MAX)
}

/// How many events wait for one node, whatever the mapping says: each is a request of the server's time.
const MOST_EVENTS: usize = 1_000;

#[cfg(test)]
mod tests {
    use std::num::NonZeroU16;

    use mappings::{Access, Endpoint, NodeTarget};

    use super::*;

    fn outbox(overflow: Overflow) -> (Outbox, TopicId) {
        let access = Access::anonymous(Endpoint::default());
        let outbox = Outbox::new(Arc::new(State::new("plc", &access)));
        let topic = TopicId::new(1, 2, 10).unwrap();
        outbox.plan(&Plan {
            reads: Vec::new(),
            writes: vec![Arc::new(Write {
                topic,
                name: "x".to_owned(),
                target: NodeTarget {
                    server: "plc".to_owned(),
                    node: "ns=2;i=1".parse().unwrap(),
                },
                overflow,
            })],
        });
        (outbox, topic)
    }

    fn taken(outbox: &Outbox) -> Vec<Bytes> {
        let all = std::iter::from_fn(|| outbox.take(10).pop());
        all.map(|(_, value)| value).collect()
    }

    #[test]
    fn of_a_state_the_newest_waits_and_is_told_again_to_a_server_that_comes_back() {
        let (outbox, topic) = outbox(Overflow::KeepLatest);
        outbox.put(topic, b"1");
        outbox.put(topic, b"2");
        outbox.up();
        assert_eq!(taken(&outbox), ["2"]);
        outbox.down();
        outbox.up();
        assert_eq!(taken(&outbox), ["2"]);
        outbox.forget(topic);
        outbox.down();
        outbox.up();
        assert_eq!(taken(&outbox), [""; 0]);
        assert_eq!(outbox.state.told().not_written, 1);
    }

    #[test]
    fn events_are_told_in_turn_to_a_server_that_is_there_and_to_no_other() {
        let (outbox, topic) = outbox(Overflow::DropOldest(NonZeroU16::new(2).unwrap()));
        outbox.put(topic, b"1");
        outbox.up();
        for event in [b"2", b"3", b"4"] {
            outbox.put(topic, event);
        }
        assert_eq!(taken(&outbox), ["3", "4"]);
        outbox.put(topic, b"5");
        outbox.down();
        outbox.up();
        assert_eq!(taken(&outbox), [""; 0]);
        // The first, the second, and the one that waited as the server fell.
        assert_eq!(outbox.state.told().not_written, 3);
    }
}
