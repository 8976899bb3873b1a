//! bridge-ros2 with peers that come, vanish, are numerous, and request QoS that is not offered.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use system_tests::{
    Cell, Child, LeasedParticipant, METRICS_ROS2, Peer, StartedChild, TopicTriple, UaSide,
    anonymous, cpu_share, eventually, metrics, program, resident, threads,
};
use uadp::Scalar;

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::FastDds, Peer::CycloneC];
const STRING: &str = "std_msgs/String";
/// A value of the space, and a value of the domain.
const THERE: (TopicTriple, &str) = ((1, 2, 10), "/ua_1_2_10");
const BACK: (TopicTriple, &str) = ((2, 2, 20), "/ua_2_2_20");

type Peers = [fn(&Cell, &[&str]) -> Child; 2];
const MAKERS: Peers = [Cell::fastdds, Cell::cyclone_c];

/// Writes the text to the space ten times a second until it is the newest value of all readers.
fn reaches(ua: &mut UaSide, triple: TopicTriple, text: &str, readers: &mut [&mut Child]) {
    let mut written: Option<Instant> = None;
    eventually(&format!("all readers have `{text}`"), SOON, || {
        if written.is_none_or(|at| at.elapsed() > Duration::from_millis(100)) {
            ua.write(triple, Scalar::String(Some(text)));
            written = Some(Instant::now());
        }
        readers
            .iter_mut()
            .all(|reader| {
                reader
                    .values()
                    .last()
                    .is_some_and(|last| last["data"] == *text)
            })
            .then_some(())
    });
}

fn kill(mut child: Child) {
    child.signal(Signal::SIGKILL);
    child.wait_for_end(SOON);
}

fn sends<'a>(topic: &'a str, text: &'a str) -> [&'a str; 9] {
    [
        "pub", topic, STRING, "--text", text, "--count", "0", "--rate", "20",
    ]
}

#[test]
fn values_flow_again_each_time_a_peer_is_killed_and_started() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut ua = UaSide::join();
    let mut bridge = cell.bridge_ros2(&[]);
    for turn in 0..20 {
        let peer = MAKERS[turn % MAKERS.len()];
        let mut reader = peer(&cell, &["sub", THERE.1, STRING]);
        let back = format!("back {turn}");
        let writer = peer(&cell, &sends(BACK.1, &back));
        reaches(
            &mut ua,
            THERE.0,
            &format!("there {turn}"),
            &mut [&mut reader],
        );
        ua.hear_scalar(BACK.0, Scalar::String(Some(&back)));
        kill(reader);
        kill(writer);
    }
    assert!(bridge.runs());
}

#[test]
fn values_flow_again_each_time_the_bridge_is_killed_and_started() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut ua = UaSide::join();
    let mut readers = MAKERS.map(|peer| peer(&cell, &["sub", THERE.1, STRING]));
    let topics = [(2, 2, 20), (2, 2, 21)];
    let _writers = [
        cell.fastdds(&sends("/ua_2_2_20", "fast")),
        cell.cyclone_c(&sends("/ua_2_2_21", "cyclone")),
    ];
    for turn in 0..20 {
        let bridge = cell.bridge_ros2(&[]);
        let [fast, cyclone] = &mut readers;
        reaches(
            &mut ua,
            THERE.0,
            &format!("there {turn}"),
            &mut [fast, cyclone],
        );
        for (triple, text) in topics.into_iter().zip(["fast", "cyclone"]) {
            ua.hear_scalar(triple, Scalar::String(Some(text)));
        }
        kill(bridge);
        // The datagrams that the killed bridge sent are discarded.
        ua.drain();
    }
}

/// Like Ctrl-Z and `fg`, a debugger, or a frozen container: the waits of all its threads are
/// interrupted.
#[test]
fn a_bridge_that_was_stopped_and_goes_on_finds_who_comes_and_is_found() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut ua = UaSide::join();
    let mut bridge = cell.bridge_ros2(&[]);
    bridge.signal(Signal::SIGSTOP);
    let status = format!("/proc/{}/stat", bridge.id());
    eventually("it is stopped", SOON, || {
        let status = std::fs::read_to_string(&status).ok()?;
        status.contains(") T ").then_some(())
    });
    bridge.signal(Signal::SIGCONT);
    let mut readers = MAKERS.map(|peer| peer(&cell, &["sub", THERE.1, STRING]));
    let [fast, cyclone] = &mut readers;
    reaches(&mut ua, THERE.0, "there", &mut [fast, cyclone]);
    for peer in MAKERS {
        let writer = peer(&cell, &sends(BACK.1, "back"));
        ua.hear_scalar(BACK.0, Scalar::String(Some("back")));
        kill(writer);
        ua.drain();
    }
    assert!(bridge.runs());
}

