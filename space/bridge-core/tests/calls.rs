//! Calls between Routers: requested in one space, executed in another, with the response to the
//! requestor.
use crate::cell;

use std::sync::Arc;

use bridge_core::{
    AskErrorKind, AskId, CallDescription, CallField, CallMap, CallRole, Executed, Local,
    OfferedCall, OfferedType, Output, Owned, Reason, ValueDescription,
};
use cell::{SimulatedCell, SimulatedProgram, component, ms, topic};
use mappings::{Assigned, Assignment, FieldMap, Mapping, Overflow, TopicId};
use messages::{ArrayRank, Dialect, Leaf, Literal, ServiceType, TypeRegistry};
use uadp::{BuiltinType, Fields, Scalar, StatusCode, Variant};

const BRIDGE: usize = 0;
const GRIPPER: usize = 1;

fn start() -> TopicId {
    topic(0, 7, 105)
}

fn service(dialect: Dialect, name: &str) -> Arc<ServiceType> {
    let name = name.parse().unwrap();
    TypeRegistry::bundle(dialect).service(&name).unwrap()
}

/// Returns the Start call of a skill with default values for all parameters.
fn grasp() -> CallDescription {
    CallDescription {
        name: "gripper.Grasp.Start".to_owned(),
        about: String::new(),
        role: CallRole::Call,
        request: vec![CallField::scalar("Force", BuiltinType::Double).optional()],
        response: vec![
            CallField::scalar("success", BuiltinType::Boolean),
            CallField::scalar("message", BuiltinType::String),
            CallField::scalar("run", BuiltinType::UInt32),
        ],
    }
}

fn offered(description: CallDescription) -> OfferedCall {
    OfferedCall {
        description,
        open: false,
    }
}

/// Creates a bridge of space 1 and a component with the namespace 7. The bridge knows the call of
/// the component.
fn plugged_in(local: Local) -> SimulatedCell {
    let mut cell = SimulatedCell::new(vec![SimulatedProgram::new(1, local), component(7)]);
    cell.offer(GRIPPER, start(), offered(grasp()));
    cell.run(ms(200));
    assert_eq!(cell.known(BRIDGE), [start()]);
    cell
}

/// Returns the fields of a block.
fn told(block: &[u8]) -> Vec<String> {
    let fields = Fields::parse(block).unwrap();
    fields
        .map(|field| format!("{:?}", field.unwrap()))
        .collect()
}

fn succeeded(run: u32) -> Executed {
    let fields = [
        Variant::Scalar(Scalar::Boolean(true)),
        Variant::Scalar(Scalar::String(Some("grasps"))),
        Variant::Scalar(Scalar::UInt32(run)),
    ];
    Executed::Answered(cell::block(&fields))
}

#[test]
fn a_ros_service_call_starts_a_skill_and_is_answered() {
    // `success`, and the length and text of `message`.
    let ros1 = [&[1][..], &6_u32.to_le_bytes(), b"grasps"].concat();
    // Padded to four bytes.
    let cdr = [
        &[0, 1, 0, 0, 1, 0, 0, 0][..],
        &7_u32.to_le_bytes(),
        b"grasps\0\0",
    ]
    .concat();
    let cases = [
        (Local::Ros1, Dialect::Ros1, &[][..], ros1),
        (Local::Cdr, Dialect::Ros2, &[0, 1, 0, 0, 0][..], cdr),
    ];
    for (local, dialect, request, answer) in cases {
        let mut cell = plugged_in(local);
        let trigger = service(dialect, "std_srvs/Trigger");
        let now = cell.now();
        let bridge = &mut cell.programs[BRIDGE].router;
        assert_eq!(
            bridge.bind_call(start(), (&trigger, &Arc::default()), now),
            Ok(())
        );
        cell.ask(BRIDGE, AskId(1), (start(), request), ms(3_000));
        cell.run(ms(50));
        let execution = cell.executions(GRIPPER).pop().unwrap();
        assert_eq!(execution.topic, start());
        assert_eq!(told(&execution.request), Vec::<String>::new());
        assert_eq!(execution.requestor.map(|space| space.get()), Some(1));
        cell.executed(GRIPPER, execution.id, succeeded(4));
        cell.run(ms(50));
        let answers = cell.answers(BRIDGE);
        let (ask, found) = answers.first().unwrap();
        let found = found.clone().unwrap();
        assert_eq!((*ask, found), (AskId(1), answer), "{local:?}");
        assert_eq!(answers.len(), 1);
        let counters = cell.counters(BRIDGE, start());
        assert_eq!((counters.asked, counters.answered), (1, 1));
        assert_eq!(cell.counters(GRIPPER, start()).executed, 1);
    }
}

