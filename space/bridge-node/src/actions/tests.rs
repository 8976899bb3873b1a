//! The policy of both sides in one process, with graphs that have no network.

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use bridge_core::{
    AskError, AskErrorKind, AskId, CallField, CallRole, Executed, Kept, OfferedType,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId};
use messages::{ActionCalls, Dialect, MessageType, Registry, ServiceType, TypeName, Wire};
use tokio::sync::oneshot;
use tokio::time::timeout;
use uadp::{BuiltinType, StatusCode, Timestamp};

use super::*;
use crate::services::{CallFault, Ran, ServiceCall};
use crate::{CallGraph, Calls, ServiceGraph, now};

const NAME: &str = "demo_msgs/Count";
const TEXT: &str = "int32 order\n---\nint32 last\n---\nint32 so_far\n";
const GOAL: &str = "ua_1_2_70";
const ID: GoalId = [9; 16];

fn of_goals() -> TopicId {
    GOAL.parse().unwrap()
}

/// The graph on either side. Requests to its servers and events for its clients go through
/// channels.
struct Fake {
    registry: Registry,
    sent: mpsc::Sender<Sent>,
    cancels: mpsc::Sender<Cancel>,
    /// The events of the server of an action of another space.
    events: Mutex<Option<mpsc::Receiver<ServerEvent<New, Request>>>>,
    served: Arc<Mutex<Vec<String>>>,
}

/// A goal that a server of the graph has received.
struct Sent {
    id: GoalId,
    body: Bytes,
    say: mpsc::Sender<GoalEvent>,
}

struct Cancel {
    what: CancelWhat,
    answer: oneshot::Sender<Result<CancelAnswer, CallFault>>,
}

struct Never;

impl ServiceCall for Never {
    fn service(&self) -> &'static str {
        ""
    }

    async fn call_by(&self, _: Bytes, _: Option<Instant>) -> Result<Bytes, CallFault> {
        std::future::pending().await
    }
}

impl ServiceGraph for Fake {
    type Client = Never;

    const WIRE: Wire = Wire::Ros1;

    fn service_type(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, String> {
        self.registry
            .service(name)
            .map_err(|error| error.to_string())
    }

    fn carrier(&mut self, _: BuiltinType, _: bool) -> Result<Option<Arc<MessageType>>, String> {
        Ok(None)
    }

    fn client(&mut self, _: &str, _: &ServiceType, _: Duration) -> Result<Never, String> {
        Ok(Never)
    }
}

impl CallGraph for Fake {
    type Server = ();

    const TELLS_FAULTS: bool = true;

    fn offer(&mut self, _: &str, _: &Arc<ServiceType>, _: Asker) -> Result<(), String> {
        Ok(())
    }
}

impl ActionGraph for Fake {
    type Sender = Client;
    type Taker = Server;

    fn action_calls(&mut self, name: &TypeName) -> Result<Arc<ActionCalls>, String> {
        let calls = self.registry.action_calls(name);
        calls.map(Arc::new).map_err(|error| error.to_string())
    }

    fn action_client(&mut self, _: &str, _: &TypeName, _: Waits) -> Result<Client, String> {
        Ok(Client {
            sent: self.sent.clone(),
            cancels: self.cancels.clone(),
        })
    }

    fn serve_action(&mut self, action: &str, _: &TypeName) -> Result<Server, String> {
        self.served.lock().unwrap().push(action.to_owned());
        Ok(Server {
            name: action.to_owned(),
            events: self.events.lock().unwrap().take().ok_or("it is served")?,
            served: Arc::clone(&self.served),
        })
    }
}

struct Client {
    sent: mpsc::Sender<Sent>,
    cancels: mpsc::Sender<Cancel>,
}

struct Heard(mpsc::Receiver<GoalEvent>);

impl SentGoal for Heard {
    async fn recv(&mut self) -> Option<GoalEvent> {
        self.0.recv().await
    }
}

impl ActionClient for Client {
    type Goal = Heard;

    fn send_goal(&self, id: GoalId, body: &[u8], _: Instant) -> Heard {
        let (say, heard) = mpsc::channel(16);
        let body = Bytes::copy_from_slice(body);
        self.sent.try_send(Sent { id, body, say }).ok().unwrap();
        Heard(heard)
    }

