//! The facts about this host: interfaces, sockets and settings of the kernel.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read as _};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::mpsc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::Serialize;
use tokio::time::{Instant, timeout};
use transport::{SendError, Udp, UdpOpenError, UdpOptions};

use super::super::processes::{self, LocalProcess, UdpSocket};

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct HostFacts {
    pub(super) name: String,
    pub(super) interfaces: Vec<InterfaceFacts>,
    /// The multicast groups that are joined, by interface.
    pub(super) memberships: BTreeMap<String, Vec<Ipv4Addr>>,
    pub(super) routes: Vec<Route>,
    pub(super) processes: Vec<LocalProcess>,
    pub(super) udp: Vec<UdpSocket>,
    /// Settings of the kernel, by path.
    pub(super) settings: BTreeMap<String, u64>,
    /// Failed reassemblies of IP fragments since the start of the host.
    pub(super) reassembly_failures: u64,
    pub(super) is_virtual: bool,
    /// Rules of the firewall that drop or reject incoming packets, if they are readable.
    pub(super) firewall: Vec<String>,
    /// Network bridges of this host.
    pub(super) switches: Vec<Switch>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct InterfaceFacts {
    pub(super) name: String,
    pub(super) address: String,
    pub(super) up: bool,
    /// The result of sending a datagram to the group and receiving it; `None` if not measured.
    pub(super) round_trip: Option<Result<f64, String>>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct Route {
    pub(super) interface: String,
    pub(super) destination: u32,
    pub(super) mask: u32,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct Switch {
    pub(super) name: String,
    pub(super) snooping: bool,
    pub(super) querier: bool,
}

pub(super) const RMEM_MAX: &str = "/proc/sys/net/core/rmem_max";
pub(super) const IPFRAG_HIGH: &str = "/proc/sys/net/ipv4/ipfrag_high_thresh";
pub(super) const HALT_POLL: &str = "/sys/module/haltpoll/parameters/guest_halt_poll_ns";
const SETTINGS: [&str; 3] = [RMEM_MAX, IPFRAG_HIGH, HALT_POLL];

/// Reads the facts below a root.
pub(super) fn read(root: &Path) -> HostFacts {
    let text = |path: &str| {
        let path = root.join(path.trim_start_matches('/'));
        fs::read_to_string(path).unwrap_or_default()
    };
    let (processes, udp) = processes::read(root);
    let settings = SETTINGS.iter().filter_map(|path| {
        let value = text(path).trim().parse().ok()?;
        Some(((*path).to_owned(), value))
    });
    HostFacts {
        name: text("/proc/sys/kernel/hostname").trim().to_owned(),
        interfaces: interfaces(),
        memberships: memberships(&text("/proc/net/igmp")),
        routes: routes(&text("/proc/net/route")),
        processes,
        udp,
        settings: settings.collect(),
        reassembly_failures: reassembly_failures(&text("/proc/net/snmp")),
        is_virtual: text("/proc/cpuinfo").contains(" hypervisor"),
        firewall: firewall(),
        switches: switches(root),
    }
}

impl HostFacts {
    /// Sends a datagram to the group on each interface, at a port that no program uses.
    pub(super) async fn measure(&mut self, group: SocketAddr) {
        if !group.ip().is_multicast() {
            return;
        }
        for interface in &mut self.interfaces {
            if interface.up {
                let round_trip = round_trip(group.ip(), &interface.address).await;
                interface.round_trip = Some(round_trip.map_err(|fault| fault.to_string()));
            }
        }
    }
}

/// The reason why a datagram to the group did not come back.
#[derive(Debug, thiserror::Error)]
enum RoundTripFault {
    #[error(transparent)]
    Port(#[from] io::Error),
    #[error(transparent)]
    Open(#[from] UdpOpenError),
    #[error("cannot send: {0}")]
    Send(SendError),
    #[error("cannot receive: {0}")]
    Receive(io::Error),
    #[error("nothing came back within {ROUND_TRIP:?}")]
    Lost,
}

/// Returns the time until a datagram to the group comes back, in microseconds.
async fn round_trip(group: IpAddr, interface: &str) -> Result<f64, RoundTripFault> {
    let free = std::net::UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0));
    let port = free.and_then(|socket| socket.local_addr());
    let port = port?.port();
    let options = UdpOptions {
        interface: Some(interface.to_owned()),
        ttl: 0,
        own: true,
        ..UdpOptions::new(SocketAddr::new(group, port))
    };
    let mut udp = Udp::open(&options)?;
    let sent = format!("ua-space doctor {} {interface}", std::process::id());
    let start = Instant::now();
    udp.try_send(sent.as_bytes())
        .map_err(RoundTripFault::Send)?;
    let mut buffer = [0; 256];
    let received = async {
        loop {
            match udp.recv(&mut buffer).await {
                Ok((length, _)) if buffer.get(..length) == Some(sent.as_bytes()) => return Ok(()),
                Ok(_) => {}
                Err(error) => return Err(RoundTripFault::Receive(error)),
            }
        }
    };
    match timeout(ROUND_TRIP, received).await {
        Ok(Ok(())) => Ok(start.elapsed().as_secs_f64() * 1e6),
        Ok(Err(error)) => Err(error),
        Err(_over) => Err(RoundTripFault::Lost),
    }
}

/// The time limit of a measurement on an interface.
const ROUND_TRIP: Duration = Duration::from_secs(1);

fn interfaces() -> Vec<InterfaceFacts> {
    let all = transport::interfaces().unwrap_or_default().into_iter();
    all.map(|one| InterfaceFacts {
        name: one.name,
        address: one.address.to_string(),
        up: one.up,
        round_trip: None,
    })
    .collect()
}

/// Parses `/proc/net/igmp`: a line per interface, and an indented line per group.
fn memberships(table: &str) -> BTreeMap<String, Vec<Ipv4Addr>> {
    let mut found: BTreeMap<String, Vec<Ipv4Addr>> = BTreeMap::new();
    let mut interface = String::new();
    for line in table.lines().skip(1) {
        let mut words = line.split_whitespace();
        let Some(first) = words.next() else {
            continue;
        };
        if line.starts_with(char::is_whitespace) {
            if let Ok(group) = u32::from_str_radix(first, 16) {
                let group = Ipv4Addr::from(group.to_ne_bytes());
                found.entry(interface.clone()).or_default().push(group);
            }
        } else {
            let name = words.next().unwrap_or_default();
            interface = name.trim_end_matches(':').to_owned();
        }
    }
    found
}

fn routes(table: &str) -> Vec<Route> {
    let route = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let number = |at: usize| {
            let word = u32::from_str_radix(words.get(at)?, 16).ok()?;
            Some(u32::from_be_bytes(word.to_ne_bytes()))
        };
        Some(Route {
            interface: (*words.first()?).to_owned(),
            destination: number(1)?,
            mask: number(7)?,
        })
    };
    table.lines().skip(1).filter_map(route).collect()
}

/// Returns `ReasmFails` of `/proc/net/snmp`.
fn reassembly_failures(table: &str) -> u64 {
    let mut lines = table.lines().filter(|line| line.starts_with("Ip:"));
    let (Some(names), Some(values)) = (lines.next(), lines.next()) else {
        return 0;
    };
    let mut both = names.split_whitespace().zip(values.split_whitespace());
    let found = both.find(|(name, _)| *name == "ReasmFails");
    found.and_then(|(_, value)| value.parse().ok()).unwrap_or(0)
}

fn switches(root: &Path) -> Vec<Switch> {
    let folder = root.join("sys/class/net");
    let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
    let switches = entries.filter_map(|entry| {
        let bridge = entry.path().join("bridge");
        let flag = |name: &str| {
            let text = fs::read_to_string(bridge.join(name)).ok()?;
            Some(text.trim() == "1")
        };
        Some(Switch {
            name: entry.file_name().to_string_lossy().into_owned(),
            snooping: flag("multicast_snooping")?,
            querier: flag("multicast_querier")?,
        })
    });
    switches.collect()
}

/// Returns the dropping rules of nftables, or else of iptables, if a program can list them.
fn firewall() -> Vec<String> {
    for (program, arguments) in [("nft", &["list", "ruleset"][..]), ("iptables", &["-S"])] {
        if let Some(text) = output(program, arguments) {
            let rules = dropping(&text);
            if !rules.is_empty() {
                return rules;
            }
        }
    }
    Vec::new()
}

/// Returns the rules that drop or reject incoming packets: rules of the input chains, and of the
/// chains to which these jump. Rules for invalid connections drop no packet of a cell.
pub(super) fn dropping(rules: &str) -> Vec<String> {
    let chains = chains(rules);
    let input = chains.iter().filter(|(_, chain)| chain.is_input);
    let mut reached: Vec<(&str, &str)> = input.map(|(name, _)| *name).collect();
    let mut next = 0;
    while let Some(&(table, name)) = reached.get(next) {
        next += 1;
        let chain = chains.get(&(table, name)).into_iter();
        for target in chain
            .flat_map(|chain| &chain.rules)
            .flat_map(|rule| jumps_of(rule))
        {
            let target = (table, target);
            if chains.contains_key(&target) && !reached.contains(&target) {
                reached.push(target);
            }
        }
    }
    let all = reached.iter().filter_map(|name| chains.get(name));
    let rules = all.flat_map(|chain| chain.rules.iter().map(move |rule| (chain, rule)));
    let drops = rules.filter(|(chain, rule)| {
        let lower = rule.to_lowercase();
        let is_drop = has_word(&lower, "drop") || has_word(&lower, "reject");
        // Docker protects the addresses of its containers in this way.
        let is_of_container =
            chain.is_prerouting && lower.contains("ip daddr ") && lower.contains("iifname != ");
        is_drop && !is_of_container && !has_word(&lower, "invalid")
    });
    drops
        .take(MOST_RULES)
        .map(|(_, rule)| (*rule).to_owned())
        .collect()
}

/// A chain of a firewall.
#[derive(Debug, Default)]
struct FirewallChain<'a> {
    /// True if the kernel passes incoming packets to this chain.
    is_input: bool,
    /// True if these include packets that are forwarded, such as those of containers.
    is_prerouting: bool,
    rules: Vec<&'a str>,
}

/// Parses the output of `nft list ruleset` or `iptables -S`. The key is the line that opens the
/// table (empty for iptables), and the name of the chain.
fn chains(text: &str) -> BTreeMap<(&str, &str), FirewallChain<'_>> {
    let mut chains: BTreeMap<(&str, &str), FirewallChain<'_>> = BTreeMap::new();
    let (mut table, mut open) = ("", None);
    for line in text.lines().map(str::trim) {
        let mut words = line.split_whitespace();
        let name = match (words.next(), words.next()) {
            (Some("table"), Some(_)) => {
                table = line;
                continue;
            }
            (Some("chain"), Some(name)) => {
                open = Some(name);
                continue;
            }
            (Some("}"), None) => {
                open = None;
                continue;
            }
            (Some("-P" | "-A"), Some(name)) => name,
            _ => match open {
                Some(name) => name,
                None => continue,
            },
        };
        let chain = chains.entry((table, name)).or_default();
        let hooks = ["hook input", "hook prerouting", "hook ingress"];
        chain.is_input |= (table.is_empty() && name == "INPUT")
            || (line.starts_with("type ") && hooks.iter().any(|hook| line.contains(hook)));
        chain.is_prerouting |= line.starts_with("type ") && line.contains("hook prerouting");
        chain.rules.push(line);
    }
    chains
}

