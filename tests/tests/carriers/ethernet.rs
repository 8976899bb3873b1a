//! UADP over Ethernet: hosts at a switch, VLANs, foreign frames, and Wireshark as a judge.

use std::os::fd::AsRawFd as _;

use nix::ifaddrs::getifaddrs;
use serde_json::Value;
use socket2::{Domain, Socket, Type};
use system_tests::{StartedChild, WireEffect, program};
use transport::{Ethernet, EthernetOptions, VlanTag};

use super::*;

const GROUP_MAC: [u8; 6] = [0x01, 0x00, 0x5E, 0x7F, 0x00, 0x01];

/// Hosts at a switch: the interfaces `host1` to `host4`, whose other ends are ports of a bridge. An
/// interface receives no frames of itself, as a host.
struct Switch;

impl Switch {
    fn new() -> Self {
        ip("link add switch type bridge");
        for number in HOSTS {
            ip(&format!(
                "link add host{number} type veth peer name port{number}"
            ));
            ip(&format!("link set port{number} master switch up"));
            ip(&format!("link set host{number} up"));
        }
        ip("link set switch up");
        Self
    }

    fn ports(state: &str) {
        for number in HOSTS {
            ip(&format!("link set port{number} {state}"));
        }
    }
}

impl Network for Switch {
    fn join(&self, publisher: u16) -> Box<dyn Carrier> {
        Box::new(ethernet(publisher, None))
    }

    fn cut(&mut self) {
        Self::ports("down");
    }

    fn mend(&mut self) {
        Self::ports("up");
    }
}

const HOSTS: std::ops::RangeInclusive<u16> = 1..=4;

fn ip(args: &str) {
    let status = Command::new("ip").args(args.split(' ')).status().unwrap();
    assert!(status.success(), "ip {args}");
}

fn ethernet(host: u16, tag: Option<VlanTag>) -> Ethernet {
    let options = EthernetOptions {
        tag,
        ..EthernetOptions::new(format!("host{host}"), GROUP_MAC)
    };
    Ethernet::open(&options).unwrap()
}

/// A raw socket at the interface of a host.
struct Raw {
    socket: Socket,
    address: [u8; 6],
}

impl Raw {
    fn at(host: &str) -> Self {
        let socket = Socket::new(Domain::PACKET, Type::RAW, None).unwrap();
        let link = getifaddrs()
            .unwrap()
            .filter(|interface| interface.interface_name == host)
            .find_map(|interface| interface.address?.as_link_addr().copied())
            .unwrap();
        nix::sys::socket::bind(socket.as_raw_fd(), &link).unwrap();
        let address = link.addr().unwrap();
        Self { socket, address }
    }

    /// Sends a frame with bytes behind its source address.
    fn send(&self, to: [u8; 6], rest: &[&[u8]]) {
        let frame = [&to[..], &self.address, &rest.concat()].concat();
        self.socket.send(&frame).unwrap();
    }
}

const UADP: &[u8] = &[0xB6, 0x2C];

/// Returns the senders and numbers of the messages until `last` arrives.
async fn all_until(carrier: &mut Ethernet, last: u32) -> Vec<(u16, u32)> {
    let carrier: &mut dyn Carrier = carrier;
    let mut buffer = vec![0; BUFFER];
    let mut all = Vec::new();
    let received = async {
        while all.last().is_none_or(|(_, number)| *number != last) {
            let received = carrier.recv(&mut buffer).await.unwrap();
            let (publisher, number) = read(&buffer[..received.length]);
            let PublisherId::UInt16(publisher) = publisher else {
                panic!("{publisher:?}");
            };
            all.push((publisher, number));
        }
    };
    timeout(SOON, received).await.expect("the last message");
    all
}

#[test]
fn ethernet_conforms() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let faults = Faults {
        loses: true,
        reorders: false,
    };
    run(conforms(&mut Switch::new(), faults));
}

#[test]
fn frames_of_a_vlan_stay_in_it_and_a_priority_alone_is_no_vlan() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let _switch = Switch::new();
    let tags = [VlanTag::new(5, 6), VlanTag::new(6, 0), VlanTag::new(0, 7)];
    run(async {
        let mut senders = tags.map(|tag| ethernet(1, tag));
        let mut receivers = [
            VlanTag::new(5, 0),
            VlanTag::new(6, 3),
            // Frames with a priority and without a VLAN are received like frames without a tag.
            None,
        ]
        .map(|tag| ethernet(2, tag));
        for number in 1..=2 {
            for (sender, publisher) in senders.iter_mut().zip(1..) {
                send(sender, publisher, number, 1400).unwrap();
            }
        }
        for (receiver, publisher) in receivers.iter_mut().zip(1..) {
            let got = all_until(receiver, 2).await;
            assert_eq!(got, [(publisher, 1), (publisher, 2)]);
        }
    });
}

