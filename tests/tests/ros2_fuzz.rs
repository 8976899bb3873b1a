//! bridge-ros2 under datagrams that no correct participant sends.
//!
//! The datagrams that stop RustDDS as published are known ([`claims_too_much`]). They are left out
//! when the bridge runs on it, unless `UA_FUZZ_ALL` is set. `UA_FUZZ_DATAGRAMS` and `UA_FUZZ_SEED`
//! set the number of datagrams and their seed; `--nocapture` shows the duration.

use std::env;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

use system_tests::{
    Cell, Child, Mutator, Peer, UaSide, announced, claims_too_much, eventually, group_member,
    queued, resident,
};
use uadp::Scalar;

const SOON: Duration = Duration::from_secs(30);
/// The multicast address for announcements of participants in domain 2 (RTPS 2.5, 9.6.2.3), and the
/// ports of the first participant.
const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 255, 0, 1), 7900);
const PORTS: [u16; 2] = [7910, 7911];
/// Number of datagrams between two checks of the bridge's unread data.
const BATCH: usize = 50;
/// Bytes that may wait at the bridge before more is sent.
const WAITING: u64 = 0;
/// Allowed growth of the bridge's memory, independent of the number of datagrams.
const GROWTH: u64 = 48_000_000;

fn setting(name: &str, otherwise: u64) -> u64 {
    env::var(name).map_or(otherwise, |value| value.parse().unwrap())
}

/// Checks that values still cross in both directions.
fn traffic_goes_on(ua: &mut UaSide, reader: &Child, turn: u64) {
    let text = format!("turn {turn}");
    let mut written: Option<Instant> = None;
    eventually("a value reaches the subscriber", SOON, || {
        if written.is_none_or(|at| at.elapsed() > Duration::from_millis(200)) {
            ua.write((1, 2, 10), Scalar::String(Some(&text)));
            written = Some(Instant::now());
        }
        let last = reader.values();
        last.last()
            .is_some_and(|last| last["data"] == *text)
            .then_some(())
    });
    ua.drain();
    ua.hear_scalar((2, 2, 20), Scalar::String(Some("cyclone")));
}

/// Waits until the bridge has read the sent datagrams. Stores the last datagrams if the bridge
/// stops reading.
fn wait_until_read(cell: &Cell, recent: &mut Vec<Vec<u8>>) {
    let start = Instant::now();
    while queued(&PORTS).0 > WAITING {
        if start.elapsed() > SOON {
            for (number, datagram) in recent.iter().enumerate() {
                std::fs::write(cell.folder().join(format!("stops-{number:02}")), datagram).unwrap();
            }
            panic!("the bridge reads no more; what was sent last is in its folder");
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    recent.clear();
}

#[test]
fn changed_datagrams_of_all_kinds_neither_stop_nor_swell_the_bridge() {
    let datagrams = setting("UA_FUZZ_DATAGRAMS", 20_000);
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let group = group_member(GROUP);
    group.set_read_timeout(Some(SOON)).unwrap();
    // The first participant in the domain, so it has the first ports.
    let mut bridge = cell.bridge_ros2(&[]);
    let receiver = eventually("the bridge announces itself", SOON, || announced(&group));
    drop(group);
    let mut ua = UaSide::join();
    let reader = cell.cyclone_c(&["sub", "/ua_1_2_10", "std_msgs/String", "--limit", "7200"]);
    let sends = ["pub", "/ua_2_2_20", "std_msgs/String", "--text", "cyclone"];
    let paced = ["--count", "0", "--rate", "20", "--limit", "7200"];
    let _writer = cell.cyclone_c(&[&sends[..], &paced].concat());
    traffic_goes_on(&mut ua, &reader, 0);

    let before = resident(bridge.id());
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let mut mutator = Mutator::new(receiver, setting("UA_FUZZ_SEED", 1));
    for datagram in mutator.corpus() {
        socket
            .send_to(datagram, (Ipv4Addr::LOCALHOST, PORTS[0]))
            .unwrap();
    }
    let step = (datagrams / 10).max(1);
    let mut recent = Vec::new();
    let all = ros2_node::limits::PATCHED || env::var_os("UA_FUZZ_ALL").is_some();
    let mut left_out = 0;
    for number in 0..datagrams {
        let datagram = mutator.datagram();
        if all || !claims_too_much(&datagram) {
            let port = PORTS[(number % 2) as usize];
            socket
                .send_to(&datagram, (Ipv4Addr::LOCALHOST, port))
                .unwrap();
            recent.push(datagram);
        } else {
            left_out += 1;
        }
        if recent.len() == BATCH {
            wait_until_read(&cell, &mut recent);
        }
        if number % step == step - 1 {
            traffic_goes_on(&mut ua, &reader, number);
            println!(
                "{} datagrams: {} MB, {} not read",
                number + 1,
                resident(bridge.id()) / 1_000_000,
                queued(&PORTS).1
            );
        }
    }
    assert!(bridge.runs());
    println!("{left_out} left out");
    let panics: Vec<String> = bridge
        .lines()
        .into_iter()
        .filter(|line| line.contains("panicked"))
        .collect();
    assert!(panics.is_empty(), "{panics:?}");
    let grown = resident(bridge.id()).saturating_sub(before);
    assert!(grown < GROWTH, "{grown} bytes more than before");
}
