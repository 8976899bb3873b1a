use std::net::Ipv4Addr;

use super::super::super::pages::{CertificatePage, StatusPage, TopicPage};
use super::super::super::processes::{LocalProcess, UdpSocket};
use super::super::facts::AnnouncedApplication;
use super::super::host::{HALT_POLL, IPFRAG_HIGH, InterfaceFacts, RMEM_MAX, Route, Switch};
use super::DoctorSeverity::{Note, Warning};
use super::programs::{DAY, day_number};
use super::*;
use crate::live::{SenderTiming, TopicSeen};

/// Returns the facts of a host with one bridge, without any fault.
fn healthy() -> CellFacts {
    let mut facts = CellFacts {
        version: "0.1.0".to_owned(),
        now: 1_790_000_000,
        ..CellFacts::default()
    };
    facts.group.address = "239.192.0.40:4840".to_owned();
    facts.group.seconds = 3.0;
    facts.group.applications.push(announced(1, "10.0.0.5:4000"));
    facts.group.topics.push(TopicSeen {
        topic: "ua_1_2_10".to_owned(),
        name: Some("Speed".to_owned()),
        types: vec!["geometry_msgs/Twist".to_owned()],
        ..TopicSeen::default()
    });
    facts.host.name = "gateway".to_owned();
    facts.host.interfaces.push(InterfaceFacts {
        name: "eth0".to_owned(),
        address: "10.0.0.5".to_owned(),
        up: true,
        round_trip: Some(Ok(40.0)),
    });
    let group = Ipv4Addr::new(239, 192, 0, 40);
    facts
        .host
        .memberships
        .insert("eth0".to_owned(), vec![group]);
    facts.host.routes.push(Route {
        interface: "eth0".to_owned(),
        destination: 0,
        mask: 0,
    });
    facts.host.processes.push(LocalProcess {
        pid: 7,
        program: "bridge-ros1".to_owned(),
        open_files: 20,
        most_open_files: Some(1024),
        ..LocalProcess::default()
    });
    for (path, value) in [(RMEM_MAX, 8 << 20), (IPFRAG_HIGH, 32 << 20)] {
        facts.host.settings.insert(path.to_owned(), value);
    }
    facts.pages.push(page("bridge-ros1", 1));
    facts
}

fn announced(space: u16, from: &str) -> AnnouncedApplication {
    AnnouncedApplication {
        space,
        from: from.to_owned(),
        ..AnnouncedApplication::default()
    }
}

fn page(program: &str, space: u8) -> StatusPage {
    let mut page = StatusPage {
        program: program.to_owned(),
        version: Some("0.1.0".to_owned()),
        space,
        url: "http://127.0.0.1:9101".to_owned(),
        ..StatusPage::default()
    };
    page.mapping.hash = "0123456789abcdef".to_owned();
    page
}

/// Returns the codes of the findings after a change of the healthy facts.
fn after(change: impl FnOnce(&mut CellFacts)) -> Vec<&'static str> {
    let mut facts = healthy();
    change(&mut facts);
    of(&facts).iter().map(|one| one.code).collect()
}

#[test]
fn a_healthy_cell_has_no_findings() {
    assert_eq!(of(&healthy()), []);
}

#[test]
fn faults_of_the_network_are_found() {
    let fault = after(|facts| facts.group.fault = Some("no such interface".to_owned()));
    assert_eq!(fault, ["D001"]);
    let down = after(|facts| facts.host.interfaces.clear());
    assert_eq!(down, ["D001"]);
    let member = after(|facts| facts.host.memberships.clear());
    assert_eq!(member, ["D002"]);
    let elsewhere = after(|facts| {
        facts.host.interfaces.push(InterfaceFacts {
            name: "wlan0".to_owned(),
            address: "192.168.0.5".to_owned(),
            up: true,
            round_trip: None,
        });
        facts.group.interface = Some("wlan0".to_owned());
    });
    assert_eq!(elsewhere, ["D002"], "it joined on eth0");
    let trip = after(|facts| {
        let failed = Err("nothing came back".to_owned());
        facts.host.interfaces[0].round_trip = Some(failed);
    });
    assert_eq!(trip, ["D003"]);
    let route = after(|facts| facts.host.routes.clear());
    assert_eq!(route, ["D004"]);
    let silent = after(|facts| {
        facts.group.topics.clear();
        facts.group.applications.clear();
    });
    assert_eq!(silent, ["D007"]);
    let rules = after(|facts| facts.host.firewall.push("policy drop".to_owned()));
    assert_eq!(rules, ["D070"]);
    let switch = after(|facts| {
        facts.host.switches.push(Switch {
            name: "eth0".to_owned(),
            snooping: true,
            querier: false,
        });
    });
    assert_eq!(switch, ["D071"]);
}

