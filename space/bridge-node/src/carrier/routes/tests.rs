use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use uadp::action::{ActionCall, ActionEncoder, ActionHeader, ActionStart, ActionState};
use uadp::discovery::Probe;
use uadp::{
    ChunkBudget, ChunkEncoder, DataSetHeader, DateTime, Extras, GroupHeader, NetworkHeader,
    NetworkMessageEncoder, Scalar, SecurityHeader, Whole,
};

use super::*;

const CELL: &str = "
pubsub:
  - udp: {}
    forward: [ua_1_2, ua_0_2_20]
  - mqtt: {address: mqtt://broker.local}
    forward: [ua_2_5_60, ua_2_5_61]
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:a, 5: urn:b}
variables:
  - {node: ns=2;i=10, name: battery, origin: 1, queue: keep_latest,
     ros: {space: 1, topic: /battery, type: std_msgs/Float64}}
  - {node: ns=2;i=20, name: target, origin: 0, confirm: {within: 500ms},
     ros: {space: 2, topic: /target, type: std_msgs/Float64}}
  - {node: ns=5;i=61, name: alert, origin: 2, queue: {drop_oldest: 10},
     ros: {space: 2, topic: /alert, type: std_msgs/Float64}}
";
const UDP: usize = 0;
const MQTT: usize = 1;
const NOWHERE: [usize; 0] = [];

fn routes() -> Routes {
    routes_of(CELL)
}

fn routes_of(cell: &str) -> Routes {
    let checked = Mapping::from_yaml(cell, "cell.yaml");
    let findings = format!("{:?}", checked.findings);
    Routes::new(&Arc::new(checked.mapping.expect(&findings)))
}

fn path(carrier: usize, port: u16) -> MessagePath {
    let from = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), port);
    MessagePath { carrier, from }
}

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn start() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
    }
}

fn later(now: Now, millis: u64) -> Now {
    Now {
        monotonic: now.monotonic + Duration::from_millis(millis),
        utc: Timestamp::from_unix_nanos(now.utc.unix_nanos() + i128::from(millis) * 1_000_000),
    }
}

fn header(publisher: u16, group: u16, sent: Option<Timestamp>) -> NetworkHeader<'static> {
    NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(publisher)),
        group: Some(GroupHeader {
            writer_group_id: Some(group),
            ..GroupHeader::default()
        }),
        timestamp: sent.map(|sent| sent.time),
        ..NetworkHeader::default()
    }
}

/// Returns a value with its sequence number and times.
fn value(
    (publisher, group, writer): (u16, u16, u16),
    number: u16,
    (sent, taken): (Option<Timestamp>, Option<Timestamp>),
) -> Vec<u8> {
    let mut bytes = Vec::new();
    let network = header(publisher, group, sent);
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[writer])).unwrap();
    let about = DataSetHeader {
        sequence_number: Some(number),
        timestamp: taken.map(|taken| taken.time),
        ..DataSetHeader::default()
    };
    let mut frame = message.key_frame(&about).unwrap();
    frame.scalar(Scalar::Double(1.5)).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    bytes
}

/// Returns a message with a value of `ua_0_2_21` and a command of `ua_0_2_20`, by their sequence
/// numbers.
fn value_and_command(value: u16, command: u16, sent: Timestamp) -> Vec<u8> {
    let mut bytes = Vec::new();
    let network = header(0, 2, Some(sent));
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[21, 20])).unwrap();
    for number in [value, command] {
        let about = DataSetHeader {
            sequence_number: Some(number),
            ..DataSetHeader::default()
        };
        let mut frame = message.key_frame(&about).unwrap();
        frame.scalar(Scalar::Double(1.5)).unwrap();
        frame.finish().unwrap();
    }
    message.finish().unwrap();
    bytes
}

fn keep_alive((publisher, group, writer): (u16, u16, u16), number: u16) -> Vec<u8> {
    let mut bytes = Vec::new();
    let network = header(publisher, group, None);
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[writer])).unwrap();
    let about = DataSetHeader {
        sequence_number: Some(number),
        ..DataSetHeader::default()
    };
    message.keep_alive(&about).unwrap();
    message.finish().unwrap();
    bytes
}

