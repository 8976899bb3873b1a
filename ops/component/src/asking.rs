//! What skills of the component ask of others in the space.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bridge_node::{Answered, AskError, AskId, CallDescription, CallRole, PortEvent};
use bytes::Bytes;
use mappings::TopicId;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::timeout;

/// The calls that drivers ask for, as far as somebody executes them.
type Known = BTreeMap<TopicId, Arc<CallDescription>>;

/// The way of drivers to the space.
#[derive(Debug, Clone)]
pub(crate) struct Asks {
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
        answer: oneshot::Sender<Answered<Bytes>>,
    },
    GiveUp(AskId),
}

/// The other end: what the port reports and is told.
#[derive(Debug)]
pub(crate) struct Asking {
    asks: Asks,
    known: watch::Sender<Known>,
    wishes: mpsc::Receiver<Wish>,
    asked: HashMap<AskId, oneshot::Sender<Answered<Bytes>>>,
    /// Those that drivers ask for.
    wanted: BTreeSet<TopicId>,
    events: VecDeque<PortEvent>,
}

impl Asking {
    pub(crate) fn new() -> Self {
        let (known, hears) = watch::channel(Known::new());
        let (wish, wishes) = mpsc::channel(MOST_WISHES);
        Self {
            asks: Asks {
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

    /// The way of a driver that asks for that call.
    pub(crate) fn asks(&mut self, topic: TopicId) -> Asks {
        self.want(topic);
        self.asks.clone()
    }

    fn want(&mut self, topic: TopicId) {
        if self.wanted.insert(topic) {
            self.events.push_back(PortEvent::CallWanted { topic });
        }
    }

    /// What there is to report. Cancel-safe.
    pub(crate) async fn next(&mut self) -> PortEvent {
        loop {
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            // Never `None` while we hold a sender ourselves.
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
        // Also what nobody wants yet: the calls of an action are told of once, in any order.
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

    pub(crate) fn answered(&mut self, ask: AskId, answer: Answered<Bytes>) {
        if let Some(asked) = self.asked.remove(&ask) {
            // Who asked may have given up meanwhile.
            drop(asked.send(answer));
        }
    }
}

impl Asks {
    /// What a call is, once somebody executes it.
    ///
    /// # Errors
    /// Nobody does within that time.
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

    /// Whether somebody executes it now.
    pub(crate) fn is_known(&self, topic: TopicId) -> bool {
        self.known.borrow().contains_key(&topic)
    }

    /// Asks. Given up when it is dropped.
    ///
    /// # Errors
    /// Why there is no answer; `None` where the component ends.
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

/// Something that is asked and not answered.
struct Open<'a> {
    ask: AskId,
    wish: &'a mpsc::Sender<Wish>,
    over: bool,
}

impl Drop for Open<'_> {
    fn drop(&mut self) {
        if !self.over {
            // Where there is no room it ends at its deadline.
            drop(self.wish.try_send(Wish::GiveUp(self.ask)));
        }
    }
}

/// What drivers have asked and the port has not taken: each skill asks for one or two at a time.
const MOST_WISHES: usize = 256;
