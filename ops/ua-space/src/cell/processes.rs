//! The programs of the project that run on this host, from `/proc`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use serde::Serialize;

/// A running program of this project in the network namespace of the caller.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct LocalProcess {
    pub(crate) pid: u32,
    /// The name of the program, as `bridge-ros1`.
    pub(crate) program: String,
    /// The addresses at which it listens for TCP connections.
    pub(crate) listening: Vec<SocketAddr>,
    /// The addresses of `listening` that may serve its status page. A request to any other port is
    /// an error in the log of the program.
    #[serde(skip)]
    pub(crate) status_at: Vec<SocketAddr>,
    /// The local addresses of its UDP sockets.
    pub(crate) udp: Vec<SocketAddr>,
    pub(crate) uptime_s: Option<u64>,
    pub(crate) open_files: usize,
    /// The limit of open files.
    pub(crate) most_open_files: Option<u64>,
}

/// A UDP socket of this host.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct UdpSocket {
    pub(crate) local: SocketAddr,
    pub(crate) inode: u64,
    /// Datagrams that were dropped because the receive buffer was full.
    pub(crate) drops: u64,
    /// The process with the socket, if it is readable.
    pub(crate) pid: Option<u32>,
    pub(crate) command: String,
}

/// Reads the programs and the UDP sockets below a root: `/proc` is `<root>/proc`.
pub(crate) fn read(root: &Path) -> (Vec<LocalProcess>, Vec<UdpSocket>) {
    let proc = root.join("proc");
    let mut udp = sockets(&proc, "udp");
    udp.extend(sockets(&proc, "udp6"));
    let mut tcp = sockets(&proc, "tcp");
    tcp.extend(sockets(&proc, "tcp6"));
    let owners = owners(&proc);
    let mut programs = Vec::new();
    for pid in pids(&proc) {
        let folder = proc.join(pid.to_string());
        let Some(program) = program(&folder) else {
            continue;
        };
        if !is_same_network(&proc, &folder) {
            continue;
        }
        let of = |rows: &[ProcSocket]| -> Vec<SocketAddr> {
            let own = rows
                .iter()
                .filter(|row| owners.get(&row.inode) == Some(&pid));
            let all: BTreeSet<SocketAddr> = own.map(|row| row.local).collect();
            all.into_iter().collect()
        };
        let listening: Vec<ProcSocket> = tcp
            .iter()
            .filter(|row| row.state == LISTEN)
            .cloned()
            .collect();
        let limits = fs::read_to_string(folder.join("limits")).unwrap_or_default();
        let listening = of(&listening);
        let words = |file: &str| fs::read(folder.join(file)).map(|bytes| split(&bytes)).ok();
        let arguments = words("cmdline").unwrap_or_default();
        let status = StatusPort::of(&program, &arguments, words("environ").as_deref());
        programs.push(LocalProcess {
            pid,
            program,
            status_at: status.among(&listening),
            listening,
            udp: of(&udp),
            uptime_s: uptime(&proc, &folder),
            open_files: fs::read_dir(folder.join("fd")).map_or(0, Iterator::count),
            most_open_files: most_open_files(&limits),
        });
    }
    let sockets = udp.into_iter().map(|row| {
        let pid = owners.get(&row.inode).copied();
        UdpSocket {
            local: row.local,
            inode: row.inode,
            drops: row.drops,
            pid,
            command: pid.map(|pid| command(&proc, pid)).unwrap_or_default(),
        }
    });
    (programs, sockets.collect())
}

/// Returns the texts of a file of `/proc` that separates them by zero bytes.
fn split(bytes: &[u8]) -> Vec<String> {
    let text = String::from_utf8_lossy(bytes);
    text.split('\0').map(str::to_owned).collect()
}

/// The port at which a program serves its status page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StatusPort {
    At(u16),
    /// The program was started without a status page.
    None,
    Unknown,
}

impl StatusPort {
    /// Returns the port that the arguments name, or else the environment, which only root and the
    /// user of the program can read.
    fn of(program: &str, arguments: &[String], environment: Option<&[String]>) -> Self {
        let mut words = arguments.iter().map(String::as_str);
        let named = words.find_map(|word| word.strip_prefix("--metrics"));
        let named = match named {
            Some("") => words.next(),
            Some(value) => value.strip_prefix('='),
            None => environment
                .unwrap_or_default()
                .iter()
                .find_map(|setting| setting.strip_prefix("UA_METRICS=")),
        };
        let address = named.map(|text| text.parse::<SocketAddr>());
        match (address, environment) {
            // Port 0 stands for any free port.
            (Some(Ok(address)), _) if address.port() > 0 => Self::At(address.port()),
            (None, Some(_)) if !WITH_OTHER_PAGES.contains(&program) => Self::None,
            (Some(_) | None, _) => Self::Unknown,
        }
    }

