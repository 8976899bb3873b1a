//! Bad bytes, missing peers, wrong configuration: each leads to a clear message or a counted drop,
//! and other traffic continues.

use std::{
    io::Write,
    net::{Ipv4Addr, TcpListener, TcpStream, UdpSocket},
    process::ExitStatus,
    time::Duration,
};

use serde_json::Value;
use system_tests::{
    Cell, Child, GROUP, METRICS_ROS1, METRICS_ROS2, METRICS_SERVER, Peer, StartedChild, UadpSocket,
    drops, eventually, metrics,
};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
const TEN_FAULTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/cells/ten_faults.yaml");

/// A fixed sequence of pseudo-random bytes (xorshift), so that a failure can be reproduced.
struct Noise(u64);

impl Noise {
    fn byte(&mut self) -> u8 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0.to_le_bytes()[3]
    }

    fn bytes(&mut self, length: usize) -> Vec<u8> {
        (0..length).map(|_| self.byte()).collect()
    }
}

/// Waits until more values arrive than at the start of the call.
fn goes_on(heard: &Child) {
    let before = heard.values().len();
    eventually("traffic goes on", SOON, || {
        (heard.values().len() > before + 5).then_some(())
    });
}

fn ends(started: StartedChild) -> (ExitStatus, String) {
    let mut child = started.start();
    let status = child.wait_for_end(SOON);
    (status, child.lines().join("\n"))
}

#[test]
fn random_and_truncated_datagrams_are_counted_and_stop_nobody() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let group = UadpSocket::join();
    let mut programs = [
        cell.bridge_ros1(&[]),
        cell.bridge_ros2(&[]),
        cell.ua_server(&[]),
    ];
    let mut heard = cell.cyclone(
        "ros2_sub.py",
        &["/ua_1_5_10", "std_msgs/String", "--domain", "2"],
    );
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_5_10",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"on\"",
        ],
    );
    heard.wait_for_line("\"on\"", SOON);
    group.drain();
    let good = group.receive(SOON).unwrap();

    let addresses = [METRICS_ROS1, METRICS_ROS2, METRICS_SERVER];
    let before: Vec<u64> = addresses
        .iter()
        .map(|at| drops(&metrics(at).unwrap()))
        .collect();
    let mut noise = Noise(0x5eed);
    let mut bad = 0;
    for length in 1..good.len() {
        group.send(&good[..length]);
        bad += 1;
    }
    for round in 0..1000 {
        group.send(&noise.bytes(round % 97 + 1));
        bad += 1;
        if round % 50 == 0 {
            // Sent no faster than a program on a busy machine reads: the test is about bad bytes,
            // not about floods.
            goes_on_a_little(&heard);
        }
    }
    group.send(&[]);
    group.send(&noise.bytes(65_507));

    for (address, before) in addresses.iter().zip(before) {
        eventually(
            &format!("{address} counts {bad} bad datagrams"),
            SOON,
            || (drops(&metrics(address)?) >= before + bad).then_some(()),
        );
    }
    goes_on(&heard);
    for program in &mut programs {
        assert!(program.runs(), "{program}");
    }
}

fn goes_on_a_little(heard: &Child) {
    let before = heard.values().len();
    eventually("traffic goes on", SOON, || {
        (heard.values().len() > before).then_some(())
    });
}

#[test]
fn garbage_at_the_tcpros_and_slave_ports_stops_nobody() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let mut bridge = cell.bridge_ros1(&[]);
    let _ros2 = cell.bridge_ros2(&[]);
    let topic = ["/ua_2_5_10", "std_msgs/String"];
    let _sends = cell.cyclone(
        "ros2_pub.py",
        &[
            &topic[..],
            &["--domain", "2", "--repeat", "0", "--value", "\"on\""],
        ]
        .concat(),
    );
    let mut heard = cell.rospy("ros1_sub.py", &topic);
    let node = heard.wait_for_json("a message of the bridge", SOON, |line| {
        Some(line.get("callerid")?.as_str()?.to_owned())
    });
    let tcpros = eventually("the bridge serves the topic", SOON, || {
        cell.tcpros_port(&node, topic[0])
    });
    let slave = eventually("the bridge serves its slave API", SOON, || {
        cell.slave_api(&node)
    });

    let mut noise = Noise(0xbad);
    let mut open = Vec::new();
    for (address, bytes) in [
        (&tcpros, vec![0xff; 4]), // a header of 4 GiB
        (&tcpros, noise.bytes(4096)),
        (&tcpros, b"\x04\0\0\0\0\0\0\0".to_vec()), // a header of one empty field
        (&tcpros, b"\x10\0\0\0\xff\xff\xff\x7fcallerid=/x".to_vec()), // a field longer than its header
        (&tcpros, b"GET / HTTP/1.1\r\n\r\n".to_vec()),
        (&tcpros, Vec::new()), // a peer that sends nothing
        (&slave, noise.bytes(4096)),
        (
            &slave,
            b"POST / HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n<".to_vec(),
        ),
        (
            &slave,
            b"POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\n<methodCa".to_vec(),
        ),
        (&slave, Vec::new()),
    ] {
        let mut stream = TcpStream::connect(address.as_str()).unwrap();
        stream.write_all(&bytes).unwrap();
        open.push(stream);
    }
    goes_on(&heard);
    let mut later = cell.rospy("ros1_sub.py", &[&topic[..], &["--node", "later"]].concat());
    later.wait_for_line("\"on\"", SOON);
    drop(open);
    goes_on(&heard);
    assert!(bridge.runs());
}

