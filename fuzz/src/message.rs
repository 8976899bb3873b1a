//! Fuzzes messages of all types of the bundle, on both wire formats, with arbitrary bytes.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use messages::{Dialect, MessagePlan, ReadError, Selection, TypeRegistry, Wire, WriteFault};

use crate::tape::{EventPlayer, Recorder};

/// The plans by the digit of the ROS version and the name of the type.
static PLANS: LazyLock<BTreeMap<String, MessagePlan>> = LazyLock::new(|| {
    let ways = [
        (Dialect::Ros1, Wire::Ros1, 1),
        (Dialect::Ros2, Wire::Cdr, 2),
    ];
    ways.into_iter()
        .flat_map(|(dialect, wire, digit)| {
            let registry = TypeRegistry::bundle(dialect);
            let plans = registry.names().map(|name| {
                let message = registry.get(name).expect("the bundle is whole");
                let plan =
                    MessagePlan::compile(&message, &Selection::Whole, wire).expect("of its ROS");
                (format!("{digit}{name}"), plan)
            });
            plans.collect::<Vec<_>>()
        })
        .collect()
});

/// Decodes a message. The input is `1` or `2`, the name of a type, a line feed, and the message.
/// Its encoding must decode and encode to the same bytes. The number of events is bounded by the
/// number of bytes.
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
    // An element has at least one byte and up to two events around it; elements of a fixed array
    // may have no bytes.
    let most = 4 * payload.len() + 4096;
    assert!(fields.events.len() <= most, "{}", fields.events.len());
    let mut written = Vec::new();
    if let Err(error) = plan.write(&mut EventPlayer::new(&fields.events), &mut written) {
        assert!(written.is_empty(), "a message that failed left bytes");
        match error.fault {
            // Such text is accepted from other writers but not encoded.
            WriteFault::Nul => return,
            fault => panic!("what was read is not written: {}: {fault}", error.field),
        }
    }
    // A time is rounded and a Boolean of 2 becomes 1, so the first encoding may differ from the
    // input, and the second may not.
    let mut again = Recorder::default();
    plan.read(&written, &mut again)
        .expect("what was written can be read");
    let mut twice = Vec::new();
    plan.write(&mut EventPlayer::new(&again.events), &mut twice)
        .expect("it was written before");
    assert_eq!(written, twice, "writing is not canonical");
}