#[test]
fn a_block_of_fields_is_asked_with_as_it_is() {
    let mut cell = plugged_in(Local::Fields);
    let request = cell::block(&[Variant::Scalar(Scalar::Double(2.5))]);
    cell.ask(BRIDGE, AskId(1), (start(), &request), ms(3_000));
    cell.run(ms(50));
    let execution = cell.executions(GRIPPER).pop().unwrap();
    assert_eq!(execution.request, request);
    cell.executed(GRIPPER, execution.id, succeeded(9));
    cell.run(ms(50));
    let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
    assert!(told(&answer.unwrap())[2].contains('9'));
}

#[test]
fn a_type_that_lacks_what_the_call_wants_is_refused_with_the_name_of_the_field() {
    let mut wants = grasp();
    wants.request = vec![CallField::scalar("Force", BuiltinType::Double)];
    let trigger = service(Dialect::Ros1, "std_srvs/Trigger");
    let fault = |call: &CallDescription, service| {
        let fits = call.fits(service, &CallMap::default());
        fits.unwrap_err().to_string()
    };
    let why = fault(&wants, &trigger);
    assert!(why.contains("`Force` (Double)"), "{why}");
    let set_bool = service(Dialect::Ros1, "std_srvs/SetBool");
    let why = fault(&grasp(), &set_bool);
    assert!(why.contains("`data`"), "{why}");
    // Only optional fields may be omitted.
    let mut also = grasp();
    also.request
        .push(CallField::scalar("data", BuiltinType::Boolean));
    assert_eq!(also.fits(&set_bool, &CallMap::default()), Ok(()));
    also.request[0].optional = false;
    let why = fault(&also, &set_bool);
    assert!(why.contains("`Force` (Double)"), "{why}");
    let mut silent = grasp();
    silent.response.remove(1);
    let why = fault(&silent, &trigger);
    assert!(why.contains("`message` (String)"), "{why}");
    // Names in other cases and another order fit.
    let mut turned = grasp();
    turned.response.reverse();
    turned.response[1].name = "Message".to_owned();
    assert_eq!(turned.fits(&trigger, &CallMap::default()), Ok(()));

    let mut cell = plugged_in(Local::Ros1);
    cell.offer(GRIPPER, start(), offered(wants));
    cell.run(ms(3_000));
    let now = cell.now();
    assert!(
        cell.programs[BRIDGE]
            .router
            .bind_call(start(), (&trigger, &Arc::default()), now)
            .is_err()
    );
    cell.ask(BRIDGE, AskId(1), (start(), &[]), ms(3_000));
    cell.run(ms(50));
    let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
    let error = answer.unwrap_err();
    assert_eq!(error.kind, AskErrorKind::Refused);
    assert!(error.text.contains("`Force`"), "{error}");
    assert_eq!(cell.executions(GRIPPER).len(), 0, "nothing moves");
}

#[test]
fn answers_in_another_order_are_sorted_by_name_and_further_fields_left_out() {
    let mut cell = plugged_in(Local::Ros1);
    let mut turned = grasp();
    turned.response.reverse();
    cell.offer(GRIPPER, start(), offered(turned));
    cell.run(ms(3_000));
    let now = cell.now();
    let trigger = service(Dialect::Ros1, "std_srvs/Trigger");
    let bridge = &mut cell.programs[BRIDGE].router;
    bridge
        .bind_call(start(), (&trigger, &Arc::default()), now)
        .unwrap();
    cell.ask(BRIDGE, AskId(1), (start(), &[]), ms(3_000));
    cell.run(ms(50));
    let execution = cell.executions(GRIPPER).pop().unwrap();
    let fields = [
        Variant::Scalar(Scalar::UInt32(4)),
        Variant::Scalar(Scalar::String(Some("no"))),
        Variant::Scalar(Scalar::Boolean(false)),
    ];
    let answer = Executed::Answered(cell::block(&fields));
    cell.executed(GRIPPER, execution.id, answer);
    cell.run(ms(50));
    let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
    assert_eq!(answer.unwrap(), [0, 2, 0, 0, 0, b'n', b'o']);
}

