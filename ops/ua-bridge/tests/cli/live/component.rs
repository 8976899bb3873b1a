//! A component with one skill, gripper.Grasp of namespace 7, implemented with the codec alone.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::time::Instant;
use transport::{Udp, UdpOptions};
use uadp::action::{
    ActionDialect, ActionFields, ActionKind, ActionMessage, ActionOutcome, RequiredAction,
    Responder, ResponderSettings,
};
use uadp::discovery::{
    ActionMetaData, ActionTargetDataType, AnnouncedContent, Announcement, DataSetMetaDataType,
    FieldMetaData, KeyValuePair, Probe, WireArray,
};
use uadp::{
    Array, BuiltinType, DataSetHeader, Extras, FieldEncoder, GroupHeader, LocalizedText,
    NetworkHeader, NetworkMessage, NetworkMessageEncoder, NetworkMessageType, PublisherId,
    QualifiedName, Scalar, SecurityHeader, StatusCode, Timestamp, Variant,
};

const STATE: u16 = 101;
const RESULT: u16 = 104;
const START: u16 = 105;
const HALT: u16 = 106;

/// A component that runs in a group of its own until it is dropped.
pub(crate) struct GroupComponent {
    pub(crate) group: String,
    pub(crate) address: SocketAddr,
    seen: Arc<Seen>,
    thread: Option<JoinHandle<()>>,
}

/// The events that the component has recorded.
#[derive(Default)]
struct Seen {
    stop: AtomicBool,
    started: AtomicU32,
    halted: AtomicU32,
    requestors: Mutex<Vec<String>>,
}

impl GroupComponent {
    pub(crate) fn start() -> Self {
        Self::start_beside(false, 0)
    }

    /// Starts the component with a network that loses the first announcements of the state.
    pub(crate) fn start_losing(announcements: u32) -> Self {
        Self::start_beside(false, announcements)
    }

    /// Starts the component beside a forger, which answers every request before the component does,
    /// from another port.
    pub(crate) fn start_beside_a_forger() -> Self {
        Self::start_beside(true, 0)
    }

    fn start_beside(is_forged: bool, lost: u32) -> Self {
        let port = UdpSocket::bind("127.0.0.1:0").unwrap();
        let port = port.local_addr().unwrap().port();
        let address = SocketAddr::from((Ipv4Addr::new(239, 255, 41, 7), port));
        let seen = Arc::new(Seen::default());
        let its = Arc::clone(&seen);
        let (ready, is_ready) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()
                .unwrap();
            runtime.block_on(async {
                let options = UdpOptions {
                    interface: Some("127.0.0.1".to_owned()),
                    ttl: 0,
                    ..UdpOptions::new(address)
                };
                let udp = Udp::open(&options).unwrap();
                let mut gripper = Gripper::new(udp, its);
                gripper.lost = lost;
                if is_forged {
                    let udp = Udp::open(&options).unwrap();
                    let responder = Responder::new(ResponderSettings::default());
                    gripper.forger = Some((udp, responder));
                }
                ready.send(()).unwrap();
                gripper.run().await;
            });
        });
        is_ready.recv().unwrap();
        Self {
            group: format!("opc.udp://{address}"),
            address,
            seen,
            thread: Some(thread),
        }
    }

    /// Appends the options with the address of the component to a command.
    pub(crate) fn words<'a>(&'a self, words: &[&'a str]) -> Vec<&'a str> {
        let group = ["--address", &self.group, "--interface", "127.0.0.1"];
        words.iter().copied().chain(group).collect()
    }

    pub(crate) fn started(&self) -> u32 {
        self.seen.started.load(Ordering::SeqCst)
    }

    pub(crate) fn halted(&self) -> u32 {
        self.seen.halted.load(Ordering::SeqCst)
    }

    pub(crate) fn requestors(&self) -> Vec<String> {
        self.seen.requestors.lock().unwrap().clone()
    }
}

impl Drop for GroupComponent {
    fn drop(&mut self) {
        self.seen.stop.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            let joined = thread.join();
            assert!(joined.is_ok() || std::thread::panicking());
        }
    }
}