/// For example, the wire was cut for 30 s: the bridge loses a ROS 2 node after 20 s, and the node
/// loses the bridge after 50 s. The node keeps its state, and Fast DDS drops an ACKNACK whose count
/// is not above the previous count.
#[test]
fn a_participant_that_was_lost_and_has_not_lost_us_is_asked_with_counts_that_go_on() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let _bridge = cell.bridge_ros2(&[]);
    let node = LeasedParticipant::open();
    node.announce();
    // Meanwhile the node's lease of a second ends, which is checked every two seconds.
    let before = node.asked(Duration::from_secs(4), |_| false);
    node.announce();
    let after = node.asked(SOON, |counts| !counts.is_empty());
    assert!(!before.is_empty(), "it is not asked");
    let highest = before.iter().max();
    assert!(after.first() > highest, "{after:?} after {before:?}");
}

/// Receives texts of the topics `2_3_k` until each of `count` topics has sent its k.
fn hear_each(ua: &UaSide, count: u16) {
    for number in 1..=count {
        ua.hear_scalar((2, 3, number), Scalar::String(Some(&number.to_string())));
    }
}

#[test]
fn thirteen_participants_that_join_at_once_exchange_values_with_the_bridge() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut ua = UaSide::join();
    let _bridge = cell.bridge_ros2(&[]);
    for peer in MAKERS {
        let mut crowd = peer(&cell, &["crowd", "/ua_2_3_", "--hear", THERE.1]);
        hear_each(&ua, 13);
        eventually("all members hear the bridge", SOON, || {
            ua.write(THERE.0, Scalar::String(Some("hello")));
            std::thread::sleep(Duration::from_millis(50));
            (members(&crowd).len() == 13).then_some(())
        });
        crowd.tell("leave");
        crowd.wait_for_end(SOON);
    }
}

fn members(crowd: &Child) -> BTreeSet<u64> {
    let lines = crowd.json_lines();
    lines
        .iter()
        .filter_map(|line| line["member"].as_u64())
        .collect()
}

#[test]
fn five_hundred_topics_take_few_threads_little_memory_and_no_processor_when_idle() {
    const EACH_WAY: u16 = 250;
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut ua = UaSide::join();
    let mut bridge = cell.bridge_ros2(&[]);
    for peer in MAKERS {
        let number = EACH_WAY.to_string();
        let many = [
            "crowd",
            "/ua_2_3_",
            "--hear-each",
            "/ua_1_3_",
            "--members",
            &number,
        ];
        let mut crowd = peer(&cell, &[&many[..], &["--one-participant"]].concat());
        hear_each(&ua, EACH_WAY);
        let start = Instant::now();
        while members(&crowd).len() < usize::from(EACH_WAY) {
            assert!(start.elapsed() < SOON, "{} heard", members(&crowd).len());
            for number in 1..=EACH_WAY {
                ua.write((1, 3, number), Scalar::String(Some("there")));
            }
            std::thread::sleep(Duration::from_millis(500));
        }
        crowd.tell("leave");
        crowd.wait_for_end(SOON);
    }
    let (threads, memory) = (threads(bridge.id()), resident(bridge.id()));
    let idle = cpu_share(bridge.id(), Duration::from_secs(5));
    println!(
        "500 topics: {threads} threads, {} MB, {:.1} % of a processor when idle",
        memory / 1_000_000,
        idle * 100.0
    );
    assert!(threads < 10, "{threads} threads");
    assert!(memory < 100_000_000, "{memory} bytes");
    assert!(idle < 0.05, "{:.1} %", idle * 100.0);
    assert!(bridge.runs());
}

#[test]
fn five_thousand_routes_of_a_mapping_take_little_memory() {
    const ROUTES: usize = 5000;
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let mut text = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: urn:test}\nvariables:\n".to_owned();
    for route in 1..=ROUTES {
        // Half of the routes are read, the others written.
        let origin = 1 + route % 2;
        text += &format!(
            "  - {{node: ns=2;i={route}, name: R{route}, origin: {origin}, \
             ros: [{{space: 2, topic: /robot{}/value{route}, type: std_msgs/Float64, field: data}}]}}\n",
            route % 50
        );
    }
    let mapping = cell.file("cell.yaml", &text);
    let mut bridge = cell.bridge_ros2(&[mapping.to_str().unwrap()]);
    // The log lists the first routes only. An endpoint of RustDDS has three descriptors.
    eventually("all routes are there", 2 * SOON, || {
        let descriptors = std::fs::read_dir(format!("/proc/{}/fd", bridge.id())).unwrap();
        (descriptors.count() >= 3 * ROUTES).then_some(())
    });
    // The bridge processes its own announcements for a while.
    let (mut memory, mut since) = (0, Instant::now());
    eventually("its memory stays as it is", SOON, || {
        let more = resident(bridge.id());
        if more != memory {
            (memory, since) = (more, Instant::now());
        }
        (since.elapsed() > Duration::from_secs(2)).then_some(())
    });
    let idle = cpu_share(bridge.id(), Duration::from_secs(6));
    println!(
        "{ROUTES} routes: {} MB, {:.1} % of a processor when idle",
        memory / 1_000_000,
        idle * 100.0
    );
    // The routes' memory is private; some 30 MB are pages of the program file.
    let own = anonymous(bridge.id());
    assert!(own < 58_000_000, "{own} bytes");
    assert!(memory < 87_000_000, "{memory} bytes");
    assert!(idle < 0.04, "{:.1} %", idle * 100.0);
    assert!(bridge.runs());
}

