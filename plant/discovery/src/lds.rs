//! The Local Discovery Server: a registry with an OPC UA endpoint, and mDNS on an interface.

mod status;

use std::collections::{BTreeMap, VecDeque};
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use log_limit::LogLimit;
use opcua::types::ApplicationType;
use plant_opcua::enrolment::{Applicant, DirectoryClient, Enrolment, Invitation};
use plant_opcua::own;
use registry::{
    AnnouncedServer, NetworkRecord, RegistrationRequest, RegistryEvent, RegistrySettings,
    ServerLoss, instance_name,
};
use service::{Failure, FailureKind, Requests};
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinSet, spawn_blocking};
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{info, warn};

pub use self::status::LdsStatus;
use self::status::{LossStatus, RecordStatus, ServerStatus};
use crate::clock;
use crate::connection::{RegistryRequest, RequestCounters, ServerShared};
use crate::endpoint;
use crate::keeper::Keeper;
use crate::listen::{cut, listen};
use crate::listing::{ListingTask, ServerQuery};
use crate::security::{ChannelSecurity, TOLD_EVERY};
use crate::services::{OwnDescription, RegistryAnswer, RegistryQuery, semaphore};
use mdns::MdnsInterface;
use mdns::Url;
use mdns::host_name;
use mdns::{Aside, Mdns, OwnAnnouncement};

/// The settings of a discovery server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LdsSettings {
    /// The ApplicationUri of the embedding application; `None` for a default with the host name.
    pub application_uri: Option<String>,
    /// The endpoint URL, for example `opc.tcp://127.0.0.1:4840`.
    pub endpoint: String,
    /// The interface for mDNS.
    pub interface: MdnsInterface,
    /// Whether servers of other hosts may register over an unsecured channel.
    pub allow_unsecured: bool,
    /// Whether servers of this host must register over a secured channel too.
    pub secured_only: bool,
    /// The registration interval of servers. A registration without a semaphore file expires after
    /// twice this time.
    pub register_every: Duration,
    /// The certificate store; `None` disables secured channels.
    pub pki: Option<PathBuf>,
    /// The Global Discovery Server that issues the certificate. Requires `pki`.
    pub gds: Option<Invitation>,
    /// The Global Discovery Server; its servers are listed too. Requires `pki`.
    pub listing: Option<ServerQuery>,
    /// Whether every client certificate is trusted. For tests only.
    pub trust_any: bool,
    /// The embedding program; `None` for the program `ua-lds`.
    pub embedded: Option<EmbeddedIn>,
}

/// The program that embeds a discovery server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EmbeddedIn {
    /// The name of the program.
    pub name: String,
    /// The certificate store that decides on trust; `None` for the store of the discovery server.
    pub trusts: Option<PathBuf>,
}

impl LdsSettings {
    /// Returns the defaults of `ua-lds` at an endpoint: mDNS on loopback, and no secured channels.
    #[must_use]
    pub fn at(endpoint: impl Into<String>) -> Self {
        Self {
            application_uri: None,
            endpoint: endpoint.into(),
            interface: MdnsInterface::LOOPBACK,
            allow_unsecured: false,
            secured_only: false,
            register_every: REGISTER_EVERY,
            pki: None,
            gds: None,
            listing: None,
            trust_any: false,
            embedded: None,
        }
    }

    /// Returns the application name.
    fn name(&self) -> String {
        match &self.embedded {
            None => NAME.to_owned(),
            Some(program) => format!("{NAME} in {}", program.name),
        }
    }

    /// Creates a missing certificate and key. Generating a key takes seconds on a small computer,
    /// during which an open port would keep clients waiting.
    pub(crate) async fn prepare(&self) -> Result<(), Failure> {
        let place = Url::parse(&self.endpoint).map(|place| place.host);
        let host = own_host(place.as_deref().unwrap_or_default(), &self.interface);
        self.open_security(&self.uri(), &host).await.map(drop)
    }

    fn uri(&self) -> String {
        let given = self.application_uri.clone();
        given.unwrap_or_else(|| format!("urn:{}:ua-lds", host_name()))
    }