/// Returns a request or response of `ua_<publisher>_<group>_<writer>`.
fn action(
    kind: ActionKind,
    (publisher, group, writer): (u16, u16, u16),
    requestor: u16,
    sent: Option<Timestamp>,
) -> Vec<u8> {
    let start = ActionStart {
        network: header(publisher, group, sent),
        action: ActionHeader {
            correlation_data: Some(&[7]),
            requestor_id: Some(PublisherId::UInt16(requestor)),
            timeout_hint: Some(300.0),
            ..ActionHeader::new(kind)
        },
        dialect: ActionDialect::Standard,
        extras: Extras::default(),
    };
    let call = ActionCall {
        target_id: 1,
        request_id: 1,
        state: ActionState::Executing,
    };
    let mut bytes = Vec::new();
    let mut message = ActionEncoder::new(&mut bytes, &start, &[writer]).unwrap();
    let fields = message.variants(&DataSetHeader::default(), call).unwrap();
    fields.finish().unwrap();
    message.finish().unwrap();
    bytes
}

fn targets(judgement: &Judgement) -> &[usize] {
    let forward = judgement.forward.as_ref();
    forward.map_or(&[], |forward| forward.carriers.as_slice())
}

#[test]
fn a_value_goes_from_the_carrier_of_its_publisher_to_the_others_only() {
    let (mut routes, now) = (routes(), start());
    let sent = (Some(now.utc), Some(now.utc));
    let of_route = value((1, 2, 10), 1, sent);
    let forward = routes.judge(&of_route, path(UDP, 9), now).forward.unwrap();
    assert_eq!(forward.carriers, [MQTT]);
    assert!(forward.replaceable && !forward.command);
    // The broker's default.
    assert_eq!(forward.within, Some(Duration::from_secs(1)));

    for (bytes, carrier) in [
        (value((1, 2, 10), 2, sent), MQTT),
        (value((1, 3, 10), 1, sent), UDP),
        (value((2, 5, 61), 1, sent), UDP),
    ] {
        let judgement = routes.judge(&bytes, path(carrier, 9), now);
        assert_eq!(judgement, Judgement::default());
    }
}

#[test]
fn a_copy_by_another_way_is_dropped_and_ends_a_loop() {
    let (mut routes, now) = (routes(), start());
    let bytes = value((1, 2, 10), 1, (Some(now.utc), None));
    assert_eq!(targets(&routes.judge(&bytes, path(UDP, 9), now)), [MQTT]);
    // Another program forwards it back, with the time of its own transmission.
    let back = value((1, 2, 10), 1, (Some(later(now, 1).utc), None));
    for by in [path(MQTT, 1), path(UDP, 8)] {
        let judgement = routes.judge(&back, by, later(now, 1));
        assert_eq!(judgement.dropped, Some(DOUBLED));
        assert_eq!(targets(&judgement), NOWHERE);
    }
    // The publisher repeats it, as it does for late joiners.
    let again = routes.judge(&back, path(UDP, 9), later(now, 1000));
    assert_eq!((again.dropped, targets(&again)), (None, [MQTT].as_slice()));
    // A loop over brokers, which have one address, is faster.
    let looped = routes.judge(&back, path(UDP, 9), later(now, 1010));
    assert_eq!(looped.not_forwarded, Some(LOOPED));
}

#[test]
fn a_copy_of_an_own_message_is_dropped() {
    let (mut routes, now) = (routes(), start());
    let bytes = value((2, 5, 61), 1, (Some(now.utc), None));
    routes.sent(&bytes, now.monotonic);
    let judgement = routes.judge(&bytes, path(MQTT, 1), now);
    assert_eq!(judgement.dropped, Some(DOUBLED));
    routes.sent(&bytes, later(now, 500).monotonic);
    let judgement = routes.judge(&bytes, path(MQTT, 1), later(now, 501));
    assert_eq!(judgement.dropped, Some(DOUBLED));
}

#[test]
fn the_memory_of_messages_is_bounded() {
    let (mut routes, now) = (routes(), start());
    let bytes = value((1, 2, 10), 1, (None, None));
    routes.judge(&bytes, path(UDP, 9), now);
    for number in 0..70_000_u32 {
        let identity = u64::from(number);
        routes
            .seen
            .note(identity, Some(path(UDP, 9)), now.monotonic);
    }
    assert!(routes.seen.young.len() + routes.seen.old.len() <= 2 * MOST_SEEN);
}

#[test]
fn a_publisher_that_moves_to_another_address_is_received_again() {
    let (mut routes, now) = (routes(), start());
    let bytes = keep_alive((1, 2, 10), 7);
    for (millis, dropped) in [(0, None), (2999, Some(DOUBLED)), (3000, None), (3001, None)] {
        let port = if millis == 0 { 9 } else { 8 };
        let judgement = routes.judge(&bytes, path(UDP, port), later(now, millis));
        assert_eq!(judgement.dropped, dropped, "{millis} ms");
    }
}

