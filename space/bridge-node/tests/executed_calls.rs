//! Services of a fake graph, executed for other spaces.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bridge_node::policy::Policy;
use bridge_node::{
    CallFault, Executed, ExecutedServices, Execution, ExecutionId, ExecutorGraph, GraphError,
    MayHaveRun, PortEvent, Present, Refusal, ServiceCall, ServiceGraph, now,
};
use bytes::Bytes;
use mappings::{Call, CallKind, CallTarget, ExecutedBy, Mapping, NodeIdText, SpaceId, TopicId};
use messages::{Dialect, MessageType, ServiceType, TypeName, TypeRegistry, Wire};
use tokio::sync::Semaphore;
use uadp::BuiltinType;

/// The next responses of a service.
type Answers = Arc<Mutex<VecDeque<Result<Bytes, CallFault>>>>;

/// A graph with services that respond once the test permits it.
struct Fake {
    registry: TypeRegistry,
    may: Arc<Semaphore>,
    answers: Answers,
}

struct Client(String, Arc<Semaphore>, Answers);

impl ServiceCall for Client {
    fn service(&self) -> &str {
        &self.0
    }

    async fn call_by(&self, _: Bytes, _: Option<Instant>) -> Result<Bytes, CallFault> {
        self.1.acquire().await.unwrap().forget();
        let answer = self.2.lock().unwrap().pop_front();
        answer.unwrap_or_else(|| Ok(Bytes::from_static(b"done")))
    }
}

impl ServiceGraph for Fake {
    type Client = Client;

    const WIRE: Wire = Wire::Cdr;

    fn service_type(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, GraphError> {
        Ok(self.registry.service(name)?)
    }

    fn carrier(&mut self, _: BuiltinType, _: bool) -> Result<Option<Arc<MessageType>>, GraphError> {
        Ok(None)
    }

    fn client(&mut self, name: &str, _: &ServiceType, _: Duration) -> Result<Client, GraphError> {
        let (may, answers) = (Arc::clone(&self.may), Arc::clone(&self.answers));
        Ok(Client(name.to_owned(), may, answers))
    }
}

impl ExecutorGraph for Fake {
    type Executor = Client;

    fn executor(
        &mut self,
        name: &str,
        service_type: &ServiceType,
        timeout: Duration,
    ) -> Result<Client, GraphError> {
        self.client(name, service_type, timeout)
    }
}

struct Bench {
    graph: Fake,
    policy: Policy,
    executing: ExecutedServices<Client>,
}

impl Bench {
    fn new(calls: Vec<Call>) -> Self {
        Self {
            graph: Fake {
                registry: TypeRegistry::bundle(Dialect::Ros2),
                may: Arc::new(Semaphore::new(0)),
                answers: Answers::default(),
            },
            policy: Policy::new(
                SpaceId::ROS1,
                Arc::new(Mapping::default().with_calls(calls)),
            ),
            executing: ExecutedServices::default(),
        }
    }

    /// Returns the events of a comparison with a graph that has these services.
    fn look(&mut self, services: &[(&str, Option<&str>)]) -> Vec<String> {
        let present = services.iter().map(|(service, type_name)| {
            let type_name = type_name.map(|name| name.parse().unwrap());
            ((*service).to_owned(), type_name)
        });
        let present: Present = present.collect();
        let most = (&present, usize::MAX);
        let events = self
            .executing
            .reconcile(&mut self.graph, &mut self.policy, most);
        events.iter().map(said).collect()
    }

