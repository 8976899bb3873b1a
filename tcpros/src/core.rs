//! A ROS master inside this process, for tests and for demonstrations without a ROS installation.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::Notify;
use tokio::task::JoinSet;

use crate::outbox::lock;
use crate::rpc::{self, Endpoint};
use crate::xmlrpc::{Call, Fault, Response, Value};

/// A running master: registrations of topics and services, and parameters under flat names. It ends on drop.
///
/// It is no replacement for `rosmaster`: parameters are not kept as a tree (`getParam` of a namespace finds nothing),
/// and a node that takes another's name is told nothing.
#[derive(Debug)]
pub struct Core {
    address: SocketAddr,
    shared: Arc<Shared>,
    _tasks: JoinSet<()>,
}

impl Core {
    /// Listens on an address; port 0 takes a free one. Must be called inside a tokio runtime. Fails when the port is
    /// taken.
    pub fn start(address: SocketAddr) -> std::io::Result<Self> {
        let listener = std::net::TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let listener = TcpListener::from_std(listener)?;
        let shared = Arc::new(Shared {
            uri: format!("http://{address}/"),
            registry: Mutex::default(),
            changed: Notify::new(),
        });
        let mut tasks = JoinSet::new();
        let handler = Arc::clone(&shared);
        tasks.spawn(async move { rpc::serve(listener, move |call| handler.answer(&call)).await });
        tasks.spawn(notify(Arc::clone(&shared)));
        Ok(Self {
            address,
            shared,
            _tasks: tasks,
        })
    }

    /// The value for `ROS_MASTER_URI`.
    pub fn uri(&self) -> &str {
        &self.shared.uri
    }

    /// Where it listens.
    pub const fn address(&self) -> SocketAddr {
        self.address
    }
}

#[derive(Debug)]
struct Shared {
    uri: String,
    registry: Mutex<Registry>,
    changed: Notify,
}

#[derive(Debug, Default)]
struct Registry {
    publishers: Registrations,
    subscribers: Registrations,
    services: BTreeMap<String, (String, String)>,
    types: BTreeMap<String, String>,
    /// URIs of the slave APIs by node name.
    nodes: BTreeMap<String, String>,
    parameters: BTreeMap<String, Value>,
    /// Topics whose subscribers have not been told of the last change.
    dirty: BTreeSet<String>,
}

/// Nodes and their slave APIs by topic.
type Registrations = BTreeMap<String, Vec<(String, String)>>;

impl Shared {
    fn answer(&self, call: &Call) -> Response {
        let texts: Vec<&str> = call
            .params
            .iter()
            .map(|p| p.as_str().unwrap_or(""))
            .collect();
        let mut registry = lock(&self.registry);
        let answer = match (call.method.as_str(), texts.as_slice()) {
            ("getPid", _) => done(i32::try_from(std::process::id()).unwrap_or(0)),
            ("getUri", _) => done(self.uri.as_str()),
            ("getSystemState", _) => done(registry.system_state()),
            ("getTopicTypes", _) | ("getPublishedTopics", _) => done(registry.topic_types()),
            ("lookupNode", [_, name, ..]) => {
                found(registry.nodes.get(*name).map(String::as_str), "node")
            }
            (
                "registerPublisher"
                | "registerSubscriber"
                | "unregisterPublisher"
                | "unregisterSubscriber"
                | "registerService"
                | "unregisterService"
                | "lookupService",
                _,
            ) => registry.registration(&call.method, &texts)?,
            (method, [_, name, ..]) => registry.parameter(method, name, call.params.get(2))?,
            (method, _) => registry.parameter(method, "", None)?,
        };
        let changed = !registry.dirty.is_empty();
        drop(registry);
        if changed {
            self.changed.notify_one();
        }
        Ok(answer)
    }
}

