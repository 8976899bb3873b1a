//! The cost of a message in a relay that carries few topics or many, at the same total rate. It is
//! compared with an echo of as many connections that does nothing else.

use std::net::TcpStream;
use std::time::Duration;

use system_tests::{
    BareNode, BareSubscription, Cell, Child, StartedChild, Times, per_message, processor_time,
    string_frame,
};

use crate::lane::{DIGITS, PathLane};

/// A relay of many topics, with both ends of each topic.
struct Crowd {
    name: &'static str,
    relay: Child,
    lanes: Vec<PathLane>,
    times: Times,
    used: Duration,
}

impl Crowd {
    fn echo(count: usize) -> Self {
        let me = std::env::current_exe().unwrap();
        let lanes = count.to_string();
        let mut relay = StartedChild::new(&format!("echo_{count}"), &me)
            .args(["echo", &lanes])
            .start();
        let address = relay.wait_for_line("127.0.0.1:", Duration::from_secs(10));
        let connect = || TcpStream::connect(&address).unwrap();
        let lane = |_| {
            let input = connect();
            input.set_nodelay(true).unwrap();
            PathLane::of(input, BareSubscription::of(connect()))
        };
        Self {
            name: "raw TCP echo",
            lanes: (0..count).map(lane).collect(),
            relay,
            times: Times::default(),
            used: Duration::ZERO,
        }
    }

    fn of(cell: &Cell, count: usize) -> Self {
        let pairs: Vec<(String, String)> = (0..count)
            .map(|topic| {
                (
                    format!("/of_{count}/in_{topic}"),
                    format!("/of_{count}/out_{topic}"),
                )
            })
            .collect();
        let relay = cell.tcpros_relay(&format!("relay_{count}"), &pairs);
        let node = BareNode::start(&format!("/bench_{count}"));
        Self {
            name: "tcpros `relay`",
            lanes: PathLane::through(&node, &pairs),
            relay,
            times: Times::default(),
            used: Duration::ZERO,
        }
    }

    /// Sends messages one at a time, each through the next topic, so that no two messages are read
    /// or written together.
    fn turn(&mut self, first: u64) {
        let before = processor_time(self.relay.id());
        let lanes = self.lanes.len() as u64;
        for number in first..first + BLOCK {
            let frame = string_frame(&format!("{number:0DIGITS$}"));
            let lane = usize::try_from(number % lanes).unwrap();
            self.times.add(self.lanes[lane].pass(&frame));
        }
        self.used += processor_time(self.relay.id()) - before;
    }
}

pub(crate) fn measure(cell: &Cell, blocks: usize) {
    println!(
        "\n16 B, one message at a time, each through the next topic or connection, {} messages for each count; \
         microseconds:\n",
        blocks as u64 * BLOCK
    );
    let counts = [1, 10, 100, 1000];
    let mut crowds: Vec<Crowd> = counts
        .into_iter()
        .flat_map(|count| [Crowd::echo(count), Crowd::of(cell, count)])
        .collect();
    for block in 0..blocks as u64 {
        for crowd in &mut crowds {
            crowd.turn(block * BLOCK);
        }
    }
    println!("| path | topics | p50 | p99 | CPU per message | CPU / that of one topic |");
    println!("|---|---|---|---|---|---|");
    for name in ["raw TCP echo", "tcpros `relay`"] {
        let mut one = None;
        for crowd in crowds.iter_mut().filter(|crowd| crowd.name == name) {
            let cost = per_message(crowd.used, crowd.times.count());
            let ratio = cost / *one.get_or_insert(cost);
            println!(
                "| {name} | {} | {:.1} | {:.1} | {cost:.1} | {ratio:.2} |",
                crowd.lanes.len(),
                crowd.times.at(0.5),
                crowd.times.at(0.99)
            );
        }
    }
}

/// Messages of a turn: with the highest number of topics, each topic gets a message.
const BLOCK: u64 = 1000;
