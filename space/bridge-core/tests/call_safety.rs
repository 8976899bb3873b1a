//! Calls on a network that loses datagrams, and with peers that send false messages or end.
use crate::cell;

use std::cell::Cell as Shared;
use std::net::SocketAddr;
use std::rc::Rc;
use std::time::Duration;

use bridge_core::{
    AskErrorKind, AskId, CallDescription, CallField, CallRole, Executed, Local, OfferedCall,
    Output, Reason, Relay,
};
use cell::{SimulatedCell, SimulatedProgram, component, ms, topic};
use mappings::TopicId;
use uadp::action::{
    ActionAddress, ActionDialect, ActionFields, ActionHeader, ActionKind, ActionState, ActionToSend,
};
use uadp::{
    BuiltinType, Extras, NetworkHeader, NetworkMessage, NetworkMessageType, OwnedPublisherId,
    PublisherId, Scalar, Timestamp, Variant,
};

const BRIDGE: usize = 0;
const GRIPPER: usize = 1;

fn start() -> TopicId {
    topic(0, 7, 105)
}

fn offered(open: bool) -> OfferedCall {
    OfferedCall {
        description: CallDescription {
            name: "gripper.Load".to_owned(),
            about: String::new(),
            role: CallRole::Call,
            request: vec![CallField::scalar("bytes", BuiltinType::ByteString).optional()],
            response: vec![CallField::scalar("bytes", BuiltinType::ByteString)],
        },
        open,
    }
}

/// Creates a bridge of space 1 and a component with the namespace 7. The bridge knows the call of
/// the component.
fn plugged_in() -> SimulatedCell {
    let mut cell = SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Fields), component(7)]);
    cell.offer(GRIPPER, start(), offered(true));
    cell.run(ms(200));
    assert_eq!(cell.known(BRIDGE), [start()]);
    cell
}

/// Returns a request or response of the given number of distinct 32-bit numbers.
fn large(bytes: u32) -> Vec<u8> {
    let bytes: Vec<u8> = (0..bytes).flat_map(|at| at.to_le_bytes()).collect();
    cell::block(&[Variant::Scalar(Scalar::ByteString(Some(&bytes)))])
}

/// Returns a datagram with a request for the call as sent by a program of another vendor.
fn request(response_address: Option<&str>, request_id: u16) -> Vec<u8> {
    request_to(start(), response_address, request_id)
}

/// Returns a request for a call without a ResponseAddress.
pub(crate) fn request_for(topic: TopicId, request_id: u16) -> Vec<u8> {
    request_to(topic, None, request_id)
}

fn request_to(topic: TopicId, response_address: Option<&str>, request_id: u16) -> Vec<u8> {
    let (space, namespace, writer_id) = topic.triple();
    let address = ActionAddress {
        publisher_id: OwnedPublisherId::UInt16(space),
        writer_group_id: Some(namespace),
        writer_id,
        target_id: 1,
    };
    let request = ActionToSend {
        address: &address,
        action: ActionHeader {
            response_address,
            correlation_data: Some(b"test"),
            requestor_id: Some(PublisherId::UInt16(9)),
            timeout_hint: Some(3_000.0),
            ..ActionHeader::new(ActionKind::Request)
        },
        left: None,
        request_id,
        call: 0,
        state: ActionState::Executing,
        status: None,
        fields: ActionFields::NONE,
        dialect: ActionDialect::Standard,
    };
    let mut datagram = Vec::new();
    let (header, extras) = (NetworkHeader::default(), Extras::default());
    let encoder = request.encode(&mut datagram, &header, &extras).unwrap();
    encoder.finish().unwrap();
    datagram
}

#[test]
fn a_request_that_wants_its_answer_elsewhere_is_refused_and_counted() {
    let from = SocketAddr::from(([192, 0, 2, 9], 5_000));
    // The address of the group with and without its port, no address, and the host of the
    // requestor.
    let allowed = [
        None,
        Some(""),
        Some("opc.udp://239.192.0.40:4840"),
        Some("opc.udp://239.192.0.40/"),
        Some("opc.udp://192.0.2.9:6000"),
    ];
    let elsewhere = [
        "opc.udp://192.0.2.10:5000",
        "opc.udp://239.192.0.41:4840",
        "opc.udp://printer.example:9100",
        "opc.tcp://192.0.2.9:4840",
        "nonsense",
    ];
    let mut cell = plugged_in();
    for (id, address) in (0..).zip(allowed) {
        cell.hear(GRIPPER, &request(address, id), from);
        assert_eq!(cell.executions(GRIPPER).len(), 1, "{address:?}");
    }
    for (id, address) in (100..).zip(elsewhere) {
        let before = cell.dropped(GRIPPER, Reason::CallRefused);
        cell.hear(GRIPPER, &request(Some(address), id), from);
        assert_eq!(cell.executions(GRIPPER).len(), 0, "{address:?}");
        assert_eq!(cell.dropped(GRIPPER, Reason::CallRefused), before + 1);
        let told = cell
            .outputs(GRIPPER)
            .into_iter()
            .any(|output| match output {
                Output::Notice(notice) => notice.detail.contains(address),
                _ => false,
            });
        assert!(told || id > 100, "the first of them is told with where");
    }
}

