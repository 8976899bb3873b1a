//! Reports the servers of a network to a program: [`watch`].

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::num::NonZeroU16;
use std::time::{Duration, SystemTime};

use registry::{AnnouncedServer, RegistryEvent, RegistrySettings, ServerLoss};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use crate::client;
use crate::clock;
use crate::keeper::{Keeper, is_lds};
use mdns::MdnsInterface;
use mdns::Url;
use mdns::{Mdns, MdnsFault, same_place};

/// The settings of a watcher.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WatchSettings {
    /// The interface for mDNS; `None` for no mDNS.
    pub mdns: Option<MdnsInterface>,
    /// The interval of probes of each endpoint.
    pub probe_every: Duration,
    /// The time without any answer after which a server is lost.
    pub lost_after: Duration,
    /// Whether only discovery servers are watched. Others are neither probed nor queried, so that
    /// a hundred programs that look for a discovery server do not connect to each other.
    pub lds_only: bool,
}

impl Default for WatchSettings {
    fn default() -> Self {
        let settings = RegistrySettings::default();
        Self {
            mdns: Some(MdnsInterface::LOOPBACK),
            probe_every: settings.probe_every,
            lost_after: settings.lost_after,
            lds_only: false,
        }
    }
}

/// A server that is present.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PresentServer {
    /// The mDNS instance name, which is unique while the server is present.
    pub name: String,
    /// The URL.
    pub url: String,
    /// The server capabilities: codes of OPC 10000-12, Annex D.
    pub capabilities: Vec<String>,
    /// The ApplicationUri that the server reports; `None` if it does not answer.
    pub application_uri: Option<String>,
    /// The time at which it appeared.
    pub since: SystemTime,
    /// The start time of its program, if known: from mDNS, or the StartTime of its ServerStatus.
    pub started: Option<SystemTime>,
    /// The number of the server in the space, which is the namespace of its publications, if
    /// announced.
    pub number: Option<NonZeroU16>,
}

impl PresentServer {
    /// Returns whether the server is a Local Discovery Server, which has no functions of its own.
    #[must_use]
    pub fn is_lds(&self) -> bool {
        is_lds(&self.capabilities)
    }
}

/// A change of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServerChange {
    /// The server appeared, or its description changed.
    Seen(PresentServer),
    /// The program restarted: cached data of the server is invalid.
    Restarted(PresentServer),
    /// The server was lost.
    Gone {
        /// The last description of the server.
        known: PresentServer,
        /// The detected cause of the loss.
        loss: ServerLoss,
    },
}

impl ServerChange {
    /// Returns the server.
    #[must_use]
    pub fn known(&self) -> &PresentServer {
        match self {
            Self::Seen(known) | Self::Restarted(known) | Self::Gone { known, .. } => known,
        }
    }
}

/// Receives changes of servers until this value is dropped.
#[derive(Debug)]
pub struct ServerWatcher(mpsc::Receiver<ServerChange>);

impl ServerWatcher {
    /// Waits for the next change. `None` only when the runtime ends. A slow reader receives only
    /// the last of several changes of a server, and misses no server.
    pub async fn next(&mut self) -> Option<ServerChange> {
        self.0.recv().await
    }
}

/// Starts to watch servers. Requires a tokio runtime, and returns at once.
///
/// # Errors
/// Returns an error if the mDNS daemon cannot be started.
pub fn watch(settings: WatchSettings) -> Result<ServerWatcher, MdnsFault> {
    let mdns = settings.mdns.as_ref().map(Mdns::open).transpose()?;
    let registry = RegistrySettings {
        probe_every: settings.probe_every,
        lost_after: settings.lost_after,
        ..RegistrySettings::default()
    };
    let (tell, found) = mpsc::channel(16);
    let watching = Watching {
        keeper: Keeper::new(registry, mdns, None).lds_only(settings.lds_only),
        servers: Servers::default(),
        asking: JoinSet::new(),
        ask: VecDeque::new(),
        ask_later: BTreeSet::new(),
    };
    tokio::spawn(watching.run(tell));
    Ok(ServerWatcher(found))
}

struct Watching {
    keeper: Keeper,
    servers: Servers,
    /// The running queries for ApplicationUris.
    asking: JoinSet<(String, Option<String>)>,
    /// The URLs to query next.
    ask: VecDeque<String>,
    /// The URLs to query after an answered probe: earlier probes failed, or too many servers
    /// appeared at the same time.
    ask_later: BTreeSet<String>,
}

