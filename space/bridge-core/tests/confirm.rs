//! Events that bridges confirm, on a network that loses datagrams, with a manual clock.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    Application, ConfirmedArrival, Delivery, Handover, Local, LocalMessage, Now, Output, Reason,
    Relay, Router, RouterSettings,
};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::{BuiltinType, Timestamp};

const STEP: Duration = Duration::from_millis(10);
const MAPPING: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:cell}
variables:
  - {node: ns=2;i=10, name: Stop, origin: 0, ros: {space: 1, topic: /stop, type: std_msgs/UInt32}}
  - {node: ns=2;i=11, name: Both, origin: 0, ros: [{space: 1, topic: /both, type: std_msgs/UInt32}, {space: 2, topic: /both, type: std_msgs/UInt32}]}
  - {node: ns=2;i=12, name: Sent, origin: 0, confirm: none, ros: {space: 1, topic: /sent, type: std_msgs/UInt32}}
  - {node: ns=2;i=13, name: Seldom, origin: 0, at_most: 1 Hz, ros: {space: 1, topic: /seldom, type: std_msgs/UInt32}}
  - {node: ns=2;i=14, name: Text, origin: 0, type: String, ros: {space: 1, topic: /text, type: std_msgs/String}}
";

fn address(port: u16) -> SocketAddr {
    ([127, 0, 0, 1], port).into()
}

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn start() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
    }
}

fn later(now: Now, time: Duration) -> Now {
    let nanos = now.utc.unix_nanos() + i128::try_from(time.as_nanos()).unwrap();
    Now {
        monotonic: now.monotonic + time,
        utc: Timestamp::from_unix_nanos(nanos),
    }
}

/// Returns the field of an OPC UA write.
fn field(value: u32) -> Vec<u8> {
    let mut block = 1_u16.to_le_bytes().to_vec();
    block.push(BuiltinType::UInt32.id());
    block.extend_from_slice(&value.to_le_bytes());
    block
}

/// Returns the number in the message of a delivery.
fn number(delivery: &Delivery) -> u32 {
    u32::from_le_bytes(*delivery.payload.last_chunk().unwrap())
}

/// A program of the group.
struct Program {
    router: Router,
    port: u16,
    /// The values that its local side has received.
    got: Vec<u32>,
    /// The handover that the local side reports for them.
    handover: Handover,
    arrivals: Vec<(TopicId, ConfirmedArrival)>,
}

impl Program {
    fn new(own: u16, port: u16, of: TopicId, now: Now) -> Self {
        let (local, dialect) = match own {
            0 => (Local::Fields, Dialect::Ros1),
            1 => (Local::Ros1, Dialect::Ros1),
            _ => (Local::Cdr, Dialect::Ros2),
        };
        let settings = RouterSettings {
            own: SpaceId::new(own).unwrap(),
            local,
            source: Some(address(port)),
        };
        let mapping = Mapping::from_yaml(MAPPING, "cell.yaml").mapping.unwrap();
        let mut router = Router::new(settings, Arc::new(mapping));
        if own != 0 {
            let type_name = match of.triple().2 {
                14 => "std_msgs/String",
                _ => "std_msgs/UInt32",
            };
            let message = TypeRegistry::bundle(dialect).get(&type_name.parse().unwrap());
            router
                .bind(of, &message.unwrap(), &Selection::Whole, now)
                .unwrap();
        }
        Self {
            router,
            port,
            got: Vec::new(),
            handover: Handover::Done,
            arrivals: Vec::new(),
        }
    }

    fn introduce(&mut self, now: Now) {
        let application = Application {
            uri: format!("urn:{}", self.port),
            ..Application::default()
        };
        self.router.introduce(application, now);
    }

    fn write(&mut self, of: TopicId, payload: &[u8], now: Now) {
        let heard = LocalMessage {
            topic: of,
            payload,
            received: now.utc,
            latched_by: None,
        };
        let _verdict = self.router.handle_local(heard, now);
    }

