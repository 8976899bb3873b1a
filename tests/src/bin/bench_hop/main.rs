//! `cargo xtask bench hop`: the duration of a hop through each bridge, compared with a raw relay
//! and roscpp's relay.
//!
//! A single process sends a message into a path and waits for it at the other end, one at a time.
//! The paths take turns, so that all of them see the same machine. The lower bound is the minimum
//! between ROS 1 and UADP: a program that reads frames from a TCP connection and sends each as a
//! UDP multicast datagram with blocking calls.

mod dds;
mod ros1;

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use socket2::{Domain, Protocol, Socket, Type};
use system_tests::{BareNode, Cell, PATIENCE, Peer, StartedChild, group_member, string_frame};
use uadp::{DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar};

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.first().map(String::as_str) {
        Some("relay") => relay(&args[1..]),
        Some("--help" | "-h") => {
            println!("bench-hop [ROUNDS]   messages per path and size, 3000 unless told");
            ExitCode::SUCCESS
        }
        rounds => bench(
            rounds
                .and_then(|rounds| rounds.parse().ok())
                .unwrap_or(3000),
        ),
    }
}

/// Runs the lower bound: frames in, datagrams out.
fn relay(args: &[String]) -> ExitCode {
    let group: SocketAddrV4 = args[0].parse().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    println!("{}", listener.local_addr().unwrap());
    let (mut stream, _) = listener.accept().unwrap();
    stream.set_nodelay(true).unwrap();
    let out = sender();
    let mut buffer = vec![0; 70_000];
    let mut length = [0; 4];
    while stream.read_exact(&mut length).is_ok() {
        let length = u32::from_le_bytes(length) as usize;
        stream.read_exact(&mut buffer[..length]).unwrap();
        out.send_to(&buffer[..length], group).unwrap();
    }
    ExitCode::SUCCESS
}

/// A path of a message from this process and back to it.
trait Path {
    fn name(&self) -> &'static str;
    /// Sends the text and waits until it arrives. The number is in the text.
    fn pass(&mut self, text: &str);
}

fn bench(rounds: usize) -> ExitCode {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return ExitCode::FAILURE;
    };
    let _core = cell.roscore();
    let mut floor = Floor::new();
    let (mut relay, _relay) = ros1::TopicToolsRelay::new(&cell);
    let mut bridge1 = Bridge1::new(&cell);
    let mut bridge2 = Bridge2::new(&cell);
    println!(
        "one message at a time, {rounds} per size and path, the paths in turn; microseconds\n"
    );
    println!("| payload | path | p50 | p99 | p50 / floor | p99 / floor |");
    println!("|---|---|---|---|---|---|");
    for (size, shown) in [(16, "16 B"), (1024, "1 KiB"), (64_000, "64 kB")] {
        let mut paths: [(&mut dyn Path, Vec<f64>); 4] = [
            (&mut floor, Vec::new()),
            (&mut relay, Vec::new()),
            (&mut bridge1, Vec::new()),
            (&mut bridge2, Vec::new()),
        ];
        let warm_up = rounds / 10;
        for round in 0..rounds + warm_up {
            let text = format!("{round:0>size$}");
            for (path, times) in &mut paths {
                let start = Instant::now();
                path.pass(&text);
                let time = start.elapsed();
                if round >= warm_up {
                    times.push(time.as_secs_f64() * 1e6);
                }
            }
        }
        print(shown, &mut paths);
    }
    ExitCode::SUCCESS
}

fn print(size: &str, paths: &mut [(&mut dyn Path, Vec<f64>)]) {
    let mut floor = None;
    for (path, times) in paths {
        times.sort_by(f64::total_cmp);
        let at = |share: f64| times[((times.len() - 1) as f64 * share) as usize];
        let (p50, p99) = (at(0.5), at(0.99));
        let (floor50, floor99) = *floor.get_or_insert((p50, p99));
        println!(
            "| {size} | {} | {p50:.1} | {p99:.1} | {:.2} | {:.2} |",
            path.name(),
            p50 / floor50,
            p99 / floor99
        );
    }
}

struct Floor {
    stream: TcpStream,
    receiver: UdpSocket,
    buffer: Vec<u8>,
    _relay: system_tests::Child,
}

impl Floor {
    fn new() -> Self {
        let group = SocketAddrV4::new(Ipv4Addr::new(239, 192, 0, 41), 4841);
        let me = std::env::current_exe().unwrap();
        let mut relay = StartedChild::new("floor", &me)
            .args(["relay".to_owned(), group.to_string()])
            .start();
        let address = relay.wait_for_line("127.0.0.1:", Duration::from_secs(10));
        let address = address.split_whitespace().last().unwrap().to_owned();
        let stream = TcpStream::connect(address).unwrap();
        stream.set_nodelay(true).unwrap();
        Self {
            stream,
            receiver: receiver(group),
            buffer: vec![0; 70_000],
            _relay: relay,
        }
    }
}

