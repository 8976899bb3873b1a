//! Delivery of events, states and commands to ROS on a network that loses datagrams, with a manual
//! clock.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    Delivery, Local, LocalMessage, Now, Output, PublisherKey, Reason, Router, RouterSettings,
    ValueRelation,
};
use mappings::{Mapping, ServiceRole, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::{
    BuiltinType, DataSetHeader, DateTime, GroupHeader, NetworkHeader, NetworkMessageEncoder,
    PublisherId, Scalar, Timestamp, Variant,
};

const STEP: Duration = Duration::from_millis(10);
const SECOND: Duration = Duration::from_secs(1);

fn address(port: u16) -> SocketAddr {
    ([127, 0, 0, 1], port).into()
}

fn topic(text: &str) -> TopicId {
    text.parse().unwrap()
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

fn router(own: u16, local: Local) -> Router {
    let settings = RouterSettings {
        own: SpaceId::new(own).unwrap(),
        local,
        source: Some(address(10_000 + own)),
    };
    Router::new(settings, Arc::new(Mapping::default()))
}

/// Creates a bridge of the space that binds the topic to std_msgs/UInt32.
fn bridge(own: u16, of: TopicId, now: Now) -> Router {
    let (local, dialect) = match own {
        1 => (Local::Ros1, Dialect::Ros1),
        _ => (Local::Cdr, Dialect::Ros2),
    };
    let mut router = router(own, local);
    let number = TypeRegistry::bundle(dialect).get(&"std_msgs/UInt32".parse().unwrap());
    router
        .bind(of, &number.unwrap(), &Selection::Whole, now)
        .unwrap();
    router
}

/// Returns the field of an OPC UA write.
fn field(value: u32) -> Vec<u8> {
    let mut block = 1_u16.to_le_bytes().to_vec();
    block.push(BuiltinType::UInt32.id());
    block.extend_from_slice(&value.to_le_bytes());
    block
}

fn say(router: &mut Router, of: TopicId, payload: &[u8], latched: bool, now: Now) {
    let heard = LocalMessage {
        topic: of,
        payload,
        received: now.utc,
        latched_by: latched.then_some(PublisherKey(1)),
    };
    let _verdict = router.handle_local(heard, now);
}

/// Returns the datagrams that the producer sends at this time.
fn sent(router: &mut Router, now: Now) -> Vec<Vec<u8>> {
    router.handle_timeout(now);
    let outputs = std::iter::from_fn(|| router.poll_output(now));
    outputs
        .filter_map(|output| match output {
            Output::Datagram { bytes, .. } => Some(bytes),
            _ => None,
        })
        .collect()
}

/// Returns the deliveries that a consumer publishes from the datagrams.
fn taken(router: &mut Router, datagrams: &[Vec<u8>], from: u16, now: Now) -> Vec<Delivery> {
    for datagram in datagrams {
        router.handle_datagram(datagram, address(from), now);
    }
    router.handle_timeout(now);
    let outputs: Vec<_> = std::iter::from_fn(|| router.poll_output(now)).collect();
    let deliveries = outputs.into_iter().filter_map(|output| match output {
        Output::Delivery(delivery) => Some(delivery),
        _ => None,
    });
    let deliveries: Vec<_> = deliveries.collect();
    for delivery in &deliveries {
        router.published(delivery.topic, delivery.arrived, now);
    }
    deliveries
}

/// Returns the number in the last four bytes.
fn number(delivery: &Delivery) -> u32 {
    u32::from_le_bytes(*delivery.payload.last_chunk().unwrap())
}

fn dropped(router: &Router, reason: Reason) -> u64 {
    router.topics().map(|(_, of)| of.dropped(reason)).sum()
}

/// Pseudorandom numbers, the same in each run.
struct Dice(u64);

impl Dice {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (self.0 >> 33) % end
    }

    fn loses_a_fifth(&mut self) -> bool {
        self.below(5) == 0
    }
}

/// A network that delays each datagram by up to 150 ms, so that datagrams overtake each other, and
/// duplicates a fifth of them.
struct Network {
    dice: Dice,
    under_way: Vec<(Instant, Vec<u8>)>,
}

impl Network {
    const fn new(seed: u64) -> Self {
        Self {
            dice: Dice(seed),
            under_way: Vec::new(),
        }
    }

    /// Starts the transmission of datagrams with a delay for each.
    fn send(&mut self, datagrams: Vec<Vec<u8>>, now: Now) {
        for datagram in datagrams {
            for _ in 0..1 + u64::from(self.dice.loses_a_fifth()) {
                let delay = Duration::from_millis(self.dice.below(150));
                self.under_way
                    .push((now.monotonic + delay, datagram.clone()));
            }
        }
    }

    /// Returns the datagrams with an elapsed delay in the order of their arrival.
    fn arrived(&mut self, now: Now) -> Vec<Vec<u8>> {
        let (mut arrived, rest): (Vec<_>, Vec<_>) = std::mem::take(&mut self.under_way)
            .into_iter()
            .partition(|(at, _)| *at <= now.monotonic);
        self.under_way = rest;
        arrived.sort_by_key(|(at, _)| *at);
        arrived.into_iter().map(|(_, datagram)| datagram).collect()
    }
}

#[test]
fn of_1000_stops_on_a_network_that_loses_a_fifth_at_most_18_are_lost_and_none_comes_twice() {
    let of = topic("ua_0_2_10");
    let mut now = start();
    let mut server = router(0, Local::Fields);
    let mut robot = bridge(1, of, now);
    let mut dice = Dice(34);
    let mut datagrams = 0;
    let mut came = Vec::new();
    for stop in 0..1000_u32 {
        say(&mut server, of, &field(stop), false, now);
        for _ in 0..20 {
            let sent = sent(&mut server, now);
            datagrams += sent.len();
            let kept: Vec<_> = sent.into_iter().filter(|_| !dice.loses_a_fifth()).collect();
            came.extend(taken(&mut robot, &kept, 1, now).iter().map(number));
            now = later(now, STEP);
        }
    }
    assert_eq!(datagrams, 3000, "each is sent three times");
    let mut once = came.clone();
    once.dedup();
    assert_eq!(once, came, "none comes twice");
    assert!(came.is_sorted(), "none comes late");
    assert!((982..1000).contains(&came.len()), "{} came", came.len());
}

#[test]
fn on_a_network_that_delays_and_reorders_no_event_and_no_command_comes_twice_or_after_a_newer_one()
{
    for (of, local) in [("ua_1_2_10", Local::Ros1), ("ua_0_2_10", Local::Fields)] {
        let of = topic(of);
        let mut now = start();
        let (mut sender, mut reader) = match local {
            Local::Fields => (router(0, local), bridge(1, of, now)),
            Local::Ros1 | Local::Cdr => (bridge(1, of, now), bridge(2, of, now)),
        };
        let mut network = Network::new(34);
        let mut dice = Dice(7);
        let mut came = Vec::new();
        let (bursts, each) = (100_u32, 20_u32);
        for burst in 0..bursts {
            // From 1 kHz to the rate at which each event is sent three times.
            let gap = [1, 5, 20, 35, 60, 120][usize::try_from(burst).unwrap() % 6];
            for value in 0..each {
                let value = burst * each + value;
                let payload = match local {
                    Local::Fields => field(value),
                    Local::Ros1 | Local::Cdr => value.to_le_bytes().to_vec(),
                };
                say(&mut sender, of, &payload, false, now);
                for _ in 0..gap {
                    network.send(sent(&mut sender, now), now);
                    came.extend(taken(&mut reader, &network.arrived(now), 1, now));
                    now = later(now, Duration::from_millis(1));
                }
            }
            // In some rounds the last event is also repeated for readers that show it, and in some
            // rounds the producer ends.
            let ends = burst % 3 == 0;
            if ends {
                sender.set_live(of, false, now);
            }
            for _ in 0..200 + dice.below(2000) {
                network.send(sent(&mut sender, now), now);
                came.extend(taken(&mut reader, &network.arrived(now), 1, now));
                now = later(now, Duration::from_millis(1));
            }
            if ends {
                sender.set_live(of, true, now);
            }
        }
        assert!(came.iter().all(|one| !one.lasting), "{of}");
        let came: Vec<_> = came.iter().map(number).collect();
        assert!(came.is_sorted_by(|a, b| a < b), "{of}: {came:?}");
        let last: Vec<_> = (1..=bursts).map(|burst| burst * each - 1).collect();
        let missing = last.iter().filter(|last| !came.contains(last)).count();
        assert_eq!(missing, 0, "{of}: the last one of each burst arrives");
    }
}

#[test]
fn a_newer_sample_ends_the_repetition_of_the_one_before() {
    let of = topic("ua_0_2_10");
    let mut now = start();
    let mut server = router(0, Local::Fields);
    let mut count = 0;
    for value in 0..100 {
        say(&mut server, of, &field(value), false, now);
        count += sent(&mut server, now).len();
        now = later(now, STEP);
    }
    assert_eq!(count, 100, "a stream costs nothing");
}

#[test]
fn the_first_event_of_a_producer_that_starts_over_is_never_taken_for_old() {
    let of = topic("ua_0_2_10");
    let begin = start();
    // By its stamp, by its address, and with a clock that was set back after the producer had timed
    // out.
    for (after, clock, port) in [(1, 0, 1), (1, -3600, 2), (10, -3600, 1)] {
        let mut now = begin;
        let mut robot = bridge(1, of, now);
        let mut server = router(0, Local::Fields);
        for value in 0..50 {
            say(&mut server, of, &field(value), false, now);
            assert_eq!(taken(&mut robot, &sent(&mut server, now), 1, now).len(), 1);
            now = later(now, SECOND / 5);
        }
        let mut server = router(0, Local::Fields);
        now = later(now, SECOND * after);
        taken(&mut robot, &[], port, now);
        let shifted = Now {
            utc: Timestamp::from_unix_nanos(now.utc.unix_nanos() + clock * 1_000_000_000),
            ..now
        };
        say(&mut server, of, &field(7), false, shifted);
        let came = taken(&mut robot, &sent(&mut server, shifted), port, now);
        assert_eq!(came.iter().map(number).collect::<Vec<_>>(), [7], "{clock}");
    }
}

#[test]
fn an_event_of_ros_is_published_once_and_shown_to_readers_that_come_late() {
    let of = topic("ua_1_2_10");
    let mut now = start();
    let mut robot = bridge(1, of, now);
    let mut present = bridge(2, of, now);
    say(&mut robot, of, &5_u32.to_le_bytes(), false, now);
    let mut came = taken(&mut present, &sent(&mut robot, now), 1, now);
    // Two late readers: a bridge, and a server that shows the value.
    let mut late = bridge(2, of, now);
    let mut server = router(0, Local::Fields);
    let mut published = Vec::new();
    let mut shown = Vec::new();
    for _ in 0..500 {
        now = later(now, STEP);
        let sent = sent(&mut robot, now);
        came.extend(taken(&mut present, &sent, 1, now));
        if now.monotonic > start().monotonic + SECOND {
            published.extend(taken(&mut late, &sent, 1, now));
            shown.extend(taken(&mut server, &sent, 1, now));
        }
    }
    assert_eq!(came.iter().map(number).collect::<Vec<_>>(), [5]);
    assert!(came.iter().all(|delivery| !delivery.lasting));
    assert_eq!(published, []);
    assert_eq!(shown.iter().map(number).collect::<Vec<_>>(), [5]);
    assert!(
        dropped(&late, Reason::Repeat) > 0,
        "what is dropped is counted"
    );
}

#[test]
fn an_event_whose_datagrams_were_all_lost_does_not_come_with_a_later_repetition() {
    let of = topic("ua_1_2_10");
    let mut now = start();
    let mut robot = bridge(1, of, now);
    let mut bridge = bridge(2, of, now);
    say(&mut robot, of, &1_u32.to_le_bytes(), false, now);
    let mut came = taken(&mut bridge, &sent(&mut robot, now), 1, now);
    now = later(now, SECOND);
    say(&mut robot, of, &2_u32.to_le_bytes(), false, now);
    for step in 0..300 {
        let sent = sent(&mut robot, now);
        if step > 15 {
            came.extend(taken(&mut bridge, &sent, 1, now));
        }
        now = later(now, STEP);
    }
    assert_eq!(came.iter().map(number).collect::<Vec<_>>(), [1]);
}

#[test]
fn a_latched_value_reaches_a_bridge_that_starts_late_and_is_stored_there() {
    let of = topic("ua_1_2_10");
    let mut now = start();
    let mut robot = bridge(1, of, now);
    let mut present = bridge(2, of, now);
    say(&mut robot, of, &5_u32.to_le_bytes(), true, now);
    let mut came = taken(&mut present, &sent(&mut robot, now), 1, now);
    let mut late = bridge(2, of, now);
    let mut stored = Vec::new();
    for _ in 0..50 {
        now = later(now, SECOND / 10);
        let sent = sent(&mut robot, now);
        came.extend(taken(&mut present, &sent, 1, now));
        stored.extend(taken(&mut late, &sent, 1, now));
    }
    // Once for the present subscribers, and once to be stored.
    let kinds: Vec<_> = came.iter().map(|one| (one.kept, one.lasting)).collect();
    assert_eq!(
        kinds,
        [(ValueRelation::Alone, false), (ValueRelation::Again, true)]
    );
    let kinds: Vec<_> = stored.iter().map(|one| (one.kept, one.lasting)).collect();
    assert_eq!(kinds, [(ValueRelation::Alone, true)]);
    // The next value is known to be a state at once.
    say(&mut robot, of, &6_u32.to_le_bytes(), true, now);
    let next = taken(&mut present, &sent(&mut robot, now), 1, now);
    assert!(matches!(&next[..], [one] if one.lasting && number(one) == 6));
}

#[test]
fn a_state_whose_producer_timed_out_comes_again_for_late_subscribers_when_it_is_back() {
    let of = topic("ua_1_2_10");
    let mut now = start();
    let mut robot = bridge(1, of, now);
    let mut bridge = bridge(2, of, now);
    say(&mut robot, of, &5_u32.to_le_bytes(), true, now);
    let mut came = Vec::new();
    for step in 0..200 {
        let sent = sent(&mut robot, now);
        let cut = (30..100).contains(&step);
        let sent = if cut { Vec::new() } else { sent };
        came.extend(taken(&mut bridge, &sent, 1, now));
        now = later(now, SECOND / 10);
    }
    let kinds: Vec<_> = came.iter().map(|one| (one.kept, one.lasting)).collect();
    let stored = (ValueRelation::Again, true);
    assert_eq!(kinds, [(ValueRelation::Alone, false), stored, stored]);
}

#[test]
fn values_under_a_stamp_that_stands_still_are_all_taken_by_their_numbers() {
    let of = topic("ua_2_9_11");
    let begin = start();
    for (stamp, picoseconds) in [(133_000_000_000_000_000, 7), (0, 0)] {
        for mut reader in [bridge(1, of, begin), router(0, Local::Fields)] {
            let mut came = Vec::new();
            for value in 1..=8_u16 {
                let now = later(begin, SECOND * value.into());
                let header = DataSetHeader {
                    sequence_number: Some(value),
                    timestamp: Some(DateTime(stamp)),
                    picoseconds: Some(picoseconds),
                    ..DataSetHeader::default()
                };
                let frame = frame(&header, u32::from(value));
                // Each datagram is received twice.
                came.extend(taken(&mut reader, &[frame.clone(), frame], 1, now));
            }
            let came: Vec<_> = came.iter().map(number).collect();
            assert_eq!(came, [1, 2, 3, 4, 5, 6, 7, 8]);
        }
    }
}

#[test]
fn an_older_number_after_a_newer_one_is_dropped_and_counted() {
    let of = topic("ua_2_9_11");
    let now = start();
    let mut robot = bridge(1, of, now);
    let header = |sequence| DataSetHeader {
        sequence_number: Some(sequence),
        ..DataSetHeader::default()
    };
    let frames: Vec<_> = [5_u16, 7, 6]
        .map(|sequence| frame(&header(sequence), u32::from(sequence)))
        .into();
    let came = taken(&mut robot, &frames, 1, now);
    assert_eq!(came.iter().map(number).collect::<Vec<_>>().last(), Some(&7));
    assert_eq!(dropped(&robot, Reason::Stale), 1);
}

/// Returns a key frame of ua_2_9_11 from a foreign writer with a single UInt32.
fn frame(header: &DataSetHeader, value: u32) -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        group: Some(GroupHeader {
            writer_group_id: Some(9),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut bytes = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[11])).unwrap();
    let mut frame = message.key_frame(header).unwrap();
    let value = Variant::Scalar(Scalar::UInt32(value));
    frame.variant(&value).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    bytes
}

