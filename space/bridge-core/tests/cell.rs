//! A simulated group of programs with a manual clock.
#![allow(dead_code, reason = "each test file uses some of it")]

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    AskId, CallCounters, CallExecution, CallResponse, Executed, ExecutionId, Local, LocalMessage,
    Now, OfferedCall, Output, Owned, Reason, Router, RouterSettings, ValueDescription,
};
use mappings::{Mapping, SpaceId, TopicId};
use uadp::{
    DataSetHeader, Fields, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
    NetworkMessageType, Scalar, Timestamp, Variant,
};

/// Returns the number of copies of a datagram that are delivered; 1 by default.
pub(crate) type NetworkCopies = Box<dyn FnMut(&[u8]) -> usize>;
/// Returns the transmission delay of a datagram.
pub(crate) type Delay = Box<dyn FnMut() -> Duration>;

pub(crate) struct SimulatedCell {
    pub(crate) programs: Vec<SimulatedProgram>,
    /// The datagrams in transmission with their senders.
    under_way: VecDeque<(SocketAddr, Vec<u8>)>,
    /// The delayed datagrams by their arrival time and their sending order.
    late: BTreeMap<(Duration, u64), (SocketAddr, Vec<u8>)>,
    sent: u64,
    /// The number of copies of each datagram.
    pub(crate) copies: NetworkCopies,
    /// The delay of each copy; zero by default.
    pub(crate) delay: Delay,
    /// Whether every second datagram is taken from the end.
    pub(crate) reorders: bool,
    turn: usize,
    started: Instant,
    passed: Duration,
}

pub(crate) struct SimulatedProgram {
    pub(crate) router: Router,
    pub(crate) address: SocketAddr,
    outputs: Vec<Output>,
    sent: Vec<Vec<u8>>,
    dead: bool,
    /// Stopped as by SIGSTOP: its datagrams wait in its socket.
    stopped: bool,
    socket: Vec<((SocketAddr, Timestamp), Vec<u8>)>,
}

impl SimulatedProgram {
    pub(crate) fn new(space: u16, local: Local) -> Self {
        let address = SocketAddr::from(([127, 0, 0, 1], 10_000 + space));
        Self::at(space, local, address)
    }

    fn at(space: u16, local: Local, address: SocketAddr) -> Self {
        let settings = RouterSettings {
            own: SpaceId::new(space).unwrap(),
            local,
            source: Some(address),
        };
        let mut router = Router::new(settings, Arc::new(Mapping::default()));
        router.set_instance(instance(address));
        Self {
            router,
            address,
            outputs: Vec::new(),
            sent: Vec::new(),
            dead: false,
            stopped: false,
            socket: Vec::new(),
        }
    }

    /// Replaces the mapping.
    pub(crate) fn mapped(mut self, mapping: &Arc<Mapping>) -> Self {
        self.router.replace_mapping(Arc::clone(mapping), start());
        self
    }

    /// Changes the port, as for another program or for a restarted program.
    pub(crate) fn at_port(mut self, port: u16) -> Self {
        self.address.set_port(port);
        self.router.set_source(self.address);
        self.router.set_instance(instance(self.address));
        self
    }

    fn runs(&self) -> bool {
        !self.dead && !self.stopped
    }

    pub(crate) fn owning(mut self, namespaces: &[u16]) -> Self {
        let owned = Owned::Only(namespaces.iter().copied().collect());
        self.router.set_owned(owned, start());
        self
    }
}

/// Returns a fixed instance id in place of random bytes.
fn instance(address: SocketAddr) -> [u8; 16] {
    // Requests are distinguished by the first bytes, and heartbeats by the last bytes.
    let [low, high] = address.port().to_le_bytes();
    // The ActionTargetId is the exclusive or of all pairs.
    let [last, end] = [low, high].map(|byte| byte.rotate_left(3));
    [low, high, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, last, end]
}

/// Creates a program that writes a single namespace of space 0.
pub(crate) fn component(namespace: u16) -> SimulatedProgram {
    let address = SocketAddr::from(([127, 0, 0, 1], 20_000 + namespace));
    SimulatedProgram::at(0, Local::Fields, address).owning(&[namespace])
}

impl SimulatedCell {
    pub(crate) fn new(programs: Vec<SimulatedProgram>) -> Self {
        Self {
            programs,
            under_way: VecDeque::new(),
            late: BTreeMap::new(),
            sent: 0,
            copies: Box::new(|_| 1),
            delay: Box::new(|| Duration::ZERO),
            reorders: false,
            turn: 0,
            started: start().monotonic,
            passed: Duration::ZERO,
        }
    }

    pub(crate) fn now(&mut self) -> Now {
        self.passed += Duration::from_micros(1);
        let nanos = i128::try_from(self.passed.as_nanos()).unwrap();
        Now {
            monotonic: self.started + self.passed,
            utc: Timestamp::from_unix_nanos(START + nanos),
        }
    }