#[test]
fn a_bridge_waits_for_the_master_says_so_and_connects_when_it_comes() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let mut bridge = cell.bridge_ros1(&[]);
    bridge.wait_for_line("master", SOON);
    let group = UadpSocket::join();

    let _master = cell.roscore();
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_5_10",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"on\"",
        ],
    );
    eventually("the topic crosses", SOON, || {
        group.receive(Duration::from_millis(100))
    });
    assert!(bridge.runs());
}

#[test]
fn a_bridge_withdraws_its_registrations_when_told_to_end() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let mut bridge = cell.bridge_ros1(&[]);
    let group = UadpSocket::join();
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_5_10",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"on\"",
        ],
    );
    // Probes for calls are received before.
    eventually("the topic crosses", SOON, || {
        let datagram = group.receive(Duration::from_millis(100))?;
        let message = uadp::NetworkMessage::decode(&datagram).unwrap();
        (message.message_type() == uadp::NetworkMessageType::DataSet).then_some(())
    });
    let state = || {
        system_tests::xml_rpc(system_tests::MASTER, "getSystemState", &["/system_tests"]).unwrap()
    };
    assert!(state().contains("bridge"), "{}", state());

    let status = bridge.end();
    assert_eq!(status.code(), Some(0));
    assert!(!state().contains("bridge"), "{}", state());
    assert!(state().contains("/rospy_pub"), "{}", state());
}

#[test]
fn a_taken_metrics_port_is_named() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let _taken = TcpListener::bind(METRICS_ROS1).unwrap();
    let (status, said) = ends(cell.bridge_ros1_started(&[]));
    assert_eq!(status.code(), Some(69), "{said}");
    assert!(said.contains(METRICS_ROS1), "{said}");
}

#[test]
fn a_taken_uadp_port_is_named() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let _taken = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, GROUP.port())).unwrap();
    for started in [
        cell.bridge_ros1_started(&[]),
        cell.bridge_ros2_started(&[]),
        cell.ua_server_started(&[]),
    ] {
        let (status, said) = ends(started);
        assert_eq!(status.code(), Some(69), "{said}");
        assert!(said.contains("4840"), "{said}");
    }
}

#[test]
fn a_taken_opc_ua_port_is_named() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let _taken = TcpListener::bind("127.0.0.1:4840").unwrap();
    let (status, said) = ends(cell.ua_server_started(&[]));
    assert_eq!(status.code(), Some(69), "{said}");
    assert!(said.contains("4840"), "{said}");
}

#[test]
fn a_missing_interface_is_named_beside_those_that_are_there() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let arguments = ["--interface", "robot0"];
    for name in ["bridge-ros1", "bridge-ros2", "ua-server"] {
        let mut started = StartedChild::new(name, &system_tests::program(name)).args(arguments);
        if name == "bridge-ros2" {
            started = started.args(["--domain", "2"]);
        }
        if name == "ua-server" {
            started = started.args(["--pki".into(), cell.folder().join("pki")]);
        }
        let (status, said) = ends(started);
        assert_eq!(status.code(), Some(69), "{said}");
        assert!(said.contains("robot0") && said.contains("lo"), "{said}");
    }
}

#[test]
fn ten_faults_in_a_mapping_are_ten_findings_in_one_go() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    for started in [
        cell.bridge_ros1_started(&[TEN_FAULTS]),
        cell.bridge_ros2_started(&[TEN_FAULTS]),
        cell.ua_server_started(&[TEN_FAULTS]),
    ] {
        let (status, said) = ends(started);
        assert_eq!(status.code(), Some(78), "{said}");
        let findings = said
            .lines()
            .filter(|line| line.starts_with("error[M"))
            .count();
        assert_eq!(findings, 10, "{said}");
        let places = said
            .lines()
            .filter(|line| line.contains("ten_faults.yaml:"))
            .count();
        assert!(places >= 10, "{said}");
    }
}

#[test]
fn a_mapping_that_is_not_there_is_named() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let (status, said) = ends(cell.bridge_ros1_started(&["no_such_cell.yaml"]));
    assert_eq!(status.code(), Some(74), "{said}");
    assert!(said.contains("no_such_cell.yaml"), "{said}");
}

#[test]
fn what_is_no_flag_is_a_usage_error() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    for started in [
        cell.bridge_ros1_started(&["--intrface"]),
        cell.bridge_ros2_started(&["--intrface"]),
    ] {
        let (status, said) = ends(started);
        assert_eq!(status.code(), Some(64), "{said}");
        assert!(said.contains("--intrface"), "{said}");
    }
}

#[test]
fn a_program_without_topics_reports_none() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let _bridge = cell.bridge_ros2(&[]);
    let status = metrics(METRICS_ROS2).unwrap();
    assert_eq!(drops(&status), 0, "{status}");
    assert_eq!(status["space"], Value::from(2), "{status}");
}