    /// Returns the renewal of the certificate at the Global Discovery Server.
    fn enrolment(&self, own: &OwnDescription) -> Option<Enrolment> {
        let (root, gds) = (self.pki.as_ref()?, self.gds.clone()?);
        let applicant = Applicant {
            application_uri: own.application_uri.clone(),
            name: own.name.clone(),
            product_uri: "urn:ua-bridge:lds".to_owned(),
            urls: vec![own.url.clone()],
            capabilities: vec!["LDS".to_owned()],
        };
        Some(Enrolment::new(root, applicant, gds))
    }

    /// Returns the queries of the Global Discovery Server, with the identity of the discovery
    /// server.
    fn listing_task(&self, own: &OwnDescription) -> Option<ListingTask> {
        let (query, root) = (self.listing.as_ref()?, self.pki.clone()?);
        let client = DirectoryClient {
            root,
            application_uri: own.application_uri.clone(),
            name: own.name.clone(),
            gds: query.gds.clone(),
        };
        Some(ListingTask::new(query, client, vec![own.url.clone()]))
    }

    /// Opens the certificate store, and creates a missing certificate and key.
    async fn open_security(
        &self,
        application_uri: &str,
        host: &str,
    ) -> Result<Option<ChannelSecurity>, Failure> {
        let Some(root) = self.pki.clone() else {
            return Ok(None);
        };
        let (uri, host, trust_any) = (application_uri.to_owned(), host.to_owned(), self.trust_any);
        // Generating a key takes some time, and must not block the program.
        let open = move || ChannelSecurity::open(&root, &uri, &host, trust_any);
        let opened = spawn_blocking(open).await;
        let opened = opened.map_err(|error| Failure::new(FailureKind::Io, error.to_string()))??;
        let trusts = self
            .embedded
            .as_ref()
            .and_then(|program| program.trusts.clone());
        Ok(Some(opened.judging_by(trusts, self.trust_any)))
    }
}

/// A server of another level that is reached through this server (OPC 10000-4, 7.2:
/// GatewayServerUri).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gated {
    /// The ApplicationUri.
    pub application_uri: String,
    /// The application name.
    pub name: String,
    /// The ApplicationUri of the gateway, which forwards requests.
    pub gateway_uri: String,
    /// The URL of the gateway on this level.
    pub url: String,
}

/// The information that an embedding program adds to the discovery server.
#[derive(Debug, Clone, Default)]
pub struct Added {
    /// Servers to list in FindServers.
    pub gated: Vec<Gated>,
    /// The value of `level` in `/status`.
    pub status: Option<serde_json::Value>,
    /// The reasons why the program is not ready.
    pub not_ready: Vec<String>,
}

/// The connection between an embedding program and its discovery server.
#[derive(Debug)]
pub struct LdsEmbedding {
    /// The name of the program in `/status`.
    pub program: &'static str,
    /// Receives changes of the servers. Events that do not fit into the channel are dropped, and
    /// counted as `level_missed_total`: the discovery server never waits.
    pub events: mpsc::Sender<OnLevel>,
    /// The added information.
    pub added: watch::Receiver<Added>,
}

/// A change of the servers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OnLevel {
    /// A source, which is an ApplicationUri or an mDNS name, reports a server.
    Told {
        /// The source.
        source: String,
        /// The URL of the server.
        url: String,
        /// Whether the server is registered; otherwise it is announced by mDNS only.
        registered: bool,
    },
    /// A source no longer reports a server.
    Left {
        /// The source.
        source: String,
    },
    /// The program behind a URL restarted.
    Restarted {
        /// The URL.
        url: String,
    },
}

/// Runs a discovery server until `stop` completes.
///
/// # Errors
/// Returns an error if the endpoint or the interface cannot be used.
pub async fn run(
    settings: LdsSettings,
    pages: Requests<LdsStatus>,
    stop: impl Future<Output = ()>,
) -> Result<(), Failure> {
    run_around(settings, None, pages, stop).await
}

