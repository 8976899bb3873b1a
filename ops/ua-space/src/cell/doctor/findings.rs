//! The findings: pure functions of the facts.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;

use DoctorSeverity::{Error, Note, Warning};
use serde::Serialize;
use supervisor::is_intended_drop;

use super::super::processes::UdpSocket;
use super::facts::CellFacts;
use super::host::{HALT_POLL, IPFRAG_HIGH, RMEM_MAX};
use crate::cell::StatusPage;

/// A fault, or a setting that may cause a fault.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct DoctorFinding {
    pub(super) code: &'static str,
    pub(super) severity: DoctorSeverity,
    pub(super) what: String,
    /// The effect on the cell.
    pub(super) why: String,
    /// The remedy.
    #[serde(rename = "do")]
    pub(super) remedy: String,
    /// The safe repair, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) fix: Option<Fix>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum DoctorSeverity {
    Error,
    Warning,
    Note,
}

/// A setting of the kernel to write.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Fix {
    pub(super) path: String,
    pub(super) value: u64,
}

/// Returns all findings, the most severe first.
pub(super) fn of(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut found: Vec<DoctorFinding> = ALL.iter().flat_map(|check| check(facts)).collect();
    found.sort_by_key(|one| (one.severity, one.code));
    found
}

const ALL: [fn(&CellFacts) -> Vec<DoctorFinding>; 27] = [
    interfaces,
    membership,
    round_trips,
    route,
    port_holders,
    socket_drops,
    nothing_heard,
    master,
    unresolved_nodes,
    own_ros_address,
    discovery_range,
    discovery_server,
    middleware,
    domain,
    two_bridges,
    duplicate_topics,
    different_mappings,
    type_conflicts,
    dropped_samples,
    not_ready,
    stale_mappings,
    different_versions,
    clocks,
    kernel_settings,
    descriptors,
    certificates,
    filters,
];