#[test]
fn a_command_crosses_once_and_only_in_time() {
    let (mut routes, now) = (routes(), start());
    let topic = (0, 2, 20);
    let forward = routes.judge(
        &value(topic, 1, (Some(now.utc), Some(now.utc))),
        path(UDP, 9),
        now,
    );
    let forward = forward.forward.unwrap();
    assert!(forward.command && !forward.replaceable);
    assert_eq!(forward.within, Some(Duration::from_millis(500)));
    // The repetition has a new time of sending.
    let next = later(now, 200);
    let repeated = value(topic, 1, (Some(next.utc), Some(now.utc)));
    let judgement = routes.judge(&repeated, path(UDP, 9), next);
    assert_eq!(judgement.not_forwarded, Some(REPEATED));
    assert_eq!(judgement.dropped, None);
    // Its keep-alives go on.
    for seconds in [1, 2, 3] {
        let at = later(now, seconds * 1000);
        let judgement = routes.judge(&keep_alive(topic, 2), path(UDP, 9), at);
        assert_eq!(targets(&judgement), [MQTT], "{judgement:?}");
    }
}

#[test]
fn a_command_among_other_values_crosses_once_too() {
    let mut routes = routes_of(&CELL.replace("ua_0_2_20", "ua_0_2"));
    let now = start();
    let first = routes.judge(&value_and_command(1, 1, now.utc), path(UDP, 9), now);
    let forward = first.forward.unwrap();
    assert!(forward.command && !forward.replaceable);
    assert_eq!(forward.within, Some(Duration::from_millis(500)));
    // The value is new, and the command is repeated with a new time of sending.
    let next = later(now, 200);
    let repeated = routes.judge(&value_and_command(2, 1, next.utc), path(UDP, 9), next);
    assert_eq!(repeated.not_forwarded, Some(REPEATED));
    assert_eq!((repeated.dropped, repeated.forward), (None, None));
    let other = routes.judge(&value_and_command(3, 2, next.utc), path(UDP, 9), next);
    assert_eq!(targets(&other), [MQTT]);
}

#[test]
fn a_probe_does_not_go_round_between_the_carriers_of_a_divided_space() {
    let mut routes = routes_of(&CELL.replace("ua_2_5_60", "ua_1_3"));
    let now = start();
    let probe = |publisher| {
        let mut bytes = Vec::new();
        let id = Some(PublisherId::UInt16(publisher));
        let encoded = Probe::PublisherEndpoints.encode(id, SecurityHeader::NONE, &mut bytes);
        encoded.unwrap();
        bytes
    };
    let divided = probe(1);
    assert_eq!(targets(&routes.judge(&divided, path(UDP, 9), now)), [MQTT]);
    // Another program forwards the same probe. It is delivered here, and not forwarded again.
    for by in [path(MQTT, 1), path(UDP, 8)] {
        let echo = routes.judge(&divided, by, later(now, 100));
        assert_eq!((echo.dropped, echo.not_forwarded), (None, Some(LOOPED)));
        assert_eq!(targets(&echo), NOWHERE);
    }
    // The publisher is at one carrier: the probes of several programs reach it.
    let single = probe(2);
    for port in [9, 8] {
        let judgement = routes.judge(&single, path(UDP, port), now);
        assert_eq!(targets(&judgement), [MQTT]);
    }
}

#[test]
fn a_late_message_of_a_broker_is_not_forwarded() {
    let (mut routes, now) = (routes(), start());
    let event = (2, 5, 61);
    for (number, age, refused) in [(1, 0, None), (2, 1000, None), (3, 1001, Some(LATE))] {
        let bytes = value(event, number, (Some(now.utc), None));
        let judgement = routes.judge(&bytes, path(MQTT, 1), later(now, age));
        assert_eq!(judgement.not_forwarded, refused, "{age} ms");
        assert_eq!(judgement.forward.is_some(), refused.is_none());
    }
    let untimed = value(event, 4, (None, None));
    let judgement = routes.judge(&untimed, path(MQTT, 1), now);
    assert_eq!(judgement.not_forwarded, Some(UNTIMED));
    let taken_only = value(event, 5, (None, Some(now.utc)));
    let judgement = routes.judge(&taken_only, path(MQTT, 1), later(now, 1500));
    assert_eq!(judgement.not_forwarded, Some(LATE));
}