    /// Handles the due timeouts and outputs, and returns the datagrams that the program sends.
    fn turn(&mut self, now: Now) -> Vec<Vec<u8>> {
        self.router.handle_timeout(now);
        let mut sent = Vec::new();
        while let Some(output) = self.router.poll_output(now) {
            match output {
                Output::Datagram { bytes, .. }
                | Output::Discovery { bytes }
                | Output::Action { bytes, .. } => sent.push(bytes),
                Output::Delivery(delivery) => {
                    let Delivery {
                        topic,
                        arrived,
                        instance,
                        ..
                    } = delivery;
                    self.router.published(topic, arrived, now);
                    if self.handover != Handover::Nobody {
                        self.got.push(number(&delivery));
                    }
                    assert!(self.router.is_to_confirm(topic, instance));
                    self.router.handed(topic, instance, self.handover);
                }
                Output::HandoverWanted { topic, instance } => {
                    self.router.handed(topic, Some(instance), self.handover);
                }
                Output::Settled { topic, arrival } => self.arrivals.push((topic, arrival)),
                _ => {}
            }
        }
        sent
    }
}

/// Programs in a network.
struct Cell {
    programs: Vec<Program>,
    now: Now,
    /// Returns whether a datagram is lost, by the ports of its sender and its receiver.
    loses: Box<dyn FnMut(u16, u16) -> bool>,
    datagrams: usize,
}

impl Cell {
    /// Creates a server, and a bridge for each of the spaces, which have discovered each other.
    fn new(of: TopicId, spaces: &[u16]) -> Self {
        let now = start();
        let all = std::iter::once(&0).chain(spaces);
        let programs = all.map(|own| Program::new(*own, 100 + own, of, now));
        let mut cell = Self {
            programs: programs.collect(),
            now,
            loses: Box::new(|_, _| false),
            datagrams: 0,
        };
        for program in &mut cell.programs {
            program.introduce(now);
        }
        cell.run(Duration::from_secs(2));
        cell
    }

    fn run(&mut self, time: Duration) {
        let end = self.now.monotonic + time;
        while self.now.monotonic < end {
            for at in 0..self.programs.len() {
                let from = self.programs[at].port;
                for datagram in self.programs[at].turn(self.now) {
                    self.datagrams += 1;
                    for other in &mut self.programs {
                        if other.port == from || !(self.loses)(from, other.port) {
                            other
                                .router
                                .handle_datagram(&datagram, address(from), self.now);
                        }
                    }
                }
            }
            self.now = later(self.now, STEP);
        }
    }

    fn write(&mut self, of: TopicId, value: u32) {
        let now = self.now;
        self.programs[0].write(of, &field(value), now);
    }

    fn arrivals(&mut self) -> Vec<ConfirmedArrival> {
        let told = std::mem::take(&mut self.programs[0].arrivals);
        told.into_iter().map(|(_, arrival)| arrival).collect()
    }
}

fn topic(text: &str) -> TopicId {
    text.parse().unwrap()
}

fn unknown(space: u16) -> ConfirmedArrival {
    ConfirmedArrival::Unknown(vec![SpaceId::new(space).unwrap()])
}

/// Returns a function that loses a fifth of the datagrams, the same in each run.
fn loses_a_fifth(seed: u64) -> Box<dyn FnMut(u16, u16) -> bool> {
    let mut state = seed;
    Box::new(move |_, _| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (state >> 33).is_multiple_of(5)
    })
}

#[test]
fn of_1000_stops_that_bridges_confirm_none_is_lost_and_none_comes_twice_though_a_fifth_is_lost() {
    let of = topic("ua_0_2_11");
    let mut cell = Cell::new(of, &[1, 2]);
    cell.loses = loses_a_fifth(34);
    for stop in 0..1000 {
        cell.write(of, stop);
        cell.run(Duration::from_millis(1100));
    }
    let all: Vec<u32> = (0..1000).collect();
    assert_eq!(cell.programs[1].got, all);
    assert_eq!(cell.programs[2].got, all);
    assert_eq!(cell.arrivals(), vec![ConfirmedArrival::Confirmed; 1000]);
}