struct Gripper {
    udp: Udp,
    seen: Arc<Seen>,
    start: Instant,
    responder: Responder<()>,
    forger: Option<(Udp, Responder<()>)>,
    run: u32,
    /// Start time and duration of the running skill.
    running: Option<(Instant, Duration)>,
    last_transition: &'static str,
    succeeded: bool,
    sequence: u16,
    /// Number of announcements of the state that are still to be lost.
    lost: u32,
}

impl Gripper {
    fn new(udp: Udp, seen: Arc<Seen>) -> Self {
        Self {
            udp,
            seen,
            start: Instant::now(),
            responder: Responder::new(ResponderSettings::default()),
            forger: None,
            run: 0,
            running: None,
            last_transition: "HaltedToReady",
            succeeded: false,
            sequence: 0,
            lost: 0,
        }
    }

    async fn run(mut self) {
        let mut buffer = vec![0; 65_536];
        let mut beat = tokio::time::interval(Duration::from_millis(50));
        while !self.seen.stop.load(Ordering::SeqCst) {
            tokio::select! {
                _ = beat.tick() => self.publish(),
                received = self.udp.recv(&mut buffer) => {
                    let (length, _) = received.unwrap();
                    self.handle(&buffer[..length]);
                }
            }
            self.transmit();
        }
    }

    fn handle(&mut self, datagram: &[u8]) {
        let Ok(message) = NetworkMessage::decode(datagram) else {
            return;
        };
        if message.message_type() == NetworkMessageType::Probe {
            if message.publisher_id() == Some(PublisherId::UInt16(0)) {
                if let Probe::DataSetMetaData(ids) = Probe::decode(&message).unwrap() {
                    ids.iter().for_each(|id| self.announce(id));
                } else {
                    [START, HALT].iter().for_each(|id| self.announce(*id));
                }
            }
        } else if message.is_action() {
            for action in message.actions(ActionDialect::Standard).unwrap() {
                let action = action.unwrap();
                if let Some(PublisherId::String(id)) = action.action.requestor_id {
                    let mut requestors = self.seen.requestors.lock().unwrap();
                    if requestors.last().map(String::as_str) != Some(id) {
                        requestors.push(id.to_owned());
                    }
                }
                if action.action.kind == ActionKind::Response {
                    continue;
                }
                self.forge(&action);
                let asked = self
                    .responder
                    .handle_request(&action, (), self.start.elapsed());
                if let Ok(RequiredAction::Execute(execution)) = asked {
                    let block = self.execute(action.writer_id, action.fields);
                    let outcome = ActionOutcome::Answered {
                        status: StatusCode::GOOD,
                        fields: ActionFields::Variants(&block),
                    };
                    self.responder
                        .finish(execution, outcome, self.start.elapsed())
                        .unwrap();
                }
            }
        }
    }

    /// Answers in the name of the component, with a run that does not exist.
    fn forge(&mut self, action: &ActionMessage<'_>) {
        let now = self.start.elapsed();
        let Some((udp, responder)) = &mut self.forger else {
            return;
        };
        if let Ok(RequiredAction::Execute(execution)) = responder.handle_request(action, (), now) {
            let mut block = vec![3, 0, 1, 1, 12, 0, 0, 0, 0, 7];
            block.extend(4242_u32.to_le_bytes());
            let outcome = ActionOutcome::Answered {
                status: StatusCode::GOOD,
                fields: ActionFields::Variants(&block),
            };
            responder.finish(execution, outcome, now).unwrap();
        }
        send_due(udp, responder, now);
    }