/// Starts a second bridge on the domain, for the values of that space, and waits until it answers.
fn second_bridge(space: &str) -> Child {
    const METRICS: &str = "127.0.0.1:9202";
    let bridge = StartedChild::new("the second bridge", &program("bridge-ros2"))
        .args(["--domain", "2", "--space", space, "--interface", "lo"])
        .args(["--metrics", METRICS])
        .start();
    eventually("the second bridge answers", SOON, || metrics(METRICS));
    bridge
}

/// Checks that a subscriber receives a value that was published once exactly once, and that traffic
/// of the space ends except for repetitions.
fn is_heard_once_beside(space: &str) {
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let ua = UaSide::join();
    let _bridges = (cell.bridge_ros2(&[]), second_bridge(space));
    let mut reader = cell.cyclone_c(&["sub", BACK.1, STRING]);
    let once = [
        "pub",
        BACK.1,
        STRING,
        "--text",
        "once",
        "--wait-readers",
        "2",
    ];
    let _writer = cell.cyclone_c(&once);
    ua.hear_scalar(BACK.0, Scalar::String(Some("once")));
    reader.wait_for_line("once", SOON);
    let _settling = ua.triples_for(Duration::from_secs(2));
    let repeated = ua.triples_for(Duration::from_secs(3));
    // Each bridge sends a key frame or keep-alive a second; the rest is a margin.
    assert!(repeated.len() <= 10, "{}: {repeated:?}", repeated.len());
    assert_eq!(reader.values().len(), 1);
}

#[test]
fn two_bridges_of_one_space_on_one_domain_make_no_loop() {
    is_heard_once_beside("2");
}

#[test]
fn two_bridges_of_two_spaces_on_one_domain_make_no_loop() {
    is_heard_once_beside("3");
}

#[test]
fn every_quality_a_peer_offers_or_asks_for_is_met() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut ua = UaSide::join();
    let _bridge = cell.bridge_ros2(&[]);
    let mut id = 100;
    for peer in MAKERS {
        for reliability in ["reliable", "best_effort"] {
            for durability in ["volatile", "transient_local"] {
                let quality = ["--reliability", reliability, "--durability", durability];
                id += 1;
                let text = format!("{reliability} {durability}");
                let there = format!("/ua_1_2_{id}");
                let mut reader = peer(&cell, &[&["sub", &there, STRING], &quality[..]].concat());
                reaches(&mut ua, (1, 2, id), &text, &mut [&mut reader]);
                let back = format!("/ua_2_2_{id}");
                let _writer = peer(&cell, &[&sends(&back, &text)[..], &quality].concat());
                ua.hear_scalar((2, 2, id), Scalar::String(Some(&text)));
            }
        }
    }
}

#[test]
fn writers_of_different_qualities_on_one_topic_are_all_heard() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let ua = UaSide::join();
    let _bridge = cell.bridge_ros2(&[]);
    let reliable = ["--durability", "transient_local"];
    let _reliable = cell.cyclone_c(&[&sends(BACK.1, "cyclone")[..], &reliable].concat());
    ua.hear_scalar(BACK.0, Scalar::String(Some("cyclone")));
    let best_effort = ["--reliability", "best_effort"];
    let _best_effort = cell.fastdds(&[&sends(BACK.1, "fast")[..], &best_effort].concat());
    ua.hear_scalar(BACK.0, Scalar::String(Some("fast")));
    ua.hear_scalar(BACK.0, Scalar::String(Some("cyclone")));
}

#[test]
fn a_reader_that_asks_for_more_than_an_event_topic_offers_is_told_so_and_others_hear() {
    const EVENTS: &str = r#"
spaces: [{id: 1}, {id: 2}]
namespaces: {2: "urn:cell"}
variables:
  - {node: "ns=2;i=12", name: events, type: String, origin: 1, queue: {drop_oldest: 100}}
"#;
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut ua = UaSide::join();
    let mapping = cell.file("events.yaml", EVENTS);
    let _bridge = cell.bridge_ros2(&[mapping.to_str().unwrap()]);
    let topic = ["sub", "/ua_1_2_12", STRING];
    let old = ["--durability", "transient_local"];
    let mut asking = MAKERS.map(|peer| peer(&cell, &[&topic[..], &old].concat()));
    let mut readers = MAKERS.map(|peer| peer(&cell, &topic));
    let [fast, cyclone] = &mut readers;
    reaches(&mut ua, (1, 2, 12), "event", &mut [fast, cyclone]);
    for reader in &mut asking {
        // DURABILITY of DDS 1.4, 2.2.3.4, has the number 2.
        reader.wait_for_json("the policy is named", SOON, |line| {
            (line["incompatible"] == 2).then_some(())
        });
        assert_eq!(reader.values().len(), 0);
    }
    assert!(metrics(METRICS_ROS2).is_some());
}
