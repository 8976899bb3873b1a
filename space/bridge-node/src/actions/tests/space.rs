//! Two bridges of a space in one process.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bridge_core::{
    AskError, AskErrorKind, AskId, CallDescription, CallField, Executed, ExecutionId, OfferedType,
    ValueRelation,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, MessageType, TypeRegistry};
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;
use uadp::{StatusCode, Timestamp};

use super::super::{BridgeActions, GraphGoalEvent, GraphServerEvent};
use super::fakes::{Cancel, Fake, FakeReport, FakeRequest, New, Sent};
use super::{GOAL, ID, NAME, QUICK, TEXT};
use crate::policy::Policy;
use crate::port::{Execution, LocalDelivery};
use crate::present::Present;
use crate::{PortEvent, SpaceCalls, now};

/// A bridge of space 1 that executes, a bridge of space 2 that offers, and the space between them.
pub(super) struct SimulatedSpace {
    graph: Fake,
    pub(super) executing: BridgeActions,
    pub(super) offering: BridgeActions,
    pub(super) policies: [Policy; 2],
    pub(super) calls: SpaceCalls<()>,
    pub(super) asked: HashMap<ExecutionId, AskId>,
    next: u64,
    /// The servers of the graph of space 1.
    pub(super) present: Present,
    pub(super) sent: mpsc::Receiver<Sent>,
    pub(super) cancels: mpsc::Receiver<Cancel>,
    clients: mpsc::Sender<GraphServerEvent<New, FakeRequest>>,
    pub(super) statuses: Vec<Bytes>,
    pub(super) served: Arc<Mutex<Vec<String>>>,
    /// Whether no executor is known.
    pub(super) deserted: bool,
}

impl SimulatedSpace {
    pub(super) fn new(mapping: &str) -> Self {
        let mut registry = TypeRegistry::bundle(Dialect::Ros1);
        registry.add_action(&NAME.parse().unwrap(), TEXT).unwrap();
        let (send, sent) = mpsc::channel(16);
        let (cancel, cancels) = mpsc::channel(16);
        let (clients, events) = mpsc::channel(16);
        let served = Arc::<Mutex<Vec<String>>>::default();
        let read = Mapping::from_yaml(mapping, "cell.yaml");
        let mapping = Arc::new(read.mapping.ok_or(read.findings).unwrap());
        let policy = |space| Policy::new(space, Arc::clone(&mapping));
        Self {
            graph: Fake {
                registry,
                sent: send,
                cancels: cancel,
                events: Mutex::new(Some(events)),
                served: Arc::clone(&served),
            },
            executing: BridgeActions::default(),
            offering: BridgeActions::default(),
            policies: [1, 2].map(|space| policy(SpaceId::new(space).unwrap())),
            calls: SpaceCalls::default(),
            asked: HashMap::new(),
            next: 0,
            present: [(format!("/{GOAL}"), NAME.parse().ok())].into(),
            sent,
            cancels,
            clients,
            statuses: Vec::new(),
            served,
            deserted: false,
        }
    }

    /// Returns a space with the action offered in both spaces.
    pub(super) fn offered() -> Self {
        Self::offered_by(QUICK)
    }

    pub(super) fn offered_by(mapping: &str) -> Self {
        let mut space = Self::new(mapping);
        let events = space.reconcile();
        assert_eq!(events.len(), 6, "{events:?}");
        space.announce(&events);
        let bound = space.offer();
        assert_eq!(bound.len(), 5, "{bound:?}");
        assert_eq!(*space.served.lock().unwrap(), [format!("/{GOAL}")]);
        space
    }

    pub(super) fn reconcile(&mut self) -> Vec<PortEvent> {
        let [policy, _] = &mut self.policies;
        let present = (&self.present, 8);
        self.executing.reconcile(&mut self.graph, policy, present)
    }

    pub(super) fn announce(&mut self, events: &[PortEvent]) {
        for (topic, offered) in offers(events) {
            self.offering.known(topic, &describe(offered));
        }
    }

    pub(super) fn offer(&mut self) -> Vec<PortEvent> {
        let [_, policy] = &mut self.policies;
        let calls = &self.calls;
        let asker = |topic| calls.asker(topic);
        let with = (&mut self.graph, policy);
        self.offering.offer_waiting(with, asker, |_, _| true, 8)
    }