/// Runs a discovery server of an embedding program until `stop` completes.
///
/// # Errors
/// Returns an error if the endpoint or the interface cannot be used.
pub async fn run_around(
    settings: LdsSettings,
    around: Option<LdsEmbedding>,
    mut pages: Requests<LdsStatus>,
    stop: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let listening = match listen(&settings.endpoint).await {
        Ok(listening) => listening,
        Err(fault) => return Err(fault.told(&settings.endpoint).await),
    };
    let (mut lds, questions) = DiscoveryServer::start(&settings, listening).await?;
    lds.around = around;
    service::service_manager::ready();
    lds.run(questions, &mut pages, stop).await;
    Ok(())
}

/// A discovery server, which serves its clients during [`run`](Self::run).
pub(crate) struct DiscoveryServer {
    keeper: Keeper,
    shared: Arc<ServerShared>,
    interface: MdnsInterface,
    /// Its own mDNS instance name.
    instance: String,
    started: SystemTime,
    since: BTreeMap<String, SystemTime>,
    losses: VecDeque<LossStatus>,
    lost: u64,
    around: Option<LdsEmbedding>,
    missed: u64,
    register_every: Duration,
    /// Limits the log messages for refused registrations, by URI and reason.
    refused: LogLimit,
    /// The task that accepts clients.
    accepting: JoinSet<()>,
    /// The certificate store.
    pki: Option<PathBuf>,
    /// The queries of the Global Discovery Server.
    listing: Option<ListingTask>,
}

impl DiscoveryServer {
    /// Starts a discovery server with the result of [`listen`].
    pub(crate) async fn start(
        settings: &LdsSettings,
        (listener, place): (TcpListener, Url),
    ) -> Result<(Self, mpsc::Receiver<RegistryRequest>), Failure> {
        let at = listener.local_addr().map_err(|error| {
            Failure::new(
                FailureKind::Io,
                format!("cannot listen at {}: {error}", settings.endpoint),
            )
        })?;
        let mdns = Mdns::open(&settings.interface);
        let mdns =
            mdns.map_err(|error| Failure::new(FailureKind::Unavailable, error.to_string()))?;
        let addresses = settings.interface.addresses();
        if addresses.is_empty() {
            warn!(
                "the interface {} has no IPv4 address: no server is found there until it has an address",
                settings.interface
            );
        }
        let host = own_host(&place.host, &settings.interface);
        let url = Url {
            host,
            port: at.port(),
            path: place.path,
        }
        .to_string();
        let application_uri = settings.uri();
        let host = Url::parse(&url).map_or_else(host_name, |url| url.host);
        let security = settings.open_security(&application_uri, &host).await?;
        let certificate = security
            .as_ref()
            .map(|own| own.certificate.as_byte_string());
        let own = OwnDescription {
            application_uri,
            name: settings.name(),
            url: url.clone(),
            application_type: ApplicationType::DiscoveryServer,
            certificate: certificate.unwrap_or_default(),
        };
        let started = clock::wall();
        let (ask, questions) = mpsc::channel(64);
        let shared =
            Arc::new(ServerShared::new(own, security, ask).secured_only(settings.secured_only));
        let mut accepting = JoinSet::new();
        accepting.spawn(endpoint::accept(listener, Arc::clone(&shared)));
        if let Some(enrolment) = settings.enrolment(&shared.own) {
            accepting.spawn(enrolment.keep(service::restart::restart));
        }
        let listing = settings.listing_task(&shared.own);
        info!(url, interface = %settings.interface, "the discovery server is listening");
        let registry = RegistrySettings {
            allow_unsecured: settings.allow_unsecured,
            forget_after: settings.register_every * 2,
            ..RegistrySettings::default()
        };
        let mut lds = Self {
            keeper: Keeper::new(registry, Some(mdns), Some(url)),
            shared,
            interface: settings.interface.clone(),
            instance: instance_name("ua-lds", &host_name(), at.port()),
            started,
            since: BTreeMap::new(),
            losses: VecDeque::new(),
            lost: 0,
            around: None,
            missed: 0,
            register_every: settings.register_every,
            refused: LogLimit::every(TOLD_EVERY),
            accepting,
            pki: settings.pki.clone(),
            listing,
        };
        lds.announce();
        Ok((lds, questions))
    }

