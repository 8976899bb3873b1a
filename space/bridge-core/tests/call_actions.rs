//! The calls and values of an action between Routers with different types on both sides.
use crate::cell;

use std::num::NonZeroU16;
use std::sync::Arc;

use bridge_core::{
    ActionFamily, AskId, CallMap, CallRole, Executed, Local, LocalMessage, OfferedType, Output,
    Reason, ValueNote,
};
use cell::{SimulatedCell, SimulatedProgram, ms, topic};
use mappings::{Assigned, Assignment, FieldMap, Overflow, TopicId};
use messages::{ActionCalls, Dialect, Literal, TypeRegistry};

const ASKING: usize = 0;
const EXECUTING: usize = 1;
const GOAL: u16 = 70;

fn actions(dialect: Dialect, name: &str, text: &str) -> ActionCalls {
    let mut registry = TypeRegistry::bundle(dialect);
    let name = name.parse().unwrap();
    registry.add_action(&name, text).unwrap();
    registry.action_calls(&name).unwrap()
}

fn of(id: u16) -> TopicId {
    topic(2, 5, id)
}

fn events() -> Overflow {
    Overflow::DropOldest(NonZeroU16::new(100).unwrap())
}

fn note(name: &str, overflow: Overflow, map: FieldMap) -> ValueNote {
    ValueNote {
        name: name.to_owned(),
        about: String::new(),
        overflow,
        map,
    }
}

fn assign(target: &str, value: Assigned) -> Assignment {
    Assignment {
        target: target.to_owned(),
        value,
    }
}

fn field(path: &str) -> Assigned {
    Assigned::Field(path.to_owned())
}

/// Creates a ROS 2 bridge that executes an action of the type, and a ROS 1 bridge.
fn executed(calls: &ActionCalls) -> SimulatedCell {
    let mut cell = SimulatedCell::new(vec![
        SimulatedProgram::new(1, Local::Ros1),
        SimulatedProgram::new(2, Local::Cdr),
    ]);
    let now = cell.now();
    let router = &mut cell.programs[EXECUTING].router;
    let feedback = note("Count.Feedback", events(), FieldMap::default());
    router
        .bind_as(of(GOAL + 3), (calls.feedback(), feedback), now)
        .unwrap();
    let family = ActionFamily::behind(GOAL).unwrap();
    for (id, service_type, role) in [
        (GOAL, calls.goal(), CallRole::Goal(family)),
        (GOAL + 2, calls.result(), CallRole::Result { of: GOAL }),
    ] {
        let offered = OfferedType {
            service_type: Arc::clone(service_type),
            name: String::new(),
            about: String::new(),
            role,
            open: false,
        };
        router.offer_type(of(id), &offered, now).unwrap();
    }
    cell.run(ms(200));
    cell
}

fn say(cell: &mut SimulatedCell, payload: &[u8]) {
    let now = cell.now();
    let heard = LocalMessage {
        topic: of(GOAL + 3),
        payload,
        received: now.utc,
        latched_by: None,
    };
    let _verdict = cell.programs[EXECUTING].router.handle_local(heard, now);
}

fn deliveries(cell: &mut SimulatedCell) -> Vec<Vec<u8>> {
    let outputs = cell.outputs(ASKING).into_iter();
    let payloads = outputs.filter_map(|output| match output {
        Output::Delivery(delivery) => Some(delivery.payload),
        _ => None,
    });
    payloads.collect()
}

const COUNT: &str =
    "int32 order\n---\nint32 last\nfloat64 share\n---\nint32 so_far\nfloat64 share\nstring step\n";
/// A part of the same fields in another order and under other names.
const WATCH: &str =
    "int32 goal\n---\nfloat64 part\nint32 last\n---\nfloat64 share\nint32 done\nuint8 kind\n";

/// Returns feedback in ROS 2.
fn feedback(so_far: i32) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend([7; 16]);
    bytes.extend(so_far.to_le_bytes());
    bytes.extend([0; 4]);
    bytes.extend(0.5_f64.to_le_bytes());
    bytes.extend([3, 0, 0, 0, b'u', b'p', 0]);
    bytes
}

/// Returns the same feedback in the ROS 1 type.
fn watched(done: i32) -> Vec<u8> {
    let mut bytes = vec![7; 16];
    bytes.extend(0.5_f64.to_le_bytes());
    bytes.extend(done.to_le_bytes());
    bytes.push(9);
    bytes
}

#[test]
fn feedback_in_a_row_is_told_whole_once_and_by_the_names_of_its_fields() {
    let mut cell = executed(&actions(Dialect::Ros2, "demo_msgs/Count", COUNT));
    let watch = actions(Dialect::Ros1, "demo_msgs/Watch", WATCH);
    let map = FieldMap(vec![
        assign("feedback.done", field("feedback.so_far")),
        assign(
            "feedback.kind",
            Assigned::Constant(Literal::One("9".to_owned())),
        ),
    ]);
    let now = cell.now();
    cell.programs[ASKING]
        .router
        .bind_as(
            of(GOAL + 3),
            (watch.feedback(), note("", events(), map)),
            now,
        )
        .unwrap();
    // The description of its writer has been probed.
    cell.run(ms(500));
    for so_far in 1..=5 {
        say(&mut cell, &feedback(so_far));
    }
    cell.run(ms(100));
    let expected: Vec<Vec<u8>> = (1..=5).map(watched).collect();
    assert_eq!(deliveries(&mut cell), expected);
    // An event is not repeated.
    cell.run(ms(5_000));
    assert_eq!(deliveries(&mut cell), Vec::<Vec<u8>>::new());
    assert_eq!(cell.dropped(ASKING, Reason::Mismatch), 0);
}

