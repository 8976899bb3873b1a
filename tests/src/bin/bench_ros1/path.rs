//! The relays: the echo, `tcpros`, roscpp, rospy, rosrust.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::ExitCode;
use std::time::Duration;

use rustix::event::epoll;
use system_tests::{BareNode, BareSubscription, Cell, Child, StartedChild, processor_time};

use crate::lane::PathLane;

/// A relay with both ends of its only lane.
pub(crate) struct RelayPath {
    pub(crate) name: &'static str,
    pub(crate) lane: PathLane,
    relay: Child,
}

impl RelayPath {
    /// Starts all relays, the echo first.
    pub(crate) fn all(cell: &Cell) -> Vec<Self> {
        let node = BareNode::start("/bench");
        vec![
            Self::echo(),
            Self::through(&node, "tcpros `relay`", |pair| {
                cell.tcpros_relay("relay", std::slice::from_ref(pair))
            }),
            Self::through(&node, "roscpp `topic_tools relay`", |(input, output)| {
                cell.topic_tools_relay(input, output)
            }),
            Self::through(&node, "rospy relay", |(input, output)| {
                cell.rospy("ros1_relay.py", &[input, output])
            }),
            Self::through(&node, "rosrust relay", |(input, output)| {
                cell.rosrust(&["relay", input, output])
            }),
        ]
    }

    fn through(
        node: &BareNode,
        name: &'static str,
        start: impl FnOnce(&(String, String)) -> Child,
    ) -> Self {
        let word = name.split(' ').next().unwrap_or(name);
        let pair = (format!("/{word}_in"), format!("/{word}_out"));
        let relay = start(&pair);
        let lane = PathLane::through(node, &[pair]).remove(0);
        Self { name, lane, relay }
    }

    fn echo() -> Self {
        let me = std::env::current_exe().unwrap();
        let mut relay = StartedChild::new("echo", &me).args(["echo"]).start();
        let address = relay.wait_for_line("127.0.0.1:", Duration::from_secs(10));
        let input = TcpStream::connect(&address).unwrap();
        input.set_nodelay(true).unwrap();
        let output = BareSubscription::of(TcpStream::connect(&address).unwrap());
        Self {
            name: "raw TCP echo",
            lane: PathLane::of(input, output),
            relay,
        }
    }

    pub(crate) fn processor_time(&self) -> Duration {
        processor_time(self.relay.id())
    }
}

/// Runs an echo of many lanes: data received on a connection is sent to the next connection, in the
/// order of a readiness queue. Connections are taken in pairs, input first.
pub(crate) fn echo_many(lanes: usize) -> ExitCode {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    println!("{}", listener.local_addr().unwrap());
    let ready = epoll::create(epoll::CreateFlags::CLOEXEC).unwrap();
    let mut pairs = Vec::with_capacity(lanes);
    for lane in 0..lanes {
        let (input, _) = listener.accept().unwrap();
        let (output, _) = listener.accept().unwrap();
        output.set_nodelay(true).unwrap();
        let data = epoll::EventData::new_u64(lane as u64);
        epoll::add(&ready, &input, data, epoll::EventFlags::IN).unwrap();
        pairs.push((input, output));
    }
    let mut events = Vec::with_capacity(64);
    let mut buffer = vec![0; 65_536];
    let mut open = lanes;
    while open > 0 {
        epoll::wait(&ready, rustix::buffer::spare_capacity(&mut events), None).unwrap();
        for event in events.drain(..) {
            let lane = usize::try_from(event.data.u64()).unwrap();
            let (input, output) = &mut pairs[lane];
            match input.read(&mut buffer) {
                Ok(length @ 1..) if output.write_all(&buffer[..length]).is_ok() => {}
                _ => {
                    epoll::delete(&ready, &*input).unwrap();
                    open -= 1;
                }
            }
        }
    }
    ExitCode::SUCCESS
}

/// Runs the echo: frames in from the first connection, out to the second, with as few calls as
/// possible.
pub(crate) fn echo() -> ExitCode {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    println!("{}", listener.local_addr().unwrap());
    let (input, _) = listener.accept().unwrap();
    let (mut output, _) = listener.accept().unwrap();
    output.set_nodelay(true).unwrap();
    // Waits as long as the other end stays connected.
    let mut frames = BareSubscription::of(input);
    frames.wait_without_end();
    while let Ok(frame) = frames.receive_frame() {
        if output.write_all(frame).is_err() {
            break;
        }
    }
    ExitCode::SUCCESS
}
