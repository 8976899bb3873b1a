//! Calls of redundant bridges: a request is executed at most once, whatever stops, and each request
//! has an outcome.
use crate::cell;

use std::cell::Cell as Shared;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use bridge_core::{
    AskErrorKind, AskId, CallDescription, CallField, CallRole, Executed, KeyDelivery, Local,
    OfferedCall, Reason, RedundancyRank, RedundancyRole,
};
use cell::{SimulatedCell, SimulatedProgram, component, ms, topic};
use mappings::{Mapping, TopicId};
use uadp::action::{ActionDialect, ActionKind};
use uadp::{BuiltinType, NetworkMessage, Scalar, SecurityPolicy, TokenKeys, Variant};

/// The redundant bridges of space 2.
const A: usize = 0;
const B: usize = 1;
/// The bridge of space 1.
const CALLER: usize = 2;
/// A component of space 0.
const GRIPPER: usize = 3;

/// The call of space 2.
fn weld() -> TopicId {
    topic(2, 5, 61)
}

/// The call of the component.
fn grip() -> TopicId {
    topic(0, 7, 105)
}

fn offered() -> OfferedCall {
    OfferedCall {
        description: CallDescription {
            name: "Weld".to_owned(),
            about: String::new(),
            role: CallRole::Call,
            request: vec![CallField::scalar("seam", BuiltinType::UInt32).optional()],
            response: vec![CallField::scalar("done", BuiltinType::Boolean)],
        },
        open: true,
    }
}

fn seam(number: u32) -> Vec<u8> {
    cell::block(&[Variant::Scalar(Scalar::UInt32(number))])
}

fn done() -> Executed {
    Executed::Answered(cell::block(&[Variant::Scalar(Scalar::Boolean(true))]))
}

fn keys() -> KeyDelivery {
    let key = TokenKeys::from_bytes(SecurityPolicy::PubSubAes256Ctr, &[9; 68]).unwrap();
    KeyDelivery {
        first_token_id: 1,
        keys: vec![key],
        time_to_next: None,
        lifetime: Duration::ZERO,
    }
}

const PLAIN: &str = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {5: urn:x, 7: urn:y}\n";
const SECURED: &str = "security: [{group: cell, keys: {file: k}}]\n";

fn redundant(
    port: u16,
    rank: u8,
    mapping: &Arc<Mapping>,
    cell: &mut SimulatedCell,
) -> SimulatedProgram {
    let mut program = SimulatedProgram::new(2, Local::Fields)
        .at_port(port)
        .mapped(mapping);
    let now = cell.now();
    let rank = RedundancyRank::new(rank).unwrap();
    program.router.set_redundancy(rank, now);
    program
}

/// Creates the bridges, of which A is active, and the component. All know the calls of each other.
fn plant(is_secured: bool) -> SimulatedCell {
    let text = if is_secured {
        format!("{PLAIN}{SECURED}")
    } else {
        PLAIN.to_owned()
    };
    let mapping = Mapping::from_yaml(&text, "cell.yaml").mapping.unwrap();
    let mapping = Arc::new(mapping);
    let mut cell = SimulatedCell::new(Vec::new());
    let bridges = [(10_002, 1), (10_012, 2)];
    let bridges = bridges.map(|(port, rank)| redundant(port, rank, &mapping, &mut cell));
    cell.programs.extend(bridges);
    cell.programs
        .push(SimulatedProgram::new(1, Local::Fields).mapped(&mapping));
    cell.programs.push(component(7).mapped(&mapping));
    if is_secured {
        let now = cell.now();
        for program in &mut cell.programs {
            program.router.set_keys("cell", &keys(), now).unwrap();
        }
    }
    for at in [A, B] {
        cell.offer(at, weld(), offered());
    }
    cell.offer(GRIPPER, grip(), offered());
    cell.run(ms(1_500));
    assert_eq!(
        roles(&cell),
        [RedundancyRole::Active, RedundancyRole::Standby]
    );
    assert_eq!(cell.known(CALLER), [grip(), weld()]);
    cell
}

fn roles(cell: &SimulatedCell) -> [RedundancyRole; 2] {
    [A, B].map(|at| cell.programs[at].router.redundancy().unwrap().role())
}

/// Returns whether a datagram is a response in clear.
fn is_response(bytes: &[u8]) -> bool {
    let Ok(message) = NetworkMessage::decode(bytes) else {
        return false;
    };
    if !message.is_action() {
        return false;
    }
    let actions = message.actions(ActionDialect::Standard);
    actions.is_ok_and(|mut actions| {
        actions.any(|action| action.is_ok_and(|action| action.action.kind == ActionKind::Response))
    })
}