impl Registry {
    fn registration(&mut self, method: &str, texts: &[&str]) -> Response {
        Ok(match (method, texts) {
            ("registerPublisher", [caller, topic, type_name, api]) => {
                self.know(caller, api);
                self.types
                    .insert((*topic).to_owned(), (*type_name).to_owned());
                add(&mut self.publishers, topic, caller, api);
                self.dirty.insert((*topic).to_owned());
                done(apis(&self.subscribers, topic))
            }
            ("registerSubscriber", [caller, topic, type_name, api]) => {
                self.know(caller, api);
                if *type_name != "*" {
                    self.types
                        .entry((*topic).to_owned())
                        .or_insert_with(|| (*type_name).to_owned());
                }
                add(&mut self.subscribers, topic, caller, api);
                done(apis(&self.publishers, topic))
            }
            ("unregisterPublisher", [caller, topic, api]) => {
                let removed = remove(&mut self.publishers, topic, caller, api);
                self.dirty.insert((*topic).to_owned());
                self.forget_unused(caller);
                done(removed)
            }
            ("unregisterSubscriber", [caller, topic, api]) => {
                let removed = remove(&mut self.subscribers, topic, caller, api);
                self.forget_unused(caller);
                done(removed)
            }
            ("registerService", [caller, service, service_api, api]) => {
                self.know(caller, api);
                let entry = ((*caller).to_owned(), (*service_api).to_owned());
                self.services.insert((*service).to_owned(), entry);
                done(1)
            }
            ("unregisterService", [caller, service, service_api]) => {
                // A service that another node has taken over is that node's.
                let own = |(node, api): &(String, String)| node == caller && api == service_api;
                let removed = self.services.get(*service).is_some_and(own);
                if removed {
                    self.services.remove(*service);
                }
                self.forget_unused(caller);
                done(i32::from(removed))
            }
            ("lookupService", [_, service]) => found(
                self.services.get(*service).map(|(_, api)| api.as_str()),
                "service",
            ),
            _ => return Err(fault(format!("{method}: wrong number of arguments"))),
        })
    }

    fn parameter(&mut self, method: &str, name: &str, value: Option<&Value>) -> Response {
        Ok(match (method, value) {
            ("setParam", Some(value)) => {
                self.parameters.insert(name.to_owned(), value.clone());
                done(0)
            }
            ("getParam" | "subscribeParam", _) => match self.parameters.get(name) {
                Some(value) => triple(1, "", value.clone()),
                // `subscribeParam` says "not set yet" with an empty struct.
                None if method == "subscribeParam" => done(Value::Struct(Vec::new())),
                None => triple(-1, &format!("Parameter [{name}] is not set"), 0),
            },
            ("hasParam", _) => done(Value::Bool(self.parameters.contains_key(name))),
            ("deleteParam", _) => found(self.parameters.remove(name).map(|_| ""), "parameter"),
            ("searchParam", _) => {
                let full = format!("/{}", name.trim_start_matches('/'));
                let known = self.parameters.contains_key(&full);
                found(known.then_some(full.as_str()), "parameter")
            }
            ("unsubscribeParam", _) => done(1),
            ("getParamNames", _) => done(Value::Array(
                self.parameters
                    .keys()
                    .map(|key| key.as_str().into())
                    .collect(),
            )),
            _ => return Err(fault(format!("no such method: {method}"))),
        })
    }

    fn know(&mut self, caller: &str, api: &str) {
        let before = self.nodes.insert(caller.to_owned(), api.to_owned());
        if before.is_some_and(|before| before != api) {
            // The name has a new owner: what the old one had registered is void.
            for registrations in [&mut self.publishers, &mut self.subscribers] {
                for (topic, nodes) in registrations.iter_mut() {
                    nodes.retain(|(node, old)| node != caller || old == api);
                    self.dirty.insert(topic.clone());
                }
                registrations.retain(|_, nodes| !nodes.is_empty());
            }
            self.services.retain(|_, (node, _)| node != caller);
        }
    }

