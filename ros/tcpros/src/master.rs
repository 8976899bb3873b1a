//! The client of the master API.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use thiserror::Error;

use crate::rpc::{self, RpcEndpoint, RpcError};
use crate::xmlrpc::XmlRpcValue;

/// State of the connection to the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MasterState {
    /// Not found yet, or lost: the node tries to connect.
    Awaited,
    /// The master replies, and was sent all registrations of that time. Refused registrations are
    /// logged and retried, and later registrations may still be on their way.
    Registered,
}

/// The publishers, subscribers and services that are registered with the master.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MasterGraph {
    /// Names of the publishing nodes by topic.
    pub publishers: BTreeMap<String, Vec<String>>,
    /// Names of the subscribing nodes by topic.
    pub subscribers: BTreeMap<String, Vec<String>>,
    /// Names of the nodes that offer services, by service. The master keeps a node per service:
    /// the last that registered.
    pub services: BTreeMap<String, Vec<String>>,
    /// Type names by topic. A topic that has only subscribers of any type has `*` or is missing.
    pub types: BTreeMap<String, String>,
}

impl MasterGraph {
    /// Reads the graph from the master at `uri` (`http://host:port`) without registering a node.
    /// Takes at most two calls of 3 s each.
    ///
    /// # Errors
    /// Fails if the URI is invalid, if the master cannot be reached, or if its reply violates the
    /// API.
    pub async fn of_master(uri: &str, caller_id: &str) -> Result<Self, MasterError> {
        Master::at(uri, caller_id)?.graph().await
    }

    /// Returns the URI that a node registered with the master at `uri`; `None` if the node is
    /// unknown. Takes at most 3 s.
    ///
    /// # Errors
    /// See [`of_master`](Self::of_master).
    pub async fn node_uri(
        uri: &str,
        caller_id: &str,
        node: &str,
    ) -> Result<Option<String>, MasterError> {
        Master::at(uri, caller_id)?.lookup_node(node).await
    }
}

/// A master, called with the name of a node.
#[derive(Clone, Debug)]
pub(crate) struct Master {
    endpoint: RpcEndpoint,
    uri: String,
    caller_id: String,
    caller_uri: String,
    /// Whether the master has refused several calls in a single request.
    one_by_one: Arc<AtomicBool>,
}

