//! Who is there, for a program: [`watch`].

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::num::NonZeroU16;
use std::time::{Duration, SystemTime};

use registry::{Announcement, Event, Loss, Settings};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use crate::client;
use crate::clock;
use crate::keeper::Keeper;
use mdns::Interface;
use mdns::Url;
use mdns::{Mdns, MdnsFault, same_place};

/// How servers are watched.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WatchSettings {
    /// Where announcements are heard; `None` hears none.
    pub mdns: Option<Interface>,
    /// How often each endpoint is tried.
    pub probe_every: Duration,
    /// How long one that gives no answer at all still counts as there.
    pub lost_after: Duration,
}

impl Default for WatchSettings {
    fn default() -> Self {
        let settings = Settings::default();
        Self {
            mdns: Some(Interface::LOOPBACK),
            probe_every: settings.probe_every,
            lost_after: settings.lost_after,
        }
    }
}

/// A server that is there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Known {
    /// By which it is told apart from all others, for as long as it is there: its mDNS instance name.
    pub name: String,
    /// Where it is.
    pub url: String,
    /// Codes of OPC 10000-12, Annex D.
    pub capabilities: Vec<String>,
    /// Its ApplicationUri as it says itself; `None` where it does not.
    pub application_uri: Option<String>,
    /// Since when it is there.
    pub since: SystemTime,
    /// When its program started, where it tells: by mDNS, or as the StartTime of its ServerStatus.
    pub started: Option<SystemTime>,
    /// Its number in the space, the namespace of what it produces there, where it tells.
    pub number: Option<NonZeroU16>,
}

impl Known {
    /// Whether it is a Local Discovery Server, which has nothing of its own.
    #[must_use]
    pub fn is_lds(&self) -> bool {
        self.capabilities
            .iter()
            .any(|code| code.eq_ignore_ascii_case("LDS"))
    }
}

/// What has happened to a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Found {
    /// It is there; or it was, and says something else of itself.
    Seen(Known),
    /// It is another run of the program: what was known of its inside is void.
    Restarted(Known),
    /// It is no longer there.
    Gone {
        /// What was known of it.
        known: Known,
        /// How that is known.
        loss: Loss,
    },
}

impl Found {
    /// The server.
    #[must_use]
    pub fn known(&self) -> &Known {
        match self {
            Self::Seen(known) | Self::Restarted(known) | Self::Gone { known, .. } => known,
        }
    }
}

/// Hears of servers for as long as it is kept.
#[derive(Debug)]
pub struct Watcher(mpsc::Receiver<Found>);

impl Watcher {
    /// What has happened next. `None` only when the runtime ends. Whoever is slow misses no server, but is told only what
    /// it came to at last.
    pub async fn next(&mut self) -> Option<Found> {
        self.0.recv().await
    }
}

/// Starts to hear of servers. Needs a tokio runtime, and waits for nothing.
///
/// # Errors
/// No mDNS daemon can be started.
pub fn watch(settings: WatchSettings) -> Result<Watcher, MdnsFault> {
    let mdns = settings.mdns.as_ref().map(Mdns::open).transpose()?;
    let registry = Settings {
        probe_every: settings.probe_every,
        lost_after: settings.lost_after,
        ..Settings::default()
    };
    let (tell, found) = mpsc::channel(16);
    let watching = Watching {
        keeper: Keeper::new(registry, mdns, None),
        servers: Servers::default(),
        asking: JoinSet::new(),
        ask: VecDeque::new(),
        ask_later: BTreeSet::new(),
    };
    tokio::spawn(watching.run(tell));
    Ok(Watcher(found))
}

struct Watching {
    keeper: Keeper,
    servers: Servers,
    /// Who is asked for its ApplicationUri.
    asking: JoinSet<(String, Option<String>)>,
    /// Who is asked next.
    ask: VecDeque<String>,
    /// Who is asked once a probe was answered: earlier probes failed, or too many servers appeared at once.
    ask_later: BTreeSet<String>,
}