#[test]
fn the_first_feedback_is_told_where_the_action_was_known_before_it_was_offered() {
    let mut cell = executed(&actions(Dialect::Ros2, "demo_msgs/Count", COUNT));
    // A program that starts later has not received the first announcements.
    cell.kill(ASKING);
    cell.start(ASKING, SimulatedProgram::new(1, Local::Ros1));
    let now = cell.now();
    cell.programs[ASKING].router.call_the_roll(now);
    cell.run(ms(2_000));
    let same = actions(Dialect::Ros1, "demo_msgs/Count", COUNT);
    let now = cell.now();
    let by_name = note("", events(), FieldMap::default());
    let router = &mut cell.programs[ASKING].router;
    let bound = router.bind_as(of(GOAL + 3), (same.feedback(), by_name), now);
    bound.unwrap();
    say(&mut cell, &feedback(1));
    cell.run(ms(20));
    assert_eq!(deliveries(&mut cell).len(), 1);
}

#[test]
fn feedback_of_other_fields_is_counted_and_not_misread() {
    let mut cell = executed(&actions(Dialect::Ros2, "demo_msgs/Count", COUNT));
    let watch = actions(Dialect::Ros1, "demo_msgs/Watch", WATCH);
    let now = cell.now();
    let by_name = note("", events(), FieldMap::default());
    cell.programs[ASKING]
        .router
        .bind_as(of(GOAL + 3), (watch.feedback(), by_name), now)
        .unwrap();
    cell.run(ms(500));
    say(&mut cell, &feedback(1));
    cell.run(ms(500));
    assert_eq!(deliveries(&mut cell), Vec::<Vec<u8>>::new());
    assert!(cell.dropped(ASKING, Reason::Mismatch) > 0);
}

#[test]
fn a_goal_and_its_result_are_made_as_a_map_says() {
    let count = actions(Dialect::Ros2, "demo_msgs/Count", COUNT);
    let watch = actions(Dialect::Ros1, "demo_msgs/Watch", WATCH);
    let mut cell = executed(&count);
    let goal = CallMap {
        request: FieldMap(vec![assign("goal.order", field("goal.goal"))]),
        response: FieldMap::default(),
    };
    let result = CallMap {
        request: FieldMap::default(),
        response: FieldMap(vec![assign("result.part", field("result.share"))]),
    };
    let now = cell.now();
    let router = &mut cell.programs[ASKING].router;
    let bound = router.bind_call(of(GOAL), (watch.goal(), &Arc::new(goal)), now);
    bound.unwrap();
    let bound = router.bind_call(of(GOAL + 2), (watch.result(), &Arc::new(result)), now);
    bound.unwrap();
    let request = [&[3; 16][..], &11_i32.to_le_bytes()].concat();
    cell.ask(ASKING, AskId(1), (of(GOAL), &request), ms(3_000));
    cell.run(ms(50));
    let execution = cell.executions(EXECUTING).pop().unwrap();
    let told = [&[0, 1, 0, 0][..], &[3; 16], &11_i32.to_le_bytes()].concat();
    assert_eq!(execution.request, told);
    cell.ask(ASKING, AskId(2), (of(GOAL + 2), &[3; 16]), ms(3_000));
    cell.run(ms(50));
    let execution = cell.executions(EXECUTING).pop().unwrap();
    // The status, an empty text, and the fields after the status in the message of ROS 2.
    let mut response = vec![0, 1, 0, 0, 4, 0, 0, 0, 1, 0, 0, 0, 0];
    response.extend([0; 3]);
    response.extend(8_i32.to_le_bytes());
    response.extend(0.25_f64.to_le_bytes());
    cell.executed(EXECUTING, execution.id, Executed::Answered(response));
    cell.run(ms(50));
    let answer = cell.answers(ASKING).pop().unwrap().1.unwrap();
    let mut told = vec![4, 0, 0, 0, 0];
    told.extend(0.25_f64.to_le_bytes());
    told.extend(8_i32.to_le_bytes());
    assert_eq!(answer, told);
}

#[test]
fn the_last_feedback_is_told_before_the_result() {
    let count = actions(Dialect::Ros2, "demo_msgs/Count", COUNT);
    let same = actions(Dialect::Ros1, "demo_msgs/Count", COUNT);
    let mut cell = executed(&count);
    let now = cell.now();
    let by_name = note("", events(), FieldMap::default());
    let router = &mut cell.programs[ASKING].router;
    let bound = router.bind_as(of(GOAL + 3), (same.feedback(), by_name), now);
    bound.unwrap();
    let map = Arc::new(CallMap::default());
    let bound = router.bind_call(of(GOAL + 2), (same.result(), &map), now);
    bound.unwrap();
    cell.ask(ASKING, AskId(1), (of(GOAL + 2), &[3; 16]), ms(3_000));
    cell.run(ms(500));
    let execution = cell.executions(EXECUTING).pop().unwrap();
    cell.outputs(ASKING);
    say(&mut cell, &feedback(1));
    let mut response = vec![0, 1, 0, 0, 4, 0, 0, 0, 1, 0, 0, 0, 0];
    response.extend([0; 15]);
    cell.executed(EXECUTING, execution.id, Executed::Answered(response));
    cell.run(ms(50));
    let told: Vec<&str> = cell
        .outputs(ASKING)
        .iter()
        .filter_map(|output| match output {
            Output::Delivery(_) => Some("feedback"),
            Output::Answer { .. } => Some("result"),
            _ => None,
        })
        .collect();
    assert_eq!(told, ["feedback", "result"]);
}