#[test]
fn stored_values_are_no_samples_of_a_delay() {
    let of = topic("ua_1_2_10");
    let mut now = start();
    let mut robot = bridge(1, of, now);
    say(&mut robot, of, &5_u32.to_le_bytes(), true, now);
    sent(&mut robot, now);
    now = later(now, SECOND * 20);
    let mut late = bridge(2, of, now);
    for _ in 0..50 {
        now = later(now, SECOND / 10);
        let sent = sent(&mut robot, now);
        taken(&mut late, &sent, 1, now);
    }
    let origin = late.hops().of(bridge_core::Hop::Origin);
    assert_eq!(origin.count(), 0, "{} us", origin.quantile_us(1.0));
}

const COMMANDS: &str = "
spaces: [{id: 1}]
namespaces: {2: urn:cell}
variables:
  - {node: ns=2;i=10, name: Drive, origin: 0, on_loss: zero, ros: {space: 1, topic: /cmd_vel, type: geometry_msgs/Twist}}
  - {node: ns=2;i=11, name: Held, origin: 0, on_loss: {twist.linear.x: 0.5}, hold: 500ms, ros: {space: 1, topic: /held, type: geometry_msgs/TwistStamped}}
  - {node: ns=2;i=12, name: Arm, origin: 0, type: UInt32, on_loss: {call: ns=2;i=13}, ros: {space: 1, topic: /arm, type: std_msgs/UInt32, field: data}}
  - {node: ns=2;i=13, name: Stop, origin: 0, type: Boolean, ros: {space: 1, call: /stop, type: std_srvs/Trigger, when: true}}
  - {node: ns=2;i=14, name: Motor, origin: 0, type: Boolean, on_loss: false, ros: {space: 1, call: /motor, type: std_srvs/SetBool, field: data}}
