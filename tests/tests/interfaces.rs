//! Network interfaces that are deleted and recreated, or get another address, while the bridges
//! run.

use std::cell::RefCell;
use std::time::{Duration, Instant};

use system_tests::{
    BareNode, Cable, Cell, Child, HERE, METRICS_ROS1, METRICS_ROS2, Peer, StartedChild, THERE,
    TopicTriple, UaSide, WIRE, eventually, http_answer, http_get, metrics, program, string_frame,
};
use tcpros::Core;
use uadp::{Scalar, Variant};

/// Another address of this host on the cable.
const ELSEWHERE: &str = "10.77.0.3";
const START: Duration = Duration::from_secs(20);
/// The interfaces are polled each second and values repeated each second; the rest is for a loaded
/// machine.
const SOON: Duration = Duration::from_secs(20);
const OUT: (TopicTriple, &str) = ((1, 2, 10), "/ua_1_2_10");
const IN: (TopicTriple, &str) = ((2, 2, 20), "ua_2_2_20");

/// A ROS 1 graph on loopback with a published topic, for a bridge with a PubSub network that is
/// elsewhere.
struct Graph {
    _master: Core,
    _runtime: tokio::runtime::Runtime,
}

impl Graph {
    fn start() -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let _inside = runtime.enter();
        Self {
            _master: Core::start(([127, 0, 0, 1], 11311).into()).unwrap(),
            _runtime: runtime,
        }
    }
}

/// Starts a bridge that announces this address to other nodes.
fn bridge_ros1(address: &str, more: &[&str]) -> Child {
    let bridge = StartedChild::new("bridge-ros1", &program("bridge-ros1"))
        .env("ROS_MASTER_URI", "http://127.0.0.1:11311")
        .env("ROS_IP", address)
        .args(["--metrics", METRICS_ROS1])
        .args(more)
        .start();
    until_ready(METRICS_ROS1, START);
    bridge
}

fn until_ready(metrics: &str, within: Duration) {
    eventually("the bridge is ready", within, || {
        (http_answer(metrics, "/readyz")?.0 == 200).then_some(())
    });
}

/// Waits until the bridge reports that it is not ready, and returns the reasons.
fn until_not_ready(metrics: &str) -> String {
    eventually("the bridge is not ready", SOON, || {
        let (code, why) = http_answer(metrics, "/readyz")?;
        (code == 503).then_some(why)
    })
}

/// Returns whether the bridge has the interfaces of that side, by its gauge.
fn has_interface(metrics: &str, side: &str) -> bool {
    let side = format!("side=\"{side}\"}} ");
    let text = http_get(metrics, "/metrics").unwrap();
    let line = text
        .lines()
        .find(|line| line.starts_with("ua_interface_up{") && line.contains(&side));
    line.unwrap().ends_with('1')
}

fn delivered() -> u64 {
    metrics(METRICS_ROS1)
        .and_then(|status| status["topics"][IN.1]["delivered"].as_u64())
        .unwrap_or_default()
}

/// Waits until values cross the cable in both directions.
fn cross(cable: &Cable, value: &str) {
    let start = Instant::now();
    let mut ua: UaSide = cable.ua_side();
    // The value is repeated each second.
    ua.hear_scalar(OUT.0, Scalar::String(Some("out")));
    let before = delivered();
    eventually("a value of the other host is delivered", SOON, || {
        ua.write(IN.0, Scalar::String(Some(value)));
        (delivered() > before).then_some(())
    });
    assert!(start.elapsed() < SOON, "{:?}", start.elapsed());
}

/// Checks a bridge whose interface is named by `arguments` or chosen by the system.
fn values_cross_again(arguments: &[&str]) {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let cable = cell.cable();
    let lay = |address: &str| {
        cable.lay(address);
        cable.route();
    };
    lay(HERE);
    let _graph = Graph::start();
    let mut bridge = bridge_ros1("127.0.0.1", arguments);
    let node = BareNode::start("/talker");
    let mut out = node.publish(&[OUT.1.to_owned()]).remove(0);
    std::io::Write::write_all(&mut out, &string_frame("out")).unwrap();
    cross(&cable, "before");

    for address in [HERE, ELSEWHERE] {
        cable.pull();
        let why = until_not_ready(METRICS_ROS1);
        assert!(why.contains("network interface"), "{why}");
        assert!(!has_interface(METRICS_ROS1, "pubsub"));
        bridge.wait_for_line("the PubSub network is out of reach", SOON);
        lay(address);
        cross(&cable, address);
        assert!(has_interface(METRICS_ROS1, "pubsub"));
        until_ready(METRICS_ROS1, SOON);
        bridge.wait_for_line("the PubSub network is within reach", SOON);
    }
    // The interface is recreated so quickly that the bridge does not see its absence.
    cable.pull();
    lay(ELSEWHERE);
    cross(&cable, "at once");
    // The bridge recognizes its own datagrams by the new address.
    let status = metrics(METRICS_ROS1).unwrap();
    assert_eq!(
        status["others"]["dropped"]["space_taken"],
        serde_json::Value::Null
    );
}

