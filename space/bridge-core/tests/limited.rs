//! Programs that use few namespaces of a cell with many programs.
use crate::cell;

use bridge_core::{
    CallDescription, CallField, CallRole, Local, OfferedCall, Reason, ValueDescription,
};
use cell::{SimulatedCell, SimulatedProgram, component, ms, topic};
use mappings::{Overflow, TopicId};
use messages::{ArrayRank, Leaf};
use uadp::{BuiltinType, NetworkMessage, NetworkMessageType};

/// Returns the value and the call of the component with this namespace.
fn of(namespace: u16) -> (TopicId, TopicId) {
    (topic(0, namespace, 101), topic(0, namespace, 105))
}

fn state() -> ValueDescription {
    ValueDescription {
        name: "gripper.Grasp.State".to_owned(),
        message_type: "std_msgs/String".parse().ok(),
        about: String::new(),
        fields: vec![Leaf {
            path: "data".to_owned(),
            builtin: BuiltinType::String,
            rank: ArrayRank::Scalar,
        }],
        overflow: Overflow::KeepLatest,
    }
}

fn start() -> OfferedCall {
    OfferedCall {
        description: CallDescription {
            name: "gripper.Grasp.Start".to_owned(),
            about: String::new(),
            role: CallRole::Call,
            request: Vec::new(),
            response: vec![CallField::scalar("success", BuiltinType::Boolean)],
        },
        open: false,
    }
}

/// Describes and sends the value of a component, and offers its call.
fn serve(cell: &mut SimulatedCell, at: usize, namespace: u16) {
    let (value, call) = of(namespace);
    cell.describe(at, value, state());
    cell.offer(at, call, start());
    cell.say(at, value, "Ready");
}

/// Returns the number of announcements that a program has sent.
fn announced(cell: &mut SimulatedCell, at: usize) -> usize {
    let sent = cell.datagrams_of(at);
    let types = sent
        .iter()
        .map(|bytes| NetworkMessage::decode(bytes).unwrap().message_type());
    types
        .filter(|of| *of == NetworkMessageType::Announcement)
        .count()
}

#[test]
fn a_limited_program_uses_its_namespaces_and_stores_nothing_of_others() {
    let mut cell = SimulatedCell::new(vec![component(5), component(7), component(9)]);
    cell.programs[0].router.limit_to([of(7).0]);
    serve(&mut cell, 1, 7);
    serve(&mut cell, 2, 9);
    cell.run(ms(3_000));
    assert_eq!(cell.texts(0, of(7).0), ["Ready"]);
    assert_eq!(cell.known(0), [of(7).1]);
    let router = &cell.programs[0].router;
    assert!(router.topics().all(|(topic, _)| topic != of(9).0));
    assert!(router.calls().all(|(topic, _)| topic != of(9).1));
    let dropped = |reason| cell.dropped(0, reason);
    assert_eq!([Reason::MetaData, Reason::Untyped].map(dropped), [0, 0]);
    // A program without a limit uses both.
    assert_eq!(cell.texts(1, of(9).0), ["Ready"]);
    assert_eq!(cell.known(1), [of(9).1]);
}

#[test]
fn a_call_that_a_limited_program_wants_later_is_found() {
    let mut cell = SimulatedCell::new(vec![component(5), component(7)]);
    cell.programs[0].router.limit_to([]);
    serve(&mut cell, 1, 7);
    cell.run(ms(3_000));
    assert_eq!(cell.known(0), []);
    let now = cell.now();
    cell.programs[0].router.want_call(of(7).1, now);
    cell.run(ms(1_500));
    assert_eq!(cell.known(0), [of(7).1]);
}

#[test]
fn a_newcomer_does_not_make_the_others_announce_their_calls() {
    let mut cell = SimulatedCell::new(vec![
        component(7),
        component(9),
        SimulatedProgram::new(0, Local::Fields).owning(&[2]),
    ]);
    serve(&mut cell, 0, 7);
    serve(&mut cell, 1, 9);
    cell.run(ms(5_000));
    let before = [0, 1].map(|at| announced(&mut cell, at));

    cell.programs.push(component(8));
    let now = cell.now();
    let newcomer = &mut cell.programs[3].router;
    newcomer.limit_to([]);
    newcomer.call_the_roll(now);
    newcomer.claim(now);
    serve(&mut cell, 3, 8);
    cell.run(ms(5_000));
    assert!(
        cell.known(2).contains(&of(8).1),
        "the server knows its calls"
    );
    assert_eq!([0, 1].map(|at| announced(&mut cell, at)), before);
}

#[test]
fn a_namespace_with_calls_and_no_values_is_found_taken() {
    let mut cell = SimulatedCell::new(vec![component(7), component(9)]);
    cell.offer(0, of(7).1, start());
    cell.run(ms(5_000));
    cell.programs.push(component(7).at_port(7_777));
    let now = cell.now();
    cell.programs[2].router.limit_to([]);
    cell.programs[2].router.claim(now);
    cell.run(ms(250));
    assert_eq!(cell.taken(2), [(7, true)]);
}
