//! The server as the local side of the bridge shell.
//!
//! The port wires types that own their state: the running server with its users and certificates
//! ([`RunningServer`]), the values that clients write ([`ClientWrites`]), the values that the
//! address space shows ([`ShownValues`]), the Methods for calls of other spaces, and the
//! connections to other servers.

mod running;
mod shown;
mod start;
mod writes;

use std::collections::VecDeque;
use std::sync::Arc;

use bridge_node::{
    Application, AskId, CallDescription, CallResponse, ConfirmedArrival, Execution, ExecutionId,
    Failure, FailureKind, LinkState, LocalDelivery, Port, PortEvent, Reason, RedundancyRank,
    Router, TopicMetaData, TypePaths, Verdict,
};
use bytes::Bytes;
use discovery::AnnounceSettings;
use mappings::{Mapping, TopicId};
use opcua::server::authenticator::AuthManager;
use plant_opcua::configuration::Configuration;
use plant_opcua::endpoint::EndpointUrl;
use plant_opcua::enrolment::Invitation;
use plant_opcua::pki::Pki;
use uadp::BuiltinType;

use self::running::{DescribedServer, Rights, RunningServer};
use self::shown::{Exchanged, ShownStep, ShownValues};
use self::start::NodesBuilder;
use self::writes::ClientWrites;
use crate::access;
use crate::browse::Ordered;
use crate::components::{ComponentEvent, Components};
use crate::endpoint;
use crate::methods::{Methods, Wish};
use crate::nodes::ClientWrite;
use crate::operations::PageOperations;
use crate::others::Others;
use crate::pubsub::PubSubNodes;
use crate::redundant::{ServerRole, ServerSet, ranked};
use crate::sks::Sks;
use crate::sources::Sourced;
use crate::structures::MappedTypes;

/// The arguments of [`ServerPort::start`] in addition to the mapping.
pub(crate) struct Setup {
    pub(crate) url: EndpointUrl,
    pub(crate) pki: Pki,
    /// The key service of the groups for which this server creates the keys.
    pub(crate) sks: Arc<Sks>,
    pub(crate) trust_any_client: bool,
    pub(crate) types: MappedTypes,
    /// True if the endpoint comes from the mapping, false if it comes from the command line.
    pub(crate) mapped_url: bool,
    /// The rank of the server among redundant servers.
    pub(crate) rank: Option<RedundancyRank>,
    /// Settings for announcing the server.
    pub(crate) announce: Option<AnnounceSettings>,
    /// The Global Discovery Server that renews the certificate.
    pub(crate) gds: Option<Invitation>,
}

