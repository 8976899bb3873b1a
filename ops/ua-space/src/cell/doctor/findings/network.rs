//! Interfaces, the group, sockets, firewalls and network bridges.

use std::net::IpAddr;

use super::super::super::processes::UdpSocket;
use super::super::facts::CellFacts;
use super::DoctorSeverity::{Error, Note, Warning};
use super::{DoctorFinding, Fix, finding};

pub(super) fn interfaces(facts: &CellFacts) -> Vec<DoctorFinding> {
    let named = facts.group.interface.as_deref();
    if let Some(fault) = &facts.group.fault {
        return vec![finding(
            ("D001", Error),
            format!("the group cannot be received: {fault}"),
            "no value of the space reaches this host",
            "name an interface that is up with --interface, and the group with --address",
        )];
    }
    let is_up = facts
        .interfaces()
        .any(|one| one.up && one.address != "127.0.0.1");
    match (named, is_up) {
        (None, false) => vec![finding(
            ("D001", Warning),
            "no interface but loopback is up",
            "programs on other hosts cannot be reached",
            "connect the network, or check `ip link`",
        )],
        _ => Vec::new(),
    }
}

pub(super) fn membership(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(IpAddr::V4(group)) = facts.group.socket().map(|group| group.ip()) else {
        return Vec::new();
    };
    let is_member = match facts.group.interface {
        Some(_) => facts.interfaces().any(|one| {
            // An address with a label has the name `eth0:1`.
            let device = one.name.split(':').next().unwrap_or(&one.name);
            let groups = facts.host.memberships.get(device);
            groups.is_some_and(|groups| groups.contains(&group))
        }),
        None => {
            let mut all = facts.host.memberships.values();
            all.any(|groups| groups.contains(&group))
        }
    };
    let named = facts.group.interface.as_deref();
    let interface = named.map_or_else(
        || "no interface of this host has".to_owned(),
        |name| format!("interface {name} has not"),
    );
    let program = facts
        .host
        .processes
        .iter()
        .find(|one| JOINING.contains(&one.program.as_str()));
    let is_wanted = group.is_multicast() && facts.group.fault.is_none();
    match program {
        Some(program) if !is_member && is_wanted => vec![finding(
            ("D002", Error),
            format!(
                "{interface} joined {group}, though {} runs",
                program.program
            ),
            "switches and the kernel forward the group to its members only",
            "start the program with the --interface and --address of the cell; its log names the \
             group that it joined",
        )],
        _ => Vec::new(),
    }
}

pub(super) fn round_trips(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(group) = facts.group.socket().map(|group| group.ip()) else {
        return Vec::new();
    };
    let failed = facts.interfaces().filter_map(|one| {
        let fault = one.round_trip.as_ref()?.as_ref().err()?;
        Some(finding(
            ("D003", Error),
            format!(
                "multicast does not work on {} ({}): {fault}",
                one.name, one.address
            ),
            "values are sent by multicast; without it no program on this interface receives values",
            format!(
                "check `ip link` for MULTICAST, the route with `ip route get {group}`, and the \
                 firewall"
            ),
        ))
    });
    failed.collect()
}

pub(super) fn route(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(IpAddr::V4(group)) = facts.group.socket().map(|group| group.ip()) else {
        return Vec::new();
    };
    let number = u32::from(group);
    let routes = &facts.host.routes;
    let has_route = routes
        .iter()
        .any(|one| number & one.mask == one.destination);
    if has_route || facts.group.interface.is_some() || !group.is_multicast() {
        return Vec::new();
    }
    vec![finding(
        ("D004", Warning),
        format!("there is no route to {group}"),
        "a program without --interface cannot send to the group",
        "give each program --interface, or add `ip route add 239.0.0.0/8 dev INTERFACE`",
    )]
}

pub(super) fn port_holders(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(group) = facts.group.socket() else {
        return Vec::new();
    };
    let at_port = facts
        .host
        .udp
        .iter()
        .filter(|one| one.local.port() == group.port());
    let strangers = at_port.filter(|one| !is_ours(facts, one));
    let strangers = strangers.map(|one| {
        let who = match (one.pid, one.command.as_str()) {
            (Some(pid), command) => format!("{command} (process {pid})"),
            (None, _) => "a process of another user".to_owned(),
        };
        finding(
            ("D005", Warning),
            format!(
                "{who} holds UDP port {} at {}",
                group.port(),
                one.local.ip()
            ),
            "unicast to this port reaches one socket only, and a socket without SO_REUSEADDR keeps \
             bridges from starting",
            "stop that program if it is not part of the cell, or use another port in `address` of \
             the mapping",
        )
    });
    strangers.collect()
}

