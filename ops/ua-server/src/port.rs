//! The server as the local side of the bridge shell.

use std::collections::VecDeque;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::{
    Answered, Application, Arrival, AskId, CallDescription, Delivery, Described, Execution,
    ExecutionId, Failure, FailureKind, Kept, LinkState, Port, PortEvent, Rank, Reason, Router,
    TypePaths,
};
use bytes::Bytes;
use discovery::{AnnounceSettings, Announced, MdnsFault, WatchSettings, announce, watch};
use mappings::{Anonymous, Mapping, Role, Server, SpaceId, TopicId};
use opcua::nodes::NodeType;
use opcua::server::address_space::{AddressSpace, EventNotifier};
use opcua::server::authenticator::AuthManager;
use opcua::server::node_manager::memory::InMemoryNodeManagerImplBuilder;
use opcua::server::node_manager::{NodeManagerBuilder, ServerContext};
use opcua::server::{MonitoredItemHandle, ServerHandle, SubscriptionCache};
use opcua::types::{NodeId, NumericRange, ObjectId, StatusCode, VariableId};
use plant_opcua::configuration::Configuration;
use plant_opcua::endpoint::EndpointUrl;
use plant_opcua::enrolment::Invitation;
use plant_opcua::nodeset::NodeSets;
use plant_opcua::own;
use plant_opcua::pki::Pki;
use plant_opcua::server::{
    CoreValue, EventHistory, Facets, Security, Supplement, capabilities, core_of, core_with, roles,
};
use plant_opcua::users::{self, Access, UserFault};
use tokio::runtime::Runtime;
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinHandle;
use tokio::time::{Interval, MissedTickBehavior};
use tracing::{info, warn};
use uadp::BuiltinType;

use crate::access;
use crate::alarms::Alarms;
use crate::asking::{Heard, Questions};
use crate::auditing;
use crate::browse::Ordered;
use crate::commanders::Commanders;
use crate::components::{Components, Happened};
use crate::confirm::Confirms;
use crate::endpoint;
use crate::history::{self, Store, Stored};
use crate::layout::{Layout, LayoutError};
use crate::leaving::Leaving;
use crate::methods::{Methods, Wish};
use crate::nodes::{ClientWrite, Exits, SpaceManager, SpaceNodes, look_again};
use crate::nodesets;
use crate::operations::PageOperations;
use crate::others::Others;
use crate::pubsub::{Places, PubSub, Readers, State};
use crate::redundant::{self, Condition, ServerRole, ranked};
use crate::sks::Sks;
use crate::sources::{self, Sourced};
use crate::space::Space;
use crate::structures::Types;

/// The arguments of [`ServerPort::start`] in addition to the mapping.
pub(crate) struct Setup {
    pub(crate) url: EndpointUrl,
    pub(crate) pki: Pki,
    /// The key service of the groups for which this server creates the keys.
    pub(crate) sks: Arc<Sks>,
    pub(crate) trust_any_client: bool,
    pub(crate) types: Types,
    /// True if the endpoint comes from the mapping, false if it comes from the command line.
    pub(crate) mapped_url: bool,
    /// The rank of the server among redundant servers.
    pub(crate) rank: Option<Rank>,
    /// Settings for announcing the server.
    pub(crate) announce: Option<AnnounceSettings>,
    /// The Global Discovery Server that renews the certificate.
    pub(crate) gds: Option<Invitation>,
}

/// The OPC UA side of the space.
pub(crate) struct ServerPort {
    space: Space,
    handle: ServerHandle,
    /// The server's own threads, because signing for a client takes longer than a value should
    /// wait. Taken at shutdown.
    runtime: Option<Runtime>,
    serving: Option<JoinHandle<Result<(), String>>>,
    writes: mpsc::Receiver<ClientWrite>,
    /// Topics that clients can write, with a start or end of production that is not reported yet.
    live: VecDeque<(TopicId, bool)>,
    /// Topics that were removed or replaced.
    unbound: VecDeque<TopicId>,
    /// The namespaces at the start of the server.
    namespaces: Vec<String>,
    nodesets: nodesets::Running,
    described: Server,
    mapped_url: bool,
    types: Types,
    pki: Pki,
    sks: Arc<Sks>,
    access: Arc<Access>,
    look: Interval,
    /// Announces the server. Taken at shutdown.
    told: Option<Announced>,
    components: Option<Components>,
    /// Calls of other spaces.
    methods: Methods,
    /// Other servers.
    others: Others,
    /// Events that are reported before all others.
    events: VecDeque<PortEvent>,
    /// The PubSub configuration, and the state of its readers.
    pubsub: Arc<PubSub>,
    readers: Readers,
    rank: Option<Rank>,
    role: ServerRole,
    /// Writes that wait for a confirmation.
    confirms: Arc<Confirms>,
    /// The conditions of values, robots and publishers.
    alarms: Arc<Alarms>,
    /// The sessions that wrote commands. Their topics are stopped when the session is lost.
    commanders: Commanders,
    /// The written values that are not sent yet.
    leaving: Leaving,
    /// Time without messages after which a publisher counts as offline.
    receive_timeout: Duration,
    /// The application as it is described to the group.
    application: Application,
    /// The certificates of the server, which clients can manage.
    certificates: Arc<Configuration>,
}

