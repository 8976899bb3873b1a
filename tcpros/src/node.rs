//! The node: what it publishes, subscribes and offers, and the tasks that serve it.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicI32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use socket2::{Domain, Socket, Type};
use thiserror::Error;
use tokio::net::TcpListener;
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;
use tokio::time::timeout;

use crate::crowd::Shares;
use crate::events;
use crate::inbox::Inbox;
use crate::link::LinkContext;
use crate::master::{Graph, Master, MasterError};
use crate::names::{NameError, Names};
use crate::options::NodeOptions;
use crate::outbox::{Limit, lock};
use crate::parameters::{ParamValue, Parameters, Params};
use crate::publisher::{Hub, Publisher, PublisherOptions, TopicType};
use crate::service::{
    Served, ServiceClient, ServiceClientOptions, ServiceOptions, ServiceRequest, ServiceServer,
    ServiceType,
};
use crate::subscription::{Feed, SubscriberOptions, Subscription, Wanted};
use crate::time::{CLOCK_MD5, CLOCK_TYPE, RosClock, RosTime};
use crate::{registrar, rpc, slave, topic_server};

/// A ROS 1 node. Dropping it ends its connections; only [`Node::shutdown`] also tells the master.
///
/// Three tasks belong to it: the slave API, the listener for subscribers and clients, and the one that keeps the master
/// informed. Each connection to a subscriber, publisher or client is a task besides. All end with the node.
#[derive(Debug)]
pub struct Node {
    inner: Arc<Inner>,
    tasks: JoinSet<()>,
}

impl Node {
    /// Opens the node's two ports and begins to look for the master, which need not be there yet.
    ///
    /// Must be called inside a tokio runtime with IO and time. Fails when a name is no ROS name, when the master's
    /// URI does not read as one, or when no port can be opened.
    pub fn start(options: NodeOptions) -> Result<Self, NodeError> {
        if tokio::runtime::Handle::try_current().is_err() {
            return Err(NodeError::NoRuntime);
        }
        let names = options.names()?;
        let params = params(&names, options.parameters.clone())?;
        let endpoint = options
            .master()
            .ok_or_else(|| NodeError::MasterUri(options.master_uri.clone()))?;
        let (api, api_port) = listen(options.bind)?;
        let (topics, topics_port) = listen(options.bind)?;
        let uri = format!("http://{}:{api_port}/", rpc::bracketed(&options.hostname));
        let caller_id = names.node().to_owned();
        let master = Master::new(endpoint, options.master_uri, caller_id.clone(), uri.clone());
        let shares = Shares::of_process();
        let context = LinkContext::new(caller_id, options.max_message, master.clone(), &shares);
        let inner = Arc::new(Inner {
            names,
            uri,
            service_uri: format!(
                "rosrpc://{}:{topics_port}",
                rpc::bracketed(&options.hostname)
            ),
            hostname: options.hostname,
            topics_port,
            master,
            links: Arc::new(context),
            params,
            clock: RosClock::default(),
            clock_feed: Mutex::default(),
            registry: Mutex::default(),
            changed: Notify::new(),
            master_state: watch::Sender::new(MasterState::Awaited),
            shutdown: watch::Sender::new(None),
            contests: AtomicU64::new(0),
            decided: AtomicU64::new(0),
            settled: watch::Sender::new(false),
            draining: watch::Sender::new(0),
            next_id: AtomicI32::new(1),
        });
        let mut tasks = JoinSet::new();
        let handler = Arc::clone(&inner);
        tasks.spawn(async move {
            rpc::serve(api, shares.callers, move |call| {
                slave::answer(&handler, call)
            })
            .await;
        });
        let served = topic_server::serve(topics, shares.subscribers, Arc::clone(&inner));
        tasks.spawn(served);
        tasks.spawn(registrar::run(Arc::clone(&inner)));
        Ok(Self { inner, tasks })
    }

    /// The node's resolved name, as others see it in `callerid`.
    pub fn name(&self) -> &str {
        self.inner.name()
    }

