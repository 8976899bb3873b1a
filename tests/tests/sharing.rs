//! Samples of many topics in shared datagrams, as read by third-party software and as received
//! through the other bridge.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Write as _;
use std::time::Duration;

use serde_json::Value;
use system_tests::{
    CaptureFile, Cell, Child, METRICS_ROS2, Peer, TextStamp, UadpSocket, eventually, metrics,
    number as number_of,
};
use uadp::{DataSetMessage, NetworkMessage};

const SOON: Duration = Duration::from_secs(30);
const FIRST: u64 = 10;
const TOPICS: u64 = 20;
/// Number of samples per topic. All of them fit into a system's default receive buffer if a
/// listener is late.
const TICKS: u64 = 12;
/// Number of samples per topic that are sent as fast as possible.
const BURST: u64 = 20;
/// A queue in which no sample replaces another.
const EVENTS: &str = "{drop_oldest: 1000}";

/// Writes a mapping of texts of ROS 2 with that rule for their queues.
fn mapping(cell: &Cell, queue: &str) -> String {
    let mut text = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: urn:plant:line}\n\
                    pubsub: {messages_per_datagram: 32}\nvariables:\n"
        .to_owned();
    for id in FIRST..FIRST + TOPICS {
        writeln!(
            text,
            "  - {{node: ns=2;i={id}, name: v{id}, type: String, origin: 2, queue: {queue}}}"
        )
        .unwrap();
    }
    let path = cell.file("sharing.yaml", &text);
    path.to_string_lossy().into_owned()
}

/// Sends stamped texts on all topics at once, every 10 ms. Returns the first number.
fn send(pacer: &mut Child, ticks: u64) -> u64 {
    send_every(pacer, ticks, Duration::from_millis(10))
}

fn send_every(pacer: &mut Child, ticks: u64, period: Duration) -> u64 {
    let answer = pacer.ask(&format!("{ticks} 40 {} 0 0", period.as_nanos()), SOON);
    assert_eq!(answer["refused"], 0);
    answer["first"].as_u64().unwrap()
}

fn pacer(cell: &Cell) -> Child {
    let (topics, first) = (TOPICS.to_string(), FIRST.to_string());
    cell.cyclone_c(&[
        "pace", "/ua_2_2_", "--topics", &topics, "--first", &first, "--depth", "1000",
    ])
    .ready(SOON)
}

fn number(text: &str) -> Option<u64> {
    TextStamp::of(text.as_bytes()).map(|stamp| stamp.number)
}

/// Returns the samples that asyncua received so far: writer, and numbers in their order.
fn heard(listener: &Child) -> BTreeMap<u64, Vec<u64>> {
    let mut heard: BTreeMap<u64, Vec<u64>> = BTreeMap::new();
    for line in listener.json_lines() {
        if line["kind"] == "key_frame"
            && let (Some(writer), Some(number)) = (
                line["writer"].as_u64(),
                line["fields"][0]["value"].as_str().and_then(number),
            )
        {
            heard.entry(writer).or_default().push(number);
        }
    }
    heard
}

#[test]
fn what_shares_datagrams_is_read_by_asyncua_and_shown_by_wireshark() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::CycloneC, Peer::Tshark]) else {
        return;
    };
    let mapping = mapping(&cell, EVENTS);
    let _bridge = cell.bridge_ros2(&[&mapping]);
    let listener = cell.uadp_listener();
    let group = UadpSocket::join();
    let mut pacer = pacer(&cell);
    let all = usize::try_from(TOPICS).unwrap();
    eventually("all topics cross", SOON, || {
        send(&mut pacer, 1);
        (heard(&listener).len() == all).then_some(())
    });

    group.drain();
    let first = send(&mut pacer, TICKS);
    let numbers: Vec<u64> = (first..first + TICKS).collect();
    let expected: BTreeMap<u64, Vec<u64>> = (FIRST..FIRST + TOPICS)
        .map(|writer| (writer, numbers.clone()))
        .collect();
    let since_first = || {
        let mut heard = heard(&listener);
        for numbers in heard.values_mut() {
            numbers.retain(|number| *number >= first);
        }
        heard
    };
    eventually("asyncua hears each sample", SOON, || {
        let count: usize = since_first().values().map(Vec::len).sum();
        (count >= numbers.len() * all).then_some(())
    });
    assert_eq!(since_first(), expected);

    let datagrams = waiting(&group);
    let mut shared = datagrams.iter().filter(|datagram| ids(datagram).len() > 1);
    let one = shared.next().expect("no datagram was shared");
    let shown = cell.dissect(&CaptureFile::of([&one[..]]), &[]).remove(0);
    assert!(!shown.has("uadp.malformed"), "{:?}", shown.expert_infos());
    let topics: Vec<String> = ids(one).iter().map(|id| format!("ua_2_2_{id}")).collect();
    assert_eq!(shown.all("uadp.topic"), topics);
    assert_eq!(shown.all("uadp.field.string").len(), topics.len());
    assert!(datagrams.iter().all(|datagram| datagram.len() <= 1472));
}

