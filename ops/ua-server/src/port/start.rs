//! The start of the server: certificates, address space, endpoints and announcements.

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;

use bridge_node::{Application, Failure, FailureKind};
use discovery::{AnnounceSettings, MdnsFault, ServerAnnouncement, WatchSettings, announce, watch};
use mappings::{Anonymous, Mapping, Role, Server};
use opcua::nodes::NodeType;
use opcua::server::address_space::{AddressSpace, EventNotifier};
use opcua::server::node_manager::memory::InMemoryNodeManagerImplBuilder;
use opcua::server::node_manager::{NodeManagerBuilder, ServerContext};
use opcua::server::{MonitoredItemHandle, ServerHandle, SubscriptionCache};
use opcua::types::{NodeId, NumericRange, ObjectId, VariableId};
use plant_opcua::configuration::Configuration;
use plant_opcua::endpoint::EndpointUrl;
use plant_opcua::nodeset::ImportedNodeSets;
use plant_opcua::pki::Pki;
use plant_opcua::server::{
    CoreValue, EventHistory, Facets, ServerSecurity, Supplement, capabilities, core_of, core_with,
    roles,
};
use plant_opcua::users::{self, UserAccess, UserFault};
use tokio::runtime::Runtime;
use tokio::sync::{Semaphore, mpsc};
use tracing::{info, warn};

use super::shown::largest_write;
use crate::alarms::Alarms;
use crate::asking::{QuestionReceiver, Questions};
use crate::auditing;
use crate::browse::Ordered;
use crate::components::Components;
use crate::endpoint;
use crate::history::{self, HistoryFile, StoredValue};
use crate::identity;
use crate::layout::{Layout, LayoutError};
use crate::methods::Methods;
use crate::nodes::{ClientWrite, Exits, SpaceManager, SpaceNodes, look_again};
use crate::nodesets;
use crate::pubsub::{PubSubManagers, PubSubNodes};
use crate::redundant::{self, ServerRole, ServerSet};
use crate::sks::Sks;
use crate::structures::MappedTypes;

/// Creates the Methods for the calls of other spaces.
pub(super) fn shown_calls(
    nodes: &(Arc<SpaceManager>, Arc<SubscriptionCache>),
    mapping: &Arc<Mapping>,
    (asked, layout): (QuestionReceiver, &Layout),
    pki: &Pki,
) -> Methods {
    let asked = (asked, &layout.structures[..]);
    Methods::new(nodes.clone(), mapping, asked, pki.root())
}

/// Reads the users of the server.
pub(super) fn users(pki: &Pki, is_local: bool) -> Result<Arc<UserAccess>, Failure> {
    let folder = pki.root().join(users::FOLDER);
    let access = UserAccess::new(Some(folder), is_local);
    let faulty = |error: UserFault| Failure::new(FailureKind::Configuration, error.to_string());
    access.map(Arc::new).map_err(faulty)
}

/// NodeSets to be loaded, and the record of their files.
pub(super) type Loading = (ImportedNodeSets, nodesets::RunningNodeSets);

/// Returns the nodes of the mapping and the NodeSets.
pub(super) fn laid_out(
    mapping: &Mapping,
    types: &mut MappedTypes,
) -> Result<(Arc<Layout>, Loading), Failure> {
    let configuration =
        |error: LayoutError| Failure::new(FailureKind::Configuration, error.to_string());
    let mut layout = Layout::of(mapping, types).map_err(configuration)?;
    let sets = nodesets::read(mapping)?;
    nodesets::add_namespaces(&sets, &mut layout.namespaces);
    let running = nodesets::RunningNodeSets::new(mapping, &sets);
    Ok((Arc::new(layout), (sets, running)))
}

