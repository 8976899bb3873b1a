//! Requests of the component's skills to other participants of the space.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bridge_node::{AskError, AskId, CallDescription, CallResponse, CallRole, PortEvent};
use bytes::Bytes;
use mappings::TopicId;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::timeout;

/// The calls that drivers need, as far as they have an executor.
type Known = BTreeMap<TopicId, Arc<CallDescription>>;

/// The sender of the drivers' requests to the space.
#[derive(Debug, Clone)]
pub(crate) struct RequestSender {
    known: watch::Receiver<Known>,
    wish: mpsc::Sender<Wish>,
    next: Arc<AtomicU64>,
}

#[derive(Debug)]
enum Wish {
    Ask {
        ask: AskId,
        topic: TopicId,
        request: Bytes,
        timeout: Duration,
        answer: oneshot::Sender<CallResponse<Bytes>>,
    },
    GiveUp(AskId),
}

/// The receiver of the drivers' requests. The port reports the requests and passes the answers on.
#[derive(Debug)]
pub(crate) struct Asking {
    asks: RequestSender,
    known: watch::Sender<Known>,
    wishes: mpsc::Receiver<Wish>,
    asked: HashMap<AskId, oneshot::Sender<CallResponse<Bytes>>>,
    /// The calls that drivers need.
    wanted: BTreeSet<TopicId>,
    events: VecDeque<PortEvent>,
}

impl Asking {
    pub(crate) fn new() -> Self {
        let (known, hears) = watch::channel(Known::new());
        let (wish, wishes) = mpsc::channel(MOST_WISHES);
        Self {
            asks: RequestSender {
                known: hears,
                wish,
                next: Arc::default(),
            },
            known,
            wishes,
            asked: HashMap::new(),
            wanted: BTreeSet::new(),
            events: VecDeque::new(),
        }
    }

    /// Returns a sender for a driver that needs this call.
    pub(crate) fn asks(&mut self, topic: TopicId) -> RequestSender {
        self.want(topic);
        self.asks.clone()
    }

    fn want(&mut self, topic: TopicId) {
        if self.wanted.insert(topic) {
            self.events.push_back(PortEvent::CallWanted { topic });
        }
    }

    /// Returns the calls that drivers need.
    pub(crate) fn wanted(&self) -> impl Iterator<Item = TopicId> {
        self.wanted.iter().copied()
    }

    /// Waits for the next event to report. Cancel-safe.
    pub(crate) async fn next(&mut self) -> PortEvent {
        loop {
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            // Never `None`, because `asks` holds a sender.
            match self.wishes.recv().await {
                None => return std::future::pending().await,
                Some(Wish::Ask {
                    ask,
                    topic,
                    request,
                    timeout,
                    answer,
                }) => {
                    self.asked.insert(ask, answer);
                    return PortEvent::Ask {
                        ask,
                        topic,
                        request,
                        timeout,
                    };
                }
                Some(Wish::GiveUp(ask)) => {
                    if self.asked.remove(&ask).is_some() {
                        return PortEvent::AskGivenUp { ask };
                    }
                }
            }
        }
    }

    pub(crate) fn known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        // Calls that no driver needs are recorded too, because the calls of an action are announced
        // once and in any order.
        if self.wanted.contains(&topic)
            && let CallRole::Goal(family) = description.role
        {
            let (space, namespace, _) = topic.triple();
            for id in [family.cancel, family.result] {
                if let Some(part) = TopicId::new(space, namespace, id) {
                    self.want(part);
                }
            }
        }
        self.known.send_modify(|known| {
            known.insert(topic, Arc::clone(description));
        });
    }

    pub(crate) fn gone(&mut self, topic: TopicId) {
        self.known
            .send_if_modified(|known| known.remove(&topic).is_some());
    }

    pub(crate) fn answered(&mut self, ask: AskId, answer: CallResponse<Bytes>) {
        if let Some(asked) = self.asked.remove(&ask) {
            // The driver may have abandoned the request.
            drop(asked.send(answer));
        }
    }
}

impl RequestSender {
    /// Waits until a call has an executor, and returns its description.
    ///
    /// # Errors
    /// Returns an error if the call has no executor within that time.
    pub(crate) async fn known(
        &self,
        topic: TopicId,
        within: Duration,
    ) -> Result<Arc<CallDescription>, String> {
        let mut known = self.known.clone();
        let found = timeout(within, known.wait_for(|known| known.contains_key(&topic))).await;
        let found = found.ok().and_then(Result::ok);
        let found = found.and_then(|known| known.get(&topic).cloned());
        found.ok_or_else(|| format!("nobody in the space executes {topic}"))
    }

    /// Sends a request and waits for the answer. Dropping the future abandons the request.
    ///
    /// # Errors
    /// Returns the reason why there is no answer, or `None` if the component stops.
    pub(crate) async fn ask(
        &self,
        topic: TopicId,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, Option<AskError>> {
        let ask = AskId(self.next.fetch_add(1, Ordering::Relaxed));
        let (answer, answered) = oneshot::channel();
        let wish = Wish::Ask {
            ask,
            topic,
            request,
            timeout,
            answer,
        };
        self.wish.send(wish).await.map_err(|_| None)?;
        let mut open = Open {
            ask,
            wish: &self.wish,
            over: false,
        };
        let answer = answered.await;
        open.over = true;
        answer.map_err(|_| None)?.map_err(Some)
    }
}

/// A pending request.
struct Open<'a> {
    ask: AskId,
    wish: &'a mpsc::Sender<Wish>,
    over: bool,
}

impl Drop for Open<'_> {
    fn drop(&mut self) {
        if !self.over {
            // If the queue is full, the request ends at its deadline.
            drop(self.wish.try_send(Wish::GiveUp(self.ask)));
        }
    }
}

/// Largest number of requests of drivers that the port has not taken. Each skill sends one or two
/// at a time.
const MOST_WISHES: usize = 256;
