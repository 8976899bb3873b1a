//! bridge-ros2 on a host, its ROS 2 peers on another, and a wire with an MTU of 1500 between them
//! that loses and delays frames.

use std::time::{Duration, Instant};

use system_tests::{
    Cell, Child, HERE, Host, Numbered, Peer, TopicTriple, UaSide, WireEffect, eventually, numbered,
};
use uadp::{Scalar, Variant};

/// Peers start in seconds; on a lossy wire, a repair takes some heartbeats.
const SOON: Duration = Duration::from_secs(60);
const BOTH: &[Peer] = &[Peer::FastDds, Peer::CycloneC];
const PLANT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/cells/plant.yaml");
const STRING: &str = "std_msgs/String";
/// Events in both directions: every value counts.
const EVENTS: (TopicTriple, &str) = ((1, 2, 12), "/ua_1_2_12");
const EVENTS_BACK: (TopicTriple, &str) = ((2, 2, 22), "/ua_2_2_22");
/// A state: only the last value counts.
const STATE: (TopicTriple, &str) = ((1, 2, 10), "/ua_1_2_10");

const CLEAN: WireEffect = WireEffect {
    loss: 0.0,
    delay: Duration::ZERO,
};

const fn lossy(loss: f64) -> WireEffect {
    WireEffect {
        loss,
        delay: Duration::from_millis(20),
    }
}

/// Starts the peers of both vendors on the other host with these arguments, and waits until they
/// are ready.
fn peers(cell: &Cell, host: &Host, args: &[&str]) -> [Child; 2] {
    [
        host.fastdds_started(cell, args),
        host.cyclone_c_started(cell, args),
    ]
    .map(|peer| peer.start().ready(SOON))
}

fn bridge(cell: &Cell) -> Child {
    cell.bridge_ros2(&[PLANT, "--ros-interface", HERE])
}

/// Starts readers on the other host and waits until they have received a first value, so that later
/// values are not missed.
fn listeners(cell: &Cell, host: &Host, ua: &mut UaSide) -> [Child; 2] {
    let readers = peers(cell, host, &["sub", EVENTS.1, STRING, "--counts"]);
    eventually("both readers hear the bridge", SOON, || {
        ua.write(EVENTS.0, Scalar::String(Some("hello")));
        std::thread::sleep(Duration::from_millis(50));
        readers
            .iter()
            .all(|reader| {
                let mut lines = reader.json_lines().into_iter();
                lines.any(|line| line["received"].as_u64() > Some(0))
            })
            .then_some(())
    });
    readers
}

/// Writes the texts to the space, 200 a second.
fn write_paced(ua: &mut UaSide, texts: impl Iterator<Item = String>) {
    let start = Instant::now();
    for (turn, text) in (0..).zip(texts) {
        let due = start + Duration::from_millis(5) * turn;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        ua.write(EVENTS.0, Scalar::String(Some(&text)));
    }
}

fn await_all(readers: &mut [Child], count: u32) {
    for reader in readers {
        reader.wait_for_json(&format!("all {count}, whole"), SOON, |line| {
            (line["distinct"] == count && line["bad"] == 0 && line["repeated"] == 0).then_some(())
        });
    }
}

/// Receives numbered texts of the topic until all numbers of both ranges below `count` have
/// arrived.
fn hear_all(ua: &UaSide, firsts: [u32; 2], count: u32) {
    let mut heard = Numbered::default();
    let wanted = count as usize * firsts.len();
    let mut add = |fields: &[Variant<'_>]| {
        if let [Variant::Scalar(Scalar::String(Some(text)))] = fields {
            heard.add(text);
        }
        (heard.len() == wanted).then_some(())
    };
    let add = std::cell::RefCell::new(&mut add);
    ua.hear(EVENTS_BACK.0, &format!("{wanted} texts"), |fields| {
        (add.borrow_mut())(fields)
    });
    assert_eq!(heard.bad, 0);
}

fn nothing_is_lost_on(wire: WireEffect) {
    const COUNT: u32 = 400;
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let host = cell.host(wire);
    let mut ua = UaSide::join();
    let _bridge = bridge(&cell);
    let mut readers = listeners(&cell, &host, &mut ua);
    write_paced(&mut ua, (0..COUNT).map(|number| numbered(number, 200)));
    await_all(&mut readers, COUNT);
    drop(readers);

    let ua = UaSide::join();
    let firsts = [0, 1_000_000];
    let text = COUNT.to_string();
    let pace = ["--rate", "200", "--wait-readers", "1", "--depth", "1000"];
    let start = |first: &str, fast: bool| {
        let what = [
            "pub",
            EVENTS_BACK.1,
            STRING,
            "--size",
            "200",
            "--first",
            first,
        ];
        let args = [&what[..], &["--count", &text], &pace].concat();
        let peer = if fast {
            host.fastdds_started(&cell, &args)
        } else {
            host.cyclone_c_started(&cell, &args)
        };
        peer.start().ready(SOON)
    };
    let _writers = [start("0", true), start("1000000", false)];
    hear_all(&ua, firsts, COUNT);
}