#[test]
fn a_call_that_changes_all_the_time_is_not_offered_anew_each_time() {
    let mut cell = plugged_in(Local::Fields);
    for number in 0..20 {
        let mut other = grasp();
        other.about = format!("version {number}");
        cell.offer(GRIPPER, start(), offered(other));
        cell.run(ms(500));
    }
    let told = cell.known(BRIDGE).len();
    assert!((4..=10).contains(&told), "{told} times in 10 s");
    cell.run(ms(3_000));
    let bridge = &cell.programs[BRIDGE].router;
    assert_eq!(bridge.described_call(start()).unwrap().about, "version 19");
}

#[test]
fn what_nobody_executes_is_refused_and_what_dies_midway_is_unknown() {
    let mut cell = plugged_in(Local::Fields);
    cell.ask(BRIDGE, AskId(1), (topic(0, 9, 105), &[0, 0]), ms(3_000));
    let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
    assert_eq!(answer.unwrap_err().kind, AskErrorKind::Refused);

    cell.ask(BRIDGE, AskId(2), (start(), &[0, 0]), ms(10_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
    cell.kill(GRIPPER);
    cell.run(ms(4_000));
    let (ask, answer) = cell.answers(BRIDGE).pop().unwrap();
    assert_eq!(
        (ask, answer.unwrap_err().kind),
        (AskId(2), AskErrorKind::Unknown)
    );
    assert_eq!(cell.counters(BRIDGE, start()).unknown, 1);
}

#[test]
fn bad_outcomes_are_told_as_what_they_are() {
    let mut cell = plugged_in(Local::Fields);
    let outcomes = [
        (
            Executed::Failed(StatusCode(0x8001_0000)),
            AskErrorKind::Failed,
        ),
        (
            Executed::Refused(bridge_core::Refusal::Busy),
            AskErrorKind::Refused,
        ),
        (Executed::Lost, AskErrorKind::Unknown),
        // Not a block of fields.
        (Executed::Answered(vec![1]), AskErrorKind::Failed),
    ];
    for (number, (outcome, kind)) in (1..).zip(outcomes) {
        cell.ask(BRIDGE, AskId(number), (start(), &[0, 0]), ms(3_000));
        cell.run(ms(50));
        let execution = cell.executions(GRIPPER).pop().unwrap();
        cell.executed(GRIPPER, execution.id, outcome);
        cell.run(ms(50));
        let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
        assert_eq!(answer.unwrap_err().kind, kind);
    }
}

#[test]
fn requests_from_other_hosts_are_executed_only_where_that_is_allowed() {
    for open in [false, true] {
        let mut cell =
            SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Fields), component(7)]);
        cell.programs[BRIDGE].address = "192.168.1.9:5000".parse().unwrap();
        let description = grasp();
        cell.offer(GRIPPER, start(), OfferedCall { description, open });
        cell.run(ms(200));
        cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
        cell.run(ms(50));
        let executions = cell.executions(GRIPPER);
        assert_eq!(executions.len(), usize::from(open));
        let refused = cell.counters(GRIPPER, start()).drops;
        assert_eq!(refused.dropped(Reason::CallRefused), u64::from(!open));
        if !open {
            let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
            assert_eq!(answer.unwrap_err().status, StatusCode(0x801F_0000));
        }
    }
}