/// Returns the chains to which a rule jumps; a verdict map has several.
fn jumps_of(rule: &str) -> Vec<&str> {
    let is_edge = |c: char| c.is_whitespace() || [',', ';', '{', '}'].contains(&c);
    let words = rule.split(is_edge).filter(|word| !word.is_empty());
    let pairs = words.clone().zip(words.skip(1));
    let jumps = pairs.filter(|(word, _)| ["jump", "goto", "-j", "-g"].contains(word));
    jumps.map(|(_, target)| target).collect()
}

fn has_word(line: &str, word: &str) -> bool {
    line.match_indices(word).any(|(at, _)| {
        let before = line.get(..at).and_then(|text| text.chars().next_back());
        let after = line
            .get(at + word.len()..)
            .and_then(|text| text.chars().next());
        let is_edge = |c: Option<char>| c.is_none_or(|c| !c.is_alphanumeric() && c != '_');
        is_edge(before) && is_edge(after)
    })
}

/// Runs a program that lists settings; `None` if it is missing, fails, or takes too long.
pub(super) fn output(program: &str, arguments: &[&str]) -> Option<String> {
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .ok()?;
    let stdout = child.stdout.take()?;
    let (send, receive) = mpsc::sync_channel(1);
    let reader = std::thread::spawn(move || {
        let mut text = Vec::new();
        let read = stdout.take(MOST_OUTPUT).read_to_end(&mut text);
        // The receiver is gone after the time limit.
        let _late = send.send(read.is_ok().then_some(text));
    });
    let text = receive.recv_timeout(OUTPUT_TIME).ok().flatten();
    if text.is_none() {
        let _killed = child.kill();
    }
    let status = child.wait().ok();
    let _ended = reader.join();
    // A program ends by a broken pipe when its output is cut.
    let text = text.filter(|text| {
        let is_cut = u64::try_from(text.len()).is_ok_and(|length| length >= MOST_OUTPUT);
        is_cut || status.is_some_and(|status| status.success())
    })?;
    Some(String::from_utf8_lossy(&text).into_owned())
}

