//! Services of the graph as calls of the space: other spaces send requests, a service of the graph
//! executes them.
//!
//! A service is a call if the mapping sets it, or if it has the name of a call of the own space
//! (`/ua_1_2_61`). It is offered while it is present. Each execution is a separate task, so that a
//! slow service does not delay others.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use bridge_core::{CallRole, Executed, ExecutionId, OfferedType, Refusal};
use bytes::Bytes;
use mappings::{CallKind, Mapping, TopicId};
use messages::{ServiceType, TypeName};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::task::JoinSet;
use uadp::StatusCode;

use crate::clock::now;
use crate::policy::Policy;
use crate::port::Execution;
use crate::present::{self, Present};
use crate::services::{CallFault, MayHaveRun, ServiceCall};
use crate::{GraphError, PortEvent, ServiceGraph};

/// A ROS graph with services that can be executed for other spaces.
pub trait ExecutorGraph: ServiceGraph {
    /// The client of a service, for concurrent calls.
    type Executor: ServiceCall + Sync;

    /// Creates a client of a service with a timeout for each call.
    ///
    /// # Errors
    /// The reason why the client cannot be created.
    fn executor(
        &mut self,
        service: &str,
        service_type: &ServiceType,
        timeout: Duration,
    ) -> Result<Self::Executor, GraphError>;
}

/// The services of a graph that are executed for the space.
#[derive(Debug)]
pub struct ExecutedServices<C> {
    served: HashMap<TopicId, Served<C>>,
    /// Services that cannot be served with their present settings.
    refused: HashMap<TopicId, Wanted>,
    /// The running executions, each with its call.
    running: HashMap<ExecutionId, TopicId>,
    done: mpsc::Receiver<Done>,
    report: mpsc::Sender<Done>,
    tasks: JoinSet<()>,
}

#[derive(Debug)]
struct Served<C> {
    wanted: Wanted,
    service_type: Arc<ServiceType>,
    client: Arc<C>,
    /// Permits for the concurrent executions.
    places: Arc<Semaphore>,
}

/// A service and its metadata as a call.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Wanted {
    service: String,
    type_name: TypeName,
    name: String,
    about: String,
    open: bool,
    timeout: Duration,
}

/// The result of an execution.
#[derive(Debug)]
struct Done {
    execution: ExecutionId,
    result: Result<Bytes, CallFault>,
}

impl<C> Default for ExecutedServices<C> {
    fn default() -> Self {
        let (report, done) = mpsc::channel(MOST_RUNNING);
        Self {
            served: HashMap::new(),
            refused: HashMap::new(),
            running: HashMap::new(),
            done,
            report,
            tasks: JoinSet::new(),
        }
    }
}

impl<C: ServiceCall + Sync> ExecutedServices<C> {
    /// Returns whether the name of a service makes it a call of the own space, so that its type has
    /// to be found out.
    #[must_use]
    pub fn is_named(policy: &Policy, service: &str) -> bool {
        present::named(policy, service).is_some()
    }