impl ServerPort {
    /// Builds the address space of `mapping` and listens.
    ///
    /// # Errors
    /// Returns an error if the mapping cannot be served, if the address cannot be bound, or if the
    /// certificate store cannot be used.
    #[expect(
        clippy::too_many_lines,
        reason = "the parts of the server, in the order of their start"
    )]
    pub(crate) fn start(mapping: &Arc<Mapping>, mut setup: Setup) -> Result<Self, Failure> {
        let configuration = |error: String| Failure::new(FailureKind::Configuration, error);
        let role = ServerRole::new(setup.rank);
        let mapping = &ranked(mapping, setup.rank);
        let (layout, (sets, nodesets)) = laid_out(mapping, &mut setup.types)?;
        let described = mapping.server();
        setup.sks.follow(mapping)?;
        let (listener, (address, security)) = listen(&setup.pki, &setup.url, described)?;
        let port = address.port();
        let access = users(&setup.pki, endpoint::is_local(described, address))?;
        access.set_rules(access::rules(mapping, &layout));
        let pubsub = Arc::new(PubSub::new());
        let (exits, (writes, created_items, asked)) = exits(mapping, &access, (&pubsub, &role));
        let (confirms, alarms) = (Arc::clone(&exits.confirms), Arc::clone(&exits.alarms));
        let nodes = NodesBuilder {
            layout: Arc::clone(&layout),
            sets,
            exits,
        };
        let certificates = Configuration::new(setup.pki.root(), &described.application_uri);
        let mdns = matches!(&setup.announce, Some(to) if to.mdns.is_some());
        let shown = (&setup.sks, &pubsub, &alarms);
        let facets = facets(&security, &layout);
        let described_core = (described, facets, setup.rank);
        let core = core(shown, (&certificates, mdns), described_core, &access);
        let builder = endpoint::server(described, (&setup.url, port), &security);
        let (trusts_any, limits) = (setup.trust_any_client, endpoint::clients(described.limits));
        let built = (listener, builder);
        let (door, listener, builder) = endpoint::door(&setup.pki, trusts_any, limits, built)?;
        let (server, handle) = builder
            .with_authenticator(Arc::clone(&access) as Arc<dyn AuthManager>)
            .with_node_manager(core)
            .with_node_manager(Ordered::around(nodes, &access))
            .build()
            .map_err(configuration)?;
        let manager = manager(&handle, &layout).map_err(configuration)?;
        let shown = ((&*pubsub, &*alarms), history(described, &layout)?);
        show_limits(mapping, &layout, (&handle, &manager), shown);
        let (runtime, listener) = endpoint::threads(listener)?;
        let serving = runtime.spawn(server.run_with(listener));
        let clients = (&handle, setup.url.advertised(port));
        endpoint::reverse_connect(described, clients, (&runtime, door.is_some()))?;
        endpoint::stand(&runtime, door)?;
        let subscriptions = Arc::clone(handle.subscriptions());
        audit(&access, &handle);
        let nodes = (Arc::clone(&manager), Arc::clone(&subscriptions));
        look_at_created(&runtime, nodes.clone(), created_items);
        tell_serving(&layout, &setup.pki, (&setup.url, port));
        let others = Others::new(
            mapping,
            setup.announce.as_ref(),
            (setup.pki.root(), &alarms),
        );
        let methods = shown_calls(&nodes, mapping, (asked, &layout), &setup.pki);
        let (server, application) = told_of(described, setup.url.advertised(port), &security);
        let own = server.applicant(setup.url.urls(port));
        endpoint::enrol(&runtime, (own, setup.gds), (&setup.pki, &certificates));
        let (told, components) = tell(server, setup.announce, nodes)?;
        Ok(Self {
            unbound: VecDeque::new(),
            namespaces: layout.namespaces.clone(),
            nodesets,
            described: described.clone(),
            mapped_url: setup.mapped_url,
            space: Space::new(&layout, manager, subscriptions).with_ages(mapping),
            handle,
            runtime: Some(runtime),
            serving: Some(serving),
            writes,
            live: live(&layout),
            types: setup.types,
            pki: setup.pki,
            sks: setup.sks,
            access,
            look: looks(),
            told,
            components,
            methods,
            others,
            events: VecDeque::new(),
            pubsub,
            readers: Readers::default(),
            rank: setup.rank,
            role,
            confirms,
            alarms,
            commanders: Commanders::new(mapping),
            leaving: Leaving::default(),
            receive_timeout: mapping.pubsub().receive_timeout,
            application,
            certificates,
        })
    }
}