#[test]
fn holders_of_the_port_and_lost_datagrams_are_found() {
    let socket = |pid, drops| UdpSocket {
        local: "0.0.0.0:4840".parse().unwrap(),
        inode: 1,
        drops,
        pid: Some(pid),
        command: "python3".to_owned(),
    };
    assert_eq!(after(|facts| facts.host.udp.push(socket(99, 0))), ["D005"]);
    assert!(after(|facts| facts.host.udp.push(socket(7, 0))).is_empty());
    let lost = after(|facts| facts.host.udp.push(socket(99, 3)));
    assert!(lost.contains(&"D006"), "{lost:?}");
    // The kernel counts the own datagrams that a program filters.
    assert!(after(|facts| facts.host.udp.push(socket(7, 3))).is_empty());
}

#[test]
fn faults_of_ros_1_are_found() {
    let master = after(|facts| {
        facts.ros1.is_wanted = true;
        facts.ros1.fault = Some("refused".to_owned());
    });
    assert_eq!(master, ["D010"]);
    let names = after(|facts| {
        facts.ros1.is_wanted = true;
        let node = |name: &str| (name.to_owned(), "ned".to_owned());
        facts.ros1.unresolved = vec![node("/a"), node("/b")];
    });
    assert_eq!(names, ["D011"]);
    let ip = after(|facts| {
        facts.ros1.is_wanted = true;
        facts.ros1.ros_ip = Some("10.0.0.99".to_owned());
    });
    assert_eq!(ip, ["D012"]);
    let name = after(|facts| {
        facts.ros1.is_wanted = true;
        facts.ros1.master_addresses = vec!["10.0.0.7".parse().unwrap()];
        facts.ros1.own_name_addresses = vec!["127.0.1.1".parse().unwrap()];
    });
    assert_eq!(name, ["D012"]);
}

