//! The whole way between ROS 1 and ROS 2 through both bridges, compared with roscpp's relay.

use std::time::Duration;

use system_tests::{BareNode, Cell, Child, eventually, per_message, processor_time};

use crate::ends::{Listener, Meter, MeterReport, Pacer, START, SendingPace, Talker};

pub(crate) fn measure(cell: &Cell, seconds: u64) {
    let mut ways = Ways::stand(cell, WAITING);
    println!("\n1 kHz, {seconds} s for each way, in turns of {TURN} s; microseconds:\n");
    println!("| payload | way | sent | lost | p50 | p99 | p50 / relay | CPU per message |");
    println!("|---|---|---|---|---|---|---|---|");
    for (size, shown) in [(64, "64 B"), (1024, "1 KiB")] {
        let mut all = [Sum::default(), Sum::default(), Sum::default()];
        let mut left = seconds;
        while left > 0 {
            let turn = left.min(TURN);
            left -= turn;
            for (way, all) in all.iter_mut().enumerate() {
                let before = ways.used(way);
                let pace = SendingPace::kilohertz(turn, size);
                all.sent += pace.ticks;
                all.report.extend(ways.send(way, pace));
                all.used += ways.used(way) - before;
            }
        }
        let mut relay = None;
        for (name, mut all) in NAMES.into_iter().zip(all) {
            let p50 = all.report.times.at(0.5);
            println!(
                "| {shown} | {name} | {} | {} | {p50:.1} | {:.1} | {:.2} | {:.1} |",
                all.sent,
                all.sent - all.report.distinct,
                all.report.times.at(0.99),
                p50 / *relay.get_or_insert(p50),
                per_message(all.used, all.sent)
            );
        }
    }
}

/// Both bridges and the relay, with all ends.
pub(crate) struct Ways {
    to_relay: Talker,
    from_relay: Listener,
    to_ros2: Talker,
    in_ros2: Meter,
    from_ros2: Pacer,
    in_ros1: Listener,
    relay: Child,
    bridges: Vec<Child>,
}

impl Ways {
    /// Starts all programs, with queues of `waiting` samples, and waits until each way carries
    /// samples.
    pub(crate) fn stand(cell: &Cell, waiting: u32) -> Self {
        Self::secured(cell, waiting, "")
    }

    /// As [`stand`](Self::stand), with both bridges in one process.
    pub(crate) fn in_one_process(cell: &Cell, waiting: u32) -> Self {
        Self::with(cell, &mapping(waiting), |mapping| {
            let only = ["--only", "bridge-ros1,bridge-ros2"];
            let together = cell.ua_cell_started(&[&[mapping][..], &only].concat());
            vec![together.start()]
        })
    }

    /// Starts all programs, with `security` added to the mapping of both bridges.
    pub(crate) fn secured(cell: &Cell, waiting: u32, security: &str) -> Self {
        Self::with(cell, &(mapping(waiting) + security), |mapping| {
            vec![cell.bridge_ros1(&[mapping]), cell.bridge_ros2(&[mapping])]
        })
    }

    /// Starts all programs; `start` starts the bridges with the mapping of this text.
    fn with(cell: &Cell, mapping: &str, start: impl FnOnce(&str) -> Vec<Child>) -> Self {
        let mapping = cell.file("through.yaml", mapping);
        let bridges = start(&mapping.to_string_lossy());
        let relay = cell.topic_tools_relay("/relay_in", "/relay_out");
        let node = BareNode::start("/bench");
        let mut inputs = node
            .publish(&["/relay_in".to_owned(), "/ua_1_2_10".to_owned()])
            .into_iter();
        let (mut to_relay, mut to_ros2) = (
            Talker::of(inputs.next().unwrap()),
            Talker::of(inputs.next().unwrap()),
        );
        let mut in_ros2 = Meter::start(cell, "/ua_1_2_10", &[]);
        let mut from_ros2 = Pacer::start(cell, "/ua_2_2_11", &["--depth", "2000"]);
        to_relay.say(64);
        let mut from_relay = Listener::of(&node, "/relay_out");
        let hello = SendingPace {
            period: Duration::from_millis(20),
            ..SendingPace::kilohertz(1, 64)
        };
        let hello = SendingPace { ticks: 25, ..hello };
        eventually("the relay carries", START, || {
            to_relay.send(hello);
            (from_relay.report(hello.ticks).distinct == hello.ticks).then_some(())
        });
        eventually("ROS 1 to ROS 2 carries", START, || {
            to_ros2.send(hello);
            (in_ros2.report(hello.ticks).distinct == hello.ticks).then_some(())
        });
        from_ros2.send(hello);
        let mut in_ros1 = Listener::of(&node, "/ua_2_2_11");
        eventually("ROS 2 to ROS 1 carries", START, || {
            from_ros2.send(hello);
            (in_ros1.report(hello.ticks).distinct >= hello.ticks).then_some(())
        });
        // Samples that were sent before the way was established may still arrive.
        in_ros1.report(u64::MAX);
        Self {
            to_relay,
            from_relay,
            to_ros2,
            in_ros2,
            from_ros2,
            in_ros1,
            relay,
            bridges,
        }
    }

    /// Sends on a way of [`NAMES`] and returns the results of its receiver.
    pub(crate) fn send(&mut self, way: usize, pace: SendingPace) -> MeterReport {
        let expected = pace.ticks;
        if way == 1 {
            self.to_ros2.send(pace);
            return self.in_ros2.report(expected);
        }
        std::thread::scope(|scope| {
            let (talker, pacer) = (&mut self.to_relay, &mut self.from_ros2);
            let listener = if way == 0 {
                &mut self.from_relay
            } else {
                &mut self.in_ros1
            };
            let heard = scope.spawn(move || listener.report(expected));
            if way == 0 {
                talker.send(pace);
            } else {
                pacer.send(pace);
            }
            heard.join().unwrap()
        })
    }

    /// Returns the processes of both bridges, first the bridge of ROS 1.
    pub(crate) fn bridges(&self) -> &[Child] {
        &self.bridges
    }

    pub(crate) fn used(&self, way: usize) -> Duration {
        if way == 0 {
            return processor_time(self.relay.id());
        }
        self.bridges
            .iter()
            .map(|bridge| processor_time(bridge.id()))
            .sum()
    }
}

pub(crate) const NAMES: [&str; 3] = [
    "roscpp `topic_tools relay` (ROS 1 -> ROS 1)",
    "both bridges, ROS 1 -> UADP -> ROS 2",
    "both bridges, ROS 2 -> UADP -> ROS 1",
];

/// Queue length in samples, unless a measurement needs more.
pub(crate) const WAITING: u32 = 2000;

const MAPPING: &str = "\
spaces:
  - id: 1
  - id: 2
namespaces:
  2: urn:ua-bridge:bench
variables:
  - {node: ns=2;i=10, name: there, type: String, origin: 1, queue: {drop_oldest: WAITING}}
  - {node: ns=2;i=11, name: back, type: String, origin: 2, queue: {drop_oldest: WAITING}}
";

fn mapping(waiting: u32) -> String {
    MAPPING.replace("WAITING", &waiting.to_string())
}

#[derive(Default)]
struct Sum {
    report: MeterReport,
    sent: u64,
    used: Duration,
}

/// Seconds of a turn.
const TURN: u64 = 5;
