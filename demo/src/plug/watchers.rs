//! Observers of the status pages, of the datagrams of the group, and of the ROS 1 graph.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::time::Duration;

use serde_json::Value;
use tcpros::MasterGraph;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval};
use transport::{Udp, UdpOptions};
use uadp::{NetworkMessage, PublisherId};

use super::fact::{Fact, PlugComponent, VisibilityLevel};
use super::pages::{Dated, StatusPageKind, StatusPageReader};
use super::{START, topic};
use crate::clock::wall_nanos;
use crate::stage::{LOOPBACK, fetch};

/// The observer tasks. Dropping this value stops them.
pub(crate) struct Watchers {
    tasks: JoinSet<()>,
    facts: mpsc::Sender<Dated>,
}

impl Watchers {
    pub(crate) fn new() -> (Self, mpsc::Receiver<Dated>) {
        // If facts are not received, the observers wait.
        let (facts, receiver) = mpsc::channel(1024);
        let tasks = JoinSet::new();
        (Self { tasks, facts }, receiver)
    }

    /// Returns a sender for facts of other tasks.
    pub(crate) fn facts(&self) -> mpsc::Sender<Dated> {
        self.facts.clone()
    }

    /// Runs a task until the end of the scenario.
    pub(crate) fn spawn(&mut self, task: impl Future<Output = ()> + Send + 'static) {
        self.tasks.spawn(task);
    }

    /// Observes the status page of a program at a port.
    pub(crate) fn page(&mut self, program: &'static str, page: StatusPageKind, port: u16) {
        self.spawn(watch_page(
            StatusPageReader::new(program, page),
            port,
            self.facts(),
        ));
    }

    /// Listens in the PubSub group on the loopback interface.
    ///
    /// # Errors
    /// The group cannot be joined.
    pub(crate) fn group(&mut self) -> std::io::Result<()> {
        let options = UdpOptions {
            interface: Some(LOOPBACK.to_owned()),
            ..UdpOptions::new(GROUP)
        };
        let udp = Udp::open(&options).map_err(std::io::Error::other)?;
        self.spawn(listen(udp, self.facts()));
        Ok(())
    }

    /// Observes the ROS 1 graph for the service of the gripper's first skill.
    pub(crate) fn graph(&mut self, master: String) {
        self.spawn(watch_graph(master, self.facts()));
    }
}

async fn watch_page(mut reader: StatusPageReader, port: u16, facts: mpsc::Sender<Dated>) {
    let mut ticks = interval(LOOK_EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    while !reader.is_done() {
        ticks.tick().await;
        // The page is not available before the program listens or after it has ended.
        let Ok(page) = fetch::<Value>(port).await else {
            continue;
        };
        for fact in reader.read(wall_nanos(), &page) {
            if facts.send(fact).await.is_err() {
                return;
            }
        }
    }
}

async fn listen(mut udp: Udp, facts: mpsc::Sender<Dated>) {
    let mut buffer = vec![0; MOST_BYTES];
    let mut heard = Vec::new();
    while heard.len() < PlugComponent::ALL.len() {
        let Ok((length, _)) = udp.recv(&mut buffer).await else {
            tokio::time::sleep(LOOK_EVERY).await;
            continue;
        };
        let Some(part) = buffer.get(..length).and_then(value_of) else {
            continue;
        };
        if !heard.contains(&part) {
            heard.push(part);
            let fact = (wall_nanos(), Fact::Reached(part, VisibilityLevel::InSpace));
            if facts.send(fact).await.is_err() {
                return;
            }
        }
    }
}

/// Returns the component of the values in a datagram, if any.
fn value_of(datagram: &[u8]) -> Option<PlugComponent> {
    let message = NetworkMessage::decode(datagram).ok()?;
    if message.publisher_id() != Some(PublisherId::UInt16(0)) || message.is_action() {
        return None;
    }
    let part = PlugComponent::of_namespace(message.group()?.writer_group_id?)?;
    let mut messages = message.messages();
    messages
        .any(|message| {
            let fields = message
                .ok()
                .and_then(|message| message.fields().ok().map(|f| f.len()));
            fields.is_some_and(|fields| fields > 0)
        })
        .then_some(part)
}

async fn watch_graph(master: String, facts: mpsc::Sender<Dated>) {
    let service = topic(PlugComponent::Gripper.namespace(), START);
    let mut ticks = interval(LOOK_EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut was_there = false;
    loop {
        ticks.tick().await;
        let Ok(graph) = MasterGraph::of_master(&master, "/demo").await else {
            continue;
        };
        let is_there = graph.services.contains_key(&service);
        if was_there && !is_there {
            let fact = (
                wall_nanos(),
                Fact::Left(PlugComponent::Gripper, VisibilityLevel::Ros1),
            );
            if facts.send(fact).await.is_err() {
                return;
            }
        }
        was_there = is_there;
    }
}

/// The default group of the programs.
const GROUP: SocketAddr = SocketAddr::V4(SocketAddrV4::new(Ipv4Addr::new(239, 192, 0, 40), 4840));
const LOOK_EVERY: Duration = Duration::from_millis(20);
const MOST_BYTES: usize = 65_536;
