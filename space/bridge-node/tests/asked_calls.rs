//! Calls of other spaces as services of a fake graph.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "test code"
)]

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bridge_node::policy::Policy;
use bridge_node::{
    AskError, AskErrorKind, AskId, Asker, CallDescription, CallFault, CallField, CallGraph,
    CallRole, GraphError, PortEvent, ServiceCall, ServiceGraph, SpaceCalls, now,
};
use bytes::Bytes;
use mappings::{SpaceId, TopicId};
use messages::{Dialect, MessageType, ServiceType, TypeName, TypeRegistry, Wire};
use uadp::{BuiltinType, StatusCode};

type Offered = Arc<Mutex<BTreeMap<String, Asker>>>;

/// A graph with services that the test calls.
struct Fake {
    registry: TypeRegistry,
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

    async fn call_by(&self, _: Bytes, _: Option<Instant>) -> Result<Bytes, CallFault> {
        std::future::pending().await
    }
}

impl ServiceGraph for Fake {
    type Client = NoClient;

    const WIRE: Wire = Wire::Cdr;

    fn service_type(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, GraphError> {
        Ok(self.registry.service(name)?)
    }

    fn carrier(&mut self, _: BuiltinType, _: bool) -> Result<Option<Arc<MessageType>>, GraphError> {
        Ok(None)
    }

    fn client(&mut self, _: &str, _: &ServiceType, _: Duration) -> Result<NoClient, GraphError> {
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
    ) -> Result<Server, GraphError> {
        let mut offered = self.offered.lock().unwrap();
        offered.insert(service.to_owned(), asker);
        Ok(Server(service.to_owned(), Arc::clone(&self.offered)))
    }
}

struct Bench {
    graph: Fake,
    policy: Policy,
    calls: SpaceCalls<Server>,
}

impl Bench {
    fn new() -> Self {
        Self {
            graph: Fake {
                registry: TypeRegistry::bundle(Dialect::Ros2),
                offered: Offered::default(),
            },
            policy: Policy::new(SpaceId::ROS1, Arc::default()),
            calls: SpaceCalls::default(),
        }
    }

    /// Returns the offered services.
    fn services(&self) -> Vec<String> {
        self.graph.offered.lock().unwrap().keys().cloned().collect()
    }

    fn offer(&mut self) -> Vec<PortEvent> {
        let all = |_: TopicId, _: &str| true;
        self.calls
            .offer_waiting(&mut self.graph, &mut self.policy, all, usize::MAX)
    }

    fn asker(&self, service: &str) -> Asker {
        self.graph.offered.lock().unwrap()[service].clone()
    }

    async fn heard(&mut self) -> PortEvent {
        self.calls.recv::<Fake>().await
    }

    /// Returns the id and topic of the next request.
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
        role: CallRole::Call,
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

/// Returns `success` and `message` of a Trigger response.
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
        [PortEvent::CallBound { topic: of, service_type, .. }]
            if *of == topic(105) && service_type.name().to_string() == "std_srvs/Trigger"
    ));
    assert_eq!(bench.services(), ["/ua_0_7_105"]);
    // An unchanged description has no effect; a changed description is offered again.
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
    bench.calls.tidy(now + Duration::from_secs(1));
    let (success, why) = read(&waits.await.unwrap().unwrap());
    assert!(!success && why.contains("unknown whether"), "{why}");
    assert_eq!(bench.services(), ["/ua_0_7_105"]);
    bench.calls.tidy(now + Duration::from_secs(2));
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
    for _ in 0..511 {
        asks.push(tokio::spawn(asker.ask(Bytes::new())));
        bench.asked().await;
    }
    let refused = asker.ask(Bytes::new()).await.unwrap_err();
    assert!(refused.contains("in progress"), "{refused}");
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
    bench.calls.look_again(&mut bench.graph, &bench.policy);
    assert!(bench.calls.is_waiting());
    bench.offer();
    bench.calls.known(topic(106), trigger());
    bench.offer();
    assert_eq!(bench.services(), ["/ua_0_7_106"]);
    bench.calls.leave(|_, _| true);
    assert!(bench.services().is_empty() && bench.calls.is_waiting());
}

#[test]
fn of_too_many_calls_the_rest_waits_until_one_is_gone() {
    let mut bench = Bench::new();
    for id in 1..=1025 {
        bench.calls.known(topic(id), trigger());
    }
    assert_eq!((bench.offer().len(), bench.services().len()), (1024, 1024));
    assert!(!bench.calls.is_waiting());
    bench.calls.gone(topic(7), now().monotonic);
    let events = bench.offer();
    assert!(matches!(events[..], [PortEvent::CallBound { topic: of, .. }] if of == topic(1025)));
}
