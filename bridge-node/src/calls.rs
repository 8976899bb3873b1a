//! Calls of other spaces, offered as services of a ROS graph under their names: `/ua_0_7_105`.
//!
//! Under which type is [`policy`](crate::policy)'s matter, how a service is offered the graph's; what is asked goes to the
//! Router as [`PortEvent::Ask`], and its answer comes back by [`answered`](Calls::answered).

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use bridge_core::{Answered, AskId, CallDescription};
use bytes::Bytes;
use mappings::TopicId;
use messages::{Literal, MessageType, NoFields, Plan, Selection, ServiceType, Wire};
use tokio::sync::{mpsc, oneshot};
use tracing::{debug, info};

use crate::policy::{Policy, call_type};
use crate::{PortEvent, ServiceGraph};

/// A ROS graph that services can be offered in.
pub trait CallGraph: ServiceGraph {
    /// An offered service, which is withdrawn when this is dropped.
    type Server: Send;

    /// Whether a caller can be told that its call failed, and why.
    const TELLS_FAULTS: bool;

    /// Offers a service: each request goes to `asker`.
    ///
    /// # Errors
    /// Why there can be none, for people.
    fn offer(
        &mut self,
        service: &str,
        service_type: &Arc<ServiceType>,
        asker: Asker,
    ) -> Result<Self::Server, String>;
}

/// The calls of other spaces that a port knows, and what its graph asks them.
#[derive(Debug)]
pub struct Calls<S> {
    known: BTreeMap<TopicId, Known<S>>,
    /// Services of calls that are gone, since when: who waits for an answer is still told.
    leaving: Vec<(Instant, TopicId, S)>,
    /// What was asked and is not answered.
    asked: HashMap<AskId, Asked>,
    said: mpsc::Receiver<Said>,
    say: mpsc::Sender<Said>,
    next: Arc<AtomicU64>,
}

#[derive(Debug)]
struct Known<S> {
    described: Arc<CallDescription>,
    state: State<S>,
}

#[derive(Debug)]
enum State<S> {
    /// To be offered when there is time for it.
    Waiting,
    /// There is no service type for it here, or no room.
    Refused,
    Offered {
        service_type: Arc<ServiceType>,
        server: S,
    },
}

#[derive(Debug)]
struct Asked {
    topic: TopicId,
    answer: oneshot::Sender<Result<Bytes, String>>,
    /// An answer that says no, where the caller can be told in no other way.
    says_no: Option<Arc<MessageType>>,
}

/// Asks one call of another space, on behalf of whoever calls its service.
#[derive(Debug, Clone)]
pub struct Asker {
    topic: TopicId,
    say: mpsc::Sender<Said>,
    next: Arc<AtomicU64>,
}

/// What the services of a port say to it.
#[derive(Debug)]
enum Said {
    Ask {
        ask: AskId,
        topic: TopicId,
        request: Bytes,
        answer: oneshot::Sender<Result<Bytes, String>>,
    },
    GivenUp(AskId),
}

/// Says that an answer is no longer waited for, unless it came. Its place in the queue was taken with that of the question.
struct GiveUp {
    ask: AskId,
    place: Option<mpsc::OwnedPermit<Said>>,
}

impl Drop for GiveUp {
    fn drop(&mut self) {
        if let Some(place) = self.place.take() {
            drop(place.send(Said::GivenUp(self.ask)));
        }
    }
}

impl Asker {
    /// Asks with a request as the messages of that ROS are on the wire; the answer is likewise. Dropping the future gives
    /// the question up. Ends in bounded time, as every call of the space does.
    ///
    /// # Errors
    /// Why there is no answer, for people.
    pub fn ask(
        &self,
        request: Bytes,
    ) -> impl Future<Output = Result<Bytes, String>> + Send + use<> {
        let asked = self.send(request);
        async move {
            let (mut give_up, answer) = asked?;
            let answer = answer.await;
            give_up.place = None;
            answer.unwrap_or_else(|_| Err("the call is not there any more".to_owned()))
        }
    }

