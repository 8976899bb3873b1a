//! A program that joins late at a broker that retains no messages.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use bridge_core::{Local, LocalMessage, Now, Output, Relay, Router, RouterSettings};
use broker::{BrokerIdentity, Mqtt};
use mappings::{Broker, BrokerAddress, Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use system_tests::{BROKER, Cell, Peer};
use transport::{BUFFER, Carrier, OutgoingMessage};
use uadp::Timestamp;

use super::SOON;

/// The number of topics of the sender.
const TOPICS: u16 = 40;
/// The period of the values of all topics.
const PERIOD: Duration = Duration::from_millis(100);
/// The time of the announcements of a start.
const STARTED: Duration = Duration::from_secs(3);
/// The time after the connection in which a late program knows the types of all topics.
const UNDERSTOOD: Duration = Duration::from_secs(1);
const TURN: Duration = Duration::from_millis(5);

/// A program at the broker.
struct BrokerProgram {
    router: Router,
    carrier: Mqtt,
    buffer: Vec<u8>,
    /// Topics of other programs whose type is known.
    described: BTreeSet<TopicId>,
}

impl BrokerProgram {
    /// Connects with the broker. Called in a runtime.
    fn join(space: u16) -> Self {
        let broker = Broker::new(BrokerAddress::parse(BROKER).unwrap());
        let identity = BrokerIdentity {
            program: "test".to_owned(),
            publisher: Some(space),
        };
        let settings = RouterSettings {
            own: SpaceId::new(space).unwrap(),
            local: Local::Ros1,
            source: None,
        };
        let mut router = Router::new(settings, Arc::new(Mapping::default()));
        router.set_relay(Some(Relay {
            within: broker.within,
            authorized: false,
        }));
        Self {
            router,
            carrier: Mqtt::open(&broker, &identity).unwrap(),
            buffer: vec![0; BUFFER],
            described: BTreeSet::new(),
        }
    }

    /// Sends and receives as a program does.
    fn turn(&mut self) {
        let now = clock();
        let _change = self.carrier.follow();
        while let Some(received) = self.carrier.try_recv(&mut self.buffer) {
            let received = received.unwrap();
            let message = &self.buffer[..received.length];
            self.router.handle_datagram(message, received.from, now);
        }
        let due = self.router.poll_timeout();
        if due.is_some_and(|due| due <= now.monotonic) {
            self.router.handle_timeout(now);
        }
        while let Some(output) = self.router.poll_output(now) {
            let (bytes, replaceable) = match output {
                Output::Datagram { bytes, .. } => (bytes, true),
                Output::Discovery { bytes } => (bytes, false),
                Output::Unbound {
                    topic, described, ..
                } => {
                    if described.is_some() {
                        self.described.insert(topic);
                    }
                    continue;
                }
                _ => continue,
            };
            let message = OutgoingMessage {
                bytes: &bytes,
                replaceable,
                command: false,
                within: None,
            };
            let _not_yet = self.carrier.try_send(&message);
            self.router.recycle(bytes);
        }
    }

    /// Gives each topic a value.
    fn publish(&mut self, topics: &[TopicId]) {
        let now = clock();
        for topic in topics {
            let message = LocalMessage {
                topic: *topic,
                payload: &[0; 48],
                received: now.utc,
                latched_by: None,
            };
            let _verdict = self.router.handle_local(message, now);
        }
    }
}

fn clock() -> Now {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(since.as_nanos().try_into().unwrap()),
    }
}

/// Binds the topics of the sender to a type.
fn bind(sender: &mut BrokerProgram) -> Vec<TopicId> {
    let types = TypeRegistry::bundle(Dialect::Ros1);
    let twist = types.get(&"geometry_msgs/Twist".parse().unwrap()).unwrap();
    let topics: Vec<TopicId> = (1..=TOPICS)
        .map(|id| TopicId::new(1, 5, id).unwrap())
        .collect();
    for topic in &topics {
        let selection = &Selection::Whole;
        let bound = sender.router.bind(*topic, &twist, selection, clock());
        bound.unwrap();
    }
    topics
}

#[test]
fn a_late_joiner_understands_all_topics_at_a_broker_that_retains_nothing() {
    let Some(cell) = Cell::with(&[Peer::Mosquitto]) else {
        return;
    };
    let _broker = cell
        .mosquitto_with("listener 1883 127.0.0.1\nallow_anonymous true\nretain_available false\n");
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    runtime.block_on(async {
        let mut sender = BrokerProgram::join(1);
        let topics = bind(&mut sender);
        // The announcements of the start are over when the other program joins.
        let start = Instant::now();
        let mut published = start;
        while start.elapsed() < STARTED || sender.carrier.lost().is_some() {
            assert!(start.elapsed() < SOON, "{:?}", sender.carrier.lost());
            step(&mut sender, None, (&topics, &mut published)).await;
        }
        let mut late = BrokerProgram::join(2);
        while late.carrier.lost().is_some() {
            assert!(start.elapsed() < SOON, "{:?}", late.carrier.lost());
            step(&mut sender, Some(&mut late), (&topics, &mut published)).await;
        }
        let joined = Instant::now();
        while late.described.len() < topics.len() {
            assert!(
                joined.elapsed() < UNDERSTOOD,
                "only {} topics are understood",
                late.described.len()
            );
            step(&mut sender, Some(&mut late), (&topics, &mut published)).await;
        }
    });
}

/// Lets the programs send and receive for a moment.
async fn step(
    sender: &mut BrokerProgram,
    late: Option<&mut BrokerProgram>,
    (topics, published): (&[TopicId], &mut Instant),
) {
    if published.elapsed() > PERIOD {
        *published = Instant::now();
        sender.publish(topics);
    }
    sender.turn();
    if let Some(late) = late {
        late.turn();
    }
    tokio::time::sleep(TURN).await;
}