";

/// Creates a bridge of space 1 with the mapping, which binds the topic to the type.
fn commanded(of: TopicId, type_name: &str, selection: &Selection, now: Now) -> Router {
    let checked = Mapping::from_yaml(COMMANDS, "cell.yaml");
    let settings = RouterSettings {
        own: SpaceId::ROS1,
        local: Local::Ros1,
        source: Some(address(10_001)),
    };
    let mut router = Router::new(settings, Arc::new(checked.mapping.unwrap()));
    for (topic, type_name, selection) in [
        (of, type_name, selection),
        (topic("ua_0_2_13"), "std_msgs/Bool", &Selection::Whole),
    ] {
        let message = TypeRegistry::bundle(Dialect::Ros1).get(&type_name.parse().unwrap());
        router
            .bind(topic, &message.unwrap(), selection, now)
            .unwrap();
    }
    router
}

/// Returns the fields of numbers.
fn doubles(values: &[f64]) -> Vec<u8> {
    let mut block = u16::try_from(values.len()).unwrap().to_le_bytes().to_vec();
    for value in values {
        block.push(BuiltinType::Double.id());
        block.extend_from_slice(&value.to_le_bytes());
    }
    block
}

#[test]
fn a_robot_gets_zero_once_when_its_commander_times_out() {
    let of = topic("ua_0_2_10");
    let mut now = start();
    let mut robot = commanded(of, "geometry_msgs/Twist", &Selection::Whole, now);
    let mut server = router(0, Local::Fields);
    let mut stops = Vec::new();
    for _ in 0..2 {
        say(
            &mut server,
            of,
            &doubles(&[0.22, 0.0, 0.0, 0.0, 0.0, 0.5]),
            false,
            now,
        );
        let moves = taken(&mut robot, &sent(&mut server, now), 1, now);
        assert_eq!(moves.len(), 1);
        for _ in 0..100 {
            now = later(now, SECOND / 10);
            stops.extend(taken(&mut robot, &[], 1, now));
        }
    }
    let stops: Vec<_> = stops
        .iter()
        .map(|stop| (stop.topic, &stop.payload[..]))
        .collect();
    assert_eq!(
        stops,
        [(of, &[0; 48][..]), (of, &[0; 48][..])],
        "once each time"
    );
}