impl ServerPort {
    /// Returns the users and commands of the server for its page.
    pub(crate) fn operations(&self) -> PageOperations {
        let subscriptions = Arc::clone(self.handle.subscriptions());
        let nodes = (Arc::clone(self.space.manager()), subscriptions);
        let alarms = (
            Arc::clone(&self.alarms),
            self.described.application_uri.as_str(),
        );
        PageOperations::new(Arc::clone(&self.access), nodes, alarms)
    }

    /// Sets the ServiceLevel, for servers with redundancy.
    fn show_service_level(&mut self) {
        if self.rank.is_none() {
            return;
        }
        let (topics, silent) = self.readers.silence();
        let condition = Condition {
            is_standby: self.role.is_standby(),
            topics,
            silent,
        };
        self.handle.set_service_level(condition.service_level());
    }

    /// Applies changes of writers and readers that clients enabled or disabled.
    fn switch(&mut self) {
        for (topic, on) in self.pubsub.switched() {
            if topic.space == SpaceId::UA {
                self.live.push_back((topic, on));
            } else {
                // Values of a disabled reader are not updated.
                let silent = !on || self.readers.of(topic) == State::Error;
                self.space.set_silent(topic, silent);
            }
        }
    }
}

impl Port for ServerPort {
    async fn recv(&mut self) -> PortEvent {
        self.space.settle();
        if let Some(topic) = self.unbound.pop_front() {
            return PortEvent::Unbound { topic };
        }
        if let Some(event) = self.events.pop_front() {
            return event;
        }
        loop {
            if let Some((topic, live)) = self.live.pop_front() {
                return PortEvent::Live { topic, live };
            }
            tokio::select! {
                () = tokio::task::yield_now(), if self.leaving.polls() => {}
                Some(write) = self.writes.recv() => {
                    let ClientWrite { topic, block, source, commander, room, departure, answer, awaited } = write;
                    if self.role.is_standby() {
                        // The role has changed since the client wrote.
                        departure.refuse();
                        let (reason, why) = (Reason::Takeover, "standby");
                        return PortEvent::Lost { topic: Some(topic), reason, why, count: 1 };
                    }
                    self.commanders.wrote(topic, commander);
                    drop(room);
                    self.leaving.add(topic, departure);
                    self.confirms.supersede(topic);
                    self.confirms.arrivals.sent(topic, awaited);
                    self.others.sources.write(topic, &block, answer);
                    return PortEvent::Sample { topic, payload: block, received: source, latched_by: None };
                }
                ended = ended(&mut self.serving) => return PortEvent::Ended(ended),
                wish = self.methods.next() => return match wish {
                    Wish::Ask { ask, topic, request, timeout } => {
                        PortEvent::Ask { ask, topic, request, timeout }
                    }
                    Wish::GiveUp(ask) => PortEvent::AskGivenUp { ask },
                },
                event = self.others.executing.next() => return event,
                event = self.others.skills.next() => return event,
                sourced = self.others.sources.next() => return self.sourced(sourced),
                () = self.pubsub.called() => self.switch(),
                happened = next(&mut self.components) => match happened {
                    Happened::Told(event) => return event,
                    Happened::Heard(found) => self.others.heard(&found),
                },
                () = self.others.finding.changed() => self.others.found(),
                lost = self.commanders.lost() => {
                    // The bridges publish `on_loss` when the writer goes silent.
                    self.live.extend(lost.into_iter().map(|topic| (topic, false)));
                }
                () = self.confirms.called() => {
                    let taken_back = self.confirms.take_back().into_iter();
                    self.live.extend(taken_back.map(|topic| (topic, false)));
                }
                () = at(self.space.due()) => self.space.grow_old(),
                () = self.alarms.elapsed() => if let Some(event) = self.report_conditions() {
                    return event;
                },
                () = self.certificates.applied() => bridge_node::restart(),
                _ = self.look.tick() => {
                    self.pki.report_rejected();
                    self.access.look();
                }
            }
        }
    }

