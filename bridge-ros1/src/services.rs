//! Services of the graph as values of the space.
//!
//! Three kinds of tasks: one per variable whose values call a service, one per service that is polled. Both report to
//! the port what became of each call; nothing here waits in the port's own task.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use mappings::{Overflow, TopicId};
use messages::Selection;
use tcpros::{Node, NodeError, ServiceClient, ServiceClientOptions, ServiceError};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, sleep};
use tracing::{info, warn};

use crate::pending::Pending;

/// A service to call.
#[derive(Debug, Clone)]
pub(crate) struct Target {
    /// Its name, as the mapping has it.
    pub(crate) service: String,
    /// The name and checksum of its type.
    pub(crate) type_name: String,
    pub(crate) md5sum: String,
    pub(crate) timeout: Duration,
}

/// A value whose answer-taking variables wait for what its calls bring.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Taker {
    pub(crate) topic: TopicId,
    pub(crate) selection: Selection,
}

/// What became of a call.
#[derive(Debug)]
pub(crate) enum Outcome {
    /// The answer, and whose it is.
    Answered { of: Source, answer: Bytes },
    /// No answer; `of` is what the call was made for.
    Failed { of: Source },
}

/// What made a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Source {
    /// A value of the space that arrived.
    Value(TopicId),
    /// The clock; the number of the poll.
    Poll(usize),
}

/// The calls of one bridge.
#[derive(Debug)]
pub(crate) struct Services {
    callers: HashMap<TopicId, Arc<Pending>>,
    outcomes: mpsc::Receiver<Outcome>,
    report: mpsc::Sender<Outcome>,
    tasks: JoinSet<()>,
}

impl Services {
    pub(crate) fn new() -> Self {
        // What is not taken yet delays the next calls: no more than these wait.
        let (report, outcomes) = mpsc::channel(64);
        Self {
            callers: HashMap::new(),
            outcomes,
            report,
            tasks: JoinSet::new(),
        }
    }

    /// Calls the service with each request that [`request`](Self::request) is given for the topic.
    pub(crate) fn call(
        &mut self,
        node: &Node,
        topic: TopicId,
        target: &Target,
        overflow: Overflow,
    ) -> Result<(), NodeError> {
        let caller = Caller {
            client: client(node, target)?,
            of: Source::Value(topic),
            report: self.report.clone(),
            trouble: Trouble::default(),
        };
        let pending = Arc::new(Pending::new(overflow));
        self.callers.insert(topic, Arc::clone(&pending));
        self.tasks
            .spawn(caller.serve(pending, overflow == Overflow::KeepLatest));
        Ok(())
    }

    /// Calls the service with one and the same request every so often.
    pub(crate) fn poll(
        &mut self,
        node: &Node,
        number: usize,
        target: &Target,
        (request, every): (Bytes, Duration),
    ) -> Result<(), NodeError> {
        let caller = Caller {
            client: client(node, target)?,
            of: Source::Poll(number),
            report: self.report.clone(),
            trouble: Trouble::default(),
        };
        self.tasks.spawn(caller.poll(request, every));
        Ok(())
    }

    /// Queues a request for the service of a topic. `None`: it calls none; else whether an older request gave way.
    pub(crate) fn request(&self, topic: TopicId, request: Bytes) -> Option<bool> {
        Some(self.callers.get(&topic)?.push(request))
    }

    /// The end of the next call. Cancel-safe.
    pub(crate) async fn recv(&mut self) -> Outcome {
        match self.outcomes.recv().await {
            Some(outcome) => outcome,
            // Not while we hold a sender ourselves.
            None => std::future::pending().await,
        }
    }
}

fn client(node: &Node, target: &Target) -> Result<ServiceClient, NodeError> {
    let options = ServiceClientOptions {
        md5sum: Some(target.md5sum.clone()),
        type_name: Some(target.type_name.clone()),
        persistent: true,
        timeout: target.timeout,
        ..ServiceClientOptions::default()
    };
    node.service_client(&target.service, options)
}

/// One task that calls one service.
struct Caller {
    client: ServiceClient,
    of: Source,
    report: mpsc::Sender<Outcome>,
    trouble: Trouble,
}

impl Caller {
    /// Calls with each request in turn. A state (`insist`) is tried until the service takes it or a newer one came,
    /// an event once.
    async fn serve(mut self, pending: Arc<Pending>, insist: bool) {
        loop {
            let mut request = pending.take().await;
            let mut wait = FIRST_WAIT;
            while self.call(request.clone(), insist).await == Next::Again {
                tokio::select! {
                    newer = pending.take() => (request, wait) = (newer, FIRST_WAIT),
                    () = sleep(wait) => wait = (wait * 2).min(LAST_WAIT),
                }
            }
        }
    }

    async fn poll(mut self, request: Bytes, every: Duration) {
        let mut ticks = interval(every);
        // A slow service is asked when it has answered, not twice in a row.
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            self.call(request.clone(), false).await;
        }
    }

    async fn call(&mut self, request: Bytes, insist: bool) -> Next {
        let service = self.client.service();
        let (outcome, next) = match self.client.call(request).await {
            Ok(answer) => {
                self.trouble.over(service);
                (Outcome::Answered { of: self.of, answer }, Next::Done)
            }
            Err(error) => {
                let again = insist && is_passing(&error);
                self.trouble.tell(service, self.of, &error, again);
                let next = if again { Next::Again } else { Next::Done };
                (Outcome::Failed { of: self.of }, next)
            }
        };
        if next == Next::Done {
            // Nobody is left to be told when the port is gone.
            drop(self.report.send(outcome).await);
        }
        next
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Next {
    Done,
    Again,
}

/// Tells of a fault once, and when it is over.
#[derive(Debug, Default)]
struct Trouble {
    told: Option<String>,
}

impl Trouble {
    fn tell(&mut self, service: &str, of: Source, error: &ServiceError, again: bool) {
        let text = error.to_string();
        if self.told.as_ref() == Some(&text) {
            return;
        }
        let then = if again { "trying again" } else { "given up" };
        match of {
            Source::Value(topic) => {
                warn!(service, %topic, error = text, then, "a value could not be handed to its service");
            }
            Source::Poll(_) => warn!(service, error = text, "a polled service did not answer"),
        }
        self.told = Some(text);
    }

    fn over(&mut self, service: &str) {
        if self.told.take().is_some() {
            info!(service, "the service answers again");
        }
    }
}

/// The first wait before a state is handed to its service again, doubling to the last.
const FIRST_WAIT: Duration = Duration::from_millis(250);
const LAST_WAIT: Duration = Duration::from_secs(5);
