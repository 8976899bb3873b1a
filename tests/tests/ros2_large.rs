//! Large samples between our endpoints and third-party endpoints, with the default socket buffers
//! of a system.

use std::io::Write as _;
use std::num::NonZeroU16;
use std::time::{Duration, Instant};

use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::graph::Graph;
use ros2_node::inbox::{Inbox, InboxTurn};
use ros2_node::limits;
use ros2_node::outlet::{Outlet, OutletRefusal};
use ros2_node::qos::{Offered, Requested};
use ros2_node::raw::Payload;
use system_tests::{
    ArrayShape, BareNode, Cell, Child, HERE, Host, METRICS_ROS1, METRICS_ROS2, Peer, THERE, UaSide,
    WIRE, WireEffect, eventually, metrics, numbered, resident,
};
use uadp::Scalar;

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::FastDds, Peer::CycloneC];
const TEXT: &str = "std_msgs/String";
const STRING: &str = "std_msgs::msg::dds_::String_";
const TOPIC: (&str, &str) = ("/ua_1_1_1", "rt/ua_1_1_1");
const MEGA: usize = 1_000_000;
const EVENTS: Offered = Offered::DropOldest(NonZeroU16::new(100).unwrap());

/// Returns whether RustDDS is patched; otherwise the test is left out.
fn patched() -> bool {
    if !limits::PATCHED {
        test_data::leave_out("RustDDS is as published; `cargo xtask test` builds with the patches");
    }
    limits::PATCHED
}

fn now() -> tokio::time::Instant {
    tokio::time::Instant::now()
}

fn join(network: &str) -> Domain {
    Domain::join(&options(network)).unwrap()
}

fn options(network: &str) -> DomainOptions {
    DomainOptions {
        domain: 2,
        enclave: None,
        networks: vec![network.parse().unwrap()],
        peers: Vec::new(),
        node: "large".into(),
    }
}

/// Creates a writer of the topic and waits until it has matched `readers` readers.
fn outlet(domain: &Domain, offered: Offered, readers: usize) -> Outlet {
    let mut outlet = Outlet::new(
        domain.writer(TOPIC.1, STRING, offered).unwrap(),
        offered,
        domain.joined(),
    );
    eventually("the readers are discovered", SOON, || {
        let graph = Graph::snapshot(domain.participant());
        let known = graph.readers(TOPIC.1);
        outlet.set_readers(known, now()).unwrap();
        (known.len() == readers).then_some(())
    });
    outlet
}

fn payload(text: &str) -> Payload {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend_from_slice(&u32::try_from(text.len() + 1).unwrap().to_le_bytes());
    bytes.extend_from_slice(text.as_bytes());
    bytes.push(0);
    Payload::to_write(bytes.into()).unwrap()
}

/// Writes a text of each size, `rate` a second.
async fn write(outlet: &mut Outlet, sizes: impl IntoIterator<Item = usize>, rate: u32) {
    let begin = Instant::now();
    for (number, size) in (0_u32..).zip(sizes) {
        let due = begin + Duration::from_secs(1) * number / rate;
        while Instant::now() < due || outlet.is_waiting() {
            assert!(begin.elapsed() < SOON * 4, "still waiting");
            tokio::time::sleep(Duration::from_millis(1)).await;
            outlet.flush(now()).unwrap();
        }
        outlet
            .offer(payload(&numbered(number, size)), None, now())
            .unwrap();
    }
    let deadline = now() + SOON;
    while outlet.is_waiting() {
        assert!(now() < deadline, "still waiting");
        tokio::time::sleep(Duration::from_millis(1)).await;
        outlet.flush(now()).unwrap();
    }
}

fn have_all(reader: &mut Child, count: usize) {
    reader.wait_for_json(&format!("all {count}, whole"), SOON, |line| {
        (line["distinct"] == count && line["bad"] == 0 && line["repeated"] == 0).then_some(())
    });
}

fn inbox(domain: &Domain, topic: &str) -> Inbox<()> {
    let requested = Requested::from_writers(&[]);
    let mut inbox = Inbox::new();
    inbox.insert((), domain.reader(topic, STRING, requested).unwrap());
    inbox
}

/// Returns the text of the next sample.
async fn text(inbox: &mut Inbox<()>) -> String {
    match tokio::time::timeout(SOON, inbox.recv()).await.unwrap() {
        InboxTurn::Sample {
            payload, missing, ..
        } => {
            assert_eq!(missing, 0);
            let bytes = payload.into_bytes();
            let length = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize - 1;
            String::from_utf8(bytes[8..8 + length].to_vec()).unwrap()
        }
        InboxTurn::Unreadable { why, .. } => panic!("{why}"),
    }
}

