//! A cell of the plant.

use std::sync::Arc;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use bridge_core::{Local, LocalMessage, Now, Output, Relay, Router, RouterSettings};
use broker::{BrokerIdentity, Mqtt};
use mappings::{Broker, BrokerAddress, Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use system_tests::BROKER;
use transport::{BUFFER, Carrier, OutgoingMessage};
use uadp::Timestamp;

/// Numbers of sent messages.
#[derive(Debug, Default)]
pub(crate) struct SentMessages {
    pub(crate) values: u64,
    pub(crate) value_bytes: u64,
    pub(crate) announcements: u64,
    pub(crate) announcement_bytes: u64,
    /// Values that the carrier did not take.
    pub(crate) refused: u64,
}

/// A program of space 1 with a Twist for each topic.
pub(crate) struct PlantCell {
    router: Router,
    carrier: Mqtt,
    topics: Vec<TopicId>,
    next: usize,
    buffer: Vec<u8>,
}

impl PlantCell {
    pub(crate) fn new(number: u16, topics: u16) -> Self {
        let mut broker = Broker::new(BrokerAddress::parse(BROKER).unwrap());
        broker.prefix = format!("plant/cell-{number}");
        let identity = BrokerIdentity {
            program: "bench".to_owned(),
            publisher: Some(1),
        };
        let own = SpaceId::new(1).unwrap();
        let settings = RouterSettings {
            own,
            local: Local::Ros1,
            source: None,
        };
        let mut router = Router::new(settings, Arc::new(Mapping::default()));
        router.set_relay(Some(Relay {
            within: broker.within,
            authorized: false,
        }));
        let twist = TypeRegistry::bundle(Dialect::Ros1)
            .get(&"geometry_msgs/Twist".parse().unwrap())
            .unwrap();
        let topics: Vec<TopicId> = (1..=topics)
            .map(|id| TopicId::new(1, 5, id).unwrap())
            .collect();
        for topic in &topics {
            router
                .bind(*topic, &twist, &Selection::Whole, clock())
                .unwrap();
        }
        Self {
            router,
            carrier: Mqtt::open(&broker, &identity).unwrap(),
            topics,
            next: 0,
            buffer: vec![0; BUFFER],
        }
    }

    pub(crate) fn is_lost(&self) -> bool {
        self.carrier.lost().is_some()
    }

    /// Gives values to the next topics.
    pub(crate) fn say(&mut self, count: u64) {
        let now = clock();
        for _ in 0..count {
            let heard = LocalMessage {
                topic: self.topics[self.next % self.topics.len()],
                payload: &[0; 48],
                received: now.utc,
                latched_by: None,
            };
            self.next += 1;
            let _verdict = self.router.handle_local(heard, now);
        }
    }

    /// Sends and receives as a program does.
    pub(crate) fn turn(&mut self, sent: &mut SentMessages) {
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
            match output {
                Output::Datagram { topic, bytes, .. } => {
                    let message = OutgoingMessage {
                        bytes: &bytes,
                        replaceable: true,
                        command: false,
                        within: self.router.expiry(topic),
                    };
                    match self.carrier.try_send(&message) {
                        Ok(()) => {
                            sent.values += 1;
                            sent.value_bytes += u64::try_from(bytes.len()).unwrap();
                        }
                        Err(_) => sent.refused += 1,
                    }
                    self.router.recycle(bytes);
                }
                Output::Discovery { bytes } => {
                    if self.carrier.try_send(&OutgoingMessage::new(&bytes)).is_ok() {
                        sent.announcements += 1;
                        sent.announcement_bytes += u64::try_from(bytes.len()).unwrap();
                    }
                    self.router.recycle(bytes);
                }
                _ => {}
            }
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