    fn forget_unused(&mut self, caller: &str) {
        let mut topics = self.publishers.values().chain(self.subscribers.values());
        let used = topics.any(|nodes| nodes.iter().any(|(node, _)| node == caller))
            || self.services.values().any(|(node, _)| node == caller);
        if !used {
            self.nodes.remove(caller);
        }
    }

    fn system_state(&self) -> Value {
        let topics = |registrations: &Registrations| {
            let entry = |(topic, nodes): (&String, &Vec<(String, String)>)| {
                let names = nodes.iter().map(|(node, _)| node.as_str().into()).collect();
                Value::Array(vec![topic.as_str().into(), Value::Array(names)])
            };
            Value::Array(registrations.iter().map(entry).collect())
        };
        let service = |(name, (node, _)): (&String, &(String, String))| {
            Value::Array(vec![
                name.as_str().into(),
                Value::Array(vec![node.as_str().into()]),
            ])
        };
        let services = Value::Array(self.services.iter().map(service).collect());
        Value::Array(vec![
            topics(&self.publishers),
            topics(&self.subscribers),
            services,
        ])
    }

    fn topic_types(&self) -> Value {
        let pair = |(topic, name): (&String, &String)| {
            Value::Array(vec![topic.as_str().into(), name.as_str().into()])
        };
        Value::Array(self.types.iter().map(pair).collect())
    }
}

/// Tells subscribers of changed topics, in rounds, so that no node hears an older list after a newer one.
async fn notify(shared: Arc<Shared>) {
    loop {
        shared.changed.notified().await;
        let mut calls = JoinSet::new();
        {
            let mut registry = lock(&shared.registry);
            for topic in std::mem::take(&mut registry.dirty) {
                let publishers = apis(&registry.publishers, &topic);
                for (_, api) in registry.subscribers.get(&topic).into_iter().flatten() {
                    let params = vec!["/master".into(), topic.as_str().into(), publishers.clone()];
                    if let Some(endpoint) = Endpoint::parse(api) {
                        calls.spawn(async move {
                            rpc::call(&endpoint, "publisherUpdate", params, NOTIFY_LIMIT).await
                        });
                    }
                }
            }
        }
        while let Some(told) = calls.join_next().await {
            if let Ok(Err(error)) = told {
                tracing::debug!(%error, "a subscriber was not told of a change");
            }
        }
    }
}

fn add(registrations: &mut Registrations, topic: &str, caller: &str, api: &str) {
    let nodes = registrations.entry(topic.to_owned()).or_default();
    if !nodes.iter().any(|(node, _)| node == caller) {
        nodes.push((caller.to_owned(), api.to_owned()));
    }
}

fn remove(registrations: &mut Registrations, topic: &str, caller: &str, api: &str) -> i32 {
    let Some(nodes) = registrations.get_mut(topic) else {
        return 0;
    };
    let before = nodes.len();
    nodes.retain(|(node, known)| node != caller || known != api);
    let removed = before - nodes.len();
    if nodes.is_empty() {
        registrations.remove(topic);
    }
    i32::try_from(removed).unwrap_or(i32::MAX)
}

fn apis(registrations: &Registrations, topic: &str) -> Value {
    let nodes = registrations.get(topic).into_iter().flatten();
    Value::Array(nodes.map(|(_, api)| api.as_str().into()).collect())
}

fn found(value: Option<&str>, what: &str) -> Value {
    value.map_or_else(|| triple(-1, &format!("unknown {what}"), 0), done)
}

fn done(result: impl Into<Value>) -> Value {
    triple(1, "", result)
}

fn triple(code: i32, message: &str, result: impl Into<Value>) -> Value {
    Value::Array(vec![code.into(), message.into(), result.into()])
}

const fn fault(message: String) -> Fault {
    Fault { code: -1, message }
}

const NOTIFY_LIMIT: Duration = Duration::from_secs(3);
