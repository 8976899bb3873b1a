//! Telling of a server: [`announce`].

use std::num::NonZeroU16;
use std::path::PathBuf;
use std::pin::Pin;
use std::time::{Duration, SystemTime};

use plant_opcua::enrolment::Applicant;
use plant_opcua::supervision::{Registrar, Supervision};
use registry::hierarchy::Choice;
use registry::{Announcement, instance_name};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{debug, info, warn};

use crate::address::reachable;
use crate::chosen::find_lds;
use crate::client::{self, AskFault};
use crate::clock;
use crate::embedded::{Embedded, Embedding, lost};
use mdns::Interface;
use mdns::Url;
use mdns::host_name;
use mdns::{Aside, Heard, Mdns, MdnsFault, Ours, same_place};

/// A server to tell of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Server {
    /// Its ApplicationUri.
    pub application_uri: String,
    /// Its ProductUri; may be empty.
    pub product_uri: String,
    /// Its ApplicationName, from which its name on the network is made with host and port behind it.
    pub name: String,
    /// Where it listens, as `opc.tcp://127.0.0.1:43121/`.
    pub url: String,
    /// Codes of OPC 10000-12, Annex D.
    pub capabilities: Vec<String>,
    /// Its number in the space, the namespace of what it produces there; `None` where it produces nothing.
    pub number: Option<NonZeroU16>,
}

impl Server {
    /// Describes the server to a Global Discovery Server, with these DiscoveryUrls beside its own.
    #[must_use]
    pub fn applicant(&self, urls: impl IntoIterator<Item = String>) -> Applicant {
        let mut all = vec![self.url.clone()];
        for url in urls {
            if !all.contains(&url) {
                all.push(url);
            }
        }
        Applicant {
            application_uri: self.application_uri.clone(),
            name: self.name.clone(),
            product_uri: self.product_uri.clone(),
            urls: all,
            capabilities: self.capabilities.clone(),
        }
    }
}

/// To whom a server is told of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AnnounceSettings {
    /// The Local Discovery Server to register with; `None` for none. Its URL, or which of those it is that are heard of by
    /// mDNS, as a [`Choice`] is written: `any`, `uri=urn:cell:*`, `name=cell-lds`.
    pub lds: Option<String>,
    /// Whether the program is that discovery server itself while nobody else is. To be true with a URL of this host alone.
    pub embed: bool,
    /// Where it is announced by mDNS; `None` for nowhere: then the Local Discovery Server is asked to do it.
    pub mdns: Option<Interface>,
    /// How often the registration is repeated; every ten seconds at least where nothing is heard by mDNS.
    pub register_every: Duration,
    /// The certificate store of the server, with its pair made: it registers over a secured channel where the discovery
    /// server offers one and is trusted. `None` registers over channels that are not secured, which most discovery servers
    /// take from their own host at best.
    pub pki: Option<PathBuf>,
    /// Is told which discovery server the server is registered with.
    pub supervision: Supervision,
}

impl Default for AnnounceSettings {
    fn default() -> Self {
        Self {
            lds: Some(crate::DEFAULT_LDS.to_owned()),
            embed: false,
            mdns: Some(Interface::LOOPBACK),
            register_every: Duration::from_secs(60),
            pki: None,
            supervision: Supervision::default(),
        }
    }
}

impl AnnounceSettings {
    /// With the discovery server as programs take it by `--lds`: `embed` is that of this host, which the program is itself while
    /// there is none; `embed=URL` the same at another port or address of this host; all else is as [`lds`](Self::lds) is.
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

/// How far the telling has come.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AnnounceState {
    /// When it was registered, for the first time since it was not.
    pub registered: Option<SystemTime>,
    /// When it was announced first.
    pub announced: Option<SystemTime>,
    /// Its name on the network.
    pub mdns_name: Option<String>,
    /// Why it is not registered.
    pub fault: Option<String>,
}

