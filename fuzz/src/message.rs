//! Any bytes as a message of any type of the bundle, on either wire.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use messages::{Dialect, Plan, ReadError, Registry, Selection, Wire, WriteFault};

use crate::tape::{Player, Recorder};

/// By the digit of the ROS and the name.
static PLANS: LazyLock<BTreeMap<String, Plan>> = LazyLock::new(|| {
    let ways = [
        (Dialect::Ros1, Wire::Ros1, 1),
        (Dialect::Ros2, Wire::Cdr, 2),
    ];
    ways.into_iter()
        .flat_map(|(dialect, wire, digit)| {
            let registry = Registry::bundle(dialect);
            let plans = registry.names().map(|name| {
                let message = registry.get(name).expect("the bundle is whole");
                let plan = Plan::compile(&message, &Selection::Whole, wire).expect("of its ROS");
                (format!("{digit}{name}"), plan)
            });
            plans.collect::<Vec<_>>()
        })
        .collect()
});

/// The input is `1` or `2`, the name of a type, a line feed, and the message. What is read is written again, and that
/// reads and writes the same. Neither hands over more than the bytes can hold.
pub fn message(input: &[u8]) {
    let Some(end) = input.iter().position(|byte| *byte == b'\n') else {
        return;
    };
    let (name, payload) = (&input[..end], &input[end + 1..]);
    let Some(plan) = std::str::from_utf8(name)
        .ok()
        .and_then(|name| PLANS.get(name))
    else {
        return;
    };
    let mut fields = Recorder::default();
    match plan.read(payload, &mut fields) {
        Ok(()) => {}
        Err(ReadError::Malformed { at, .. }) => {
            assert!(at <= payload.len(), "the fault is at {at}, behind the end");
            return;
        }
        Err(ReadError::Sink { .. } | ReadError::Value { .. }) => {
            panic!("a recorder takes all, and nothing is converted")
        }
    }
    // An element is a byte at the least, and each has an event or two around it; of a fixed array none.
    let most = 4 * payload.len() + 4096;
    assert!(fields.events.len() <= most, "{}", fields.events.len());
    let mut written = Vec::new();
    if let Err(error) = plan.write(&mut Player::new(&fields.events), &mut written) {
        assert!(written.is_empty(), "a message that failed left bytes");
        match error.fault {
            // Read of what others write, and not written.
            WriteFault::Nul => return,
            fault => panic!("what was read is not written: {}: {fault}", error.field),
        }
    }
    // A time is rounded and a Boolean of 2 becomes 1, so what is written may differ from what was read, but once.
    let mut again = Recorder::default();
    plan.read(&written, &mut again)
        .expect("what was written can be read");
    let mut twice = Vec::new();
    plan.write(&mut Player::new(&again.events), &mut twice)
        .expect("it was written before");
    assert_eq!(written, twice, "writing is not canonical");
}