    /// Runs all events that are due within the time.
    pub(crate) fn run(&mut self, time: Duration) {
        let end = self.passed + time;
        for _ in 0..200_000 {
            self.carry();
            let due = self.programs.iter().filter(|program| program.runs());
            let due = due
                .filter_map(|program| program.router.poll_timeout())
                .min();
            let next = due.map(|due| due.saturating_duration_since(self.started));
            let late = self.late.first_key_value().map(|((at, _), _)| *at);
            let next = next.into_iter().chain(late).min();
            match next.filter(|next| *next <= end) {
                Some(next) => self.passed = self.passed.max(next),
                None => {
                    self.passed = self.passed.max(end);
                    return;
                }
            }
            for at in 0..self.programs.len() {
                let now = self.now();
                if self.programs[at].runs() {
                    self.programs[at].router.handle_timeout(now);
                    self.drain(at);
                }
            }
        }
        panic!("no end of it");
    }

    /// Delivers the datagrams in transmission to all programs.
    fn carry(&mut self) {
        for at in 0..self.programs.len() {
            self.drain(at);
        }
        while let Some(entry) = self.late.first_entry()
            && entry.key().0 <= self.passed
        {
            self.under_way.push_back(entry.remove());
        }
        for _ in 0..100_000 {
            self.turn += 1;
            let next = if self.reorders && self.turn.is_multiple_of(2) {
                self.under_way.pop_back()
            } else {
                self.under_way.pop_front()
            };
            let Some((from, bytes)) = next else {
                return;
            };
            for at in 0..self.programs.len() {
                self.hear(at, &bytes, from);
            }
        }
        panic!("no silence");
    }

    pub(crate) fn hear(&mut self, at: usize, bytes: &[u8], from: SocketAddr) {
        let now = self.now();
        let program = &mut self.programs[at];
        if program.stopped {
            program.socket.push(((from, now.utc), bytes.to_vec()));
        } else if !program.dead {
            program.router.handle_datagram(bytes, from, now);
            self.drain(at);
        }
    }

    pub(crate) fn drain(&mut self, at: usize) {
        let now = self.now();
        let program = &mut self.programs[at];
        if !program.runs() {
            return;
        }
        while let Some(output) = program.router.poll_output(now) {
            match output {
                Output::Datagram { bytes, .. }
                | Output::Discovery { bytes }
                | Output::Heartbeat { bytes }
                | Output::Action { bytes, .. } => {
                    if program.router.redundancy().is_some() && is_heartbeat(&bytes) {
                        program.router.heartbeat_sent(true, now);
                    }
                    for _ in 0..(self.copies)(&bytes) {
                        let delay = (self.delay)();
                        let datagram = (program.address, bytes.clone());
                        if delay.is_zero() {
                            self.under_way.push_back(datagram);
                        } else {
                            self.sent += 1;
                            self.late.insert((self.passed + delay, self.sent), datagram);
                        }
                    }
                    program.sent.push(bytes);
                }
                other => program.outputs.push(other),
            }
        }
    }

    pub(crate) fn kill(&mut self, at: usize) {
        self.programs[at].dead = true;
    }

    /// Stops a program as SIGSTOP does.
    pub(crate) fn stop(&mut self, at: usize) {
        self.programs[at].stopped = true;
    }

    /// Continues a stopped program, which then reads its socket.
    pub(crate) fn resume(&mut self, at: usize) {
        self.programs[at].stopped = false;
        let now = self.now();
        for ((from, arrived), bytes) in std::mem::take(&mut self.programs[at].socket) {
            let from = (from, Some(arrived));
            self.programs[at].router.handle_received(&bytes, from, now);
            self.drain(at);
        }
    }

    pub(crate) fn start(&mut self, at: usize, program: SimulatedProgram) {
        self.programs[at] = program;
    }

    pub(crate) fn offer(&mut self, at: usize, topic: TopicId, offered: OfferedCall) {
        let now = self.now();
        self.programs[at].router.offer(topic, offered, now);
    }

    pub(crate) fn describe(&mut self, at: usize, topic: TopicId, what: ValueDescription) {
        let now = self.now();
        self.programs[at].router.describe_value(topic, what, now);
    }

    /// Publishes a text from a program with fields as payload.
    pub(crate) fn say(&mut self, at: usize, topic: TopicId, text: &str) {
        let now = self.now();
        let payload = block(&[Variant::Scalar(Scalar::String(Some(text)))]);
        let heard = LocalMessage {
            topic,
            payload: &payload,
            received: now.utc,
            latched_by: None,
        };
        let _verdict = self.programs[at].router.handle_local(heard, now);
    }

    pub(crate) fn ask(
        &mut self,
        at: usize,
        ask: AskId,
        (topic, request): (TopicId, &[u8]),
        timeout: Duration,
    ) {
        let now = self.now();
        let router = &mut self.programs[at].router;
        router.ask(ask, (topic, request), timeout, now);
        self.drain(at);
    }