#[test]
fn reliable_topics_lose_nothing_between_two_hosts() {
    nothing_is_lost_on(CLEAN);
}

#[test]
fn reliable_topics_lose_nothing_on_a_wire_that_loses_one_percent() {
    nothing_is_lost_on(lossy(0.01));
}

#[test]
fn reliable_topics_lose_nothing_on_a_wire_that_loses_five_percent() {
    nothing_is_lost_on(lossy(0.05));
}

/// One serialized text is a multiple of four bytes long, the other is not, and both are longer than
/// a datagram.
#[test]
fn texts_of_2002_and_2003_characters_arrive_both_ways() {
    const COUNT: u32 = 10;
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let host = cell.host(CLEAN);
    let mut ua = UaSide::join();
    let _bridge = bridge(&cell);
    let mut readers = listeners(&cell, &host, &mut ua);
    let texts = (0..COUNT).map(|number| numbered(number, 2002 + (number % 2) as usize));
    write_paced(&mut ua, texts);
    await_all(&mut readers, COUNT);
    drop(readers);

    for size in ["2002", "2003"] {
        let ua = UaSide::join();
        let what = [
            "pub",
            EVENTS_BACK.1,
            STRING,
            "--size",
            size,
            "--count",
            "10",
        ];
        let more = ["--wait-readers", "1", "--rate", "50"];
        let args = |first| [&what[..], &more, &["--first", first]].concat();
        let _writers = [
            host.fastdds_started(&cell, &args("0")),
            host.cyclone_c_started(&cell, &args("1000000")),
        ]
        .map(|writer| writer.start().ready(SOON));
        hear_all(&ua, [0, 1_000_000], COUNT);
    }
}

#[test]
fn the_last_state_reaches_best_effort_readers_on_a_wire_that_loses_a_fifth() {
    const KEY_FRAMES: Duration = Duration::from_secs(10);
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let host = cell.host(lossy(0.2));
    let mut ua = UaSide::join();
    let _bridge = bridge(&cell);
    let best_effort = ["--reliability", "best_effort"];
    let mut readers = peers(
        &cell,
        &host,
        &[&["sub", STATE.1, STRING], &best_effort[..]].concat(),
    );
    for turn in 0..12 {
        let text = format!("state {turn}");
        // A writer of the space repeats its value every second.
        let mut repeated = Instant::now();
        ua.write(STATE.0, Scalar::String(Some(&text)));
        let deadline = if turn == 0 { SOON } else { KEY_FRAMES };
        eventually(&format!("both have `{text}`"), deadline, || {
            if repeated.elapsed() > Duration::from_secs(1) {
                repeated = Instant::now();
                ua.write(STATE.0, Scalar::String(Some(&text)));
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
}

#[test]
fn the_last_state_of_best_effort_writers_reaches_the_space_on_a_wire_that_loses_a_fifth() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let host = cell.host(lossy(0.2));
    let ua = UaSide::join();
    let _bridge = bridge(&cell);
    for fast in [true, false] {
        let what = ["pub", "/ua_2_2_20", STRING, "--count", "0", "--rate", "10"];
        let text = if fast { "fast" } else { "cyclone" };
        let args = [&what[..], &["--reliability", "best_effort", "--text", text]].concat();
        let writer = if fast {
            host.fastdds_started(&cell, &args)
        } else {
            host.cyclone_c_started(&cell, &args)
        };
        let _writer = writer.start().ready(SOON);
        ua.hear_scalar((2, 2, 20), Scalar::String(Some(text)));
    }
}

/// The lease duration that Cyclone DDS announces in this test.
const LEASE: &str = "<LeaseDuration>2s</LeaseDuration>";

/// Returns whether the topic is repeated; a latched value is repeated every second.
fn is_repeated(ua: &UaSide, triple: TopicTriple) -> bool {
    ua.drain();
    ua.triples_for(Duration::from_millis(2500))
        .contains(&triple)
}

/// A robot writes its map once, and then the radio link is down for longer than the robot's lease.
#[test]
fn a_latched_value_is_back_after_the_wire_was_cut_for_longer_than_the_lease() {
    const MAP: (TopicTriple, &str) = ((2, 2, 20), "/ua_2_2_20");
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let host = cell.host(CLEAN);
    let ua = UaSide::join();
    let _bridge = bridge(&cell);
    let what = ["pub", MAP.1, STRING, "--text", "map", "--count", "1"];
    let kept = ["--durability", "transient_local", "--depth", "1"];
    let _robot = host
        .cyclone_c_with(&cell, LEASE, &[&what[..], &kept].concat())
        .start()
        .ready(SOON);
    ua.hear_scalar(MAP.0, Scalar::String(Some("map")));
    host.cut();
    eventually("the robot counts as gone", SOON, || {
        (!is_repeated(&ua, MAP.0)).then_some(())
    });
    host.mend();
    ua.hear_scalar(MAP.0, Scalar::String(Some("map")));
    eventually("the map is repeated again", SOON, || {
        is_repeated(&ua, MAP.0).then_some(())
    });
}