#[test]
fn a_robot_that_nobody_commanded_gets_nothing_when_a_producer_goes() {
    let of = topic("ua_0_2_10");
    let mut now = start();
    let mut robot = commanded(of, "geometry_msgs/Twist", &Selection::Whole, now);
    let mut server = router(0, Local::Fields);
    server.set_live(of, true, now);
    for _ in 0..100 {
        now = later(now, SECOND / 10);
        assert_eq!(taken(&mut robot, &[], 1, now), []);
    }
}

#[test]
fn a_value_that_is_not_renewed_is_held_no_longer_than_the_mapping_says() {
    let of = topic("ua_0_2_11");
    let mut now = start();
    let twist = Selection::Field("twist".to_owned());
    let mut robot = commanded(of, "geometry_msgs/TwistStamped", &twist, now);
    let mut server = router(0, Local::Fields);
    let mut stops = Vec::new();
    for step in 0..200_u32 {
        // Renewed every 100 ms for a second; the program itself continues.
        if step % 10 == 0 && step < 100 {
            say(
                &mut server,
                of,
                &doubles(&[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
                false,
                now,
            );
        }
        let came = taken(&mut robot, &sent(&mut server, now), 1, now);
        let half = 0.5_f64.to_le_bytes();
        stops.extend(
            came.into_iter()
                .filter(|one| one.payload.windows(8).any(|at| at == half))
                .map(|stop| (step, stop)),
        );
        now = later(now, STEP);
    }
    let [(step, stop)] = &stops[..] else {
        panic!("{} stops", stops.len())
    };
    assert!((140..=142).contains(step), "{step}");
    // After `seq`, the stamp of the header is the time of the loss.
    let seconds = u32::from_le_bytes(stop.payload[4..8].try_into().unwrap());
    assert_eq!(seconds, 1_700_000_001);
}

#[test]
fn a_service_is_called_when_the_commander_of_an_arm_is_lost() {
    let of = topic("ua_0_2_12");
    let mut now = start();
    let data = Selection::Field("data".to_owned());
    let mut robot = commanded(of, "std_msgs/UInt32", &data, now);
    let mut server = router(0, Local::Fields);
    say(&mut server, of, &field(3), false, now);
    taken(&mut robot, &sent(&mut server, now), 1, now);
    let mut came = Vec::new();
    for _ in 0..100 {
        now = later(now, SECOND / 10);
        came.extend(taken(&mut robot, &[], 1, now));
    }
    let came: Vec<_> = came
        .iter()
        .map(|one| (one.topic, &one.payload[..]))
        .collect();
    assert_eq!(came, [(topic("ua_0_2_13"), &[1][..])]);
}

#[test]
fn a_service_is_called_once_more_when_the_commander_of_a_value_that_calls_it_is_lost() {
    let of = topic("ua_0_2_14");
    let mut now = start();
    let checked = Mapping::from_yaml(COMMANDS, "cell.yaml").mapping.unwrap();
    let variable = checked.variable(of).unwrap();
    let service = variable.service.as_ref().unwrap();
    let ServiceRole::Call { request, .. } = &service.role else {
        panic!("{service:?}")
    };
    let mut robot = commanded(topic("ua_0_2_13"), "std_msgs/Bool", &Selection::Whole, now);
    let set_bool =
        TypeRegistry::bundle(Dialect::Ros1).service(&"std_srvs/SetBool".parse().unwrap());
    let set_bool = set_bool.unwrap();
    robot.bind(of, set_bool.request(), request, now).unwrap();
    let mut server = router(0, Local::Fields);
    let mut came = Vec::new();
    let on = [1, 0, BuiltinType::Boolean.id(), 1];
    say(&mut server, of, &on, false, now);
    came.extend(taken(&mut robot, &sent(&mut server, now), 1, now));
    for _ in 0..100 {
        now = later(now, SECOND / 10);
        came.extend(taken(&mut robot, &[], 1, now));
    }
    let came: Vec<_> = came
        .iter()
        .map(|one| (one.topic, &one.payload[..]))
        .collect();
    assert_eq!(came, [(of, &[1][..]), (of, &[0][..])]);
}

/// Returns a ROS 2 bridge without known types that has received an event of `size` characters from
/// ROS 1, and the characters.
fn heard_before_its_type(of: TopicId, size: usize, now: Now) -> (Router, Vec<u8>) {
    let mut producer = router(1, Local::Ros1);
    let text = TypeRegistry::bundle(Dialect::Ros1).get(&"std_msgs/String".parse().unwrap());
    producer
        .bind(of, &text.unwrap(), &Selection::Whole, now)
        .unwrap();
    let characters = vec![b'a'; size];
    let mut message = u32::try_from(size).unwrap().to_le_bytes().to_vec();
    message.extend_from_slice(&characters);
    say(&mut producer, of, &message, false, now);
    let mut consumer = router(2, Local::Cdr);
    let mut at = now;
    for _ in 0..20 {
        let datagrams = sent(&mut producer, at);
        assert_eq!(taken(&mut consumer, &datagrams, 1, at), []);
        at = later(at, STEP / 10);
    }
    (consumer, characters)
}

/// Returns the deliveries that the bridge publishes after the topic was bound to std_msgs/String.
fn typed(router: &mut Router, of: TopicId, now: Now) -> Vec<Delivery> {
    let text = TypeRegistry::bundle(Dialect::Ros2).get(&"std_msgs/String".parse().unwrap());
    router
        .bind(of, &text.unwrap(), &Selection::Whole, now)
        .unwrap();
    taken(router, &[], 1, now)
}

#[test]
fn an_event_of_any_size_waits_a_second_for_its_type_and_is_lost_after_it() {
    let of = topic("ua_1_5_10");
    for size in [10, 5_000, 60_000, 1_000_000] {
        let now = start();
        let (mut consumer, characters) = heard_before_its_type(of, size, now);
        let published = typed(&mut consumer, of, later(now, SECOND / 2));
        assert_eq!(published.len(), 1, "{size} bytes");
        let has_all = published[0]
            .payload
            .windows(size)
            .any(|of| of == characters);
        assert!(has_all && !published[0].lasting, "{size} bytes");

        let (mut consumer, _) = heard_before_its_type(of, size, now);
        let late = later(now, SECOND * 3 / 2);
        assert_eq!(taken(&mut consumer, &[], 1, late), []);
        assert_eq!(typed(&mut consumer, of, late), [], "{size} bytes");
        assert_eq!(dropped(&consumer, Reason::NotPublished), 1, "{size} bytes");
    }
}
