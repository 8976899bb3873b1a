//! Polls the ROS graph in separate tasks, so a slow master does not delay samples.

use std::sync::Arc;
use std::time::Duration;

use tcpros::{MasterGraph, Node};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

/// An event of the watcher.
#[derive(Debug)]
pub(crate) enum WatcherEvent {
    /// The graph, the same `Arc` as before if it has not changed; `None` while the master is
    /// unavailable.
    Graph(Option<Arc<MasterGraph>>),
    /// The node was requested to shut down, with the reason.
    Ended(String),
}

/// Two small tasks that end when the watcher is dropped.
#[derive(Debug)]
pub(crate) struct MasterWatcher {
    seen: mpsc::Receiver<WatcherEvent>,
    _tasks: JoinSet<()>,
}

impl MasterWatcher {
    pub(crate) fn of(node: &Node) -> Self {
        // A graph that was not received yet delays the next poll, so at most one graph waits.
        let (sender, seen) = mpsc::channel(1);
        let mut tasks = JoinSet::new();
        let asked = node.shutdown_requested();
        let ends = sender.clone();
        tasks.spawn(async move {
            let reason = asked.await;
            // The port may already be dropped.
            drop(ends.send(WatcherEvent::Ended(reason)).await);
        });
        let mut graph = node.graph_reader();
        tasks.spawn(async move {
            while sender
                .send(WatcherEvent::Graph(graph.read_again().await.ok()))
                .await
                .is_ok()
            {
                idle_ticks::sleep(PERIOD).await;
            }
        });
        Self {
            seen,
            _tasks: tasks,
        }
    }

    /// Returns the next event. Cancel-safe.
    pub(crate) async fn recv(&mut self) -> WatcherEvent {
        match self.seen.recv().await {
            Some(seen) => seen,
            None => std::future::pending().await,
        }
    }
}

/// Maximum delay until a new topic of the space is found; the master responds in about a
/// millisecond.
const PERIOD: Duration = Duration::from_millis(500);
