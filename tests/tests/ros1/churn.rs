//! Leftovers of topics that came and went, and the cost of very many topics.

use serde_json::Value;
use std::path::Path;
use system_tests::{Cell, Child, MASTER, Peer, StartedChild, program};

use crate::ros1::support::SOON;

/// More files than a shell usually allows: each topic between two nodes of a process takes two.
const FILES: &str = "--nofile=8192";

fn crowd(cell: &Cell, args: &[&str]) -> Child {
    StartedChild::new("crowd", Path::new("/usr/bin/prlimit"))
        .args([FILES.into(), program("examples/crowd")])
        .args(args)
        .env("ROS_MASTER_URI", format!("http://{MASTER}"))
        .env("ROS_HOSTNAME", "127.0.0.1")
        .env("ROS_HOME", cell.folder())
        .start()
}

fn measured(crowd: &mut Child, what: &str) -> Value {
    let line = crowd.wait_for_json(what, 3 * SOON, |line| line.get(what).map(|_| line.clone()));
    println!("{line}");
    line
}

/// Requirement: topics that come and go leave no thread, no file and no memory behind. Memory may
/// differ by 2 MiB, because the allocator keeps freed memory.
#[test]
fn a_hundred_rounds_of_topics_leave_nothing_behind() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _others = cell.rospy("ros1_crowd.py", &["13"]);
    let mut crowd = crowd(&cell, &["churn", "13", "100"]);
    let warm = measured(&mut crowd, "warm");
    let end = measured(&mut crowd, "end");
    assert!(crowd.wait_for_end(SOON).success());
    assert_eq!(end["threads"], warm["threads"]);
    let number = |of: &Value, key: &str| of[key].as_u64().unwrap();
    // A call of the watchdog to the master may be open during either count.
    assert!(
        number(&end, "files") <= number(&warm, "files") + 2,
        "{warm} {end}"
    );
    assert!(
        number(&end, "rss_kib") <= number(&warm, "rss_kib") + 2048,
        "{warm} {end}"
    );
}

/// Requirement: a thousand topics need no threads of their own and little memory.
#[test]
fn five_hundred_publishers_and_subscribers_live_in_one_small_process() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let mut crowd = crowd(&cell, &["steady", "500"]);
    let steady = measured(&mut crowd, "steady");
    assert!(crowd.wait_for_end(SOON).success());
    assert!(steady["threads"].as_u64().unwrap() <= 9, "{steady}");
    assert!(steady["rss_kib"].as_u64().unwrap() < 40 * 1024, "{steady}");
}
