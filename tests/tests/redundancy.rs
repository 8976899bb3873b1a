//! Two bridges of a space: the standby takes over from a bridge that is stopped, killed or ended.
//! No value is doubled and none comes late.

use std::collections::{BTreeMap, BTreeSet};
use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use nix::sys::signal::Signal;
use serde_json::Value;
use system_tests::{
    Cell, Child, GroupNumbers, METRICS_ROS1, METRICS_ROS2, Peer, StartedChild, UadpSocket,
    eventually, metrics, program,
};
use uadp::{
    DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar,
    Timestamp,
};

const SOON: Duration = Duration::from_secs(60);
/// The status of the second bridge.
const METRICS_SECOND: &str = "127.0.0.1:9112";
const COUNT: u32 = 12_000;
const PLANT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/cells/plant.yaml");

fn redundancy(address: &str) -> Option<Value> {
    Some(metrics(address)?["redundancy"].clone())
}

/// Two bridges of a space. On a loaded machine each may lose its role at any time, so the tests
/// look up the active bridge.
struct Pair {
    bridges: [Option<Child>; 2],
    metrics: [&'static str; 2],
}

impl Pair {
    fn start(bridges: [StartedChild; 2], metrics: [&'static str; 2]) -> Self {
        let [first, second] = bridges;
        let pair = Self {
            bridges: [Some(first.start()), Some(second.start())],
            metrics,
        };
        let _active = pair.active();
        eventually("both bridges have a role", SOON, || {
            metrics.iter().all(|of| pair.has_role(of)).then_some(())
        });
        pair
    }

    fn has_role(&self, metrics: &str) -> bool {
        redundancy(metrics).is_some_and(|status| status["role"] != "starting")
    }

    /// Returns the active bridge.
    fn active(&self) -> usize {
        eventually("a bridge is active", SOON, || self.active_now())
    }

    fn active_now(&self) -> Option<usize> {
        (0..2).find(|at| {
            let status = self.bridges[*at]
                .as_ref()
                .and_then(|_| redundancy(self.metrics[*at]));
            status.is_some_and(|status| status["role"] == "active")
        })
    }

    fn bridge(&self, at: usize) -> &Child {
        self.bridges[at].as_ref().unwrap()
    }

    /// Stops the active bridge, and continues it when `done` returns.
    fn stop_active(&self, done: impl FnOnce()) {
        let active = self.active();
        self.bridge(active).signal(Signal::SIGSTOP);
        let other = self.metrics[1 - active];
        eventually("the other bridge is active", SOON, || {
            (redundancy(other)?["role"] == "active").then_some(())
        });
        done();
        self.bridge(active).signal(Signal::SIGCONT);
        eventually("the stopped bridge answers", SOON, || {
            self.has_role(self.metrics[active]).then_some(())
        });
    }

    /// Removes the active bridge with a signal.
    fn remove_active(&mut self, signal: Signal) {
        let active = self.active();
        let mut bridge = self.bridges[active].take().unwrap();
        bridge.signal(signal);
        bridge.wait_for_end(SOON);
    }

    /// Returns the status of the active bridge.
    fn status(&self) -> Value {
        redundancy(self.metrics[self.active()]).unwrap()
    }
}

fn assert_rising(values: &[u32]) {
    for pair in values.windows(2) {
        assert!(pair[0] < pair[1], "{} after {}", pair[1], pair[0]);
    }
}

/// Stops and kills the active bridge while a publisher sends 1000 values a second.
fn no_value_is_doubled(mut pair: Pair, triple: (u16, u16, u16), publisher: impl FnOnce() -> Child) {
    let listener = GroupNumbers::of(triple, Ipv4Addr::LOCALHOST);
    let mut publisher = publisher();
    // The numbers are sent once the whole path is established, for both bridges.
    let metrics_of = pair.metrics;
    eventually("both bridges receive the topic", SOON, || {
        let sent = |address: &str| -> Option<u64> {
            let status = metrics(address)?;
            let topic = format!("ua_{}_{}_{}", triple.0, triple.1, triple.2);
            let sent = status["topics"][&topic]["sent"].as_u64()?;
            Some(sent + status["redundancy"]["muted_sent"].as_u64()?)
        };
        metrics_of.iter().all(|of| sent(of) > Some(3)).then_some(())
    });
    publisher.tell("go");
    listener.wait_for(1_000);
    pair.stop_active(|| listener.wait_for(4_000));
    listener.wait_for(6_000);
    pair.remove_active(Signal::SIGKILL);
    listener.wait_for(COUNT - 1);

    let values = listener.values();
    assert_rising(&values);
    let gaps = values.windows(2).map(|pair| pair[1] - pair[0]);
    let mut gaps: Vec<u32> = gaps.filter(|gap| *gap > 20).collect();
    gaps.sort_unstable();
    let status = pair.status();
    println!(
        "{} of {COUNT} values, gaps of {gaps:?} values at 1 kHz, {status}",
        values.len()
    );
    assert!(values.len() > 2_000, "{}", values.len());
    assert!(status["epoch"].as_u64() >= Some(3), "{status}");
}

#[test]
fn a_stopped_or_killed_bridge_of_ros_1_is_replaced_and_no_value_is_doubled() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let addresses = [METRICS_ROS1, METRICS_SECOND];
    let bridges = [("1", METRICS_ROS1), ("2", METRICS_SECOND)]
        .map(|(rank, metrics)| cell.bridge_ros1_at(&[PLANT, "--rank", rank], metrics));
    no_value_is_doubled(Pair::start(bridges, addresses), (1, 2, 12), || {
        let count = COUNT.to_string();
        let args = [
            "/ua_1_2_12",
            "std_msgs/String",
            "--numbered",
            &count,
            "--rate",
            "1000",
        ];
        let warm_up = ["--warm-up", "\"warm-up\""];
        cell.rospy_started("ros1_pub.py", &[&args[..], &warm_up].concat())
            .told()
            .start()
    });
}

#[test]
fn a_stopped_or_killed_bridge_of_ros_2_is_replaced_and_no_value_is_doubled() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let addresses = [METRICS_ROS2, METRICS_SECOND];
    let bridges = [("1", METRICS_ROS2), ("2", METRICS_SECOND)].map(|(rank, metrics)| {
        cell.bridge_ros2_at(&[PLANT, "--domain", "2", "--rank", rank], metrics)
    });
    no_value_is_doubled(Pair::start(bridges, addresses), (2, 2, 22), || {
        let count = COUNT.to_string();
        let args = [
            "/ua_2_2_22",
            "std_msgs/String",
            "--domain",
            "2",
            "--numbered",
            &count,
        ];
        let more = ["--rate", "1000", "--warm-up", "\"warm-up\""];
        cell.cyclone_started("ros2_pub.py", &[&args[..], &more].concat())
            .told()
            .start()
    });
}

