//! Raw bytes on the network: the UADP group, HTTP, XML-RPC.

use std::{
    io::{Read, Write},
    net::{Ipv4Addr, SocketAddrV4, TcpStream, UdpSocket},
    os::fd::AsRawFd as _,
    time::{Duration, Instant},
};

use serde_json::Value;
use socket2::{Domain, Protocol, SockRef, Socket, Type};

/// The default group and port of the programs.
pub const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 192, 0, 40), 4840);

const PATIENCE: Duration = Duration::from_secs(5);

/// A member of the UADP group on loopback, which receives and sends raw datagrams.
pub struct UadpSocket(UdpSocket);

impl UadpSocket {
    /// Joins [`GROUP`].
    ///
    /// # Panics
    /// Panics if the socket cannot be created.
    #[must_use]
    pub fn join() -> Self {
        Self::join_on(Ipv4Addr::LOCALHOST)
    }

    /// Joins [`GROUP`] on the interface with this address.
    ///
    /// # Panics
    /// Panics if the socket cannot be created.
    #[must_use]
    pub fn join_on(interface: Ipv4Addr) -> Self {
        let socket = member(GROUP, interface);
        let options = SockRef::from(&socket);
        options.set_multicast_if_v4(&interface).unwrap();
        options.set_multicast_loop_v4(true).unwrap();
        Self(socket)
    }

    /// Receives only from the own interface. Without this, a socket also receives the group from
    /// other interfaces with members on this host.
    ///
    /// # Panics
    /// Panics if the option cannot be set.
    #[must_use]
    pub fn of_one_interface(self) -> Self {
        SockRef::from(&self.0).set_multicast_all_v4(false).unwrap();
        self
    }

    /// Sends a datagram to the group.
    ///
    /// # Panics
    /// Panics if the datagram cannot be sent.
    pub fn send(&self, datagram: &[u8]) {
        let sent = self.0.send_to(datagram, GROUP).unwrap();
        assert_eq!(sent, datagram.len());
    }

    /// Returns the next datagram of any member of the group, including this socket; `None` after
    /// `deadline`.
    ///
    /// # Panics
    /// Panics if reading fails.
    #[must_use]
    pub fn receive(&self, deadline: Duration) -> Option<Vec<u8>> {
        self.0
            .set_read_timeout(Some(deadline.max(Duration::from_millis(1))))
            .unwrap();
        let mut buffer = vec![0; 65_536];
        match self.0.recv(&mut buffer) {
            Ok(length) => {
                buffer.truncate(length);
                Some(buffer)
            }
            Err(error) if matches!(error.kind(), std::io::ErrorKind::WouldBlock) => None,
            Err(error) => panic!("the group cannot be read: {error}"),
        }
    }

    /// Returns the datagrams that arrive within `window`, and the datagrams already waiting.
    #[must_use]
    pub fn receive_for(&self, window: Duration) -> Vec<Vec<u8>> {
        let start = Instant::now();
        let mut all = Vec::new();
        while let Some(rest) = window.checked_sub(start.elapsed()) {
            all.extend(self.receive(rest));
        }
        all
    }

    /// Discards the waiting datagrams.
    pub fn drain(&self) {
        while self.receive(Duration::from_millis(1)).is_some() {}
    }
}

/// Opens a socket that receives a group on loopback, with a buffer for bursts.
///
/// # Panics
/// Panics if the socket cannot be created.
#[must_use]
pub fn group_member(group: SocketAddrV4) -> UdpSocket {
    member(group, Ipv4Addr::LOCALHOST)
}

fn member(group: SocketAddrV4, interface: Ipv4Addr) -> UdpSocket {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).unwrap();
    socket.set_reuse_address(true).unwrap();
    socket.set_recv_buffer_size(4 << 20).unwrap();
    socket.bind(&group.into()).unwrap();
    socket.join_multicast_v4(group.ip(), &interface).unwrap();
    socket.into()
}

/// Returns the number of datagrams that the kernel dropped because this socket's buffer was full.
/// This is no loss by their sender.
#[must_use]
pub fn overflowed(socket: &UdpSocket) -> Option<u64> {
    let link = std::fs::read_link(format!("/proc/self/fd/{}", socket.as_raw_fd())).ok()?;
    let inode = link.to_str()?.strip_prefix("socket:[")?.strip_suffix(']')?;
    udp_sockets()?
        .into_iter()
        .find_map(|socket| (socket.inode == inode).then_some(socket.dropped))
}