    fn among(self, listening: &[SocketAddr]) -> Vec<SocketAddr> {
        let all = listening.iter().copied();
        all.filter(|address| match self {
            Self::At(port) => address.port() == port,
            Self::None => false,
            Self::Unknown => true,
        })
        .collect()
    }
}

fn pids(proc: &Path) -> Vec<u32> {
    let entries = fs::read_dir(proc).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    let mut pids: Vec<u32> = names.collect();
    pids.sort_unstable();
    pids
}

/// Returns the process with each socket, by inode.
fn owners(proc: &Path) -> BTreeMap<u64, u32> {
    let mut owners = BTreeMap::new();
    for pid in pids(proc) {
        for inode in open_sockets(&proc.join(pid.to_string())) {
            owners.entry(inode).or_insert(pid);
        }
    }
    owners
}

/// Returns the inodes of the open sockets of a process.
fn open_sockets(process: &Path) -> impl Iterator<Item = u64> {
    let entries = fs::read_dir(process.join("fd")).into_iter().flatten();
    entries.flatten().filter_map(|entry| {
        let target = fs::read_link(entry.path()).ok()?;
        let inode = target.to_str()?.strip_prefix("socket:[")?;
        inode.strip_suffix(']')?.parse().ok()
    })
}

/// Returns the number of datagrams that the kernel dropped because a UDP socket of this process was
/// full.
pub(crate) fn own_drops() -> u64 {
    let proc = Path::new("/proc");
    let own: BTreeSet<u64> = open_sockets(&proc.join("self")).collect();
    let rows = sockets(proc, "udp").into_iter();
    let rows = rows.filter(|row| own.contains(&row.inode));
    rows.map(|row| row.drops).sum()
}

/// Returns the name of a program of this project from its command line.
fn program(folder: &Path) -> Option<String> {
    let line = fs::read(folder.join("cmdline")).ok()?;
    let line = String::from_utf8_lossy(&line);
    named(&mut line.split('\0'))
}

fn named(words: &mut dyn Iterator<Item = &str>) -> Option<String> {
    let path = PathBuf::from(words.next()?);
    let name = path.file_name()?.to_str()?.to_owned();
    let name = match name.as_str() {
        "ua-bridge" => format!("ua-{}", words.next()?),
        _ => name,
    };
    PROGRAMS.contains(&name.as_str()).then_some(name)
}

/// Returns the name of any process.
fn command(proc: &Path, pid: u32) -> String {
    let name = fs::read_to_string(proc.join(pid.to_string()).join("comm"));
    name.unwrap_or_default().trim().to_owned()
}

fn is_same_network(proc: &Path, folder: &Path) -> bool {
    let of = |folder: &Path| fs::read_link(folder.join("ns/net")).ok();
    match (of(&proc.join("self")), of(folder)) {
        (Some(own), Some(other)) => own == other,
        _ => true,
    }
}

/// Returns the seconds since the start of a process.
fn uptime(proc: &Path, folder: &Path) -> Option<u64> {
    let stat = fs::read_to_string(folder.join("stat")).ok()?;
    // The second field is the name in parentheses, which may contain spaces.
    let (_, rest) = stat.rsplit_once(')')?;
    let started: u64 = rest.split_whitespace().nth(19)?.parse().ok()?;
    let system = fs::read_to_string(proc.join("uptime")).ok()?;
    let system = system.split('.').next()?.parse::<u64>().ok()?;
    Some(system.saturating_sub(started / TICKS))
}

fn most_open_files(limits: &str) -> Option<u64> {
    let line = limits
        .lines()
        .find(|line| line.starts_with("Max open files"))?;
    line.split_whitespace().nth(3)?.parse().ok()
}

/// A row of `/proc/net/udp` or `/proc/net/tcp`.
#[derive(Debug, Clone, PartialEq)]
struct ProcSocket {
    local: SocketAddr,
    state: u8,
    inode: u64,
    drops: u64,
}

fn sockets(proc: &Path, table: &str) -> Vec<ProcSocket> {
    let path = proc.join("net").join(table);
    let text = fs::read_to_string(path).unwrap_or_default();
    text.lines().skip(1).filter_map(row).collect()
}

fn row(line: &str) -> Option<ProcSocket> {
    let words: Vec<&str> = line.split_whitespace().collect();
    Some(ProcSocket {
        local: address(words.get(1)?)?,
        state: u8::from_str_radix(words.get(3)?, 16).ok()?,
        inode: words.get(9)?.parse().ok()?,
        drops: words
            .get(12)
            .and_then(|drops| drops.parse().ok())
            .unwrap_or_default(),
    })
}