    /// Carries messages between the two bridges until `what` completes.
    pub(super) async fn until<T>(&mut self, what: impl Future<Output = T>) -> T {
        let mut what = Box::pin(timeout(Duration::from_secs(20), what));
        loop {
            tokio::select! {
                out = &mut what => return out.expect("it came in time"),
                events = self.executing.recv() => {
                    for event in events {
                        self.executed(event);
                    }
                }
                event = self.calls.recv::<Fake>() => self.ask(event),
            }
        }
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "all others are none of an action that is there"
    )]
    fn executed(&mut self, event: PortEvent) {
        match event {
            PortEvent::Executed { execution, outcome } => {
                let Some(ask) = self.asked.remove(&execution) else {
                    return;
                };
                let fault = |kind| AskError {
                    kind,
                    status: StatusCode::GOOD,
                    text: format!("{kind:?}"),
                };
                let answer = match outcome {
                    Executed::Answered(answer) => Ok(answer.into()),
                    Executed::Failed(_) => Err(fault(AskErrorKind::Failed)),
                    Executed::Refused(_) => Err(fault(AskErrorKind::Refused)),
                    Executed::Lost => Err(fault(AskErrorKind::Unknown)),
                };
                self.calls.answered(ask, answer);
            }
            PortEvent::Sample { topic, payload, .. } if topic.triple().2 == 73 => {
                assert!(self.offering.takes(&self.policies[1], topic));
                let source = None;
                let delivery = LocalDelivery {
                    topic,
                    payload,
                    source,
                    status: 0,
                    instance: None,
                    kept: ValueRelation::Alone,
                    lasting: true,
                };
                self.offering.publish(&delivery).unwrap();
            }
            PortEvent::Sample { payload, .. } => self.statuses.push(payload),
            other => assert!(matches!(other, PortEvent::CallFailed { .. }), "{other:?}"),
        }
    }

    fn ask(&mut self, event: PortEvent) {
        let PortEvent::Ask {
            ask,
            topic,
            request,
            timeout,
        } = event
        else {
            let PortEvent::AskGivenUp { ask } = event else {
                panic!("{event:?}");
            };
            let run = self.asked.iter().find(|(_, of)| **of == ask);
            if let Some((run, _)) = run {
                self.executing.abandoned(*run);
            }
            return;
        };
        if self.deserted {
            let refused = AskError {
                kind: AskErrorKind::Refused,
                status: StatusCode::GOOD,
                text: "nobody executes it".to_owned(),
            };
            return self.calls.answered(ask, Err(refused));
        }
        self.next += 1;
        let id = ExecutionId::new(self.next);
        let deadline = now().monotonic + timeout;
        self.asked.insert(id, ask);
        let execution = Execution {
            id,
            topic,
            request,
            requestor: None,
            deadline,
            start_by: deadline,
        };
        if let Err(refusal) = self.executing.execute(execution) {
            let outcome = Executed::Refused(refusal);
            self.executed(PortEvent::Executed {
                execution: id,
                outcome,
            });
        }
    }

    /// Sends a goal from a client of the graph of space 2.
    pub(super) async fn client(&mut self) -> mpsc::Receiver<FakeReport> {
        let (told, heard) = mpsc::channel(16);
        let body = Bytes::copy_from_slice(&7_i32.to_le_bytes());
        let new = New { id: ID, body, told };
        let clients = self.clients.clone();
        let sent = self.until(clients.send(GraphServerEvent::Goal(new))).await;
        sent.ok().unwrap();
        heard
    }

    /// Returns the goal that the server in space 1 receives.
    pub(super) async fn server(&mut self) -> Sent {
        let mut sent = std::mem::replace(&mut self.sent, mpsc::channel(1).1);
        let goal = self.until(sent.recv()).await.unwrap();
        self.sent = sent;
        goal
    }

    pub(super) async fn told(&mut self, heard: &mut mpsc::Receiver<FakeReport>) -> FakeReport {
        self.until(heard.recv()).await.unwrap()
    }

    /// Sends a goal as [`client`](Self::client) does, and waits until it is accepted on both sides.
    pub(super) async fn running(&mut self) -> (Sent, mpsc::Receiver<FakeReport>) {
        let mut heard = self.client().await;
        let goal = self.server().await;
        let accepted = GraphGoalEvent::Accepted(Timestamp::from_unix_nanos(1_000));
        goal.say.send(accepted).await.unwrap();
        assert_eq!(self.told(&mut heard).await, FakeReport::Accepted);
        (goal, heard)
    }

    /// Sends a request to cancel the goal from a client in space 2. Returns the receiver of the
    /// response.
    pub(super) async fn cancel(&mut self) -> oneshot::Receiver<bool> {
        let (agreed, heard) = oneshot::channel();
        let clients = self.clients.clone();
        let request = FakeRequest { id: ID, agreed };
        let sent = self
            .until(clients.send(GraphServerEvent::Cancel(request)))
            .await;
        sent.ok().unwrap();
        heard
    }

    /// Runs both bridges for a number of passes.
    pub(super) async fn passes(&mut self, count: usize) {
        let passed = async {
            for _ in 0..count {
                tokio::task::yield_now().await;
            }
        };
        self.until(passed).await;
    }

    pub(super) async fn cancelled(&mut self) -> Cancel {
        let mut cancels = std::mem::replace(&mut self.cancels, mpsc::channel(1).1);
        let cancel = self.until(cancels.recv()).await.unwrap();
        self.cancels = cancels;
        cancel
    }
}

pub(super) fn offers(events: &[PortEvent]) -> impl Iterator<Item = (TopicId, &OfferedType)> {
    events.iter().filter_map(|event| {
        if let PortEvent::OfferTyped { topic, offered } = event {
            Some((*topic, offered))
        } else {
            None
        }
    })
}

/// Returns the description of a call as it is announced.
fn describe(offered: &OfferedType) -> Arc<CallDescription> {
    let fields = |message: &MessageType| {
        let leaves = message.leaves().iter();
        let field = leaves.map(|leaf| CallField {
            rank: leaf.rank,
            ..CallField::scalar(&leaf.path, leaf.builtin)
        });
        field.collect()
    };
    Arc::new(CallDescription {
        name: offered.name.clone(),
        about: offered.service_type.name().to_string(),
        role: offered.role,
        request: fields(offered.service_type.request()),
        response: fields(offered.service_type.response()),
    })
}