#[test]
fn a_state_that_waits_to_share_a_datagram_gives_way_to_no_newer_one() {
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let _bridge = cell.bridge_ros2(&[&mapping(&cell, "keep_latest")]);
    let group = UadpSocket::join();
    let mut pacer = pacer(&cell);
    let mut crossed: HashSet<(u16, u64)> = HashSet::new();
    let all = usize::try_from(TOPICS).unwrap();
    eventually("all topics cross", SOON, || {
        send(&mut pacer, 1);
        crossed.extend(waiting(&group).iter().flat_map(|one| texts(one)));
        let topics: HashSet<u16> = crossed.iter().map(|one| one.0).collect();
        (topics.len() == all).then_some(())
    });
    // As fast as possible, so that several samples of a topic arrive before the bridge polls.
    let first = send_every(&mut pacer, BURST, Duration::ZERO);
    eventually("the last sample of each", SOON, || {
        crossed.extend(waiting(&group).iter().flat_map(|one| texts(one)));
        let last = crossed.iter().filter(|one| one.1 == first + BURST - 1);
        (last.count() == all).then_some(())
    });
    let since_first = crossed.iter().filter(|one| one.1 >= first).count();
    let status = metrics(METRICS_ROS2).unwrap();
    let sent = usize::try_from(BURST).unwrap() * all;
    assert_eq!((since_first, number_of(&status, "overflow")), (sent, 0));
}

/// Returns the DataSetWriterId and the number of each text.
fn texts(datagram: &[u8]) -> Vec<(u16, u64)> {
    let message = NetworkMessage::decode(datagram).unwrap();
    let messages = message.messages().flatten();
    // A message ends with its last field.
    let stamped = |message: DataSetMessage<'_>| {
        Some((message.writer_id?, TextStamp::of(message.payload())?.number))
    };
    messages.filter_map(stamped).collect()
}

/// Returns the waiting datagrams.
fn waiting(group: &UadpSocket) -> Vec<Vec<u8>> {
    std::iter::from_fn(|| group.receive(Duration::from_millis(1))).collect()
}

/// Returns the DataSetWriterIds of the messages; an announcement has none.
fn ids(datagram: &[u8]) -> Vec<u16> {
    let message = NetworkMessage::decode(datagram).unwrap();
    let messages = message.messages().flatten();
    messages.filter_map(|message| message.writer_id).collect()
}

#[test]
fn what_shares_datagrams_comes_out_of_the_other_bridge_in_order() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::CycloneC]) else {
        return;
    };
    let _master = cell.roscore();
    let mapping = mapping(&cell, EVENTS);
    let _bridges = (cell.bridge_ros1(&[&mapping]), cell.bridge_ros2(&[&mapping]));
    let topics = [FIRST, FIRST + TOPICS / 2, FIRST + TOPICS - 1];
    let subscribers = topics.map(|id| {
        let (topic, node) = (format!("/ua_2_2_{id}"), format!("hears_{id}"));
        cell.rospy("ros1_sub.py", &[&topic, "std_msgs/String", "--node", &node])
    });
    let mut pacer = pacer(&cell);
    let numbers = |subscriber: &Child| -> Vec<u64> {
        let values = subscriber.values();
        let text = |value: &Value| number(value["data"].as_str()?);
        values.iter().filter_map(text).collect()
    };
    eventually("all subscribers hear something", SOON, || {
        send(&mut pacer, 1);
        let silent = subscribers.iter().find(|one| numbers(one).is_empty());
        silent.is_none().then_some(())
    });
    let group = UadpSocket::join();
    let first = send(&mut pacer, TICKS);
    for subscriber in &subscribers {
        let since_first = || {
            let mut numbers = numbers(subscriber);
            numbers.retain(|number| *number >= first);
            numbers
        };
        eventually("the last sample", SOON, || {
            since_first().contains(&(first + TICKS - 1)).then_some(())
        });
        let expected: Vec<u64> = (first..first + TICKS).collect();
        assert_eq!(since_first(), expected);
    }
    let datagrams = waiting(&group);
    let shared: HashSet<usize> = datagrams.iter().map(|one| ids(one).len()).collect();
    assert!(shared.iter().any(|count| *count > 1), "{shared:?}");
}
