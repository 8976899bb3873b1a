//! The master API as its client sees it.

use std::collections::BTreeMap;
use std::time::Duration;

use thiserror::Error;

use crate::rpc::{self, Endpoint, RpcError};
use crate::xmlrpc::Value;

/// Who publishes, subscribes and offers what, as the master knows it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Graph {
    /// Names of the publishing nodes by topic.
    pub publishers: BTreeMap<String, Vec<String>>,
    /// Names of the subscribing nodes by topic.
    pub subscribers: BTreeMap<String, Vec<String>>,
    /// Names of the nodes that offer services, by service. The master keeps one for each: the last that registered.
    pub services: BTreeMap<String, Vec<String>>,
    /// Type names by topic. A topic that has only subscribers of any type says `*` or is missing.
    pub types: BTreeMap<String, String>,
}

/// One master, called in the name of one node.
#[derive(Clone, Debug)]
pub(crate) struct Master {
    endpoint: Endpoint,
    uri: String,
    caller_id: String,
    caller_uri: String,
}

impl Master {
    pub(crate) const fn new(
        endpoint: Endpoint,
        uri: String,
        caller_id: String,
        caller_uri: String,
    ) -> Self {
        Self {
            endpoint,
            uri,
            caller_id,
            caller_uri,
        }
    }

    /// Whether other nodes are tried by IPv6 before IPv4, as this one is told to.
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

    /// The URI registered for a node, `None` when the master knows no such node.
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

    pub(crate) async fn register_publisher(
        &self,
        topic: &str,
        type_name: &str,
    ) -> Result<(), MasterError> {
        let params = vec![
            topic.into(),
            type_name.into(),
            self.caller_uri.as_str().into(),
        ];
        self.call("registerPublisher", params).await.map(drop)
    }

    /// Returns the URIs of the topic's publishers.
    pub(crate) async fn register_subscriber(
        &self,
        topic: &str,
        type_name: &str,
    ) -> Result<Vec<String>, MasterError> {
        let params = vec![
            topic.into(),
            type_name.into(),
            self.caller_uri.as_str().into(),
        ];
        let publishers = self.call("registerSubscriber", params).await?;
        strings(&publishers).ok_or(MasterError::Shape("registerSubscriber"))
    }

    pub(crate) async fn unregister_publisher(&self, topic: &str) -> Result<(), MasterError> {
        let params = vec![topic.into(), self.caller_uri.as_str().into()];
        self.call("unregisterPublisher", params).await.map(drop)
    }

    pub(crate) async fn unregister_subscriber(&self, topic: &str) -> Result<(), MasterError> {
        let params = vec![topic.into(), self.caller_uri.as_str().into()];
        self.call("unregisterSubscriber", params).await.map(drop)
    }

    pub(crate) async fn register_service(
        &self,
        service: &str,
        service_uri: &str,
    ) -> Result<(), MasterError> {
        let params = vec![
            service.into(),
            service_uri.into(),
            self.caller_uri.as_str().into(),
        ];
        self.call("registerService", params).await.map(drop)
    }

    pub(crate) async fn unregister_service(
        &self,
        service: &str,
        service_uri: &str,
    ) -> Result<(), MasterError> {
        let params = vec![service.into(), service_uri.into()];
        self.call("unregisterService", params).await.map(drop)
    }

    /// The URI registered for a service, `None` when the master knows no such service.
    pub(crate) async fn lookup_service(
        &self,
        service: &str,
    ) -> Result<Option<String>, MasterError> {
        self.lookup("lookupService", service).await
    }

    pub(crate) async fn graph(&self) -> Result<Graph, MasterError> {
        let state = self.call("getSystemState", vec![]).await?;
        let types = self.call("getTopicTypes", vec![]).await?;
        let [publishers, subscribers, services, ..] = state.as_array().unwrap_or_default() else {
            return Err(MasterError::Shape("getSystemState"));
        };
        let by_topic = |value| pairs(value, strings).ok_or(MasterError::Shape("getSystemState"));
        let text = |value: &Value| value.as_str().map(str::to_owned);
        Ok(Graph {
            publishers: by_topic(publishers)?,
            subscribers: by_topic(subscribers)?,
            services: by_topic(services)?,
            types: pairs(&types, text).ok_or(MasterError::Shape("getTopicTypes"))?,
        })
    }

    /// The name of the publisher of a topic that has this URI. Looks at a few publishers only: it is for messages.
    pub(crate) async fn name_of(&self, topic: &str, uri: &str) -> Option<String> {
        let graph = self.graph().await.ok()?;
        for name in graph.publishers.get(topic)?.iter().take(8) {
            if self.lookup_node(name).await.ok()?.as_deref() == Some(uri) {
                return Some(name.clone());
            }
        }
        None
    }

    /// Calls with the caller id in front and unwraps `[code, message, result]`.
    pub(crate) async fn call(
        &self,
        method: &'static str,
        mut params: Vec<Value>,
    ) -> Result<Value, MasterError> {
        params.insert(0, self.caller_id.as_str().into());
        let reply = rpc::call(&self.endpoint, method, params, CALL_LIMIT).await?;
        unwrap_triple(reply, method)
    }
}

/// Unwraps what every ROS API returns: status code, status message, result.
pub(crate) fn unwrap_triple(reply: Value, method: &'static str) -> Result<Value, MasterError> {
    let Value::Array(items) = reply else {
        return Err(MasterError::Shape(method));
    };
    let Ok([code, message, result]) = <[Value; 3]>::try_from(items) else {
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

/// Why the master, or another node's API, gave no result.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum MasterError {
    /// The call itself failed.
    #[error(transparent)]
    Rpc(#[from] RpcError),
    /// The peer answered with an error of its own.
    #[error("{method} was refused: {message}")]
    Refused {
        /// The method called.
        method: &'static str,
        /// What the peer says.
        message: String,
    },
    /// The peer's answer is not what the ROS API prescribes.
    #[error("the answer to {0} is not of the form ROS prescribes")]
    Shape(&'static str),
}

pub(crate) fn strings(value: &Value) -> Option<Vec<String>> {
    value
        .as_array()?
        .iter()
        .map(|item| item.as_str().map(str::to_owned))
        .collect()
}

fn pairs<T>(value: &Value, second: impl Fn(&Value) -> Option<T>) -> Option<BTreeMap<String, T>> {
    let pair = |item: &Value| match item.as_array()? {
        [topic, rest] => Some((topic.as_str()?.to_owned(), second(rest)?)),
        _ => None,
    };
    value.as_array()?.iter().map(pair).collect()
}

const CALL_LIMIT: Duration = Duration::from_secs(3);