    fn send(
        &self,
        request: Bytes,
    ) -> Result<(GiveUp, oneshot::Receiver<Result<Bytes, String>>), String> {
        let ask = AskId(self.next.fetch_add(1, Ordering::Relaxed));
        let place = || {
            let place = self.say.clone().try_reserve_owned();
            place.map_err(|_| format!("more than {MOST_ASKED} calls of the space are under way"))
        };
        let (question, later) = (place()?, place()?);
        let (answer, answered) = oneshot::channel();
        let topic = self.topic;
        drop(question.send(Said::Ask {
            ask,
            topic,
            request,
            answer,
        }));
        let place = Some(later);
        Ok((GiveUp { ask, place }, answered))
    }
}

impl<S: Send> Default for Calls<S> {
    fn default() -> Self {
        let (say, said) = mpsc::channel(MOST_ASKED);
        Self {
            known: BTreeMap::new(),
            leaving: Vec::new(),
            asked: HashMap::new(),
            said,
            say,
            next: Arc::default(),
        }
    }
}

impl<S: Send> Calls<S> {
    /// A call of another space is known, or what is said of it has changed. It is offered by
    /// [`offer_waiting`](Self::offer_waiting).
    pub fn known(&mut self, topic: TopicId, described: Arc<CallDescription>) {
        match self.known.get_mut(&topic) {
            Some(known) if known.described == described => {}
            Some(known) => {
                known.described = described;
                known.state = State::Waiting;
            }
            None => {
                let state = match self.known.len() < MOST_CALLS {
                    true => State::Waiting,
                    false => State::Refused,
                };
                self.known.insert(topic, Known { described, state });
            }
        }
    }

    /// A call is gone: its service is withdrawn, a little later where somebody waits for an answer.
    pub fn gone(&mut self, topic: TopicId, now: Instant) {
        let Some(known) = self.known.remove(&topic) else {
            return;
        };
        if let State::Offered { server, .. } = known.state {
            info!(%topic, "the call is gone: its service is withdrawn");
            if self.asked.values().any(|asked| asked.topic == topic) {
                self.leaving.push((now, topic, server));
            }
        }
    }

    /// Lets go of the services of calls that are gone, once everybody who waited was told.
    pub fn tidy(&mut self, now: Instant) {
        let asked = &mut self.asked;
        self.leaving.retain(|(since, topic, _)| {
            let age = now.duration_since(*since);
            if age >= ANSWERED_AFTER {
                for (_, asked) in asked.extract_if(|_, asked| asked.topic == *topic) {
                    asked.fail(GONE);
                }
            }
            age < LEFT_AFTER
        });
    }

    /// Has calls looked at again, as definitions or the mapping may be others: those that are not offered, and those whose
    /// type is another now.
    pub fn look_again<G: CallGraph<Server = S>>(&mut self, graph: &mut G) {
        for known in self.known.values_mut() {
            let again = match &known.state {
                State::Waiting | State::Refused => true,
                // A file that cannot be read for the moment changes nothing.
                State::Offered { service_type, .. } => graph
                    .service_type(service_type.name())
                    .is_ok_and(|now| !now.is_same(service_type)),
            };
            if again {
                known.state = State::Waiting;
            }
        }
    }

    /// The services that are there.
    pub fn servers(&self) -> impl Iterator<Item = &S> {
        let offered = self.known.values().filter_map(|known| match &known.state {
            State::Offered { server, .. } => Some(server),
            State::Waiting | State::Refused => None,
        });
        offered.chain(self.leaving.iter().map(|(_, _, server)| server))
    }