/// A call: the method, and its parameters without the caller id.
pub(crate) type MasterRequest = (&'static str, Vec<XmlRpcValue>);

impl Master {
    /// Returns a client of the master at a URI, for a caller that is not a node of its graph.
    pub(crate) fn at(uri: &str, caller_id: &str) -> Result<Self, MasterError> {
        let endpoint = RpcEndpoint::parse(uri).ok_or(RpcError::Uri)?;
        Ok(Self::new(
            endpoint,
            uri.to_owned(),
            caller_id.to_owned(),
            String::new(),
        ))
    }

    pub(crate) fn new(
        endpoint: RpcEndpoint,
        uri: String,
        caller_id: String,
        caller_uri: String,
    ) -> Self {
        Self {
            endpoint,
            uri,
            caller_id,
            caller_uri,
            one_by_one: Arc::default(),
        }
    }

    /// Returns whether the IPv6 addresses of other nodes are tried before their IPv4 addresses, as
    /// configured for this node.
    pub(crate) const fn prefers_ipv6(&self) -> bool {
        self.endpoint.prefers_ipv6()
    }

    pub(crate) fn uri(&self) -> &str {
        &self.uri
    }

    pub(crate) async fn pid(&self) -> Result<i32, MasterError> {
        self.call("getPid", vec![])
            .await?
            .as_int()
            .ok_or(MasterError::Shape("getPid"))
    }

    /// Returns the URI registered for a node, or `None` if the node is unknown.
    pub(crate) async fn lookup_node(&self, name: &str) -> Result<Option<String>, MasterError> {
        self.lookup("lookupNode", name).await
    }

    async fn lookup(
        &self,
        method: &'static str,
        name: &str,
    ) -> Result<Option<String>, MasterError> {
        match self.call(method, vec![name.into()]).await {
            Ok(uri) => Ok(uri.as_str().map(str::to_owned)),
            Err(MasterError::Refused { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    pub(crate) fn register_publisher(&self, topic: &str, type_name: &str) -> MasterRequest {
        let uri = self.caller_uri.as_str();
        (
            "registerPublisher",
            vec![topic.into(), type_name.into(), uri.into()],
        )
    }

    /// Returns the registration of a subscriber; its result is decoded by [`publishers`].
    pub(crate) fn register_subscriber(&self, topic: &str, type_name: &str) -> MasterRequest {
        let uri = self.caller_uri.as_str();
        (
            "registerSubscriber",
            vec![topic.into(), type_name.into(), uri.into()],
        )
    }

    pub(crate) fn register_service(&self, service: &str, service_uri: &str) -> MasterRequest {
        let uri = self.caller_uri.as_str();
        (
            "registerService",
            vec![service.into(), service_uri.into(), uri.into()],
        )
    }

    pub(crate) fn unregister_publisher(&self, topic: &str) -> MasterRequest {
        let uri = self.caller_uri.as_str();
        ("unregisterPublisher", vec![topic.into(), uri.into()])
    }

    pub(crate) fn unregister_subscriber(&self, topic: &str) -> MasterRequest {
        let uri = self.caller_uri.as_str();
        ("unregisterSubscriber", vec![topic.into(), uri.into()])
    }

    pub(crate) fn unregister_service(service: &str, service_uri: &str) -> MasterRequest {
        (
            "unregisterService",
            vec![service.into(), service_uri.into()],
        )
    }

    /// Returns the URI registered for a service, or `None` if the service is unknown.
    pub(crate) async fn lookup_service(
        &self,
        service: &str,
    ) -> Result<Option<String>, MasterError> {
        self.lookup("lookupService", service).await
    }

    pub(crate) async fn graph(&self) -> Result<MasterGraph, MasterError> {
        let (state, types) = match self.call_all(graph_requests()).await {
            Ok(replies) => return graph_of(replies),
            // Each half of a very large graph may be small enough for a reply.
            Err(MasterError::Rpc(RpcError::Body(_))) => (
                self.call(STATE, vec![]).await?,
                self.call(TYPES, vec![]).await?,
            ),
            Err(error) => return Err(error),
        };
        graph_of(vec![Ok(state), Ok(types)])
    }

    /// Reads the graph as [`graph`](Self::graph) does. A reply that is the same as before is not
    /// decoded again: the graph of a plant has thousands of names and rarely changes.
    pub(crate) async fn graph_since(
        &self,
        before: &mut Option<(Bytes, Arc<MasterGraph>)>,
    ) -> Result<Arc<MasterGraph>, MasterError> {
        let known = before.take();
        if !self.one_by_one.load(Ordering::Relaxed) {
            let requests = graph_requests();
            match self.fetch_all(&requests).await {
                Ok(document) => {
                    if let Some((last, graph)) = known
                        && last == document
                    {
                        *before = Some((last, Arc::clone(&graph)));
                        return Ok(graph);
                    }
                    if let Ok(graph) = read_all(&document, &requests).and_then(graph_of) {
                        let graph = Arc::new(graph);
                        *before = Some((document, Arc::clone(&graph)));
                        return Ok(graph);
                    }
                }
                // Too large for one reply.
                Err(MasterError::Rpc(RpcError::Body(_))) => {}
                Err(error) => return Err(error),
            }
        }
        self.graph().await.map(Arc::new)
    }

    /// Reads the graph without the types.
    pub(crate) async fn registrations(&self) -> Result<MasterGraph, MasterError> {
        registrations(&self.call(STATE, vec![]).await?)
    }

    /// Returns the name of the publisher of a topic with this URI. Checks only a few publishers,
    /// because the name is used only in log messages.
    pub(crate) async fn name_of(&self, topic: &str, uri: &str) -> Option<String> {
        let graph = self.graph().await.ok()?;
        for name in graph.publishers.get(topic)?.iter().take(8) {
            if self.lookup_node(name).await.ok()?.as_deref() == Some(uri) {
                return Some(name.clone());
            }
        }
        None
    }

    /// Makes several calls in order and returns a result for each call. The calls use one request
    /// (`system.multicall`, an extension of XML-RPC that rosmaster supports), because to rosmaster
    /// a connection costs more than a registration. A master without this method receives single
    /// calls.
    ///
    /// # Errors
    /// Fails if the master cannot be reached; some of the calls may have been made then.
    pub(crate) async fn call_all(
        &self,
        requests: Vec<MasterRequest>,
    ) -> Result<Vec<Result<XmlRpcValue, MasterError>>, MasterError> {
        if requests.len() > 1 && !self.one_by_one.load(Ordering::Relaxed) {
            match self.multicall(&requests).await {
                Err(MasterError::Rpc(RpcError::Fault(_)) | MasterError::Shape(_)) => {
                    self.one_by_one.store(true, Ordering::Relaxed);
                }
                result => return result,
            }
        }
        let mut results = Vec::with_capacity(requests.len());
        for (method, params) in requests {
            match self.call(method, params).await {
                Err(error @ MasterError::Rpc(_)) => return Err(error),
                result => results.push(result),
            }
        }
        Ok(results)
    }

    async fn multicall(
        &self,
        requests: &[MasterRequest],
    ) -> Result<Vec<Result<XmlRpcValue, MasterError>>, MasterError> {
        read_all(&self.fetch_all(requests).await?, requests)
    }

    /// Makes the calls of a multicall, and returns the document of the reply for [`read_all`].
    async fn fetch_all(&self, requests: &[MasterRequest]) -> Result<Bytes, MasterError> {
        let calls = requests.iter().map(|(method, params)| {
            let own = std::iter::once(self.caller_id.as_str().into());
            let params = own.chain(params.iter().cloned()).collect();
            XmlRpcValue::Struct(vec![
                ("methodName".to_owned(), (*method).into()),
                ("params".to_owned(), XmlRpcValue::Array(params)),
            ])
        });
        let params = vec![XmlRpcValue::Array(calls.collect())];
        Ok(rpc::fetch(&self.endpoint, MULTICALL, params, CALL_LIMIT).await?)
    }

    /// Makes a call with the caller id as its first parameter and unwraps `[code, message,
    /// result]`.
    pub(crate) async fn call(
        &self,
        method: &'static str,
        mut params: Vec<XmlRpcValue>,
    ) -> Result<XmlRpcValue, MasterError> {
        params.insert(0, self.caller_id.as_str().into());
        let reply = rpc::call(&self.endpoint, method, params, CALL_LIMIT).await?;
        unwrap_triple(reply, method)
    }
}

/// Reads the reply to a multicall, with a result for each of the requests.
fn read_all(
    document: &[u8],
    requests: &[MasterRequest],
) -> Result<Vec<Result<XmlRpcValue, MasterError>>, MasterError> {
    let XmlRpcValue::Array(replies) = rpc::read(document)? else {
        return Err(MasterError::Shape(MULTICALL));
    };
    if replies.len() != requests.len() {
        return Err(MasterError::Shape(MULTICALL));
    }
    let methods = requests.iter().map(|(method, _)| *method);
    Ok(replies.into_iter().zip(methods).map(unwrap_one).collect())
}

/// Returns the calls that read the graph.
fn graph_requests() -> Vec<MasterRequest> {
    vec![(STATE, vec![]), (TYPES, vec![])]
}

/// Decodes the replies to [`graph_requests`].
fn graph_of(replies: Vec<Result<XmlRpcValue, MasterError>>) -> Result<MasterGraph, MasterError> {
    let mut replies = replies.into_iter();
    let mut next = |method| replies.next().ok_or(MasterError::Shape(method))?;
    let (state, types) = (next(STATE)?, next(TYPES)?);
    let text = |value: &XmlRpcValue| value.as_str().map(str::to_owned);
    Ok(MasterGraph {
        types: pairs(&types, text).ok_or(MasterError::Shape(TYPES))?,
        ..registrations(&state)?
    })
}

/// Decodes the reply to `getSystemState`: the graph without the types.
fn registrations(state: &XmlRpcValue) -> Result<MasterGraph, MasterError> {
    let [publishers, subscribers, services, ..] = state.as_array().unwrap_or_default() else {
        return Err(MasterError::Shape(STATE));
    };
    let by_topic = |value| pairs(value, strings).ok_or(MasterError::Shape(STATE));
    Ok(MasterGraph {
        publishers: by_topic(publishers)?,
        subscribers: by_topic(subscribers)?,
        services: by_topic(services)?,
        types: BTreeMap::new(),
    })
}

/// Unwraps a reply of a multicall: its result in an array of its own, or a struct with a fault.
fn unwrap_one((reply, method): (XmlRpcValue, &'static str)) -> Result<XmlRpcValue, MasterError> {
    let XmlRpcValue::Array(result) = reply else {
        return Err(MasterError::Shape(method));
    };
    let [result] = <[XmlRpcValue; 1]>::try_from(result).map_err(|_| MasterError::Shape(method))?;
    unwrap_triple(result, method)
}

/// Decodes the URIs of a topic's publishers from the reply to `registerSubscriber`.
pub(crate) fn publishers(result: &XmlRpcValue) -> Result<Vec<String>, MasterError> {
    strings(result).ok_or(MasterError::Shape("registerSubscriber"))
}

/// Unwraps the reply of every ROS API: status code, status message, result.
pub(crate) fn unwrap_triple(
    reply: XmlRpcValue,
    method: &'static str,
) -> Result<XmlRpcValue, MasterError> {
    let XmlRpcValue::Array(items) = reply else {
        return Err(MasterError::Shape(method));
    };
    let Ok([code, message, result]) = <[XmlRpcValue; 3]>::try_from(items) else {
        return Err(MasterError::Shape(method));
    };
    match code.as_int() {
        Some(1) => Ok(result),
        Some(_) => Err(MasterError::Refused {
            method,
            message: message.as_str().unwrap_or("").to_owned(),
        }),
        None => Err(MasterError::Shape(method)),
    }
}

/// Error of a call of the master or of another node's API.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum MasterError {
    /// The call itself failed.
    #[error(transparent)]
    Rpc(#[from] RpcError),
    /// The peer replied with an error of its own.
    #[error("{method} was refused: {message}")]
    Refused {
        /// The called method.
        method: &'static str,
        /// The status message of the peer.
        message: String,
    },
    /// The reply of the peer violates the ROS API.
    #[error("the response to {0} does not have the form that ROS requires")]
    Shape(&'static str),
}

pub(crate) fn strings(value: &XmlRpcValue) -> Option<Vec<String>> {
    value
        .as_array()?
        .iter()
        .map(|item| item.as_str().map(str::to_owned))
        .collect()
}

fn pairs<T>(
    value: &XmlRpcValue,
    second: impl Fn(&XmlRpcValue) -> Option<T>,
) -> Option<BTreeMap<String, T>> {
    let pair = |item: &XmlRpcValue| match item.as_array()? {
        [topic, rest] => Some((topic.as_str()?.to_owned(), second(rest)?)),
        _ => None,
    };
    value.as_array()?.iter().map(pair).collect()
}

const STATE: &str = "getSystemState";
const MULTICALL: &str = "system.multicall";
const TYPES: &str = "getTopicTypes";
const CALL_LIMIT: Duration = Duration::from_secs(3);

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use tokio::net::TcpListener;
    use tokio::task::JoinSet;

    use super::*;
    use crate::xmlrpc::{MethodCall, MethodResponse, XmlRpcFault};

    /// Returns a master that replies with `answer`, and the list of the called methods.
    async fn master(
        answer: fn(&MethodCall) -> MethodResponse,
    ) -> (Master, Arc<Mutex<Vec<String>>>, JoinSet<()>) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let uri = format!("http://{}/", listener.local_addr().unwrap());
        let asked = Arc::new(Mutex::new(Vec::new()));
        let noted = Arc::clone(&asked);
        let mut tasks = JoinSet::new();
        let places = crate::crowd::Shares::of_process().nodes;
        tasks.spawn(rpc::serve(listener, places, move |call| {
            noted.lock().unwrap().push(call.method.clone());
            answer(&call)
        }));
        let endpoint = RpcEndpoint::parse(&uri).unwrap();
        let node = ("/node".to_owned(), "http://node:1/".to_owned());
        (Master::new(endpoint, uri, node.0, node.1), asked, tasks)
    }

    fn accepted() -> XmlRpcValue {
        XmlRpcValue::Array(vec![XmlRpcValue::Int(1), "".into(), XmlRpcValue::Int(0)])
    }

    fn requests(master: &Master) -> Vec<MasterRequest> {
        vec![
            master.register_publisher("/a", "std_msgs/Bool"),
            master.register_publisher("/b", "std_msgs/Bool"),
        ]
    }

    #[tokio::test]
    async fn the_graph_is_decoded_again_only_after_a_change() {
        static LOOKS: std::sync::atomic::AtomicUsize = std::sync::atomic::AtomicUsize::new(0);
        let (master, asked, _tasks) = master(|_| {
            // The third reply has another topic.
            let topic = match LOOKS.fetch_add(1, Ordering::Relaxed) {
                0 | 1 => "/a",
                _ => "/b",
            };
            let pair =
                XmlRpcValue::Array(vec![topic.into(), XmlRpcValue::Array(vec!["/node".into()])]);
            let published = XmlRpcValue::Array(vec![pair]);
            let none = || XmlRpcValue::Array(Vec::new());
            let answer = |result| {
                let triple = XmlRpcValue::Array(vec![XmlRpcValue::Int(1), "".into(), result]);
                XmlRpcValue::Array(vec![triple])
            };
            let state = XmlRpcValue::Array(vec![published, none(), none()]);
            Ok(XmlRpcValue::Array(vec![answer(state), answer(none())]))
        })
        .await;
        let mut before = None;
        let first = master.graph_since(&mut before).await.unwrap();
        assert!(first.publishers.contains_key("/a"));
        let same = master.graph_since(&mut before).await.unwrap();
        assert!(Arc::ptr_eq(&first, &same));
        let changed = master.graph_since(&mut before).await.unwrap();
        assert!(changed.publishers.contains_key("/b"), "{changed:?}");
        assert_eq!(asked.lock().unwrap().len(), 3, "one request each");
    }

    #[tokio::test]
    async fn several_calls_are_one_request_and_a_refused_one_leaves_the_others() {
        let (master, asked, _tasks) = master(|call| {
            let Some(XmlRpcValue::Array(calls)) = call.params.first() else {
                return Ok(XmlRpcValue::Nil);
            };
            let own = XmlRpcValue::Struct(vec![
                ("methodName".to_owned(), "registerPublisher".into()),
                (
                    "params".to_owned(),
                    XmlRpcValue::Array(vec![
                        "/node".into(),
                        "/b".into(),
                        "std_msgs/Bool".into(),
                        "http://node:1/".into(),
                    ]),
                ),
            ]);
            assert_eq!(calls.get(1), Some(&own));
            let refused =
                XmlRpcValue::Array(vec![XmlRpcValue::Int(-1), "no".into(), XmlRpcValue::Int(0)]);
            let answers = [accepted(), refused].map(|answer| XmlRpcValue::Array(vec![answer]));
            Ok(XmlRpcValue::Array(answers.to_vec()))
        })
        .await;
        let results = master.call_all(requests(&master)).await.unwrap();
        assert!(
            matches!(results.as_slice(), [Ok(_), Err(MasterError::Refused { message, .. })] if message == "no"),
            "{results:?}"
        );
        assert_eq!(*asked.lock().unwrap(), ["system.multicall"]);
    }

    #[tokio::test]
    async fn the_graph_is_read_with_one_request() {
        let (master, asked, _tasks) = master(|_| {
            let list = |items: Vec<XmlRpcValue>| XmlRpcValue::Array(items);
            let entry = list(vec!["/a".into(), list(vec!["/node".into()])]);
            let state = list(vec![list(vec![entry]), list(vec![]), list(vec![])]);
            let types = list(vec![list(vec!["/a".into(), "std_msgs/Bool".into()])]);
            let answers = [state, types]
                .map(|result| list(vec![list(vec![XmlRpcValue::Int(1), "".into(), result])]));
            Ok(list(answers.to_vec()))
        })
        .await;
        let graph = master.graph().await.unwrap();
        assert_eq!(graph.publishers.get("/a").unwrap(), &["/node"]);
        assert_eq!(graph.types.get("/a").unwrap(), "std_msgs/Bool");
        assert_eq!(*asked.lock().unwrap(), ["system.multicall"]);
    }

    #[tokio::test]
    async fn a_master_that_takes_no_several_calls_is_called_one_by_one_from_then_on() {
        let (master, asked, _tasks) = master(|call| {
            if call.method == "system.multicall" {
                return Err(XmlRpcFault {
                    code: 1,
                    message: "no such method".to_owned(),
                });
            }
            Ok(accepted())
        })
        .await;
        for _ in 0..2 {
            let results = master.call_all(requests(&master)).await.unwrap();
            assert!(results.iter().all(Result::is_ok), "{results:?}");
        }
        let single = "registerPublisher";
        assert_eq!(
            *asked.lock().unwrap(),
            ["system.multicall", single, single, single, single]
        );
    }
}