/// Parses an address as `0100007F:12E8`: words of 32 bits in the byte order of the host.
fn address(text: &str) -> Option<SocketAddr> {
    let (ip, port) = text.split_once(':')?;
    let port = u16::from_str_radix(port, 16).ok()?;
    let word = |at: usize| u32::from_str_radix(ip.get(at..at + 8)?, 16).ok();
    let ip = match ip.len() {
        8 => IpAddr::V4(Ipv4Addr::from(word(0)?.to_ne_bytes())),
        32 => {
            let mut bytes = [0; 16];
            for (at, part) in bytes.chunks_exact_mut(4).enumerate() {
                part.copy_from_slice(&word(at * 8)?.to_ne_bytes());
            }
            IpAddr::from(bytes)
        }
        _ => return None,
    };
    Some(SocketAddr::new(ip, port))
}

/// The programs with a part in a cell.
const PROGRAMS: [&str; 9] = [
    "bridge-ros1",
    "bridge-ros2",
    "ua-server",
    "ua-cell",
    "ua-component",
    "ua-lds",
    "ua-gds",
    "ua-station",
    "ua-mes",
];
/// Programs with a status page without `--metrics`: `ua-mes` has it beside its questions.
const WITH_OTHER_PAGES: [&str; 2] = ["ua-mes", "ua-cell"];
/// The state of a listening TCP socket.
const LISTEN: u8 = 0x0A;
/// Clock ticks per second in `/proc`, which is 100 on all architectures of Linux.
const TICKS: u64 = 100;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn programs_are_known_by_their_links_and_by_the_word_after_ua_bridge() {
        let of = |line: &str| named(&mut line.split(' '));
        assert_eq!(
            of("/usr/bin/bridge-ros1 cell.yaml").as_deref(),
            Some("bridge-ros1")
        );
        assert_eq!(of("ua-bridge server").as_deref(), Some("ua-server"));
        assert_eq!(of("ua-bridge cell cell.yaml").as_deref(), Some("ua-cell"));
        assert_eq!(of("ua-bridge space list"), None);
        assert_eq!(of("/bin/bash"), None);
    }

    #[test]
    fn only_the_port_of_the_status_page_is_requested() {
        let words = |text: &str| -> Vec<String> { text.split(' ').map(str::to_owned).collect() };
        let of = |line: &str, environment: Option<&str>| {
            let environment = environment.map(words);
            StatusPort::of("bridge-ros1", &words(line), environment.as_deref())
        };
        let set = Some("HOME=/root UA_METRICS=127.0.0.1:9101");
        let nothing = Some("HOME=/root");
        let line = "bridge-ros1 cell.yaml --metrics 127.0.0.1:9102";
        assert_eq!(of(line, set), StatusPort::At(9102));
        assert_eq!(
            of("bridge-ros1 --metrics=0.0.0.0:9102", None),
            StatusPort::At(9102)
        );
        assert_eq!(of("bridge-ros1", set), StatusPort::At(9101));
        assert_eq!(of("bridge-ros1", nothing), StatusPort::None);
        assert_eq!(of("bridge-ros1", None), StatusPort::Unknown);
        assert_eq!(
            of("bridge-ros1 --metrics 127.0.0.1:0", set),
            StatusPort::Unknown
        );
        let mes = StatusPort::of("ua-mes", &words("ua-mes mes.yaml"), Some(&words("HOME=/")));
        assert_eq!(mes, StatusPort::Unknown);
        let listening = ["127.0.0.1:4840", "127.0.0.1:9102"].map(|text| text.parse().unwrap());
        assert_eq!(StatusPort::At(9102).among(&listening), listening[1..]);
        assert_eq!(StatusPort::None.among(&listening), []);
        assert_eq!(StatusPort::Unknown.among(&listening), listening);
    }

    #[test]
    fn sockets_and_limits_are_read_from_the_tables_of_the_kernel() {
        let line = "  1: 0100007F:12E8 00000000:0000 0A 00000000:00000000 00:00000000 00000000 0 0 4711 2 0000000000000000 7";
        let row = row(line).unwrap();
        assert_eq!(row.local, "127.0.0.1:4840".parse().unwrap());
        assert_eq!((row.state, row.inode, row.drops), (LISTEN, 4711, 7));
        let six = address("00000000000000000000000001000000:0050").unwrap();
        assert_eq!(six, "[::1]:80".parse().unwrap());
        assert_eq!(address("nonsense"), None);
        let limits = "Limit  Soft Limit  Hard Limit  Units\nMax open files            1024                 524288               files\n";
        assert_eq!(most_open_files(limits), Some(1024));
    }
}