    /// The URI of the node's slave API, as the master is told it.
    pub fn uri(&self) -> &str {
        &self.inner.uri
    }

    /// A topic's or service's name as this node resolves it: namespace, `~` and remappings applied.
    pub fn resolve(&self, topic: &str) -> Result<String, NameError> {
        self.inner.names.resolve(topic)
    }

    /// The time for the stamps of messages: that of [`Node::clock`].
    pub fn now(&self) -> RosTime {
        self.inner.clock.now()
    }

    /// The clock that follows `/use_sim_time` and `/clock`. From [`MasterState::Registered`] on it is the one the
    /// master wants; before that it is the wall clock.
    pub fn clock(&self) -> RosClock {
        self.inner.clock.clone()
    }

    /// The parameters of the node's master.
    pub fn parameters(&self) -> Parameters {
        Parameters::new(Arc::clone(&self.inner))
    }

    /// Whether the master has been found, now and as it changes.
    pub fn master_state(&self) -> watch::Receiver<MasterState> {
        self.inner.master_state.subscribe()
    }

    /// Waits until this node is told to shut down, as by `rosnode kill`, or has lost its name to another node, and
    /// gives the reason. Cancel-safe, and free to outlive the borrow of the node.
    pub fn shutdown_requested(&self) -> impl Future<Output = String> + Send + use<> {
        let mut asked = self.inner.shutdown.subscribe();
        async move {
            let reason = asked.wait_for(Option::is_some).await;
            match reason.map(|reason| reason.clone()) {
                Ok(reason) => reason.unwrap_or_default(),
                // The node is gone, and nobody can ask it any more.
                Err(_) => std::future::pending().await,
            }
        }
    }

    /// Publishes a topic. Fails when the name is no ROS name, when this node already publishes it, or when the type
    /// is not complete: subscribers compare its checksum, and `rosbag` records its definition.
    pub fn advertise(
        &self,
        topic: &str,
        topic_type: TopicType,
        options: PublisherOptions,
    ) -> Result<Publisher, NodeError> {
        let topic = self.inner.names.resolve(topic)?;
        if !topic_type.name.contains('/') || topic_type.md5sum.len() != 32 {
            return Err(NodeError::Type {
                topic,
                type_name: topic_type.name,
            });
        }
        let mut registry = lock(&self.inner.registry);
        if registry.publications.contains_key(&topic) {
            return Err(NodeError::AlreadyPublished(topic));
        }
        let generation = registry.next_generation();
        let draining = self.inner.draining.clone();
        let hub = Arc::new(Hub::new(
            topic.clone(),
            topic_type,
            options,
            generation,
            draining,
        ));
        registry.publications.insert(topic, Arc::clone(&hub));
        drop(registry);
        self.inner.changed.notify_one();
        Ok(Publisher::new(hub, Arc::clone(&self.inner)))
    }