#[expect(clippy::disallowed_methods, reason = "the age of certificates")]
pub(super) fn unix_seconds() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.unwrap_or_default().as_secs()
}

/// The time limit of a program that lists settings.
const OUTPUT_TIME: Duration = Duration::from_secs(3);
const MOST_OUTPUT: u64 = 1 << 20;
const MOST_RULES: usize = 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_of_the_kernel_are_read() {
        let igmp = "Idx\tDevice    : Count Querier\tGroup    Users Timer\tReporter\n1\tlo        :     1      V3\n\t\t\t\t010000E0     1 0:00000000\t\t0\n2\teth0      :     2      V3\n\t\t\t\t2800C0EF     1 0:00000000\t\t0\n";
        let found = memberships(igmp);
        assert_eq!(found["lo"], [Ipv4Addr::new(224, 0, 0, 1)]);
        assert_eq!(found["eth0"], [Ipv4Addr::new(239, 192, 0, 40)]);
        let table = "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\nlo\t000000E0\t00000000\t0001\t0\t0\t0\t000000F0\n";
        let route = &routes(table)[0];
        assert_eq!((route.destination, route.mask), (0xE000_0000, 0xF000_0000));
        let snmp = "Ip: Forwarding ReasmFails FragOKs\nIp: 2 17 0\nUdp: a\nUdp: 1\n";
        assert_eq!(reassembly_failures(snmp), 17);
        assert_eq!(reassembly_failures(""), 0);
    }

    #[test]
    fn rules_that_drop_input_are_found() {
        let nft = "table inet filter {\n\tchain input {\n\t\ttype filter hook input priority 0; policy drop;\n\t\tudp dport 4840 accept\n\t\tip daddr 239.0.0.0/8 drop\n\t}\n\tchain forward {\n\t\ttype filter hook forward priority 0; policy drop;\n\t}\n}\n";
        let found = dropping(nft);
        assert_eq!(found.len(), 2, "{found:?}");
        let tables =
            "-P INPUT DROP\n-P FORWARD DROP\n-A INPUT -p udp -j REJECT\n-A INPUT -i lo -j ACCEPT\n";
        let expected = ["-P INPUT DROP", "-A INPUT -p udp -j REJECT"];
        assert_eq!(dropping(tables), expected);
        assert!(dropping("counter packets 0 dropped").is_empty());
    }

    #[test]
    fn rules_for_forwarded_packets_and_invalid_connections_are_no_fault() {
        // Docker adds chains of this kind on each host.
        let docker = "-P INPUT ACCEPT\n-P FORWARD DROP\n-N DOCKER\n-A FORWARD -j DOCKER\n-A DOCKER -o docker0 -j DROP\n";
        assert_eq!(dropping(docker), Vec::<String>::new());
        let nft = "table ip filter {\n\tchain DOCKER {\n\t\toifname \"docker0\" counter packets 0 bytes 0 drop\n\t}\n\tchain FORWARD {\n\t\ttype filter hook forward priority filter; policy drop;\n\t\tjump DOCKER\n\t}\n\tchain INPUT {\n\t\ttype filter hook input priority filter; policy accept;\n\t\tct state invalid drop\n\t}\n}\n";
        assert_eq!(dropping(nft), Vec::<String>::new());
    }

    #[test]
    fn rules_of_a_chain_to_which_the_input_jumps_are_found() {
        let ufw = "-P INPUT ACCEPT\n-N ufw-input\n-N ufw-end\n-A INPUT -j ufw-input\n-A ufw-input -j ufw-end\n-A ufw-end -j DROP\n";
        assert_eq!(dropping(ufw), ["-A ufw-end -j DROP"]);
        let nft = "table inet filter {\n\tchain input {\n\t\ttype filter hook input priority filter; policy accept;\n\t\tudp dport 4840 goto cell\n\t}\n\tchain cell {\n\t\tip saddr != 10.0.0.0/8 reject\n\t\tgoto input\n\t}\n}\n";
        assert_eq!(dropping(nft), ["ip saddr != 10.0.0.0/8 reject"]);
    }

    #[test]
    fn rules_behind_a_verdict_map_are_found_and_rules_for_containers_are_not() {
        let map = "table inet filter {\n\tchain input {\n\t\ttype filter hook input priority filter; policy accept;\n\t\tiifname vmap { \"lo\" : accept, \"eth0\" : jump world, \"eth1\" : jump private }\n\t}\n\tchain world {\n\t\tudp dport 4840 drop\n\t}\n\tchain private {\n\t\tudp dport 4841 drop\n\t}\n}\n";
        assert_eq!(
            dropping(map),
            ["udp dport 4840 drop", "udp dport 4841 drop"]
        );
        let raw = "table ip raw {\n\tchain PREROUTING {\n\t\ttype filter hook prerouting priority raw; policy accept;\n\t\tip daddr 172.17.0.2 iifname != \"docker0\" counter packets 0 bytes 0 drop\n\t\tudp dport 4840 drop\n\t}\n}\n";
        assert_eq!(dropping(raw), ["udp dport 4840 drop"]);
    }
}