impl Watching {
    async fn run(mut self, tell: mpsc::Sender<Found>) {
        loop {
            tokio::select! {
                permit = tell.reserve(), if !self.servers.outbox.is_empty() => {
                    let Ok(permit) = permit else { return };
                    if let Some(found) = self.servers.next() {
                        permit.send(found);
                    }
                    continue;
                }
                () = tell.closed() => return,
                () = self.keeper.step() => {}
                Some(asked) = self.asking.join_next(), if !self.asking.is_empty() => {
                    if let Ok((url, uri)) = asked {
                        self.servers.answered(&url, uri);
                    }
                }
            }
            while let Some(event) = self.keeper.event() {
                self.take(event);
            }
            for (url, started) in self.keeper.take_started() {
                self.servers.started(&url, clock::of_ticks(started));
            }
            self.ask_answering();
            while self.asking.len() < MOST_ASKED
                && let Some(url) = self.ask.pop_front()
            {
                // Many forged names appear and go before it is their turn.
                if self.keeper.registry.watches(&url) {
                    self.asking.spawn(application_uri(url));
                }
            }
        }
    }

    /// Asks a server who it is, now or when it answers probes.
    fn ask(&mut self, url: String) {
        let is_paused = self.keeper.registry.is_paused(&url, clock::now());
        if !is_paused && self.ask.len() < MOST_WAITING {
            self.ask.push_back(url);
        } else if self.ask_later.len() < MOST_LATER {
            self.ask_later.insert(url);
        }
    }

    fn ask_answering(&mut self) {
        let registry = &self.keeper.registry;
        if self.ask_later.is_empty() {
            return;
        }
        let ask = &mut self.ask;
        self.ask_later.retain(|url| {
            let answers = registry.has_answered(url);
            if answers {
                ask.push_back(url.clone());
            }
            !answers && registry.watches(url)
        });
    }

    #[expect(clippy::wildcard_enum_match_arm, reason = "nobody registers here")]
    fn take(&mut self, event: Event) {
        match event {
            Event::Seen(record) => {
                let url = record.announcement.url.clone();
                if let Some(ask) = self.servers.seen(record.announcement, clock::wall()) {
                    self.ask(ask);
                }
                self.servers.numbered(&url, self.keeper.number(&url));
                if let Some(started) = self.keeper.started(&url) {
                    self.servers.started(&url, clock::of_ticks(started));
                }
            }
            Event::Vanished { record, loss } => {
                self.servers.vanished(&record.announcement.instance, loss);
            }
            Event::Restarted { url } => {
                let started = self.keeper.started(&url).map(clock::of_ticks);
                self.servers.restarted(&url, started);
            }
            _ => {}
        }
    }
}

/// What a server says it is, if it says it in time.
async fn application_uri(url: String) -> (String, Option<String>) {
    let found = client::find_servers(&url, ASK_LIMIT)
        .await
        .unwrap_or_default();
    let port = Url::parse(&url).map(|url| url.port);
    let of_port = |application: &&client::Application| {
        let ports = application
            .discovery_urls
            .iter()
            .filter_map(|url| Url::parse(url));
        ports.map(|url| Some(url.port)).any(|its| its == port)
    };
    let own = found.iter().find(of_port).or_else(|| found.first());
    let uri = own.map(|application| application.application_uri.clone());
    (url, uri.filter(|uri| !uri.is_empty()))
}

const MOST_ASKED: usize = 32;
const MOST_WAITING: usize = 256;
const MOST_LATER: usize = 1024;
const ASK_LIMIT: Duration = Duration::from_millis(500);

/// The servers that are there, and what their reader is still to be told.
#[derive(Debug, Default)]
struct Servers {
    known: BTreeMap<String, Server>,
    /// Whom the reader believes to be there.
    told: BTreeSet<String>,
    outbox: VecDeque<Found>,
}

#[derive(Debug)]
struct Server {
    known: Known,
    /// The mDNS instances it is announced as: a discovery server may announce it, too.
    instances: BTreeSet<String>,
    /// Whether it has been asked who it is.
    asked: bool,
}

