//! Announcement and registration of a server: [`announce`].

use std::path::PathBuf;
use std::pin::Pin;
use std::time::{Duration, SystemTime};

use plant_opcua::supervision::{Registrar, Supervision};
use registry::hierarchy::ServerChoice;
use registry::{AnnouncedServer, instance_name};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{debug, info, warn};

use crate::address::reachable;
use crate::chosen::find_lds;
use crate::client::{self, DiscoveryQueryFault};
use crate::clock;
use crate::description::ServerDescription;
use crate::embedded::{Embedded, Embedding, lost};
use mdns::MdnsInterface;
use mdns::Url;
use mdns::host_name;
use mdns::{Aside, MdnsAnnouncer, MdnsEvent, MdnsFault, OwnAnnouncement, same_place};

/// The settings of announcement and registration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AnnounceSettings {
    /// The Local Discovery Server to register with; `None` for no registration. Either its URL, or
    /// a [`ServerChoice`] among the discovery servers on mDNS: `any`, `uri=urn:cell:*`,
    /// `name=cell-lds`.
    pub lds: Option<String>,
    /// Whether the program embeds the discovery server while no other program provides it. Only
    /// valid with a URL of this host.
    pub embed: bool,
    /// The interface for mDNS; `None` for no mDNS announcement by the program. The Local Discovery
    /// Server is then asked to announce the server.
    pub mdns: Option<MdnsInterface>,
    /// The interval of registrations; at most ten seconds while no mDNS packets are received.
    pub register_every: Duration,
    /// The certificate store of the server, which contains its certificate and key. The server
    /// registers over a secured channel if the discovery server offers such a channel and is
    /// trusted. With `None` the server registers over unsecured channels, which most discovery
    /// servers accept from their own host at most.
    pub pki: Option<PathBuf>,
    /// Receives the discovery server that the server is registered with.
    pub supervision: Supervision,
}

impl Default for AnnounceSettings {
    fn default() -> Self {
        Self {
            lds: Some(crate::DEFAULT_LDS.to_owned()),
            embed: false,
            mdns: Some(MdnsInterface::LOOPBACK),
            register_every: Duration::from_secs(60),
            pki: None,
            supervision: Supervision::default(),
        }
    }
}

impl AnnounceSettings {
    /// Returns the settings for the value of `--lds`. `embed` selects the discovery server of this
    /// host, and embeds it while no other program provides it. `embed=URL` does the same at another
    /// port or address of this host. All other values have the form of [`lds`](Self::lds).
    #[must_use]
    pub fn registering(written: Option<&str>) -> Self {
        let embedded = match written.and_then(|written| written.strip_prefix("embed")) {
            Some("") => Some(crate::DEFAULT_LDS),
            Some(more) => more.strip_prefix('='),
            None => None,
        };
        Self {
            lds: embedded.or(written).map(str::to_owned),
            embed: embedded.is_some(),
            ..Self::default()
        }
    }
}

/// The state of announcement and registration.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AnnounceState {
    /// The start of the current registration period; `None` while the server is not registered.
    pub registered: Option<SystemTime>,
    /// The time of the first announcement.
    pub announced: Option<SystemTime>,
    /// The mDNS instance name.
    pub mdns_name: Option<String>,
    /// The reason for a missing registration.
    pub fault: Option<String>,
}

/// Announces a server until this value is dropped.
#[derive(Debug)]
pub struct ServerAnnouncement {
    server: watch::Sender<ServerDescription>,
    state: watch::Receiver<AnnounceState>,
    /// Dropping the sender stops the announcement.
    stop: mpsc::Sender<()>,
    task: JoinHandle<()>,
}

impl ServerAnnouncement {
    /// Replaces the description of the server, and publishes changes.
    pub fn update(&self, server: ServerDescription) {
        self.server.send_if_modified(|known| {
            let changed = *known != server;
            *known = server;
            changed
        });
    }