    pub(crate) fn executed(&mut self, at: usize, execution: ExecutionId, outcome: Executed) {
        let now = self.now();
        self.programs[at].router.executed(execution, outcome, now);
        self.drain(at);
    }

    /// Removes and returns the outputs of a program that `pick` selects.
    fn take<T>(&mut self, at: usize, pick: impl Fn(&Output) -> Option<T>) -> Vec<T> {
        let outputs = &mut self.programs[at].outputs;
        let taken = outputs.iter().filter_map(&pick).collect();
        outputs.retain(|output| pick(output).is_none());
        taken
    }

    pub(crate) fn outputs(&mut self, at: usize) -> Vec<Output> {
        std::mem::take(&mut self.programs[at].outputs)
    }

    pub(crate) fn answers(&mut self, at: usize) -> Vec<(AskId, CallResponse)> {
        self.take(at, |output| match output {
            Output::Answer { ask, answer, .. } => Some((*ask, answer.clone())),
            _ => None,
        })
    }

    pub(crate) fn executions(&mut self, at: usize) -> Vec<CallExecution> {
        self.take(at, |output| match output {
            Output::Execute(execution) => Some(execution.clone()),
            _ => None,
        })
    }

    pub(crate) fn abandoned(&mut self, at: usize) -> Vec<ExecutionId> {
        self.take(at, |output| match output {
            Output::Abandoned { execution, .. } => Some(*execution),
            _ => None,
        })
    }

    pub(crate) fn known(&mut self, at: usize) -> Vec<TopicId> {
        let mut known = self.take(at, |output| match output {
            Output::CallKnown { topic, .. } => Some(*topic),
            _ => None,
        });
        known.sort();
        known
    }

    pub(crate) fn gone(&mut self, at: usize) -> Vec<TopicId> {
        self.take(at, |output| match output {
            Output::CallGone { topic } => Some(*topic),
            _ => None,
        })
    }

    /// Returns the namespaces that were taken (`true`) or became free (`false`).
    pub(crate) fn taken(&mut self, at: usize) -> Vec<(u16, bool)> {
        self.take(at, |output| match output {
            Output::Taken { namespace, by, .. } => Some((*namespace, by.is_some())),
            _ => None,
        })
    }

    /// Returns the texts that a program with fields as payload received for a topic.
    pub(crate) fn texts(&mut self, at: usize, topic: TopicId) -> Vec<String> {
        self.take(at, |output| match output {
            Output::Delivery(delivery) if delivery.topic == topic => {
                match Fields::parse(&delivery.payload).unwrap().next() {
                    Some(Ok(Variant::Scalar(Scalar::String(Some(text))))) => Some(text.to_owned()),
                    other => panic!("{other:?}"),
                }
            }
            _ => None,
        })
    }

    /// Returns all datagrams that a program sent.
    pub(crate) fn datagrams_of(&mut self, at: usize) -> Vec<Vec<u8>> {
        self.drain(at);
        self.programs[at].sent.clone()
    }

    pub(crate) fn counters(&self, at: usize, topic: TopicId) -> CallCounters {
        let all: BTreeMap<TopicId, &CallCounters> = self.programs[at].router.calls().collect();
        all.get(&topic).copied().cloned().unwrap_or_default()
    }

    /// Returns the number of drops for the reason over all topics and calls.
    pub(crate) fn dropped(&self, at: usize, reason: Reason) -> u64 {
        let router = &self.programs[at].router;
        let calls = router.calls().map(|(_, call)| call.drops.dropped(reason));
        let topics = router.topics().map(|(_, topic)| topic.dropped(reason));
        calls.chain(topics).sum::<u64>() + router.others().dropped(reason)
    }
}

pub(crate) fn is_action(bytes: &[u8]) -> bool {
    NetworkMessage::decode(bytes).is_ok_and(|message| message.is_action())
}

/// Returns whether a datagram is a heartbeat of a redundant bridge, in clear or sealed.
fn is_heartbeat(bytes: &[u8]) -> bool {
    NetworkMessage::decode(bytes).is_ok_and(|message| {
        message.group().is_none()
            && message.message_type() == NetworkMessageType::DataSet
            && !message.is_action()
    })
}

/// Returns a block of fields.
pub(crate) fn block(fields: &[Variant<'_>]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut message =
        NetworkMessageEncoder::new(&mut bytes, &NetworkHeader::default(), None).unwrap();
    let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
    for field in fields {
        frame.variant(field).unwrap();
    }
    frame.finish().unwrap();
    message.finish().unwrap();
    let message = NetworkMessage::decode(&bytes).unwrap();
    let message = message.messages().next().unwrap().unwrap();
    message.fields().unwrap().bytes().to_vec()
}

pub(crate) fn topic(space: u16, namespace: u16, id: u16) -> TopicId {
    TopicId::new(space, namespace, id).unwrap()
}

pub(crate) const fn ms(time: u64) -> Duration {
    Duration::from_millis(time)
}

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn start() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(START),
    }
}

const START: i128 = 1_700_000_000_000_000_000;
