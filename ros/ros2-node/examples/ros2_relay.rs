//! Relays one topic of a DDS domain to another. The benchmarks compare it with relays of Cyclone
//! DDS and Fast DDS.
//!
//! `ros2_relay FROM TO [DOMAIN]`: topics of `std_msgs/msg/String`, on loopback, until SIGTERM.

#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a program without a log"
)]

use std::num::NonZeroU16;
use std::process::ExitCode;
use std::time::Duration;

use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::graph::RemoteEndpoint;
use ros2_node::inbox::{Inbox, InboxTurn};
use ros2_node::outlet::Outlet;
use ros2_node::qos::{Offered, Requested};
use tokio::time::Instant;

#[tokio::main(flavor = "current_thread")]
async fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let (from, to, domain) = match words.as_slice() {
        [from, to] => (from, to, Ok(0)),
        [from, to, domain] => (from, to, domain.parse()),
        _ => {
            eprintln!("ros2_relay FROM TO [DOMAIN]");
            return ExitCode::from(64);
        }
    };
    let result = match domain {
        // A separate task: waking the main task costs a system call each time.
        Ok(domain) => tokio::spawn(relay(from.clone(), to.clone(), domain))
            .await
            .unwrap_or_else(|panic| Err(panic.into())),
        Err(error) => Err(format!("no domain: {error}").into()),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("relay: {error}");
            ExitCode::FAILURE
        }
    }
}

async fn relay(from: String, to: String, domain: u16) -> Result<(), Failure> {
    let domain = Domain::join(&DomainOptions {
        domain,
        networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
        peers: Vec::new(),
        node: "relay".into(),
        enclave: None,
    })?;
    let (from, to) = (format!("rt{from}"), format!("rt{to}"));
    let offered = Offered::DropOldest(ROOM);
    let mut outlet = Outlet::new(domain.writer(&to, TYPE, offered)?, offered, domain.joined());
    let mut inbox = Inbox::new();
    inbox.insert(
        (),
        domain.reader(&from, TYPE, Requested::from_writers(&[]))?,
    );
    println!("{{\"ready\":\"{to}\"}}");
    let mut look = tokio::time::interval(LOOK);
    loop {
        tokio::select! {
            biased;
            taken = inbox.recv() => match taken {
                InboxTurn::Sample { payload, .. } => {
                    if let Err(refusal) = outlet.offer(payload, None, Instant::now()) {
                        eprintln!("relay: {}", refusal.label());
                    }
                }
                InboxTurn::Unreadable { why, .. } => eprintln!("relay: {why}"),
            },
            // More often only while samples wait for room.
            () = tokio::time::sleep(FLUSH), if outlet.is_waiting() => outlet.flush(Instant::now()).map_err(|r| r.label())?,
            _ = look.tick() => {
                let graph = domain.graph();
                let readers: Vec<RemoteEndpoint> = graph.readers(&to).to_vec();
                outlet.set_readers(&readers, Instant::now()).map_err(|r| r.label())?;
            }
        }
    }
}

type Failure = Box<dyn std::error::Error + Send + Sync>;

const TYPE: &str = "std_msgs::msg::dds_::String_";
const ROOM: NonZeroU16 = NonZeroU16::new(1000).unwrap();
const LOOK: Duration = Duration::from_millis(200);
const FLUSH: Duration = Duration::from_millis(1);