#[test]
fn a_forged_answer_is_not_believed_whether_from_a_third_space_or_a_third_address() {
    let mut cell = SimulatedCell::new(vec![
        SimulatedProgram::new(1, Local::Fields),
        component(7),
        SimulatedProgram::new(3, Local::Fields),
    ]);
    cell.offer(GRIPPER, start(), offered(grasp()));
    cell.run(ms(200));
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    let execution = cell.executions(GRIPPER).pop().unwrap();
    cell.executed(GRIPPER, execution.id, succeeded(1));
    // The response is captured, and another sender sends it first.
    let said = cell.datagrams_of(GRIPPER);
    let answer = said
        .into_iter()
        .rfind(|bytes| cell::is_action(bytes))
        .unwrap();
    let stranger = "127.0.0.1:999".parse().unwrap();
    cell.hear(BRIDGE, &answer, stranger);
    let mut third = answer.clone();
    // The PublisherId of the Responder, a UInt16 after the flags.
    let at = third.windows(2).position(|bytes| *bytes == [0, 0]).unwrap();
    third[at] = 3;
    let other = cell.programs[2].address;
    cell.hear(BRIDGE, &third, other);
    assert_eq!(cell.answers(BRIDGE).len(), 0);
    assert_eq!(cell.dropped(BRIDGE, Reason::Forged), 2);
    let gripper = cell.programs[GRIPPER].address;
    cell.hear(BRIDGE, &answer, gripper);
    assert_eq!(cell.answers(BRIDGE).len(), 1);
    cell.hear(BRIDGE, &answer, gripper);
    assert_eq!(cell.answers(BRIDGE).len(), 0, "once");
    assert!(cell.dropped(BRIDGE, Reason::NotAsked) > 0);
}

#[test]
fn who_gives_up_gets_no_answer_and_who_executes_is_told() {
    let mut cell = plugged_in(Local::Fields);
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    let execution = cell.executions(GRIPPER).pop().unwrap();
    let now = cell.now();
    cell.programs[BRIDGE].router.give_up(AskId(1), now);
    cell.run(ms(200));
    assert_eq!(cell.abandoned(GRIPPER), [execution.id]);
    cell.executed(GRIPPER, execution.id, succeeded(1));
    cell.run(ms(500));
    assert_eq!(cell.answers(BRIDGE).len(), 0);
}

#[test]
fn no_more_requests_are_open_than_there_is_room_for() {
    let mut cell = plugged_in(Local::Fields);
    for number in 0..300 {
        cell.ask(BRIDGE, AskId(number), (start(), &[0, 0]), ms(60_000));
    }
    let refused = cell.answers(BRIDGE);
    assert_eq!(refused.len(), 44);
    assert!(refused.iter().all(|(_, answer)| {
        let busy = bridge_core::Refusal::Busy.status_code();
        answer.as_ref().is_err_and(|error| error.status == busy)
    }));
    cell.run(ms(300));
    assert_eq!(cell.executions(GRIPPER).len(), 256);
}

#[test]
fn calls_of_several_components_with_equal_identifiers_are_told_apart() {
    let mut cell = SimulatedCell::new(vec![
        SimulatedProgram::new(1, Local::Fields),
        component(7),
        component(8),
    ]);
    let mut other = grasp();
    other.name = "vacuum.Grasp.Start".to_owned();
    cell.offer(1, start(), offered(grasp()));
    cell.offer(2, topic(0, 8, 105), offered(other));
    cell.run(ms(200));
    assert_eq!(cell.known(BRIDGE), [start(), topic(0, 8, 105)]);
    let names = [start(), topic(0, 8, 105)].map(|call| {
        let known = cell.programs[BRIDGE].router.described_call(call).unwrap();
        known.name.clone()
    });
    assert_eq!(names, ["gripper.Grasp.Start", "vacuum.Grasp.Start"]);
    cell.ask(BRIDGE, AskId(1), (topic(0, 8, 105), &[0, 0]), ms(3_000));
    cell.run(ms(100));
    assert_eq!(cell.executions(1).len(), 0);
    assert_eq!(cell.executions(2).len(), 1);
}