    fn publish(&mut self, sample: Delivery) -> Result<(), &'static str> {
        if self.space.is_mapped(sample.topic) {
            self.readers.heard(sample.topic);
        }
        if self.pubsub.is_off(sample.topic) {
            self.readers.ignored(sample.topic);
            return Err("its reader is disabled");
        }
        if sample.kept == Kept::Again {
            // A variable shows a single value, the last.
            return Ok(());
        }
        // If several values are kept for late joiners, an older value may arrive after the last
        // value.
        if sample.kept == Kept::Beside && sample.source < self.space.shown(sample.topic) {
            return Ok(());
        }
        if sample.status & BAD == 0 {
            if !self.role.is_standby() {
                // The active server writes to other servers.
                self.others.sources.put(sample.topic, &sample.payload);
            }
            self.methods.reported(sample.topic, &sample.payload);
        }
        let shown = self
            .space
            .update(sample.topic, sample.payload, (sample.source, sample.status));
        self.unbound.extend(self.space.take_gave_way());
        shown
    }

    fn wanted(
        &mut self,
        _topic: TopicId,
        _shape: &[(BuiltinType, bool)],
        _described: Option<&Described>,
    ) {
        // Values of every type have a node.
    }

    fn left(&mut self, topic: TopicId, sent: Result<(), Reason>) {
        self.leaving.left(topic, sent);
    }

    fn drained(&mut self, is_muted: bool) {
        self.leaving.drained(is_muted);
    }

    fn settled(&mut self, topic: TopicId, arrival: &Arrival) {
        self.space
            .show_arrival(topic, matches!(arrival, Arrival::Confirmed));
        self.confirms.arrivals.settled(topic, arrival);
    }

    fn silent(&mut self, topic: TopicId, silent: bool) {
        if self.space.is_mapped(topic) {
            self.readers.silent(topic, silent);
        }
        if silent {
            self.others.sources.set_silent(topic);
        }
        self.space
            .set_silent(topic, silent || self.pubsub.is_off(topic));
    }

    fn counted(&mut self, router: &Router) {
        self.pubsub.look(&self.readers, router);
        self.space.hear(router.heard(), self.receive_timeout);
        self.alarms.publishers(router, self.receive_timeout);
        self.show_service_level();
    }

    fn drop_waiting(&mut self, _at_once: bool) {
        // The values of the space are only shown. Values for other servers are commands.
        self.others.sources.drop_waiting();
    }

    fn role_changed(&mut self, is_active: bool) {
        self.role.set_active(is_active);
        self.show_service_level();
    }

    fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.others.skills.others(topic, &description.name);
        self.methods.known(topic, description);
    }

    fn call_gone(&mut self, topic: TopicId) {
        self.methods.gone(topic);
    }

    fn answered(&mut self, ask: AskId, _topic: TopicId, answer: Answered<Bytes>) {
        self.methods.answered(ask, answer);
    }

    fn execute(&mut self, execution: Execution) -> bool {
        match self.others.skills.serves(execution.topic) {
            true => self.others.skills.execute(execution),
            false => self.others.executing.execute(&execution),
        }
    }

    fn abandoned(&mut self, execution: ExecutionId, _topic: TopicId) {
        // A Method that was called continues.
        self.others.skills.abandoned(execution);
    }

    fn reload(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) -> Vec<String> {
        let mapping = &ranked(mapping, self.rank);
        let (was, is) = (&self.described, mapping.server());
        let endpoint = self.mapped_url && was.endpoint != is.endpoint;
        let mut restart: Vec<String> = [
            ("server.endpoint", endpoint),
            (
                "server.application_uri",
                was.application_uri != is.application_uri,
            ),
            ("server.redundant", was.redundant != is.redundant),
            ("server.security", was.security != is.security),
            ("server.limits", was.limits != is.limits),
            (
                "server.reverse_connect",
                was.reverse_connect != is.reverse_connect,
            ),
            ("server.history.file", was.history_file != is.history_file),
        ]
        .into_iter()
        .filter(|(_, differs)| *differs)
        .map(|(key, _)| key.to_owned())
        .chain(self.nodesets.differs(mapping))
        .collect();
        self.receive_timeout = mapping.pubsub().receive_timeout;
        self.confirms.follow(mapping);
        self.commanders.follow(mapping);
        self.space.limit_writes(largest_write(mapping));
        self.space.limit_past(mapping);
        self.types.replace(types);
        let moved = self.methods.take_moved(mapping);
        match Layout::within(&self.namespaces, mapping, &mut self.types) {
            Ok((layout, namespaces)) => {
                let layout = Arc::new(layout);
                restart.extend(namespaces);
                self.access.set_rules(access::rules(mapping, &layout));
                let (gone, new) = self.space.exchange(&layout);
                self.space.set_ages(mapping);
                self.live.retain(|(topic, _)| !gone.contains(topic));
                self.readers.forget(&gone);
                self.unbound.extend(gone);
                self.live
                    .extend(written(new.into_iter()).map(|topic| (topic, true)));
                self.pubsub.show(mapping, &layout);
                self.alarms.reload(mapping);
                // Disabled readers and writers stay disabled.
                self.switch();
            }
            Err(error) => restart.push(format!("variables ({error})")),
        }
        if let Err(failure) = self.sks.follow(mapping) {
            restart.push(format!("security ({failure})"));
        }
        self.methods.put(moved, self.space.structures());
        for topic in self.others.reload(mapping) {
            let waiting = StatusCode::BadWaitingForInitialData;
            let block = Bytes::from(sources::no_value(waiting));
            // The block has no large value, so there is enough memory.
            let _shown = self.space.update(topic, block, (None, status(waiting)));
        }
        restart
    }

    fn pending(&self) -> Vec<String> {
        self.methods.pending()
    }

    fn links(&self) -> Vec<LinkState> {
        self.others.links()
    }

    fn certificate(&self) -> Option<serde_json::Value> {
        own::status(self.pki.root())
    }

    fn application(&self) -> Option<Application> {
        Some(self.application.clone())
    }

    async fn shutdown(mut self) {
        self.methods.end();
        if let Some(told) = self.told.take() {
            // If the time is over, other applications detect the loss themselves.
            let _late = tokio::time::timeout(GOODBYE, told.leave()).await;
        }
        self.handle.cancel();
        if let Some(serving) = &mut self.serving
            && tokio::time::timeout(SHUTDOWN, serving).await.is_err()
        {
            warn!("dropped the connections that clients did not close in time");
        }
        self.space.manager().inner().close_past();
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl ServerPort {
    /// Shows and sends the values that report the conditions, if they are due. Returns the first
    /// event.
    fn report_conditions(&mut self) -> Option<PortEvent> {
        for (topic, block) in self.alarms.elapse() {
            let taken = bridge_node::now().utc;
            let status = StatusCode::Good;
            let event = self.sourced(Sourced {
                topic,
                block,
                taken,
                status,
            });
            self.events.push_back(event);
        }
        self.events.pop_front()
    }

    /// Shows a value of another server and sends it.
    fn sourced(&mut self, sourced: Sourced) -> PortEvent {
        let Sourced {
            topic,
            block,
            taken,
            status: quality,
        } = sourced;
        let said = status(quality);
        if !quality.is_bad() && !self.role.is_standby() {
            self.others.sources.put(topic, &block);
        }
        let shown = self.space.update(topic, block.clone(), (Some(taken), said));
        let Err(why) = shown else {
            let payload = block;
            return PortEvent::Qualified {
                topic,
                payload,
                taken,
                status: said,
            };
        };
        // The group receives the status that the node shows instead of the value.
        let refused = self.space.status(topic);
        self.events.push_back(PortEvent::Lost {
            topic: Some(topic),
            reason: Reason::NotPublished,
            why,
            count: 1,
        });
        PortEvent::Qualified {
            topic,
            payload: Bytes::from(sources::no_value(refused)),
            taken,
            status: status(refused),
        }
    }
}

/// Returns the upper half of a StatusCode.
fn status(code: StatusCode) -> u16 {
    u16::try_from(code.bits() >> 16).unwrap_or(u16::MAX)
}

impl Drop for ServerPort {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // A runtime must not be waited for inside another runtime.
            runtime.shutdown_background();
        }
    }
}