impl Watching {
    async fn run(mut self, tell: mpsc::Sender<ServerChange>) {
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
                // Many forged names may appear and disappear before their turn.
                if self.keeper.registry.watches(&url) {
                    self.asking.spawn(application_uri(url));
                }
            }
        }
    }

    /// Queries the ApplicationUri of a server, at once or after an answered probe.
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
    fn take(&mut self, event: RegistryEvent) {
        match event {
            RegistryEvent::Seen(record) => {
                let url = record.announcement.url.clone();
                if let Some(ask) = self.servers.seen(record.announcement, clock::wall()) {
                    self.ask(ask);
                }
                self.servers.numbered(&url, self.keeper.number(&url));
                if let Some(started) = self.keeper.started(&url) {
                    self.servers.started(&url, clock::of_ticks(started));
                }
            }
            RegistryEvent::Vanished { record, loss } => {
                self.servers.vanished(&record.announcement.instance, loss);
            }
            RegistryEvent::Restarted { url } => {
                let started = self.keeper.started(&url).map(clock::of_ticks);
                self.servers.restarted(&url, started);
            }
            _ => {}
        }
    }
}

/// Returns the ApplicationUri that a server reports, if it answers in time.
async fn application_uri(url: String) -> (String, Option<String>) {
    let found = client::find_servers(&url, ASK_LIMIT)
        .await
        .unwrap_or_default();
    let port = Url::parse(&url).map(|url| url.port);
    let of_port = |application: &&client::FoundServer| {
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

/// The servers that are present, and the pending changes for the reader.
#[derive(Debug, Default)]
struct Servers {
    known: BTreeMap<String, Server>,
    /// The names of the servers that are present for the reader.
    told: BTreeSet<String>,
    outbox: VecDeque<ServerChange>,
}

#[derive(Debug)]
struct Server {
    known: PresentServer,
    /// The mDNS instances of the server: a discovery server may announce it too.
    instances: BTreeSet<String>,
    /// Whether the query for the ApplicationUri has completed.
    asked: bool,
}

impl Servers {
    /// Adds or changes a record. Returns the URL to query for the ApplicationUri.
    fn seen(&mut self, announcement: AnnouncedServer, since: SystemTime) -> Option<String> {
        let AnnouncedServer {
            instance,
            url,
            capabilities,
        } = announcement;
        if let Some((name, server)) = self.of_instance(&instance) {
            if same_place(&server.known.url, &url) {
                server.known.capabilities = capabilities;
                let known = server.known.clone();
                if server.asked {
                    self.push(ServerChange::Seen(known));
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
        // A previous server with this name has lost the name.
        self.renamed(&instance);
        let name = if self.known.contains_key(&instance) {
            format!("{instance} at {url}")
        } else {
            instance.clone()
        };
        let known = PresentServer {
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

    /// Renames a server that lost its name to another server with the same name. It continues under
    /// another of its names.
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
        self.push(ServerChange::Gone {
            known: before,
            loss: ServerLoss::Goodbye,
        });
        if asked {
            self.push(ServerChange::Seen(after));
        }
    }

    /// Stores the result of a query for an ApplicationUri.
    fn answered(&mut self, url: &str, application_uri: Option<String>) {
        if let Some((_, server)) = self.of_url(url) {
            server.known.application_uri = application_uri;
            server.asked = true;
            let known = server.known.clone();
            self.push(ServerChange::Seen(known));
        }
    }

    fn vanished(&mut self, instance: &str, loss: ServerLoss) {
        let Some((name, server)) = self.of_instance(instance) else {
            return;
        };
        server.instances.remove(instance);
        if server.instances.is_empty()
            && let Some(server) = self.known.remove(&name)
        {
            let known = server.known;
            self.push(ServerChange::Gone { known, loss });
        }
    }

    /// Stores the number of a server in the space, or its absence.
    fn numbered(&mut self, url: &str, number: Option<NonZeroU16>) {
        if let Some((_, server)) = self.of_url(url)
            && std::mem::replace(&mut server.known.number, number) != number
            && server.asked
        {
            let known = server.known.clone();
            self.push(ServerChange::Seen(known));
        }
    }

    /// Stores the start time of a server.
    fn started(&mut self, url: &str, at: SystemTime) {
        if let Some((_, server)) = self.of_url(url)
            && server.known.started.replace(at) != Some(at)
            && server.asked
        {
            let known = server.known.clone();
            self.push(ServerChange::Seen(known));
        }
    }

    fn restarted(&mut self, url: &str, at: Option<SystemTime>) {
        if let Some((_, server)) = self.of_url(url) {
            server.known.started = at.or(server.known.started);
            let known = server.known.clone();
            if server.asked {
                self.push(ServerChange::Restarted(known));
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

    /// Queues a change for the reader, and replaces pending changes of the same server.
    fn push(&mut self, found: ServerChange) {
        let name = found.known().name.clone();
        let of_it = |waiting: &ServerChange| waiting.known().name == name;
        let went = self
            .outbox
            .iter()
            .find(|waiting| of_it(waiting) && matches!(waiting, ServerChange::Gone { .. }));
        let went = went.cloned();
        self.outbox.retain(|waiting| !of_it(waiting));
        let told = self.told.contains(&name);
        match found {
            ServerChange::Gone { .. } if told => self.outbox.push_back(found),
            // The server appeared and was lost before the reader received it.
            ServerChange::Gone { .. } => {}
            ServerChange::Seen(known) | ServerChange::Restarted(known)
                if !told || went.is_some() =>
            {
                self.outbox.extend(went);
                self.outbox.push_back(ServerChange::Seen(known));
            }
            ServerChange::Seen(_) | ServerChange::Restarted(_) => self.outbox.push_back(found),
        }
    }

    fn next(&mut self) -> Option<ServerChange> {
        let found = self.outbox.pop_front()?;
        match &found {
            ServerChange::Gone { known, .. } => self.told.remove(&known.name),
            ServerChange::Seen(known) | ServerChange::Restarted(known) => {
                self.told.insert(known.name.clone())
            }
        };
        Some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robot(instance: &str, port: u16) -> AnnouncedServer {
        AnnouncedServer {
            instance: instance.to_owned(),
            url: format!("opc.tcp://127.0.0.1:{port}/"),
            capabilities: Vec::new(),
        }
    }

    fn told(servers: &mut Servers) -> Vec<String> {
        let next = std::iter::from_fn(|| servers.next());
        next.map(|found| {
            let what = match &found {
                ServerChange::Seen(_) => "seen",
                ServerChange::Restarted(_) => "restarted",
                ServerChange::Gone { .. } => "gone",
            };
            format!("{what} {}", found.known().name)
        })
        .collect()
    }

    /// Adds a server that has reported its ApplicationUri.
    fn seen(servers: &mut Servers, announcement: AnnouncedServer) {
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
        servers.vanished("arm", ServerLoss::Goodbye);
        assert!(told(&mut servers).is_empty());
        servers.vanished("arm of the discovery server", ServerLoss::Goodbye);
        assert_eq!(told(&mut servers), ["gone arm"]);
    }

    #[test]
    fn a_slow_reader_is_told_what_it_came_to() {
        let mut servers = Servers::default();
        seen(&mut servers, robot("brief", 2));
        servers.vanished("brief", ServerLoss::Unreachable);
        assert!(told(&mut servers).is_empty(), "it came and went meanwhile");
        seen(&mut servers, robot("arm", 1));
        assert_eq!(told(&mut servers), ["seen arm"]);
        servers.restarted("opc.tcp://127.0.0.1:1/", None);
        servers.vanished("arm", ServerLoss::Unreachable);
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
        // Two servers with the same name look like a single server that moves.
        seen(&mut servers, robot("arm", 2));
        seen(&mut servers, robot("arm (2)", 2));
        assert_eq!(told(&mut servers), ["seen arm"]);
        seen(&mut servers, robot("arm", 1));
        assert_eq!(told(&mut servers), ["seen arm (2)", "gone arm", "seen arm"]);
        servers.vanished("arm", ServerLoss::Goodbye);
        servers.vanished("arm (2)", ServerLoss::Goodbye);
        assert_eq!(told(&mut servers), ["gone arm", "gone arm (2)"]);
    }

    #[test]
    fn a_name_that_was_taken_back_is_free_for_another() {
        let mut servers = Servers::default();
        seen(&mut servers, robot("arm", 2));
        seen(&mut servers, robot("arm (2)", 2));
        servers.vanished("arm", ServerLoss::Goodbye);
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