#[test]
fn a_command_of_a_broker_counts_for_its_own_time() {
    let cell = CELL.replace("ua_1_2, ua_0_2_20", "ua_1_2");
    let mut routes = routes_of(&cell.replace("ua_2_5_60,", "ua_2_5_60, ua_0_2_20,"));
    let now = start();
    for (number, age, refused) in [(1, 500, None), (2, 501, Some(LATE))] {
        let bytes = value((0, 2, 20), number, (Some(now.utc), None));
        let judgement = routes.judge(&bytes, path(MQTT, 1), later(now, age));
        assert_eq!(judgement.not_forwarded, refused, "{age} ms");
    }
    let untimed = value((0, 2, 20), 3, (None, None));
    let judgement = routes.judge(&untimed, path(MQTT, 1), now);
    assert_eq!(judgement.not_forwarded, Some(UNTIMED));
}

#[test]
fn a_command_of_udp_crosses_only_in_time() {
    let groups = CELL.replace(
        "mqtt: {address: mqtt://broker.local}",
        "udp: {address: opc.udp://239.192.0.41}",
    );
    for cell in [CELL, &groups] {
        let (mut routes, now) = (routes_of(cell), start());
        for (number, sent, age, refused) in [
            (1, Some(now.utc), 500, None),
            (2, Some(now.utc), 501, Some(LATE)),
            (3, None, 0, Some(UNTIMED)),
        ] {
            let bytes = value((0, 2, 20), number, (sent, None));
            let judgement = routes.judge(&bytes, path(UDP, 9), later(now, age));
            assert_eq!(judgement.not_forwarded, refused, "{age} ms");
        }
        // The age of other values does not matter.
        let state = value((1, 2, 10), 1, (Some(now.utc), None));
        let judgement = routes.judge(&state, path(UDP, 9), later(now, 60_000));
        assert_eq!(targets(&judgement), [1]);
    }
}

#[test]
fn requests_go_to_the_executor_and_responses_come_back() {
    let (mut routes, now) = (routes(), start());
    let call = (2, 5, 60);
    let request = action(ActionKind::Request, call, 1, Some(now.utc));
    assert_eq!(targets(&routes.judge(&request, path(UDP, 9), now)), [MQTT]);
    let response = action(ActionKind::Response, call, 1, None);
    assert_eq!(targets(&routes.judge(&response, path(MQTT, 1), now)), [UDP]);
    let other = action(ActionKind::Request, (2, 5, 62), 1, Some(now.utc));
    assert_eq!(targets(&routes.judge(&other, path(UDP, 9), now)), NOWHERE);
}

/// Returns a chunk of a request or response of `ua_2_5_60`, which does not show its direction.
fn chunk(sent: Option<Timestamp>) -> Vec<u8> {
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: None,
        message_sequence_number: 1,
        bytes: &[7; 3_000],
    };
    let budget = ChunkBudget {
        network_message: 1_400,
        trailer: 0,
    };
    let (header, extras) = (header(2, 5, sent), Extras::default());
    let mut chunks = ChunkEncoder::new(&header, &extras, whole, budget).unwrap();
    let mut bytes = Vec::new();
    chunks.append(&mut bytes, &extras).unwrap().unwrap();
    bytes
}

#[test]
fn a_hidden_request_crosses_with_a_time_only_and_a_hidden_response_without() {
    let cell = CELL.replace("ua_2_5_60, ua_2_5_61", "ua_2_5");
    let now = start();
    for (sent, age, refused) in [
        (None, 0, Some(UNTIMED)),
        (Some(now.utc), 1000, None),
        (Some(now.utc), 1001, Some(LATE)),
    ] {
        let mut routes = routes_of(&cell);
        let judgement = routes.judge(&chunk(sent), path(UDP, 9), later(now, age));
        assert_eq!(judgement.not_forwarded, refused, "{age} ms");
    }
    // The executor is at the carrier of the name.
    let at_udp = CELL.replace("[ua_1_2, ua_0_2_20]", "[ua_2_5]");
    let mut routes = routes_of(&at_udp.replace("    forward: [ua_2_5_60, ua_2_5_61]\n", ""));
    let judgement = routes.judge(&chunk(None), path(UDP, 9), now);
    assert_eq!(targets(&judgement), [MQTT], "{judgement:?}");
}

