//! Programs that claim the same namespace, over a network that loses datagrams.
use crate::cell;

use std::cell::Cell as Flag;
use std::rc::Rc;

use bridge_core::{CallDescription, CallField, CallRole, OfferedCall};
use cell::{SimulatedCell, component, ms, topic};
use uadp::BuiltinType;

fn offer(cell: &mut SimulatedCell, at: usize) {
    let offered = OfferedCall {
        description: CallDescription {
            name: "gripper.Grasp.Start".to_owned(),
            about: String::new(),
            role: CallRole::Call,
            request: Vec::new(),
            response: vec![CallField::scalar("success", BuiltinType::Boolean)],
        },
        open: false,
    };
    cell.offer(at, topic(0, 7, 105), offered);
}

/// Starts a program that offers a call, and claims its namespace.
fn start(cell: &mut SimulatedCell, at: usize) {
    let now = cell.now();
    cell.programs[at].router.claim(now);
    offer(cell, at);
}

/// Returns a network that loses its datagrams while the flag is set.
fn lossy(cell: &mut SimulatedCell) -> Rc<Flag<bool>> {
    let is_lost = Rc::new(Flag::new(false));
    let flag = Rc::clone(&is_lost);
    cell.copies = Box::new(move |_| usize::from(!flag.get()));
    is_lost
}

#[test]
fn a_writer_is_found_although_the_first_probes_and_responses_are_lost() {
    for lost_for in [50, 150, 250, 700] {
        let mut cell = SimulatedCell::new(vec![component(7)]);
        let is_lost = lossy(&mut cell);
        start(&mut cell, 0);
        cell.run(ms(5_000));

        cell.programs.push(component(7).at_port(7_777));
        is_lost.set(true);
        start(&mut cell, 1);
        cell.run(ms(lost_for));
        is_lost.set(false);
        cell.run(ms(2_000));
        assert_eq!(cell.taken(1), [(7, true)], "lost for {lost_for} ms");
        assert_eq!(cell.taken(0), [], "it was there first");
    }
}

#[test]
fn of_two_programs_that_start_at_the_same_moment_one_stays() {
    let mut cell = SimulatedCell::new(vec![component(7), component(7).at_port(7_777)]);
    let is_lost = lossy(&mut cell);
    is_lost.set(true);
    for at in [0, 1] {
        start(&mut cell, at);
    }
    cell.run(ms(400));
    is_lost.set(false);
    for at in [0, 1] {
        cell.say(at, topic(0, 7, 101), "Ready");
    }
    cell.run(ms(10_000));
    let stay = [0, 1].map(|at| cell.taken(at).last() != Some(&(7, true)));
    assert_eq!(stay.iter().filter(|stays| **stays).count(), 1, "{stay:?}");
    let before = [0, 1].map(|at| cell.datagrams_of(at).len());
    cell.run(ms(3_000));
    let sends = [0, 1].map(|at| cell.datagrams_of(at).len() > before[at]);
    assert_eq!(sends, stay);
}