/// Creates the Methods for the calls of other spaces.
fn shown_calls(
    nodes: &(Arc<SpaceManager>, Arc<SubscriptionCache>),
    mapping: &Arc<Mapping>,
    (asked, layout): (Heard, &Layout),
    pki: &Pki,
) -> Methods {
    let asked = (asked, &layout.structures[..]);
    Methods::new(nodes.clone(), mapping, asked, pki.root())
}

/// Reads the users of the server.
fn users(pki: &Pki, is_local: bool) -> Result<Arc<Access>, Failure> {
    let folder = pki.root().join(users::FOLDER);
    let access = Access::new(Some(folder), is_local);
    let faulty = |error: UserFault| Failure::new(FailureKind::Configuration, error.to_string());
    access.map(Arc::new).map_err(faulty)
}

/// NodeSets to be loaded, and the record of their files.
type Loading = (NodeSets, nodesets::Running);

/// Returns the nodes of the mapping and the NodeSets.
fn laid_out(mapping: &Mapping, types: &mut Types) -> Result<(Arc<Layout>, Loading), Failure> {
    let configuration =
        |error: LayoutError| Failure::new(FailureKind::Configuration, error.to_string());
    let mut layout = Layout::of(mapping, types).map_err(configuration)?;
    let sets = nodesets::read(mapping)?;
    nodesets::add_namespaces(&sets, &mut layout.namespaces);
    let running = nodesets::Running::new(mapping, &sets);
    Ok((Arc::new(layout), (sets, running)))
}

