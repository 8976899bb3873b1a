//! The DDS peers themselves: the tests of bridge-ros2 are only valid if the peers interoperate with
//! each other.

use std::time::Duration;

use system_tests::{Cell, Child, Peer};

const SOON: Duration = Duration::from_secs(20);
const STRING: &str = "std_msgs/String";

// Kept for late joiners. The writer counts a reader as matched before the reader has finished
// matching. On a busy machine, Cyclone DDS then misses some of the first samples of a volatile
// topic.
const TEXTS: [&str; 6] = [
    "/chatter",
    STRING,
    "--durability",
    "transient_local",
    "--depth",
    "200",
];

type Start = fn(&Cell, &[&str]) -> Child;

#[test]
fn numbered_texts_arrive_whole_between_both_makers() {
    let Some(cell) = Cell::with(&[Peer::FastDds, Peer::CycloneC]) else {
        return;
    };
    let (fast, cyclone): (Start, Start) = (Cell::fastdds, Cell::cyclone_c);
    for (writer, reader) in [(fast, cyclone), (cyclone, fast), (fast, fast)] {
        let mut hears = reader(&cell, &[&["sub"], &TEXTS[..], &["--counts"]].concat());
        let sends = ["--size", "2003", "--count", "200", "--rate", "1000"];
        let _sends = writer(
            &cell,
            &[&["pub"], &TEXTS[..], &sends, &["--wait-readers", "1"]].concat(),
        );
        hears.wait_for_json("all 200, whole and in order", SOON, |line| {
            (line["distinct"] == 200
                && line["bad"] == 0
                && line["repeated"] == 0
                && line["disordered"] == 0)
                .then_some(())
        });
    }
}

#[test]
fn a_call_is_answered_with_the_servers_bytes_and_by_its_own_reply() {
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let service = ["/add", "example_interfaces/AddTwoInts"];
    let _serves = cell.fastdds(&[&["serve"], &service[..]].concat());
    let call = [
        &["call"],
        &service[..],
        &["--hex", "0a000000", "--hex", "0b000000"],
    ]
    .concat();
    let mut callers = [cell.fastdds(&call), cell.fastdds(&call)];
    for caller in &mut callers {
        caller.wait_for_json("it is done", SOON, |line| line.get("done").map(drop));
        let replies: Vec<_> = caller
            .json_lines()
            .iter()
            .filter_map(|line| line.get("reply").cloned())
            .collect();
        assert_eq!(replies, ["0a000000", "0b000000"]);
    }
}