    async fn cancel(&self, what: CancelWhat) -> Result<CancelAnswer, CallFault> {
        let (answer, answered) = oneshot::channel();
        let asked = self.cancels.send(Cancel { what, answer }).await;
        asked.ok().unwrap();
        answered.await.unwrap()
    }
}

struct Server {
    name: String,
    events: mpsc::Receiver<ServerEvent<New, Request>>,
    served: Arc<Mutex<Vec<String>>>,
}

impl Drop for Server {
    fn drop(&mut self) {
        self.served
            .lock()
            .unwrap()
            .retain(|name| *name != self.name);
    }
}

impl ActionServer for Server {
    type New = New;
    type Cancel = Request;

    async fn recv(&mut self) -> ServerEvent<New, Request> {
        match self.events.recv().await {
            Some(event) => event,
            None => std::future::pending().await,
        }
    }
}

/// An event that a client of the graph receives.
#[derive(Debug, PartialEq, Eq)]
enum Told {
    Accepted,
    Rejected(String),
    Feedback(Bytes),
    Ended(i8, String, Option<Bytes>),
}

struct New {
    id: GoalId,
    body: Bytes,
    told: mpsc::Sender<Told>,
}

impl NewGoal for New {
    type Goal = Taken;

    fn id(&self) -> GoalId {
        self.id
    }

    fn body(&self) -> &Bytes {
        &self.body
    }

    async fn accept(self) -> Result<Taken, String> {
        self.told.try_send(Told::Accepted).unwrap();
        Ok(Taken(self.told))
    }

    fn reject(self, why: &str) {
        self.told.try_send(Told::Rejected(why.to_owned())).unwrap();
    }
}

struct Taken(mpsc::Sender<Told>);

impl ServedGoal for Taken {
    fn execute(&self) {}

    fn feedback(&self, body: &[u8]) -> Result<(), String> {
        let body = Bytes::copy_from_slice(body);
        self.0.try_send(Told::Feedback(body)).unwrap();
        Ok(())
    }

    fn end(&self, status: i8, message: &str, result: Option<&[u8]>) -> Result<(), String> {
        let result = result.map(Bytes::copy_from_slice);
        let ended = Told::Ended(status, message.to_owned(), result);
        self.0.try_send(ended).unwrap();
        Ok(())
    }
}

struct Request {
    id: GoalId,
    agreed: oneshot::Sender<bool>,
}

impl CancelRequest for Request {
    fn id(&self) -> GoalId {
        self.id
    }

    fn accept(self) -> Result<(), String> {
        self.agreed.send(true).map_err(|_| "gone".to_owned())
    }