#[test]
fn settings_of_ros_2_that_hide_nodes_are_found() {
    for (name, value, code) in [
        ("ROS_LOCALHOST_ONLY", "1", "D020"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost", "D020"),
        ("ROS_DISCOVERY_SERVER", "10.0.0.1:11811", "D021"),
        ("RMW_IMPLEMENTATION", "rmw_zenoh_cpp", "D022"),
    ] {
        let set = |facts: &mut CellFacts| {
            let variables = &mut facts.ros2.variables;
            variables.insert(name.to_owned(), value.to_owned());
        };
        assert_eq!(after(set), [code], "{name}");
    }
    let domain = after(|facts| {
        facts.pages.push(page("bridge-ros2", 2));
        let variables = &mut facts.ros2.variables;
        variables.insert("ROS_DOMAIN_ID".to_owned(), "7".to_owned());
    });
    assert_eq!(domain, ["D023"]);
}

#[test]
fn programs_that_disagree_are_found() {
    let two = after(|facts| facts.group.applications.push(announced(1, "10.0.0.6:4000")));
    assert_eq!(two, ["D030"]);
    let triple = after(|facts| facts.group.topics[0].sender_changed = 9);
    assert_eq!(triple, ["D031"]);
    let restarted = after(|facts| facts.group.topics[0].sender_changed = 1);
    assert!(restarted.is_empty());
    let mapping = after(|facts| {
        let mut other = page("bridge-ros2", 2);
        other.mapping.hash = "f".to_owned();
        facts.pages.push(other);
    });
    assert_eq!(mapping, ["D032"]);
    let component = after(|facts| {
        let mut other = page("ua-component", 0);
        other.mapping.hash = "f".to_owned();
        facts.pages.push(other);
    });
    assert!(
        component.is_empty(),
        "its file is no mapping: {component:?}"
    );
    let types = after(|facts| facts.group.topics[0].types.push("std_msgs/Bool".to_owned()));
    assert_eq!(types, ["D033"]);
    let version = after(|facts| {
        let version = Some("0.2.0".to_owned());
        facts.pages.push(StatusPage {
            version,
            ..page("ua-server", 0)
        });
    });
    assert_eq!(version, ["D036"]);
    let clock = after(|facts| {
        facts.group.senders.push(SenderTiming {
            from: "10.0.0.6:4000".to_owned(),
            shortest_delay_us: -3_000_000,
        });
    });
    assert_eq!(clock, ["D040"]);
}

#[test]
fn what_programs_report_is_found() {
    let mut facts = healthy();
    let topic = TopicPage {
        dropped: [("too_big", 4), ("repeat", 9)]
            .map(|(reason, count)| (reason.to_owned(), count))
            .into(),
        ..TopicPage::default()
    };
    facts.pages[0].topics.insert("ua_1_2_10".to_owned(), topic);
    let found = of(&facts);
    assert_eq!(found[0].code, "D034");
    assert!(
        found[0]
            .what
            .ends_with("dropped 4 samples: 4 of Speed (ua_1_2_10) (too_big)"),
        "{found:?}"
    );
    facts.pages[0].topics.insert(
        "ua_1_2_11".to_owned(),
        TopicPage {
            dropped: [("no_subscriber", 7), ("untyped", 1)]
                .map(|(reason, count)| (reason.to_owned(), count))
                .into(),
            ..TopicPage::default()
        },
    );
    let shown: Vec<_> = of(&facts)
        .into_iter()
        .map(|one| (one.code, one.severity))
        .collect();
    assert_eq!(
        shown,
        [("D034", Warning), ("D034", Note)],
        "events without a subscriber are no fault"
    );
    let ready = after(|facts| facts.pages[0].not_ready.push("no keys".to_owned()));
    assert_eq!(ready, ["D035"]);
    let waiting = after(|facts| facts.pages[0].waiting_for.push("/speed".to_owned()));
    assert_eq!(waiting, ["D035"]);
    let stale = after(|facts| facts.pages[0].mapping.stale = Some("M014".to_owned()));
    assert_eq!(stale, ["D037"]);
}

fn set(facts: &mut CellFacts, path: &str, value: u64) {
    facts.host.settings.insert(path.to_owned(), value);
}

#[test]
fn limits_of_the_host_are_found() {
    let rmem = after(|facts| set(facts, RMEM_MAX, 212_992));
    assert_eq!(rmem, ["D050"]);
    let frag = after(|facts| set(facts, IPFRAG_HIGH, 262_144));
    assert_eq!(frag, ["D052"]);
    let lost = after(|facts| {
        set(facts, IPFRAG_HIGH, 4 << 20);
        facts.host.reassembly_failures = 2;
    });
    assert_eq!(lost, ["D052"]);
    let mut enlarged = healthy();
    enlarged.host.reassembly_failures = 2;
    let found = of(&enlarged);
    assert_eq!((found[0].code, found[0].severity), ("D052", Note));
    assert_eq!(found[0].fix, None, "the buffer is large enough");
    let poll = after(|facts| {
        facts.host.is_virtual = true;
        facts.host.settings.insert(HALT_POLL.to_owned(), 0);
    });
    assert_eq!(poll, ["D053"]);
    assert_eq!(
        after(|facts| facts.host.processes[0].open_files = 900),
        ["D051"]
    );
}

#[test]
fn certificates_are_found_before_they_expire() {
    let until = |day: &str| {
        let certificate = CertificatePage {
            name: "ua-server".to_owned(),
            until: day.to_owned(),
        };
        after(|facts| facts.pages[0].certificate = Some(certificate))
    };
    // The facts are of 2026-09-21.
    assert_eq!(day_number("1970-01-01"), Some(0));
    assert_eq!(day_number("2026-09-21"), Some(1_790_000_000 / DAY));
    assert_eq!(until("2026-09-20"), ["D060"]);
    assert_eq!(until("2026-10-01"), ["D060"]);
    assert!(until("2026-11-01").is_empty());
    assert!(until("nonsense").is_empty());
}