    /// Returns the state of announcement and registration.
    #[must_use]
    pub fn state(&self) -> AnnounceState {
        self.state.borrow().clone()
    }

    /// Withdraws the announcement and the registration; waits for at most one second. To be called
    /// before the server stops. Dropping this value does the same without waiting.
    pub async fn leave(self) {
        let Self { stop, task, .. } = self;
        drop(stop);
        // If this is late or fails, the other programs detect the loss themselves.
        drop(timeout(LEAVE_LIMIT, task).await);
    }
}

/// Starts to announce and register a server. Requires a tokio runtime. Returns at once, because a
/// discovery server may become available later.
///
/// # Errors
/// Returns an error if the mDNS daemon cannot be started.
pub fn announce(
    server: ServerDescription,
    settings: AnnounceSettings,
) -> Result<ServerAnnouncement, MdnsFault> {
    let mdns = settings.mdns.as_ref().map(MdnsAnnouncer::open);
    let mdns = mdns.transpose()?;
    let (settings, found) = found(settings)?;
    let (sender, changes) = watch::channel(server);
    let (tell, state) = watch::channel(AnnounceState::default());
    let (stop, stopped) = mpsc::channel(1);
    let mut telling = Telling {
        settings,
        mdns,
        found,
        server: changes,
        state: tell,
        start_time: clock::ticks(clock::wall()),
        instance: None,
        lds_run: None,
        register_at: Instant::now(),
        wait: FIRST_WAIT,
        here: None,
        there: None,
        look_from: Instant::now(),
        look_wait: FIRST_WAIT,
    };
    telling.heed_lds();
    let task = tokio::spawn(telling.run(stopped));
    Ok(ServerAnnouncement {
        server: sender,
        state,
        stop,
        task,
    })
}

/// The discovery server found by mDNS, if it is selected by a [`ServerChoice`].
type Looked = Option<watch::Receiver<Option<String>>>;

/// Starts to look for the discovery server if it is not given by a URL.
fn found(settings: AnnounceSettings) -> Result<(AnnounceSettings, Looked), MdnsFault> {
    let choice = settings.lds.as_deref().map(str::parse::<ServerChoice>);
    match (choice, &settings.mdns) {
        (Some(Ok(choice)), Some(interface)) if !matches!(choice, ServerChoice::At(_)) => {
            let found = find_lds(choice, interface, None)?;
            let settings = AnnounceSettings {
                lds: None,
                ..settings
            };
            Ok((settings, Some(found)))
        }
        // An invalid URL is reported at the attempt to use it.
        _ => Ok((settings, None)),
    }
}

struct Telling {
    settings: AnnounceSettings,
    /// Discovers no servers: hundreds of programs that only announce themselves may be on a
    /// network. A search for a discovery server by mDNS browses besides.
    mdns: Option<MdnsAnnouncer>,
    /// The discovery server found by mDNS, if it is selected by a choice.
    found: Looked,
    server: watch::Receiver<ServerDescription>,
    state: watch::Sender<AnnounceState>,
    start_time: i64,
    /// The mDNS instance name.
    instance: Option<String>,
    /// The last announced run of the discovery server.
    lds_run: Option<AnnouncedRun>,
    register_at: Instant,
    wait: Duration,
    /// The embedded discovery server.
    here: Option<Embedded>,
    /// Completes when the connection to the discovery server of another program is lost. The server
    /// then registers again, or embeds a discovery server.
    there: Option<Pin<Box<dyn Future<Output = ()> + Send>>>,
    /// The earliest time of the next connection that watches the discovery server of another
    /// program.
    look_from: Instant,
    /// The delay of that connection after the loss of the previous connection.
    look_wait: Duration,
}

/// A run of a discovery server.
#[derive(Debug, PartialEq, Eq)]
enum AnnouncedRun {
    /// It was announced, with its start time if it is known.
    Started(Option<i64>),
    /// It said goodbye, so the next announcement is that of another run.
    Ended,
}