    /// Whether any call waits to be offered.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        let mut known = self.known.values();
        known.any(|known| matches!(known.state, State::Waiting))
    }

    /// Withdraws the services of the calls that are left to others, and has them wait.
    pub fn leave(&mut self, to_others: impl Fn(TopicId) -> bool) {
        for (topic, known) in &mut self.known {
            if let State::Offered { .. } = known.state
                && to_others(*topic)
            {
                known.state = State::Waiting;
            }
        }
    }

    /// Offers calls that wait and `may` be offered, at most so many. Reports the types of their services.
    pub fn offer_waiting<G: CallGraph<Server = S>>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
        may: impl Fn(TopicId) -> bool,
        most: usize,
    ) -> Vec<PortEvent> {
        let waiting = self
            .known
            .iter_mut()
            .filter(|(topic, known)| matches!(known.state, State::Waiting) && may(**topic));
        let mut events = Vec::new();
        for (topic, known) in waiting.take(most) {
            let topic = *topic;
            // One name has one service.
            self.leaving.retain(|(_, left, _)| *left != topic);
            let asker = Asker {
                topic,
                say: self.say.clone(),
                next: Arc::clone(&self.next),
            };
            let service_type = call_type(&known.described, None, |name| graph.service_type(name));
            let offered = service_type.and_then(|service_type| {
                let server = graph.offer(&format!("/{topic}"), &service_type, asker)?;
                Ok((service_type, server))
            });
            known.state = match offered {
                Ok((service_type, server)) => {
                    info!(%topic, service_type = %service_type.name(), "offered as a service");
                    events.push(PortEvent::CallBound {
                        topic,
                        service_type: Arc::clone(&service_type),
                    });
                    State::Offered {
                        service_type,
                        server,
                    }
                }
                Err(why) => {
                    policy.told.once(&topic.to_string(), "no service", || {
                        let name = &known.described.name;
                        format!("the call {name} cannot be asked for as a service: {why}")
                    });
                    State::Refused
                }
            };
        }
        events
    }

    /// What the services were asked next. Cancel-safe.
    pub async fn recv<G: CallGraph<Server = S>>(&mut self) -> PortEvent {
        std::future::poll_fn(|cx| self.poll_recv::<G>(cx)).await
    }

    /// As [`recv`](Self::recv), for ports that poll.
    pub fn poll_recv<G: CallGraph<Server = S>>(&mut self, cx: &mut Context<'_>) -> Poll<PortEvent> {
        loop {
            let said = match self.said.poll_recv(cx) {
                Poll::Ready(Some(said)) => said,
                // Never `None` while we hold a sender ourselves.
                Poll::Ready(None) | Poll::Pending => return Poll::Pending,
            };
            match said {
                Said::Ask {
                    ask,
                    topic,
                    request,
                    answer,
                } => {
                    // One that was withdrawn meanwhile answers by the end of its sender.
                    let Some(State::Offered { service_type, .. }) =
                        self.known.get(&topic).map(|known| &known.state)
                    else {
                        continue;
                    };
                    let says_no = (!G::TELLS_FAULTS).then(|| Arc::clone(service_type.response()));
                    let asked = Asked {
                        topic,
                        answer,
                        says_no,
                    };
                    self.asked.insert(ask, asked);
                    return Poll::Ready(PortEvent::Ask {
                        topic,
                        ask,
                        request,
                        timeout: ANSWERED_WITHIN,
                    });
                }
                Said::GivenUp(ask) => {
                    if self.asked.remove(&ask).is_some() {
                        return Poll::Ready(PortEvent::AskGivenUp { ask });
                    }
                }
            }
        }
    }

    /// Hands an answer to who asked.
    pub fn answered(&mut self, ask: AskId, answer: Answered<Bytes>) {
        let Some(asked) = self.asked.remove(&ask) else {
            return;
        };
        match answer {
            Ok(bytes) => drop(asked.answer.send(Ok(bytes))),
            Err(fault) => asked.fail(&fault.to_string()),
        }
    }
}

impl Asked {
    fn fail(self, why: &str) {
        debug!(topic = %self.topic, why, "a call came to nothing");
        let no = self.says_no.and_then(|response| no(&response, why));
        // Who asked may have gone.
        drop(self.answer.send(no.ok_or_else(|| why.to_owned())));
    }
}

