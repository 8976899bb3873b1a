//! The values that wait to be written to a server.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use bytes::Bytes;
use mappings::{Overflow, TopicId};
use opcua::sync::Mutex;
use opcua::types::StatusCode;
use tokio::sync::{Notify, oneshot};

use super::state::{ServerState, Way};
use super::{Plan, Write};

/// Values to be written to a server, as fields. Only the newest value of a state waits, also while
/// the server is offline; it is written again after a reconnect. Events are written while the
/// server is connected, and dropped otherwise.
pub(super) struct ServerOutbox {
    waiting: Mutex<Waiting>,
    /// Notified when a value waits.
    pub(super) filled: Notify,
    pub(super) state: Arc<ServerState>,
}

#[derive(Default)]
struct Waiting {
    topics: HashMap<TopicId, Lane>,
    /// The topics in the order of writing.
    turns: VecDeque<TopicId>,
    up: bool,
}

/// A waiting value, as fields.
#[derive(Debug)]
pub(super) struct WaitingValue {
    pub(super) block: Bytes,
    /// Receives the result if a client waits for it.
    answer: Option<oneshot::Sender<StatusCode>>,
}

impl WaitingValue {
    /// Answers the client that wrote the value.
    fn answer(&mut self, status: StatusCode) {
        if let Some(answer) = self.answer.take() {
            // The client may be lost.
            let _gone = answer.send(status);
        }
    }
}

/// The queue of a variable.
struct Lane {
    write: Arc<Write>,
    values: VecDeque<WaitingValue>,
    /// The last value of a state.
    last: Option<Bytes>,
}

impl ServerOutbox {
    pub(super) fn new(state: Arc<ServerState>) -> Self {
        Self {
            waiting: Mutex::default(),
            filled: Notify::new(),
            state,
        }
    }

    /// Switches to another plan. Values for unchanged nodes continue to wait.
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

    /// Adds a value to be written.
    pub(super) fn put(&self, topic: TopicId, block: &[u8]) {
        self.add(topic, block, None);
    }

    /// Adds a value to be written. `answer` receives the result: the status of the server,
    /// BadRequestCancelledByRequest if a newer value superseded it, BadNoCommunication for an event
    /// that did not reach the server, and GoodCompletesAsynchronously for a state that waits for
    /// the server.
    pub(super) fn write(&self, topic: TopicId, block: &[u8], answer: oneshot::Sender<StatusCode>) {
        self.add(topic, block, Some(answer));
    }

