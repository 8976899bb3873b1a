//! A graph without a network, with its servers and clients of actions.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use messages::{ActionCalls, MessageType, Registry, ServiceType, TypeName, Wire};
use tokio::sync::{mpsc, oneshot};
use uadp::BuiltinType;

use super::super::{
    ActionClient, ActionGraph, ActionServer, CancelAnswer, CancelRequest, CancelWhat, GoalEvent,
    GoalId, NewGoal, SentGoal, ServedGoal, ServerEvent, Waits,
};
use crate::services::{CallFault, ServiceCall};
use crate::{Asker, CallGraph, GraphError, ServiceGraph};

/// The graph on either side. Requests to its servers and events for its clients go through
/// channels.
pub(super) struct Fake {
    pub(super) registry: Registry,
    pub(super) sent: mpsc::Sender<Sent>,
    pub(super) cancels: mpsc::Sender<Cancel>,
    /// The events of the server of an action of another space.
    pub(super) events: Mutex<Option<mpsc::Receiver<ServerEvent<New, Request>>>>,
    pub(super) served: Arc<Mutex<Vec<String>>>,
}

/// A goal that a server of the graph has received.
pub(super) struct Sent {
    pub(super) id: GoalId,
    pub(super) body: Bytes,
    pub(super) say: mpsc::Sender<GoalEvent>,
}

pub(super) struct Cancel {
    pub(super) what: CancelWhat,
    pub(super) answer: oneshot::Sender<Result<CancelAnswer, CallFault>>,
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
    type Sender = Client;
    type Taker = Server;

    fn action_calls(&mut self, name: &TypeName) -> Result<Arc<ActionCalls>, GraphError> {
        Ok(Arc::new(self.registry.action_calls(name)?))
    }

    fn action_client(&mut self, _: &str, _: &TypeName, _: Waits) -> Result<Client, GraphError> {
        Ok(Client {
            sent: self.sent.clone(),
            cancels: self.cancels.clone(),
        })
    }

    fn serve_action(&mut self, action: &str, _: &TypeName) -> Result<Server, GraphError> {
        self.served.lock().unwrap().push(action.to_owned());
        Ok(Server {
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

pub(super) struct Client {
    sent: mpsc::Sender<Sent>,
    cancels: mpsc::Sender<Cancel>,
}

pub(super) struct Heard(mpsc::Receiver<GoalEvent>);

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

pub(super) struct Server {
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
pub(super) enum Told {
    Accepted,
    Rejected(String),
    Feedback(Bytes),
    Ended(i8, String, Option<Bytes>),
}

pub(super) struct New {
    pub(super) id: GoalId,
    pub(super) body: Bytes,
    pub(super) told: mpsc::Sender<Told>,
}

impl NewGoal for New {
    type Goal = Taken;

    fn id(&self) -> GoalId {
        self.id
    }

    fn body(&self) -> &Bytes {
        &self.body
    }

    async fn accept(self) -> Result<Taken, GraphError> {
        self.told.try_send(Told::Accepted).unwrap();
        Ok(Taken(self.told))
    }

    fn reject(self, why: &str) {
        self.told.try_send(Told::Rejected(why.to_owned())).unwrap();
    }
}

pub(super) struct Taken(mpsc::Sender<Told>);

impl ServedGoal for Taken {
    fn execute(&self) {}

    fn feedback(&self, body: &[u8]) -> Result<(), GraphError> {
        let body = Bytes::copy_from_slice(body);
        self.0.try_send(Told::Feedback(body)).unwrap();
        Ok(())
    }

    fn end(&self, status: i8, message: &str, result: Option<&[u8]>) -> Result<(), GraphError> {
        let result = result.map(Bytes::copy_from_slice);
        let ended = Told::Ended(status, message.to_owned(), result);
        self.0.try_send(ended).unwrap();
        Ok(())
    }
}

pub(super) struct Request {
    pub(super) id: GoalId,
    pub(super) agreed: oneshot::Sender<bool>,
}

impl CancelRequest for Request {
    fn id(&self) -> GoalId {
        self.id
    }

    fn accept(self) -> Result<(), GraphError> {
        self.agreed.send(true).map_err(|_| GraphError::GoalAnswered)
    }

    fn reject(self) {
        let _gone = self.agreed.send(false).is_err();
    }
}