/// Lets the network lose the responses as long as the returned flag is set.
fn losing_responses(cell: &mut SimulatedCell) -> Rc<Shared<bool>> {
    let loses = Rc::new(Shared::new(true));
    let flag = Rc::clone(&loses);
    cell.copies = Box::new(move |bytes| {
        if flag.get() && is_response(bytes) {
            0
        } else {
            1
        }
    });
    loses
}

#[test]
fn a_request_that_the_former_active_bridge_executed_is_unknown_and_not_executed_again() {
    let mut cell = plant(false);
    let loses = losing_responses(&mut cell);
    cell.ask(CALLER, AskId(1), (weld(), &seam(1)), ms(3_000));
    cell.run(ms(10));
    assert_eq!(cell.executions(A).len(), 1);
    cell.kill(A);
    loses.set(false);
    cell.run(ms(5_000));
    assert_eq!(roles(&cell)[B], RedundancyRole::Active);
    assert_eq!(cell.executions(B), [], "no second execution");
    let answers = cell.answers(CALLER);
    let [(AskId(1), Err(error))] = &answers[..] else {
        panic!("{answers:?}");
    };
    assert_eq!(error.kind, AskErrorKind::Unknown);
    assert!(cell.dropped(B, Reason::CallRefused) > 0);
}

#[test]
fn in_a_secured_group_the_new_active_bridge_answers_and_executes_at_once() {
    let mut cell = plant(true);
    cell.ask(CALLER, AskId(1), (weld(), &seam(1)), ms(3_000));
    cell.run(ms(10));
    let [execution] = &cell.executions(A)[..] else {
        panic!("A executes it");
    };
    let id = execution.id;
    cell.executed(A, id, done());
    cell.run(ms(10));
    assert!(matches!(cell.answers(CALLER)[..], [(AskId(1), Ok(_))]));
    cell.kill(A);
    // The request reaches no active bridge, and the standby answers it after the takeover.
    cell.ask(CALLER, AskId(2), (weld(), &seam(2)), ms(3_000));
    cell.run(ms(450));
    assert_eq!(roles(&cell)[B], RedundancyRole::Active);
    let answers = cell.answers(CALLER);
    let [(AskId(2), Err(error))] = &answers[..] else {
        panic!("{answers:?}");
    };
    assert_eq!(error.kind, AskErrorKind::Unknown);
    assert_eq!(cell.executions(B), []);
    // The announcement of the new active bridge is accepted.
    cell.ask(CALLER, AskId(3), (weld(), &seam(3)), ms(3_000));
    cell.run(ms(10));
    let [execution] = &cell.executions(B)[..] else {
        panic!("B executes it");
    };
    let id = execution.id;
    cell.executed(B, id, done());
    cell.run(ms(10));
    assert!(matches!(cell.answers(CALLER)[..], [(AskId(3), Ok(_))]));
    assert_eq!(cell.gone(CALLER), [], "the call stays available");
}

#[test]
fn in_a_group_without_security_requestors_follow_after_the_receive_timeout() {
    let mut cell = plant(false);
    cell.kill(A);
    cell.run(ms(8_000));
    assert!(cell.known(CALLER).contains(&weld()));
    cell.ask(CALLER, AskId(1), (weld(), &seam(1)), ms(3_000));
    cell.run(ms(10));
    assert_eq!(cell.executions(B).len(), 1);
}

#[test]
fn a_bridge_that_was_stopped_starts_nothing() {
    for pause in [90, 400] {
        let mut cell = plant(true);
        cell.stop(A);
        cell.ask(CALLER, AskId(1), (weld(), &seam(1)), ms(3_000));
        cell.run(ms(pause));
        cell.resume(A);
        cell.run(ms(600));
        assert_eq!(cell.executions(A), [], "{pause} ms");
        assert_eq!(cell.executions(B), [], "{pause} ms");
        let answers = cell.answers(CALLER);
        let [(AskId(1), Err(error))] = &answers[..] else {
            panic!("{pause} ms: {answers:?}");
        };
        assert_eq!(error.kind, AskErrorKind::Unknown);
        assert!(cell.dropped(A, Reason::Takeover) > 0);
    }
}

/// Returns the datagram of a request, which does not reach the bridges.
fn request(cell: &mut SimulatedCell) -> Vec<u8> {
    let now = cell.now();
    let router = &mut cell.programs[CALLER].router;
    router.ask(AskId(1), (weld(), &seam(1)), ms(3_000), now);
    let mut request = Vec::new();
    while let Some(output) = router.poll_output(now) {
        if let bridge_core::Output::Action { bytes, .. } = output {
            request = bytes;
        }
    }
    assert!(!request.is_empty());
    request
}

#[test]
fn a_request_after_the_end_of_the_lease_is_not_even_passed_on() {
    for (pause, executed) in [(0, 1), (300, 0)] {
        let mut cell = plant(true);
        let request = request(&mut cell);
        let from = cell.programs[CALLER].address;
        cell.stop(A);
        cell.run(ms(pause));
        let now = cell.now();
        let router = &mut cell.programs[A].router;
        router.handle_datagram(&request, from, now);
        let passed_on: u64 = router.calls().map(|(_, call)| call.executed).sum();
        assert_eq!(passed_on, executed, "{pause} ms");
    }
}