impl Path for Floor {
    fn name(&self) -> &'static str {
        "floor: raw TCP in, UDP multicast out"
    }

    fn pass(&mut self, text: &str) {
        self.stream.write_all(&string_frame(text)).unwrap();
        until(&self.receiver, &mut self.buffer, text);
    }
}

/// ROS 1 in, UADP out.
struct Bridge1 {
    publisher: TcpStream,
    receiver: UdpSocket,
    buffer: Vec<u8>,
    _bridge: system_tests::Child,
}

impl Bridge1 {
    fn new(cell: &Cell) -> Self {
        let group = SocketAddrV4::new(Ipv4Addr::new(239, 192, 0, 42), 4842);
        let bridge = cell.bridge_ros1(&["--address", &format!("opc.udp://{group}")]);
        let node = BareNode::start("/bench_bridge");
        let publisher = node.publish(&["/ua_1_5_10".to_owned()]).remove(0);
        Self {
            publisher,
            receiver: receiver(group),
            buffer: vec![0; 70_000],
            _bridge: bridge,
        }
    }
}

impl Path for Bridge1 {
    fn name(&self) -> &'static str {
        "bridge-ros1: ROS 1 in, UADP out"
    }

    fn pass(&mut self, text: &str) {
        self.publisher.write_all(&string_frame(text)).unwrap();
        until(&self.receiver, &mut self.buffer, text);
    }
}

/// UADP in, DDS out.
struct Bridge2 {
    sender: UdpSocket,
    group: SocketAddrV4,
    datagram: Vec<u8>,
    sequence: u16,
    reader: dds::DdsReader,
    _bridge: system_tests::Child,
}

impl Bridge2 {
    fn new(cell: &Cell) -> Self {
        let group = SocketAddrV4::new(Ipv4Addr::new(239, 192, 0, 43), 4843);
        let reader = dds::DdsReader::new("rt/ua_1_5_11");
        let bridge = cell.bridge_ros2(&["--address", &format!("opc.udp://{group}")]);
        let mut path = Self {
            sender: sender(),
            group,
            datagram: Vec::new(),
            sequence: 0,
            reader,
            _bridge: bridge,
        };
        let text = "are you there";
        system_tests::eventually(
            "bridge-ros2 carries a first message",
            Duration::from_secs(20),
            || {
                path.send(text);
                path.reader
                    .wait_for(text, Duration::from_millis(200))
                    .then_some(())
            },
        );
        path
    }

    fn send(&mut self, text: &str) {
        self.datagram.clear();
        self.sequence = self.sequence.wrapping_add(1);
        let header = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(1)),
            group: Some(GroupHeader {
                writer_group_id: Some(5),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        };
        let mut message =
            NetworkMessageEncoder::new(&mut self.datagram, &header, Some(&[11])).unwrap();
        let sequence_number = Some(self.sequence);
        let mut frame = message
            .key_frame(&DataSetHeader {
                sequence_number,
                ..DataSetHeader::default()
            })
            .unwrap();
        frame.scalar(Scalar::String(Some(text))).unwrap();
        frame.finish().unwrap();
        message.finish().unwrap();
        self.sender.send_to(&self.datagram, self.group).unwrap();
    }
}

impl Path for Bridge2 {
    fn name(&self) -> &'static str {
        "bridge-ros2: UADP in, DDS out"
    }

    fn pass(&mut self, text: &str) {
        self.send(text);
        assert!(
            self.reader.wait_for(text, PATIENCE),
            "bridge-ros2 lost {}",
            &text[..16]
        );
    }
}

/// Reads datagrams until a datagram ends with the text.
fn until(receiver: &UdpSocket, buffer: &mut [u8], text: &str) {
    loop {
        let length = receiver
            .recv(buffer)
            .unwrap_or_else(|error| panic!("{} was lost: {error}", &text[..16]));
        if buffer[..length].ends_with(text.as_bytes()) {
            return;
        }
    }
}

fn receiver(group: SocketAddrV4) -> UdpSocket {
    let socket = group_member(group);
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    socket
}

fn sender() -> UdpSocket {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).unwrap();
    socket.set_multicast_if_v4(&Ipv4Addr::LOCALHOST).unwrap();
    socket.set_multicast_ttl_v4(0).unwrap();
    socket
        .bind(&SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0).into())
        .unwrap();
    socket.into()
}