    /// Announces the discovery server by mDNS.
    fn announce(&mut self) {
        if let Some(mdns) = &mut self.keeper.mdns {
            mdns.put(OwnAnnouncement {
                announcement: AnnouncedServer {
                    instance: self.instance.clone(),
                    url: self.shared.own.url.clone(),
                    capabilities: vec!["LDS".to_owned()],
                },
                aside: Aside::of_start(clock::ticks(self.started)),
            });
        }
    }

    /// Returns the sender for requests of the embedding program.
    pub(crate) fn asking(&self) -> mpsc::Sender<RegistryRequest> {
        self.shared.ask.clone()
    }

    /// Serves requests until `stop` completes, and withdraws the announcement.
    pub(crate) async fn run(
        &mut self,
        mut questions: mpsc::Receiver<RegistryRequest>,
        pages: &mut Requests<LdsStatus>,
        stop: impl Future<Output = ()>,
    ) {
        let mut semaphores = interval(SEMAPHORES_EVERY.min(self.register_every));
        semaphores.set_missed_tick_behavior(MissedTickBehavior::Delay);
        tokio::pin!(stop);
        loop {
            tokio::select! {
                () = &mut stop => break,
                () = self.keeper.step() => {}
                servers = listed(&mut self.listing) => {
                    self.keeper.registry.listed(servers, clock::now());
                }
                Some((question, channel, reply)) = questions.recv() => {
                    let answer = self.answer(question, &channel);
                    // The client may have disconnected.
                    drop(reply.send(answer));
                }
                Some(reply) = pages.recv() => drop(reply.send(self.status())),
                _ = semaphores.tick() => self.look_at_semaphores(),
            }
            while let Some(event) = self.keeper.event() {
                self.take(event);
            }
            for (url, started) in self.keeper.take_started() {
                info!(
                    url,
                    started_ms = clock::millis(clock::of_ticks(started)),
                    "received the start time of a server"
                );
            }
        }
        self.leave().await;
    }