/// Creates the certificate if it is missing, and listens.
fn listen(
    pki: &Pki,
    url: &EndpointUrl,
    described: &Server,
) -> Result<(TcpListener, (SocketAddr, Vec<Security>)), Failure> {
    let io = |error: String| Failure::new(FailureKind::Io, error);
    pki.ensure_own_at(&described.application_uri, &url.hosts())
        .map_err(|error| io(error.to_string()))?;
    let listener = url
        .bind()
        .map_err(|error| Failure::new(FailureKind::Unavailable, format!("{error} (--endpoint)")))?;
    let address = listener.local_addr();
    let address = address.map_err(|error| io(error.to_string()))?;
    let security = endpoint::security(described, address);
    if !endpoint::is_local(described, address) {
        tell_open(url, described, &security);
    }
    Ok((listener, (address, security)))
}

/// Warns about the access that a server grants to other hosts. Requests that the server sends to
/// other programs come from its own address.
fn tell_open(url: &EndpointUrl, described: &Server, security: &[Security]) {
    if security.contains(&Security::None) {
        warn!(
            "messages of {url} can be read and changed on the network: remove None from server.security"
        );
    }
    match described.anonymous {
        Anonymous::Has(Role::Operator | Role::Engineer) => warn!(
            "anonymous clients of {url} can write values and call all calls that programs of this host execute: restrict server.anonymous to observer"
        ),
        Anonymous::Usual
        | Anonymous::Refused
        | Anonymous::Has(Role::Observer | Role::SecurityAdmin) => {}
    }
}

/// Reports logins to the audit.
fn audit(access: &Access, handle: &ServerHandle) {
    let subscriptions = Arc::clone(handle.subscriptions());
    let server = handle.info().application_uri.as_ref().to_owned();
    access.on_login(move |login| auditing::came_in(login, &server).tell(&subscriptions));
}

/// Builds the core namespace with its methods and values.
fn core(
    (sks, pubsub, alarms): (&Arc<Sks>, &Arc<PubSub>, &Arc<Alarms>),
    (configuration, is_announced): (&Arc<Configuration>, bool),
    (described, facets, rank): (&Server, Facets, Option<Rank>),
    access: &Arc<Access>,
) -> impl NodeManagerBuilder + use<> {
    let methods = [
        sks.methods(),
        pubsub.methods(),
        alarms.methods(),
        configuration.methods(),
    ];
    let methods = methods.concat();
    let values = [
        history::capabilities(),
        crate::pubsub::capabilities(),
        Configuration::values(is_announced),
    ]
    .concat();
    let values = values.into_iter();
    let mut values: Vec<(VariableId, CoreValue)> =
        values.map(|(id, value)| (id, value.into())).collect();
    values.extend(redundant::values(described, rank));
    values.extend(capabilities(&endpoint::within(described.limits), facets));
    values.extend(roles::values(access));
    let supplement = Supplement::new(values, Some(Arc::clone(access)));
    let supplement = supplement.with_events(Arc::clone(alarms) as Arc<dyn EventHistory>);
    core_with(methods, supplement, prepared)
}

/// Lists the aggregates and the roles, and sets the Auditing variable and the EventNotifier of the
/// server.
fn prepared(core: &mut AddressSpace) {
    history::list_aggregates(core);
    roles::prepare(core);
    let auditing: NodeId = VariableId::Server_Auditing.into();
    if let Some(NodeType::Variable(variable)) = core.find_mut(&auditing) {
        // A constant of the node set takes every value.
        let _is_good = variable.set_value(&NumericRange::None, true);
    }
    let server: NodeId = ObjectId::Server.into();
    if let Some(NodeType::Object(server)) = core.find_mut(&server) {
        let notifier = EventNotifier::SUBSCRIBE_TO_EVENTS | EventNotifier::HISTORY_READ;
        server.set_event_notifier(notifier);
    }
}

/// Sets the limits of the node manager, restores the history, and shows the PubSub configuration
/// and the conditions in the address space.
fn show_limits(
    mapping: &Arc<Mapping>,
    layout: &Arc<Layout>,
    (handle, manager): (&ServerHandle, &Arc<SpaceManager>),
    ((pubsub, alarms), history): ((&PubSub, &Alarms), Option<OpenedHistory>),
) {
    limit(manager.inner(), mapping);
    let conditions = history.map(|(mut store, values)| {
        let conditions = store.take_conditions();
        manager.inner().keep_past_in((store, values));
        conditions
    });
    pubsub.stand(places(handle, manager));
    pubsub.show(mapping, layout);
    let conditions = conditions.unwrap_or_default();
    alarms.stand(Arc::clone(manager), handle, mapping, conditions);
}

