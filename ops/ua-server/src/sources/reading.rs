//! Subscribes to the nodes of a server from which variables are read.
//!
//! NodeIds are valid for a single connection only, because a restarted server may number its
//! namespaces differently. Each connection therefore has its own subscriptions, and later
//! notifications of old subscriptions are ignored.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use mappings::TopicId;
use opcua::types::{DataValue, DateTime, StatusCode, Variant};
use plant_opcua::client::{ClientSubscription, Link, MonitoredWatch, Notice, OpcUaClient, Sampled};
use plant_opcua::limits::SHORTEST_PUBLISHING;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, MissedTickBehavior};

use super::state::{ServerState, Way};
use super::{News, Plan, Read};
use crate::executing::local_node;

/// Reads the nodes for as long as the server is in use.
pub(super) async fn run(
    client: OpcUaClient,
    mut plan: watch::Receiver<Arc<Plan>>,
    state: Arc<ServerState>,
    tell: mpsc::Sender<News>,
) {
    let mut link = client.link();
    let mut reader = Reader {
        client,
        state,
        tell,
        wanted: Vec::new(),
        batches: Vec::new(),
        faulty: HashMap::new(),
        at: None,
        away: false,
    };
    let mut again = tokio::time::interval_at(Instant::now() + LOOK_AGAIN, LOOK_AGAIN);
    again.set_missed_tick_behavior(MissedTickBehavior::Delay);
    reader.wanted.clone_from(&plan.borrow_and_update().reads);
    loop {
        let now = link.borrow_and_update().clone();
        let told = reader.follow(&now).await;
        if told.is_err() || now == Link::Closed {
            return;
        }
        let told = tokio::select! {
            changed = link.changed() => if changed.is_err() { return } else { Ok(()) },
            changed = plan.changed() => {
                if changed.is_err() {
                    return;
                }
                let reads = plan.borrow_and_update().reads.clone();
                reader.change(reads).await
            }
            heard = heard(&mut reader.batches) => reader.hear(heard, &link).await,
            _ = again.tick(), if !reader.faulty.is_empty() => reader.retry().await,
        };
        if told.is_err() {
            // The receiver has stopped.
            return;
        }
    }
}

struct Reader {
    client: OpcUaClient,
    state: Arc<ServerState>,
    tell: mpsc::Sender<News>,
    wanted: Vec<Arc<Read>>,
    batches: Vec<Batch>,
    /// Variables without a node on the server.
    faulty: HashMap<TopicId, Arc<Read>>,
    /// The connection of the subscriptions.
    at: Option<u64>,
    /// True if the loss of the server was reported.
    away: bool,
}

/// A subscription.
struct Batch {
    subscription: ClientSubscription,
    reads: Vec<Arc<Read>>,
}

type Told = Result<(), mpsc::error::SendError<News>>;

/// Waits for the next notification of a subscription, and returns it with the index of the
/// subscription.
async fn heard(batches: &mut [Batch]) -> (usize, Option<Notice>) {
    if batches.is_empty() {
        return std::future::pending().await;
    }
    let each = batches
        .iter_mut()
        .enumerate()
        .map(|(at, batch)| Box::pin(async move { (at, batch.subscription.next().await) }));
    let (told, _, _) = futures_util::future::select_all(each).await;
    told
}

impl Reader {
    /// Follows the state of the connection.
    async fn follow(&mut self, link: &Link) -> Told {
        self.state.link(link, self.client.certificates_refused());
        match link {
            Link::Up { connects, .. } => {
                self.away = false;
                if self.at == Some(*connects) {
                    return Ok(());
                }
                self.at = Some(*connects);
                self.batches.clear();
                self.faulty.clear();
                self.subscribe(self.wanted.clone()).await
            }
            Link::Down { .. } => {
                self.at = None;
                self.batches.clear();
                self.faulty.clear();
                if std::mem::replace(&mut self.away, true) {
                    return Ok(());
                }
                for read in self.wanted.clone() {
                    self.bad(&read, StatusCode::BadNoCommunication).await?;
                }
                Ok(())
            }
            Link::Connecting | Link::Closed => Ok(()),
        }
    }

    /// Subscribes to new variables and drops the subscriptions without wanted variables.
    async fn change(&mut self, reads: Vec<Arc<Read>>) -> Told {
        let same = |one: &Arc<Read>, all: &[Arc<Read>]| all.iter().any(|of| Arc::ptr_eq(of, one));
        let new: Vec<Arc<Read>> = {
            let before: HashSet<*const Read> = self.wanted.iter().map(Arc::as_ptr).collect();
            let is_new = |read: &&Arc<Read>| !before.contains(&Arc::as_ptr(read));
            reads.iter().filter(is_new).cloned().collect()
        };
        self.wanted = reads;
        let wanted = &self.wanted;
        self.faulty.retain(|_, read| same(read, wanted));
        self.batches
            .retain(|batch| batch.reads.iter().any(|read| same(read, wanted)));
        if self.at.is_none() {
            if self.away {
                for read in new {
                    self.bad(&read, StatusCode::BadNoCommunication).await?;
                }
            }
            return Ok(());
        }
        if self.batches.len() >= MOST_BATCHES {
            self.batches.clear();
            self.faulty.clear();
            return self.subscribe(self.wanted.clone()).await;
        }
        self.subscribe(new).await
    }

