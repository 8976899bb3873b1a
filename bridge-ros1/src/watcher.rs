//! Looks at the ROS graph beside the samples, so that a slow master holds nothing up.

use std::time::Duration;

use tcpros::{Graph, Node};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::sleep;

/// What was seen.
#[derive(Debug)]
pub(crate) enum Seen {
    /// The graph, `None` while there is no master.
    Graph(Option<Graph>),
    /// The node was told to shut down, for this reason.
    Ended(String),
}

/// Two small tasks; they end when it is dropped.
#[derive(Debug)]
pub(crate) struct Watcher {
    seen: mpsc::Receiver<Seen>,
    _tasks: JoinSet<()>,
}

impl Watcher {
    pub(crate) fn of(node: &Node) -> Self {
        // A look that was not taken yet delays the next: no more than one waits.
        let (sender, seen) = mpsc::channel(1);
        let mut tasks = JoinSet::new();
        let asked = node.shutdown_requested();
        let ends = sender.clone();
        tasks.spawn(async move {
            let reason = asked.await;
            // Nobody is left to be told when the port is gone.
            drop(ends.send(Seen::Ended(reason)).await);
        });
        let graph = node.graph_reader();
        tasks.spawn(async move {
            while sender
                .send(Seen::Graph(graph.read().await.ok()))
                .await
                .is_ok()
            {
                sleep(PERIOD).await;
            }
        });
        Self {
            seen,
            _tasks: tasks,
        }
    }

    /// The next look at the graph. Cancel-safe.
    pub(crate) async fn recv(&mut self) -> Seen {
        match self.seen.recv().await {
            Some(seen) => seen,
            None => std::future::pending().await,
        }
    }
}

/// How long a new topic of the space waits to be noticed; the master answers in about a millisecond.
const PERIOD: Duration = Duration::from_millis(500);