#[test]
fn a_request_of_the_local_side_after_the_end_of_the_lease_is_unknown_at_once() {
    for (pause, unknown) in [(0, 0), (300, 1)] {
        let mut cell = plant(true);
        cell.stop(A);
        cell.run(ms(pause));
        let now = cell.now();
        let router = &mut cell.programs[A].router;
        router.ask(AskId(1), (grip(), &seam(1)), ms(3_000), now);
        let counted: u64 = router.calls().map(|(_, call)| call.unknown).sum();
        assert_eq!(counted, unknown, "{pause} ms");
    }
}

#[test]
fn an_execution_that_waits_for_the_local_side_does_not_start_after_a_stop() {
    let mut cell = plant(true);
    // The request is handled, and the process stops before its output is taken.
    let request = request(&mut cell);
    let now = cell.now();
    let from = cell.programs[CALLER].address;
    let router = &mut cell.programs[A].router;
    router.handle_datagram(&request, from, now);
    cell.stop(A);
    cell.run(ms(300));
    cell.resume(A);
    cell.run(ms(300));
    assert_eq!(cell.executions(A), []);
    assert_eq!(cell.executions(B), []);
    assert!(cell.dropped(A, Reason::Takeover) > 0);
}

#[test]
fn a_standby_sends_no_requests_and_says_that_the_outcome_is_unknown() {
    let mut cell = plant(true);
    cell.ask(B, AskId(1), (grip(), &seam(1)), ms(3_000));
    cell.run(ms(500));
    assert_eq!(cell.executions(GRIPPER), []);
    let answers = cell.answers(B);
    let [(AskId(1), Err(error))] = &answers[..] else {
        panic!("{answers:?}");
    };
    assert_eq!(error.kind, AskErrorKind::Unknown);
    assert_eq!(cell.counters(B, grip()).unknown, 1);
}

#[test]
fn a_confirmed_request_is_answered_after_a_planned_switch_and_others_are_unknown() {
    let mut cell = plant(false);
    cell.ask(A, AskId(1), (grip(), &seam(1)), ms(3_000));
    cell.run(ms(20));
    let loses = losing_responses(&mut cell);
    cell.ask(A, AskId(2), (grip(), &seam(2)), ms(3_000));
    cell.run(ms(20));
    let executions = cell.executions(GRIPPER);
    assert_eq!(executions.len(), 2);
    let now = cell.now();
    cell.programs[A].router.switch_over(now).unwrap();
    cell.run(ms(20));
    let answers = cell.answers(A);
    let [(AskId(2), Err(error))] = &answers[..] else {
        panic!("{answers:?}");
    };
    assert_eq!(error.kind, AskErrorKind::Unknown);
    loses.set(false);
    cell.executed(GRIPPER, executions[0].id, done());
    cell.run(ms(300));
    assert_eq!(
        roles(&cell),
        [RedundancyRole::Standby, RedundancyRole::Active]
    );
    assert!(matches!(cell.answers(A)[..], [(AskId(1), Ok(_))]));
    assert_eq!(cell.executions(GRIPPER), []);
}

#[test]
fn a_request_without_an_announced_target_is_refused_by_redundant_bridges() {
    let mut cell = plant(false);
    let before = cell.dropped(A, Reason::CallRefused);
    let request = crate::call_safety::request_for(weld(), 7);
    let from = cell.programs[CALLER].address;
    for at in [A, B] {
        cell.hear(at, &request, from);
    }
    assert_eq!(cell.executions(A), []);
    assert_eq!(cell.executions(B), []);
    assert_eq!(cell.dropped(A, Reason::CallRefused), before + 1);
    assert_eq!(
        cell.dropped(B, Reason::CallRefused),
        0,
        "the standby is silent"
    );
}

#[test]
fn each_term_of_each_bridge_has_an_action_target_id_of_its_own() {
    let mut cell = plant(true);
    let mut executed = 0;
    for turn in 0..4 {
        let active = usize::from(roles(&cell)[B] == RedundancyRole::Active);
        let ask = AskId(turn);
        cell.ask(CALLER, ask, (weld(), &seam(1)), ms(3_000));
        cell.run(ms(20));
        for execution in cell.executions(active) {
            executed += 1;
            cell.executed(active, execution.id, done());
        }
        cell.run(ms(20));
        assert!(matches!(cell.answers(CALLER)[..], [(_, Ok(_))]), "{turn}");
        let now = cell.now();
        cell.programs[active].router.switch_over(now).unwrap();
        cell.run(ms(400));
    }
    assert_eq!(executed, 4);
    assert_eq!(cell.gone(CALLER), []);
}
