//! Fifty topics at 1 kHz each through `bridge-ros2`, from UADP to DDS and back.

use std::collections::HashSet;
use std::fmt::Write as _;
use std::time::Duration;

use system_tests::{
    Cell, GROUP, METRICS_ROS2, TextStamp, UaSide, drops, eventually, group_member, metrics, now,
    overflowed, overflowed_outside_group, per_message, processor_time,
};
use uadp::{NetworkMessage, Scalar};

use crate::ends::{Meter, MeterReport, Pacer, START, SendingPace};

pub(crate) fn measure(cell: &Cell, seconds: u64) {
    println!(
        "\n{TOPICS} topics of {SIZE} B at 1 kHz each through bridge-ros2, {seconds} s; microseconds:\n"
    );
    println!(
        "| way | sent | received | dropped by the bridge | in the receiver's socket | in other sockets | p50 | p99 | CPU share of the bridge | CPU per message |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    to_dds(cell, seconds);
    to_uadp(cell, "DDS -> UADP", "", seconds);
    let shared = format!("pubsub: {{messages_per_datagram: {SHARED}}}\n");
    let way = format!("DDS -> UADP, {SHARED} messages a datagram at most");
    to_uadp(cell, &way, &shared, seconds);
}

fn to_dds(cell: &Cell, seconds: u64) {
    let mapping = cell.file("to-dds.yaml", &mapping(0));
    let bridge = cell.bridge_ros2(&[&mapping.to_string_lossy()]);
    let (topics, first) = (TOPICS.to_string(), FIRST.to_string());
    let mut meter = Meter::start(cell, "/ua_0_2_", &["--topics", &topics, "--first", &first]);
    let mut side = UaSide::join();
    let mut number = 0;
    let mut tick = |number: u64| {
        for topic in 0..TOPICS {
            let text = TextStamp::text(topic, number, SIZE);
            side.write((0, 2, id(topic)), Scalar::String(Some(&text)));
        }
    };
    let mut whole = 0;
    eventually("all topics cross", START, || {
        tick(number);
        number += 1;
        let heard = meter.report(TOPICS as u64).distinct;
        // Twice in succession, so that all endpoints have settled.
        whole = if heard == TOPICS as u64 { whole + 1 } else { 0 };
        (whole == 2).then_some(())
    });
    let dropped = Dropped::so_far(0);
    let before = processor_time(bridge.id());
    let start = now();
    let mut due = start;
    for _ in 0..seconds * 1000 {
        std::thread::sleep(due.saturating_sub(now()));
        tick(number);
        number += 1;
        due += Duration::from_millis(1);
    }
    let took = now() - start;
    let sent = seconds * 1000 * TOPICS as u64;
    let report = meter.report(sent);
    let used = processor_time(bridge.id()) - before;
    // The receiver's socket belongs to Cyclone DDS, which repairs its losses.
    let dropped = Dropped::so_far(0).since(&dropped);
    row(
        "UADP -> DDS",
        Ran {
            sent,
            report,
            dropped,
            used,
            took,
        },
    );
}

fn to_uadp(cell: &Cell, way: &str, pubsub: &str, seconds: u64) {
    let mapping = cell.file("to-uadp.yaml", &format!("{pubsub}{}", mapping(2)));
    let listener = group_member(GROUP);
    listener.set_read_timeout(Some(SILENCE)).unwrap();
    let bridge = cell.bridge_ros2(&[&mapping.to_string_lossy()]);
    let (topics, first) = (TOPICS.to_string(), FIRST.to_string());
    let more = ["--topics", &topics, "--first", &first, "--depth", "1000"];
    let mut pacer = Pacer::start(cell, "/ua_2_2_", &more);
    let mut heard = ReceivedTexts::default();
    let mut buffer = vec![0; 65_536];
    eventually("all topics cross", START, || {
        pacer.send(SendingPace::kilohertz(1, SIZE));
        let mut crossed = HashSet::new();
        let start = now();
        // Keep-alives never end.
        while now() - start < SETTLES
            && let Ok(length) = listener.recv(&mut buffer)
        {
            crossed.extend(heard.add(&buffer[..length]));
        }
        (crossed.len() == TOPICS).then_some(())
    });
    heard.report = MeterReport::default();
    let full = || overflowed(&listener).unwrap_or_default();
    let dropped = Dropped::so_far(full());
    let before = processor_time(bridge.id());
    let start = now();
    let sent = seconds * 1000 * TOPICS as u64;
    let took = std::thread::scope(|scope| {
        let sender = scope.spawn(|| {
            pacer.send(SendingPace::kilohertz(seconds, SIZE));
            now() - start
        });
        let mut last = now();
        while heard.report.distinct < sent && (!sender.is_finished() || now() - last < SILENCE) {
            if let Ok(length) = listener.recv(&mut buffer)
                && !heard.add(&buffer[..length]).is_empty()
            {
                last = now();
            }
        }
        sender.join().unwrap()
    });
    let used = processor_time(bridge.id()) - before;
    let dropped = Dropped::so_far(full()).since(&dropped);
    row(
        way,
        Ran {
            sent,
            report: heard.report,
            dropped,
            used,
            took,
        },
    );
}

/// The number of dropped samples and datagrams, by location.
struct Dropped {
    by_bridge: u64,
    in_receiver: u64,
    in_others: u64,
}

impl Dropped {
    fn so_far(in_receiver: u64) -> Self {
        let bridge = metrics(METRICS_ROS2).unwrap_or_default();
        Self {
            by_bridge: drops(&bridge),
            in_receiver,
            in_others: overflowed_outside_group().unwrap_or_default(),
        }
    }

    fn since(&self, before: &Self) -> Self {
        Self {
            by_bridge: self.by_bridge - before.by_bridge,
            in_receiver: self.in_receiver - before.in_receiver,
            in_others: self.in_others - before.in_others,
        }
    }
}

/// The results of a way.
struct Ran {
    sent: u64,
    report: MeterReport,
    dropped: Dropped,
    used: Duration,
    took: Duration,
}

fn row(way: &str, ran: Ran) {
    let Ran {
        sent,
        mut report,
        dropped,
        used,
        took,
    } = ran;
    println!(
        "| {way} | {sent} | {} | {} | {} | {} | {:.0} | {:.0} | {:.0} % of one core | {:.1} |",
        report.distinct,
        dropped.by_bridge,
        dropped.in_receiver,
        dropped.in_others,
        report.times.at(0.5),
        report.times.at(0.99),
        used.as_secs_f64() / took.as_secs_f64() * 100.0,
        per_message(used, sent)
    );
}

/// The stamped texts that a member of the group has received.
#[derive(Default)]
struct ReceivedTexts {
    seen: HashSet<(usize, u64)>,
    report: MeterReport,
}

impl ReceivedTexts {
    /// Adds a datagram. Returns the topics of its texts that were not received before.
    fn add(&mut self, datagram: &[u8]) -> Vec<usize> {
        let mut topics = Vec::new();
        let Ok(message) = NetworkMessage::decode(datagram) else {
            return topics;
        };
        let now = now();
        for message in message.messages().flatten() {
            // A message ends with its last field.
            let Some(stamp) = TextStamp::of(message.payload()) else {
                continue;
            };
            if !self.seen.insert((stamp.topic, stamp.number)) {
                self.report.repeated += 1;
                continue;
            }
            self.report.distinct += 1;
            self.report.times.add(now.saturating_sub(stamp.sent));
            topics.push(stamp.topic);
        }
        topics
    }
}

/// Returns a mapping of events, none of which may be replaced.
pub(crate) fn mapping(origin: u16) -> String {
    let mut text =
        "spaces:\n  - id: 1\n  - id: 2\nnamespaces:\n  2: urn:ua-bridge:bench\nvariables:\n"
            .to_owned();
    for topic in 0..TOPICS {
        let id = id(topic);
        write!(
            text,
            "  - node: ns=2;i={id}\n    name: v{topic}\n    type: String\n    origin: {origin}\n    queue: {{drop_oldest: 2000}}\n"
        )
        .unwrap();
    }
    text
}

fn id(topic: usize) -> u16 {
    u16::try_from(FIRST + topic).unwrap()
}

pub(crate) const TOPICS: usize = 50;
pub(crate) const FIRST: usize = 10;
const SIZE: usize = 64;
/// DataSetMessages of a shared datagram; some ten of these texts fit.
const SHARED: u8 = 32;
/// Time after which all samples of a second have arrived.
const SETTLES: Duration = Duration::from_secs(2);
/// Silence, without a new text, after which no more texts are expected.
const SILENCE: Duration = Duration::from_millis(500);