/// The file of the history, and its values.
type OpenedHistory = (Store, Vec<Stored>);

/// Returns the facets of the profile that a server with these policies and topics has.
fn facets(security: &[Security], layout: &Layout) -> Facets {
    Facets {
        is_secured: security.iter().any(|policy| *policy != Security::None),
        has_history: layout.topics.iter().any(|topic| topic.historizing),
        has_alarms: true,
    }
}

/// Opens the file of the history, if the mapping names a file.
fn history(described: &Server, layout: &Layout) -> Result<Option<OpenedHistory>, Failure> {
    let file = described.history_file.as_ref();
    let opened = file.map(|file| Store::open(file, layout.topics.iter()));
    let opened = opened.transpose();
    opened.map_err(|fault| Failure::new(FailureKind::Io, fault.to_string()))
}

fn places(handle: &ServerHandle, manager: &Arc<SpaceManager>) -> Places {
    Places {
        core: core_of(handle),
        space: Arc::clone(manager),
        subscriptions: Arc::clone(handle.subscriptions()),
    }
}

/// Starts the second check of created monitored items.
fn look_at_created(
    runtime: &Runtime,
    (manager, subscriptions): (Arc<SpaceManager>, Arc<SubscriptionCache>),
    created: mpsc::Receiver<(NodeId, MonitoredItemHandle)>,
) {
    drop(runtime.spawn(look_again(manager, subscriptions, created)));
}

fn tell_serving(layout: &Layout, pki: &Pki, (url, port): (&EndpointUrl, u16)) {
    info!(
        topics = layout.topics.len(),
        pki = %pki.root().display(),
        "serving at {url} (port {port})"
    );
}

/// Returns the interval of checking refused certificates and the users.
fn looks() -> Interval {
    let mut look = tokio::time::interval(LOOK_AT_REJECTED);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    look
}

/// Sets the limits of written values and of past values.
fn limit(nodes: &SpaceNodes, mapping: &Mapping) {
    nodes.limit_writes(largest_write(mapping));
    nodes.limit_past(mapping);
}

/// Returns the topics that are written here, in their initial state.
fn live(layout: &Layout) -> VecDeque<(TopicId, bool)> {
    let topics = written(layout.topics.iter().map(|node| node.topic));
    topics.map(|topic| (topic, true)).collect()
}

/// Creates the channels of the node manager, with their receivers.
fn exits(
    mapping: &Mapping,
    access: &Arc<Access>,
    (pubsub, role): (&Arc<PubSub>, &ServerRole),
) -> (Exits, Entries) {
    let (writes, written) = mpsc::channel(MOST_WRITES);
    let (created, created_items) = mpsc::channel(MOST_CREATED);
    let (questions, heard) = Questions::channel();
    let exits = Exits {
        writes,
        room: Arc::new(Semaphore::new(ROOM_FOR_WRITES)),
        created,
        questions,
        access: Arc::clone(access),
        pubsub: Arc::clone(pubsub),
        confirms: Arc::default(),
        role: role.clone(),
        alarms: Arc::default(),
    };
    exits.confirms.follow(mapping);
    (exits, (written, created_items, heard))
}

/// The receivers of written values, of created monitored items, and of client calls.
type Entries = (
    mpsc::Receiver<ClientWrite>,
    mpsc::Receiver<(NodeId, MonitoredItemHandle)>,
    Heard,
);

/// Waits until a time; pends without a time.
async fn at(time: Option<Instant>) {
    match time {
        Some(time) => tokio::time::sleep_until(time.into()).await,
        None => std::future::pending().await,
    }
}

/// Waits for the next event of the servers in the network.
async fn next(components: &mut Option<Components>) -> Happened {
    match components {
        Some(components) => components.next().await,
        None => std::future::pending().await,
    }
}

/// Announces the server if the settings request it, and watches other servers if mDNS is enabled.
fn tell(
    server: discovery::Server,
    settings: Option<AnnounceSettings>,
    nodes: (Arc<SpaceManager>, Arc<SubscriptionCache>),
) -> Result<(Option<Announced>, Option<Components>), Failure> {
    let unavailable = |error: MdnsFault| Failure::new(FailureKind::Unavailable, error.to_string());
    let Some(settings) = settings else {
        return Ok((None, None));
    };
    let own_uri = server.application_uri.clone();
    let components = match &settings.mdns {
        None => None,
        Some(interface) => {
            let watcher = watch(WatchSettings {
                mdns: Some(interface.clone()),
                ..WatchSettings::default()
            });
            let watcher = watcher.map_err(unavailable)?;
            Some(Components::new((watcher, interface), nodes, own_uri))
        }
    };
    let told = announce(server, settings).map_err(unavailable)?;
    Ok((Some(told), components))
}

