//! The deadline of a variable.

use std::sync::Arc;

use crate::cell::{SimulatedCell, component, ms, topic};
use mappings::Mapping;

const LEVEL: &str = "
namespaces: {7: urn:cell}
spaces: [{id: 1}]
variables:
  - node: ns=7;i=10
    name: Level
    origin: 0
    queue: keep_latest
    deadline: 100ms
    ros: {space: 1, topic: /level, type: std_msgs/String}
";

/// Returns the number of missed deadlines at a program.
fn missed(cell: &SimulatedCell, at: usize) -> u64 {
    let mut topics = cell.programs[at].router.topics();
    let found = topics.find(|(of, _)| *of == topic(0, 7, 10));
    found.map_or(0, |(_, counters)| counters.deadline_missed)
}

#[test]
fn a_value_later_than_the_deadline_is_counted_at_both_ends_and_repetitions_are_not() {
    let mut cell = SimulatedCell::new(vec![component(7), component(8)]);
    let mapping = Mapping::from_yaml(LEVEL, "cell.yaml").mapping.unwrap();
    let mapping = Arc::new(mapping);
    let now = cell.now();
    for program in &mut cell.programs {
        program.router.replace_mapping(Arc::clone(&mapping), now);
    }
    for (number, pause) in [50, 50, 50, 1_500, 50].into_iter().enumerate() {
        cell.say(0, topic(0, 7, 10), &number.to_string());
        cell.run(ms(pause));
    }
    assert_eq!([missed(&cell, 0), missed(&cell, 1)], [1, 1]);
}