#[test]
fn a_component_that_dies_is_gone_when_its_values_are_missing_and_back_when_it_is_started_anew() {
    let mut cell = plugged_in(Local::Fields);
    cell.describe(GRIPPER, topic(0, 7, 101), state());
    cell.say(GRIPPER, topic(0, 7, 101), "Ready");
    cell.run(ms(20_000));
    assert_eq!(cell.gone(BRIDGE), [], "it lives");
    cell.kill(GRIPPER);
    cell.run(ms(1_900));
    assert_eq!(cell.gone(BRIDGE), [], "a datagram or two may be lost");
    cell.run(ms(1_800));
    assert_eq!(cell.gone(BRIDGE), [start()]);
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
    let (_, answer) = cell.answers(BRIDGE).pop().unwrap();
    assert_eq!(answer.unwrap_err().kind, AskErrorKind::Refused);

    // At another port, as after the restart of a program.
    let again = component(7).at_port(7_777);
    cell.start(GRIPPER, again);
    cell.offer(GRIPPER, start(), offered(grasp()));
    cell.run(ms(500));
    assert_eq!(cell.known(BRIDGE), [start()]);
    cell.ask(BRIDGE, AskId(2), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
}

#[test]
fn a_component_that_is_started_anew_at_once_is_asked_as_soon_as_its_past_is_over() {
    let mut cell = plugged_in(Local::Fields);
    cell.describe(GRIPPER, topic(0, 7, 101), state());
    cell.say(GRIPPER, topic(0, 7, 101), "Ready");
    cell.run(ms(2_000));
    let again = component(7).at_port(7_777);
    cell.start(GRIPPER, again);
    cell.offer(GRIPPER, start(), offered(grasp()));
    cell.run(ms(5_500));
    assert_eq!(
        (cell.gone(BRIDGE), cell.known(BRIDGE)),
        (vec![start()], vec![start()])
    );
    cell.ask(BRIDGE, AskId(2), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);
}

#[test]
fn a_call_without_values_is_gone_when_it_is_not_announced_any_more_or_said_to_be() {
    let mut cell = plugged_in(Local::Fields);
    cell.run(ms(100_000));
    assert_eq!(cell.gone(BRIDGE), [], "it is announced every 30 s");
    let now = cell.now();
    cell.programs[GRIPPER].router.withdraw_all(now);
    cell.run(ms(50));
    assert_eq!(cell.gone(BRIDGE), [start()], "at once");

    let mut cell = plugged_in(Local::Fields);
    cell.kill(GRIPPER);
    cell.run(ms(80_000));
    assert_eq!(cell.gone(BRIDGE), []);
    cell.run(ms(15_000));
    assert_eq!(cell.gone(BRIDGE), [start()]);
}

#[test]
fn a_program_whose_last_value_has_no_producer_any_more_keeps_its_calls_until_it_dies() {
    let mut cell = plugged_in(Local::Fields);
    cell.describe(GRIPPER, topic(0, 7, 101), state());
    cell.say(GRIPPER, topic(0, 7, 101), "Ready");
    cell.run(ms(5_000));
    let now = cell.now();
    let component = &mut cell.programs[GRIPPER].router;
    component.set_live(topic(0, 7, 101), false, now);
    cell.run(ms(100_000));
    assert_eq!((cell.gone(BRIDGE), cell.known(BRIDGE)), (vec![], vec![]));
    cell.ask(BRIDGE, AskId(1), (start(), &[0, 0]), ms(3_000));
    cell.run(ms(50));
    assert_eq!(cell.executions(GRIPPER).len(), 1);

    // With values again, its loss is detected as fast as before.
    cell.say(GRIPPER, topic(0, 7, 101), "Ready");
    cell.run(ms(5_000));
    cell.kill(GRIPPER);
    cell.run(ms(3_700));
    assert_eq!(cell.gone(BRIDGE), [start()]);
}

#[test]
fn a_program_that_speaks_seldom_is_missed_whenever_it_dies() {
    let text = "spaces: [{id: 2}]\npubsub: {key_frame_period: 10s, keep_alive_period: 10s, receive_timeout: 15s}\n";
    let checked = Mapping::from_yaml(text, "test.yaml");
    assert!(checked.findings.is_empty(), "{}", checked.render(text));
    let mapping = Arc::new(checked.mapping.unwrap());
    for second in 0..10 {
        let mut cell = plugged_in(Local::Fields);
        let now = cell.now();
        for program in &mut cell.programs {
            program.router.replace_mapping(Arc::clone(&mapping), now);
        }
        cell.describe(GRIPPER, topic(0, 7, 101), state());
        cell.say(GRIPPER, topic(0, 7, 101), "Ready");
        cell.run(ms(50_500 + 1_000 * second));
        assert_eq!(cell.gone(BRIDGE), [], "{second}: it lives");
        cell.kill(GRIPPER);
        cell.run(ms(15_700));
        assert_eq!(cell.gone(BRIDGE), [start()], "{second}");
    }
}

#[test]
fn who_comes_late_learns_the_calls_that_are_there_by_asking() {
    let mut cell = SimulatedCell::new(vec![component(7)]);
    cell.describe(0, topic(0, 7, 101), state());
    cell.offer(0, start(), offered(grasp()));
    cell.say(0, topic(0, 7, 101), "Ready");
    cell.run(ms(5_000));
    cell.programs.push(SimulatedProgram::new(2, Local::Fields));
    // The next key frame is received within a second, and the response to the probe within another
    // second.
    cell.run(ms(2_000));
    assert_eq!(cell.known(1), [start()]);

    // Or after a request for the call.
    let mut cell = SimulatedCell::new(vec![component(7)]);
    cell.offer(0, start(), offered(grasp()));
    cell.run(ms(5_000));
    cell.programs.push(SimulatedProgram::new(2, Local::Fields));
    let now = cell.now();
    cell.programs[1].router.want_call(start(), now);
    cell.run(ms(1_000));
    assert_eq!(cell.known(1), [start()]);

    // Or after the probe of a starting program.
    cell.programs.push(SimulatedProgram::new(3, Local::Cdr));
    let now = cell.now();
    cell.programs[2].router.call_the_roll(now);
    cell.run(ms(3_000));
    assert_eq!(cell.known(2), [start()]);
}

fn state() -> ValueDescription {
    ValueDescription {
        name: "gripper.Grasp.State".to_owned(),
        message_type: Some("std_msgs/String".parse().unwrap()),
        about: "GripperSkillType nsu=urn:x".to_owned(),
        fields: vec![Leaf {
            path: "data".to_owned(),
            builtin: BuiltinType::String,
            rank: ArrayRank::Scalar,
        }],
        overflow: Overflow::KeepLatest,
    }
}

#[test]
fn a_value_that_the_program_describes_itself_crosses_under_the_ros_type_it_says() {
    let mut cell = SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Ros1), component(7)]);
    let value = topic(0, 7, 101);
    cell.describe(GRIPPER, value, state());
    cell.say(GRIPPER, value, "Ready");
    cell.run(ms(2_000));
    let outputs = cell.outputs(BRIDGE);
    let described = outputs.iter().rev().find_map(|output| match output {
        Output::Unbound { described, .. } => described.clone(),
        _ => None,
    });
    let described = described.unwrap();
    assert_eq!(described.message_type.as_str(), "std_msgs/String");
    assert_eq!(described.name, "gripper.Grasp.State");
    assert_eq!(described.about, "GripperSkillType nsu=urn:x");
}