    /// Returns the response: success, message, run.
    fn execute(&mut self, writer_id: u16, fields: ActionFields<'_>) -> Vec<u8> {
        let (success, message) = if writer_id == START {
            self.seen.started.fetch_add(1, Ordering::SeqCst);
            let mut fields = fields.variants().unwrap().map(Result::unwrap);
            let Some(Variant::Scalar(Scalar::Double(force))) = fields.next() else {
                unreachable!("what it takes begins with a Double");
            };
            if self.running.is_some() {
                (false, "BadInvalidState: it is running")
            } else if force > 100.0 {
                (false, "BadInvalidArgument: Force 100 at most")
            } else {
                self.run += 1;
                // Without a force the run does not end during the test.
                let ends = if force > 0.0 { 300 } else { 60_000 };
                self.running = Some((Instant::now(), Duration::from_millis(ends)));
                self.last_transition = "ReadyToRunning";
                (true, "")
            }
        } else {
            assert_eq!(writer_id, HALT);
            self.seen.halted.fetch_add(1, Ordering::SeqCst);
            self.end(false, "RunningToHalted");
            (true, "")
        };
        let mut block = vec![3, 0, 1, u8::from(success), 12];
        block.extend(i32::try_from(message.len()).unwrap().to_le_bytes());
        block.extend(message.as_bytes());
        block.push(7);
        block.extend(self.run.to_le_bytes());
        block
    }

    fn end(&mut self, succeeded: bool, transition: &'static str) {
        if self.running.take().is_some() {
            (self.succeeded, self.last_transition) = (succeeded, transition);
        }
    }

    fn publish(&mut self) {
        if self
            .running
            .is_some_and(|(since, ends)| since.elapsed() >= ends)
        {
            self.end(true, "RunningToReady");
        }
        let (state, number) = match (self.running.is_some(), self.last_transition) {
            (true, _) => ("Running", 13),
            (false, "RunningToHalted") => ("Halted", 11),
            (false, _) => ("Ready", 12),
        };
        let (run, transition, succeeded) = (self.run, self.last_transition, self.succeeded);
        self.send(STATE, |fields| {
            fields.scalar(Scalar::String(Some(state))).unwrap();
            fields.scalar(Scalar::Byte(number)).unwrap();
            fields.scalar(Scalar::String(Some(transition))).unwrap();
            fields.scalar(Scalar::Float(0.5)).unwrap();
            fields.scalar(Scalar::String(Some("Closing"))).unwrap();
            fields.scalar(Scalar::UInt32(run)).unwrap();
        });
        if run > 0 && self.running.is_none() {
            self.send(RESULT, |fields| {
                let text = |text: &str| {
                    let mut bytes = i32::try_from(text.len()).unwrap().to_le_bytes().to_vec();
                    bytes.extend(text.as_bytes());
                    bytes
                };
                fields.scalar(Scalar::UInt32(run)).unwrap();
                fields.scalar(Scalar::Boolean(succeeded)).unwrap();
                let why = if succeeded { "" } else { "halted" };
                fields.scalar(Scalar::String(Some(why))).unwrap();
                for element in ["Gripped", "true"] {
                    let bytes = text(element);
                    let array = Array::new(BuiltinType::String, 1, &bytes).unwrap();
                    fields.variant(&array.into()).unwrap();
                }
            });
        }
    }

