//! Property tests with any set of bridges in a group: a value enters every other space once and
//! never returns to its own space, and no messages are sent afterwards.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{KeyDelivery, Local, LocalMessage, Now, Output, Router, RouterSettings};
use mappings::{GroupMode, Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use proptest::prelude::*;
use uadp::{SecurityPolicy, Timestamp, TokenKeys};

/// A simulated cell: a bridge per space, a group that delivers every datagram to all bridges
/// including its sender, and local graphs that echo every publication to the bridge itself.
struct Cell {
    bridges: BTreeMap<SpaceId, Router>,
    /// The pending events: datagrams in the group, and messages in local graphs.
    under_way: VecDeque<Event>,
    /// The values that each bridge published in the graph of its space.
    delivered: BTreeMap<(SpaceId, TopicId), Vec<Vec<u8>>>,
    datagrams: usize,
    clock: i128,
    started: Instant,
}

enum Event {
    Datagram {
        from: SpaceId,
        bytes: Vec<u8>,
    },
    Message {
        space: SpaceId,
        topic: TopicId,
        payload: Vec<u8>,
    },
}

impl Cell {
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn new(spaces: &[SpaceId], mode: GroupMode) -> Self {
        let yaml = match mode {
            GroupMode::None => "variables: []".to_owned(),
            secured => format!(
                "security: [{{group: cell, mode: {}, keys: {{file: k}}}}]",
                secured.name()
            ),
        };
        let mapping = Mapping::from_yaml(&yaml, "cell.yaml").mapping.unwrap();
        let mapping = Arc::new(mapping);
        let keys = TokenKeys::from_bytes(SecurityPolicy::PubSubAes256Ctr, &[7; 68]).unwrap();
        let started = Instant::now();
        let bridges = spaces
            .iter()
            .map(|own| {
                let settings = RouterSettings {
                    own: *own,
                    local: Local::Ros1,
                    source: Some(address(*own)),
                };
                let mut router = Router::new(settings, Arc::clone(&mapping));
                router.set_instance([own.get().wrapping_add(1); 16]);
                let now = Now {
                    monotonic: started,
                    utc: Timestamp::from_unix_nanos(0),
                };
                let delivery = KeyDelivery {
                    first_token_id: 1,
                    keys: vec![keys.clone()],
                    time_to_next: None,
                    lifetime: Duration::ZERO,
                };
                router.set_keys("cell", &delivery, now).unwrap();
                (*own, router)
            })
            .collect();
        Self {
            bridges,
            under_way: VecDeque::new(),
            delivered: BTreeMap::new(),
            datagrams: 0,
            clock: 1_700_000_000_000_000_000,
            started,
        }
    }

    fn now(&mut self) -> Now {
        self.clock += 1_000;
        Now {
            monotonic: self.started,
            utc: Timestamp::from_unix_nanos(self.clock),
        }
    }

    fn publish(&mut self, topic: TopicId, text: &str) {
        let mut payload = u32::try_from(text.len()).unwrap().to_le_bytes().to_vec();
        payload.extend_from_slice(text.as_bytes());
        self.under_way.push_back(Event::Message {
            space: topic.space,
            topic,
            payload,
        });
    }

    /// Handles all pending events. Panics if they do not end.
    fn run(&mut self) {
        for _ in 0..10_000 {
            let Some(event) = self.under_way.pop_front() else {
                return;
            };
            match event {
                Event::Message {
                    space,
                    topic,
                    payload,
                } => {
                    let now = self.now();
                    let bridge = self.bridges.get_mut(&space).unwrap();
                    bind(bridge, topic, now);
                    let _verdict = bridge.handle_local(
                        LocalMessage {
                            topic,
                            payload: &payload,
                            received: now.utc,
                            latched_by: None,
                        },
                        now,
                    );
                    self.drain(space);
                }
                Event::Datagram { from, bytes } => {
                    let spaces: Vec<_> = self.bridges.keys().copied().collect();
                    for space in spaces {
                        let now = self.now();
                        let bridge = self.bridges.get_mut(&space).unwrap();
                        bridge.handle_datagram(&bytes, address(from), now);
                        self.drain(space);
                    }
                }
            }
        }
        panic!("no silence within 10 000 steps");
    }

    fn drain(&mut self, space: SpaceId) {
        let now = self.now();
        let bridge = self.bridges.get_mut(&space).unwrap();
        while let Some(output) = bridge.poll_output(now) {
            match output {
                Output::Datagram { bytes, .. } => {
                    self.datagrams += 1;
                    self.under_way
                        .push_back(Event::Datagram { from: space, bytes });
                }
                Output::Delivery(delivery) => {
                    let topic = delivery.topic;
                    let payloads = self.delivered.entry((space, topic)).or_default();
                    payloads.push(delivery.payload.clone());
                    // The graph echoes the publication of the bridge to the bridge itself.
                    let payload = delivery.payload;
                    self.under_way.push_back(Event::Message {
                        space,
                        topic,
                        payload,
                    });
                }
                Output::Unbound { topic, .. } => bind(bridge, topic, now),
                _ => {}
            }
        }
    }
}

fn bind(bridge: &mut Router, topic: TopicId, now: Now) {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let string = registry.get(&"std_msgs/String".parse().unwrap()).unwrap();
    bridge.bind(topic, &string, &Selection::Whole, now).unwrap();
}

fn address(space: SpaceId) -> SocketAddr {
    ([127, 0, 0, 1], 10_000 + u16::from(space.get())).into()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_value_enters_every_other_space_once_and_never_comes_home(
        numbers in proptest::collection::btree_set(0_u16..=232, 1..=5),
        sent in proptest::collection::vec((any::<proptest::sample::Index>(), 1_u16.., 1_u16..), 1..8),
        mode in proptest::sample::select(vec![GroupMode::None, GroupMode::Sign, GroupMode::SignAndEncrypt]),
    ) {
        let spaces: Vec<_> = numbers.into_iter().filter_map(SpaceId::new).collect();
        let mut cell = Cell::new(&spaces, mode);
        let mut expected: BTreeMap<(SpaceId, TopicId), Vec<Vec<u8>>> = BTreeMap::new();
        for (number, (origin, namespace, identifier)) in sent.iter().enumerate() {
            let origin = *origin.get(&spaces);
            let topic =
                TopicId::new(u16::from(origin.get()), *namespace, *identifier).unwrap();
            let text = format!("cover {number}");
            cell.publish(topic, &text);
            cell.run();
            let mut payload = u32::try_from(text.len()).unwrap().to_le_bytes().to_vec();
            payload.extend_from_slice(text.as_bytes());
            for space in spaces.iter().filter(|space| **space != origin) {
                expected.entry((*space, topic)).or_default().push(payload.clone());
            }
        }
        prop_assert_eq!(&cell.delivered, &expected);
        prop_assert_eq!(cell.datagrams, sent.len());
    }
}
