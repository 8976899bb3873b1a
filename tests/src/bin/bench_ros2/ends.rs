//! The ends of the paths: Cyclone DDS in C, controlled by lines, and ROS 1 with a blocking socket.

use std::collections::HashSet;
use std::io::Write as _;
use std::net::TcpStream;
use std::time::Duration;

use serde_json::Value;
use system_tests::{
    BareNode, BareSubscription, Cell, Child, TextStamp, Times, eventually, now, string_frame,
};

/// A sender of stamped texts on topics of DDS.
pub(crate) struct Pacer(Child);

/// The times of sending: ticks of `period`, with a pause after each `burst` of ticks.
#[derive(Clone, Copy)]
pub(crate) struct SendingPace {
    pub(crate) ticks: u64,
    pub(crate) size: usize,
    pub(crate) period: Duration,
    pub(crate) burst: u64,
    pub(crate) pause: Duration,
}

impl SendingPace {
    /// Returns a pace of 1 kHz without a pause.
    pub(crate) const fn kilohertz(seconds: u64, size: usize) -> Self {
        Self {
            ticks: seconds * 1000,
            size,
            period: Duration::from_millis(1),
            burst: 0,
            pause: Duration::ZERO,
        }
    }

    fn took_at_most(self) -> Duration {
        let ticks = u32::try_from(self.ticks).unwrap();
        let pauses = ticks / u32::try_from(self.burst.max(1)).unwrap();
        (self.period * ticks + self.pause * pauses) * 3 + PATIENCE
    }
}

impl Pacer {
    pub(crate) const fn of(peer: Child) -> Self {
        Self(peer)
    }

    pub(crate) fn start(cell: &Cell, topic: &str, more: &[&str]) -> Self {
        let args = ["pace", topic, "--limit", LIMIT];
        Self(cell.cyclone_c(&[&args, more].concat()))
    }

    /// Sends at a pace, and returns the number of refused samples.
    pub(crate) fn send(&mut self, pace: SendingPace) -> u64 {
        let (period, pause) = (pace.period.as_nanos(), pace.pause.as_nanos());
        let line = format!(
            "{} {} {period} {} {pause}",
            pace.ticks, pace.size, pace.burst
        );
        let answer = self.0.ask(&line, pace.took_at_most());
        count(&answer, "refused")
    }
}

/// A receiver of stamped texts on topics of DDS.
pub(crate) struct Meter(Child);

/// The results of a [`Meter`] or a [`Listener`].
#[derive(Debug, Default)]
pub(crate) struct MeterReport {
    pub(crate) distinct: u64,
    pub(crate) repeated: u64,
    pub(crate) disordered: u64,
    pub(crate) times: Times,
}

impl MeterReport {
    pub(crate) fn extend(&mut self, other: Self) {
        self.distinct += other.distinct;
        self.repeated += other.repeated;
        self.disordered += other.disordered;
        self.times.extend(other.times);
    }
}

impl Meter {
    pub(crate) const fn of(peer: Child) -> Self {
        Self(peer)
    }

    pub(crate) fn start(cell: &Cell, topic: &str, more: &[&str]) -> Self {
        let args = ["meter", topic, "--limit", LIMIT, "--depth", "2000"];
        Self(cell.cyclone_c(&[&args, more].concat()))
    }

    /// Waits for this many samples, or for silence, and resets the results.
    pub(crate) fn report(&mut self, expected: u64) -> MeterReport {
        self.wait_for(&format!("{expected} {SILENCE_MS}"), PATIENCE)
    }

    /// Waits as [`report`](Self::report) does while the samples are sent at a pace. Silence is
    /// longer then, because the repair of a large sample takes its time.
    pub(crate) fn report_after(&mut self, pace: SendingPace, expected: u64) -> MeterReport {
        self.wait_for(&format!("{expected} {REPAIR_MS}"), pace.took_at_most())
    }

    fn wait_for(&mut self, line: &str, patience: Duration) -> MeterReport {
        let answer = self.0.ask(line, patience);
        MeterReport {
            distinct: count(&answer, "distinct"),
            repeated: count(&answer, "repeated"),
            disordered: count(&answer, "disordered"),
            times: times(&answer),
        }
    }
}

/// Reads the count of a peer's answer.
pub(crate) fn count(answer: &Value, field: &str) -> u64 {
    answer[field]
        .as_u64()
        .unwrap_or_else(|| panic!("no {field} in {answer}"))
}

/// Reads the times of a peer's answer.
pub(crate) fn times(answer: &Value) -> Times {
    let mut times = Times::default();
    for time in answer["ns"].as_array().unwrap() {
        times.add(Duration::from_nanos(time.as_u64().unwrap()));
    }
    times
}

/// A sender of stamped texts on a topic of ROS 1.
pub(crate) struct Talker {
    stream: TcpStream,
    number: u64,
}

impl Talker {
    pub(crate) fn of(stream: TcpStream) -> Self {
        Self { stream, number: 0 }
    }

    /// Sends at absolute times.
    pub(crate) fn send(&mut self, pace: SendingPace) {
        let mut due = now();
        for tick in 0..pace.ticks {
            if pace.burst > 0 && tick > 0 && tick % pace.burst == 0 {
                due = now() + pace.pause;
            }
            std::thread::sleep(due.saturating_sub(now()));
            self.say(pace.size);
            due += pace.period;
        }
    }

    /// Sends a text, which measurements count, too.
    pub(crate) fn say(&mut self, size: usize) {
        let text = TextStamp::text(0, self.number, size);
        self.number += 1;
        self.stream.write_all(&string_frame(&text)).unwrap();
    }
}

/// A receiver of stamped texts on a topic of ROS 1.
pub(crate) struct Listener {
    subscription: BareSubscription,
    heard: HashSet<u64>,
    next: u64,
}

impl Listener {
    /// Waits until the topic is published, and subscribes to it.
    pub(crate) fn of(node: &BareNode, topic: &str) -> Self {
        let what = format!("{topic} is published");
        Self {
            subscription: eventually(&what, START, || node.subscribe(topic)),
            heard: HashSet::new(),
            next: 0,
        }
    }

    /// Receives this many texts, or until silence.
    pub(crate) fn report(&mut self, expected: u64) -> MeterReport {
        self.subscription
            .wait_at_most(Duration::from_millis(SILENCE_MS));
        let mut report = MeterReport::default();
        while report.distinct < expected
            && let Ok(frame) = self.subscription.receive()
        {
            let Some(stamp) = TextStamp::of(frame) else {
                continue;
            };
            if !self.heard.insert(stamp.number) {
                report.repeated += 1;
                continue;
            }
            report.disordered += u64::from(stamp.number < self.next);
            self.next = stamp.number + 1;
            report.distinct += 1;
            report.times.add(now().saturating_sub(stamp.sent));
        }
        report
    }
}

/// The maximum lifetime of peers in seconds: longer than any measurement.
pub(crate) const LIMIT: &str = "1800";
/// A path needs seconds to be established.
pub(crate) const START: Duration = Duration::from_secs(30);
/// The timeout of an answer that is given at once.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);
/// Silence after which no more samples are expected.
pub(crate) const SILENCE_MS: u64 = 1000;
/// The same for large samples.
const REPAIR_MS: u64 = 5000;