/// The OPC UA side of the space.
pub(crate) struct ServerPort {
    server: RunningServer,
    /// The values that clients write.
    writes: ClientWrites,
    /// The values that the address space shows.
    shown: ShownValues,
    /// Calls of other spaces.
    methods: Methods,
    /// Other servers.
    others: Others,
    /// Servers that were found in the network.
    components: Option<Components>,
    /// Events that are reported before all others.
    events: VecDeque<PortEvent>,
    /// The application as it is described to the group.
    application: Application,
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
        let (layout, (sets, nodesets)) = start::laid_out(mapping, &mut setup.types)?;
        let described = mapping.server();
        setup.sks.follow(mapping)?;
        let (listener, (address, security)) = start::listen(&setup.pki, &setup.url, described)?;
        let port = address.port();
        let access = start::users(&setup.pki, endpoint::is_local(described, address))?;
        access.set_rules(access::rules(mapping, &layout));
        let pubsub = Arc::new(PubSubNodes::new());
        let (exits, (writes, created_items, asked)) =
            start::exits(mapping, &access, (&pubsub, &role));
        let (confirms, alarms) = (Arc::clone(&exits.confirms), Arc::clone(&exits.alarms));
        let nodes = NodesBuilder {
            layout: Arc::clone(&layout),
            sets,
            exits,
        };
        let certificates = Configuration::new(setup.pki.root(), &described.application_uri);
        let mdns = matches!(&setup.announce, Some(to) if to.mdns.is_some());
        let shown = (&setup.sks, &pubsub, &alarms);
        let facets = start::facets(&security, &layout);
        let set = ServerSet::new(described, setup.rank);
        let described_core = (described, facets, &set);
        let core = start::core(shown, (&certificates, mdns), described_core, &access);
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
        let manager = start::manager(&handle, &layout)?;
        let shown = ((&*pubsub, &*alarms), start::history(described, &layout)?);
        start::show_limits(mapping, &layout, (&handle, &manager), shown);
        let (runtime, listener) = endpoint::threads(listener)?;
        let serving = runtime.spawn(server.run_with(listener));
        let clients = (&handle, setup.url.advertised(port));
        endpoint::reverse_connect(described, clients, (&runtime, door.is_some()))?;
        endpoint::stand(&runtime, door)?;
        let subscriptions = Arc::clone(handle.subscriptions());
        start::audit(&access, &handle);
        let nodes = (Arc::clone(&manager), Arc::clone(&subscriptions));
        start::look_at_created(&runtime, nodes.clone(), created_items);
        start::tell_serving(&layout, &setup.pki, (&setup.url, port));
        let others = Others::new(
            mapping,
            setup.announce.as_ref(),
            (setup.pki.root(), &alarms),
        );
        let methods = start::shown_calls(&nodes, mapping, (asked, &layout), &setup.pki);
        let (server, application) =
            start::told_of(described, setup.url.advertised(port), &security);
        let own = server.applicant(setup.url.urls(port));
        endpoint::enrol(&runtime, (own, setup.gds), (&setup.pki, &certificates));
        let (told, components) = start::tell(server, setup.announce, nodes)?;
        let described = DescribedServer {
            server: described.clone(),
            mapped_url: setup.mapped_url,
            nodesets,
        };
        let rights = Rights {
            pki: setup.pki,
            sks: setup.sks,
            access,
            certificates,
        };
        let running = (runtime, serving);
        let ranked = (setup.rank, role, set);
        let content = (&**mapping, &*layout);
        let states = (pubsub, alarms);
        Ok(Self {
            writes: ClientWrites::new(content, writes, confirms),
            shown: ShownValues::new(content, (manager, subscriptions), states, setup.types),
            server: RunningServer::new(handle, running, (described, rights), ranked, told),
            methods,
            others,
            components,
            events: VecDeque::new(),
            application,
        })
    }

    /// Returns the users and commands of the server for its page.
    pub(crate) fn operations(&self) -> PageOperations {
        let nodes = (
            Arc::clone(self.shown.manager()),
            self.server.subscriptions(),
        );
        let alarms = (Arc::clone(self.shown.alarms()), self.server.uri());
        PageOperations::new(Arc::clone(self.server.access()), nodes, alarms)
    }

    /// Applies changes of writers and readers that clients enabled or disabled.
    fn switch(&mut self) {
        for (topic, on) in self.shown.switched() {
            self.writes.switch(topic, on);
        }
    }

    /// Sends a value that a client has written.
    fn written(&mut self, write: ClientWrite) -> PortEvent {
        let ClientWrite {
            topic,
            block,
            source,
            commander,
            room,
            departure,
            answer,
            awaited,
        } = write;
        if self.server.is_standby() {
            // The role has changed since the client wrote.
            departure.refuse();
            return PortEvent::Lost {
                topic: Some(topic),
                reason: Reason::Takeover,
                why: "standby",
                count: 1,
            };
        }
        self.writes.begin((topic, commander), departure, awaited);
        drop(room);
        self.others.sources.write(topic, &block, answer);
        PortEvent::Sample {
            topic,
            payload: block,
            received: source,
            latched_by: None,
        }
    }

    /// Shows and sends the values that report the conditions, if they are due. Returns the first
    /// event.
    fn report_conditions(&mut self) -> Option<PortEvent> {
        for report in self.shown.due_reports() {
            let event = self.sourced(report);
            self.events.push_back(event);
        }
        self.events.pop_front()
    }

    /// Shows a value of another server and sends it.
    fn sourced(&mut self, sourced: Sourced) -> PortEvent {
        if !sourced.status.is_bad() && !self.server.is_standby() {
            self.others.sources.put(sourced.topic, &sourced.block);
        }
        let (event, lost) = self.shown.show_sourced(sourced);
        self.events.extend(lost);
        event
    }
}

impl Port for ServerPort {
    async fn recv(&mut self) -> PortEvent {
        if let Some(unbound) = self.shown.settle() {
            return unbound;
        }
        if let Some(event) = self.events.pop_front() {
            return event;
        }
        loop {
            if let Some(live) = self.writes.next_live() {
                return live;
            }
            tokio::select! {
                () = tokio::task::yield_now(), if self.writes.polls() => {}
                written = self.writes.recv() => if let Some(write) = written {
                    return self.written(write);
                },
                ended = self.server.ended() => return PortEvent::Ended(ended),
                wish = self.methods.next() => return match wish {
                    Wish::Ask { ask, topic, request, timeout } => {
                        PortEvent::Ask { ask, topic, request, timeout }
                    }
                    Wish::GiveUp(ask) => PortEvent::AskGivenUp { ask },
                },
                event = self.others.executing.next() => return event,
                event = self.others.skills.next() => return event,
                sourced = self.others.sources.next() => return self.sourced(sourced),
                happened = next(&mut self.components) => match happened {
                    ComponentEvent::Told(event) => return event,
                    ComponentEvent::Heard(found) => self.others.heard(&found),
                },
                () = self.others.finding.changed() => self.others.found(),
                step = self.shown.wait() => match step {
                    ShownStep::Old => self.shown.grow_old(),
                    ShownStep::Switched => self.switch(),
                    ShownStep::Conditions => if let Some(event) = self.report_conditions() {
                        return event;
                    },
                },
            }
        }
    }