fn finding(
    (code, severity): (&'static str, DoctorSeverity),
    what: impl Into<String>,
    why: &str,
    remedy: impl Into<String>,
) -> DoctorFinding {
    DoctorFinding {
        code,
        severity,
        what: what.into(),
        why: why.to_owned(),
        remedy: remedy.into(),
        fix: None,
    }
}

fn interfaces(facts: &CellFacts) -> Vec<DoctorFinding> {
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

fn membership(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(IpAddr::V4(group)) = facts.group.socket().map(|group| group.ip()) else {
        return Vec::new();
    };
    let is_member = facts
        .host
        .memberships
        .values()
        .any(|groups| groups.contains(&group));
    let waits = facts
        .host
        .processes
        .iter()
        .find(|one| JOINING.contains(&one.program.as_str()));
    match waits {
        Some(program) if !is_member && group.is_multicast() => vec![finding(
            ("D002", Error),
            format!(
                "no interface of this host has joined {group}, though {} runs",
                program.program
            ),
            "switches and the kernel forward the group to its members only",
            "start the program with the --interface and --address of the cell; its log names the \
             group that it joined",
        )],
        _ => Vec::new(),
    }
}

/// The programs that join the group.
const JOINING: [&str; 4] = ["bridge-ros1", "bridge-ros2", "ua-server", "ua-component"];

fn round_trips(facts: &CellFacts) -> Vec<DoctorFinding> {
    let failed = facts.interfaces().filter_map(|one| {
        let fault = one.round_trip.as_ref()?.as_ref().err()?;
        Some(finding(
            ("D003", Error),
            format!(
                "multicast does not work on {} ({}): {fault}",
                one.name, one.address
            ),
            "values are sent by multicast; without it no program on this interface hears another",
            "check `ip link` for MULTICAST, the route with `ip route get 239.192.0.40`, and the \
             firewall",
        ))
    });
    failed.collect()
}

fn route(facts: &CellFacts) -> Vec<DoctorFinding> {
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

fn port_holders(facts: &CellFacts) -> Vec<DoctorFinding> {
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

fn socket_drops(facts: &CellFacts) -> Vec<DoctorFinding> {
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

fn nothing_heard(facts: &CellFacts) -> Vec<DoctorFinding> {
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

fn master(facts: &CellFacts) -> Vec<DoctorFinding> {
    let ros = &facts.ros1;
    let Some(fault) = ros.fault.as_ref().filter(|_| ros.is_wanted) else {
        return Vec::new();
    };
    let severity = if facts.has_program("bridge-ros1") {
        Error
    } else {
        Warning
    };
    vec![finding(
        ("D010", severity),
        format!("no ROS 1 master answers at {}: {fault}", ros.master),
        "bridge-ros1 waits for the master, and nothing crosses from or to ROS 1",
        "start roscore, or set ROS_MASTER_URI to the master that the robot uses (`echo \
         $ROS_MASTER_URI` there)",
    )]
}

fn unresolved_nodes(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut by_host: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (node, host) in &facts.ros1.unresolved {
        by_host.entry(host).or_default().push(node);
    }
    let each = by_host.into_iter().map(|(host, nodes)| {
        let first = nodes.first().copied().unwrap_or_default();
        let others = match nodes.len() {
            0 | 1 => String::new(),
            many => format!(" and {} more", many - 1),
        };
        finding(
            ("D011", Error),
            format!("the host `{host}` of ROS 1 node {first}{others} does not resolve from here"),
            "ROS 1 peers connect to the name that a node registered: topics of this node are listed \
             and stay silent",
            format!(
                "add `ADDRESS {host}` to /etc/hosts of this host, or set ROS_IP to an address on \
                 the node's host and restart the node"
            ),
        )
    });
    each.collect()
}

fn own_ros_address(facts: &CellFacts) -> Vec<DoctorFinding> {
    let ros = &facts.ros1;
    if !ros.is_wanted {
        return Vec::new();
    }
    let own = |address: &IpAddr| {
        let text = address.to_string();
        address.is_loopback() || facts.host.interfaces.iter().any(|one| one.address == text)
    };
    let is_remote = ros.master_addresses.iter().any(|address| !own(address));
    let why = "other nodes connect to this address to receive what bridge-ros1 publishes";
    if let Some(ip) = &ros.ros_ip {
        let parsed: Option<IpAddr> = ip.parse().ok();
        if !parsed.as_ref().is_some_and(own) {
            return vec![finding(
                ("D012", Error),
                format!("ROS_IP is {ip}, which is no address of this host"),
                why,
                "set ROS_IP to an address that `ip -4 address` shows, in the network of the robot",
            )];
        }
        if parsed.is_some_and(|ip| ip.is_loopback()) && is_remote {
            return vec![finding(
                ("D012", Error),
                format!("ROS_IP is {ip}, and the master is on another host"),
                why,
                "set ROS_IP to the address of this host in the network of the robot",
            )];
        }
        return Vec::new();
    }
    let name = ros.ros_hostname.as_ref().unwrap_or(&facts.host.name);
    let is_loopback = ros.own_name_addresses.iter().all(IpAddr::is_loopback);
    if is_remote && is_loopback {
        let what = match ros.own_name_addresses.is_empty() {
            true => format!("the name `{name}` of this host does not resolve"),
            false => format!("the name `{name}` of this host resolves to loopback"),
        };
        return vec![finding(
            ("D012", Error),
            format!("{what}, and the ROS 1 master is on another host"),
            why,
            "set ROS_IP to the address of this host in the network of the robot",
        )];
    }
    Vec::new()
}

fn discovery_range(facts: &CellFacts) -> Vec<DoctorFinding> {
    let localhost = facts
        .ros2
        .get("ROS_LOCALHOST_ONLY")
        .filter(|value| *value == "1");
    let range = facts.ros2.get("ROS_AUTOMATIC_DISCOVERY_RANGE");
    let range = range.filter(|value| ["LOCALHOST", "OFF"].contains(&value.to_uppercase().as_str()));
    let set = match (localhost, range) {
        (Some(_), _) => "ROS_LOCALHOST_ONLY is 1".to_owned(),
        (None, Some(range)) => format!("ROS_AUTOMATIC_DISCOVERY_RANGE is {range}"),
        (None, None) => return Vec::new(),
    };
    vec![finding(
        ("D020", Warning),
        set,
        "ROS 2 nodes with this setting are not found from other hosts",
        "unset it where the nodes start, or run bridge-ros2 on the host of the nodes",
    )]
}

fn discovery_server(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(server) = facts.ros2.get("ROS_DISCOVERY_SERVER") else {
        return Vec::new();
    };
    vec![finding(
        ("D021", Warning),
        format!("ROS_DISCOVERY_SERVER is {server}"),
        "nodes that use a discovery server do not announce themselves by multicast, so bridge-ros2 \
         does not find them",
        "unset it for the nodes of the cell",
    )]
}

fn middleware(facts: &CellFacts) -> Vec<DoctorFinding> {
    let name = facts.ros2.get("RMW_IMPLEMENTATION");
    let Some(name) = name.filter(|name| !DDS.contains(name)) else {
        return Vec::new();
    };
    vec![finding(
        ("D022", Error),
        format!("RMW_IMPLEMENTATION is {name}, which does not speak DDS as bridge-ros2 does"),
        "nodes with this middleware and bridge-ros2 do not find each other",
        "start the nodes with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp or rmw_fastrtps_cpp",
    )]
}

const DDS: [&str; 4] = [
    "rmw_cyclonedds_cpp",
    "rmw_fastrtps_cpp",
    "rmw_fastrtps_dynamic_cpp",
    "rmw_connextdds",
];

fn domain(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(domain) = facts.ros2.get("ROS_DOMAIN_ID") else {
        return Vec::new();
    };
    let bridges = facts
        .pages
        .iter()
        .filter(|page| page.program == "bridge-ros2");
    let spaces: BTreeSet<String> = bridges.map(|page| page.space.to_string()).collect();
    if spaces.is_empty() || spaces.contains(domain) {
        return Vec::new();
    }
    let spaces: Vec<String> = spaces.into_iter().collect();
    vec![finding(
        ("D023", Note),
        format!(
            "ROS_DOMAIN_ID is {domain}, and bridge-ros2 here serves space {}",
            spaces.join(", ")
        ),
        "a ROS 2 node of another domain is not bridged; the domain of a space is its number unless \
         the mapping names another",
        "start nodes in the domain of the space, or set `domain` of the space in the mapping",
    )]
}

fn two_bridges(facts: &CellFacts) -> Vec<DoctorFinding> {
    let twice = facts
        .bridges()
        .into_iter()
        .filter(|(_, senders)| senders.len() > 1);
    let each = twice.map(|(space, senders)| {
        let senders: Vec<&str> = senders.into_iter().collect();
        finding(
            ("D030", Error),
            format!(
                "space {space} has {} bridges: {}",
                senders.len(),
                senders.join(", ")
            ),
            "each sample crosses once for each bridge, and both publish under the same identifiers",
            "stop all bridges of this space but one",
        )
    });
    each.collect()
}

fn duplicate_topics(facts: &CellFacts) -> Vec<DoctorFinding> {
    let known = facts.bridges();
    let two = facts.group.topics.iter().filter(|one| {
        let space = one
            .topic
            .split('_')
            .nth(1)
            .and_then(|space| space.parse().ok());
        let is_explained = space
            .is_some_and(|space: u16| known.get(&space).is_some_and(|senders| senders.len() > 1));
        // A restarted program changes the sender once.
        one.sender_changed > 1 && !is_explained
    });
    let each = two.take(MOST_EACH).map(|one| {
        finding(
            ("D031", Error),
            format!(
                "{} is sent from several addresses",
                called(one.name.as_deref(), &one.topic)
            ),
            "readers see two interleaved sequences of values",
            "give each program its own namespace number; `ua-space info` names the sender",
        )
    });
    each.collect()
}

fn called(name: Option<&str>, topic: &str) -> String {
    match name {
        Some(name) => format!("{name} ({topic})"),
        None => topic.to_owned(),
    }
}

fn different_mappings(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut by_hash: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for page in facts
        .pages
        .iter()
        .filter(|page| !page.mapping.hash.is_empty() && !has_own_file(page))
    {
        let hash = page.mapping.hash.as_str();
        by_hash.entry(hash).or_default().push(page.label());
    }
    if by_hash.len() < 2 {
        return Vec::new();
    }
    let each = by_hash.iter().map(|(hash, programs)| {
        let hash: String = hash.chars().take(8).collect();
        format!("{hash} of {}", programs.join(", "))
    });
    let each: Vec<String> = each.collect();
    vec![finding(
        ("D032", Warning),
        format!("programs run different mappings: {}", each.join("; ")),
        "a value that one program maps may be unknown to the others, or have another type",
        "copy one file to all hosts; SIGHUP or saving the file reloads it",
    )]
}

/// Returns whether the file of a program is not the mapping of the cell.
fn has_own_file(page: &StatusPage) -> bool {
    ["ua-component", "ua-mes", "ua-station"].contains(&page.program.as_str())
}

fn type_conflicts(facts: &CellFacts) -> Vec<DoctorFinding> {
    let conflicting = facts.group.topics.iter().filter(|one| one.types.len() > 1);
    let each = conflicting.take(MOST_EACH).map(|one| {
        finding(
            ("D033", Error),
            format!(
                "{} is announced with different types: {}",
                called(one.name.as_deref(), &one.topic),
                one.types.join(", ")
            ),
            "readers take the type of one sender, and drop the values of the other",
            "correct the type in the mapping of one of the senders",
        )
    });
    each.collect()
}

fn dropped_samples(facts: &CellFacts) -> Vec<DoctorFinding> {
    let names = facts.names();
    let each = facts.pages.iter().filter_map(|page| {
        let mut drops: Vec<(u64, &str, &str)> = Vec::new();
        for (topic, of) in &page.topics {
            for (reason, count) in &of.dropped {
                drops.push((*count, topic, reason));
            }
        }
        for (reason, count) in &page.others.dropped {
            drops.push((*count, "others", reason));
        }
        drops.retain(|(count, _, reason)| *count > 0 && !is_intended_drop(reason));
        drops.sort_by(|a, b| b.cmp(a));
        let total: u64 = drops.iter().map(|(count, ..)| count).sum();
        let most = drops.iter().take(3).map(|(count, topic, reason)| {
            let topic = called(names.get(topic).copied(), topic);
            format!("{count} of {topic} ({reason})")
        });
        let most: Vec<String> = most.collect();
        (total > 0).then(|| {
            finding(
                ("D034", Warning),
                format!(
                    "{} dropped {total} samples: {}",
                    page.label(),
                    most.join(", ")
                ),
                "dropped samples do not reach the other side",
                format!(
                    "docs/running.md explains each reason; `curl {}/status` shows all counters",
                    page.url
                ),
            )
        })
    });
    each.collect()
}

fn not_ready(facts: &CellFacts) -> Vec<DoctorFinding> {
    let each = facts.pages.iter().flat_map(|page| {
        let reasons = page
            .not_ready
            .iter()
            .map(|why| (Error, "is not ready", why));
        let waiting = page
            .waiting_for
            .iter()
            .map(|why| (Warning, "waits for", why));
        reasons.chain(waiting).map(|(severity, how, why)| {
            let (what, remedy) = match severity {
                Error => (
                    format!("{} {how}: {why}", page.label()),
                    "remove this cause; the program then continues by itself",
                ),
                Warning | Note => (
                    format!("{} {how} {why}", page.label()),
                    "start or correct this peer, or change its entry in the mapping",
                ),
            };
            finding(
                ("D035", severity),
                what,
                "the values that depend on it do not cross",
                remedy,
            )
        })
    });
    each.collect()
}

fn stale_mappings(facts: &CellFacts) -> Vec<DoctorFinding> {
    let each = facts.pages.iter().flat_map(|page| {
        let file = page.mapping.file.as_deref().unwrap_or("the mapping");
        let stale = page.mapping.stale.as_ref().map(|why| {
            finding(
                ("D037", Error),
                format!("{} runs an older mapping than {file}: {why}", page.label()),
                "changes of the saved file have no effect",
                format!("`ua-space check {file}` lists the faults"),
            )
        });
        let restart = page.mapping.restart_needed.as_slice();
        let restart = (!restart.is_empty()).then(|| {
            finding(
                ("D037", Warning),
                format!(
                    "{} needs a restart for: {}",
                    page.label(),
                    restart.join(", ")
                ),
                "these changes of the mapping have no effect yet",
                "restart the program",
            )
        });
        stale.into_iter().chain(restart)
    });
    each.collect()
}

fn different_versions(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut by_version: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for page in &facts.pages {
        if let Some(version) = &page.version {
            by_version.entry(version).or_default().push(page.label());
        }
    }
    if by_version.len() < 2 {
        return Vec::new();
    }
    let each = by_version.iter();
    let each: Vec<String> = each
        .map(|(version, programs)| format!("{version} of {}", programs.join(", ")))
        .collect();
    vec![finding(
        ("D036", Warning),
        format!("programs have different versions: {}", each.join("; ")),
        "an older program may not know what a newer one announces",
        "install the same version on all hosts",
    )]
}

fn clocks(facts: &CellFacts) -> Vec<DoctorFinding> {
    let each = facts.group.senders.iter().filter_map(|one| {
        // The transport takes less than this; the rest is the difference of the clocks.
        let offset = one.shortest_delay_us;
        let (how, size) = match offset {
            ..-2_000 => ("ahead of", offset.unsigned_abs()),
            250_000.. => ("behind", offset.unsigned_abs()),
            _ => return None,
        };
        let milliseconds = size / 1_000;
        Some(finding(
            ("D040", Warning),
            format!(
                "the clock of {} is about {milliseconds} ms {how} the clock of this host",
                one.from
            ),
            "ages, delays of hops, deadlines of calls and certificates depend on the clocks",
            "synchronise both hosts with chrony or PTP (`chronyc tracking` shows the offset)",
        ))
    });
    each.collect()
}

fn kernel_settings(facts: &CellFacts) -> Vec<DoctorFinding> {
    let setting = |path: &str| facts.host.settings.get(path).copied();
    let with_fix = |one: DoctorFinding, path: &str, value| DoctorFinding {
        fix: Some(Fix {
            path: path.to_owned(),
            value,
        }),
        ..one
    };
    let mut found = Vec::new();
    if let Some(bytes) = setting(RMEM_MAX).filter(|bytes| *bytes < LEAST_RMEM) {
        let one = finding(
            ("D050", Warning),
            format!("socket buffers are limited to {bytes} bytes (net.core.rmem_max)"),
            "a burst of large messages overflows the buffer, and samples are lost",
            format!("set net.core.rmem_max to {WANTED_RMEM}"),
        );
        found.push(with_fix(one, RMEM_MAX, WANTED_RMEM));
    }
    if let Some(bytes) = setting(IPFRAG_HIGH) {
        let failures = facts.host.reassembly_failures;
        if bytes < LEAST_IPFRAG || failures > 0 {
            let failed = match failures {
                0 => String::new(),
                count => format!(", and {count} datagrams could not be reassembled"),
            };
            let one = finding(
                ("D052", Warning),
                format!(
                    "IP fragments may take {bytes} bytes (net.ipv4.ipfrag_high_thresh){failed}"
                ),
                "DDS sends large messages in fragments; a full buffer loses whole messages",
                format!("set net.ipv4.ipfrag_high_thresh to {WANTED_IPFRAG}"),
            );
            match bytes < WANTED_IPFRAG {
                true => found.push(with_fix(one, IPFRAG_HIGH, WANTED_IPFRAG)),
                false => found.push(one),
            }
        }
    }
    if facts.host.is_virtual && setting(HALT_POLL) == Some(0) {
        let one = finding(
            ("D053", Note),
            "guest_halt_poll_ns is 0 on this virtual machine",
            "waking an idle processor of a virtual machine takes up to a tenth of a millisecond",
            "set it to 200000 where delays matter more than processor time",
        );
        found.push(one);
    }
    found
}

fn descriptors(facts: &CellFacts) -> Vec<DoctorFinding> {
    let full = facts.host.processes.iter().filter_map(|one| {
        let most = one.most_open_files?;
        let open = u64::try_from(one.open_files).unwrap_or(u64::MAX);
        (open.saturating_mul(5) > most.saturating_mul(4)).then(|| {
            finding(
                ("D051", Error),
                format!(
                    "{} (process {}) has {open} of {most} files and sockets open",
                    one.program, one.pid
                ),
                "without descriptors it cannot open further topics or connections",
                "raise LimitNOFILE of its unit, or `ulimit -n`",
            )
        })
    });
    full.collect()
}

fn certificates(facts: &CellFacts) -> Vec<DoctorFinding> {
    let today = facts.now / DAY;
    let each = facts.pages.iter().filter_map(|page| {
        let certificate = page.certificate.as_ref()?;
        let until = day_number(&certificate.until)?;
        let left = i64::try_from(until).ok()? - i64::try_from(today).ok()?;
        let (severity, when) = match left {
            ..0 => (Error, "expired".to_owned()),
            0..DAYS_LEFT => (Warning, format!("expires in {left} days")),
            _ => return None,
        };
        Some(finding(
            ("D060", severity),
            format!(
                "the certificate of {} {when} ({})",
                page.label(),
                certificate.until
            ),
            "peers refuse connections with an expired certificate",
            "`ua-server renew` or the GDS replaces it; see docs/security.md",
        ))
    });
    each.collect()
}

/// Returns the days from 1970 to a day as `2031-11-25`.
fn day_number(text: &str) -> Option<u64> {
    let mut parts = text.split('-').map(|part| part.parse::<u64>().ok());
    let (year, month, day) = (parts.next()??, parts.next()??, parts.next()??);
    if !(1970..=9999).contains(&year) || !(1..=12).contains(&month) || !(1..=31).contains(&day) {
        return None;
    }
    // The year starts in March, so that the leap day is its last day.
    let (year, month) = match month {
        1 | 2 => (year - 1, month + 9),
        _ => (year, month - 3),
    };
    let days = year * 365 + year / 4 - year / 100 + year / 400 + (month * 153 + 2) / 5 + day - 1;
    days.checked_sub(719_468)
}

fn filters(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut found = Vec::new();
    if let Some(first) = facts.host.firewall.first() {
        let more = facts.host.firewall.len() - 1;
        let port = facts.group.socket().map_or(4840, |group| group.port());
        found.push(finding(
            ("D070", Warning),
            format!("the firewall drops packets: `{first}`, and {more} further rules"),
            "UDP of the group, DDS (ports from 7400), OPC UA (4840) and mDNS (5353) must pass",
            format!("allow UDP port {port} and IGMP, and the ports that docs/running.md lists"),
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

const MOST_EACH: usize = 10;
const LEAST_RMEM: u64 = 1 << 20;
const WANTED_RMEM: u64 = 8 << 20;
const LEAST_IPFRAG: u64 = 4 << 20;
const WANTED_IPFRAG: u64 = 32 << 20;
const DAY: u64 = 86_400;
const DAYS_LEFT: i64 = 30;

#[cfg(test)]
mod tests;