#[test]
fn padded_frames_are_received_and_frames_for_others_are_counted() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let _switch = Switch::new();
    run(async {
        let mut receiver = ethernet(1, None);
        let other = Raw::at("host2");
        let message = value(7, 1, 0);
        let padding = vec![0; 46 - message.len()];
        other.send(GROUP_MAC, &[UADP, &message, &padding]);
        let own = Raw::at("host1").address;
        other.send(own, &[UADP, &value(7, 2, 0)]);
        // Another protocol, another group, another VLAN, no message.
        other.send(GROUP_MAC, &[&[0xB6, 0x2D], &value(7, 3, 0)]);
        let other_group = [0x01, 0x00, 0x5E, 0x7F, 0x00, 0x02];
        other.send(other_group, &[UADP, &value(7, 4, 0)]);
        other.send(GROUP_MAC, &[&[0x81, 0, 0, 5], UADP, &value(7, 5, 0)]);
        other.send(GROUP_MAC, &[UADP]);
        other.send(GROUP_MAC, &[UADP, &value(7, 6, 0)]);
        assert_eq!(all_until(&mut receiver, 6).await, [(7, 1), (7, 2), (7, 6)]);
        let expected = [("frame_short", 1), ("frame_other_address", 1)];
        assert_eq!(receiver.dropped(), expected);
    });
}

#[test]
fn wireshark_reads_vlan_priority_and_values_of_frames() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let _switch = Switch::new();
    let file = cell.folder().join("frames.pcapng");
    let filter = "ether proto 0xb62c or (vlan and ether proto 0xb62c)";
    let mut capture = Command::new("tshark")
        .args(["-i", "host3", "-f", filter, "-c", "8", "-w"])
        .arg(&file)
        .spawn()
        .unwrap();
    run(async {
        let mut plain = ethernet(1, None);
        let mut tagged = ethernet(1, VlanTag::new(5, 6));
        let start = Instant::now();
        while capture.try_wait().unwrap().is_none() {
            assert!(start.elapsed() < SOON, "eight frames are captured");
            send(&mut plain, 1, 1, 0).unwrap();
            send(&mut tagged, 2, 1, 1000).unwrap();
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    });
    let columns =
        "-T fields -E separator=/s -e vlan.id -e vlan.priority -e _ws.col.Protocol -e _ws.col.Info";
    let columns: Vec<&str> = columns.split(' ').collect();
    let shown = cell.tshark_of(&file, &columns);
    let mut lines: Vec<&str> = shown.lines().map(str::trim).collect();
    lines.sort_unstable();
    lines.dedup();
    let value = |of: u16| format!("UADP PublisherId {of} WriterGroup 2: 10 key frame (2 fields)");
    assert_eq!(lines, [format!("5 6 {}", value(2)), value(1)]);
}

#[test]
fn a_program_without_the_capability_says_how_to_give_it() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let _switch = Switch::new();
    let mapping = cell.file("ethernet.yaml", "pubsub: {eth: {interface: host1}}\n");
    let ended = Command::new("setpriv")
        .args(["--bounding-set", "-net_raw", "--inh-caps", "-net_raw", "--"])
        .arg(program("bridge-ros1"))
        .arg(mapping)
        .output()
        .unwrap();
    assert_eq!(ended.status.code(), Some(78));
    let shown = String::from_utf8_lossy(&ended.stderr);
    for word in ["host1", "CAP_NET_RAW", "AmbientCapabilities", "setcap"] {
        assert!(shown.contains(word), "{word}: {shown}");
    }
}

/// A text of fourteen frames.
const LONG: usize = 20_000;

#[test]
fn a_text_of_many_frames_crosses_between_hosts_by_ethernet_alone() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let host = cell.host(WireEffect {
        loss: 0.0,
        delay: Duration::from_millis(1),
    });
    let _master = cell.roscore();
    let text = format!("pubsub: {{eth: {{interface: {WIRE}}}}}\nspaces: [{{id: 1}}, {{id: 2}}]\n");
    let mapping = cell.file("ethernet.yaml", &text).display().to_string();
    let bridge = |name: &str| StartedChild::new(name, &program(name)).args([&mapping[..]]);
    let _ros1 = cell.with_ros1(bridge("bridge-ros1")).start();
    let _ros2 = bridge("bridge-ros2")
        .args(["--domain", "2"])
        .on(&host)
        .start();
    let topic = ["/ua_1_5_10", "std_msgs/String"];
    let mut receives = cell
        .cyclone_started("ros2_sub.py", &[&topic[..], &["--domain", "2"]].concat())
        .on(&host)
        .start()
        .ready(SOON);
    let long = "x".repeat(LONG);
    let value = format!("\"{long}\"");
    let args = [
        "--value",
        &value,
        "--value",
        "\"last\"",
        "--warm-up",
        "\"warm\"",
    ];
    let mut sends = cell
        .rospy_started("ros1_pub.py", &[&topic[..], &args].concat())
        .told()
        .start()
        .ready(SOON);
    receives.wait_for_json("the first text", SOON, |line| line.get("value").map(drop));
    sends.tell("begin");
    receives.wait_for_json("the last text", SOON, |line| {
        (line["value"]["data"] == "last").then_some(())
    });
    let values = receives.values();
    let is_long = |value: &&Value| value["data"] == long;
    assert_eq!(values.iter().filter(is_long).count(), 1);
}