/// Sends numbers as a program of space 0 sends events: each is repeated after 30 ms.
struct Commander {
    newest: Arc<Mutex<u32>>,
    ends: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Commander {
    fn start(group: u16, writer: u16) -> Self {
        let newest = Arc::new(Mutex::new(0));
        let ends = Arc::new(AtomicBool::new(false));
        let (told, over) = (Arc::clone(&newest), Arc::clone(&ends));
        let thread = thread::spawn(move || {
            let socket = UadpSocket::join();
            let start = Instant::now();
            let mut sent: Vec<(u32, Timestamp)> = Vec::new();
            while !over.load(Ordering::Relaxed) {
                let number = u32::try_from(sent.len()).unwrap() + 1;
                let now = utc();
                sent.push((number, now));
                socket.send(&command((group, writer), (number, now), now));
                if let Some(before) = sent.len().checked_sub(7) {
                    socket.send(&command((group, writer), sent[before], now));
                }
                *told.lock().unwrap() = number;
                let due = PERIOD * number;
                thread::sleep(due.saturating_sub(start.elapsed()));
            }
        });
        Self {
            newest,
            ends,
            thread: Some(thread),
        }
    }

    fn newest(&self) -> u32 {
        *self.newest.lock().unwrap()
    }
}

impl Drop for Commander {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
        }
    }
}

const PERIOD: Duration = Duration::from_millis(5);

fn utc() -> Timestamp {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    Timestamp::from_unix_nanos(i128::try_from(since.as_nanos()).unwrap())
}

fn command(
    (group, writer): (u16, u16),
    (number, taken): (u32, Timestamp),
    now: Timestamp,
) -> Vec<u8> {
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(0)),
        group: Some(GroupHeader {
            writer_group_id: Some(group),
            ..GroupHeader::default()
        }),
        timestamp: Some(now.time),
        picoseconds: Some(now.picoseconds),
        ..NetworkHeader::default()
    };
    let mut datagram = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[writer])).unwrap();
    let frame = DataSetHeader {
        sequence_number: Some(u16::try_from(number & 0xFFFF).unwrap()),
        timestamp: Some(taken.time),
        picoseconds: Some(taken.picoseconds),
        ..DataSetHeader::default()
    };
    let mut frame = message.key_frame(&frame).unwrap();
    frame
        .scalar(Scalar::String(Some(&number.to_string())))
        .unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    datagram
}

