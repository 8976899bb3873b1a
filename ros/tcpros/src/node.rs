//! The node: its topics and services, and the tasks that serve it.

mod error;
mod graph_reader;
mod listener;
mod name_contests;
mod registry;

use std::collections::HashSet;
use std::net::IpAddr;
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;
use tokio::time::timeout;

pub use self::error::NodeError;
pub use self::graph_reader::GraphReader;
use self::listener::listen;
use self::name_contests::NameContests;
pub(crate) use self::registry::{Registration, ResourceKind};
use self::registry::{Registry, Subscribed};
use crate::crowd::Shares;
use crate::events;
use crate::inbox::Inbox;
use crate::link::LinkContext;
use crate::master::{Master, MasterError, MasterGraph, MasterState};
use crate::names::{NameResolver, ResourceNameError};
use crate::options::NodeOptions;
use crate::outbox::{Limit, lock};
use crate::parameters::{NodeParameters, ParamValue, Params};
use crate::publisher::{PublishedTopic, Publisher, PublisherOptions, TopicType};
use crate::reach::NetworkReach;
use crate::service::{
    OfferedService, ServiceClient, ServiceClientOptions, ServiceOptions, ServiceRequest,
    ServiceServer, ServiceTypeSum,
};
use crate::subscription::{RequestedType, SubscriberOptions, Subscription, TopicFeed};
use crate::time::{CLOCK_MD5, CLOCK_TYPE, Ros1Clock, Ros1Time};
use crate::{registrar, rpc, slave, topic_server};

/// A ROS 1 node. Dropping it ends its connections; only [`Node::shutdown`] also unregisters it at
/// the master.
///
/// A node has three tasks: the slave API, the listener for subscribers and clients, and the
/// registrar that keeps the master up to date. Each connection to a subscriber, publisher or client
/// has another task. All tasks end with the node.
#[derive(Debug)]
pub struct Node {
    inner: Arc<Inner>,
    tasks: JoinSet<()>,
}

impl Node {
    /// Opens the two ports of the node and starts to connect to the master, which may start later.
    ///
    /// Must be called inside a tokio runtime with IO and time.
    ///
    /// # Errors
    /// Fails if a name is not a valid ROS name, if the master's URI is invalid, or if no port can
    /// be opened.
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
        let (network, reach) = NetworkReach::new();
        let context = LinkContext::new(
            caller_id,
            options.max_message,
            (master.clone(), reach),
            &shares,
        );
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
            network,
            params,
            clock: Ros1Clock::default(),
            clock_feed: Mutex::default(),
            registry: Mutex::default(),
            renewed: Mutex::default(),
            changed: Notify::new(),
            master_state: watch::Sender::new(MasterState::Awaited),
            shutdown: watch::Sender::new(None),
            name_contests: NameContests::default(),
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

    /// Returns the node's resolved name, which other nodes see in `callerid`.
    pub fn name(&self) -> &str {
        self.inner.name()
    }

    /// Returns the URI of the node's slave API, which is registered with the master.
    pub fn uri(&self) -> &str {
        &self.inner.uri
    }

    /// Resolves the name of a topic or service: applies the namespace, `~` and remappings.
    pub fn resolve(&self, topic: &str) -> Result<String, ResourceNameError> {
        self.inner.names.resolve(topic)
    }

    /// Returns the time of [`Node::clock`] for the stamps of messages.
    pub fn now(&self) -> Ros1Time {
        self.inner.clock.now()
    }

    /// Returns the clock that follows `/use_sim_time` and `/clock`. Before
    /// [`MasterState::Registered`] it is the wall clock, from then on the clock that the master's
    /// parameter selects.
    pub fn clock(&self) -> Ros1Clock {
        self.inner.clock.clone()
    }

    /// Returns the parameters of the node's master.
    pub fn parameters(&self) -> NodeParameters {
        NodeParameters::new(Arc::clone(&self.inner))
    }

    /// Returns the state of the connection to the master and its changes.
    pub fn master_state(&self) -> watch::Receiver<MasterState> {
        self.inner.master_state.subscribe()
    }