#[test]
fn values_cross_again_when_the_interface_was_made_anew_or_has_another_address() {
    values_cross_again(&["--interface", WIRE]);
}

#[test]
fn values_cross_again_on_the_interface_the_system_chooses() {
    values_cross_again(&[]);
}

#[test]
fn a_bridge_whose_dds_is_bound_to_an_address_that_is_another_ends_to_be_started_again() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let cable = cell.cable();
    cable.lay(HERE);
    let start = || {
        let bridge = cell.bridge_ros2_started(&["--ros-interface", WIRE]).start();
        until_ready(METRICS_ROS2, START);
        bridge
    };
    let mut bridge = start();
    assert!(has_interface(METRICS_ROS2, "local"));
    cable.pull();
    let why = until_not_ready(METRICS_ROS2);
    assert!(why.contains(&format!("{WIRE} ({HERE})")), "{why}");
    assert!(!has_interface(METRICS_ROS2, "local"));
    cable.lay(ELSEWHERE);
    let ended = bridge.wait_for_end(SOON);
    assert_eq!(ended.code(), Some(69));
    bridge.wait_for_line("should restart this program", SOON);
    let _again = start();
}

#[test]
fn a_bridge_whose_ros_1_address_is_another_ends_to_be_started_again() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let cable = cell.cable();
    cable.lay(HERE);
    let _graph = Graph::start();
    let mut bridge = bridge_ros1(HERE, &["--interface", "lo"]);
    cable.pull();
    let why = until_not_ready(METRICS_ROS1);
    assert!(why.contains(&format!("{WIRE} ({HERE})")), "{why}");
    cable.lay(ELSEWHERE);
    assert_eq!(bridge.wait_for_end(SOON).code(), Some(69));
    bridge.wait_for_line("should restart this program", SOON);
}

/// The numbers that rospy published on another host, as they arrive in the group.
struct Numbers(RefCell<Vec<u32>>);

impl Numbers {
    /// Reads values until a number of at least `last`.
    fn read(&self, ua: &UaSide, last: u32) {
        ua.hear(OUT.0, "a number of rospy", |fields| {
            let [Variant::Scalar(Scalar::String(Some(text)))] = fields else {
                return None;
            };
            let number: u32 = text.parse().ok()?;
            self.0.borrow_mut().push(number);
            (number >= last).then_some(())
        });
    }

    /// Returns the longest row of numbers that are missing.
    fn longest_gap(&self) -> u32 {
        let mut numbers = self.0.borrow().clone();
        numbers.sort_unstable();
        let steps = numbers.windows(2).map(|pair| pair[1] - pair[0]);
        steps.max().unwrap_or_default()
    }
}

/// TCP holds what is sent while a link is down, and delivers it when the link is up again.
#[test]
fn what_was_sent_while_the_link_of_ros_1_was_down_does_not_arrive_when_it_is_up() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let cable = cell.cable();
    cable.lay(HERE);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let _master = Core::start(([0, 0, 0, 0], 11311).into()).unwrap();
    let _bridge = bridge_ros1(HERE, &["--interface", "lo"]);
    let beyond = |script: &str, args: &[&str]| {
        cell.rospy_started(script, args)
            .env("ROS_MASTER_URI", format!("http://{HERE}:11311"))
            .env("ROS_HOSTNAME", THERE)
            .beyond(&cable)
            .start()
            .ready(START)
    };
    let subscriber = beyond("ros1_sub.py", &["/ua_2_2_20", "std_msgs/String"]);
    let arrives = |ua: &mut UaSide, text: &str| {
        eventually(text, SOON, || {
            ua.write(IN.0, Scalar::String(Some(text)));
            let mut lines = subscriber.lines().into_iter();
            lines.any(|line| line.contains(text)).then_some(())
        });
    };
    let mut ua = UaSide::join();
    arrives(&mut ua, "before the cut");
    let numbered = [
        OUT.1,
        "std_msgs/String",
        "--numbered",
        "9999",
        "--rate",
        "100",
    ];
    let _publisher = beyond("ros1_pub.py", &numbered);
    let numbers = Numbers(RefCell::default());
    numbers.read(&ua, 50);

    cable.cut();
    let cut = Instant::now();
    until_not_ready(METRICS_ROS1);
    let lasts = |ms| {
        eventually("the cut lasts", SOON, || {
            (cut.elapsed() > Duration::from_millis(ms)).then_some(())
        });
    };
    // The bridge closes the connections within 0.3 s.
    lasts(800);
    for _ in 0..20 {
        ua.write(IN.0, Scalar::String(Some("while it was cut")));
    }
    lasts(1500);
    cable.mend();

    // Longer than the numbers that the socket of the test holds, and those of the cut.
    let last = numbers.0.borrow().last().copied().unwrap_or_default();
    numbers.read(&ua, last + 400);
    let gap = numbers.longest_gap();
    assert!(gap > 60, "{gap}: {:?}", numbers.0.borrow());
    arrives(&mut ua, "after the cut");
    let lines = subscriber.lines();
    assert!(
        !lines.iter().any(|line| line.contains("while it was cut")),
        "{lines:?}"
    );
}