    fn publish(&mut self, sample: LocalDelivery) -> Result<(), &'static str> {
        if !self.shown.admit(&sample)? {
            return Ok(());
        }
        if sample.status & BAD == 0 {
            if !self.server.is_standby() {
                // The active server writes to other servers.
                self.others.sources.put(sample.topic, &sample.payload);
            }
            self.methods.reported(sample.topic, &sample.payload);
        }
        self.shown.show(sample)
    }

    fn wanted(
        &mut self,
        _topic: TopicId,
        _shape: &[(BuiltinType, bool)],
        _described: Option<&TopicMetaData>,
    ) {
        // Values of every type have a node.
    }

    fn handled(&mut self, topic: TopicId, verdict: Verdict, router: &Router) {
        self.writes.handled(topic, verdict, router);
    }

    fn left(&mut self, topic: TopicId, sent: Result<(), Reason>, router: &Router) {
        self.writes.left(topic, sent, router);
    }

    fn drained(&mut self, is_muted: bool, router: &Router) {
        self.writes.drained(is_muted, router);
    }

    fn settled(&mut self, topic: TopicId, arrival: &ConfirmedArrival) {
        self.shown.show_arrival(topic, arrival);
        self.writes.settled(topic, arrival);
    }

    fn silent(&mut self, topic: TopicId, silent: bool) {
        if silent {
            self.others.sources.set_silent(topic);
        }
        self.shown.set_silent(topic, silent);
    }

    fn counted(&mut self, router: &Router) {
        self.shown.counted(router);
        self.server.show_service_level(self.shown.silence());
        self.server.show_set(router);
    }

    fn drop_waiting(&mut self, _at_once: bool) {
        // The values of the space are only shown. Values for other servers are commands.
        self.others.sources.drop_waiting();
    }

    fn role_changed(&mut self, is_active: bool) {
        self.server.set_active(is_active);
        self.server.show_service_level(self.shown.silence());
    }

    fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.others.skills.others(topic, &description.name);
        self.methods.known(topic, description);
    }

    fn call_gone(&mut self, topic: TopicId) {
        self.methods.gone(topic);
    }

    fn answered(&mut self, ask: AskId, _topic: TopicId, answer: CallResponse<Bytes>) {
        self.methods.answered(ask, answer);
    }

    fn execute(&mut self, execution: Execution) -> bool {
        if self.others.skills.serves(execution.topic) {
            self.others.skills.execute(execution)
        } else {
            self.others.executing.execute(&execution)
        }
    }

    fn abandoned(&mut self, execution: ExecutionId, _topic: TopicId) {
        // A Method that was called continues.
        self.others.skills.abandoned(execution);
    }

    fn reload(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) -> Vec<String> {
        let mapping = &ranked(mapping, self.server.rank());
        let mut restart = self.server.differs(mapping);
        self.writes.follow(mapping);
        self.shown.follow(mapping, types);
        let moved = self.methods.take_moved(mapping);
        let server = &self.server;
        let exchanged = self
            .shown
            .exchange(mapping, |layout| server.set_rules(mapping, layout));
        match exchanged {
            Ok(Exchanged {
                restart: namespaces,
                gone,
                new,
            }) => {
                restart.extend(namespaces);
                self.writes.exchange(&gone, new);
                // Disabled readers and writers stay disabled.
                self.switch();
            }
            Err(error) => restart.push(format!("variables ({error})")),
        }
        if let Err(failure) = self.server.follow_groups(mapping) {
            restart.push(format!("security ({failure})"));
        }
        self.methods.put(moved, self.shown.structures());
        for topic in self.others.reload(mapping) {
            self.shown.show_waiting(topic);
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
        self.server.certificate()
    }

    fn service_level(&self) -> Option<u8> {
        self.server.service_level()
    }

    fn application(&self) -> Option<Application> {
        Some(self.application.clone())
    }

    async fn shutdown(mut self) {
        self.methods.end();
        self.server.shutdown().await;
        self.shown.manager().inner().live().close_past();
    }
}

/// Waits for the next event of the servers in the network.
async fn next(components: &mut Option<Components>) -> ComponentEvent {
    match components {
        Some(components) => components.next().await,
        None => std::future::pending().await,
    }
}

/// The Bad severity in the upper half of a StatusCode.
const BAD: u16 = 0x8000;