    /// Waits for the request to shut down, as by `rosnode kill`, or for the loss of the node's name
    /// to another node, and returns the reason. Cancel-safe. The future may outlive the borrow of
    /// the node.
    pub fn shutdown_requested(&self) -> impl Future<Output = String> + Send + use<> {
        let mut asked = self.inner.shutdown.subscribe();
        async move {
            let reason = asked.wait_for(Option::is_some).await;
            match reason.map(|reason| reason.clone()) {
                Ok(reason) => reason.unwrap_or_default(),
                // The node was dropped, and no request can arrive.
                Err(_) => std::future::pending().await,
            }
        }
    }

    /// Publishes a topic.
    ///
    /// # Errors
    /// Fails if the name is not a valid ROS name, if this node already publishes the topic, or if
    /// the type is incomplete. Subscribers compare the checksum of the type, and `rosbag` records
    /// its definition.
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
        let hub = Arc::new(PublishedTopic::new(
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

    /// Subscribes to a topic with an inbox. Messages of this node itself are not received. Fails if
    /// the name is not a valid ROS name.
    #[expect(
        clippy::too_many_arguments,
        reason = "the key and the inbox belong to the call, not to a subscriber's options"
    )]
    pub fn subscribe<K: Clone + Send + 'static>(
        &self,
        topic: &str,
        wanted: RequestedType,
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
        let feed = TopicFeed::new(topic, wanted, entrance).keeping_cut_off(options.keep_cut_off);
        let feed = Arc::new(feed);
        // A node that can still be called is open.
        let _open = self.inner.follow(&feed);
        Ok(Subscription::new(feed, Arc::clone(&self.inner)))
    }

    /// Offers a service. The handler is called once per request, for several clients at a time; its
    /// error is sent to the client as text. If several nodes offer the same service, the master
    /// directs clients to the last node that registered.
    ///
    /// # Errors
    /// Fails if the name is not a valid ROS name, if this node already offers the service, or if
    /// the type is incomplete.
    pub fn advertise_service<H, F>(
        &self,
        service: &str,
        service_type: ServiceTypeSum,
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
        let served = Arc::new(OfferedService::new(
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

    /// Creates a client of a service, which may be offered later: the first request is sent with
    /// the first call. Fails if the name is not a valid ROS name.
    pub fn service_client(
        &self,
        service: &str,
        options: ServiceClientOptions,
    ) -> Result<ServiceClient, NodeError> {
        let service = self.inner.names.resolve(service)?;
        let master = self.inner.master.clone();
        Ok(ServiceClient::new(service, options, self.name(), master))
    }

    /// Reads the publishers, subscribers and services from the master.
    pub async fn graph(&self) -> Result<MasterGraph, MasterError> {
        self.inner.master.graph().await
    }

    /// Returns a reader of the graph for another task, which may outlive the node.
    pub fn graph_reader(&self) -> GraphReader {
        GraphReader::new(self.inner.master.clone())
    }

    /// Sets the addresses of this host that have lost their link. A connection to another host that
    /// uses one of them is cut off: what is sent over it would arrive late, as if it were new.
    ///
    /// The connection to a publisher is closed, and opened anew when the link is back. Messages for
    /// a subscriber are dropped; when the link is back and the subscriber responds, its connection
    /// is reset, so that it connects again and receives the latched messages. Topics with
    /// [`PublisherOptions::keep_cut_off`] or [`SubscriberOptions::keep_cut_off`], connections
    /// within this host and those over other interfaces go on.
    pub fn set_lost_addresses(&self, lost: &[IpAddr]) {
        let set = |state: &mut Arc<[IpAddr]>| {
            let is_changed = **state != *lost;
            *state = lost.into();
            is_changed
        };
        if self.inner.network.send_if_modified(set) {
            for hub in self.inner.publications() {
                hub.drop_cut_off();
            }
        }
    }

    /// Unregisters everything from the master and stops within two seconds. Connections to
    /// subscribers end after their queues are written, connections to clients after their requests
    /// are answered. Registrations that stay behind in an unreachable master are logged by name; a
    /// master that replies too slowly is logged as well.
    pub async fn shutdown(mut self) {
        let mut settled = self.inner.settled.subscribe();
        let mut draining = self.inner.draining.subscribe();
        self.inner.close();
        self.inner.changed.notify_one();
        // Both results are locks that must not be held during the other wait; an error is the end
        // as well.
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

/// State shared by the handles and tasks of the node.
#[derive(Debug)]
pub(crate) struct Inner {
    names: NameResolver,
    pub(crate) uri: String,
    /// Address of the node's services, which is registered with the master.
    pub(crate) service_uri: String,
    pub(crate) hostname: String,
    pub(crate) topics_port: u16,
    pub(crate) master: Master,
    links: Arc<LinkContext>,
    /// The addresses of this host without a link.
    network: watch::Sender<Arc<[IpAddr]>>,
    pub(crate) params: Params,
    clock: Ros1Clock,
    /// The subscription to `/clock` while time is simulated.
    clock_feed: Mutex<Option<Arc<TopicFeed>>>,
    registry: Mutex<Registry>,
    /// Published topics that are to be registered once more.
    renewed: Mutex<HashSet<String>>,
    /// Notifies that the registry differs from the state of the master.
    pub(crate) changed: Notify,
    pub(crate) master_state: watch::Sender<MasterState>,
    /// The reason of the master's request to shut down.
    shutdown: watch::Sender<Option<String>>,
    /// The contests for this node's name.
    name_contests: NameContests,
    /// True once everything is closed and unregistered at the master.
    pub(crate) settled: watch::Sender<bool>,
    /// Number of connections to subscribers and clients, including withdrawn topics and services.
    draining: watch::Sender<usize>,
    next_id: AtomicI32,
}

impl Inner {
    pub(crate) fn name(&self) -> &str {
        self.names.node()
    }

    pub(crate) fn next_connection_id(&self) -> i32 {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    /// Returns the reach of other hosts, for a connection.
    pub(crate) fn reach(&self) -> NetworkReach {
        self.links.reach.clone()
    }

    pub(crate) fn publication(&self, topic: &str) -> Option<Arc<PublishedTopic>> {
        lock(&self.registry).publications.get(topic).cloned()
    }

    pub(crate) fn publications(&self) -> Vec<Arc<PublishedTopic>> {
        lock(&self.registry)
            .publications
            .values()
            .cloned()
            .collect()
    }

    pub(crate) fn feeds(&self) -> Vec<Arc<TopicFeed>> {
        let registry = lock(&self.registry);
        registry
            .subscriptions
            .values()
            .flat_map(|entry| entry.feeds.iter().cloned())
            .collect()
    }

    /// Returns the full name of a parameter; `/` is the root of the tree.
    pub(crate) fn parameter_name(&self, name: &str) -> Result<String, ResourceNameError> {
        if name == "/" {
            Ok(name.to_owned())
        } else {
            self.names.resolve(name)
        }
    }

    /// Returns the name of a parameter for the upward search of the master. A remapped name is
    /// absolute.
    pub(crate) fn searched_name(&self, name: &str) -> Result<String, ResourceNameError> {
        self.names.searched(name)
    }

    /// Marks the subscriptions of a parameter or namespace for another read.
    pub(crate) fn parameter_changed(&self, name: &str) {
        self.params.touch(name);
        self.changed.notify_one();
    }

    /// Switches to simulated time, or back to the wall clock.
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
            let wanted = RequestedType {
                type_name: Some(CLOCK_TYPE.to_owned()),
                md5sum: Some(CLOCK_MD5.to_owned()),
            };
            let feed = Arc::new(TopicFeed::new(topic, wanted, Box::new(self.clock.clone())));
            if self.follow(&feed) {
                *current = Some(feed);
            }
        }
    }

    /// Registers a subscription and links it to the known publishers. Returns false if the node is
    /// closed; then the feed is closed as well.
    fn follow(&self, feed: &Arc<TopicFeed>) -> bool {
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

    pub(crate) fn withdraw_publication(&self, hub: &Arc<PublishedTopic>) {
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

    pub(crate) fn service(&self, name: &str) -> Option<Arc<OfferedService>> {
        lock(&self.registry).services.get(name).cloned()
    }

    pub(crate) fn services(&self) -> Vec<Arc<OfferedService>> {
        lock(&self.registry).services.values().cloned().collect()
    }

    pub(crate) fn withdraw_service(&self, served: &Arc<OfferedService>) {
        let mut registry = lock(&self.registry);
        let known = registry.services.get(&served.service);
        if known.is_some_and(|known| Arc::ptr_eq(known, served)) {
            registry.services.remove(&served.service);
        }
        drop(registry);
        self.changed.notify_one();
    }

    pub(crate) fn withdraw_subscription(&self, feed: &Arc<TopicFeed>) {
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

    /// Registers a published topic once more, so that the master sends its publishers to all
    /// subscribers: a subscriber of rospy does not connect again by itself.
    pub(crate) fn renew_publication(&self, topic: &str) {
        lock(&self.renewed).insert(topic.to_owned());
        self.changed.notify_one();
    }

    /// Takes the published topics that are to be registered once more.
    pub(crate) fn take_renewed(&self) -> HashSet<String> {
        std::mem::take(&mut *lock(&self.renewed))
    }

    /// Returns all registrations that the master should have.
    pub(crate) fn wanted_registrations(&self) -> Vec<Registration> {
        lock(&self.registry).wanted()
    }

    /// Returns the number of received lists of publishers of a topic.
    pub(crate) fn updates(&self, topic: &str) -> u64 {
        lock(&self.registry)
            .subscriptions
            .get(topic)
            .map_or(0, |entry| entry.updates)
    }

    /// Applies the list in the reply to a registration, unless a newer list was received in the
    /// meantime.
    pub(crate) fn registered_publishers(&self, topic: &str, publishers: &[String], seen: u64) {
        self.take_publishers(topic, publishers, |updates| updates == seen);
    }

    /// Applies a list that the master sends on its own.
    pub(crate) fn publishers_changed(&self, topic: &str, publishers: &[String]) {
        self.take_publishers(topic, publishers, |_| true);
    }

    /// Compares and links under one lock, so that an older list never replaces a newer list.
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
        // Publishers beyond the limit of connections need not be stored.
        let most = self.links.publishers_of_topic;
        entry.publishers = publishers.iter().take(most).cloned().collect();
        for feed in &entry.feeds {
            self.connect(feed, publishers);
        }
    }

    /// Links a feed to publishers other than this node itself. Called with the registry locked;
    /// this lock is taken before the lock of a feed's links.
    fn connect(&self, feed: &Arc<TopicFeed>, publishers: &[String]) {
        let own = self.uri.trim_end_matches('/');
        let others: Vec<String> = publishers
            .iter()
            .filter(|uri| uri.trim_end_matches('/') != own)
            .cloned()
            .collect();
        feed.update(&others, &self.links, || self.next_connection_id());
    }

    /// Notifies the waiters of [`Node::shutdown_requested`].
    pub(crate) fn ask_to_shut_down(&self, reason: &str) {
        self.shutdown.send_if_modified(|asked| {
            let first = asked.is_none();
            asked.get_or_insert_with(|| reason.to_owned());
            first
        });
    }

    /// Records the master's report that another node has taken this node's name. Nothing is
    /// registered until the owner of the name is known.
    pub(crate) fn name_is_contested(&self) {
        self.name_contests.begin();
        self.changed.notify_one();
    }

    /// Returns the number of the contest for the name that is open.
    pub(crate) fn contest(&self) -> Option<u64> {
        let open = self.name_contests.open();
        open.filter(|_| !self.is_asked_to_shut_down())
    }

    /// Records that the name was this node's after this number of contests.
    pub(crate) fn decided(&self, contest: u64) {
        self.name_contests.decide(contest);
    }

    /// Returns whether the name is this node's, as far as it knows.
    pub(crate) fn may_register(&self) -> bool {
        !self.is_asked_to_shut_down() && self.contest().is_none()
    }

    fn is_asked_to_shut_down(&self) -> bool {
        self.shutdown.borrow().is_some()
    }

    pub(crate) fn is_closed(&self) -> bool {
        lock(&self.registry).closed
    }

    /// Closes all topics and services permanently.
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

/// Returns the initial parameters by their full names. The last value of a name is used.
fn params(names: &NameResolver, given: Vec<(String, ParamValue)>) -> Result<Params, NodeError> {
    let mut last: Vec<(String, ParamValue)> = Vec::new();
    for (name, value) in given {
        let full = names.resolve(&format!("~{name}"))?;
        last.retain(|(other, _)| *other != full);
        last.push((full, value));
    }
    Ok(Params::new(last, names.resolve("/use_sim_time")?))
}

const SHUTDOWN_LIMIT: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests;