#[test]
fn a_namespace_that_somebody_else_writes_is_left_alone_until_it_is_free() {
    let mut cell = SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Fields), component(7)]);
    let value = topic(0, 7, 101);
    cell.describe(GRIPPER, value, state());
    cell.offer(GRIPPER, start(), offered(grasp()));
    cell.say(GRIPPER, value, "first");
    cell.run(ms(5_000));

    cell.programs.push(component(7).at_port(7_777));
    let now = cell.now();
    cell.programs[2].router.claim(now);
    cell.describe(2, value, state());
    cell.offer(2, start(), offered(grasp()));
    cell.say(2, value, "second");
    cell.run(ms(1_000));
    assert_eq!(cell.taken(2), [(7, true)]);
    let notices = |output: &Output| matches!(output, Output::Notice(_));
    assert!(!cell.outputs(2).iter().any(notices), "it is told once");
    cell.say(2, value, "third");
    cell.run(ms(5_000));
    assert_eq!(
        cell.datagrams_of(2).len(),
        1,
        "its question, and nothing else"
    );
    assert_eq!(cell.taken(GRIPPER), [], "it was there first");
    assert_eq!(cell.texts(BRIDGE, value), ["first"]);

    cell.kill(GRIPPER);
    cell.run(ms(5_000));
    assert_eq!(cell.taken(2), [(7, false)]);
    assert_eq!(cell.texts(BRIDGE, value), ["third"]);
    cell.run(ms(2_000));
    assert_eq!(cell.known(BRIDGE).last(), Some(&start()));
}