    /// Subscribes a topic into an inbox. What this node publishes itself is not received. Fails when the name is no
    /// ROS name.
    #[expect(
        clippy::too_many_arguments,
        reason = "the key and the inbox belong to the call, not to a subscriber's options"
    )]
    pub fn subscribe<K: Clone + Send + 'static>(
        &self,
        topic: &str,
        wanted: Wanted,
        options: SubscriberOptions,
        key: K,
        inbox: &Inbox<K>,
    ) -> Result<Subscription, NodeError> {
        let topic = self.inner.names.resolve(topic)?;
        let limit = Limit {
            messages: options.queue_messages,
            bytes: options.queue_bytes,
        };
        let entrance = Box::new(inbox.open(key, limit));
        let feed = Arc::new(Feed::new(topic, wanted, entrance));
        // A node that can still be asked is open.
        let _open = self.inner.follow(&feed);
        Ok(Subscription::new(feed, Arc::clone(&self.inner)))
    }

    /// Offers a service. The handler is called once per request, for several clients at a time; what it fails with
    /// reaches the client as text. Where several nodes offer one service, the master sends clients to the last.
    ///
    /// Fails when the name is no ROS name, when this node already offers it, or when the type is not complete.
    pub fn advertise_service<H, F>(
        &self,
        service: &str,
        service_type: ServiceType,
        options: ServiceOptions,
        handler: H,
    ) -> Result<ServiceServer, NodeError>
    where
        H: Fn(ServiceRequest) -> F + Send + Sync + 'static,
        F: Future<Output = Result<Bytes, String>> + Send + 'static,
    {
        let service = self.inner.names.resolve(service)?;
        if !service_type.name.contains('/') || service_type.md5sum.len() != 32 {
            return Err(NodeError::ServiceType {
                service,
                type_name: service_type.name,
            });
        }
        let mut registry = lock(&self.inner.registry);
        if registry.services.contains_key(&service) {
            return Err(NodeError::AlreadyOffered(service));
        }
        let served = Arc::new(Served::new(
            service.clone(),
            service_type,
            options,
            registry.next_generation(),
            self.inner.draining.clone(),
            handler,
        ));
        registry.services.insert(service, Arc::clone(&served));
        drop(registry);
        self.inner.changed.notify_one();
        Ok(ServiceServer::new(served, Arc::clone(&self.inner)))
    }

    /// A client of a service, which need not be there yet: nobody is asked before the first call. Fails when the name
    /// is no ROS name.
    pub fn service_client(
        &self,
        service: &str,
        options: ServiceClientOptions,
    ) -> Result<ServiceClient, NodeError> {
        let service = self.inner.names.resolve(service)?;
        let master = self.inner.master.clone();
        Ok(ServiceClient::new(service, options, self.name(), master))
    }

    /// Asks the master who publishes, subscribes and offers what.
    pub async fn graph(&self) -> Result<Graph, MasterError> {
        self.inner.master.graph().await
    }

    /// Asks the same in another task, which may outlive the node.
    pub fn graph_reader(&self) -> GraphReader {
        GraphReader {
            master: self.inner.master.clone(),
        }
    }

    /// Withdraws everything from the master and ends: connections to subscribers after their queues are written, those
    /// to clients after their requests are answered, all within two seconds. What a master that cannot be reached keeps
    /// is logged by its names; one that answers too slowly is logged as such.
    pub async fn shutdown(mut self) {
        let mut settled = self.inner.settled.subscribe();
        let mut draining = self.inner.draining.subscribe();
        self.inner.close();
        self.inner.changed.notify_one();
        // What the two give is a lock that must not be held while the other waits; an error is the end as well.
        let done = async {
            let _settled = settled.wait_for(|settled| *settled).await.is_ok();
            let _drained = draining.wait_for(|open| *open == 0).await.is_ok();
        };
        if timeout(SHUTDOWN_LIMIT, done).await.is_err() {
            events::shutdown_incomplete(SHUTDOWN_LIMIT);
        }
        self.tasks.shutdown().await;
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.inner.close();
    }
}

/// Asks the master of a node who publishes, subscribes and offers what.
#[derive(Clone, Debug)]
pub struct GraphReader {
    master: Master,
}

impl GraphReader {
    /// The graph as the master knows it now. Takes a few seconds at most; fails while there is no master.
    pub async fn read(&self) -> Result<Graph, MasterError> {
        self.master.graph().await
    }
}

/// Where the node stands with its master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MasterState {
    /// Not found yet, or lost: the node looks for it.
    Awaited,
    /// It answers, and was told of all that the node had then. What it refused is tried again, with a line in the log,
    /// and what was added since may still be on its way.
    Registered,
}