#[test]
fn a_confirmed_event_is_sent_as_often_as_any_other() {
    for (of, confirmations) in [("ua_0_2_10", 3), ("ua_0_2_12", 0)] {
        let of = topic(of);
        let mut cell = Cell::new(of, &[1]);
        let before = cell.datagrams;
        // The bridge asserts that each delivery needs a confirmation.
        if confirmations == 0 {
            cell.programs.truncate(1);
        }
        cell.write(of, 1);
        cell.run(Duration::from_millis(150));
        assert_eq!(cell.datagrams - before, 3 + confirmations, "{of}");
    }
}

#[test]
fn a_value_that_nobody_has_is_handed_over_as_soon_as_somebody_is_there_in_time() {
    let of = topic("ua_0_2_10");
    let mut cell = Cell::new(of, &[1]);
    cell.programs[1].handover = Handover::Nobody;
    cell.write(of, 7);
    cell.run(Duration::from_millis(500));
    assert!(cell.programs[1].got.is_empty());
    cell.programs[1].handover = Handover::Done;
    cell.run(Duration::from_secs(1));
    assert_eq!(cell.programs[1].got, [7], "once");
    assert_eq!(cell.arrivals(), [ConfirmedArrival::Confirmed]);
}

#[test]
fn a_value_that_nobody_has_in_time_is_unknown_and_does_not_come_later() {
    let of = topic("ua_0_2_10");
    let mut cell = Cell::new(of, &[1]);
    cell.programs[1].handover = Handover::Nobody;
    let mut held_back = Vec::new();
    let now = cell.now;
    cell.programs[0].write(of, &field(7), now);
    held_back.extend(cell.programs[0].turn(now));
    for datagram in &held_back {
        let bridge = &mut cell.programs[1].router;
        bridge.handle_datagram(datagram, address(100), now);
    }
    cell.run(Duration::from_millis(1100));
    assert_eq!(cell.arrivals(), [unknown(1)]);
    let counted = cell.programs[0].router.topics();
    let counted: u64 = counted.map(|(_, of)| of.dropped(Reason::Unconfirmed)).sum();
    assert_eq!(counted, 1);
    // A copy that the network delayed.
    cell.programs[1].handover = Handover::Done;
    for datagram in &held_back {
        let now = cell.now;
        let bridge = &mut cell.programs[1].router;
        bridge.handle_datagram(datagram, address(100), now);
    }
    cell.run(Duration::from_secs(1));
    assert!(cell.programs[1].got.is_empty());
}

#[test]
fn a_command_that_waited_for_a_stopped_bridge_until_it_was_given_up_is_not_delivered() {
    let of = topic("ua_0_2_10");
    for (stopped, got, late) in [(500, &[7][..], 0), (1100, &[], 1)] {
        let mut cell = Cell::new(of, &[1]);
        let mut bridge = cell.programs.pop().unwrap();
        cell.write(of, 7);
        // The datagrams wait in the socket of the bridge, the last one for a short time only.
        let mut waiting = Vec::new();
        let end = cell.now.monotonic + Duration::from_millis(stopped);
        while cell.now.monotonic < end {
            let sent = cell.programs[0].turn(cell.now);
            waiting.extend(sent.into_iter().map(|datagram| (datagram, cell.now.utc)));
            cell.now = later(cell.now, STEP);
        }
        for (datagram, arrived) in &waiting {
            let from = (address(100), Some(*arrived));
            bridge.router.handle_received(datagram, from, cell.now);
        }
        cell.programs.push(bridge);
        cell.run(Duration::from_secs(1));
        assert_eq!(cell.programs[1].got, got);
        let counted = cell.programs[1].router.topics();
        let counted: u64 = counted.map(|(_, of)| of.dropped(Reason::Late)).sum();
        assert_eq!(counted, late);
        let expected = match late {
            0 => ConfirmedArrival::Confirmed,
            _ => unknown(1),
        };
        assert_eq!(cell.arrivals(), [expected]);
        // The next command arrives.
        cell.write(of, 8);
        cell.run(Duration::from_millis(100));
        assert_eq!(cell.programs[1].got.last(), Some(&8));
    }
}