#[test]
fn the_chunks_of_a_repetition_fill_in_those_that_were_lost() {
    let mut cell = plugged_in();
    // Every seventh chunk is lost. Each repetition loses other chunks, and no transmission is
    // complete.
    let count = Rc::new(Shared::new(0_u32));
    let counting = Rc::clone(&count);
    cell.copies = Box::new(move |bytes| {
        let chunk = NetworkMessage::decode(bytes).and_then(|message| message.chunk());
        // The first chunk contains the ActionHeader; a difference in it would start another
        // message.
        if chunk.is_ok_and(|chunk| chunk.offset > 0) {
            counting.set(counting.get() + 1);
            usize::from(!counting.get().is_multiple_of(7))
        } else {
            1
        }
    });
    // 31 and 32 chunks.
    let (asked, answer) = (large(500_000), large(510_000));
    cell.ask(BRIDGE, AskId(1), (start(), &asked), ms(10_000));
    cell.run(ms(900));
    let execution = cell.executions(GRIPPER).pop().expect("filled in");
    assert!(execution.request == asked);
    let id = execution.id;
    cell.executed(GRIPPER, id, Executed::Answered(answer.clone()));
    cell.run(ms(900));
    let (_, told) = cell.answers(BRIDGE).pop().expect("filled in");
    assert!(told == Ok(answer));
    cell.run(ms(5_000));
    assert!(cell.executions(GRIPPER).is_empty(), "executed once");
}

/// Returns the time of sending and the TimeoutHint of the requests that a program sent.
fn times_of_requests(cell: &mut SimulatedCell, at: usize) -> Vec<(Option<i128>, Duration)> {
    let mut times = Vec::new();
    for datagram in cell.datagrams_of(at) {
        let message = NetworkMessage::decode(&datagram).unwrap();
        let Ok(actions) = message.actions(ActionDialect::Standard) else {
            continue;
        };
        let header = message.header();
        let sent = header.timestamp.map(|time| {
            let picoseconds = header.picoseconds.unwrap_or_default();
            Timestamp { time, picoseconds }.unix_nanos()
        });
        let waits = actions.flatten().filter_map(|of| of.action.timeout());
        times.extend(waits.map(|waits| (sent, waits)));
    }
    times
}

#[test]
fn requests_say_when_they_were_sent_and_how_long_their_caller_still_waits() {
    for bytes in [1, 900] {
        let mut cell = plugged_in();
        cell.kill(GRIPPER);
        let asked = cell.now().utc.unix_nanos();
        cell.ask(BRIDGE, AskId(1), (start(), &large(bytes)), ms(1_000));
        cell.run(ms(600));
        let times = times_of_requests(&mut cell, BRIDGE);
        assert!(times.len() > 4, "{times:?}");
        for (sent, waits) in times {
            // A broker may deliver each repetition until then, and no later.
            let until = sent.unwrap() + i128::try_from(waits.as_nanos()).unwrap();
            let after = until - asked - 1_000_000_000;
            assert!(after.abs() < 1_000_000, "{bytes} bytes: {after} ns");
        }
    }
}

#[test]
fn the_chunks_of_repetitions_have_the_time_of_the_first_transmission() {
    let mut cell = plugged_in();
    cell.kill(GRIPPER);
    let before = cell.datagrams_of(BRIDGE).len();
    let asked = cell.now().utc.unix_nanos();
    cell.ask(BRIDGE, AskId(1), (start(), &large(50_000)), ms(1_000));
    cell.run(ms(250));
    let sent = cell.datagrams_of(BRIDGE).split_off(before);
    let chunks: Vec<&Vec<u8>> = sent
        .iter()
        .filter(|datagram| NetworkMessage::decode(datagram).unwrap().is_chunk())
        .collect();
    let (first, again) = chunks.split_at(chunks.len() / 3);
    assert!(!first.is_empty());
    assert_eq!(first, &again[..first.len()]);
    let header = NetworkMessage::decode(first[0]).unwrap().header();
    let sent = Timestamp {
        time: header.timestamp.unwrap(),
        picoseconds: header.picoseconds.unwrap_or_default(),
    };
    assert!((sent.unix_nanos() - asked).abs() < 1_000_000);
}