type Registering = Pin<Box<dyn Future<Output = Result<Done, DiscoveryQueryFault>> + Send>>;

/// The outcome of a registration.
enum Done {
    /// The server is registered with this discovery server, if its identity is known.
    Registered(Option<Registrar>),
    /// No discovery server was reachable, so a discovery server was embedded.
    Embedded(Embedded),
}

impl Telling {
    async fn run(mut self, mut stopped: mpsc::Receiver<()>) {
        self.put();
        if self.settings.embed
            && let Some(lds) = self.settings.lds.clone()
        {
            drop(tokio::spawn(self.embedding(lds).prepare()));
        }
        let mut registering: Option<Registering> = None;
        loop {
            let due = registering.is_none() && self.settings.lds.is_some();
            let heard = async {
                match &mut self.mdns {
                    Some(mdns) => mdns.next().await,
                    None => std::future::pending().await,
                }
            };
            let registered = async {
                match &mut registering {
                    Some(registering) => registering.await,
                    None => std::future::pending().await,
                }
            };
            let gone = gone(&mut self.here, &mut self.there);
            let found = async {
                match &mut self.found {
                    Some(found) => found.changed().await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                _ = stopped.recv() => break,
                heard = heard => self.hear(heard),
                found = found => {
                    registering = None;
                    self.another(found.is_ok());
                }
                Ok(()) = self.server.changed() => {
                    self.put();
                    self.soon();
                    registering = None;
                }
                result = registered => {
                    registering = None;
                    self.registered(result);
                }
                () = gone => self.gone(),
                () = sleep_until(self.register_at), if due => registering = self.register(true),
            }
        }
        drop(registering);
        let goodbye = match (&mut self.mdns, &self.instance) {
            (Some(mdns), Some(instance)) => mdns.take_back(instance),
            _ => None,
        };
        let unregister = self.register(false);
        let goodbye = async {
            if let Some(goodbye) = goodbye {
                goodbye.await;
            }
        };
        let unregister = async {
            if let Some(unregister) = unregister
                && let Err(error) = unregister.await
            {
                debug!(%error, "cannot withdraw the registration");
            }
            if let Some(here) = self.here.take() {
                here.leave().await;
            }
        };
        tokio::join!(goodbye, unregister);
    }

    /// Announces the server by mDNS, and replaces the previous announcement.
    fn put(&mut self) {
        let server = self.server.borrow_and_update().clone();
        let Some(mdns) = &mut self.mdns else { return };
        let instance = match &self.instance {
            // The instance name is kept while it still matches the server.
            Some(known) if known.starts_with(&name(&server)) => known.clone(),
            _ => name(&server),
        };
        if let Some(before) = self.instance.take_if(|before| *before != instance) {
            drop(mdns.take_back(&before));
        }
        mdns.put(OwnAnnouncement {
            announcement: AnnouncedServer {
                instance: instance.clone(),
                url: server.url,
                capabilities: server.capabilities,
            },
            aside: Aside {
                start_time: Some(self.start_time),
                number: server.number,
            },
        });
        self.state.send_modify(|state| {
            state.announced.get_or_insert_with(clock::wall);
            state.mdns_name = Some(instance.clone());
        });
        self.instance = Some(instance);
    }

    fn hear(&mut self, heard: MdnsEvent) {
        match heard {
            MdnsEvent::Renamed { to, .. } => {
                self.state
                    .send_modify(|state| state.mdns_name = Some(to.clone()));
                self.instance = Some(to);
            }
            MdnsEvent::Announced {
                announcement,
                aside: Aside { start_time, .. },
            } => {
                let lds = self.settings.lds.as_deref();
                if lds.is_some_and(|lds| same_place(lds, &announcement.url)) {
                    // A discovery server that started or restarted has no registrations yet.
                    let before = self.lds_run.replace(AnnouncedRun::Started(start_time));
                    let is_registered = self.state.borrow().registered.is_some();
                    if !is_registered || before.is_some_and(|before| Some(before) != self.lds_run) {
                        self.soon();
                    }
                }
            }
            // Only the goodbyes of the discovery server are reported.
            MdnsEvent::Withdrawn { .. } => self.lds_run = Some(AnnouncedRun::Ended),
        }
    }

    /// Switches to another discovery server, or to none.
    fn another(&mut self, is_looked_for: bool) {
        self.settings.lds = match &mut self.found {
            Some(found) if is_looked_for => found.borrow_and_update().clone(),
            // The search ended, so the last discovery server stays.
            _ => {
                self.found = None;
                return;
            }
        };
        self.state.send_modify(|state| state.registered = None);
        self.lds_run = None;
        self.heed_lds();
        self.soon();
    }

    /// Follows the announcements of the discovery server.
    fn heed_lds(&mut self) {
        if let Some(mdns) = &mut self.mdns {
            mdns.heed(self.settings.lds.as_deref());
        }
    }

    /// Handles the loss of the embedded or external discovery server.
    fn gone(&mut self) {
        debug!(
            lds = self.settings.lds,
            "the connection to the discovery server failed"
        );
        let was_here = self.here.take().is_some();
        self.there = None;
        // A discovery server with too many clients may close the connection repeatedly.
        self.look_from = Instant::now() + spread(self.look_wait, &self.server.borrow().url);
        self.look_wait = (self.look_wait * 2).min(MOST_WAIT / 2);
        self.soon();
        if was_here {
            // An embedded discovery server that ended may end again.
            self.register_at += FIRST_WAIT;
        }
    }

    fn soon(&mut self) {
        self.register_at = Instant::now();
        self.wait = FIRST_WAIT;
    }

    fn register(&self, is_online: bool) -> Option<Registering> {
        let lds = self.settings.lds.clone()?;
        if !is_online && self.state.borrow().registered.is_none() {
            return None;
        }
        let server = self.server.borrow().clone();
        // The discovery server announces only servers that do not announce themselves.
        let mdns_name = self.mdns.is_none().then(|| name(&server));
        let interface = self.settings.mdns.clone();
        if let Some(here) = &self.here {
            let here = here.asking();
            return Some(Box::pin(async move {
                let server = reachable(server, &lds, interface.as_ref()).await;
                let registering = here.register(&server, mdns_name, is_online);
                registering.await.map(|()| Done::Registered(None))
            }));
        }
        let pki = self.settings.pki.clone();
        let embedding = self.embedding(lds.clone());
        let embed = self.settings.embed;
        Some(Box::pin(async move {
            if embed && same_port(&lds, &server.url) {
                let message =
                    format!("the server itself listens at {lds}; give it another endpoint");
                return Err(DiscoveryQueryFault::Embed(message));
            }
            let server = reachable(server, &lds, interface.as_ref()).await;
            let how = (mdns_name.as_deref(), pki.as_deref());
            match client::register(&lds, &server, how, is_online).await {
                Ok(registrar) => Ok(Done::Registered(registrar)),
                Err(DiscoveryQueryFault::Connect(absent)) if embed && is_online => {
                    embedding.start(absent).await.map(Done::Embedded)
                }
                Err(fault) => Err(fault),
            }
        }))
    }

    fn embedding(&self, lds: String) -> Embedding {
        let interface = self.settings.mdns.clone();
        Embedding {
            lds,
            interface: interface.unwrap_or(MdnsInterface::LOOPBACK),
            pki: self.settings.pki.clone(),
            name: self.server.borrow().name.clone(),
        }
    }

    /// Returns the interval of registrations. Without mDNS packets the restart of a discovery
    /// server is not noticed.
    fn register_every(&self) -> Duration {
        let every = self.settings.register_every;
        if self.mdns.as_ref().is_some_and(MdnsAnnouncer::receives) {
            every
        } else {
            every.min(MOST_UNHEARD)
        }
    }

    /// Registers again after a wait that grows.
    fn register_later(&mut self) {
        self.register_at = Instant::now() + spread(self.wait, &self.server.borrow().url);
        self.wait = (self.wait * 2).min(self.longest_wait());
    }

    /// Including the share of `spread`, the wait stays below its limit.
    fn longest_wait(&self) -> Duration {
        (MOST_WAIT / 2).min(self.register_every() / 2)
    }

    fn registered(&mut self, result: Result<Done, DiscoveryQueryFault>) {
        let lds = self.settings.lds.clone().unwrap_or_default();
        match result {
            Ok(Done::Embedded(here)) => {
                self.here = Some(here);
                self.there = None;
                self.look_wait = FIRST_WAIT;
                self.state.send_modify(|state| state.registered = None);
                self.soon();
            }
            Ok(Done::Registered(registrar)) => {
                // A busy discovery server may not describe itself in time. Until it does, it
                // cannot configure this server as its supervisor.
                let is_described = registrar.is_some() || self.here.is_some();
                if let Some(registrar) = registrar {
                    self.settings.supervision.registered_with(registrar);
                }
                if is_described || self.wait >= self.longest_wait() {
                    self.register_at = Instant::now() + self.register_every();
                    self.wait = FIRST_WAIT;
                } else {
                    self.register_later();
                }
                self.state.send_modify(|state| {
                    if state.registered.is_none() {
                        info!(lds, "registered");
                        state.registered = Some(clock::wall());
                    }
                    state.fault = None;
                });
                // A killed discovery server loses its registrations, and its announcement after the
                // restart may be lost.
                if self.here.is_none() && self.there.is_none() {
                    self.there = Some(Box::pin(lost(lds, self.look_from)));
                }
            }
            Err(error) => {
                self.look_wait = FIRST_WAIT;
                self.register_later();
                let fault = error.to_string();
                self.state.send_modify(|state| {
                    state.registered = None;
                    // A repeated fault is logged once.
                    if state.fault.as_ref() != Some(&fault) {
                        if matches!(
                            error,
                            DiscoveryQueryFault::Refused(_)
                                | DiscoveryQueryFault::Certificate(_)
                                | DiscoveryQueryFault::Embed(_)
                        ) {
                            warn!(lds, "cannot register at the discovery server: {fault}");
                        } else {
                            info!(lds, "not registered at the discovery server yet: {fault}");
                        }
                        state.fault = Some(fault);
                    }
                });
            }
        }
    }
}

/// Completes when the embedded or external discovery server is lost.
async fn gone(
    here: &mut Option<Embedded>,
    there: &mut Option<Pin<Box<dyn Future<Output = ()> + Send>>>,
) {
    match (here, there) {
        (Some(here), _) => here.ended().await,
        (None, Some(there)) => there.await,
        (None, None) => std::future::pending().await,
    }
}

/// Returns whether two URLs have the same host and port, so that only one program can listen.
fn same_port(one: &str, other: &str) -> bool {
    let place = |url| Url::parse(url).map(|url| (url.host, url.port));
    place(one).is_some_and(|one| place(other) == Some(one))
}

/// Returns the wait plus a share that depends on the URL. A discovery server does not answer all of
/// many simultaneous clients, and the share keeps them from retrying at the same time.
fn spread(wait: Duration, url: &str) -> Duration {
    wait + wait.mul_f64(registry::spread(url))
}

/// Returns the mDNS instance name of a server.
fn name(server: &ServerDescription) -> String {
    let place = Url::parse(&server.url);
    instance_name(
        &server.name,
        &host_name(),
        place.map_or(0, |place| place.port),
    )
}

const FIRST_WAIT: Duration = Duration::from_secs(1);
const MOST_UNHEARD: Duration = Duration::from_secs(10);
const MOST_WAIT: Duration = Duration::from_secs(60);
const LEAVE_LIMIT: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests;
