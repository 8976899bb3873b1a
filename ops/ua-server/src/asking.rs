//! The path of client calls to other spaces: the request of each call, and the queue to
//! [`Methods`](crate::methods::Methods).

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{AskError, CallDescription, CallResponse};
use bytes::Bytes;
use futures_util::future::BoxFuture;
use mappings::TopicId;
use opcua::sync::Mutex;
use opcua::types::{NodeId, StatusCode, Variant};
use tokio::sync::{Notify, mpsc, oneshot};
use uadp::Fields;

use crate::layout::VariableShape;
use crate::value;

/// The Methods by their nodes.
pub(crate) type Table = Mutex<HashMap<NodeId, Callable>>;

/// A call as it is offered to clients.
#[derive(Debug, Clone)]
pub(crate) struct Callable {
    topic: TopicId,
    description: Arc<CallDescription>,
}

/// The sender of client requests to [`Methods`](crate::methods::Methods).
#[derive(Debug, Clone)]
pub(crate) struct Questions {
    sender: mpsc::Sender<ClientQuestion>,
    given_up: Arc<Notify>,
}

/// The receiver of [`Questions`].
#[derive(Debug)]
pub(crate) struct QuestionReceiver {
    pub(crate) questions: mpsc::Receiver<ClientQuestion>,
    /// Notified when clients have abandoned requests that were handed on.
    pub(crate) given_up: Arc<Notify>,
}

/// A request of a client.
#[derive(Debug)]
pub(crate) struct ClientQuestion {
    pub(crate) topic: TopicId,
    pub(crate) block: Bytes,
    pub(crate) answer: oneshot::Sender<CallResponse<Bytes>>,
}

/// A pending answer for a client. [`Methods`](crate::methods::Methods) is notified when the client
/// abandons it.
struct Waiting {
    answered: oneshot::Receiver<CallResponse<Bytes>>,
    given_up: Arc<Notify>,
    over: bool,
}

impl Drop for Waiting {
    fn drop(&mut self) {
        if !self.over {
            self.answered.close();
            self.given_up.notify_one();
        }
    }
}

/// The methods of Programs that clients can call, by their nodes.
pub(crate) type Drives = Mutex<HashMap<NodeId, Drive>>;

/// A method of a Program.
#[derive(Clone)]
pub(crate) struct Drive {
    /// The node of the Method that sends goals of the action. Permission to call that Method
    /// includes permission to call this method.
    pub(crate) goal: NodeId,
    /// Calls the method with the given arguments.
    pub(crate) carry_out: CarryOut,
}

/// The implementation of a method of a Program.
pub(crate) type CarryOut = Arc<
    dyn Fn(Vec<Variant>) -> BoxFuture<'static, Result<Vec<Variant>, CallFailure>> + Send + Sync,
>;

/// The reason why a call of a client failed.
pub(crate) enum CallFailure {
    /// Some arguments have the wrong type; contains a status for each argument.
    Arguments(Vec<StatusCode>),
    /// The request was not sent.
    Status(StatusCode),
    /// The request was sent, but there is no response.
    Asked(AskError),
}

impl Questions {
    /// Creates both ends of the queue.
    pub(crate) fn channel() -> (Self, QuestionReceiver) {
        let (sender, questions) = mpsc::channel(MOST_QUESTIONS);
        let given_up = Arc::<Notify>::default();
        let heard = QuestionReceiver {
            questions,
            given_up: Arc::clone(&given_up),
        };
        (Self { sender, given_up }, heard)
    }
}

impl Waiting {
    /// Waits for the answer. The request is abandoned when the session of the client is closed. The
    /// session is polled, because the library continues the requests of a lost connection.
    async fn answer(mut self, gone: impl Fn() -> bool) -> Result<CallResponse<Bytes>, StatusCode> {
        let answer = loop {
            match tokio::time::timeout(LOOK_AT_CLIENT, &mut self.answered).await {
                Ok(answer) => break answer.map_err(|_| StatusCode::BadShutdown),
                Err(_) if gone() => return Err(StatusCode::BadSessionClosed),
                Err(_) => {}
            }
        };
        self.over = true;
        answer
    }
}

impl Callable {
    pub(crate) fn new(topic: TopicId, description: &Arc<CallDescription>) -> Self {
        Self {
            topic,
            description: Arc::clone(description),
        }
    }

    pub(crate) const fn topic(&self) -> TopicId {
        self.topic
    }

    pub(crate) const fn description(&self) -> &Arc<CallDescription> {
        &self.description
    }

    /// Sends a request with these arguments and returns the response. The request is abandoned when
    /// the future is dropped or the client is lost.
    pub(crate) async fn call(
        &self,
        arguments: &[Variant],
        questions: &Questions,
        gone: impl Fn() -> bool,
    ) -> Result<Vec<Variant>, CallFailure> {
        let response = self.ask(self.block(arguments)?, questions, gone).await?;
        let fields = Fields::parse(&response);
        let fields = fields.map_err(|_| CallFailure::Status(StatusCode::BadDecodingError))?;
        let outputs = fields.map(|field| field.map(|field| value::from_field(&field)));
        outputs
            .collect::<Result<_, _>>()
            .map_err(|_| CallFailure::Status(StatusCode::BadDecodingError))
    }

    /// Sends a request with this block of fields and returns the block of the response. See
    /// [`call`](Self::call).
    pub(crate) async fn ask(
        &self,
        block: Bytes,
        questions: &Questions,
        gone: impl Fn() -> bool,
    ) -> Result<Bytes, CallFailure> {
        let (answer, answered) = oneshot::channel();
        let question = ClientQuestion {
            topic: self.topic,
            block,
            answer,
        };
        let waiting = Waiting {
            answered,
            given_up: Arc::clone(&questions.given_up),
            over: false,
        };
        questions
            .sender
            .try_send(question)
            .map_err(|_| CallFailure::Status(StatusCode::BadTooManyOperations))?;
        let answer = waiting.answer(gone).await.map_err(CallFailure::Status)?;
        answer.map_err(CallFailure::Asked)
    }

    /// Encodes the request. All arguments may be omitted together if each of them has a default.
    fn block(&self, arguments: &[Variant]) -> Result<Bytes, CallFailure> {
        let request = &self.description.request;
        let left_out = arguments.is_empty() && self.description.may_be_empty();
        if arguments.len() < request.len() && !left_out {
            return Err(CallFailure::Status(StatusCode::BadArgumentsMissing));
        }
        let block = value::fields_block(arguments).map_err(CallFailure::Status)?;
        let fields = Fields::parse(&block);
        let fields = fields.map_err(|_| CallFailure::Status(StatusCode::BadInvalidArgument))?;
        let statuses = fields.zip(request).map(|(value, field)| match value {
            Ok(value) if VariableShape::of(field).fits(&value) => StatusCode::Good,
            Ok(_) => StatusCode::BadTypeMismatch,
            Err(_) => StatusCode::BadInvalidArgument,
        });
        let statuses: Vec<StatusCode> = statuses.collect();
        if statuses.iter().any(|status| status.is_bad()) {
            return Err(CallFailure::Arguments(statuses));
        }
        Ok(Bytes::from(block))
    }
}

/// Largest number of client requests that wait for the run loop. Further requests are refused.
const MOST_QUESTIONS: usize = 256;
/// Interval between two checks if the waiting client is still connected.
const LOOK_AT_CLIENT: Duration = Duration::from_secs(1);
