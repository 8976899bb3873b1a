//! A ROS master inside this process, for tests and for demonstrations without a ROS installation.

mod parameters;

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use tokio::net::TcpListener;
use tokio::sync::Notify;
use tokio::task::JoinSet;

use self::parameters::{ParameterTree, Update, parts};
use crate::clock;
use crate::crowd::Shares;
use crate::header::clipped;
use crate::names::{self, ResourceNameError};
use crate::outbox::lock;
use crate::rpc::{self, RpcEndpoint, RpcError};
use crate::xmlrpc::{MethodCall, MethodResponse, XmlRpcFault, XmlRpcValue};

/// A running master: registrations of topics and services, and the parameter tree. It stops on
/// drop.
///
/// It serves the Master and Parameter Server APIs of `wiki.ros.org/ROS`, notifies nodes of changed
/// topics and parameters, and requests a node to shut down when another node registers the same
/// name. Unlike `roscore` it has no `/rosout` and stores nothing in files.
#[derive(Debug)]
pub struct Core {
    address: SocketAddr,
    shared: Arc<Shared>,
    _tasks: JoinSet<()>,
}

impl Core {
    /// Listens on an address; port 0 selects a free port. Must be called inside a tokio runtime.
    /// Fails if the port is in use.
    pub fn start(address: SocketAddr) -> std::io::Result<Self> {
        let listener = std::net::TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let listener = TcpListener::from_std(listener)?;
        let shared = Arc::new(Shared {
            uri: format!("http://{address}/"),
            registry: Mutex::new(Registry::new()),
            changed: Notify::new(),
        });
        let mut tasks = JoinSet::new();
        let handler = Arc::clone(&shared);
        let places = Shares::of_process().nodes;
        tasks.spawn(async move {
            rpc::serve(listener, places, move |call| handler.answer(&call)).await;
        });
        tasks.spawn(notify(Arc::clone(&shared)));
        Ok(Self {
            address,
            shared,
            _tasks: tasks,
        })
    }

    /// Returns the value for `ROS_MASTER_URI`.
    pub fn uri(&self) -> &str {
        &self.shared.uri
    }

    /// Returns the address of the listener.
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
    parameters: ParameterTree,
    /// Topics with a change that their subscribers have not been notified of.
    dirty: BTreeSet<String>,
    /// Pending parameter updates by slave API, with only the latest update per key.
    updates: BTreeMap<String, Vec<(String, XmlRpcValue)>>,
    /// Slave APIs and names of nodes that have lost their name to another node and have not been
    /// notified.
    displaced: BTreeSet<(String, String)>,
}

/// Nodes and their slave APIs by topic.
type Registrations = BTreeMap<String, Vec<(String, String)>>;

impl Shared {
    fn answer(&self, call: &MethodCall) -> MethodResponse {
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
            ("getTopicTypes", _) => done(registry.topic_types(|_| true)),
            ("getPublishedTopics", [_, subgraph]) => done(registry.published_topics(subgraph)),
            ("getPublishedTopics", _) => {
                return Err(fault(
                    "getPublishedTopics: wrong number of arguments".to_owned(),
                ));
            }
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
            (method, _) => registry.parameter(method, &texts, call.params.get(2))?,
        };
        let changed = registry.has_news();
        drop(registry);
        if changed {
            self.changed.notify_one();
        }
        Ok(answer)
    }
}

impl Registry {
    fn new() -> Self {
        let mut registry = Self::default();
        // Tools distinguish the runs of a master by this parameter.
        let since = clock::utc().duration_since(SystemTime::UNIX_EPOCH);
        let started = since.unwrap_or_default().as_nanos();
        let run_id = format!("{started:x}-{:x}", std::process::id());
        let nobody = registry.parameters.set("/run_id", &run_id.into(), MASTER);
        registry.tell(nobody.unwrap_or_default());
        registry
    }