/// Checks that the texts are equal, and prints only a part of them if they differ.
fn is_whole(got: &str, sent: &str) {
    let differs = got.bytes().zip(sent.bytes()).position(|(a, b)| a != b);
    let head = |text: &str| text.get(..30).unwrap_or(text).to_owned();
    assert_eq!(
        (differs, head(got), got.len()),
        (None, head(sent), sent.len())
    );
}

async fn all_thirty_arrive(size: usize) {
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let reads = ["sub", TOPIC.0, TEXT, "--counts"];
    let mut readers = [cell.fastdds(&reads), cell.cyclone_c(&reads)];
    let domain = join("127.0.0.1");
    let mut outlet = outlet(&domain, EVENTS, readers.len());
    write(&mut outlet, [size; 30], 5).await;
    for reader in &mut readers {
        have_all(reader, 30);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn all_thirty_samples_of_1_mb_reach_fast_dds_and_cyclone() {
    all_thirty_arrive(MEGA).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn all_thirty_samples_of_2_mb_reach_fast_dds_and_cyclone() {
    all_thirty_arrive(2 * MEGA).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn all_thirty_samples_of_5_mb_reach_fast_dds_and_cyclone() {
    all_thirty_arrive(5 * MEGA).await;
}

/// The reader needs more time for the data in transit than it may be silent.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_reader_that_is_slow_for_large_states_is_not_given_up_as_a_silent_one() {
    const COUNT: u32 = 7;
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let mut reader = cell.fastdds(&["sub", TOPIC.0, TEXT, "--counts"]);
    let domain = join("127.0.0.1");
    let mut outlet = outlet(&domain, Offered::KeepLatest, 1);
    // One sample more than fits into the memory limit.
    for number in 0..COUNT {
        let large = payload(&numbered(number, 10 * MEGA));
        outlet.offer(large, None, now()).unwrap();
    }
    let deadline = now() + SOON;
    while outlet.is_waiting() {
        assert!(now() < deadline, "still waiting");
        assert!(!outlet.is_stuck(now()), "to be advertised anew");
        tokio::time::sleep(Duration::from_millis(1)).await;
        outlet.flush(now()).unwrap();
    }
    have_all(&mut reader, COUNT as usize);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn the_first_sample_arrives_even_when_it_is_large() {
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    for _ in 0..5 {
        let reads = ["sub", TOPIC.0, TEXT, "--counts"];
        let mut readers = [cell.fastdds(&reads), cell.cyclone_c(&reads)];
        let domain = join("127.0.0.1");
        let mut outlet = outlet(&domain, EVENTS, readers.len());
        write(&mut outlet, [3 * MEGA], 1).await;
        for reader in &mut readers {
            have_all(reader, 1);
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn ten_megabytes_cross_between_two_of_ours() {
    if !patched() {
        return;
    }
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let domains = [join("127.0.0.1"), join("127.0.0.1")];
    for (writer, reader) in [(0, 1), (1, 0)] {
        let mut inbox = inbox(&domains[reader], TOPIC.1);
        let mut outlet = outlet(&domains[writer], EVENTS, 1);
        for number in 0..5 {
            let sent = numbered(number, 10 * MEGA);
            outlet.offer(payload(&sent), None, now()).unwrap();
            let deadline = now() + SOON;
            while outlet.is_waiting() {
                assert!(now() < deadline, "still waiting");
                tokio::time::sleep(Duration::from_millis(1)).await;
                outlet.flush(now()).unwrap();
            }
            is_whole(&text(&mut inbox).await, &sent);
        }
        drop(inbox);
        eventually("the reader is gone", SOON, || {
            let graph = Graph::snapshot(domains[writer].participant());
            graph.readers(TOPIC.1).is_empty().then_some(())
        });
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn ten_megabytes_of_cyclone_and_fast_dds_are_read() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let size = (10 * MEGA).to_string();
    let writes = [
        "pub", TOPIC.0, TEXT, "--size", &size, "--count", "5", "--rate", "2",
    ];
    let args = [&writes[..], &["--wait-readers", "1"]].concat();
    for writer in [Cell::cyclone_c, Cell::fastdds] {
        // A separate participant per writer, because RustDDS passes retained samples of a topic to
        // a new reader.
        let domain = join("127.0.0.1");
        let mut inbox = inbox(&domain, TOPIC.1);
        let _writer = writer(&cell, &args);
        for number in 0..5 {
            is_whole(&text(&mut inbox).await, &numbered(number, 10 * MEGA));
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn texts_of_every_length_cross_an_ethernet() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let host = cell.host(WireEffect::default());
    let reads = ["sub", TOPIC.0, TEXT, "--counts"];
    let mut readers = [
        host.fastdds_started(&cell, &reads),
        host.cyclone_c_started(&cell, &reads),
    ]
    .map(|peer| peer.start().ready(SOON));
    let domain = join(HERE);
    let mut outlet = outlet(&domain, EVENTS, readers.len());
    // Sizes around the start of fragmentation, and sizes of which Cyclone DDS may lose three in
    // four samples.
    let sizes: Vec<usize> = (1280..1400).chain(1995..2010).chain(2555..2570).collect();
    let count = sizes.len();
    write(&mut outlet, sizes, 200).await;
    for reader in &mut readers {
        have_all(reader, count);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn large_samples_survive_a_wire_that_loses() {
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let host = cell.host(WireEffect {
        loss: 0.05,
        delay: Duration::from_millis(20),
    });
    let reads = ["sub", TOPIC.0, TEXT, "--counts"];
    let mut readers = [
        host.fastdds_started(&cell, &reads),
        host.cyclone_c_started(&cell, &reads),
    ]
    .map(|peer| peer.start().ready(SOON));
    let domain = join(HERE);
    let mut outlet = outlet(&domain, EVENTS, readers.len());
    write(&mut outlet, [MEGA; 10], 2).await;
    for reader in &mut readers {
        have_all(reader, 10);
    }
}

/// Sometimes the last fragments of a sample and the HEARTBEAT after them are lost together, and
/// nothing follows.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn large_samples_of_others_survive_a_wire_that_loses() {
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    // Fast DDS sends 64 kB in a datagram: with a packet loss of 5 %, nine in ten datagrams would be
    // lost.
    let host = cell.host(WireEffect {
        loss: 0.01,
        delay: Duration::from_millis(20),
    });
    // Otherwise Linux keeps the fragments of each datagram for 30 s, and soon has no room for new
    // fragments (docs/ros2.md).
    std::fs::write("/proc/sys/net/ipv4/ipfrag_time", "3").unwrap();
    let domain = join(HERE);
    for fast in [true, false] {
        let mut inbox = inbox(&domain, TOPIC.1);
        let size = MEGA.to_string();
        let writes = ["pub", TOPIC.0, TEXT, "--size", &size, "--count", "5"];
        let args = [&writes[..], &["--rate", "1", "--wait-readers", "1"]].concat();
        let peer = if fast {
            host.fastdds_started(&cell, &args)
        } else {
            host.cyclone_c_started(&cell, &args)
        };
        let _writer = peer.start().ready(SOON);
        for number in 0..5 {
            is_whole(&text(&mut inbox).await, &numbered(number, MEGA));
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_history_of_large_samples_takes_little_memory() {
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let mut reader = cell.cyclone_c(&["sub", TOPIC.0, TEXT, "--counts"]);
    let domain = join("127.0.0.1");
    let mut outlet = outlet(&domain, EVENTS, 1);
    let own = std::process::id();
    let before = resident(own);
    write(&mut outlet, [100_000; 1000], 200).await;
    have_all(&mut reader, 1000);
    let grown = resident(own).saturating_sub(before);
    assert!(grown < 15 << 20, "{grown} bytes more");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn large_samples_that_were_read_take_no_memory_any_more() {
    const COUNT: u32 = 100;
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let domain = join("127.0.0.1");
    let mut inbox = inbox(&domain, TOPIC.1);
    let (size, count) = (MEGA.to_string(), COUNT.to_string());
    let writes = ["pub", TOPIC.0, TEXT, "--size", &size, "--count", &count];
    let paced = ["--rate", "20", "--wait-readers", "1"];
    let own = std::process::id();
    let before = resident(own);
    let _writer = cell.cyclone_c(&[&writes[..], &paced].concat());
    for number in 0..COUNT {
        is_whole(&text(&mut inbox).await, &numbered(number, MEGA));
    }
    let grown = resident(own).saturating_sub(before);
    assert!(grown < 30 << 20, "{grown} bytes more after {COUNT} MB");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_sample_beyond_the_limit_is_refused_by_name() {
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let mut reader = cell.fastdds(&["sub", TOPIC.0, TEXT, "--counts"]);
    let domain = join("127.0.0.1");
    let mut outlet = outlet(&domain, EVENTS, 1);
    let limit = limits::sample_size(Graph::snapshot(domain.participant()).readers(TOPIC.1));
    let refused = outlet.offer(payload(&numbered(7, limit)), None, now());
    assert_eq!(refused, Err(OutletRefusal::TooLarge(limit)));
    write(&mut outlet, [limit - 64], 1).await;
    have_all(&mut reader, 1);
}

/// Returns Cyclone DDS on the other host, without multicast in both directions.
fn without_multicast(cell: &Cell, host: &Host, args: &[&str]) -> Child {
    let uri = format!(
        "<CycloneDDS><Domain id=\"any\"><General><AllowMulticast>false</AllowMulticast>\
         <Interfaces><NetworkInterface name=\"{WIRE}\"/></Interfaces></General>\
         <Discovery><ParticipantIndex>auto</ParticipantIndex></Discovery></Domain></CycloneDDS>"
    );
    host.cyclone_c_started(cell, args)
        .env("CYCLONEDDS_URI", uri)
        .start()
        .ready(SOON)
}

#[test]
fn a_listed_peer_is_found_without_multicast() {
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let host = cell.host(WireEffect::default());
    let reader = without_multicast(&cell, &host, &["sub", "/ua_1_1_1", TEXT]);
    let mut ua = UaSide::join();
    let _bridge = cell.bridge_ros2(&["--ros-interface", HERE, "--ros-peer", THERE]);
    eventually("the value arrives", SOON, || {
        ua.write((1, 1, 1), Scalar::String(Some("hello")));
        std::thread::sleep(Duration::from_millis(100));
        reader
            .values()
            .iter()
            .any(|value| value["data"] == "hello")
            .then_some(())
    });
}

/// 25 MB/s, which each part of the path carries also on a busy machine.
#[test]
fn images_from_ros_1_reach_a_reliable_reader_of_ros_2_whole_and_in_order() {
    const IMAGES: u64 = 20;
    const SIZE: usize = 5_000_000;
    if !patched() {
        return;
    }
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::FastDds]) else {
        return;
    };
    let _core = cell.roscore();
    let mapping = cell.file("camera.yaml", CAMERA);
    let mapping = [mapping.to_str().unwrap()];
    let _bridges = [cell.bridge_ros1(&mapping), cell.bridge_ros2(&mapping)];
    let shape = ArrayShape::IMAGE;
    let arguments = shape.arguments();
    let mut reads = vec!["meter", "/camera_there", "--depth", "10"];
    reads.extend(arguments.iter().map(String::as_str));
    let mut reader = cell.fastdds(&reads);
    let node = BareNode::start("/camera");
    let mut streams = node.publish_as(shape.message_type, &["/camera".to_owned()]);
    let camera = streams.first_mut().unwrap();
    // Small images, until the path is established.
    let mut number = 0;
    let mut small = shape.frame(100);
    eventually("a small image arrives", SOON, || {
        shape.stamp(&mut small, number);
        number += 1;
        camera.write_all(&small).unwrap();
        let heard = reader.ask("1 200", SOON);
        (heard["distinct"] != 0).then_some(())
    });
    reader.ask(&format!("{number} 1000"), SOON);
    let mut image = shape.frame(SIZE);
    let start = Instant::now();
    for sent in 0..u32::try_from(IMAGES).unwrap() {
        let due = start + Duration::from_millis(200) * sent;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        shape.stamp(&mut image, number);
        number += 1;
        camera.write_all(&image).unwrap();
    }
    let heard = reader.ask(&format!("{IMAGES} 10000"), SOON * 2);
    let statuses = [METRICS_ROS1, METRICS_ROS2].map(metrics);
    // Parts that a busy machine loses between the bridges are not sent again.
    let distinct = heard["distinct"].as_u64().unwrap();
    assert!(distinct >= IMAGES - IMAGES / 10, "{heard}: {statuses:?}");
    assert_eq!(heard["disordered"], 0, "{heard}");
}

const CAMERA: &str = r#"
spaces: [{id: 1}, {id: 2}]
namespaces: {5: "urn:cell"}
variables:
  - node: ns=5;i=10
    name: Camera
    origin: 1
    queue: {drop_oldest: 20}
    ros:
      - {topic: /camera, type: sensor_msgs/Image}
      - {space: 2, topic: /camera_there, type: sensor_msgs/Image}
"#;