#[test]
fn a_large_request_that_a_broker_held_is_executed_only_while_its_caller_waits() {
    for (held, executions) in [(700, 1), (1_300, 0)] {
        let mut cell = plugged_in();
        // The caller is on UDP alone; its requests are forwarded to the broker of the component.
        let relay = Relay {
            within: ms(5_000),
            authorized: true,
        };
        cell.programs[GRIPPER].router.set_relay(Some(relay));
        cell.stop(GRIPPER);
        let large = large(50_000);
        cell.ask(BRIDGE, AskId(1), (start(), &large), ms(1_000));
        cell.run(ms(held));
        cell.resume(GRIPPER);
        assert_eq!(cell.executions(GRIPPER).len(), executions, "{held} ms");
        let late = cell.dropped(GRIPPER, Reason::Late);
        assert_eq!(late > 0, executions == 0, "{held} ms: {late}");
    }
}

#[test]
fn a_large_response_that_a_broker_held_arrives_while_its_caller_waits() {
    let mut cell = plugged_in();
    // The component is on UDP alone; its responses are forwarded to the broker of the caller.
    let relay = Relay {
        within: ms(1_000),
        authorized: true,
    };
    cell.programs[BRIDGE].router.set_relay(Some(relay));
    cell.ask(BRIDGE, AskId(1), (start(), &large(1)), ms(10_000));
    cell.run(ms(50));
    let execution = cell.executions(GRIPPER).pop().unwrap();
    cell.stop(BRIDGE);
    let response = Executed::Answered(large(50_000));
    cell.executed(GRIPPER, execution.id, response);
    cell.run(ms(1_300));
    cell.resume(BRIDGE);
    cell.run(ms(200));
    let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
    assert!(answer.is_ok(), "{answer:?}");
    assert_eq!(cell.dropped(BRIDGE, Reason::Late), 0);
}

#[test]
fn chunks_of_calls_go_out_at_the_pace_of_chunks() {
    let mut cell = plugged_in();
    let sent = |cell: &mut SimulatedCell| -> usize {
        cell.datagrams_of(BRIDGE).iter().map(Vec::len).sum()
    };
    let before = sent(&mut cell);
    cell.ask(BRIDGE, AskId(1), (start(), &large(2_500_000)), ms(10_000));
    let burst = sent(&mut cell) - before;
    assert!(burst < 400_000, "{burst} bytes at once");
    // 10 MB at 100 MB/s.
    cell.run(ms(50));
    assert!(cell.executions(GRIPPER).is_empty(), "half of it is there");
    cell.run(ms(60));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
    // Nothing is sent twice during its transmission, which takes as long as the interval of
    // repetitions.
    let all = sent(&mut cell) - before;
    assert!(all < 11_000_000, "{all} bytes for 10 MB");
}

#[test]
fn who_is_started_anew_at_once_without_values_is_believed_soon() {
    let mut cell = plugged_in();
    cell.run(ms(10_000));
    cell.start(GRIPPER, component(7).at_port(7_777));
    cell.offer(GRIPPER, start(), offered(true));
    cell.run(ms(6_000));
    assert_eq!(
        (cell.gone(BRIDGE), cell.known(BRIDGE)),
        (vec![start()], vec![start()])
    );
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
}

#[test]
fn who_lives_keeps_its_calls_whatever_others_say() {
    let mut cell = plugged_in();
    cell.programs.push(component(7).at_port(7_777));
    for _ in 0..20 {
        cell.offer(2, start(), offered(true));
        cell.run(ms(1_500));
    }
    assert_eq!((cell.gone(BRIDGE), cell.known(BRIDGE)), (vec![], vec![]));
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
    assert!(cell.dropped(BRIDGE, Reason::MetaData) > 0, "it is counted");
}