    /// Returns the names of the services that the mapping has executed in the own space.
    pub fn mapped<'m>(mapping: &'m Mapping, policy: &Policy) -> BTreeSet<&'m str> {
        present::mapped(mapping, policy, CallKind::Service)
    }

    /// Compares the present services with the services that are offered as calls. Starts to offer
    /// at most `most` further services.
    pub fn reconcile<G: ExecutorGraph<Executor = C>>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
        (present, mut most): (&Present, usize),
    ) -> Vec<PortEvent> {
        while self.tasks.try_join_next().is_some() {}
        present::tell_other_types(policy, present, CallKind::Service);
        let wanted = wanted(policy, present);
        let mut events = Vec::new();
        let gone = self
            .served
            .extract_if(|topic, served| wanted.get(topic).is_none_or(|now| served.wanted != *now));
        events.extend(gone.map(|(topic, _)| PortEvent::Withdrawn { topic }));
        self.refused
            .retain(|topic, refused| wanted.get(topic) == Some(refused));
        for (topic, wanted) in wanted {
            if self.served.contains_key(&topic) || self.refused.contains_key(&topic) {
                continue;
            }
            if most == 0 {
                break;
            }
            most -= 1;
            match self.serve(graph, topic, &wanted) {
                Ok(event) => events.push(event),
                Err(why) => {
                    policy.told.once(&topic.to_string(), "not executed", || {
                        format!(
                            "the service {} is not offered to other spaces: {why}",
                            wanted.service
                        )
                    });
                    self.refused.insert(topic, wanted);
                }
            }
        }
        events
    }

    /// Checks all services again, because definitions may have changed.
    pub fn look_again<G: ExecutorGraph<Executor = C>>(&mut self, graph: &mut G) -> Vec<PortEvent> {
        self.refused.clear();
        let other = self.served.extract_if(|_, served| {
            let now = graph.service_type(&served.wanted.type_name);
            now.is_ok_and(|now| !now.is_same(&served.service_type))
        });
        other
            .map(|(topic, _)| PortEvent::Withdrawn { topic })
            .collect()
    }

    fn serve<G: ExecutorGraph<Executor = C>>(
        &mut self,
        graph: &mut G,
        topic: TopicId,
        wanted: &Wanted,
    ) -> Result<PortEvent, GraphError> {
        if self.served.len() >= MOST_SERVED {
            return Err(GraphError::Full {
                most: MOST_SERVED,
                ends: "services",
            });
        }
        let service_type = graph.service_type(&wanted.type_name)?;
        let client = graph.executor(&wanted.service, &service_type, wanted.timeout)?;
        self.served.insert(
            topic,
            Served {
                wanted: wanted.clone(),
                service_type: Arc::clone(&service_type),
                client: Arc::new(client),
                places: Arc::new(Semaphore::new(MOST_AT_A_TIME)),
            },
        );
        let offered = OfferedType {
            service_type,
            name: wanted.name.clone(),
            about: wanted.about.clone(),
            role: CallRole::Call,
            open: wanted.open,
        };
        Ok(PortEvent::OfferTyped { topic, offered })
    }

    /// Returns whether a call is executed here.
    #[must_use]
    pub fn serves(&self, topic: TopicId) -> bool {
        self.served.contains_key(&topic)
    }

    /// Calls the service of a call that is executed here. The outcome is reported by
    /// [`recv`](Self::recv).
    ///
    /// # Errors
    /// The reason why the request is refused.
    pub fn execute(&mut self, execution: Execution) -> Result<(), Refusal> {
        let served = self.served.get(&execution.topic);
        let served = served.ok_or(Refusal::NotExecutable)?;
        let start_by = execution.start_by;
        let place = Arc::clone(&served.places).try_acquire_owned();
        let place = place.map_err(|_| Refusal::Busy)?;
        let report = self.report.clone().try_reserve_owned();
        let report = report.map_err(|_| Refusal::Busy)?;
        let client = Arc::clone(&served.client);
        let Execution {
            id, topic, request, ..
        } = execution;
        self.running.insert(id, topic);
        self.tasks
            .spawn(run(client, (id, request, start_by), (report, place)));
        Ok(())
    }

    /// Returns the outcome of the next execution. Cancel-safe.
    pub async fn recv(&mut self) -> Vec<PortEvent> {
        std::future::poll_fn(|cx| self.poll_recv(cx)).await
    }

    /// Polls for the events of [`recv`](Self::recv), for ports that poll.
    pub fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<Vec<PortEvent>> {
        match self.done.poll_recv(cx) {
            Poll::Ready(Some(done)) => Poll::Ready(self.done(done)),
            // Never `None`, because `self` holds a sender.
            Poll::Ready(None) | Poll::Pending => Poll::Pending,
        }
    }

    fn done(&mut self, done: Done) -> Vec<PortEvent> {
        let Done { execution, result } = done;
        let Some(topic) = self.running.remove(&execution) else {
            return Vec::new();
        };
        let (outcome, failed) = match result {
            Ok(response) => (Executed::Answered(response.into()), None),
            Err(CallFault { text, ran, .. }) => {
                let outcome = match ran {
                    MayHaveRun::No => Executed::Refused(Refusal::NotExecutable),
                    MayHaveRun::Perhaps => Executed::Lost,
                    MayHaveRun::Yes => Executed::Failed(BAD_UNEXPECTED_ERROR),
                };
                let detail = text;
                (outcome, Some(PortEvent::CallFailed { topic, detail }))
            }
        };
        let executed = PortEvent::Executed { execution, outcome };
        std::iter::once(executed).chain(failed).collect()
    }
}

/// Runs one execution. It goes on when its call is withdrawn, and ends within the timeout of its
/// client.
async fn run<C: ServiceCall + Sync>(
    client: Arc<C>,
    (execution, request, start_by): (ExecutionId, Bytes, Instant),
    (report, place): (mpsc::OwnedPermit<Done>, OwnedSemaphorePermit),
) {
    // Compared here for all clients, and again by the client when it sends the request: it may have
    // to look the service up and to connect before.
    let result = if now().monotonic <= start_by {
        client.call_by(request, Some(start_by)).await
    } else {
        Err(CallFault {
            text: TOO_LATE.to_owned(),
            may_pass: true,
            ran: MayHaveRun::No,
        })
    };
    drop(place);
    drop(report.send(Done { execution, result }));
}

/// Returns the present services that are to be offered, by topic.
fn wanted(policy: &Policy, present: &Present) -> BTreeMap<TopicId, Wanted> {
    let found = present::found(policy, present, CallKind::Service);
    let wanted = found.map(|found| {
        let (name, about, open) = found.said();
        let wanted = Wanted {
            service: found.target.to_owned(),
            type_name: found.type_name.clone(),
            name,
            about,
            open,
            timeout: found.call.map_or(TIMEOUT, |call| call.timeout),
        };
        (found.topic, wanted)
    });
    wanted.collect()
}

/// The maximal number of services offered to other spaces: any node in a graph can invent names.
const MOST_SERVED: usize = 1024;
/// The maximal number of concurrent executions of one service; a further request is refused as
/// busy.
const MOST_AT_A_TIME: usize = 256;
/// The maximal number of concurrent executions of all services.
const MOST_RUNNING: usize = 1024;
/// The reason for which an execution is not started.
pub(crate) const TOO_LATE: &str = "not started: the request waited in this program for too long, and another bridge \
                                   may have taken over";
/// Time limit of a call, unless the mapping sets it.
const TIMEOUT: Duration = Duration::from_secs(30);
/// Bad_UnexpectedError (OPC 10000-6, A.2): the service ran and reports a failure.
const BAD_UNEXPECTED_ERROR: StatusCode = StatusCode(0x8001_0000);