impl Servers {
    /// Takes in a new or changed record. Gives the URL to ask who it is.
    fn seen(&mut self, announcement: Announcement, since: SystemTime) -> Option<String> {
        let Announcement {
            instance,
            url,
            capabilities,
        } = announcement;
        if let Some((name, server)) = self.of_instance(&instance) {
            if same_place(&server.known.url, &url) {
                server.known.capabilities = capabilities;
                let known = server.known.clone();
                if server.asked {
                    self.push(Found::Seen(known));
                }
                return None;
            }
            if server.instances.len() == 1 {
                server.known.url.clone_from(&url);
                server.known.capabilities = capabilities;
                server.asked = false;
                return Some(url);
            }
            server.instances.remove(&instance);
            if name == instance {
                self.renamed(&name);
            }
        }
        if let Some((_, server)) = self.of_url(&url) {
            server.instances.insert(instance);
            return None;
        }
        // Whoever was called so has lost that name since.
        self.renamed(&instance);
        let name = match self.known.contains_key(&instance) {
            true => format!("{instance} at {url}"),
            false => instance.clone(),
        };
        let known = Known {
            name: name.clone(),
            url: url.clone(),
            capabilities,
            application_uri: None,
            since,
            started: None,
            number: None,
        };
        let server = Server {
            known,
            instances: BTreeSet::from([instance]),
            asked: false,
        };
        self.known.insert(name, server);
        Some(url)
    }

    /// A server has lost its name to another that is called so, too: it is there under another of its names from now on.
    fn renamed(&mut self, name: &str) {
        let Some(mut server) = self.known.remove(name) else {
            return;
        };
        let before = server.known.clone();
        if let Some(other) = server.instances.first() {
            server.known.name.clone_from(other);
        }
        let (after, asked) = (server.known.clone(), server.asked);
        self.known.insert(after.name.clone(), server);
        self.push(Found::Gone {
            known: before,
            loss: Loss::Goodbye,
        });
        if asked {
            self.push(Found::Seen(after));
        }
    }

    /// A server has said who it is, or has not.
    fn answered(&mut self, url: &str, application_uri: Option<String>) {
        if let Some((_, server)) = self.of_url(url) {
            server.known.application_uri = application_uri;
            server.asked = true;
            let known = server.known.clone();
            self.push(Found::Seen(known));
        }
    }

    fn vanished(&mut self, instance: &str, loss: Loss) {
        let Some((name, server)) = self.of_instance(instance) else {
            return;
        };
        server.instances.remove(instance);
        if server.instances.is_empty()
            && let Some(server) = self.known.remove(&name)
        {
            let known = server.known;
            self.push(Found::Gone { known, loss });
        }
    }

    /// What number a server has in the space is known, or that it has none.
    fn numbered(&mut self, url: &str, number: Option<NonZeroU16>) {
        if let Some((_, server)) = self.of_url(url)
            && std::mem::replace(&mut server.known.number, number) != number
            && server.asked
        {
            let known = server.known.clone();
            self.push(Found::Seen(known));
        }
    }

    /// When a server started is known.
    fn started(&mut self, url: &str, at: SystemTime) {
        if let Some((_, server)) = self.of_url(url)
            && server.known.started.replace(at) != Some(at)
            && server.asked
        {
            let known = server.known.clone();
            self.push(Found::Seen(known));
        }
    }

    fn restarted(&mut self, url: &str, at: Option<SystemTime>) {
        if let Some((_, server)) = self.of_url(url) {
            server.known.started = at.or(server.known.started);
            let known = server.known.clone();
            if server.asked {
                self.push(Found::Restarted(known));
            }
        }
    }

    fn of_instance(&mut self, instance: &str) -> Option<(String, &mut Server)> {
        let mut all = self.known.iter_mut();
        let (name, server) = all.find(|(_, server)| server.instances.contains(instance))?;
        Some((name.clone(), server))
    }

    fn of_url(&mut self, url: &str) -> Option<(String, &mut Server)> {
        let mut all = self.known.iter_mut();
        let (name, server) = all.find(|(_, server)| same_place(&server.known.url, url))?;
        Some((name.clone(), server))
    }

    /// Has the reader told, in the place of what it has not been told yet of the same server.
    fn push(&mut self, found: Found) {
        let name = found.known().name.clone();
        let of_it = |waiting: &Found| waiting.known().name == name;
        let went = self
            .outbox
            .iter()
            .find(|waiting| of_it(waiting) && matches!(waiting, Found::Gone { .. }));
        let went = went.cloned();
        self.outbox.retain(|waiting| !of_it(waiting));
        let told = self.told.contains(&name);
        match found {
            Found::Gone { .. } if told => self.outbox.push_back(found),
            // It came and went while nobody looked.
            Found::Gone { .. } => {}
            Found::Seen(known) | Found::Restarted(known) if !told || went.is_some() => {
                self.outbox.extend(went);
                self.outbox.push_back(Found::Seen(known));
            }
            Found::Seen(_) | Found::Restarted(_) => self.outbox.push_back(found),
        }
    }