/// Returns whether a socket is of a program of the cell or of its tools.
fn is_ours(facts: &CellFacts, socket: &UdpSocket) -> bool {
    let is_program = |pid| {
        let mut programs = facts.host.processes.iter();
        programs.any(|program| program.pid == pid) || pid == std::process::id()
    };
    let is_tool = ["ua-space", "ua-bridge"].contains(&socket.command.as_str());
    is_tool || socket.pid.is_some_and(is_program)
}

pub(super) fn socket_drops(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(group) = facts.group.socket() else {
        return Vec::new();
    };
    let at_port = facts
        .host
        .udp
        .iter()
        .filter(|one| one.local.port() == group.port());
    // The programs of a cell let the kernel filter their own datagrams, which it counts like lost
    // datagrams.
    let dropping = at_port.filter(|one| one.drops > 0 && !is_ours(facts, one));
    let dropping = dropping.map(|one| {
        let who = match one.command.as_str() {
            "" => "a socket",
            command => command,
        };
        finding(
            ("D006", Warning),
            format!(
                "{who} lost {} datagrams because its receive buffer was full",
                one.drops
            ),
            "lost datagrams are lost samples: events are gone, states arrive a period later",
            "raise net.core.rmem_max to 8388608, and look for a program that takes a whole \
             processor",
        )
    });
    dropping.collect()
}

pub(super) fn nothing_heard(facts: &CellFacts) -> Vec<DoctorFinding> {
    let group = &facts.group;
    let is_silent = group.topics.is_empty() && group.applications.is_empty();
    if !is_silent || group.fault.is_some() {
        return Vec::new();
    }
    let here = facts
        .host
        .processes
        .iter()
        .any(|one| JOINING.contains(&one.program.as_str()));
    let (severity, remedy) = match here {
        true => (
            Error,
            "programs run on this host, so this is another group or interface than theirs: compare \
             --address and --interface with their logs; with a secured group give --keys",
        ),
        false => (
            Note,
            "start a bridge or server, or give the --address and --interface of the cell",
        ),
    };
    vec![finding(
        ("D007", severity),
        format!(
            "nothing was heard in {} for {} s",
            group.address, group.seconds
        ),
        "there are no values here",
        remedy,
    )]
}

pub(super) fn filters(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut found = Vec::new();
    if let Some(first) = facts.host.firewall.first() {
        let more = match facts.host.firewall.len() {
            0 | 1 => String::new(),
            2 => ", and one further rule".to_owned(),
            all => format!(", and {} further rules", all - 1),
        };
        let port = facts.group.socket().map_or(4840, |group| group.port());
        found.push(finding(
            ("D070", Warning),
            format!("the firewall drops packets: `{first}`{more}"),
            "a dropped packet of the group, of DDS, OPC UA or mDNS is a value or a program that is \
             missing",
            format!("allow UDP port {port} and IGMP, and the ports that docs/doctor.md lists"),
        ));
    }
    for switch in &facts.host.switches {
        let is_of_cell = facts.interfaces().any(|one| one.name == switch.name);
        if switch.snooping && !switch.querier && is_of_cell {
            let path = format!("/sys/class/net/{}/bridge/multicast_querier", switch.name);
            found.push(DoctorFinding {
                fix: Some(Fix { path, value: 1 }),
                ..finding(
                    ("D071", Warning),
                    format!(
                        "the network bridge {} does IGMP snooping without a querier",
                        switch.name
                    ),
                    "after some minutes it forgets the members of the group and stops forwarding \
                     to them",
                    "enable its querier, or disable snooping; the same holds for managed switches",
                )
            });
        }
    }
    found
}

/// The programs that join the group.
const JOINING: [&str; 4] = ["bridge-ros1", "bridge-ros2", "ua-server", "ua-component"];
