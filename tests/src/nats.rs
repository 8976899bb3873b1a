//! nats-server from Debian or Ubuntu: a cluster of three brokers that speak MQTT 3.1.1.

use std::path::Path;
use std::time::Duration;

use nix::sys::signal::Signal;

use crate::{Cell, Child, StartedChild};

pub(crate) const NATS: &str = "/usr/sbin/nats-server";

/// The number of nodes.
const NODES: u16 = 3;
const START: Duration = Duration::from_secs(60);

/// A cluster of three nodes, numbered from 0.
pub struct NatsCluster<'c> {
    cell: &'c Cell,
    nodes: Vec<Option<Child>>,
    more: String,
}

impl Cell {
    /// Starts a cluster with more configuration, and waits until it can store messages. Each
    /// `$NAME_PASSWORD` in the configuration is `word` if the name is one of `users`.
    #[must_use]
    pub fn nats(&self, more: &str, users: &[&str]) -> NatsCluster<'_> {
        let mut cluster = NatsCluster {
            cell: self,
            nodes: (0..NODES).map(|_| None).collect(),
            more: more.to_owned(),
        };
        cluster.start(users);
        cluster
    }
}

impl NatsCluster<'_> {
    /// Returns the address of a node for MQTT.
    #[must_use]
    pub fn address(node: u16) -> String {
        format!("mqtt://127.0.0.1:{}", Self::port(node))
    }

    /// Returns the port of a node for MQTT.
    #[must_use]
    pub fn port(node: u16) -> u16 {
        1883 + node % NODES
    }

    /// Starts all nodes that do not run, and waits until the cluster has a leader.
    ///
    /// # Panics
    /// Panics if the cluster has no leader in time.
    pub fn start(&mut self, users: &[&str]) {
        let missing = (0..NODES).zip(&mut self.nodes);
        for (number, node) in missing.filter(|(_, node)| node.is_none()) {
            let text = configuration(self.cell.folder(), number) + &self.more;
            let file = self.cell.file(&format!("nats-{number}.conf"), &text);
            let mut started = StartedChild::new("nats-server", Path::new(NATS))
                .args(["-c", file.to_str().unwrap()]);
            for user in users {
                let name = user.to_uppercase().replace('-', "_");
                started = started.env(&format!("{name}_PASSWORD"), "word");
            }
            *node = Some(started.start());
        }
        for node in self.nodes.iter_mut().flatten() {
            node.wait_for_line("metadata leader", START);
        }
    }

    /// Kills a node.
    pub fn kill(&mut self, node: usize) {
        if let Some(node) = self.nodes[node].take() {
            node.signal(Signal::SIGKILL);
        }
    }

    /// Kills all nodes.
    pub fn kill_all(&mut self) {
        for node in 0..self.nodes.len() {
            self.kill(node);
        }
    }

    /// Sends a node a signal.
    ///
    /// # Panics
    /// Panics if the node does not run.
    pub fn signal(&self, node: usize, signal: Signal) {
        self.nodes[node].as_ref().unwrap().signal(signal);
    }
}

/// Returns the configuration of a node. Each stream has three replicas, so that any node may fail.
/// The server would choose the number by the nodes that it sees at the first connection.
fn configuration(folder: &Path, node: u16) -> String {
    let others = (0..NODES).filter(|other| *other != node);
    let routes: Vec<String> = others
        .map(|other| format!("\"nats://127.0.0.1:{}\"", 6222 + other))
        .collect();
    format!(
        "server_name: n{node}\n\
         listen: \"127.0.0.1:{}\"\n\
         jetstream {{ store_dir: \"{}/nats-{node}\", max_mem: 64MB, max_file: 256MB }}\n\
         mqtt {{ listen: \"127.0.0.1:{}\", stream_replicas: 3, consumer_replicas: 3 }}\n\
         cluster {{ name: cell, listen: \"127.0.0.1:{}\", routes: [{}] }}\n",
        4222 + node,
        folder.display(),
        NatsCluster::port(node),
        6222 + node,
        routes.join(", ")
    )
}
