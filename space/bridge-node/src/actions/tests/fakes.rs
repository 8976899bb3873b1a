//! A graph without a network, with its servers and clients of actions.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use messages::{ActionCalls, MessageType, ServiceType, TypeName, TypeRegistry, Wire};
use tokio::sync::{mpsc, oneshot};
use uadp::BuiltinType;

use super::super::{
    ActionGraph, GraphActionClient, GraphActionServer, GraphCancelRequest, GraphCancelResponse,
    GraphCancelSelection, GraphGoalEvent, GraphGoalId, GraphNewGoal, GraphServerEvent, SentGoal,
    ServedGoal, Waits,
};
use crate::services::{CallFault, ServiceCall};
use crate::{Asker, CallGraph, GraphError, ServiceGraph};

/// The graph on either side. Requests to its servers and events for its clients go through
/// channels.
pub(super) struct Fake {
    pub(super) registry: TypeRegistry,
    pub(super) sent: mpsc::Sender<Sent>,
    pub(super) cancels: mpsc::Sender<Cancel>,
    /// The events of the server of an action of another space.
    pub(super) events: Mutex<Option<mpsc::Receiver<GraphServerEvent<New, FakeRequest>>>>,
    pub(super) served: Arc<Mutex<Vec<String>>>,
}

/// A goal that a server of the graph has received.
pub(super) struct Sent {
    pub(super) id: GraphGoalId,
    pub(super) body: Bytes,
    pub(super) say: mpsc::Sender<GraphGoalEvent>,
}

pub(super) struct Cancel {
    pub(super) what: GraphCancelSelection,
    pub(super) answer: oneshot::Sender<Result<GraphCancelResponse, CallFault>>,
}

pub(super) struct Never;

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

    fn service_type(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, GraphError> {
        Ok(self.registry.service(name)?)
    }

    fn carrier(&mut self, _: BuiltinType, _: bool) -> Result<Option<Arc<MessageType>>, GraphError> {
        Ok(None)
    }

    fn client(&mut self, _: &str, _: &ServiceType, _: Duration) -> Result<Never, GraphError> {
        Ok(Never)
    }
}

impl CallGraph for Fake {
    type Server = ();

    const TELLS_FAULTS: bool = true;

    fn offer(&mut self, _: &str, _: &Arc<ServiceType>, _: Asker) -> Result<(), GraphError> {
        Ok(())
    }
}

impl ActionGraph for Fake {
    type Sender = FakeActionClient;
    type Taker = FakeActionServer;

    fn action_calls(&mut self, name: &TypeName) -> Result<Arc<ActionCalls>, GraphError> {
        Ok(Arc::new(self.registry.action_calls(name)?))
    }

    fn action_client(
        &mut self,
        _: &str,
        _: &TypeName,
        _: Waits,
    ) -> Result<FakeActionClient, GraphError> {
        Ok(FakeActionClient {
            sent: self.sent.clone(),
            cancels: self.cancels.clone(),
        })
    }

    fn serve_action(&mut self, action: &str, _: &TypeName) -> Result<FakeActionServer, GraphError> {
        self.served.lock().unwrap().push(action.to_owned());
        Ok(FakeActionServer {
            name: action.to_owned(),
            events: self
                .events
                .lock()
                .unwrap()
                .take()
                .ok_or(GraphError::GoalAnswered)?,
            served: Arc::clone(&self.served),
        })
    }
}

pub(super) struct FakeActionClient {
    sent: mpsc::Sender<Sent>,
    cancels: mpsc::Sender<Cancel>,
}

pub(super) struct Heard(mpsc::Receiver<GraphGoalEvent>);

impl SentGoal for Heard {
    async fn recv(&mut self) -> Option<GraphGoalEvent> {
        self.0.recv().await
    }
}

impl GraphActionClient for FakeActionClient {
    type Goal = Heard;

    fn send_goal(&self, id: GraphGoalId, body: &[u8], _: Instant) -> Heard {
        let (say, heard) = mpsc::channel(16);
        let body = Bytes::copy_from_slice(body);
        self.sent.try_send(Sent { id, body, say }).ok().unwrap();
        Heard(heard)
    }

    async fn cancel(&self, what: GraphCancelSelection) -> Result<GraphCancelResponse, CallFault> {
        let (answer, answered) = oneshot::channel();
        let asked = self.cancels.send(Cancel { what, answer }).await;
        asked.ok().unwrap();
        answered.await.unwrap()
    }
}

pub(super) struct FakeActionServer {
    name: String,
    events: mpsc::Receiver<GraphServerEvent<New, FakeRequest>>,
    served: Arc<Mutex<Vec<String>>>,
}

impl Drop for FakeActionServer {
    fn drop(&mut self) {
        self.served
            .lock()
            .unwrap()
            .retain(|name| *name != self.name);
    }
}

impl GraphActionServer for FakeActionServer {
    type New = New;
    type Cancel = FakeRequest;

    async fn recv(&mut self) -> GraphServerEvent<New, FakeRequest> {
        match self.events.recv().await {
            Some(event) => event,
            None => std::future::pending().await,
        }
    }
}

/// An event that a client of the graph receives.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum FakeReport {
    Accepted,
    Rejected(String),
    Feedback(Bytes),
    Ended(i8, String, Option<Bytes>),
}

pub(super) struct New {
    pub(super) id: GraphGoalId,
    pub(super) body: Bytes,
    pub(super) told: mpsc::Sender<FakeReport>,
}

impl GraphNewGoal for New {
    type Goal = Taken;

    fn id(&self) -> GraphGoalId {
        self.id
    }

    fn body(&self) -> &Bytes {
        &self.body
    }

    async fn accept(self) -> Result<Taken, GraphError> {
        self.told.try_send(FakeReport::Accepted).unwrap();
        Ok(Taken(self.told))
    }

    fn reject(self, why: &str) {
        self.told
            .try_send(FakeReport::Rejected(why.to_owned()))
            .unwrap();
    }
}

pub(super) struct Taken(mpsc::Sender<FakeReport>);

impl ServedGoal for Taken {
    fn execute(&self) {}

    fn feedback(&self, body: &[u8]) -> Result<(), GraphError> {
        let body = Bytes::copy_from_slice(body);
        self.0.try_send(FakeReport::Feedback(body)).unwrap();
        Ok(())
    }

    fn end(&self, status: i8, message: &str, result: Option<&[u8]>) -> Result<(), GraphError> {
        let result = result.map(Bytes::copy_from_slice);
        let ended = FakeReport::Ended(status, message.to_owned(), result);
        self.0.try_send(ended).unwrap();
        Ok(())
    }
}

pub(super) struct FakeRequest {
    pub(super) id: GraphGoalId,
    pub(super) agreed: oneshot::Sender<bool>,
}

impl GraphCancelRequest for FakeRequest {
    fn id(&self) -> GraphGoalId {
        self.id
    }

    fn accept(self) -> Result<(), GraphError> {
        self.agreed.send(true).map_err(|_| GraphError::GoalAnswered)
    }

    fn reject(self) {
        let _gone = self.agreed.send(false).is_err();
    }
}
