//! Fifty topics at 1 kHz each through `bridge-ros1` into UADP.

use std::collections::HashSet;
use std::fmt::Write as _;
use std::io::Write as _;
use std::net::{TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use system_tests::{
    BareNode, Cell, GROUP, eventually, group_member, overflowed, per_message, processor_time,
    string_frame,
};
use uadp::NetworkMessage;

pub(crate) fn measure(cell: &Cell, seconds: u64) {
    println!(
        "\n{TOPICS} topics of {SIZE} B at 1 kHz each through bridge-ros1 into UADP, {seconds} s:\n"
    );
    println!(
        "| messages a datagram at most | sent | received | lost | of these in the receiver's socket | CPU share | CPU per message |"
    );
    println!("|---|---|---|---|---|---|---|");
    for shared in [1, 32] {
        row(cell, shared, seconds);
    }
}

fn row(cell: &Cell, shared: u8, seconds: u64) {
    let mapping = cell.file("fifty.yaml", &mapping(shared));
    let listener = group_member(GROUP);
    listener.set_read_timeout(Some(SILENCE)).unwrap();
    let bridge = cell.bridge_ros1(&[&mapping.to_string_lossy()]);
    let node = BareNode::start("/fifty");
    let names: Vec<String> = (0..TOPICS)
        .map(|topic| format!("/ua_1_2_{}", FIRST + topic))
        .collect();
    let mut topics = node.publish(&names);
    carries_all(&mut topics, &listener);

    let ticks = seconds * 1000;
    let before = processor_time(bridge.id());
    let done = AtomicBool::new(false);
    let (received, took) = std::thread::scope(|scope| {
        let receiver = scope.spawn(|| receive(&listener, &done));
        let start = Instant::now();
        send(&mut topics, ticks);
        let took = start.elapsed();
        done.store(true, Ordering::Release);
        (receiver.join().unwrap(), took)
    });
    let used = processor_time(bridge.id()) - before;
    let sent = ticks * TOPICS as u64;
    println!(
        "| {shared} | {sent} | {received} | {} | {} | {:.0} % of one core | {:.1} us |",
        sent - received,
        shown(overflowed(&listener)),
        used.as_secs_f64() / took.as_secs_f64() * 100.0,
        per_message(used, sent)
    );
}

fn shown(count: Option<u64>) -> String {
    count.map_or_else(|| "unknown".to_owned(), |count| count.to_string())
}

/// Returns a mapping of events, none of which may be replaced.
fn mapping(shared: u8) -> String {
    let mut text = format!(
        "spaces:\n  - id: 1\nnamespaces:\n  2: urn:ua-bridge:bench\n\
         pubsub: {{messages_per_datagram: {shared}}}\nvariables:\n"
    );
    for topic in 0..TOPICS {
        write!(
            text,
            "  - node: ns=2;i={}\n    name: v{topic}\n    type: String\n    origin: 1\n    queue: {{drop_oldest: 2000}}\n",
            FIRST + topic
        )
        .unwrap();
    }
    text
}

/// Waits until every topic crosses.
fn carries_all(topics: &mut [TcpStream], listener: &UdpSocket) {
    let mut crossed = HashSet::new();
    let mut buffer = [0; 2048];
    eventually("all topics cross", START, || {
        for (topic, stream) in topics.iter_mut().enumerate() {
            if !crossed.contains(&topic) {
                stream.write_all(&message(topic, HELLO)).unwrap();
            }
        }
        while let Ok(length) = listener.recv(&mut buffer) {
            crossed.extend(
                parsed(&buffer[..length])
                    .into_iter()
                    .map(|(topic, _)| topic),
            );
        }
        (crossed.len() == TOPICS).then_some(())
    });
}

/// Sends every topic once in each millisecond, at absolute times.
fn send(topics: &mut [TcpStream], ticks: u64) {
    let mut due = Instant::now();
    for tick in 0..ticks {
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        for (topic, stream) in topics.iter_mut().enumerate() {
            stream.write_all(&message(topic, tick)).unwrap();
        }
        due += Duration::from_millis(1);
    }
}

/// Counts the distinct numbers that arrive, over all topics.
fn receive(listener: &UdpSocket, done: &AtomicBool) -> u64 {
    let mut seen: Vec<Vec<bool>> = vec![Vec::new(); TOPICS];
    let mut count = 0;
    let mut buffer = [0; 2048];
    loop {
        let Ok(length) = listener.recv(&mut buffer) else {
            if done.load(Ordering::Acquire) {
                return count;
            }
            continue;
        };
        for (topic, number) in parsed(&buffer[..length]) {
            let Some(seen) = seen.get_mut(topic).filter(|_| number != HELLO) else {
                continue;
            };
            let place = usize::try_from(number).unwrap();
            if seen.len() <= place {
                seen.resize(place + 1, false);
            }
            if !std::mem::replace(&mut seen[place], true) {
                count += 1;
            }
        }
    }
}

/// Returns a text that ends with its topic and number, nine digits each.
fn message(topic: usize, number: u64) -> Vec<u8> {
    string_frame(&format!("{:PADDING$}{topic:09}{number:09}", ""))
}

/// Returns topic and number of each text of a datagram.
fn parsed(datagram: &[u8]) -> Vec<(usize, u64)> {
    let message = NetworkMessage::decode(datagram).unwrap();
    // An announcement has no messages. A message ends with its last field.
    let messages = message.messages().flatten();
    messages
        .filter_map(|message| {
            let (rest, number) = message.payload().split_last_chunk::<9>()?;
            let (_, topic) = rest.split_last_chunk::<9>()?;
            let topic = std::str::from_utf8(topic).ok()?.parse().ok()?;
            let number = std::str::from_utf8(number).ok()?.parse().ok()?;
            Some((topic, number))
        })
        .collect()
}

const TOPICS: usize = 50;
const FIRST: usize = 10;
const SIZE: usize = 64;
const PADDING: usize = SIZE - 18;
/// The number of texts that are sent until the whole path is established.
const HELLO: u64 = 999_999_999;
const START: Duration = Duration::from_secs(30);
/// Silence after which no more datagrams are expected.
const SILENCE: Duration = Duration::from_millis(500);