    fn reject(self) {
        let _gone = self.agreed.send(false).is_err();
    }
}

/// A bridge of space 1 that executes, a bridge of space 2 that offers, and the space between them.
struct Space {
    graph: Fake,
    executing: Actions,
    offering: Actions,
    policies: [Policy; 2],
    calls: Calls<()>,
    asked: HashMap<ExecutionId, AskId>,
    next: u64,
    /// The servers of the graph of space 1.
    present: Present,
    sent: mpsc::Receiver<Sent>,
    cancels: mpsc::Receiver<Cancel>,
    clients: mpsc::Sender<ServerEvent<New, Request>>,
    statuses: Vec<Bytes>,
    served: Arc<Mutex<Vec<String>>>,
    /// Whether no executor is known.
    deserted: bool,
}

impl Space {
    fn new(mapping: &str) -> Self {
        let mut registry = Registry::bundle(Dialect::Ros1);
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
            executing: Actions::default(),
            offering: Actions::default(),
            policies: [1, 2].map(|space| policy(SpaceId::new(space).unwrap())),
            calls: Calls::default(),
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
    fn offered() -> Self {
        Self::offered_by(QUICK)
    }

    fn offered_by(mapping: &str) -> Self {
        let mut space = Self::new(mapping);
        let events = space.reconcile();
        assert_eq!(events.len(), 6, "{events:?}");
        space.announce(&events);
        let bound = space.offer();
        assert_eq!(bound.len(), 5, "{bound:?}");
        assert_eq!(*space.served.lock().unwrap(), [format!("/{GOAL}")]);
        space
    }

    fn reconcile(&mut self) -> Vec<PortEvent> {
        let [policy, _] = &mut self.policies;
        let present = (&self.present, 8);
        self.executing.reconcile(&mut self.graph, policy, present)
    }

    fn announce(&mut self, events: &[PortEvent]) {
        for (topic, offered) in offers(events) {
            self.offering.known(topic, &describe(offered));
        }
    }

    fn offer(&mut self) -> Vec<PortEvent> {
        let [_, policy] = &mut self.policies;
        let calls = &self.calls;
        let asker = |topic| calls.asker(topic);
        let with = (&mut self.graph, policy);
        self.offering.offer_waiting(with, asker, |_, _| true, 8)
    }

    /// Carries messages between the two bridges until `what` completes.
    async fn until<T>(&mut self, what: impl Future<Output = T>) -> T {
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
                let delivery = Delivery {
                    topic,
                    payload,
                    source,
                    status: 0,
                    instance: None,
                    kept: Kept::Alone,
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
    async fn client(&mut self) -> mpsc::Receiver<Told> {
        let (told, heard) = mpsc::channel(16);
        let body = Bytes::copy_from_slice(&7_i32.to_le_bytes());
        let new = New { id: ID, body, told };
        let clients = self.clients.clone();
        let sent = self.until(clients.send(ServerEvent::Goal(new))).await;
        sent.ok().unwrap();
        heard
    }

    /// Returns the goal that the server in space 1 receives.
    async fn server(&mut self) -> Sent {
        let mut sent = std::mem::replace(&mut self.sent, mpsc::channel(1).1);
        let goal = self.until(sent.recv()).await.unwrap();
        self.sent = sent;
        goal
    }

    async fn told(&mut self, heard: &mut mpsc::Receiver<Told>) -> Told {
        self.until(heard.recv()).await.unwrap()
    }

    /// Sends a goal as [`client`](Self::client) does, and waits until it is accepted on both sides.
    async fn running(&mut self) -> (Sent, mpsc::Receiver<Told>) {
        let mut heard = self.client().await;
        let goal = self.server().await;
        let accepted = GoalEvent::Accepted(Timestamp::from_unix_nanos(1_000));
        goal.say.send(accepted).await.unwrap();
        assert_eq!(self.told(&mut heard).await, Told::Accepted);
        (goal, heard)
    }

    /// Sends a request to cancel the goal from a client in space 2. Returns the receiver of the
    /// response.
    async fn cancel(&mut self) -> oneshot::Receiver<bool> {
        let (agreed, heard) = oneshot::channel();
        let clients = self.clients.clone();
        let request = Request { id: ID, agreed };
        let sent = self.until(clients.send(ServerEvent::Cancel(request))).await;
        sent.ok().unwrap();
        heard
    }

    /// Runs both bridges for a number of passes.
    async fn passes(&mut self, count: usize) {
        let passed = async {
            for _ in 0..count {
                tokio::task::yield_now().await;
            }
        };
        self.until(passed).await;
    }

    async fn cancelled(&mut self) -> Cancel {
        let mut cancels = std::mem::replace(&mut self.cancels, mpsc::channel(1).1);
        let cancel = self.until(cancels.recv()).await.unwrap();
        self.cancels = cancels;
        cancel
    }
}

fn offers(events: &[PortEvent]) -> impl Iterator<Item = (TopicId, &OfferedType)> {
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

const QUICK: &str = "
spaces: [{id: 1}, {id: 2}]
pubsub: {receive_timeout: 300ms, keep_alive_period: 100ms, key_frame_period: 100ms}
";

fn number(number: i32) -> Bytes {
    Bytes::copy_from_slice(&number.to_le_bytes())
}

#[tokio::test]
async fn a_goal_goes_to_its_server_and_its_feedback_and_result_come_back() {
    let mut space = Space::offered();
    let (goal, mut heard) = space.running().await;
    assert_eq!((goal.id, &goal.body), (ID, &number(7)));
    for so_far in 1..=3 {
        let feedback = GoalEvent::Feedback(number(so_far));
        goal.say.send(feedback).await.unwrap();
        assert_eq!(space.told(&mut heard).await, Told::Feedback(number(so_far)));
    }
    let ended = GoalEvent::Ended {
        status: 4,
        message: "done".to_owned(),
        result: number(42),
    };
    goal.say.send(ended).await.unwrap();
    let end = Told::Ended(4, "done".to_owned(), Some(number(42)));
    assert_eq!(space.told(&mut heard).await, end);
    // The status is accepted, then succeeded.
    let status = |status: u8| {
        let mut value = vec![16, 0, 0, 0];
        value.extend(ID);
        value.extend([1, 0, 0, 0, status]);
        Bytes::from(value)
    };
    assert_eq!(space.statuses, [status(1), status(4)]);
}

#[tokio::test]
async fn a_goal_that_its_server_does_not_take_is_rejected_with_the_reason() {
    let mut space = Space::offered();
    let mut heard = space.client().await;
    let goal = space.server().await;
    let rejected = GoalEvent::Rejected("too far".to_owned());
    goal.say.send(rejected).await.unwrap();
    let told = space.told(&mut heard).await;
    assert_eq!(told, Told::Rejected("too far".to_owned()));
    // A rejected goal is rejected again.
    let mut heard = space.client().await;
    let Told::Rejected(_) = space.told(&mut heard).await else {
        panic!("a goal that was rejected is rejected again");
    };
}

#[tokio::test]
async fn a_goal_is_cancelled_where_its_server_agrees() {
    let mut space = Space::offered();
    let (goal, mut heard) = space.running().await;
    for code in [1, 0] {
        let agreed = space.cancel().await;
        let cancel = space.cancelled().await;
        assert_eq!(cancel.what, CancelWhat::Goal(ID));
        let goals = vec![ID];
        cancel.answer.send(Ok(CancelAnswer { code, goals })).ok();
        let agreed = space.until(agreed).await.unwrap();
        assert_eq!(agreed, code == 0);
    }
    let ended = GoalEvent::Ended {
        status: 5,
        message: String::new(),
        result: number(3),
    };
    goal.say.send(ended).await.unwrap();
    let end = Told::Ended(5, String::new(), Some(number(3)));
    assert_eq!(space.told(&mut heard).await, end);
    // A request to cancel an ended goal is rejected without asking the server.
    let agreed = space.cancel().await;
    assert!(!space.until(agreed).await.unwrap());
}

#[tokio::test]
async fn a_request_to_cancel_waits_for_a_goal_that_is_on_its_way() {
    let mut space = Space::offered();
    let agreed = space.cancel().await;
    let cancel = space.cancelled().await;
    let unknown = CancelAnswer {
        code: 2,
        goals: Vec::new(),
    };
    cancel.answer.send(Ok(unknown)).ok();
    let _goal = space.running().await;
    let cancel = space.cancelled().await;
    let goals = vec![ID];
    cancel.answer.send(Ok(CancelAnswer { code: 0, goals })).ok();
    assert!(space.until(agreed).await.unwrap());
}

#[tokio::test]
async fn a_goal_whose_server_dies_ends_with_the_reason() {
    let mut space = Space::offered();
    let (goal, mut heard) = space.running().await;
    let lost = GoalEvent::Lost {
        text: "the server has left".to_owned(),
        ran: Ran::Perhaps,
    };
    goal.say.send(lost).await.unwrap();
    let Told::Ended(6, why, None) = space.told(&mut heard).await else {
        panic!("it is aborted");
    };
    assert_eq!(why, "the server has left");
    // The client of a goal that was never sent receives the reason.
    let mut space = Space::offered();
    let mut heard = space.client().await;
    let goal = space.server().await;
    let lost = GoalEvent::Lost {
        text: "no server".to_owned(),
        ran: Ran::No,
    };
    goal.say.send(lost).await.unwrap();
    let Told::Rejected(why) = space.told(&mut heard).await else {
        panic!("it is rejected");
    };
    assert!(why.starts_with("not executed"), "{why}");
}

#[tokio::test]
async fn a_goal_waits_for_a_server_that_is_started_anew_and_is_rejected_where_none_is() {
    const PATIENT: &str = "spaces: [{id: 1}, {id: 2}]\npubsub: {receive_timeout: 60s}\n";
    let mut space = Space::offered_by(PATIENT);
    space.offering.gone(of_goals(), now().monotonic);
    space.deserted = true;
    let mut heard = space.client().await;
    let pause = tokio::time::sleep(Duration::from_millis(300));
    space.until(pause).await;
    assert!(heard.try_recv().is_err(), "it waits");
    space.deserted = false;
    let events = Space::new(PATIENT).reconcile();
    space.announce(&events);
    let goal = space.server().await;
    let accepted = GoalEvent::Accepted(Timestamp::from_unix_nanos(1_000));
    goal.say.send(accepted).await.unwrap();
    assert_eq!(space.told(&mut heard).await, Told::Accepted);

    for is_gone in [true, false] {
        let mut space = Space::offered();
        space.deserted = true;
        if is_gone {
            space.offering.gone(of_goals(), now().monotonic);
        }
        let mut heard = space.client().await;
        let told = space.told(&mut heard).await;
        assert_eq!(
            told,
            Told::Rejected("not executed: nobody executes it".to_owned())
        );
    }
}

#[tokio::test]
async fn a_goal_goes_on_while_its_action_is_withdrawn_for_a_moment() {
    const PATIENT: &str = "spaces: [{id: 1}, {id: 2}]\npubsub: {receive_timeout: 60s}\n";
    let mut space = Space::offered_by(PATIENT);
    let (goal, mut heard) = space.running().await;
    space.offering.gone(of_goals(), now().monotonic);
    // The request for the result is refused, because the action is not known.
    let asked: Vec<AskId> = space.asked.values().copied().collect();
    for ask in asked {
        let refused = AskError {
            kind: AskErrorKind::Refused,
            status: StatusCode::GOOD,
            text: "nobody executes it".to_owned(),
        };
        space.calls.answered(ask, Err(refused));
    }
    space.deserted = true;
    space
        .until(tokio::time::sleep(Duration::from_millis(300)))
        .await;
    while let Ok(told) = heard.try_recv() {
        assert!(!matches!(told, Told::Ended(..)), "{told:?}");
    }
    space.deserted = false;
    let events = Space::new(PATIENT).reconcile();
    space.announce(&events);
    let ended = GoalEvent::Ended {
        status: 4,
        message: String::new(),
        result: number(3),
    };
    goal.say.send(ended).await.unwrap();
    let end = Told::Ended(4, String::new(), Some(number(3)));
    assert_eq!(space.told(&mut heard).await, end);
}

#[tokio::test]
async fn of_two_cancellations_of_one_moment_a_server_hears_one() {
    let mut space = Space::offered();
    let (goal, mut heard) = space.running().await;
    let first = space.cancel().await;
    let cancel = space.cancelled().await;
    let second = space.cancel().await;
    space.passes(200).await;
    assert!(space.cancels.try_recv().is_err(), "the server hears one");
    let goals = vec![ID];
    cancel.answer.send(Ok(CancelAnswer { code: 0, goals })).ok();
    assert!(space.until(first).await.unwrap());
    assert!(space.until(second).await.unwrap());
    // A further request is answered without asking the server, which would refuse it.
    let third = space.cancel().await;
    assert!(space.until(third).await.unwrap());
    let ended = GoalEvent::Ended {
        status: 5,
        message: String::new(),
        result: number(3),
    };
    goal.say.send(ended).await.unwrap();
    let end = Told::Ended(5, String::new(), Some(number(3)));
    assert_eq!(space.told(&mut heard).await, end);
}

#[tokio::test]
async fn the_goals_of_a_bridge_that_is_gone_are_aborted_and_its_server_withdrawn() {
    let mut space = Space::offered();
    let (_goal, mut heard) = space.running().await;
    // The bridge is silent: requests are not answered any more.
    space.executing = Actions::default();
    space.offering.gone(of_goals(), now().monotonic);
    let end = async {
        loop {
            match heard.recv().await {
                Some(Told::Ended(status, why, None)) => return (status, why),
                Some(_) => {}
                None => panic!("it has an end"),
            }
        }
    };
    // Its open requests fail, as with a silent responder.
    let asked: Vec<AskId> = space.asked.values().copied().collect();
    for ask in asked {
        let silent = AskError {
            kind: AskErrorKind::Unknown,
            status: StatusCode::GOOD,
            text: "the responder is lost".to_owned(),
        };
        space.calls.answered(ask, Err(silent));
    }
    let (status, why) = space.until(end).await;
    assert_eq!(status, 6);
    assert!(why.contains("the executor of the action is lost"), "{why}");
    let [_, policy] = &space.policies;
    space.offering.tidy(policy, now().monotonic);
    assert_eq!(space.served.lock().unwrap().len(), 1);
    let later = now().monotonic + Duration::from_secs(3);
    space.offering.tidy(policy, later);
    assert_eq!(space.offering.offered().len(), 0);
    let events = space.offering.recv().await;
    assert_eq!(events.len(), 5, "{events:?}");
    let withdrawn = async {
        while !space.served.lock().unwrap().is_empty() {
            tokio::task::yield_now().await;
        }
    };
    timeout(Duration::from_secs(5), withdrawn).await.unwrap();
}

#[tokio::test]
async fn a_server_that_goes_is_withdrawn_and_the_ends_of_its_goals_can_still_be_asked_for() {
    let mut space = Space::offered();
    let (goal, _heard) = space.running().await;
    let present = std::mem::take(&mut space.present);
    let events = space.reconcile();
    let withdrawn = |event: &PortEvent| matches!(event, PortEvent::Withdrawn { .. });
    assert!(
        events.len() == 5 && events.iter().all(withdrawn),
        "{events:?}"
    );
    let lost = GoalEvent::Lost {
        text: "it has left".to_owned(),
        ran: Ran::Perhaps,
    };
    goal.say.send(lost).await.unwrap();
    space.present = present;
    let events = space.reconcile();
    assert_eq!(events.len(), 5, "{events:?}");
    let role =
        offers(&events).find_map(|(topic, offered)| (topic == of_goals()).then_some(offered.role));
    let Some(CallRole::Goal(family)) = role else {
        panic!("{events:?}");
    };
    assert_eq!((family.cancel, family.status), (71, 74));
    let result = executors::beside(of_goals(), family.result).unwrap();
    let asker = space.calls.asker(result);
    let asked = asker.ask(wire::result_request(Wire::Ros1, ID));
    let answer = space.until(asked).await.unwrap();
    let outcome = wire::read_outcome(Wire::Ros1, &answer).unwrap();
    assert_eq!((outcome.status, &outcome.message[..]), (0, "it has left"));
    assert_eq!(outcome.result, number(0));
}

#[tokio::test]
async fn who_executes_chooses_an_id_and_several_may_wait_for_a_result() {
    let mut space = Space::offered();
    let request = wire::join(Wire::Ros1, NO_GOAL, &number(5)).unwrap();
    let asked = space.calls.asker(of_goals()).ask(request);
    let mut sent = std::mem::replace(&mut space.sent, mpsc::channel(1).1);
    let server = async {
        let goal = sent.recv().await.unwrap();
        let accepted = GoalEvent::Accepted(Timestamp::from_unix_nanos(5_000));
        goal.say.send(accepted).await.unwrap();
        goal
    };
    let (goal, answer) = space.until(async { tokio::join!(server, asked) }).await;
    let answer = wire::read_goal_answer(Wire::Ros1, &answer.unwrap()).unwrap();
    assert!(answer.accepted && answer.id != NO_GOAL && answer.id == goal.id);
    assert_eq!(answer.stamp, Timestamp::from_unix_nanos(5_000));
    let result = executors::beside(of_goals(), 72).unwrap();
    let ask = |space: &Space| {
        let asker = space.calls.asker(result);
        asker.ask(wire::result_request(Wire::Ros1, goal.id))
    };
    let (one, two) = (ask(&space), ask(&space));
    let short = space
        .calls
        .asker(result)
        .within(Duration::from_millis(1200))
        .ask(wire::result_request(Wire::Ros1, goal.id));
    // The deadline of the request is close.
    let why = space.until(short).await.unwrap_err();
    assert!(why.starts_with("not executed"), "{why}");
    let ended = GoalEvent::Ended {
        status: 6,
        message: "no way".to_owned(),
        result: number(8),
    };
    goal.say.send(ended).await.unwrap();
    let (one, two) = space.until(async { tokio::join!(one, two) }).await;
    for answer in [one, two] {
        let outcome = wire::read_outcome(Wire::Ros1, &answer.unwrap()).unwrap();
        assert_eq!((outcome.status, outcome.message), (6, "no way".to_owned()));
        assert_eq!(outcome.result, number(8));
    }
    // A request to cancel all goals that were accepted until a time.
    let cancel = executors::beside(of_goals(), 71).unwrap();
    let request = wire::CancelRequest {
        id: NO_GOAL,
        until: Some(Timestamp::from_unix_nanos(9_000)),
    };
    let asked = space.calls.asker(cancel);
    let asked = asked.ask(wire::cancel_request(Wire::Ros1, request));
    let answer = space.until(asked).await.unwrap();
    let answer = wire::read_cancel_answer(Wire::Ros1, &answer).unwrap();
    // No goal is open any more.
    assert_eq!((answer.code, answer.goals.len()), (0, 0));
}

#[tokio::test]
async fn an_action_has_the_name_and_type_of_the_mapping() {
    let mut space = Space::new(
        "
spaces: [{id: 1}, {id: 2}]
namespaces: {2: 'urn:test:cell'}
calls:
  - node: ns=2;i=70
    name: Count
    origin: 1
    ros:
      - {action: /count, type: demo_msgs/Count}
      - {space: 2, action: /arm/count, type: demo_msgs/Count, goal: {order: 3}}
    open: true
",
    );
    space.present = [("/count".to_owned(), NAME.parse().ok())].into();
    let events = space.reconcile();
    let (_, offered) = offers(&events)
        .find(|(topic, _)| topic.triple().2 == 72)
        .unwrap();
    assert_eq!(offered.name, "Count.Result");
    assert!(offered.open && offered.role == CallRole::Result { of: 70 });
    space.announce(&events);
    let [_, policy] = &space.policies;
    assert_eq!(
        space.offering.chosen(policy),
        [(of_goals(), "/arm/count".to_owned())]
    );
    let bound = space.offer();
    assert_eq!(*space.served.lock().unwrap(), ["/arm/count"]);
    let PortEvent::CallBound { map, .. } = &bound[0] else {
        panic!("{bound:?}");
    };
    assert_eq!(map.request.0.len(), 1);
    assert_eq!(map.request.0[0].target, "goal.order");
}

#[tokio::test]
async fn a_variable_of_the_mapping_is_no_value_of_an_action() {
    let variable = "variables: [{node: ns=2;i=73, name: Speed, origin: 1}]\n";
    let mut space = Space::new(&format!("{QUICK}namespaces: {{2: urn:test}}\n{variable}"));
    assert!(space.reconcile().is_empty(), "its feedback would be that");
    // A bridge with another mapping announces the action all the same.
    let events = Space::new(QUICK).reconcile();
    space.announce(&events);
    assert!(space.offer().is_empty());
    let [feedback, status] = [73, 74].map(|id| TopicId::new(1, 2, id).unwrap());
    let policy = &space.policies[1];
    assert!(!space.offering.takes(policy, feedback) && space.offering.takes(policy, status));
    assert!(space.served.lock().unwrap().is_empty());
}

#[tokio::test]
async fn actions_that_would_have_the_same_calls_are_not_both_offered() {
    let mut space = Space::new(QUICK);
    for name in ["/ua_1_2_66", "/ua_1_2_73", "/ua_1_2_75"] {
        space.present.insert(name.to_owned(), NAME.parse().ok());
    }
    let offered = |events: &[PortEvent]| {
        let goals = offers(events).filter(|(_, offered)| matches!(offered.role, CallRole::Goal(_)));
        let mut goals: Vec<u16> = goals.map(|(topic, _)| topic.triple().2).collect();
        goals.sort_unstable();
        goals
    };
    let events = space.reconcile();
    // The first action occupies 66 to 70, so the action at 70 is not offered, and 75 belongs to the
    // action at 73.
    assert_eq!(offered(&events), [66, 73]);
    assert_eq!(space.reconcile().len(), 0);
}

#[tokio::test]
async fn a_goal_that_is_cancelled_before_its_server_decides_is_withdrawn() {
    let mut space = Space::offered();
    let mut heard = space.client().await;
    let goal = space.server().await;
    let agreed = space.cancel().await;
    let cancel = space.cancelled().await;
    assert_eq!(cancel.what, CancelWhat::Goal(ID));
    assert_eq!(space.until(agreed).await, Ok(true));
    let pending = space.executing.pending();
    assert!(
        matches!(&pending[..], [line] if line.contains(&"09".repeat(16))),
        "{pending:?}"
    );
    // Its outcome is unknown, and it is not sent again.
    let told = space.told(&mut heard).await;
    assert!(matches!(told, Told::Rejected(_)), "{told:?}");
    let accepted = GoalEvent::Accepted(Timestamp::from_unix_nanos(1_000));
    goal.say.send(accepted).await.unwrap();
    goal.say.send(GoalEvent::Status(3)).await.unwrap();
    let deadline = now().monotonic + Duration::from_secs(20);
    while !space.executing.pending().is_empty() {
        assert!(now().monotonic < deadline, "it is being cancelled");
        space.until(tokio::task::yield_now()).await;
    }
}