/// Returns the number of datagrams dropped because of full buffers, summed over all UDP sockets of
/// this thread's network. It includes the own datagrams of programs in [`GROUP`], which their
/// filters drop.
#[must_use]
pub fn all_overflowed() -> Option<u64> {
    let dropped = udp_sockets()?.into_iter().map(|socket| socket.dropped);
    Some(dropped.sum())
}

/// Returns the number of [`all_overflowed`] without the members of [`GROUP`].
#[must_use]
pub fn overflowed_outside_group() -> Option<u64> {
    let sockets = udp_sockets()?.into_iter();
    let others = sockets.filter(|socket| socket.port != GROUP.port());
    Some(others.map(|socket| socket.dropped).sum())
}

/// A row of `/proc/net/udp` of Linux.
struct SocketRow {
    port: u16,
    inode: String,
    dropped: u64,
}

/// Returns the UDP sockets of this thread's network: columns 2, 10 and 13 of the table.
fn udp_sockets() -> Option<Vec<SocketRow>> {
    let table = std::fs::read_to_string("/proc/thread-self/net/udp").ok()?;
    let rows = table.lines().skip(1).map(|row| {
        let mut words = row.split_whitespace();
        let (_, port) = words.nth(1)?.split_once(':')?;
        Some(SocketRow {
            port: u16::from_str_radix(port, 16).ok()?,
            inode: words.nth(7)?.to_owned(),
            dropped: words.last()?.parse().ok()?,
        })
    });
    rows.collect()
}

/// Returns the `/status` of a program, or `None` while it does not answer.
#[must_use]
pub fn metrics(address: &str) -> Option<Value> {
    serde_json::from_str(&http_get(address, "/status")?).ok()
}

/// Returns the body of a successful answer to an HTTP GET, or `None`.
#[must_use]
pub fn http_get(address: &str, path: &str) -> Option<String> {
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    exchange(address, &request)
}

/// Returns the status code and the body of any answer to an HTTP GET, or `None` without an answer.
#[must_use]
pub fn http_answer(address: &str, path: &str) -> Option<(u16, String)> {
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    answer(address, &request)
}

/// Returns the body of the answer to an XML-RPC call, or `None` without an answer. An argument is
/// text, or XML of a value.
#[must_use]
pub fn xml_rpc(address: &str, method: &str, arguments: &[&str]) -> Option<String> {
    let params: String = arguments
        .iter()
        .map(|argument| match argument.starts_with('<') {
            true => format!("<param><value>{argument}</value></param>"),
            false => format!("<param><value><string>{argument}</string></value></param>"),
        })
        .collect();
    let body = format!(
        "<?xml version=\"1.0\"?><methodCall><methodName>{method}</methodName><params>{params}</params></methodCall>"
    );
    let request = format!(
        "POST / HTTP/1.1\r\nHost: {address}\r\nContent-Type: text/xml\r\nConnection: close\r\n\
         Content-Length: {}\r\n\r\n{body}",
        body.len()
    );
    exchange(address, &request)
}

fn exchange(address: &str, request: &str) -> Option<String> {
    answer(address, request)
        .filter(|(code, _)| *code == 200)
        .map(|(_, body)| body)
}

fn answer(address: &str, request: &str) -> Option<(u16, String)> {
    let mut stream = TcpStream::connect_timeout(&address.parse().ok()?, PATIENCE).ok()?;
    stream.set_read_timeout(Some(PATIENCE)).ok()?;
    stream.write_all(request.as_bytes()).ok()?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).ok()?;
    let answer = String::from_utf8_lossy(&answer);
    let (head, body) = answer.split_once("\r\n\r\n")?;
    let code = head.split_whitespace().nth(1)?.parse().ok()?;
    let chunked = head
        .lines()
        .any(|line| line.eq_ignore_ascii_case("transfer-encoding: chunked"));
    let body = if chunked {
        unchunk(body)?
    } else {
        body.to_owned()
    };
    Some((code, body))
}

fn unchunk(mut body: &str) -> Option<String> {
    let mut whole = String::new();
    loop {
        let (size, rest) = body.split_once("\r\n")?;
        let size = usize::from_str_radix(size.split(';').next()?.trim(), 16).ok()?;
        if size == 0 {
            return Some(whole);
        }
        whole.push_str(rest.get(..size)?);
        body = rest.get(size..)?.strip_prefix("\r\n")?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_body_in_chunks_is_put_together() {
        assert_eq!(
            unchunk("4\r\n{\"a\"\r\n3;x=y\r\n:1}\r\n0\r\n\r\n").as_deref(),
            Some("{\"a\":1}")
        );
    }

    #[test]
    fn a_body_cut_in_a_chunk_is_none() {
        assert_eq!(unchunk("9\r\n{\"a\"\r\n"), None);
    }
}
