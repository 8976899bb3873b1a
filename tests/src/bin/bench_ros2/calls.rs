//! Service calls through both bridges, compared with direct calls within a ROS.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{CallerScript, Cell, Child, Times, eventually, per_message, processor_time};

use crate::ends::{LIMIT, START};

pub(crate) fn measure(cell: &Cell, calls: u64) {
    let mut ways = Ways::stand(cell);
    for window in [1, 16] {
        println!(
            "\n{calls} calls of each way, {window} at a time, in turns of {TURN}; microseconds:\n"
        );
        println!("| way | lost | p50 | p99 | calls per s | bridges' CPU per call |");
        println!("|---|---|---|---|---|---|");
        let mut sums = NAMES.map(|_| Sum::default());
        for _ in 0..calls.div_ceil(TURN) {
            for (way, sum) in sums.iter_mut().enumerate() {
                let before = ways.used();
                let told = ways.ask(way, window);
                sum.add(&told, ways.used() - before);
            }
        }
        for (name, mut sum) in NAMES.into_iter().zip(sums) {
            let answered = sum.times.count();
            println!(
                "| {name} | {} | {:.0} | {:.0} | {:.0} | {:.0} |",
                sum.lost,
                sum.times.at(0.5),
                sum.times.at(0.99),
                answered as f64 / sum.seconds,
                per_message(sum.used, answered)
            );
        }
    }
}

/// The results of the calls of a way.
#[derive(Default)]
struct Sum {
    times: Times,
    lost: u64,
    seconds: f64,
    used: Duration,
}

impl Sum {
    fn add(&mut self, told: &Value, used: Duration) {
        let times = told["ns"].as_array().unwrap();
        for nanoseconds in times {
            let nanoseconds = nanoseconds.as_u64().unwrap();
            self.times.add(Duration::from_nanos(nanoseconds));
        }
        self.lost += TURN - times.len() as u64;
        self.seconds += told["seconds"].as_f64().unwrap();
        self.used += used;
        if let Some(why) = told["failed"].get(0) {
            println!("a call failed: {why}");
        }
    }
}

struct Ways {
    rospy: CallerScript,
    direct: Child,
    through: Child,
    bridges: [Child; 2],
    /// The servers of the calls.
    _servers: [Child; 2],
}

impl Ways {
    fn stand(cell: &Cell) -> Self {
        let mapping = cell.file("calls.yaml", MAPPING);
        let mapping = mapping.to_string_lossy();
        // Every node of roscpp has the service.
        let node = ["/nothing", "/nowhere", "__name:=roscpp"];
        let servers = [
            cell.ros1_started("lib/topic_tools/relay", &node).start(),
            cell.cyclone_c(&["serve", "/direct", "--quiet", "--limit", LIMIT]),
        ];
        let bridges = [cell.bridge_ros1(&[&mapping]), cell.bridge_ros2(&[&mapping])];
        let client = |name: &str| {
            let mut client = cell.cyclone_c(&["calls", name, "--limit", LIMIT]);
            client.wait_for_json("a server", START, |line| line.get("matched").map(|_| ()));
            client
        };
        let (direct, through) = (client("/direct"), client("/level"));
        let mut ways = Self {
            rospy: cell.rospy_asker(),
            direct,
            through,
            bridges,
            _servers: servers,
        };
        for (way, name) in NAMES.into_iter().enumerate() {
            eventually(name, START, || {
                let told = ways.ask(way, 1);
                (told["ns"].as_array()?.len() as u64 == TURN).then_some(())
            });
        }
        ways
    }

    /// Calls [`TURN`] times on a way of [`NAMES`].
    fn ask(&mut self, way: usize, window: u64) -> Value {
        let order = format!("{TURN} {window}");
        let by_rospy = |case: &str, service: &str| {
            json!({
                "case": case, "service": service, "count": TURN, "at_once": window,
                "persistent": true, "times": true,
            })
        };
        match way {
            0 => self
                .rospy
                .ask(by_rospy("level", "/roscpp/set_logger_level")),
            1 => self.direct.ask(&order, START),
            2 => self.through.ask(&order, START),
            _ => self.rospy.ask(by_rospy("switch", "/switch")),
        }
    }

    fn used(&self) -> Duration {
        let bridges = self.bridges.iter();
        bridges.map(|bridge| processor_time(bridge.id())).sum()
    }
}

const NAMES: [&str; 4] = [
    "rospy -> roscpp, direct",
    "Cyclone DDS -> Cyclone DDS, direct",
    "Cyclone DDS -> both bridges -> roscpp",
    "rospy -> both bridges -> Cyclone DDS",
];

const MAPPING: &str = "\
spaces:
  - id: 1
  - id: 2
namespaces:
  2: urn:ua-bridge:bench
calls:
  - node: ns=2;i=70
    name: Level
    origin: 1
    ros:
      - {service: /roscpp/set_logger_level, type: roscpp/SetLoggerLevel}
      - space: 2
        service: /level
        type: std_srvs/SetBool
        request: {logger: ros, level: warn}
        response: {success: true, message: \"\"}
  - node: ns=2;i=71
    name: Switch
    origin: 2
    ros:
      - {service: /direct, type: std_srvs/SetBool}
      - {space: 1, service: /switch, type: std_srvs/SetBool}
";

/// Calls of a way before the next way's turn.
const TURN: u64 = 100;