#[test]
fn who_lets_a_request_go_unheard_is_gone_until_it_speaks_again() {
    let mut cell = plugged_in();
    cell.kill(GRIPPER);
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(10_000));
    cell.run(ms(3_500));
    let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
    assert_eq!(answer.unwrap_err().kind, AskErrorKind::Unknown);
    cell.run(ms(4_000));
    assert_eq!(cell.gone(BRIDGE), [start()]);
    // The next request is refused at once instead of after another timeout.
    cell.ask(BRIDGE, AskId(2), (start(), &[0, 0]), ms(10_000));
    let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
    assert_eq!(answer.unwrap_err().kind, AskErrorKind::Refused);
    cell.start(GRIPPER, component(7).at_port(7_777));
    cell.offer(GRIPPER, start(), offered(true));
    cell.run(ms(600));
    assert_eq!(cell.known(BRIDGE), [start()]);
}

#[test]
fn what_was_asked_of_a_program_before_it_was_started_anew_is_not_executed_again() {
    let mut cell = plugged_in();
    // No response arrives: the requestor repeats its request and does not learn the outcome.
    let mute = Rc::new(Shared::new(true));
    let muted = Rc::clone(&mute);
    cell.copies = Box::new(move |bytes| {
        let message = NetworkMessage::decode(bytes).unwrap();
        let is_response = message
            .actions(ActionDialect::Standard)
            .is_ok_and(|mut actions| {
                actions.any(|action| action.unwrap().action.kind == ActionKind::Response)
            });
        usize::from(!(is_response && muted.get()))
    });
    cell.ask(BRIDGE, AskId(1), (start(), &large(1)), ms(20_000));
    cell.run(ms(50));
    let execution = cell.executions(GRIPPER).pop().unwrap();
    cell.executed(GRIPPER, execution.id, Executed::Answered(large(1)));
    cell.run(ms(300));
    cell.kill(GRIPPER);
    cell.start(GRIPPER, component(7).at_port(7_777));
    cell.offer(GRIPPER, start(), offered(true));
    cell.run(ms(1_500));
    assert_eq!(cell.executions(GRIPPER).len(), 0, "it was executed before");
    assert_eq!(cell.dropped(GRIPPER, Reason::CallRefused), 1);
    mute.set(false);
    cell.run(ms(2_000));
    let (_, told) = cell.answers(BRIDGE).pop().unwrap();
    assert_eq!(told.unwrap_err().kind, AskErrorKind::Unknown);

    // After its announcement, the program receives requests as usual, also from requestors with
    // static configuration.
    cell.run(ms(90_000));
    cell.ask(BRIDGE, AskId(2), (start(), &large(2)), ms(3_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
    let from = SocketAddr::from(([192, 0, 2, 9], 5_000));
    cell.hear(GRIPPER, &request(None, 1), from);
    assert_eq!(cell.executions(GRIPPER).len(), 1);
}

#[test]
fn a_request_that_waited_for_a_stopped_program_is_executed_only_while_its_caller_waits() {
    // A caller also gives up an executor that is silent for `receive_timeout`, 3 s.
    for (timeout, stopped, executions) in [
        (3_000, 1_000, 1),
        (3_000, 4_000, 0),
        (10_000, 1_000, 1),
        (10_000, 5_000, 0),
    ] {
        let mut cell = plugged_in();
        cell.stop(GRIPPER);
        cell.ask(BRIDGE, AskId(1), (start(), &large(1)), ms(timeout));
        cell.run(ms(stopped));
        cell.resume(GRIPPER);
        cell.run(ms(1_000));
        assert_eq!(cell.executions(GRIPPER).len(), executions, "{stopped}");
        let late = cell.dropped(GRIPPER, Reason::Late);
        assert_eq!(late, u64::from(executions == 0));
        // The next request is executed.
        cell.ask(BRIDGE, AskId(2), (start(), &large(2)), ms(3_000));
        cell.run(ms(50));
        assert_eq!(cell.executions(GRIPPER).len(), 1);
    }
}

#[test]
fn who_missed_that_a_program_was_started_anew_asks_what_it_is_when_that_shows() {
    let mut cell = plugged_in();
    let deaf = Rc::new(Shared::new(true));
    let deafened = Rc::clone(&deaf);
    cell.copies = Box::new(move |bytes| {
        let message = NetworkMessage::decode(bytes).unwrap();
        let is_value_or_call = message.message_type() == NetworkMessageType::DataSet;
        usize::from(is_value_or_call || !deafened.get())
    });
    let mut again = component(7);
    again.router.set_instance([9; 16]);
    cell.start(GRIPPER, again);
    cell.offer(GRIPPER, start(), offered(true));
    cell.run(ms(1_000));
    deaf.set(false);
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    let (_, told) = cell.answers(BRIDGE).pop().unwrap();
    assert_eq!(told.unwrap_err().kind, AskErrorKind::Unknown);
    assert_eq!(cell.executions(GRIPPER).len(), 0);
    // Earlier than the next announcement, which comes after 30 s.
    cell.run(ms(2_000));
    cell.ask(BRIDGE, AskId(2), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
}

/// Sends `count` requests of a stranger with distinct ids.
fn flood(cell: &mut SimulatedCell, count: u16, from: SocketAddr) {
    for id in 0..count {
        cell.hear(GRIPPER, &request(None, id), from);
    }
}

/// Returns the number of requests and responses that a program has sent.
fn actions_of(cell: &mut SimulatedCell, at: usize) -> usize {
    let sent = cell.datagrams_of(at);
    sent.iter().filter(|bytes| cell::is_action(bytes)).count()
}

#[test]
fn refused_requests_of_a_stranger_are_answered_once_each_and_no_more_than_there_is_room_for() {
    let mut cell = SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Fields), component(7)]);
    cell.offer(GRIPPER, start(), offered(false));
    cell.run(ms(200));
    let stranger = SocketAddr::from(([192, 0, 2, 9], 5_000));
    let before = actions_of(&mut cell, GRIPPER);
    flood(&mut cell, 3, stranger);
    cell.run(ms(5_000));
    assert_eq!(actions_of(&mut cell, GRIPPER), before + 3);
    // Other ports of the same host count as the same sender.
    for port in 0..8 {
        let stranger = SocketAddr::from(([192, 0, 2, 9], 6_000 + port));
        for id in 0..300 {
            cell.hear(GRIPPER, &request(None, 1_000 + port * 300 + id), stranger);
        }
    }
    cell.run(ms(2_000));
    assert!(actions_of(&mut cell, GRIPPER) <= 512);
    assert_eq!(cell.executions(GRIPPER).len(), 0);
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
}