    fn send(&mut self, writer_id: u16, fill: impl FnOnce(&mut FieldEncoder<'_>)) {
        self.sequence = self.sequence.wrapping_add(1);
        let now = Timestamp::from_unix_nanos(unix_nanos());
        let network = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(0)),
            group: Some(GroupHeader {
                writer_group_id: Some(7),
                ..GroupHeader::default()
            }),
            timestamp: Some(now.time),
            ..NetworkHeader::default()
        };
        let header = DataSetHeader {
            sequence_number: Some(self.sequence),
            timestamp: Some(uadp::DateTime(now.time.0 - 10_000)),
            ..DataSetHeader::default()
        };
        let mut datagram = Vec::new();
        let mut message =
            NetworkMessageEncoder::new(&mut datagram, &network, Some(&[writer_id])).unwrap();
        let mut frame = message.key_frame(&header).unwrap();
        fill(&mut frame);
        frame.finish().unwrap();
        message.finish().unwrap();
        self.udp.try_send(&datagram).unwrap();
    }

    fn announce(&mut self, writer_id: u16) {
        if writer_id == STATE && self.lost > 0 {
            self.lost -= 1;
            return;
        }
        let (name, fields) = match writer_id {
            STATE => ("State", STATE_FIELDS),
            RESULT => ("Result", RESULT_FIELDS),
            START => ("Start", ANSWER_FIELDS),
            HALT => ("Halt", ANSWER_FIELDS),
            _ => return,
        };
        let optional = [KeyValuePair {
            key: QualifiedName {
                namespace: 0,
                name: Some("Optional"),
            },
            value: Variant::Scalar(Scalar::Boolean(true)),
        }];
        let request = [
            field(&("Force", BuiltinType::Double, -1)),
            FieldMetaData {
                properties: WireArray::new(&optional),
                ..field(&("Name", BuiltinType::String, -1))
            },
        ];
        let request = if writer_id == START {
            &request[..]
        } else {
            &[]
        };
        let fields: Vec<FieldMetaData<'_>> = fields.iter().map(field).collect();
        let name = format!("ua_0_7_{writer_id} gripper.Grasp.{name}");
        let meta_data = |fields| DataSetMetaDataType {
            name: Some(&name),
            description: LocalizedText {
                locale: None,
                text: Some("ua_msgs/SkillState; GraspSkillType nsu=urn:ua-bridge:skills"),
            },
            fields,
            ..DataSetMetaDataType::default()
        };
        let target = [ActionTargetDataType {
            action_target_id: 1,
            ..ActionTargetDataType::default()
        }];
        let announced = match writer_id {
            START | HALT => AnnouncedContent::ActionMetaData(ActionMetaData {
                writer_id,
                action_targets: WireArray::new(&target),
                request: meta_data(WireArray::new(request)),
                response: meta_data(WireArray::new(&fields)),
                action_methods: WireArray::null(),
            }),
            _ => AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data: meta_data(WireArray::new(&fields)),
                status: StatusCode::GOOD,
            },
        };
        let announcement = Announcement {
            sequence_number: 1,
            announced,
        };
        let mut datagram = Vec::new();
        announcement
            .encode(PublisherId::UInt16(0), SecurityHeader::NONE, &mut datagram)
            .unwrap();
        self.udp.try_send(&datagram).unwrap();
    }

    fn transmit(&mut self) {
        send_due(&self.udp, &mut self.responder, self.start.elapsed());
    }
}

fn send_due(udp: &Udp, responder: &mut Responder<()>, now: Duration) {
    while let Some(((), response)) = responder.poll_transmit(now) {
        let mut datagram = Vec::new();
        response
            .encode(&mut datagram, &NetworkHeader::default(), &Extras::default())
            .unwrap()
            .finish()
            .unwrap();
        udp.try_send(&datagram).unwrap();
    }
}

#[expect(clippy::disallowed_methods, reason = "a component has a clock")]
fn unix_nanos() -> i128 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    i128::try_from(since.unwrap().as_nanos()).unwrap()
}

/// Name, type and ValueRank of a field.
type Told = (&'static str, BuiltinType, i32);

fn field((name, builtin, value_rank): &Told) -> FieldMetaData<'static> {
    FieldMetaData {
        name: Some(name),
        built_in_type: builtin.id(),
        value_rank: *value_rank,
        ..FieldMetaData::default()
    }
}

const STATE_FIELDS: &[Told] = &[
    ("state", BuiltinType::String, -1),
    ("number", BuiltinType::Byte, -1),
    ("last_transition", BuiltinType::String, -1),
    ("progress", BuiltinType::Float, -1),
    ("step", BuiltinType::String, -1),
    ("run", BuiltinType::UInt32, -1),
];
const RESULT_FIELDS: &[Told] = &[
    ("run", BuiltinType::UInt32, -1),
    ("succeeded", BuiltinType::Boolean, -1),
    ("message", BuiltinType::String, -1),
    ("names", BuiltinType::String, 1),
    ("values", BuiltinType::String, 1),
];
const ANSWER_FIELDS: &[Told] = &[
    ("success", BuiltinType::Boolean, -1),
    ("message", BuiltinType::String, -1),
    ("run", BuiltinType::UInt32, -1),
];