#[test]
fn a_free_namespace_is_used_after_a_moment_and_nothing_is_lost_meanwhile() {
    let mut cell = SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Fields), component(7)]);
    let value = topic(0, 7, 102);
    let now = cell.now();
    cell.programs[GRIPPER].router.claim(now);
    let events = ValueDescription {
        overflow: Overflow::DropOldest(std::num::NonZeroU16::new(10).unwrap()),
        ..state()
    };
    cell.describe(GRIPPER, value, events);
    for text in ["a", "b", "c"] {
        cell.say(GRIPPER, value, text);
    }
    cell.run(ms(250));
    assert_eq!(cell.texts(BRIDGE, value), Vec::<String>::new());
    cell.run(ms(100));
    assert_eq!(cell.texts(BRIDGE, value), ["a", "b", "c"]);
}

#[test]
fn a_state_replaced_before_its_namespace_is_known_to_be_free_is_no_overflow() {
    let mut cell = SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Fields), component(7)]);
    let value = topic(0, 7, 101);
    let now = cell.now();
    cell.programs[GRIPPER].router.claim(now);
    cell.describe(GRIPPER, value, state());
    for text in ["Starting", "Ready"] {
        cell.say(GRIPPER, value, text);
    }
    cell.run(ms(400));
    assert_eq!(cell.texts(BRIDGE, value), ["Ready"]);
    assert_eq!(cell.dropped(GRIPPER, Reason::Overflow), 0);
    assert_eq!(cell.dropped(GRIPPER, Reason::Outpaced), 1);
}

#[test]
fn a_server_shows_the_values_of_components_beside_its_own() {
    let mut cell = SimulatedCell::new(vec![
        SimulatedProgram::new(0, Local::Fields).owning(&[2]),
        component(7),
    ]);
    let (theirs, ours) = (topic(0, 7, 101), topic(0, 2, 10));
    cell.say(GRIPPER, theirs, "Ready");
    cell.say(0, ours, "mine");
    cell.run(ms(100));
    assert_eq!(cell.texts(0, theirs), ["Ready"]);
    assert_eq!(cell.texts(GRIPPER, ours), ["mine"]);
    assert_eq!(cell.dropped(0, Reason::SpaceTaken), 0);
    // Another program in its own namespace is handled differently.
    cell.programs.push(component(2).at_port(7_777));
    cell.say(2, ours, "rival");
    cell.run(ms(100));
    assert_eq!(cell.texts(0, ours), Vec::<String>::new());
    assert!(cell.dropped(0, Reason::SpaceTaken) > 0);

    // After a change the mapping assigns namespace 7 to it, too: received values of the namespace
    // are removed, and the conflict is reported.
    let now = cell.now();
    let both = Owned::Only([2, 7].into());
    cell.programs[0].router.set_owned(both, now);
    cell.describe(GRIPPER, theirs, state());
    cell.say(GRIPPER, theirs, "again");
    cell.run(ms(100));
    assert_eq!(cell.texts(0, theirs), Vec::<String>::new());
    let only = Owned::Only([2].into());
    cell.programs[0].router.set_owned(only, now);
    cell.run(ms(1_000));
    assert_eq!(cell.texts(0, theirs), ["again"], "by its repetition");
}

#[test]
fn a_request_and_a_response_of_a_megabyte_cross_in_chunks() {
    let mut cell = plugged_in(Local::Fields);
    let large = |byte: u8| {
        let bytes = vec![byte; 1 << 20];
        cell::block(&[Variant::Scalar(Scalar::ByteString(Some(&bytes)))])
    };
    let (request, response) = (large(1), large(2));
    cell.ask(BRIDGE, AskId(1), (start(), &request), ms(3_000));
    cell.run(ms(50));
    let execution = cell.executions(GRIPPER).pop().unwrap();
    assert!(execution.request == request);
    cell.executed(GRIPPER, execution.id, Executed::Answered(response.clone()));
    cell.run(ms(50));
    let answers = cell.answers(BRIDGE);
    assert!(answers.len() == 1 && answers[0].1 == Ok(response));
    // They are repeated, and executed once.
    cell.run(ms(500));
    assert!(cell.executions(GRIPPER).is_empty());
    // Chunks of a response do not count as values, so no values are missing.
    cell.run(ms(50_000));
    assert_eq!(cell.gone(BRIDGE), []);
}