/// Returns the description of the server for discovery and for the group.
fn told_of(
    described: &Server,
    url: String,
    security: &[Security],
) -> (discovery::Server, Application) {
    let server = discovery::Server {
        application_uri: described.application_uri.clone(),
        product_uri: endpoint::PRODUCT_URI.to_owned(),
        name: "ua-server".to_owned(),
        url,
        capabilities: ["DA", "HD"].map(str::to_owned).to_vec(),
        number: None,
    };
    let application = application(&server, security);
    (server, application)
}

/// Returns the description of the server for the group.
fn application(server: &discovery::Server, security: &[Security]) -> Application {
    let ways = security.iter().flat_map(|security| security.ways());
    Application {
        uri: server.application_uri.clone(),
        product_uri: server.product_uri.clone(),
        name: server.name.clone(),
        urls: vec![server.url.clone()],
        capabilities: server.capabilities.clone(),
        ..Application::default()
    }
    .talked_to(ways)
}

/// Returns the largest size of the fields in a DataSetMessage, without its header, in bytes.
fn largest_write(mapping: &Mapping) -> usize {
    let message = usize::try_from(mapping.pubsub().max_message).unwrap_or(usize::MAX);
    message.saturating_sub(MESSAGE_HEADER)
}

/// Returns the topics that clients can write.
fn written(topics: impl Iterator<Item = TopicId>) -> impl Iterator<Item = TopicId> {
    topics.filter(|topic| topic.space == SpaceId::UA)
}

/// Waits until the server has ended by itself; ready once.
async fn ended(serving: &mut Option<JoinHandle<Result<(), String>>>) -> String {
    let Some(running) = serving else {
        return std::future::pending().await;
    };
    let result = running.await;
    *serving = None;
    match result {
        Ok(Ok(())) => "the OPC UA server has ended".to_owned(),
        Ok(Err(error)) => format!("the OPC UA server has ended: {error}"),
        Err(error) => format!("the OPC UA server has ended: {error}"),
    }
}

struct NodesBuilder {
    layout: Arc<Layout>,
    sets: NodeSets,
    exits: Exits,
}

impl InMemoryNodeManagerImplBuilder for NodesBuilder {
    type Impl = SpaceNodes;

    fn build(self, context: ServerContext, address_space: &mut AddressSpace) -> SpaceNodes {
        let described = (&*self.layout, &self.sets);
        SpaceNodes::build(described, self.exits, &context, address_space)
    }
}

/// Returns the node manager of the space. The server assigns the namespace indexes itself, so they
/// are compared with the mapping.
fn manager(handle: &ServerHandle, layout: &Layout) -> Result<Arc<SpaceManager>, String> {
    let manager = handle
        .node_managers()
        .get_of_type::<Ordered>()
        .and_then(|ordered| ordered.space())
        .ok_or_else(|| "the server has no node manager for the space".to_owned())?;
    if let Some(fault) = manager.inner().nodesets().fault() {
        return Err(fault.to_owned());
    }
    let wanted = layout.namespaces.iter().skip(1);
    for ((index, uri), (expected, wanted)) in manager
        .inner()
        .served_namespaces()
        .zip((1u16..).zip(wanted))
    {
        if index != expected || uri != wanted {
            return Err(format!(
                "namespace {wanted} is to have index {expected}, but in this server it has {index}"
            ));
        }
    }
    Ok(manager)
}

/// The Bad severity in the upper half of a StatusCode.
const BAD: u16 = 0x8000;
/// Largest number of written values that wait for the run loop. Further writes are refused.
const MOST_WRITES: usize = 1_024;
/// Size limit of all waiting writes, in KiB.
const ROOM_FOR_WRITES: usize = 128 << 10;
/// Largest size of a DataSetMessage without its fields, in bytes.
const MESSAGE_HEADER: usize = 64;
/// Largest number of monitored items that wait for their second check.
const MOST_CREATED: usize = 10_000;
const LOOK_AT_REJECTED: Duration = Duration::from_secs(1);
/// Within the limit of 2 s for the shutdown of a port.
const SHUTDOWN: Duration = Duration::from_millis(1_500);
/// Part of [`SHUTDOWN`] for the mDNS goodbye.
const GOODBYE: Duration = Duration::from_millis(400);