    fn next(&mut self) -> Option<Found> {
        let found = self.outbox.pop_front()?;
        match &found {
            Found::Gone { known, .. } => self.told.remove(&known.name),
            Found::Seen(known) | Found::Restarted(known) => self.told.insert(known.name.clone()),
        };
        Some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robot(instance: &str, port: u16) -> Announcement {
        Announcement {
            instance: instance.to_owned(),
            url: format!("opc.tcp://127.0.0.1:{port}/"),
            capabilities: Vec::new(),
        }
    }

    fn told(servers: &mut Servers) -> Vec<String> {
        let next = std::iter::from_fn(|| servers.next());
        next.map(|found| {
            let what = match &found {
                Found::Seen(_) => "seen",
                Found::Restarted(_) => "restarted",
                Found::Gone { .. } => "gone",
            };
            format!("{what} {}", found.known().name)
        })
        .collect()
    }

    /// A server that is there and has said who it is.
    fn seen(servers: &mut Servers, announcement: Announcement) {
        let url = announcement.url.clone();
        if servers.seen(announcement, SystemTime::UNIX_EPOCH).is_some() {
            servers.answered(&url, Some("urn:robot".to_owned()));
        }
    }

    #[test]
    fn a_server_that_two_announce_is_one_and_there_until_both_take_it_back() {
        let mut servers = Servers::default();
        seen(&mut servers, robot("arm", 1));
        seen(&mut servers, robot("arm of the discovery server", 1));
        assert_eq!(told(&mut servers), ["seen arm"]);
        servers.vanished("arm", Loss::Goodbye);
        assert!(told(&mut servers).is_empty());
        servers.vanished("arm of the discovery server", Loss::Goodbye);
        assert_eq!(told(&mut servers), ["gone arm"]);
    }

    #[test]
    fn a_slow_reader_is_told_what_it_came_to() {
        let mut servers = Servers::default();
        seen(&mut servers, robot("brief", 2));
        servers.vanished("brief", Loss::Unreachable);
        assert!(told(&mut servers).is_empty(), "it came and went meanwhile");
        seen(&mut servers, robot("arm", 1));
        assert_eq!(told(&mut servers), ["seen arm"]);
        servers.restarted("opc.tcp://127.0.0.1:1/", None);
        servers.vanished("arm", Loss::Unreachable);
        seen(&mut servers, robot("arm", 1));
        servers.restarted("opc.tcp://127.0.0.1:1/", None);
        assert_eq!(
            told(&mut servers),
            ["gone arm", "seen arm"],
            "the end of the one before is not passed over"
        );
    }

    #[test]
    fn a_server_that_gave_its_name_away_is_there_under_the_one_it_took() {
        let mut servers = Servers::default();
        // Two have one name: what is heard of them is one that moves.
        seen(&mut servers, robot("arm", 2));
        seen(&mut servers, robot("arm (2)", 2));
        assert_eq!(told(&mut servers), ["seen arm"]);
        seen(&mut servers, robot("arm", 1));
        assert_eq!(told(&mut servers), ["seen arm (2)", "gone arm", "seen arm"]);
        servers.vanished("arm", Loss::Goodbye);
        servers.vanished("arm (2)", Loss::Goodbye);
        assert_eq!(told(&mut servers), ["gone arm", "gone arm (2)"]);
    }

    #[test]
    fn a_name_that_was_taken_back_is_free_for_another() {
        let mut servers = Servers::default();
        seen(&mut servers, robot("arm", 2));
        seen(&mut servers, robot("arm (2)", 2));
        servers.vanished("arm", Loss::Goodbye);
        assert_eq!(told(&mut servers), ["seen arm"]);
        seen(&mut servers, robot("arm", 1));
        assert_eq!(told(&mut servers), ["seen arm (2)", "gone arm", "seen arm"]);
    }

    #[test]
    fn a_server_that_moves_keeps_its_name() {
        let mut servers = Servers::default();
        seen(&mut servers, robot("arm", 1));
        seen(&mut servers, robot("arm", 2));
        let last = std::iter::from_fn(|| servers.next()).last().unwrap();
        assert_eq!(last.known().url, "opc.tcp://127.0.0.1:2/");
        assert_eq!(servers.known.len(), 1);
    }
}