/// Returns the numbers that a subscriber received, by the node that published them.
fn received(subscriber: &Child) -> BTreeMap<String, Vec<u32>> {
    let mut by_node: BTreeMap<String, Vec<u32>> = BTreeMap::new();
    for line in subscriber.json_lines() {
        let number = line["value"]["data"]
            .as_str()
            .and_then(|text| text.parse().ok());
        if let (Some(node), Some(number)) = (line["callerid"].as_str(), number) {
            by_node.entry(node.to_owned()).or_default().push(number);
        }
    }
    by_node
}

#[test]
fn commands_reach_a_rospy_subscriber_once_while_bridges_are_stopped_killed_and_switched_over() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let bridges = [("1", METRICS_ROS1), ("2", METRICS_SECOND)]
        .map(|(rank, metrics)| cell.bridge_ros1_at(&[PLANT, "--rank", rank], metrics));
    let mut pair = Pair::start(bridges, [METRICS_ROS1, METRICS_SECOND]);
    let subscriber = cell.rospy("ros1_sub.py", &["/ua_0_2_40", "std_msgs/String"]);
    let commander = Commander::start(2, 40);
    let goes_on = || {
        let since = commander.newest();
        eventually(&format!("commands after {since} arrive"), SOON, || {
            let received = received(&subscriber);
            let newest = received.values().filter_map(|numbers| numbers.last()).max();
            newest.is_some_and(|newest| *newest > since).then_some(())
        });
    };
    goes_on();
    pair.stop_active(goes_on);
    goes_on();

    eventually("the active bridge hands over on request", SOON, || {
        let active = pair.active_now()?;
        pair.bridge(active).signal(Signal::SIGUSR1);
        let other = pair.metrics[1 - active];
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs(2) {
            let reason = redundancy(other)?["last_takeover"]["reason"].clone();
            if reason == "the active bridge handed over" {
                return Some(());
            }
        }
        None
    });
    goes_on();
    // The end of a program hands over too.
    pair.remove_active(Signal::SIGTERM);
    goes_on();

    let mut all = BTreeSet::new();
    for (node, numbers) in received(&subscriber) {
        assert_rising(&numbers);
        for number in numbers {
            assert!(all.insert(number), "{node} published {number} again");
        }
    }
    println!(
        "{} of {} commands arrived, each once",
        all.len(),
        commander.newest()
    );
}

#[test]
fn a_redundant_bridge_takes_calls_and_refuses_values_of_services() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let head = "spaces: [{id: 1}]\nnamespaces: {2: urn:plant}\n";
    let calls = "calls:\n  - {node: ns=2;i=60, name: Grip, origin: 1, ros: {service: /grip, type: \
                 std_srvs/Trigger}}\n";
    let values = "variables:\n  - {node: ns=2;i=61, name: Light, origin: 0, ros: {space: 1, call: /light, type: \
                  std_srvs/SetBool, field: data}}\n";
    for (name, text, code) in [("calls", calls, 0), ("values", values, 78)] {
        let mapping = cell.file(&format!("{name}.yaml"), &format!("{head}{text}"));
        let mut checked = StartedChild::new("bridge-ros1", &program("bridge-ros1"))
            .args(["--check", "--rank", "1"])
            .args([&mapping])
            .start();
        assert_eq!(checked.wait_for_end(SOON).code(), Some(code), "{name}");
        let said = checked.lines().join("\n");
        let is_refused = said.contains("values of services are not carried");
        assert_eq!(is_refused, code != 0, "{said}");
    }
}

#[test]
fn a_bridge_without_a_rank_goes_on_after_a_request_to_switch_over() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let mapping = cell.file("plain.yaml", "spaces: [{id: 1}]\n");
    let mut bridge = StartedChild::new("bridge-ros1", &program("bridge-ros1"))
        .args([&mapping])
        .start();
    bridge.wait_for_line("bridge-ros1 starts", SOON);
    bridge.signal(Signal::SIGUSR1);
    bridge.wait_for_line("ignored SIGUSR1", SOON);
    bridge.signal(Signal::SIGTERM);
    assert_eq!(bridge.wait_for_end(SOON).code(), Some(0));
}