    fn execute(&mut self, topic: TopicId, id: u64) -> Result<(), Refusal> {
        let deadline = now().monotonic + Duration::from_secs(1);
        self.executing.execute(Execution {
            id: ExecutionId::new(id),
            topic,
            request: Bytes::new(),
            requestor: None,
            deadline,
            start_by: deadline,
        })
    }
}

fn said(event: &PortEvent) -> String {
    if let PortEvent::Withdrawn { topic } = event {
        return format!("-{topic}");
    }
    let PortEvent::OfferTyped { topic, offered } = event else {
        panic!("{event:?}");
    };
    let open = if offered.open { " open" } else { "" };
    format!("+{topic} {}{open}", offered.service_type.name())
}

/// The call that the mapping executes as the service `/grip` of type `std_srvs/Trigger`.
fn mapped() -> Call {
    let name: TypeName = "std_srvs/Trigger".parse().unwrap();
    Call {
        topic: topic(70),
        node: "ns=2;i=70".parse::<NodeIdText>().unwrap(),
        name: "Gripper.Grip".to_owned(),
        about: String::new(),
        kind: CallKind::Service,
        executed: ExecutedBy::Ros(CallTarget {
            name: "/grip".to_owned(),
            type_name: name,
        }),
        asked: Vec::new(),
        open: true,
        callers: None,
        timeout: Duration::from_secs(5),
    }
}

fn topic(id: u16) -> TopicId {
    format!("ua_1_2_{id}").parse().unwrap()
}

const SET_BOOL: Option<&str> = Some("std_srvs/SetBool");
const TRIGGER: Option<&str> = Some("std_srvs/Trigger");

#[tokio::test]
async fn services_named_after_calls_of_the_own_space_are_offered_while_they_are_there() {
    let mut bench = Bench::new(Vec::new());
    let others = [
        ("/ua_2_2_61", SET_BOOL),
        ("/grip", SET_BOOL),
        ("/ua_1_2_62", None),
    ];
    let none: [&str; 0] = [];
    assert_eq!(bench.look(&others), none);
    let there = [("/ua_1_2_61", SET_BOOL)];
    assert_eq!(bench.look(&there), ["+ua_1_2_61 std_srvs/SetBool"]);
    assert_eq!(bench.look(&there), none);
    // Another type under the same name is another call.
    let other = [("/ua_1_2_61", TRIGGER)];
    let both = ["-ua_1_2_61", "+ua_1_2_61 std_srvs/Trigger"];
    assert_eq!(bench.look(&other), both);
    assert_eq!(bench.look(&[]), ["-ua_1_2_61"]);
    let unknown = [("/ua_1_2_61", Some("my_msgs/Weigh"))];
    assert_eq!(bench.look(&unknown), none);
    assert_eq!(bench.execute(topic(61), 1), Err(Refusal::NotExecutable));
}

#[tokio::test]
async fn what_the_mapping_executes_goes_by_its_name_there_and_by_no_other() {
    let mut bench = Bench::new(vec![mapped()]);
    let none: [&str; 0] = [];
    assert_eq!(bench.look(&[("/ua_1_2_70", SET_BOOL)]), none);
    assert_eq!(bench.look(&[("/grip", SET_BOOL)]), none);
    let offered = ["+ua_1_2_70 std_srvs/Trigger open"];
    assert_eq!(bench.look(&[("/grip", TRIGGER)]), offered);
    // A mapping without the call withdraws it.
    bench.policy.replace(&Arc::default());
    assert_eq!(bench.look(&[("/grip", TRIGGER)]), ["-ua_1_2_70"]);
}

#[tokio::test]
async fn one_request_more_than_a_service_may_have_at_a_time_is_refused_and_there_is_room_again() {
    let mut bench = Bench::new(Vec::new());
    bench.look(&[("/ua_1_2_61", SET_BOOL)]);
    let mut begun = 0;
    let refused = loop {
        match bench.execute(topic(61), begun) {
            Ok(()) => begun += 1,
            Err(refused) => break refused,
        }
        assert!(begun < 10_000, "there is no end to it");
    };
    assert_eq!(refused, Refusal::Busy);
    assert!(begun >= 200, "only {begun} at a time");
    bench.graph.may.add_permits(1);
    let events = bench.executing.recv().await;
    assert!(
        matches!(
            &events[..],
            [PortEvent::Executed { outcome: Executed::Answered(response), .. }]
                if response == b"done"
        ),
        "{events:?}"
    );
    bench.execute(topic(61), begun).unwrap();
}

#[tokio::test]
async fn what_came_of_an_execution_says_whether_the_service_ran() {
    let mut bench = Bench::new(Vec::new());
    bench.look(&[("/ua_1_2_61", SET_BOOL)]);
    let outcomes = [MayHaveRun::No, MayHaveRun::Perhaps, MayHaveRun::Yes];
    for (id, ran) in (0..).zip(outcomes) {
        let text = "the valve is stuck".to_owned();
        let fault = CallFault {
            text,
            may_pass: false,
            ran,
        };
        bench.graph.answers.lock().unwrap().push_back(Err(fault));
        bench.execute(topic(61), id).unwrap();
        // The execution of a withdrawn call continues to its end.
        bench.look(&[]);
        bench.graph.may.add_permits(1);
        let events = bench.executing.recv().await;
        let [
            PortEvent::Executed { outcome, .. },
            PortEvent::CallFailed { detail, .. },
        ] = &events[..]
        else {
            panic!("{events:?}");
        };
        assert!(detail.contains("stuck"), "{detail}");
        let fits = match ran {
            MayHaveRun::No => matches!(outcome, Executed::Refused(Refusal::NotExecutable)),
            MayHaveRun::Perhaps => matches!(outcome, Executed::Lost),
            MayHaveRun::Yes => matches!(outcome, Executed::Failed(_)),
        };
        assert!(fits, "{ran:?}: {outcome:?}");
        bench.look(&[("/ua_1_2_61", SET_BOOL)]);
    }
}