/// Creates the certificate if it is missing, and listens.
pub(super) fn listen(
    pki: &Pki,
    url: &EndpointUrl,
    described: &Server,
) -> Result<(TcpListener, (SocketAddr, Vec<ServerSecurity>)), Failure> {
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
fn tell_open(url: &EndpointUrl, described: &Server, security: &[ServerSecurity]) {
    if security.contains(&ServerSecurity::None) {
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
pub(super) fn audit(access: &UserAccess, handle: &ServerHandle) {
    let subscriptions = Arc::clone(handle.subscriptions());
    let server = handle.info().application_uri.as_ref().to_owned();
    access.on_login(move |login| auditing::came_in(login, &server).tell(&subscriptions));
}

/// Builds the core namespace with its methods and values.
pub(super) fn core(
    (sks, pubsub, alarms): (&Arc<Sks>, &Arc<PubSubNodes>, &Arc<Alarms>),
    (configuration, is_announced): (&Arc<Configuration>, bool),
    (described, facets, set): (&Server, Facets, &ServerSet),
    access: &Arc<UserAccess>,
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
    values.extend(redundant::values(described, set));
    values.extend(capabilities(&endpoint::within(described.limits), facets));
    values.extend(roles::values(access));
    let supplement = Supplement::new(values, Some(Arc::clone(access)));
    let supplement = supplement.with_events(Arc::clone(alarms) as Arc<dyn EventHistory>);
    let is_redundant = set.own().is_some();
    core_with(methods, supplement, move |core| {
        prepared(core);
        if is_redundant {
            redundant::prepare(core);
        }
    })
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
pub(super) fn show_limits(
    mapping: &Arc<Mapping>,
    layout: &Arc<Layout>,
    (handle, manager): (&ServerHandle, &Arc<SpaceManager>),
    ((pubsub, alarms), history): ((&PubSubNodes, &Alarms), Option<OpenedHistory>),
) {
    limit(manager.inner(), mapping);
    let conditions = history.map(|(mut store, values)| {
        let conditions = store.take_conditions();
        manager.inner().live().keep_past_in((store, values));
        conditions
    });
    pubsub.stand(places(handle, manager));
    pubsub.show(mapping, layout);
    let conditions = conditions.unwrap_or_default();
    alarms.stand(Arc::clone(manager), handle, mapping, conditions);
}

/// The file of the history, and its values.
pub(super) type OpenedHistory = (HistoryFile, Vec<StoredValue>);

/// Returns the facets of the profile that a server with these policies and topics has.
pub(super) fn facets(security: &[ServerSecurity], layout: &Layout) -> Facets {
    Facets {
        is_secured: security
            .iter()
            .any(|policy| *policy != ServerSecurity::None),
        has_history: layout.topics.iter().any(|topic| topic.historizing),
        has_alarms: true,
    }
}

/// Opens the file of the history, if the mapping names a file.
pub(super) fn history(
    described: &Server,
    layout: &Layout,
) -> Result<Option<OpenedHistory>, Failure> {
    let file = described.history_file.as_ref();
    let opened = file.map(|file| HistoryFile::open(file, layout.topics.iter()));
    let opened = opened.transpose();
    opened.map_err(|fault| Failure::new(FailureKind::Io, fault.to_string()))
}

fn places(handle: &ServerHandle, manager: &Arc<SpaceManager>) -> PubSubManagers {
    PubSubManagers {
        core: core_of(handle),
        space: Arc::clone(manager),
        subscriptions: Arc::clone(handle.subscriptions()),
    }
}

/// Starts the second check of created monitored items.
pub(super) fn look_at_created(
    runtime: &Runtime,
    (manager, subscriptions): (Arc<SpaceManager>, Arc<SubscriptionCache>),
    created: mpsc::Receiver<(NodeId, MonitoredItemHandle)>,
) {
    drop(runtime.spawn(look_again(manager, subscriptions, created)));
}

pub(super) fn tell_serving(layout: &Layout, pki: &Pki, (url, port): (&EndpointUrl, u16)) {
    info!(
        topics = layout.topics.len(),
        pki = %pki.root().display(),
        "serving at {url} (port {port})"
    );
}

/// Sets the limits of written values and of past values.
fn limit(nodes: &SpaceNodes, mapping: &Mapping) {
    nodes.writes().limit(largest_write(mapping));
    nodes.live().limit_past(mapping);
}

/// Creates the channels of the node manager, with their receivers.
pub(super) fn exits(
    mapping: &Mapping,
    access: &Arc<UserAccess>,
    (pubsub, role): (&Arc<PubSubNodes>, &ServerRole),
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
pub(super) type Entries = (
    mpsc::Receiver<ClientWrite>,
    mpsc::Receiver<(NodeId, MonitoredItemHandle)>,
    QuestionReceiver,
);

/// Announces the server if the settings request it, and watches other servers if mDNS is enabled.
pub(super) fn tell(
    server: discovery::ServerDescription,
    settings: Option<AnnounceSettings>,
    nodes: (Arc<SpaceManager>, Arc<SubscriptionCache>),
) -> Result<(Option<ServerAnnouncement>, Option<Components>), Failure> {
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
pub(super) fn told_of(
    described: &Server,
    url: String,
    security: &[ServerSecurity],
) -> (discovery::ServerDescription, Application) {
    let redundancy = redundant::is_member(described).then_some("NTRS");
    let capabilities = ["DA", "HD"].into_iter().chain(redundancy);
    let server = discovery::ServerDescription {
        application_uri: described.application_uri.clone(),
        product_uri: identity::PRODUCT_URI.to_owned(),
        name: "ua-server".to_owned(),
        url,
        capabilities: capabilities.map(str::to_owned).collect(),
        number: None,
    };
    let application = application(&server, security);
    (server, application)
}

/// Returns the description of the server for the group.
fn application(server: &discovery::ServerDescription, security: &[ServerSecurity]) -> Application {
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

/// Builds the node manager of the space.
pub(super) struct NodesBuilder {
    pub(super) layout: Arc<Layout>,
    pub(super) sets: ImportedNodeSets,
    pub(super) exits: Exits,
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
pub(super) fn manager(
    handle: &ServerHandle,
    layout: &Layout,
) -> Result<Arc<SpaceManager>, Failure> {
    let failed = |message: String| Failure::new(FailureKind::Configuration, message);
    let manager = handle
        .node_managers()
        .get_of_type::<Ordered>()
        .and_then(|ordered| ordered.space())
        .ok_or_else(|| failed("the server has no node manager for the space".to_owned()))?;
    if let Some(fault) = manager.inner().nodesets().fault() {
        return Err(failed(fault.to_owned()));
    }
    let wanted = layout.namespaces.iter().skip(1);
    for ((index, uri), (expected, wanted)) in manager
        .inner()
        .served_namespaces()
        .zip((1u16..).zip(wanted))
    {
        if index != expected || uri != wanted {
            return Err(failed(format!(
                "namespace {wanted} is to have index {expected}, but in this server it has {index}"
            )));
        }
    }
    Ok(manager)
}

/// Largest number of written values that wait for the run loop. Further writes are refused.
const MOST_WRITES: usize = 1_024;
/// Size limit of all waiting writes, in KiB.
const ROOM_FOR_WRITES: usize = 128 << 10;
/// Largest number of monitored items that wait for their second check.
const MOST_CREATED: usize = 10_000;