    fn answer(&mut self, question: RegistryQuery, channel: &registry::Channel) -> RegistryAnswer {
        let registry = &mut self.keeper.registry;
        match question {
            RegistryQuery::FindServers { uris } => {
                let uris: Vec<&str> = uris.iter().map(String::as_str).collect();
                let found = registry.find_servers(&uris);
                let found = found.map(|(asked, _)| asked.clone());
                let gated = self.around.iter().flat_map(|around| gated(around, &uris));
                RegistryAnswer::Servers(found.chain(gated).collect())
            }
            RegistryQuery::FindOnNetwork {
                from,
                most,
                capabilities,
            } => {
                let capabilities: Vec<&str> = capabilities.iter().map(String::as_str).collect();
                let records = registry.find_servers_on_network(from, most, &capabilities);
                RegistryAnswer::OnNetwork {
                    records: records.into_iter().cloned().collect(),
                    reset: self.started,
                }
            }
            RegistryQuery::Register {
                asked,
                semaphore_is_there,
            } => {
                let uri = asked.server_uri.clone();
                match registry.register(*asked, channel, semaphore_is_there, clock::now()) {
                    Ok(_) => RegistryAnswer::Registered,
                    Err(fault) => {
                        let (uri, why) = (cut(&uri), cut(&fault.to_string()));
                        let what = format!("{uri} {why}");
                        if let Some(suppressed) = self.refused.admit(&what, clock::now()) {
                            warn!(?uri, suppressed, "refused a registration: {why}");
                        }
                        RegistryAnswer::Refused(fault.status())
                    }
                }
            }
        }
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "everything is announced by then"
    )]
    fn take(&mut self, event: RegistryEvent) {
        match event {
            RegistryEvent::Registered {
                server_uri,
                discovery_urls,
            } => {
                info!(uri = ?server_uri, urls = ?discovery_urls, "registered");
                if let Some(url) = discovery_urls.into_iter().next() {
                    let source = server_uri.clone();
                    let registered = true;
                    self.tell(OnLevel::Told {
                        source,
                        url,
                        registered,
                    });
                }
                self.since.entry(server_uri).or_insert_with(clock::wall);
            }
            RegistryEvent::Seen(record) => self.seen(record),
            RegistryEvent::Restarted { url } => {
                info!(url, "restarted");
                self.tell(OnLevel::Restarted { url });
            }
            RegistryEvent::Gone { server_uri, loss } => self.lose(server_uri, String::new(), loss),
            RegistryEvent::Vanished { record, loss } => {
                let AnnouncedServer { instance, url, .. } = record.announcement;
                self.lose(instance, url, loss);
            }
            _ => {}
        }
    }

    fn seen(&mut self, record: NetworkRecord) {
        let AnnouncedServer { instance, url, .. } = record.announcement;
        let now = clock::wall();
        let started = self.keeper.started(&url).map(clock::of_ticks);
        let after = started.and_then(|at| now.duration_since(at).ok());
        let after_ms = after.map(|after| after.as_millis());
        let source = record.source.label();
        info!(name = ?instance, url, source, after_ms, "seen on the network");
        let source = instance.clone();
        let registered = false;
        self.tell(OnLevel::Told {
            source,
            url,
            registered,
        });
        self.since.entry(instance).or_insert(now);
    }

    fn lose(&mut self, name: String, url: String, loss: ServerLoss) {
        let silent = self.keeper.silent_for(&url);
        let silent_ms = silent.map(|silent| u64::try_from(silent.as_millis()).unwrap_or(u64::MAX));
        info!(?name, url, loss = loss.label(), silent_ms, "gone");
        self.since.remove(&name);
        let source = name.clone();
        self.tell(OnLevel::Left { source });
        self.lost += 1;
        if self.losses.len() >= MOST_LOSSES {
            self.losses.pop_front();
        }
        self.losses.push_back(LossStatus {
            name,
            url,
            loss: loss.label(),
            at_ms: clock::millis(clock::wall()),
            silent_ms,
        });
    }

    fn tell(&mut self, told: OnLevel) {
        if let Some(around) = &self.around
            && around.events.try_send(told).is_err()
        {
            self.missed += 1;
        }
    }

    fn look_at_semaphores(&mut self) {
        let named = self.keeper.registry.find_servers(&[]);
        let gone = named.filter(|(asked, _)| semaphore(&asked.semaphore_file_path) == Some(false));
        let gone: Vec<String> = gone.map(|(asked, _)| asked.server_uri.clone()).collect();
        for uri in gone {
            self.keeper.registry.semaphore_gone(&uri);
        }
    }

    fn status(&self) -> LdsStatus {
        let since = |name: &str| clock::millis(*self.since.get(name).unwrap_or(&self.started));
        let registry = &self.keeper.registry;
        let servers = registry.find_servers(&[]).map(|(asked, _)| ServerStatus {
            uri: asked.server_uri.clone(),
            name: asked
                .names
                .first()
                .map(|(_, name)| name.clone())
                .unwrap_or_default(),
            urls: asked.discovery_urls.clone(),
            since_ms: since(&asked.server_uri),
        });
        let records = registry.find_servers_on_network(0, 0, &[]).into_iter();
        let network = records.map(|record| RecordStatus {
            record_id: record.record_id,
            name: record.announcement.instance.clone(),
            url: record.announcement.url.clone(),
            source: record.source.label(),
            capabilities: record.announcement.capabilities.clone(),
            since_ms: since(&record.announcement.instance),
            started_ms: self
                .keeper
                .started(&record.announcement.url)
                .map(|at| clock::millis(clock::of_ticks(at))),
        });
        let no_interface = self.interface.addresses().is_empty();
        let why = format!("the interface {} has no IPv4 address", self.interface);
        let around = self.around.as_ref();
        let added = around.map(|around| around.added.borrow().clone());
        let added = added.unwrap_or_default();
        let no_interface = no_interface.then_some(why).into_iter();
        LdsStatus {
            program: around.map_or("ua-lds", |around| around.program),
            version: build_info::version(),
            library: plant_opcua::patches::library(),
            application_uri: self.shared.own.application_uri.clone(),
            endpoint: self.shared.own.url.clone(),
            interface: self.interface.to_string(),
            since_ms: clock::millis(self.started),
            not_ready: no_interface.chain(added.not_ready).collect(),
            servers: servers.collect(),
            network: network.collect(),
            losses: self.losses.clone(),
            counters: self.counters(),
            gds: self.listing.as_ref().map(ListingTask::status),
            level: added.status,
            certificate: self.pki.as_deref().and_then(own::status),
        }
    }

    /// Returns the counters, by their names in `/status`.
    pub(crate) fn counters(&self) -> BTreeMap<&'static str, u64> {
        let get = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let RequestCounters {
            connections,
            refused_connections,
            refused_certificates,
            questions,
            unsupported,
            malformed,
            timed_out,
        } = &self.shared.counters;
        BTreeMap::from([
            ("connections_total", get(connections)),
            ("connections_gave_way_total", get(refused_connections)),
            ("certificates_refused_total", get(refused_certificates)),
            ("questions_total", get(questions)),
            ("unsupported_total", get(unsupported)),
            ("malformed_total", get(malformed)),
            ("timed_out_total", get(timed_out)),
            ("lost_total", self.lost),
            ("level_missed_total", self.missed),
            (
                "gds_failures_total",
                self.listing.as_ref().map_or(0, ListingTask::failures),
            ),
            ("no_room_total", self.keeper.registry.refused()),
            ("displaced_total", self.keeper.registry.displaced()),
            (
                "announcements_ignored_total",
                self.keeper.mdns.as_ref().map_or(0, Mdns::ignored),
            ),
        ])
    }

    /// Withdraws the announcement, and then closes the listener and the connections. The order
    /// matters: clients treat a connection loss without a preceding withdrawal as a crash.
    async fn leave(&mut self) {
        let goodbye = self
            .keeper
            .mdns
            .as_mut()
            .and_then(|mdns| mdns.take_back(&self.instance));
        if let Some(goodbye) = goodbye {
            // After the timeout, other programs detect the loss themselves.
            drop(timeout(LEAVE_LIMIT, goodbye).await);
        }
        self.accepting.shutdown().await;
        self.keeper.mdns = None;
    }
}