    async fn subscribe(&mut self, reads: Vec<Arc<Read>>) -> Told {
        let (mut watches, mut watched) = (Vec::new(), Vec::new());
        for read in reads {
            match local_node(&self.client, &read.source.node) {
                Ok(node) => {
                    watches.push(MonitoredWatch::Sampled(Sampled {
                        node,
                        interval: read.source.sampling,
                        queue: read.source.queue.get().into(),
                        deadband: read.source.deadband(),
                    }));
                    watched.push(read);
                }
                Err(error) => {
                    self.fault(&read, StatusCode::BadNodeIdUnknown, &error.to_string())
                        .await?
                }
            }
        }
        if watches.is_empty() {
            return Ok(());
        }
        let shortest = watched.iter().map(|read| read.source.sampling).min();
        let interval = shortest.unwrap_or_default().max(SHORTEST_PUBLISHING);
        let room = watches.len().saturating_mul(2).max(SMALLEST_QUEUE);
        self.batches.push(Batch {
            subscription: self.client.subscribe(watches, interval, room),
            reads: watched,
        });
        Ok(())
    }

    async fn hear(
        &mut self,
        (at, notice): (usize, Option<Notice>),
        link: &watch::Receiver<Link>,
    ) -> Told {
        // After a reconnect the NodeIds may denote other nodes.
        let now = match &*link.borrow() {
            Link::Up { connects, .. } => Some(*connects),
            Link::Connecting | Link::Down { .. } | Link::Closed => None,
        };
        if now != self.at {
            return Ok(());
        }
        let read = |watch: usize| {
            let batch = self.batches.get(at)?;
            batch.reads.get(watch).cloned()
        };
        match notice {
            Some(Notice::Value { watch, value }) => {
                let Some(read) = read(watch) else {
                    return Ok(());
                };
                self.state.came();
                self.state.sound(&read.name, Way::From);
                self.tell.send(News { read, value }).await
            }
            Some(Notice::Refused { watch, status }) => {
                let Some(read) = read(watch) else {
                    return Ok(());
                };
                let why = format!("the server answers {status} for {}", read.source.node);
                self.fault(&read, status, &why).await
            }
            Some(Notice::Subscribed | Notice::Event { .. }) => Ok(()),
            None => {
                self.batches.clear();
                Ok(())
            }
        }
    }

    /// Checks if the missing nodes exist on the server in the meantime.
    async fn retry(&mut self) -> Told {
        let faulty: Vec<Arc<Read>> = self.faulty.values().cloned().collect();
        let mut nodes = Vec::new();
        let mut reads = Vec::new();
        for read in faulty {
            if let Ok(node) = local_node(&self.client, &read.source.node) {
                nodes.push(node);
                reads.push(read);
            }
        }
        let Ok(values) = self.client.read(&nodes).await else {
            return Ok(());
        };
        let there = reads.into_iter().zip(values);
        let there = there.filter(|(_, value)| !is_away(value.status.unwrap_or(StatusCode::Good)));
        let there: Vec<Arc<Read>> = there.map(|(read, _)| read).collect();
        for read in &there {
            self.faulty.remove(&read.topic);
        }
        if there.is_empty() {
            Ok(())
        } else {
            self.subscribe(there).await
        }
    }

    /// Marks a variable as faulty without affecting the others.
    async fn fault(&mut self, read: &Arc<Read>, status: StatusCode, why: &str) -> Told {
        self.state.fault(&read.name, Way::From, why);
        self.faulty.insert(read.topic, Arc::clone(read));
        self.bad(read, status).await
    }

    async fn bad(&self, read: &Arc<Read>, status: StatusCode) -> Told {
        let now = DateTime::now();
        let value = DataValue {
            value: Some(Variant::Empty),
            status: Some(status),
            source_timestamp: Some(now),
            ..DataValue::default()
        };
        let read = Arc::clone(read);
        self.tell.send(News { read, value }).await
    }
}

/// Returns true if a status means that the value is not available.
fn is_away(status: StatusCode) -> bool {
    matches!(
        status,
        StatusCode::BadNodeIdUnknown
            | StatusCode::BadNodeIdInvalid
            | StatusCode::BadAttributeIdInvalid
            | StatusCode::BadNotReadable
            | StatusCode::BadUserAccessDenied
    )
}

/// Interval between two checks of missing nodes.
const LOOK_AGAIN: Duration = Duration::from_secs(10);
/// Largest number of subscriptions. Beyond it they are merged, because servers support few.
const MOST_BATCHES: usize = 8;
/// Smallest queue size of notifications. Notifications beyond the queue are lost and counted.
const SMALLEST_QUEUE: usize = 1_000;