#[test]
fn a_service_of_ros_2_is_asked_for_from_ros_1_under_another_type_as_a_map_says() {
    let mut cell = SimulatedCell::new(vec![
        SimulatedProgram::new(1, Local::Ros1),
        SimulatedProgram::new(2, Local::Cdr),
    ]);
    let call = topic(2, 5, 61);
    let set_bool = OfferedType {
        service_type: service(Dialect::Ros2, "std_srvs/SetBool"),
        name: "Belt.Switch".to_owned(),
        about: "switches the belt".to_owned(),
        role: CallRole::Call,
        open: false,
    };
    let now = cell.now();
    let (asking, executing) = (0, 1);
    let router = &mut cell.programs[executing].router;
    router.offer_type(call, &set_bool, now).unwrap();
    cell.run(ms(200));
    let described = cell.programs[asking].router.described_call(call).unwrap();
    assert_eq!(described.about, "std_srvs/SetBool; switches the belt");
    // The request is always true, and the map replaces the text of the response.
    let assign = |target: &str, value| Assignment {
        target: target.to_owned(),
        value,
    };
    let constant = |text: &str| Assigned::Constant(Literal::One(text.to_owned()));
    let map = CallMap {
        request: FieldMap(vec![assign("data", constant("true"))]),
        response: FieldMap(vec![assign("message", constant("asked"))]),
    };
    let trigger = service(Dialect::Ros1, "std_srvs/Trigger");
    let router = &mut cell.programs[asking].router;
    let by_name = router.bind_call(call, (&trigger, &Arc::default()), now);
    assert!(by_name.unwrap_err().to_string().contains("`data`"));
    let router = &mut cell.programs[asking].router;
    router
        .bind_call(call, (&trigger, &Arc::new(map)), now)
        .unwrap();
    cell.ask(asking, AskId(1), (call, &[]), ms(3_000));
    cell.run(ms(50));
    let execution = cell.executions(executing).pop().unwrap();
    // A CDR with a single Boolean and padding.
    assert_eq!(execution.request, [0, 1, 0, 0, 1, 0, 0, 0]);
    let response = [&[0, 1, 0, 0, 1, 0, 0, 0][..], &1_u32.to_le_bytes(), &[0; 4]].concat();
    cell.executed(executing, execution.id, Executed::Answered(response));
    cell.run(ms(50));
    let answers = cell.answers(asking);
    let told = [&[1][..], &5_u32.to_le_bytes(), b"asked"].concat();
    assert_eq!(answers[0].1, Ok(told));
}

#[test]
fn who_asks_with_the_ids_of_another_gets_the_own_answer_and_what_comes_too_late_nobody() {
    let mut cell = SimulatedCell::new(vec![
        SimulatedProgram::new(1, Local::Fields),
        component(7),
        SimulatedProgram::new(3, Local::Fields),
    ]);
    let asking = [0, 2];
    for at in asking {
        cell.programs[at].router.set_instance([9; 16]);
    }
    cell.offer(GRIPPER, start(), offered(grasp()));
    cell.run(ms(200));
    for at in asking {
        cell.ask(at, AskId(1), (start(), &[0, 0]), ms(3_000));
    }
    cell.run(ms(50));
    for execution in cell.executions(GRIPPER) {
        let space = execution.requestor.unwrap();
        let run = 40 + u32::from(u16::from(space));
        cell.executed(GRIPPER, execution.id, succeeded(run));
    }
    cell.run(ms(50));
    for (at, run) in asking.into_iter().zip(["41", "43"]) {
        let answers = cell.answers(at);
        let [(AskId(1), Ok(answer))] = &answers[..] else {
            panic!("{answers:?}");
        };
        assert!(told(answer)[2].contains(run), "{:?}", told(answer));
    }

    cell.ask(BRIDGE, AskId(2), (start(), &[0, 0]), ms(300));
    cell.run(ms(1_000));
    let (ask, answer) = cell.answers(BRIDGE).pop().unwrap();
    let kind = answer.unwrap_err().kind;
    assert_eq!((ask, kind), (AskId(2), AskErrorKind::Unknown));
    let execution = cell.executions(GRIPPER).pop().unwrap();
    cell.executed(GRIPPER, execution.id, succeeded(5));
    cell.run(ms(1_000));
    assert_eq!(cell.answers(BRIDGE).len(), 0);
}