    fn registration(&mut self, method: &str, texts: &[&str]) -> MethodResponse {
        Ok(match (method, texts) {
            ("registerPublisher", [caller, topic, type_name, api]) => {
                self.know(caller, api);
                // A publisher of any type does not replace a known type.
                if *type_name != "*" || !self.types.contains_key(*topic) {
                    self.types
                        .insert((*topic).to_owned(), (*type_name).to_owned());
                }
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
                // A service that another node has taken over belongs to that node.
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

    fn parameter(
        &mut self,
        method: &str,
        texts: &[&str],
        value: Option<&XmlRpcValue>,
    ) -> MethodResponse {
        let tree = &mut self.parameters;
        Ok(match (method, texts) {
            ("setParam", [caller, name, _]) => {
                let name = full_name(name, caller)?;
                let told = value.and_then(|value| tree.set(&name, value, caller));
                let Some(told) = told else {
                    return Ok(triple(-1, "the root of all parameters is not a value", 0));
                };
                self.tell(told);
                done(0)
            }
            ("getParam", [caller, name]) => {
                let name = full_name(name, caller)?;
                let value = tree.get(&name);
                value.map_or_else(|| not_set(&name), done)
            }
            ("hasParam", [caller, name]) => done(XmlRpcValue::Bool(
                tree.get(&full_name(name, caller)?).is_some(),
            )),
            ("deleteParam", [caller, name]) => {
                let name = full_name(name, caller)?;
                match tree.delete(&name) {
                    Some(told) => {
                        self.tell(told);
                        done(0)
                    }
                    None => not_set(&name),
                }
            }
            ("searchParam", [caller, name]) => {
                not_too_deep(caller)?;
                not_too_deep(name)?;
                let full = tree.search(caller, name);
                found(full.as_deref(), "parameter")
            }
            ("subscribeParam", [caller, api, name]) => {
                let name = full_name(name, caller)?;
                self.know(caller, api);
                done(self.parameters.follow(&name, caller, api))
            }
            ("unsubscribeParam", [caller, api, name]) => {
                tree.unfollow(&full_name(name, caller)?, caller, api);
                self.forget_unused(caller);
                done(1)
            }
            ("getParamNames", _) => {
                let names = tree.names().into_iter().map(XmlRpcValue::from);
                done(names.collect::<Vec<_>>())
            }
            (
                "setParam" | "getParam" | "hasParam" | "deleteParam" | "searchParam"
                | "subscribeParam" | "unsubscribeParam",
                _,
            ) => return Err(fault(format!("{method}: wrong number of arguments"))),
            _ => return Err(fault(format!("no such method: {method}"))),
        })
    }

    /// Queues parameter updates for their subscribers. A queued update of the same key is outdated
    /// and removed.
    fn tell(&mut self, told: Vec<Update>) {
        for (api, key, value) in told {
            let waiting = self.updates.entry(api).or_default();
            waiting.retain(|(other, _)| *other != key);
            waiting.push((key, value));
        }
    }

    fn has_news(&self) -> bool {
        !self.dirty.is_empty() || !self.updates.is_empty() || !self.displaced.is_empty()
    }

    fn know(&mut self, caller: &str, api: &str) {
        let before = self.nodes.insert(caller.to_owned(), api.to_owned());
        if let Some(before) = before.filter(|before| before != api) {
            // The name has a new owner: the registrations of the previous owner are void.
            for registrations in [&mut self.publishers, &mut self.subscribers] {
                for (topic, nodes) in registrations.iter_mut() {
                    nodes.retain(|(node, _)| node != caller);
                    self.dirty.insert(topic.clone());
                }
                registrations.retain(|_, nodes| !nodes.is_empty());
            }
            self.services.retain(|_, (node, _)| node != caller);
            self.parameters.forget(caller);
            self.displaced.insert((before, caller.to_owned()));
        }
    }

    /// Returns the pending calls by slave API, in order.
    fn news(&mut self) -> BTreeMap<String, Vec<(&'static str, Vec<XmlRpcValue>)>> {
        let mut news: BTreeMap<String, Vec<_>> = BTreeMap::new();
        for topic in std::mem::take(&mut self.dirty) {
            let publishers = apis(&self.publishers, &topic);
            for (_, api) in self.subscribers.get(&topic).into_iter().flatten() {
                let params = vec![MASTER.into(), topic.as_str().into(), publishers.clone()];
                let calls = news.entry(api.clone()).or_default();
                calls.push(("publisherUpdate", params));
            }
        }
        for (api, updates) in std::mem::take(&mut self.updates) {
            let update = |(key, value): (String, XmlRpcValue)| {
                ("paramUpdate", vec![MASTER.into(), key.into(), value])
            };
            let calls = news.entry(api).or_default();
            calls.extend(updates.into_iter().map(update));
        }
        for (api, name) in std::mem::take(&mut self.displaced) {
            let reason = format!("[{name}] Reason: new node registered with same name");
            let calls = news.entry(api).or_default();
            calls.push(("shutdown", vec![MASTER.into(), reason.into()]));
        }
        news
    }

    fn forget_unused(&mut self, caller: &str) {
        let mut topics = self.publishers.values().chain(self.subscribers.values());
        let used = topics.any(|nodes| nodes.iter().any(|(node, _)| node == caller))
            || self.services.values().any(|(node, _)| node == caller)
            || self.parameters.is_followed_by(caller);
        if !used {
            self.nodes.remove(caller);
        }
    }

    fn system_state(&self) -> XmlRpcValue {
        let topics = |registrations: &Registrations| {
            let entry = |(topic, nodes): (&String, &Vec<(String, String)>)| {
                let names = nodes.iter().map(|(node, _)| node.as_str().into()).collect();
                XmlRpcValue::Array(vec![topic.as_str().into(), XmlRpcValue::Array(names)])
            };
            XmlRpcValue::Array(registrations.iter().map(entry).collect())
        };
        let service = |(name, (node, _)): (&String, &(String, String))| {
            XmlRpcValue::Array(vec![
                name.as_str().into(),
                XmlRpcValue::Array(vec![node.as_str().into()]),
            ])
        };
        let services = XmlRpcValue::Array(self.services.iter().map(service).collect());
        XmlRpcValue::Array(vec![
            topics(&self.publishers),
            topics(&self.subscribers),
            services,
        ])
    }

    /// Returns the types of the published topics below a namespace; an empty namespace selects all
    /// topics.
    fn published_topics(&self, subgraph: &str) -> XmlRpcValue {
        let namespace = match subgraph.trim_end_matches('/') {
            "" => String::new(),
            name => format!("{name}/"),
        };
        self.topic_types(|topic| {
            self.publishers.contains_key(topic) && topic.starts_with(&namespace)
        })
    }

    fn topic_types(&self, wanted: impl Fn(&str) -> bool) -> XmlRpcValue {
        let pair = |(topic, name): (&String, &String)| {
            XmlRpcValue::Array(vec![topic.as_str().into(), name.as_str().into()])
        };
        let types = self.types.iter().filter(|(topic, _)| wanted(topic));
        XmlRpcValue::Array(types.map(pair).collect())
    }
}

/// Notifies nodes of changes in rounds, so that no node receives an older state after a newer
/// state.
async fn notify(shared: Arc<Shared>) {
    loop {
        shared.changed.notified().await;
        let mut calls = JoinSet::new();
        for (api, news) in lock(&shared.registry).news() {
            if let Some(endpoint) = RpcEndpoint::parse(&api) {
                calls.spawn(async move {
                    for (method, params) in news {
                        rpc::call(&endpoint, method, params, NOTIFY_LIMIT).await?;
                    }
                    Ok::<(), RpcError>(())
                });
            }
        }
        while let Some(told) = calls.join_next().await {
            if let Ok(Err(error)) = told {
                tracing::debug!(%error, "cannot notify a node of a change");
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

fn apis(registrations: &Registrations, topic: &str) -> XmlRpcValue {
    let nodes = registrations.get(topic).into_iter().flatten();
    XmlRpcValue::Array(nodes.map(|(_, api)| api.as_str().into()).collect())
}

fn found(value: Option<&str>, what: &str) -> XmlRpcValue {
    value.map_or_else(|| triple(-1, &format!("unknown {what}"), 0), done)
}

fn done(result: impl Into<XmlRpcValue>) -> XmlRpcValue {
    triple(1, "", result)
}

fn triple(code: i32, message: &str, result: impl Into<XmlRpcValue>) -> XmlRpcValue {
    XmlRpcValue::Array(vec![code.into(), message.into(), result.into()])
}

fn not_set(name: &str) -> XmlRpcValue {
    triple(-1, &format!("Parameter [{name}] is not set"), 0)
}

/// Resolves the name of a parameter relative to the caller and returns its canonical form. Fails
/// for a name of more than [`MAX_PARTS`] parts.
fn full_name(name: &str, caller: &str) -> Result<String, XmlRpcFault> {
    let full = names::of_caller(name, caller)
        .map_err(|error: ResourceNameError| fault(clipped(&error.to_string()).to_owned()))?;
    not_too_deep(&full)?;
    Ok(full)
}

fn not_too_deep(name: &str) -> Result<(), XmlRpcFault> {
    if parts(name).nth(MAX_PARTS).is_some() {
        let name = clipped(name);
        return Err(fault(format!(
            "`{name}` has more than {MAX_PARTS} parts, the limit of this master"
        )));
    }
    Ok(())
}

const fn fault(message: String) -> XmlRpcFault {
    XmlRpcFault { code: -1, message }
}

/// Maximum number of parts in the name of a parameter. The tree is traversed by recursion, and its
/// depth must not depend on peers.
const MAX_PARTS: usize = 32;
/// Caller id of the master.
const MASTER: &str = "/master";
const NOTIFY_LIMIT: Duration = Duration::from_secs(3);

#[cfg(test)]
mod tests {
    use super::*;

    fn shared() -> Shared {
        Shared {
            uri: "http://127.0.0.1:11311/".to_owned(),
            registry: Mutex::new(Registry::new()),
            changed: Notify::new(),
        }
    }

    fn ask(shared: &Shared, method: &str, texts: &[&str]) -> MethodResponse {
        shared.answer(&MethodCall {
            method: method.to_owned(),
            params: texts.iter().map(|text| XmlRpcValue::from(*text)).collect(),
        })
    }

    fn types(topics: &[(&str, &str)]) -> XmlRpcValue {
        let pair = |(topic, name): &(&str, &str)| {
            XmlRpcValue::Array(vec![(*topic).into(), (*name).into()])
        };
        done(topics.iter().map(pair).collect::<Vec<_>>())
    }

    #[test]
    fn a_parameter_of_a_hundred_thousand_parts_is_refused_and_one_of_32_taken() {
        let shared = shared();
        let deep = "/a".repeat(100_000);
        for call in [
            vec!["setParam", "/n", &deep, "1"],
            vec!["getParam", "/n", &deep],
            vec!["hasParam", "/n", &deep],
            vec!["deleteParam", "/n", &deep],
            vec!["searchParam", "/n", &deep],
            vec!["searchParam", &deep, "a"],
            vec!["subscribeParam", "/n", "http://127.0.0.1:1/", &deep],
            vec!["unsubscribeParam", "/n", "http://127.0.0.1:1/", &deep],
            // The name is relative to the caller.
            vec!["setParam", &deep, "a", "1"],
        ] {
            let (method, texts) = call.split_first().unwrap();
            let refused = ask(&shared, method, texts).unwrap_err();
            assert!(
                refused.message.contains("32 parts") && refused.message.len() < 400,
                "{method}: {}",
                refused.message
            );
        }
        let most = "/a".repeat(32);
        assert_eq!(
            ask(&shared, "setParam", &["/n", &most, "1"]).unwrap(),
            done(0)
        );
        assert_eq!(ask(&shared, "getParam", &["/n", &most]).unwrap(), done("1"));
    }

    #[test]
    fn the_published_topics_are_those_with_publishers_below_the_namespace() {
        let shared = shared();
        let api = "http://127.0.0.1:1/";
        for (method, topic, name) in [
            ("registerPublisher", "/line/a", "std_msgs/String"),
            ("registerPublisher", "/lines", "std_msgs/Bool"),
            ("registerSubscriber", "/line/heard", "std_msgs/Int8"),
        ] {
            ask(&shared, method, &["/n", topic, name, api]).unwrap();
        }
        let published = |subgraph| ask(&shared, "getPublishedTopics", &["/n", subgraph]).unwrap();
        let line = ("/line/a", "std_msgs/String");
        let all = types(&[line, ("/lines", "std_msgs/Bool")]);
        assert_eq!(published(""), all);
        assert_eq!(published("/"), all);
        assert_eq!(published("/line"), types(&[line]));
        assert_eq!(published("/line/"), types(&[line]));
        ask(&shared, "unregisterPublisher", &["/n", "/line/a", api]).unwrap();
        assert_eq!(published("/line"), types(&[]));
    }

    #[test]
    fn a_publisher_of_any_type_leaves_the_type_that_is_known() {
        let shared = shared();
        for (name, known) in [
            ("*", "*"),
            ("std_msgs/String", "std_msgs/String"),
            ("*", "std_msgs/String"),
        ] {
            let texts = ["/n", "/a", name, "http://127.0.0.1:1/"];
            ask(&shared, "registerPublisher", &texts).unwrap();
            let now = ask(&shared, "getTopicTypes", &["/n"]).unwrap();
            assert_eq!(now, types(&[("/a", known)]));
        }
    }
}