/// Tells of a server for as long as it is kept.
#[derive(Debug)]
pub struct Announced {
    server: watch::Sender<Server>,
    state: watch::Receiver<AnnounceState>,
    /// Closed, it ends the telling.
    stop: mpsc::Sender<()>,
    task: JoinHandle<()>,
}

impl Announced {
    /// The server is another from now on: what has changed is told.
    pub fn update(&self, server: Server) {
        self.server.send_if_modified(|known| {
            let changed = *known != server;
            *known = server;
            changed
        });
    }

    /// How far it has come.
    #[must_use]
    pub fn state(&self) -> AnnounceState {
        self.state.borrow().clone()
    }

    /// Says goodbye and takes the registration back; waits for that for a second at most. To be called before the server
    /// ends. Whoever drops it instead has the same done without waiting.
    pub async fn leave(self) {
        let Self { stop, task, .. } = self;
        drop(stop);
        // Late or broken off: others find out by themselves.
        drop(timeout(LEAVE_LIMIT, task).await);
    }
}

/// Starts to tell of a server. Needs a tokio runtime, and waits for nothing: a discovery server may come later.
///
/// # Errors
/// No mDNS daemon can be started.
pub fn announce(server: Server, settings: AnnounceSettings) -> Result<Announced, MdnsFault> {
    let mdns = settings.mdns.as_ref().map(Mdns::open).transpose()?;
    let register_every = match mdns {
        Some(_) => settings.register_every,
        // It does not hear of a discovery server that starts anew.
        None => settings.register_every.min(MOST_UNHEARD),
    };
    let settings = AnnounceSettings {
        register_every,
        ..settings
    };
    let (settings, found) = found(settings)?;
    let (sender, changes) = watch::channel(server);
    let (tell, state) = watch::channel(AnnounceState::default());
    let (stop, stopped) = mpsc::channel(1);
    let telling = Telling {
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
    let task = tokio::spawn(telling.run(stopped));
    Ok(Announced {
        server: sender,
        state,
        stop,
        task,
    })
}

/// Which discovery server is found, where one is looked for.
type Looked = Option<watch::Receiver<Option<String>>>;

/// Looks for the discovery server where it is not said by its URL.
fn found(settings: AnnounceSettings) -> Result<(AnnounceSettings, Looked), MdnsFault> {
    let choice = settings.lds.as_deref().map(str::parse::<Choice>);
    match (choice, &settings.mdns) {
        (Some(Ok(choice)), Some(interface)) if !matches!(choice, Choice::At(_)) => {
            let found = find_lds(choice, interface, None)?;
            let settings = AnnounceSettings {
                lds: None,
                ..settings
            };
            Ok((settings, Some(found)))
        }
        // What is no URL is told when it is tried.
        _ => Ok((settings, None)),
    }
}

struct Telling {
    settings: AnnounceSettings,
    mdns: Option<Mdns>,
    /// The discovery server, where it is looked for.
    found: Looked,
    server: watch::Receiver<Server>,
    state: watch::Sender<AnnounceState>,
    start_time: i64,
    /// The name it is announced under.
    instance: Option<String>,
    /// Which run of the discovery server was heard.
    lds_run: Option<Option<i64>>,
    register_at: Instant,
    wait: Duration,
    /// The discovery server, where it is embedded.
    here: Option<Embedded>,
    /// Ready when the connection to the discovery server of another program breaks off. The server registers again then, or
    /// embeds a discovery server.
    there: Option<Pin<Box<dyn Future<Output = ()> + Send>>>,
    /// When a connection to that one may be held next.
    look_from: Instant,
    /// How much later than it broke off.
    look_wait: Duration,
}

type Registering = Pin<Box<dyn Future<Output = Result<Done, AskFault>> + Send>>;

/// What came of a registration.
enum Done {
    /// With this discovery server, where it says who it is.
    Registered(Option<Registrar>),
    /// Nobody was there: a discovery server is embedded now.
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
                debug!(%error, "the registration was not taken back");
            }
            if let Some(here) = self.here.take() {
                here.leave().await;
            }
        };
        tokio::join!(goodbye, unregister);
    }

    /// Announces the server by mDNS, in the place of what it was.
    fn put(&mut self) {
        let server = self.server.borrow_and_update().clone();
        let Some(mdns) = &mut self.mdns else { return };
        let instance = match &self.instance {
            // The name stays while it is still true.
            Some(known) if known.starts_with(&name(&server)) => known.clone(),
            _ => name(&server),
        };
        if let Some(before) = self.instance.take_if(|before| *before != instance) {
            drop(mdns.take_back(&before));
        }
        mdns.put(Ours {
            announcement: Announcement {
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

    fn hear(&mut self, heard: Heard) {
        match heard {
            Heard::Renamed { to, .. } => {
                self.state
                    .send_modify(|state| state.mdns_name = Some(to.clone()));
                self.instance = Some(to);
            }
            Heard::Announced {
                announcement,
                aside: Aside { start_time, .. },
            } => {
                let lds = self.settings.lds.as_deref();
                if lds.is_some_and(|lds| same_place(lds, &announcement.url)) {
                    // One that has just come, or come back, knows nobody yet.
                    let before = self.lds_run.replace(start_time);
                    let is_registered = self.state.borrow().registered.is_some();
                    if !is_registered || before.is_some_and(|before| before != start_time) {
                        self.soon();
                    }
                }
            }
            Heard::Withdrawn { .. } => {}
        }
    }

    /// The discovery server is another from now on, or none.
    fn another(&mut self, is_looked_for: bool) {
        self.settings.lds = match &mut self.found {
            Some(found) if is_looked_for => found.borrow_and_update().clone(),
            // Nobody looks any more: it stays as it is.
            _ => {
                self.found = None;
                return;
            }
        };
        self.state.send_modify(|state| state.registered = None);
        self.lds_run = None;
        self.soon();
    }

    /// The discovery server is not there any more, be it here or there.
    fn gone(&mut self) {
        debug!(lds = self.settings.lds, "the discovery server broke off");
        let was_here = self.here.take().is_some();
        self.there = None;
        // One with too many clients breaks off again and again.
        self.look_from = Instant::now() + spread(self.look_wait, &self.server.borrow().url);
        self.look_wait = (self.look_wait * 2).min(MOST_WAIT / 2);
        self.soon();
        if was_here {
            // What ends by itself may do so again.
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
        // Whoever announces itself is not announced by another.
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
                let message = format!("the server itself is at {lds}; give it another endpoint");
                return Err(AskFault::Embed(message));
            }
            let server = reachable(server, &lds, interface.as_ref()).await;
            let how = (mdns_name.as_deref(), pki.as_deref());
            match client::register(&lds, &server, how, is_online).await {
                Ok(registrar) => Ok(Done::Registered(registrar)),
                Err(AskFault::Connect(absent)) if embed && is_online => {
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
            interface: interface.unwrap_or(Interface::LOOPBACK),
            pki: self.settings.pki.clone(),
            name: self.server.borrow().name.clone(),
        }
    }

    fn registered(&mut self, result: Result<Done, AskFault>) {
        let lds = self.settings.lds.as_deref().unwrap_or_default();
        match result {
            Ok(Done::Embedded(here)) => {
                self.here = Some(here);
                self.there = None;
                self.look_wait = FIRST_WAIT;
                self.state.send_modify(|state| state.registered = None);
                self.soon();
            }
            Ok(Done::Registered(registrar)) => {
                if let Some(registrar) = registrar {
                    self.settings.supervision.registered_with(registrar);
                }
                self.register_at = Instant::now() + self.settings.register_every;
                self.wait = FIRST_WAIT;
                self.state.send_modify(|state| {
                    if state.registered.is_none() {
                        info!(lds, "registered");
                        state.registered = Some(clock::wall());
                    }
                    state.fault = None;
                });
                // A discovery server that is killed and restarted has lost its registrations, and its announcement may be lost.
                if self.here.is_none() && self.there.is_none() {
                    self.there = Some(Box::pin(lost(lds.to_owned(), self.look_from)));
                }
            }
            Err(error) => {
                self.look_wait = FIRST_WAIT;
                self.register_at = Instant::now() + spread(self.wait, &self.server.borrow().url);
                // With its share it is no longer than what may be waited at most.
                self.wait = (self.wait * 2)
                    .min(MOST_WAIT / 2)
                    .min(self.settings.register_every / 2);
                let fault = error.to_string();
                self.state.send_modify(|state| {
                    state.registered = None;
                    // Once for each reason: it is tried again and again.
                    if state.fault.as_ref() != Some(&fault) {
                        if matches!(
                            error,
                            AskFault::Refused(_) | AskFault::Certificate(_) | AskFault::Embed(_)
                        ) {
                            warn!(lds, "not registered: {fault}");
                        } else {
                            info!(lds, "not registered yet: {fault}");
                        }
                        state.fault = Some(fault);
                    }
                });
            }
        }
    }
}

/// Ready when the discovery server is gone, in this program or in another.
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

/// Whether only one of two programs can listen.
fn same_port(one: &str, other: &str) -> bool {
    let place = |url| Url::parse(url).map(|url| (url.host, url.port));
    place(one).is_some_and(|one| place(other) == Some(one))
}

/// That wait, and a share of it that is another for each URL: of many who come at once not all are answered, and they do not
/// come at once again.
fn spread(wait: Duration, url: &str) -> Duration {
    wait + wait.mul_f64(registry::spread(url))
}

/// Its name on the network.
fn name(server: &Server) -> String {
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
mod tests {
    use super::*;

    #[test]
    fn a_discovery_server_is_embedded_where_the_option_says_so() {
        let written = |text: &str| {
            let settings = AnnounceSettings::registering(Some(text));
            (settings.lds.unwrap_or_default(), settings.embed)
        };
        let elsewhere = "opc.tcp://10.0.0.2:4841";
        assert_eq!(written("embed"), (crate::DEFAULT_LDS.to_owned(), true));
        assert_eq!(
            written(&format!("embed={elsewhere}")),
            (elsewhere.to_owned(), true)
        );
        for text in [elsewhere, "any", "name=embed", "embedded"] {
            assert_eq!(written(text), (text.to_owned(), false));
        }
        assert_eq!(AnnounceSettings::registering(None).lds, None);
        assert!(same_port(elsewhere, "opc.tcp://10.0.0.2:4841/server"));
        assert!(!same_port(elsewhere, "opc.tcp://10.0.0.2:4840/server"));
    }

    #[test]
    fn five_hundred_servers_that_failed_at_once_come_again_one_after_the_other_and_nobody_too_soon()
    {
        let urls = (0..500).map(|number| format!("opc.tcp://127.0.0.1:{}/", 40_000 + number));
        let waits: Vec<Duration> = urls.map(|url| spread(FIRST_WAIT, &url)).collect();
        let too_soon = waits.iter().filter(|wait| **wait < FIRST_WAIT);
        assert_eq!(too_soon.count(), 0, "{waits:?}");
        let too_late = waits.iter().filter(|wait| **wait > FIRST_WAIT * 2);
        assert_eq!(too_late.count(), 0, "{waits:?}");
        for tenth in 1..10 {
            let from = FIRST_WAIT + FIRST_WAIT / 10 * tenth;
            let within = from..from + FIRST_WAIT / 10;
            let at_once = waits.iter().filter(|wait| within.contains(wait)).count();
            assert!(at_once < 150, "{at_once} in {within:?}");
        }
    }
}