/// Returns the host of the own URL. A server on the wildcard address uses the address of the
/// interface.
fn own_host(host: &str, interface: &MdnsInterface) -> String {
    let address: Option<IpAddr> = host.parse().ok();
    let is_wildcard = address.is_some_and(|address| address.is_unspecified());
    match (is_wildcard, interface.addresses().first()) {
        (true, Some(address)) => address.to_string(),
        _ => host.to_owned(),
    }
}

/// Waits until a Global Discovery Server lists other servers, and returns its servers.
async fn listed(listing: &mut Option<ListingTask>) -> Vec<AnnouncedServer> {
    match listing {
        Some(listing) => listing.step().await,
        None => std::future::pending().await,
    }
}

/// Returns the servers of other levels with these URIs, or all, in the form of registrations.
fn gated(around: &LdsEmbedding, uris: &[&str]) -> Vec<RegistrationRequest> {
    let added = around.added.borrow();
    let wanted = |one: &&Gated| uris.is_empty() || uris.contains(&&*one.application_uri);
    let gated = added
        .gated
        .iter()
        .filter(wanted)
        .map(|one| RegistrationRequest {
            server_uri: one.application_uri.clone(),
            product_uri: String::new(),
            names: vec![(String::new(), one.name.clone())],
            application_type: registry::ApplicationType::Server,
            gateway_server_uri: one.gateway_uri.clone(),
            discovery_urls: vec![one.url.clone()],
            semaphore_file_path: String::new(),
            is_online: true,
            mdns: None,
        });
    gated.collect()
}

const NAME: &str = "UA bridge discovery server";
/// The default of most discovery servers.
const REGISTER_EVERY: Duration = Duration::from_secs(600);
const MOST_LOSSES: usize = 64;
const SEMAPHORES_EVERY: Duration = Duration::from_secs(5);
const LEAVE_LIMIT: Duration = Duration::from_secs(1);