#[test]
fn a_request_of_another_host_does_not_cross_as_one_of_this_program() {
    let (mut routes, now) = (routes(), start());
    let request = action(ActionKind::Request, (2, 5, 60), 1, Some(now.utc));
    let elsewhere = MessagePath {
        carrier: UDP,
        from: SocketAddr::from(([10, 0, 0, 9], 9)),
    };
    let judgement = routes.judge(&request, elsewhere, now);
    assert_eq!(judgement.not_forwarded, Some(NOT_AUTHORIZED));
    assert_eq!(
        (judgement.dropped, targets(&judgement)),
        (None, &NOWHERE[..])
    );
    // The executor's response needs no permission.
    let response = action(ActionKind::Response, (2, 5, 60), 1, None);
    let by = path(MQTT, 1);
    assert_eq!(targets(&routes.judge(&response, by, now)), [UDP]);
}

#[test]
fn a_request_of_a_broker_crosses_only_while_the_caller_waits() {
    let cell = CELL.replace("[ua_1_2, ua_0_2_20]", "[ua_1_2, ua_1_5_60]");
    let (mut routes, now) = (routes_of(&cell), start());
    let request = action(ActionKind::Request, (1, 5, 60), 5, Some(now.utc));
    let judgement = routes.judge(&request, path(MQTT, 1), now);
    assert_eq!(judgement.not_forwarded, Some(NOT_AUTHORIZED));
    let mut routes = routes_of(&cell.replace("broker.local}", "broker.local, acl: true}"));
    for (requestor, sent, age, refused) in [
        (2, Some(now.utc), 300, None),
        (3, Some(now.utc), 301, Some(LATE)),
        (4, None, 0, Some(UNTIMED)),
    ] {
        let request = action(ActionKind::Request, (1, 5, 60), requestor, sent);
        let judgement = routes.judge(&request, path(MQTT, 1), later(now, age));
        assert_eq!(judgement.not_forwarded, refused, "{age} ms");
    }
}

#[test]
fn a_confirmation_goes_back_to_the_sender_of_the_command() {
    let (mut routes, now) = (routes(), start());
    // Space 2 confirms a command of space 0.
    let confirmation = action(ActionKind::Response, (2, 2, 20), 0, None);
    assert_eq!(
        targets(&routes.judge(&confirmation, path(MQTT, 1), now)),
        [UDP]
    );
    let of_other = action(ActionKind::Response, (2, 2, 21), 0, None);
    assert_eq!(
        targets(&routes.judge(&of_other, path(MQTT, 1), now)),
        NOWHERE
    );
}

#[test]
fn changed_names_are_adopted_and_other_carriers_are_not() {
    let (mut routes, now) = (routes(), start());
    let adopt = |routes: &mut Routes, cell: &str| {
        let mapping = Mapping::from_yaml(cell, "cell.yaml").mapping.unwrap();
        routes.adopt(&Arc::new(mapping));
    };
    let sent = (Some(now.utc), None);
    adopt(
        &mut routes,
        &CELL.replace("[ua_1_2, ua_0_2_20]", "[ua_1_3]"),
    );
    let judgement = routes.judge(&value((1, 2, 10), 1, sent), path(UDP, 9), now);
    assert_eq!(targets(&judgement), NOWHERE);
    let judgement = routes.judge(&value((1, 3, 10), 1, sent), path(UDP, 9), now);
    assert_eq!(targets(&judgement), [MQTT]);
    let moved = CELL.replace("broker.local", "other.local");
    adopt(&mut routes, &moved);
    let judgement = routes.judge(&value((1, 3, 10), 2, sent), path(UDP, 9), now);
    assert_eq!(targets(&judgement), [MQTT]);
}

#[test]
fn a_message_that_cannot_be_read_is_left_to_the_router() {
    let mut routes = routes();
    let judgement = routes.judge(&[0xff, 0xff, 1], path(UDP, 9), start());
    assert_eq!(judgement, Judgement::default());
}

#[test]
fn a_time_of_a_message_is_kept_in_its_identity() {
    let routes = routes();
    let identity = |number, taken| {
        let taken = Timestamp::from(DateTime(taken));
        let bytes = value((1, 2, 10), number, (None, Some(taken)));
        routes.identity(&NetworkMessage::decode(&bytes).unwrap())
    };
    assert_eq!(identity(1, 5), identity(1, 5));
    assert_ne!(identity(1, 5), identity(1, 6));
    assert_ne!(identity(1, 5), identity(2, 5));
}