/// Why a node could not start or a topic or service could not be taken.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum NodeError {
    /// Called outside a tokio runtime.
    #[error("a node needs a running tokio runtime")]
    NoRuntime,
    /// A name that is no ROS name.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The master's URI is not `http://host:port`.
    #[error("the master's URI `{0}` is not of the form http://host:11311 (ROS_MASTER_URI)")]
    MasterUri(String),
    /// No port to listen on.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address tried.
        address: IpAddr,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// This node publishes the topic already.
    #[error("{0} is already published by this node")]
    AlreadyPublished(String),
    /// The type has no package or no checksum.
    #[error("{topic} cannot be published with the incomplete type `{type_name}`")]
    Type {
        /// The resolved topic.
        topic: String,
        /// The name given.
        type_name: String,
    },
    /// This node offers the service already.
    #[error("{0} is already offered by this node")]
    AlreadyOffered(String),
    /// The service's type has no package or no checksum.
    #[error("{service} cannot be offered with the incomplete type `{type_name}`")]
    ServiceType {
        /// The resolved service.
        service: String,
        /// The name given.
        type_name: String,
    },
}

/// What the node's handles and tasks share.
#[derive(Debug)]
pub(crate) struct Inner {
    names: Names,
    pub(crate) uri: String,
    /// Where the node's services are called, as the master is told it.
    pub(crate) service_uri: String,
    pub(crate) hostname: String,
    pub(crate) topics_port: u16,
    pub(crate) master: Master,
    links: Arc<LinkContext>,
    pub(crate) params: Params,
    clock: RosClock,
    /// The subscription of `/clock` while time is simulated.
    clock_feed: Mutex<Option<Arc<Feed>>>,
    registry: Mutex<Registry>,
    /// Rings when the registry no longer is what the master was told.
    pub(crate) changed: Notify,
    pub(crate) master_state: watch::Sender<MasterState>,
    /// The reason once the master asked for it.
    shutdown: watch::Sender<Option<String>>,
    /// How often the master said that another node has taken this node's name, and of how many of them it was found out
    /// that the name is this node's.
    contests: AtomicU64,
    decided: AtomicU64,
    /// True once everything is closed and the master was told so.
    pub(crate) settled: watch::Sender<bool>,
    /// Connections to subscribers and clients, those of withdrawn topics and services included.
    draining: watch::Sender<usize>,
    next_id: AtomicI32,
}

#[derive(Debug, Default)]
struct Registry {
    publications: HashMap<String, Arc<Hub>>,
    subscriptions: HashMap<String, Subscribed>,
    services: HashMap<String, Arc<Served>>,
    generation: u64,
    closed: bool,
}

impl Registry {
    const fn next_generation(&mut self) -> u64 {
        self.generation += 1;
        self.generation
    }
}

#[derive(Debug)]
struct Subscribed {
    generation: u64,
    /// How many lists of publishers have come.
    updates: u64,
    /// The last of them.
    publishers: Vec<String>,
    feeds: Vec<Arc<Feed>>,
}

/// What the master should know of one topic or service, and which version of it.
#[derive(Clone, Debug)]
pub(crate) struct Registration {
    pub(crate) name: String,
    pub(crate) kind: ResourceKind,
    pub(crate) generation: u64,
    /// Of a topic; the master is not told the type of a service.
    pub(crate) type_name: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum ResourceKind {
    Published,
    Subscribed,
    Service,
}

impl Inner {
    pub(crate) fn name(&self) -> &str {
        self.names.node()
    }

