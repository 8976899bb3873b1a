//! Preconditions of a scenario: the other programs in the directory, and free ports.

use std::net::{Ipv4Addr, TcpListener, UdpSocket};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::{fs, io};

use super::DemoFailure;

/// Returns the paths of this program and of other programs in the same directory, in the order of
/// their names.
pub(crate) fn find<const N: usize>(
    names: [&str; N],
) -> Result<(PathBuf, [PathBuf; N]), DemoFailure> {
    let demo = std::env::current_exe().map_err(DemoFailure::io("the demo cannot find itself"))?;
    let suffix = std::env::consts::EXE_SUFFIX;
    let beside = names.map(|name| demo.with_file_name(format!("{name}{suffix}")));
    let missing: Vec<PathBuf> = beside
        .iter()
        .filter(|path| !path.is_file())
        .cloned()
        .collect();
    if missing.is_empty() {
        Ok((demo, beside))
    } else {
        Err(DemoFailure::Missing(missing))
    }
}

/// Checks that a port is free, before the program that needs it fails with a longer message.
pub(crate) fn must_be_free(port: u16, program: &'static str) -> Result<(), DemoFailure> {
    TcpListener::bind((Ipv4Addr::LOCALHOST, port))
        .map(drop)
        .map_err(|_| DemoFailure::PortTaken { port, program })
}

/// Returns a port of 127.0.0.1 for a program of the scenario. It stays reserved until the demo
/// ends, and no connection uses it as its own port before the program listens.
pub(crate) fn free_port() -> Result<u16, DemoFailure> {
    let range = fs::read_to_string("/proc/sys/net/ipv4/ip_local_port_range");
    let ports = listener_ports(range.as_deref().unwrap_or_default());
    let start = usize::try_from(std::process::id()).unwrap_or_default();
    let start = start.wrapping_mul(SPREAD) % ports.len().max(1);
    let mut reserved = RESERVED.lock().unwrap_or_else(PoisonError::into_inner);
    let mut last = io::Error::from(io::ErrorKind::AddrInUse);
    for port in ports.clone().skip(start).chain(ports.take(start)) {
        match reservation(port) {
            Ok(reservation) => {
                reserved.push(reservation);
                return Ok(port);
            }
            Err(error) => last = error,
        }
    }
    Err(DemoFailure::io("no free port on 127.0.0.1")(last))
}

/// Reserves a TCP port if it is free. The reservation is a UDP socket of the same number: it does
/// not keep a program from listening, and no other demo gets the port.
fn reservation(port: u16) -> io::Result<UdpSocket> {
    let reservation = UdpSocket::bind((Ipv4Addr::LOCALHOST, port))?;
    TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map(|_| reservation)
}

/// Returns ports that the kernel gives to no outgoing connection. `range` has the first and the
/// last port that it gives.
fn listener_ports(range: &str) -> RangeInclusive<u16> {
    let mut ends = range.split_whitespace().map(str::parse::<u16>);
    let (first, last) = match (ends.next(), ends.next()) {
        (Some(Ok(first)), Some(Ok(last))) => (first, last),
        _ => (32_768, 60_999),
    };
    match (first.checked_sub(1), last.checked_add(1)) {
        (Some(below), _) if below >= LEAST + ENOUGH => LEAST..=below,
        (_, Some(above)) if u16::MAX - above >= ENOUGH => above..=u16::MAX,
        // The kernel gives nearly all ports: none is safe.
        (Some(_) | None, _) => LEAST..=u16::MAX,
    }
}

/// The reservations of this demo.
static RESERVED: Mutex<Vec<UdpSocket>> = Mutex::new(Vec::new());
/// The first port that is reserved: well-known services and OPC UA servers are below it.
const LEAST: u16 = 12_000;
/// The least number of ports to choose from.
const ENOUGH: u16 = 1_000;
/// Distance of the first ports of two demos with process numbers that follow each other.
const SPREAD: usize = 97;

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn ports_are_outside_of_the_range_of_outgoing_connections() {
        assert_eq!(listener_ports("32768\t60999\n"), LEAST..=32_767);
        assert_eq!(listener_ports("1024 50000"), 50_001..=u16::MAX);
        assert_eq!(listener_ports("1024 65535"), LEAST..=u16::MAX);
        assert_eq!(listener_ports("none"), LEAST..=32_767);
    }

    #[test]
    fn a_port_is_given_once_and_a_program_can_listen_on_it() {
        let ports: Vec<u16> = (0..40).map(|_| free_port().unwrap()).collect();
        let different: BTreeSet<u16> = ports.iter().copied().collect();
        assert_eq!(different.len(), ports.len());
        for port in ports {
            let _listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).unwrap();
            assert!(
                reservation(port).is_err(),
                "another demo does not get {port}"
            );
        }
    }

    #[test]
    fn a_port_on_which_another_program_listens_is_not_given() {
        let other = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let port = other.local_addr().unwrap().port();
        assert!(reservation(port).is_err());
    }
}
