//! Bridges of a space that carry different namespaces: each value and call crosses one of them, and
//! an overlap is refused with both names.
use crate::cell;

use bridge_core::{
    AskErrorKind, AskId, CallDescription, CallRole, Local, OfferedCall, Output, Reason,
};
use cell::{SimulatedCell, SimulatedProgram, component, ms, topic};

/// The bridges of space 2.
const A: usize = 0;
const B: usize = 1;
/// The bridge of space 1.
const READER: usize = 2;
/// The components of the namespaces 5 and 6.
const COMMANDER_5: usize = 3;
const COMMANDER_6: usize = 4;

fn bridge(port: u16, cell: &mut SimulatedCell, namespaces: &[u16]) -> SimulatedProgram {
    let mut program = SimulatedProgram::new(2, Local::Fields).at_port(port);
    let now = cell.now();
    let part = namespaces.iter().copied().collect();
    let name = format!("bridge on port {port}");
    program.router.set_part(part, name, now);
    program
}

fn plant(a: &[u16], b: &[u16]) -> SimulatedCell {
    let mut cell = SimulatedCell::new(Vec::new());
    let a = bridge(10_002, &mut cell, a);
    cell.programs.push(a);
    cell.run(ms(20));
    let b = bridge(10_012, &mut cell, b);
    cell.programs.push(b);
    cell.programs.push(SimulatedProgram::new(1, Local::Fields));
    cell.programs.push(component(5));
    cell.programs.push(component(6));
    cell.run(ms(1_000));
    cell
}

fn offered() -> OfferedCall {
    OfferedCall {
        description: CallDescription {
            name: "Weld".to_owned(),
            about: String::new(),
            role: CallRole::Call,
            request: Vec::new(),
            response: Vec::new(),
        },
        open: true,
    }
}

/// Returns the overlaps that a program reported: the namespace and the name of the other program.
fn overlaps(cell: &mut SimulatedCell, at: usize) -> Vec<(u16, String)> {
    let outputs = cell.outputs(at);
    let taken = outputs.into_iter().filter_map(|output| match output {
        Output::Taken {
            namespace,
            by: Some(_),
            name,
        } => Some((namespace, name)),
        _ => None,
    });
    taken.collect()
}

#[test]
fn each_value_and_command_crosses_the_bridge_of_its_namespace() {
    let mut cell = plant(&[5], &[6]);
    for namespace in [5, 6] {
        let of = topic(2, namespace, 10);
        // Both bridges receive the topics of the graph.
        for at in [A, B] {
            cell.say(at, of, "measured");
        }
        cell.run(ms(50));
        assert_eq!(cell.texts(READER, of), ["measured"], "{namespace}");
    }
    for (at, namespace) in [(COMMANDER_5, 5), (COMMANDER_6, 6)] {
        let command = topic(0, namespace, 20);
        cell.say(at, command, "go");
        cell.run(ms(50));
        let delivered = [A, B].map(|at| cell.texts(at, command).len());
        assert_eq!(
            delivered,
            [usize::from(namespace == 5), usize::from(namespace == 6)]
        );
    }
    assert_eq!(
        (overlaps(&mut cell, A), overlaps(&mut cell, B)),
        (vec![], vec![])
    );
    for at in [A, B] {
        assert_eq!(cell.dropped(at, Reason::SpaceTaken), 0);
    }
}

#[test]
fn a_sample_of_the_start_waits_until_the_namespace_is_known_to_be_free() {
    let mut cell = SimulatedCell::new(Vec::new());
    let bridge = bridge(10_002, &mut cell, &[5]);
    cell.programs.push(bridge);
    cell.programs.push(SimulatedProgram::new(1, Local::Fields));
    let (at, reader, latched) = (0, 1, topic(2, 5, 10));
    cell.say(at, latched, "latched");
    cell.run(ms(200));
    assert_eq!(cell.texts(reader, latched), [] as [&str; 0]);
    cell.run(ms(800));
    assert_eq!(cell.texts(reader, latched), ["latched"]);
}

#[test]
fn a_call_is_executed_and_offered_by_the_bridge_of_its_namespace() {
    let mut cell = plant(&[5], &[6]);
    let (weld, grip) = (topic(2, 6, 61), topic(0, 5, 105));
    for at in [A, B] {
        cell.offer(at, weld, offered());
    }
    cell.offer(COMMANDER_5, grip, offered());
    cell.run(ms(1_000));
    assert_eq!(cell.known(A), [grip]);
    assert_eq!(cell.known(B), []);
    cell.ask(READER, AskId(1), (weld, &cell::block(&[])), ms(2_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(A).len(), 0);
    assert_eq!(cell.executions(B).len(), 1);
}

#[test]
fn the_bridge_that_started_first_keeps_a_namespace_and_the_other_names_it() {
    let mut cell = plant(&[5, 6], &[6, 7]);
    assert_eq!(overlaps(&mut cell, A), []);
    let named = (6, "bridge on port 10002".to_owned());
    assert_eq!(overlaps(&mut cell, B), [named]);
    let (state, command) = (topic(2, 6, 10), topic(0, 6, 20));
    for at in [A, B] {
        cell.say(at, state, "one");
    }
    cell.say(COMMANDER_6, command, "go");
    cell.run(ms(3_000));
    assert_eq!(cell.texts(READER, state), ["one"]);
    assert_eq!(cell.texts(A, command), ["go"]);
    assert_eq!(cell.texts(B, command), [] as [&str; 0]);
    // The other bridge carries the namespace once the first has ended.
    cell.kill(A);
    cell.run(ms(8_000));
    cell.say(COMMANDER_6, command, "on");
    cell.run(ms(100));
    assert_eq!(
        cell.texts(B, command).last().map(String::as_str),
        Some("on")
    );
}

#[test]
fn a_request_in_a_namespace_of_another_bridge_is_not_sent_and_its_outcome_is_unknown() {
    let mut cell = plant(&[5, 6], &[6, 7]);
    let grip = topic(0, 6, 105);
    cell.offer(COMMANDER_6, grip, offered());
    cell.run(ms(1_000));
    // Both bridges receive the request of a client in the graph.
    for at in [A, B] {
        cell.ask(at, AskId(1), (grip, &cell::block(&[])), ms(2_000));
    }
    cell.run(ms(50));
    assert_eq!(cell.executions(COMMANDER_6).len(), 1);
    let answers = cell.answers(B);
    let kinds: Vec<AskErrorKind> = answers
        .iter()
        .filter_map(|(_, answer)| Some(answer.as_ref().err()?.kind))
        .collect();
    assert_eq!(kinds, [AskErrorKind::Unknown], "{answers:?}");
}

#[test]
fn a_bridge_of_a_whole_space_names_the_bridge_of_a_part() {
    let mut cell = plant(&[5], &[6]);
    let whole = SimulatedProgram::new(2, Local::Fields).at_port(10_022);
    cell.programs.push(whole);
    cell.run(ms(2_000));
    let notices = cell.outputs(5);
    let said = notices.iter().any(|output| match output {
        Output::Notice(notice) => notice.detail.contains("bridge on port 100"),
        _ => false,
    });
    assert!(said, "{notices:?}");
}
