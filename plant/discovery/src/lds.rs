//! The Local Discovery Server: a registry with an OPC UA endpoint, and mDNS on an interface.

mod embedding;
mod settings;
mod status;

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use log_limit::LogLimit;
use mdns::{Aside, Mdns, MdnsInterface, OwnAnnouncement, Url, host_name};
use opcua::types::ApplicationType;
use plant_opcua::own;
use registry::{
    AnnouncedServer, NetworkRecord, RegistryEvent, RegistrySettings, ServerLoss, instance_name,
};
use service::{Failure, FailureKind, Requests};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{info, warn};

use self::embedding::EmbeddingProgram;
pub use self::embedding::{Added, Gated, LdsEmbedding, OnLevel};
use self::settings::own_host;
pub use self::settings::{EmbeddedIn, LdsSettings};
pub use self::status::LdsStatus;
use self::status::{LossStatus, RecordStatus, ServerStatus};
use crate::clock;
use crate::connection::{RegistryRequest, RequestCounters, ServerShared};
use crate::endpoint;
use crate::keeper::Keeper;
use crate::listen::{cut, listen};
use crate::listing::ListingTask;
use crate::security::TOLD_EVERY;
use crate::services::{OwnDescription, RegistryAnswer, RegistryQuery, semaphore};

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
    lds.around = EmbeddingProgram::new(around);
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
    around: EmbeddingProgram,
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
            around: EmbeddingProgram::default(),
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
                RegistryAnswer::Servers(found.chain(self.around.gated(&uris)).collect())
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
                    self.around.report(OnLevel::Told {
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
                self.around.report(OnLevel::Restarted { url });
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
        self.around.report(OnLevel::Told {
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
        self.around.report(OnLevel::Left { source });
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
        let added = self.around.added();
        let no_interface = no_interface.then_some(why).into_iter();
        LdsStatus {
            program: self.around.name(),
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
            ("level_missed_total", self.around.missed()),
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

/// Waits until a Global Discovery Server lists other servers, and returns its servers.
async fn listed(listing: &mut Option<ListingTask>) -> Vec<AnnouncedServer> {
    match listing {
        Some(listing) => listing.step().await,
        None => std::future::pending().await,
    }
}

const MOST_LOSSES: usize = 64;
const SEMAPHORES_EVERY: Duration = Duration::from_secs(5);
const LEAVE_LIMIT: Duration = Duration::from_secs(1);