    fn add(&self, topic: TopicId, block: &[u8], answer: Option<oneshot::Sender<StatusCode>>) {
        let mut waiting = self.waiting.lock();
        let up = waiting.up;
        let Some(lane) = waiting.topics.get_mut(&topic) else {
            return;
        };
        let block = Bytes::copy_from_slice(block);
        let mut value = WaitingValue { block, answer };
        let mut dropped = 0;
        match lane.write.overflow {
            Overflow::KeepLatest => {
                for mut older in lane.values.drain(..) {
                    older.answer(StatusCode::BadRequestCancelledByRequest);
                    dropped += 1;
                }
                if !up {
                    value.answer(StatusCode::GoodCompletesAsynchronously);
                }
                lane.last = Some(value.block.clone());
                lane.values.push_back(value);
            }
            Overflow::DropOldest(depth) if up => {
                lane.values.push_back(value);
                let depth = usize::from(depth.get()).min(MOST_EVENTS);
                while lane.values.len() > depth {
                    if let Some(mut oldest) = lane.values.pop_front() {
                        oldest.answer(StatusCode::BadRequestCancelledByRequest);
                    }
                    dropped += 1;
                }
            }
            Overflow::DropOldest(_) => {
                value.answer(StatusCode::BadNoCommunication);
                dropped = 1;
            }
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

    /// Forgets the last value of a topic, so that it is not repeated.
    pub(super) fn forget(&self, topic: TopicId) {
        if let Some(lane) = self.waiting.lock().topics.get_mut(&topic) {
            lane.last = None;
        }
    }

    /// Drops the waiting values and the last values of states, because another program writes to
    /// the server from this moment on.
    pub(super) fn clear(&self) {
        let mut waiting = self.waiting.lock();
        let mut dropped = 0;
        for lane in waiting.topics.values_mut() {
            lane.last = None;
            for mut value in lane.values.drain(..) {
                value.answer(StatusCode::BadInvalidState);
                dropped += 1;
            }
        }
        waiting.turns.clear();
        drop(waiting);
        if dropped > 0 {
            self.state.not_written(count(dropped));
        }
    }

    /// Handles a connect of the server: the states of the cell are written to it.
    pub(super) fn up(&self) {
        let mut waiting = self.waiting.lock();
        waiting.up = true;
        let Waiting { topics, turns, .. } = &mut *waiting;
        for (topic, lane) in topics {
            if lane.values.is_empty() {
                let last = lane.last.clone();
                lane.values.extend(last.map(|block| WaitingValue {
                    block,
                    answer: None,
                }));
            }
            if !lane.values.is_empty() && !turns.contains(topic) {
                turns.push_back(*topic);
            }
        }
        self.filled.notify_one();
    }

    /// Handles the loss of the server: waiting events are dropped.
    pub(super) fn down(&self) {
        let mut waiting = self.waiting.lock();
        waiting.up = false;
        let mut dropped = 0;
        for lane in waiting.topics.values_mut() {
            if lane.write.overflow == Overflow::KeepLatest {
                for value in &mut lane.values {
                    value.answer(StatusCode::GoodCompletesAsynchronously);
                }
                continue;
            }
            for mut value in lane.values.drain(..) {
                value.answer(StatusCode::BadNoCommunication);
                dropped += 1;
            }
        }
        drop(waiting);
        if dropped > 0 {
            self.state.not_written(count(dropped));
        }
    }

    /// Returns the next values to be written, at most one of each variable.
    pub(super) fn take(&self, most: usize) -> Vec<(Arc<Write>, WaitingValue)> {
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

    /// Handles a value that may not have reached the server. A state is written again unless there
    /// is a newer value; an event is dropped.
    pub(super) fn untold(&self, write: &Write, mut value: WaitingValue) {
        if write.overflow == Overflow::KeepLatest {
            value.answer(StatusCode::GoodCompletesAsynchronously);
        } else {
            value.answer(StatusCode::BadNoCommunication);
            self.state.not_written(1);
        }
    }

    /// Handles a value that the server rejected.
    pub(super) fn refused(&self, write: &Write, mut value: WaitingValue, why: (StatusCode, &str)) {
        let (status, why) = why;
        value.answer(status);
        self.state.not_written(1);
        self.state.fault(&write.name, Way::To, why);
    }

    /// Handles a value that the server accepted.
    pub(super) fn written(&self, write: &Write, mut value: WaitingValue, status: StatusCode) {
        value.answer(status);
        self.state.written(1);
        self.state.sound(&write.name, Way::To);
    }
}

fn count(many: usize) -> u64 {
    u64::try_from(many).unwrap_or(u64::MAX)
}

/// Largest number of events that wait for a node, independent of the mapping, because each event is
/// a request to the server.
const MOST_EVENTS: usize = 1_000;

#[cfg(test)]
mod tests {
    use std::num::NonZeroU16;

    use mappings::{Access, Endpoint, NodeTarget};

    use super::*;

    fn outbox(overflow: Overflow) -> (ServerOutbox, TopicId) {
        let access = Access::anonymous(Endpoint::default());
        let outbox = ServerOutbox::new(Arc::new(ServerState::new("plc", &access)));
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

    fn taken(outbox: &ServerOutbox) -> Vec<Bytes> {
        let all = std::iter::from_fn(|| outbox.take(10).pop());
        all.map(|(_, value)| value.block).collect()
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
        // The first event, the second event, and the event that waited when the connection was
        // lost.
        assert_eq!(outbox.state.told().not_written, 3);
    }

    #[test]
    fn nothing_waits_or_is_repeated_once_another_program_writes() {
        let (state, topic) = outbox(Overflow::KeepLatest);
        let (event, event_topic) = outbox(Overflow::DropOldest(NonZeroU16::new(2).unwrap()));
        for (outbox, topic) in [(&state, topic), (&event, event_topic)] {
            outbox.up();
            outbox.put(topic, b"1");
            let (answer, mut answered) = oneshot::channel();
            outbox.write(topic, b"2", answer);
            outbox.clear();
            assert_eq!(answered.try_recv(), Ok(StatusCode::BadInvalidState));
            assert_eq!(taken(outbox), [""; 0]);
            outbox.down();
            outbox.up();
            assert_eq!(taken(outbox), [""; 0], "a state is not repeated");
            assert_eq!(outbox.state.told().not_written, 2);
        }
    }

    #[test]
    fn each_write_of_a_client_has_its_own_result() {
        let (state, topic) = outbox(Overflow::KeepLatest);
        let (event, event_topic) = outbox(Overflow::DropOldest(NonZeroU16::new(1).unwrap()));
        let write = |outbox: &ServerOutbox, topic, block: &[u8]| {
            let (answer, answered) = oneshot::channel();
            outbox.write(topic, block, answer);
            answered
        };
        let answer = |mut answered: oneshot::Receiver<StatusCode>| answered.try_recv().ok();
        let only = |outbox: &ServerOutbox| outbox.take(1).pop().unwrap();

        // The server is offline.
        let waits = answer(write(&state, topic, b"1"));
        assert_eq!(waits, Some(StatusCode::GoodCompletesAsynchronously));
        let lost = answer(write(&event, event_topic, b"1"));
        assert_eq!(lost, Some(StatusCode::BadNoCommunication));
        state.up();
        event.up();
        // A newer value supersedes an older value.
        for (outbox, topic) in [(&state, topic), (&event, event_topic)] {
            let (older, newer) = (write(outbox, topic, b"2"), write(outbox, topic, b"3"));
            let superseded = Some(StatusCode::BadRequestCancelledByRequest);
            assert_eq!(answer(older), superseded);
            let (of, value) = only(outbox);
            outbox.refused(&of, value, (StatusCode::BadOutOfRange, "no"));
            assert_eq!(answer(newer), Some(StatusCode::BadOutOfRange));
            let good = write(outbox, topic, b"4");
            let (of, value) = only(outbox);
            outbox.written(&of, value, StatusCode::Good);
            assert_eq!(answer(good), Some(StatusCode::Good));
        }
        // The connection is lost before the answer.
        for (outbox, topic, status) in [
            (&state, topic, StatusCode::GoodCompletesAsynchronously),
            (&event, event_topic, StatusCode::BadNoCommunication),
        ] {
            let unknown = write(outbox, topic, b"5");
            let (of, value) = only(outbox);
            outbox.untold(&of, value);
            assert_eq!(answer(unknown), Some(status));
            let waiting = write(outbox, topic, b"6");
            outbox.down();
            assert_eq!(answer(waiting), Some(status));
        }
    }
}