    pub(crate) fn next_connection_id(&self) -> i32 {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    pub(crate) fn publication(&self, topic: &str) -> Option<Arc<Hub>> {
        lock(&self.registry).publications.get(topic).cloned()
    }

    pub(crate) fn publications(&self) -> Vec<Arc<Hub>> {
        lock(&self.registry)
            .publications
            .values()
            .cloned()
            .collect()
    }

    pub(crate) fn feeds(&self) -> Vec<Arc<Feed>> {
        let registry = lock(&self.registry);
        registry
            .subscriptions
            .values()
            .flat_map(|entry| entry.feeds.iter().cloned())
            .collect()
    }

    /// The full name of a parameter; `/` is the root of all.
    pub(crate) fn parameter_name(&self, name: &str) -> Result<String, NameError> {
        if name == "/" {
            Ok(name.to_owned())
        } else {
            self.names.resolve(name)
        }
    }

    /// A parameter's name for the master to search upwards from this node. A remapped name is no longer relative.
    pub(crate) fn searched_name(&self, name: &str) -> Result<String, NameError> {
        self.names.searched(name)
    }

    /// What is followed of a parameter or namespace has to be read anew.
    pub(crate) fn parameter_changed(&self, name: &str) {
        self.params.touch(name);
        self.changed.notify_one();
    }

    /// Goes over to simulated time, or back.
    pub(crate) fn simulate(&self, simulated: bool) {
        if !self.clock.simulate(simulated) {
            return;
        }
        events::time_source_changed(simulated);
        let mut current = lock(&self.clock_feed);
        if let Some(feed) = current.take() {
            feed.close();
            self.withdraw_subscription(&feed);
        }
        if simulated && let Ok(topic) = self.names.resolve("/clock") {
            let wanted = Wanted {
                type_name: Some(CLOCK_TYPE.to_owned()),
                md5sum: Some(CLOCK_MD5.to_owned()),
            };
            let feed = Arc::new(Feed::new(topic, wanted, Box::new(self.clock.clone())));
            if self.follow(&feed) {
                *current = Some(feed);
            }
        }
    }

    /// Registers a subscription and links it to the publishers known. False once the node is closed, which closes the
    /// feed as well.
    fn follow(&self, feed: &Arc<Feed>) -> bool {
        let mut registry = lock(&self.registry);
        if registry.closed {
            drop(registry);
            feed.close();
            return false;
        }
        let generation = registry.next_generation();
        let entry = registry
            .subscriptions
            .entry(feed.topic.clone())
            .or_insert_with(|| Subscribed {
                generation,
                updates: 0,
                publishers: Vec::new(),
                feeds: Vec::new(),
            });
        entry.feeds.push(Arc::clone(feed));
        self.connect(feed, &entry.publishers);
        drop(registry);
        self.changed.notify_one();
        true
    }

    pub(crate) fn withdraw_publication(&self, hub: &Arc<Hub>) {
        let mut registry = lock(&self.registry);
        if registry
            .publications
            .get(&hub.topic)
            .is_some_and(|known| Arc::ptr_eq(known, hub))
        {
            registry.publications.remove(&hub.topic);
        }
        drop(registry);
        self.changed.notify_one();
    }

    pub(crate) fn service(&self, name: &str) -> Option<Arc<Served>> {
        lock(&self.registry).services.get(name).cloned()
    }

    pub(crate) fn services(&self) -> Vec<Arc<Served>> {
        lock(&self.registry).services.values().cloned().collect()
    }

    pub(crate) fn withdraw_service(&self, served: &Arc<Served>) {
        let mut registry = lock(&self.registry);
        let known = registry.services.get(&served.service);
        if known.is_some_and(|known| Arc::ptr_eq(known, served)) {
            registry.services.remove(&served.service);
        }
        drop(registry);
        self.changed.notify_one();
    }

    pub(crate) fn withdraw_subscription(&self, feed: &Arc<Feed>) {
        let mut registry = lock(&self.registry);
        if let Some(entry) = registry.subscriptions.get_mut(&feed.topic) {
            entry.feeds.retain(|known| !Arc::ptr_eq(known, feed));
            if entry.feeds.is_empty() {
                registry.subscriptions.remove(&feed.topic);
            }
        }
        drop(registry);
        self.changed.notify_one();
    }

    /// All that the master should know now.
    pub(crate) fn wanted_registrations(&self) -> Vec<Registration> {
        let registry = lock(&self.registry);
        let published = registry.publications.values().map(|hub| Registration {
            name: hub.topic.clone(),
            kind: ResourceKind::Published,
            generation: hub.generation,
            type_name: hub.topic_type.name.clone(),
        });
        let subscribed = registry
            .subscriptions
            .iter()
            .map(|(topic, entry)| Registration {
                name: topic.clone(),
                kind: ResourceKind::Subscribed,
                generation: entry.generation,
                type_name: entry
                    .feeds
                    .iter()
                    .find_map(|feed| feed.wanted.type_name.clone())
                    .unwrap_or_else(|| "*".to_owned()),
            });
        let offered = registry.services.values().map(|served| Registration {
            name: served.service.clone(),
            kind: ResourceKind::Service,
            generation: served.generation,
            type_name: String::new(),
        });
        published.chain(subscribed).chain(offered).collect()
    }

    /// How many lists of publishers have come for a topic.
    pub(crate) fn updates(&self, topic: &str) -> u64 {
        lock(&self.registry)
            .subscriptions
            .get(topic)
            .map_or(0, |entry| entry.updates)
    }

    /// Takes the list that answers a registration, unless a newer one came meanwhile.
    pub(crate) fn registered_publishers(&self, topic: &str, publishers: &[String], seen: u64) {
        self.take_publishers(topic, publishers, |updates| updates == seen);
    }

    /// Takes the list that the master sends unasked.
    pub(crate) fn publishers_changed(&self, topic: &str, publishers: &[String]) {
        self.take_publishers(topic, publishers, |_| true);
    }

    /// Compares and links under one lock, so that no list is overtaken by an older one.
    fn take_publishers(&self, topic: &str, publishers: &[String], due: impl Fn(u64) -> bool) {
        let mut registry = lock(&self.registry);
        if registry.closed {
            return;
        }
        let Some(entry) = registry.subscriptions.get_mut(topic) else {
            return;
        };
        if !due(entry.updates) {
            return;
        }
        entry.updates += 1;
        // Those that no subscription would be connected to need not be kept.
        let most = self.links.publishers_of_topic;
        entry.publishers = publishers.iter().take(most).cloned().collect();
        for feed in &entry.feeds {
            self.connect(feed, publishers);
        }
    }

    /// Links a feed to publishers other than this node itself. Called with the registry locked, whose lock comes before
    /// that of a feed's links.
    fn connect(&self, feed: &Arc<Feed>, publishers: &[String]) {
        let own = self.uri.trim_end_matches('/');
        let others: Vec<String> = publishers
            .iter()
            .filter(|uri| uri.trim_end_matches('/') != own)
            .cloned()
            .collect();
        feed.update(&others, &self.links, || self.next_connection_id());
    }

    /// Tells whoever waits in [`Node::shutdown_requested`].
    pub(crate) fn ask_to_shut_down(&self, reason: &str) {
        self.shutdown.send_if_modified(|asked| {
            let first = asked.is_none();
            asked.get_or_insert_with(|| reason.to_owned());
            first
        });
    }

    /// The master says that another node has taken this node's name: nothing is registered until it is clear whose it is.
    pub(crate) fn name_is_contested(&self) {
        self.contests.fetch_add(1, Ordering::AcqRel);
        self.changed.notify_one();
    }

    /// Which of the contests for the name is open.
    pub(crate) fn contest(&self) -> Option<u64> {
        let last = self.contests.load(Ordering::Acquire);
        let open = last != self.decided.load(Ordering::Acquire) && !self.is_asked_to_shut_down();
        open.then_some(last)
    }

    /// The name was this node's when the master was asked after so many contests.
    pub(crate) fn decided(&self, contest: u64) {
        self.decided.store(contest, Ordering::Release);
    }

    /// Whether the name is this node's, as far as it knows.
    pub(crate) fn may_register(&self) -> bool {
        !self.is_asked_to_shut_down() && self.contest().is_none()
    }

    fn is_asked_to_shut_down(&self) -> bool {
        self.shutdown.borrow().is_some()
    }

    pub(crate) fn is_closed(&self) -> bool {
        lock(&self.registry).closed
    }

    /// Ends all topics and services, for good.
    fn close(&self) {
        let mut registry = lock(&self.registry);
        registry.closed = true;
        let hubs: Vec<_> = registry.publications.drain().map(|(_, hub)| hub).collect();
        let feeds: Vec<_> = registry
            .subscriptions
            .drain()
            .flat_map(|(_, entry)| entry.feeds)
            .collect();
        let services: Vec<_> = registry
            .services
            .drain()
            .map(|(_, served)| served)
            .collect();
        drop(registry);
        self.params.close();
        for hub in &hubs {
            hub.close();
        }
        for feed in &feeds {
            feed.close();
        }
        for served in &services {
            served.close();
        }
    }
}

/// The parameters to begin with, by their full names. Of several for one name the last counts.
fn params(names: &Names, given: Vec<(String, ParamValue)>) -> Result<Params, NodeError> {
    let mut last: Vec<(String, ParamValue)> = Vec::new();
    for (name, value) in given {
        let full = names.resolve(&format!("~{name}"))?;
        last.retain(|(other, _)| *other != full);
        last.push((full, value));
    }
    Ok(Params::new(last, names.resolve("/use_sim_time")?))
}

/// Listens on a port of the system's choosing.
fn listen(address: IpAddr) -> Result<(TcpListener, u16), NodeError> {
    let open = || {
        let address = SocketAddr::from((address, 0));
        let socket = Socket::new(Domain::for_address(address), Type::STREAM, None)?;
        socket.bind(&address.into())?;
        socket.listen(BACKLOG)?;
        socket.set_nonblocking(true)?;
        let listener = TcpListener::from_std(socket.into())?;
        let port = listener.local_addr()?.port();
        Ok((listener, port))
    };
    open().map_err(|source| NodeError::Listen { address, source })
}

const SHUTDOWN_LIMIT: Duration = Duration::from_secs(2);
/// Peers that may connect in one moment: a launch file starts a whole graph at once, and one that is not let in tries
/// again after a second.
const BACKLOG: i32 = 1024;

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    fn options() -> NodeOptions {
        let mut options = NodeOptions::from_env("n");
        // Nothing listens there.
        "http://127.0.0.1:1".clone_into(&mut options.master_uri);
        "/".clone_into(&mut options.namespace);
        options.advertise_as("127.0.0.1");
        options.bind = Ipv4Addr::LOCALHOST.into();
        options
    }