#[test]
fn a_value_whose_subscriber_gets_it_late_is_confirmed_then() {
    let of = topic("ua_0_2_10");
    let mut cell = Cell::new(of, &[1]);
    cell.programs[1].handover = Handover::Waiting;
    cell.write(of, 7);
    cell.run(Duration::from_millis(500));
    assert!(cell.arrivals().is_empty());
    cell.programs[1].handover = Handover::Done;
    cell.run(Duration::from_millis(100));
    assert_eq!(cell.arrivals(), [ConfirmedArrival::Confirmed]);
    assert_eq!(cell.programs[1].got, [7]);
}

#[test]
fn a_newer_write_goes_out_at_once_and_ends_the_repetition_of_the_one_before() {
    let of = topic("ua_0_2_10");
    let mut cell = Cell::new(of, &[1]);
    cell.loses = Box::new(|from, _| from == 100);
    cell.write(of, 1);
    cell.run(Duration::from_millis(300));
    cell.loses = Box::new(|_, _| false);
    cell.write(of, 2);
    cell.run(Duration::from_secs(2));
    assert_eq!(cell.programs[1].got, [2]);
    assert_eq!(cell.arrivals(), [ConfirmedArrival::Confirmed]);
    // The same holds for a newer event that waits for its publication time.
    let of = topic("ua_0_2_13");
    let mut cell = Cell::new(of, &[1]);
    cell.write(of, 1);
    cell.run(Duration::from_millis(300));
    assert_eq!(cell.arrivals(), [ConfirmedArrival::Confirmed]);
    cell.write(of, 2);
    cell.run(Duration::from_millis(300));
    assert!(cell.arrivals().is_empty());
    cell.run(Duration::from_secs(1));
    assert_eq!(cell.arrivals(), [ConfirmedArrival::Confirmed]);
    assert_eq!(cell.programs[1].got, [1, 2]);
}

#[test]
fn each_space_confirms_and_the_others_are_named() {
    let of = topic("ua_0_2_11");
    let mut cell = Cell::new(of, &[1, 2]);
    cell.loses = Box::new(|from, _| from == 102);
    cell.write(of, 1);
    cell.run(Duration::from_secs(2));
    assert_eq!(cell.arrivals(), [unknown(2)]);
    assert_eq!(cell.programs[2].got, [1], "its confirmation was lost");
}

#[test]
fn a_late_confirmation_is_ignored() {
    let of = topic("ua_0_2_10");
    let mut cell = Cell::new(of, &[1]);
    cell.write(of, 1);
    let now = cell.now;
    let mut confirmations = Vec::new();
    for datagram in cell.programs[0].turn(now) {
        let bridge = &mut cell.programs[1];
        bridge.router.handle_datagram(&datagram, address(100), now);
        confirmations.extend(bridge.turn(now));
    }
    assert_eq!(confirmations.len(), 1);
    cell.programs.truncate(1);
    cell.run(Duration::from_secs(2));
    assert_eq!(cell.arrivals(), [unknown(1)]);
    cell.write(of, 2);
    let now = cell.now;
    let server = &mut cell.programs[0].router;
    server.handle_datagram(&confirmations[0], address(101), now);
    cell.run(Duration::from_millis(500));
    assert!(cell.arrivals().is_empty(), "it is of the event before");
}