#[test]
fn a_stranger_that_fills_the_room_of_an_open_call_does_not_stop_the_calls_of_others() {
    let mut cell = plugged_in();
    let stranger = SocketAddr::from(([192, 0, 2, 9], 5_000));
    flood(&mut cell, 3_000, stranger);
    assert!(cell.dropped(GRIPPER, Reason::CallRefused) >= 900);
    let executed = cell.executions(GRIPPER).len();
    assert_eq!(executed, 512, "the share of one sender");
    for from in [[127, 0, 0, 1], [192, 0, 2, 10]] {
        let other = SocketAddr::from((from, 9_000));
        let id = 5_000 + u16::from(from[0]);
        cell.hear(GRIPPER, &request(None, id), other);
        assert_eq!(cell.executions(GRIPPER).len(), 1, "{other}");
    }
}

#[test]
fn no_room_is_taken_for_the_chunks_of_a_stranger_where_no_call_is_open() {
    for open in [false, true] {
        let mut cell =
            SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Fields), component(7)]);
        cell.offer(GRIPPER, start(), offered(open));
        cell.run(ms(200));
        cell.programs[BRIDGE].address = SocketAddr::from(([192, 0, 2, 9], 5_000));
        cell.ask(BRIDGE, AskId(1), (start(), &large(25_000)), ms(3_000));
        cell.run(ms(500));
        assert_eq!(cell.executions(GRIPPER).len(), usize::from(open));
        let refused = cell.dropped(GRIPPER, Reason::CallRefused);
        assert_eq!(refused > 0, !open);
        assert_eq!(cell.dropped(GRIPPER, Reason::Incomplete), 0);
    }
}

#[test]
fn a_stranger_that_sends_half_a_request_takes_room_only_where_a_call_is_open() {
    for open in [false, true] {
        let mut cell =
            SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Fields), component(7)]);
        cell.offer(GRIPPER, start(), offered(open));
        cell.run(ms(200));
        cell.programs[BRIDGE].address = SocketAddr::from(([192, 0, 2, 9], 5_000));
        cell.copies = Box::new(|bytes| {
            let chunk = NetworkMessage::decode(bytes).and_then(|message| message.chunk());
            usize::from(!chunk.is_ok_and(|chunk| chunk.offset > 0))
        });
        cell.ask(BRIDGE, AskId(1), (start(), &large(25_000)), ms(3_000));
        cell.run(ms(10_000));
        assert!(cell.executions(GRIPPER).is_empty());
        let incomplete = cell.dropped(GRIPPER, Reason::Incomplete);
        assert_eq!(incomplete > 0, open, "{incomplete} incomplete");
    }
}