    #[tokio::test]
    async fn a_closed_node_does_not_begin_to_follow_the_simulated_clock() {
        let node = Node::start(options()).unwrap();
        node.inner.simulate(true);
        assert_eq!(node.inner.wanted_registrations().len(), 1);
        node.inner.simulate(false);
        node.inner.close();
        node.inner.simulate(true);
        assert!(node.inner.wanted_registrations().is_empty());
        assert!(lock(&node.inner.clock_feed).is_none());
    }

    #[tokio::test]
    async fn the_answer_to_a_registration_does_not_replace_a_newer_list() {
        let node = Node::start(options()).unwrap();
        node.inner.simulate(true);
        let list = |port: u16| vec![format!("http://127.0.0.1:{port}/")];
        let known = || {
            let registry = lock(&node.inner.registry);
            registry.subscriptions["/clock"].publishers.clone()
        };
        let seen = node.inner.updates("/clock");
        node.inner.publishers_changed("/clock", &list(2));
        node.inner.registered_publishers("/clock", &list(3), seen);
        assert_eq!(known(), list(2));
        let seen = node.inner.updates("/clock");
        node.inner.registered_publishers("/clock", &list(3), seen);
        assert_eq!(known(), list(3));
    }

    #[test]
    fn of_several_values_for_one_parameter_the_last_counts() {
        let names = options().names().unwrap();
        let given = [("rate", 5), ("gain", 1), ("rate", 6)];
        let given = given.map(|(name, value)| (name.to_owned(), value.into()));
        let params = params(&names, given.to_vec());
        assert_eq!(
            params.unwrap().given(),
            [
                ("/n/gain".to_owned(), 1.into()),
                ("/n/rate".to_owned(), 6.into())
            ]
        );
    }
}