#[test]
fn a_confirmation_of_another_sender_than_the_one_that_announced_the_space_is_ignored() {
    let of = topic("ua_0_2_10");
    for announces in [false, true] {
        let mut cell = Cell::new(of, &[1]);
        // The bridge is present, but its local side has not received the value yet.
        cell.programs[1].handover = Handover::Waiting;
        let mut forger = Program::new(1, 666, of, cell.now);
        if announces {
            forger.introduce(cell.now);
        }
        cell.programs.push(forger);
        cell.write(of, 1);
        cell.run(Duration::from_millis(200));
        assert!(cell.arrivals().is_empty(), "{announces}");
        let counted = cell.programs[0].router.topics();
        let forged: u64 = counted.map(|(_, of)| of.dropped(Reason::Forged)).sum();
        assert!(forged > 0);
    }
}

#[test]
fn a_bridge_that_was_started_anew_confirms_from_another_address() {
    let of = topic("ua_0_2_10");
    let mut cell = Cell::new(of, &[1]);
    cell.write(of, 1);
    cell.run(Duration::from_secs(1));
    let mut anew = Program::new(1, 111, of, cell.now);
    anew.introduce(cell.now);
    cell.programs[1] = anew;
    cell.run(Duration::from_millis(500));
    cell.write(of, 2);
    cell.run(Duration::from_secs(2));
    assert_eq!(
        cell.arrivals(),
        [ConfirmedArrival::Confirmed, ConfirmedArrival::Confirmed]
    );
    assert_eq!(cell.programs[1].got, [2]);
}

#[test]
fn an_event_is_not_sent_again_after_its_commander_is_lost() {
    let of = topic("ua_0_2_10");
    let mut cell = Cell::new(of, &[1]);
    cell.loses = Box::new(|from, _| from == 100);
    cell.write(of, 1);
    cell.run(Duration::from_millis(300));
    let now = cell.now;
    cell.programs[0].router.set_live(of, false, now);
    cell.loses = Box::new(|_, _| false);
    cell.run(Duration::from_secs(2));
    assert_eq!(cell.arrivals(), [unknown(1)]);
    assert!(cell.programs[1].got.is_empty());
}

#[test]
fn a_large_event_is_confirmed_and_sent_again_whole() {
    let of = topic("ua_0_2_14");
    let mut cell = Cell::new(of, &[1]);
    let mut text = 1_u16.to_le_bytes().to_vec();
    text.push(BuiltinType::String.id());
    text.extend_from_slice(&20_000_u32.to_le_bytes());
    text.resize(text.len() + 20_000, b'a');
    cell.loses = Box::new(|from, _| from == 100);
    let now = cell.now;
    cell.programs[0].write(of, &text, now);
    cell.run(Duration::from_millis(100));
    cell.loses = Box::new(|_, _| false);
    cell.run(Duration::from_secs(1));
    assert_eq!(cell.programs[1].got.len(), 1);
    assert_eq!(cell.arrivals(), [ConfirmedArrival::Confirmed]);
}

#[test]
fn a_command_that_a_broker_delivers_late_is_dropped_and_counted() {
    let of = topic("ua_0_2_11");
    for (delay, got) in [(500, vec![7]), (1500, Vec::new())] {
        let mut cell = Cell::new(of, &[1]);
        let relay = Relay {
            within: Duration::from_secs(1),
            authorized: false,
        };
        for program in &mut cell.programs {
            program.router.set_relay(Some(relay));
        }
        cell.write(of, 7);
        // The broker holds the command and its repetitions, whose times of sending are later.
        let end = cell.now.monotonic + Duration::from_millis(delay);
        let mut held = Vec::new();
        while cell.now.monotonic < end {
            let now = cell.now;
            held.extend(cell.programs[0].turn(now));
            cell.now = later(now, STEP);
        }
        let now = cell.now;
        for datagram in &held {
            let router = &mut cell.programs[1].router;
            router.handle_datagram(datagram, address(100), now);
        }
        cell.run(Duration::from_millis(50));
        assert_eq!(cell.programs[1].got, got, "after {delay} ms");
        let router = &cell.programs[1].router;
        let topics = router.topics().map(|(_, of)| of.dropped(Reason::Late));
        let late = topics.sum::<u64>() + router.others().dropped(Reason::Late);
        assert_eq!(late > 0, got.is_empty(), "after {delay} ms");
    }
}