/// The response that says no, with the reason, in services of a ROS that has no word for failure: one of the type
/// `std_srvs/Trigger`, or of another with nothing but `success` and `message`.
fn no(response: &Arc<MessageType>, why: &str) -> Option<Bytes> {
    let paths: Vec<&str> = response
        .leaves()
        .iter()
        .map(|leaf| leaf.path.as_str())
        .collect();
    if paths != ["success", "message"] {
        return None;
    }
    let one = |text: &str| Literal::One(text.to_owned());
    let template = Selection::Template {
        fields: Vec::new(),
        rest: BTreeMap::from([
            ("success".to_owned(), one("false")),
            ("message".to_owned(), one(why)),
        ]),
    };
    let plan = Plan::compile(response, &template, Wire::Cdr).ok()?;
    let mut bytes = Vec::new();
    plan.write(&mut NoFields, &mut bytes).ok()?;
    Some(bytes.into())
}

/// Calls that are offered as services: anybody in the space can announce some.
const MOST_CALLS: usize = 1024;
/// What who waits is told when the one who executes a call is gone.
const GONE: &str = "whoever executes the call is gone; it is not known whether it was executed";
/// From when on that is told: the Router may have an answer yet.
const ANSWERED_AFTER: Duration = Duration::from_secs(1);
/// How long a service stays when its call is gone, so that it can be told.
const LEFT_AFTER: Duration = Duration::from_secs(2);
/// How long a call may take: services of ROS have no deadline of their own.
const ANSWERED_WITHIN: Duration = Duration::from_secs(30);
/// Questions of all services that are under way.
const MOST_ASKED: usize = 128;

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use bridge_core::{AskError, AskErrorKind, CallField};
    use mappings::SpaceId;
    use messages::{Dialect, Registry, TypeName};
    use uadp::{BuiltinType, StatusCode};

    use super::*;
    use crate::{CallFault, ServiceCall, now};

    type Offered = Arc<Mutex<BTreeMap<String, Asker>>>;

    /// A graph whose services the test calls.
    struct Fake {
        registry: Registry,
        offered: Offered,
    }

    struct Server(String, Offered);

    impl Drop for Server {
        fn drop(&mut self) {
            self.1.lock().unwrap().remove(&self.0);
        }
    }

    struct NoClient;

    impl ServiceCall for NoClient {
        fn service(&self) -> &str {
            "/none"
        }

        async fn call(&self, _: Bytes) -> Result<Bytes, CallFault> {
            std::future::pending().await
        }
    }

    impl ServiceGraph for Fake {
        type Client = NoClient;

        const WIRE: Wire = Wire::Cdr;

        fn service_type(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, String> {
            self.registry
                .service(name)
                .map_err(|error| error.to_string())
        }

        fn carrier(&mut self, _: BuiltinType, _: bool) -> Result<Option<Arc<MessageType>>, String> {
            Ok(None)
        }

        fn client(&mut self, _: &str, _: &ServiceType, _: Duration) -> Result<NoClient, String> {
            Ok(NoClient)
        }
    }

    impl CallGraph for Fake {
        type Server = Server;

        const TELLS_FAULTS: bool = false;

        fn offer(
            &mut self,
            service: &str,
            _: &Arc<ServiceType>,
            asker: Asker,
        ) -> Result<Server, String> {
            let mut offered = self.offered.lock().unwrap();
            offered.insert(service.to_owned(), asker);
            Ok(Server(service.to_owned(), Arc::clone(&self.offered)))
        }
    }

    struct Bench {
        graph: Fake,
        policy: Policy,
        calls: Calls<Server>,
    }

    impl Bench {
        fn new() -> Self {
            Self {
                graph: Fake {
                    registry: Registry::bundle(Dialect::Ros2),
                    offered: Offered::default(),
                },
                policy: Policy::new(SpaceId::ROS1, Arc::default()),
                calls: Calls::default(),
            }
        }

        /// The services that are there.
        fn services(&self) -> Vec<String> {
            self.graph.offered.lock().unwrap().keys().cloned().collect()
        }

        fn offer(&mut self) -> Vec<PortEvent> {
            let all = |_| true;
            self.calls
                .offer_waiting(&mut self.graph, &mut self.policy, all, usize::MAX)
        }

        fn asker(&self, service: &str) -> Asker {
            self.graph.offered.lock().unwrap()[service].clone()
        }

        async fn heard(&mut self) -> PortEvent {
            self.calls.recv::<Fake>().await
        }

        /// The number and topic of what is asked next.
        async fn asked(&mut self) -> (AskId, TopicId) {
            let event = self.heard().await;
            let PortEvent::Ask { ask, topic, .. } = event else {
                panic!("{event:?}");
            };
            (ask, topic)
        }
    }

    fn topic(id: u16) -> TopicId {
        format!("ua_0_7_{id}").parse().unwrap()
    }

    fn start(response: &[(&str, BuiltinType)]) -> Arc<CallDescription> {
        let fields = response.iter();
        Arc::new(CallDescription {
            name: "gripper.Grasp.Start".to_owned(),
            about: String::new(),
            request: Vec::new(),
            response: fields
                .map(|(name, builtin)| CallField::scalar(name, *builtin))
                .collect(),
        })
    }

    fn trigger() -> Arc<CallDescription> {
        start(&[
            ("success", BuiltinType::Boolean),
            ("message", BuiltinType::String),
            ("run", BuiltinType::UInt32),
        ])
    }

    fn fault(text: &str) -> AskError {
        AskError {
            kind: AskErrorKind::Unknown,
            status: StatusCode::GOOD,
            text: text.to_owned(),
        }
    }

    /// A trigger's `success` and `message`.
    fn read(answer: &[u8]) -> (bool, String) {
        let success = answer[4] == 1;
        let length = u32::from_le_bytes(answer[8..12].try_into().unwrap());
        let text = &answer[12..12 + usize::try_from(length).unwrap() - 1];
        (success, String::from_utf8(text.to_vec()).unwrap())
    }

    #[tokio::test]
    async fn a_call_is_a_service_from_when_it_is_known_until_it_is_gone() {
        let mut bench = Bench::new();
        bench.calls.known(topic(105), trigger());
        assert!(bench.services().is_empty() && bench.calls.is_waiting());
        let events = bench.offer();
        assert!(matches!(
            &events[..],
            [PortEvent::CallBound { topic: of, service_type }]
                if *of == topic(105) && service_type.name().to_string() == "std_srvs/Trigger"
        ));
        assert_eq!(bench.services(), ["/ua_0_7_105"]);
        // Said again, it is left alone; said to be another, it is offered anew.
        bench.calls.known(topic(105), trigger());
        assert!(!bench.calls.is_waiting());
        bench.calls.known(topic(105), start(&[]));
        assert!(bench.calls.is_waiting());
        assert_eq!(bench.offer().len(), 1);
        bench.calls.gone(topic(105), now().monotonic);
        assert_eq!(bench.services(), [""; 0]);
    }

    #[tokio::test]
    async fn who_waits_for_a_call_that_is_gone_is_told_before_its_service_goes() {
        let mut bench = Bench::new();
        bench.calls.known(topic(105), trigger());
        bench.offer();
        let waits = tokio::spawn(bench.asker("/ua_0_7_105").ask(Bytes::new()));
        bench.asked().await;
        let now = now().monotonic;
        bench.calls.gone(topic(105), now);
        bench.calls.tidy(now);
        assert!(!waits.is_finished());
        bench.calls.tidy(now + ANSWERED_AFTER);
        let (success, why) = read(&waits.await.unwrap().unwrap());
        assert!(!success && why == GONE, "{why}");
        assert_eq!(bench.services(), ["/ua_0_7_105"]);
        bench.calls.tidy(now + LEFT_AFTER);
        assert_eq!(bench.services(), [""; 0]);
    }

    #[tokio::test]
    async fn each_answer_goes_to_who_asked_and_one_that_is_given_up_to_nobody() {
        let mut bench = Bench::new();
        for id in [105, 205] {
            bench.calls.known(topic(id), trigger());
        }
        assert_eq!(bench.offer().len(), 2);
        let [one, other] = ["/ua_0_7_105", "/ua_0_7_205"].map(|service| bench.asker(service));
        let first = tokio::spawn(one.ask(Bytes::from_static(b"1")));
        let (first_ask, of) = bench.asked().await;
        assert_eq!(of, topic(105));
        let second = tokio::spawn(other.ask(Bytes::from_static(b"2")));
        let (second_ask, of) = bench.asked().await;
        assert_eq!(of, topic(205));
        let given_up = tokio::spawn(one.ask(Bytes::from_static(b"3")));
        let (third_ask, _) = bench.asked().await;
        given_up.abort();
        let event = bench.heard().await;
        assert!(matches!(event, PortEvent::AskGivenUp { ask } if ask == third_ask));
        for (ask, text) in [
            (third_ask, "third"),
            (second_ask, "second"),
            (first_ask, "first"),
        ] {
            bench.calls.answered(ask, Ok(text.into()));
        }
        assert_eq!(first.await.unwrap().unwrap(), "first");
        assert_eq!(second.await.unwrap().unwrap(), "second");
    }

    #[tokio::test]
    async fn a_fault_is_told_by_services_that_can_say_no() {
        let mut bench = Bench::new();
        bench.calls.known(topic(105), trigger());
        bench.calls.known(topic(106), start(&[]));
        bench.offer();
        let said = tokio::spawn(bench.asker("/ua_0_7_105").ask(Bytes::new()));
        let (ask, _) = bench.asked().await;
        bench.calls.answered(ask, Err(fault("nobody knows")));
        let answer = said.await.unwrap().unwrap();
        assert_eq!(read(&answer), (false, "nobody knows".to_owned()));
        let said = tokio::spawn(bench.asker("/ua_0_7_106").ask(Bytes::new()));
        let (ask, _) = bench.asked().await;
        bench.calls.answered(ask, Err(fault("nobody knows")));
        assert_eq!(said.await.unwrap().unwrap_err(), "nobody knows");
    }

    #[tokio::test]
    async fn no_more_is_asked_at_a_time_than_there_is_room_for() {
        let mut bench = Bench::new();
        bench.calls.known(topic(105), trigger());
        bench.offer();
        let asker = bench.asker("/ua_0_7_105");
        let mut asks = Vec::new();
        for _ in 0..MOST_ASKED - 1 {
            asks.push(tokio::spawn(asker.ask(Bytes::new())));
            bench.asked().await;
        }
        let refused = asker.ask(Bytes::new()).await.unwrap_err();
        assert!(refused.contains("under way"), "{refused}");
        asks.pop().unwrap().abort();
        assert!(matches!(bench.heard().await, PortEvent::AskGivenUp { .. }));
        let again = tokio::spawn(asker.ask(Bytes::new()));
        let (ask, _) = bench.asked().await;
        bench.calls.answered(ask, Ok("yes".into()));
        assert_eq!(again.await.unwrap().unwrap(), "yes");
    }

    #[test]
    fn a_call_without_a_type_waits_for_other_definitions_and_one_of_others_for_them_to_go() {
        let mut bench = Bench::new();
        bench
            .calls
            .known(topic(105), start(&[("number", BuiltinType::Double)]));
        assert!(bench.offer().is_empty() && bench.services().is_empty());
        assert!(!bench.calls.is_waiting());
        bench.calls.look_again(&mut bench.graph);
        assert!(bench.calls.is_waiting());
        bench.offer();
        bench.calls.known(topic(106), trigger());
        bench.offer();
        assert_eq!(bench.services(), ["/ua_0_7_106"]);
        bench.calls.leave(|_| true);
        assert!(bench.services().is_empty() && bench.calls.is_waiting());
    }
}
