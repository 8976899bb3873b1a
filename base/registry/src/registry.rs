//! The registry itself: what is heard goes in, who is there comes out.

mod room;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use crate::asked::{Asked, Channel, RegisterFault};
use crate::loss::Loss;
use crate::name::{label, renamed};
use crate::network::{Announcement, Network, NetworkRecord, place};
use crate::watch::{Outcome, Patience, Probe, Sign, Watch};

/// How careful and how patient a registry is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Whether a server may register over a channel that is not secured. The standard has it refused (OPC 10000-12, 4.2.2).
    pub allow_unsecured: bool,
    /// How long a registration without semaphore file counts: twice the period in which servers repeat it.
    pub forget_after: Duration,
    /// How often each endpoint is tried. Where there are more than 500 they are tried less often, 500 in a second.
    pub probe_every: Duration,
    /// How long one that gives no answer at all still counts as there.
    pub lost_after: Duration,
    /// How long a server that answers during calls may be silent while its host takes connections: longer than `lost_after`,
    /// since a program that computes is not gone. Ten times as long where it has never answered, since it may be starting.
    pub hangs_after: Duration,
    /// How long any other server may be: many serve one request at a time, and answer nothing while they execute a method.
    pub busy_for: Duration,
    /// Servers that may be registered, and records of the network, each. What is more is refused or not taken in.
    pub most: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            allow_unsecured: false,
            forget_after: Duration::from_secs(1200),
            probe_every: Duration::from_secs(1),
            lost_after: Duration::from_secs(2),
            hangs_after: Duration::from_secs(3),
            busy_for: Duration::from_secs(60),
            most: 1024,
        }
    }
}

/// What a registration was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Registered {
    /// Of a server that was not registered.
    New,
    /// Of one that was, with something else than before.
    Changed,
    /// A repetition.
    Again,
    /// The end of one, or of none.
    Withdrawn,
}

/// What has happened.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Event {
    /// A server registered, or registered otherwise than before.
    Registered {
        /// Its ApplicationUri.
        server_uri: String,
        /// Where its endpoints are asked for.
        discovery_urls: Vec<String>,
    },
    /// A server appeared on the network, or its record changed.
    Seen(NetworkRecord),
    /// The program behind a URL was started anew: what was learned of it counts no more.
    Restarted {
        /// The URL that was tried.
        url: String,
    },
    /// A server that was registered is gone.
    Gone {
        /// Its ApplicationUri.
        server_uri: String,
        /// How that is known.
        loss: Loss,
    },
    /// A server that was seen on the network is gone.
    Vanished {
        /// What was known of it.
        record: NetworkRecord,
        /// How that is known.
        loss: Loss,
    },
    /// This server asks us to announce it.
    Announce(Announcement),
    /// What we announced is to be taken back: a goodbye.
    Withdraw {
        /// The instance name.
        instance: String,
    },
}

/// Who is there. See the crate's page for how it is driven.
#[derive(Debug)]
pub struct Registry {
    settings: Settings,
    servers: BTreeMap<String, Server>,
    /// Registered, and not to be reached: listed again when they answer before their registration has run out.
    away: BTreeMap<String, Server>,
    network: Network,
    watch: Watch,
    events: VecDeque<Event>,
    refused: u64,
    displaced: u64,
    last_arrival: u64,
}

#[derive(Debug, Clone)]
struct Server {
    asked: Asked,
    /// What we announce for it: what it asked for, under another name where that one was taken.
    announced: Option<Announcement>,
    /// Whether a certificate said who registers it.
    certified: bool,
    /// The address that it is registered from.
    sender: String,
    /// Host and port of its first endpoint.
    place: String,
    /// The order of arrival.
    arrival: u64,
    since: Instant,
    forget_at: Instant,
}

impl Registry {
    /// A registry that knows nobody.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            servers: BTreeMap::new(),
            away: BTreeMap::new(),
            network: Network::default(),
            watch: Watch::default(),
            events: VecDeque::new(),
            refused: 0,
            displaced: 0,
            last_arrival: 0,
        }
    }

    /// RegisterServer and RegisterServer2. Whether a semaphore file is there is the caller's to look up, `None` where the
    /// request names none.
    ///
    /// # Errors
    /// [`RegisterFault`], with the status to answer; what was registered before stays.
    pub fn register(
        &mut self,
        asked: Asked,
        channel: &Channel,
        semaphore_is_there: Option<bool>,
        now: Instant,
    ) -> Result<Registered, RegisterFault> {
        asked.check(channel, self.settings.allow_unsecured)?;
        let certified = channel.certificate_uri.is_some();
        self.check_certified(&asked, certified)?;
        if !asked.is_online {
            self.forget_away(&asked.server_uri);
            self.end(&asked.server_uri.clone(), Loss::Unregistered);
            return Ok(Registered::Withdrawn);
        }
        if semaphore_is_there == Some(false) {
            return Err(RegisterFault::NoSemaphore);
        }
        let sender = channel.peer.map(|peer| peer.to_string());
        let sender = sender.unwrap_or_default();
        if !self.servers.contains_key(&asked.server_uri) {
            self.make_room(&asked, &sender, certified, now)?;
        }
        let forget_at = now + self.settings.forget_after;
        let known = self.servers.get_mut(&asked.server_uri);
        let (registered, since, arrival) = match known {
            Some(server) if server.asked == asked => {
                server.forget_at = forget_at;
                server.certified |= certified;
                return Ok(Registered::Again);
            }
            Some(server) => (Registered::Changed, server.since, server.arrival),
            None => {
                self.last_arrival += 1;
                (Registered::New, now, self.last_arrival)
            }
        };
        let announced = self.free(&asked);
        let server = Server {
            place: room::place_of(&asked),
            asked,
            announced,
            certified,
            sender,
            arrival,
            since,
            forget_at,
        };
        self.forget_away(&server.asked.server_uri);
        self.take(server, now);
        Ok(registered)
    }

    /// Who came with a certificate is changed by it alone, for as long as the registration counts.
    fn check_certified(&self, asked: &Asked, certified: bool) -> Result<(), RegisterFault> {
        let known = self.servers.get(&asked.server_uri);
        let known = known.or_else(|| self.away.get(&asked.server_uri));
        match known {
            Some(known) if known.certified && !certified => Err(RegisterFault::Certified {
                asked: asked.server_uri.clone(),
            }),
            Some(_) | None => Ok(()),
        }
    }

    /// Takes a server in, in the place of what it registered before.
    fn take(&mut self, server: Server, now: Instant) {
        let server_uri = server.asked.server_uri.clone();
        let discovery_urls = server.asked.discovery_urls.clone();
        let is_concurrent = server.asked.product_uri.starts_with(CONCURRENT_PRODUCTS);
        let wished = server.announced.clone();
        let before = self.servers.insert(server_uri.clone(), server);
        let announced = before.as_ref().and_then(|before| before.announced.as_ref());
        if let Some(old) =
            announced.filter(|old| wished.as_ref().map(|new| &new.instance) != Some(&old.instance))
        {
            self.network.remove(&old.instance);
            self.events.push_back(Event::Withdraw {
                instance: old.instance.clone(),
            });
        }
        let before = before.map(|server| server.asked);
        for url in before.iter().flat_map(|asked| &asked.discovery_urls) {
            self.unwatch(url);
        }
        for url in &discovery_urls {
            self.watch.add(url, self.settings.probe_every, now);
            if is_concurrent {
                self.watch.answers_during_calls(url);
            }
        }
        self.events.push_back(Event::Registered {
            server_uri,
            discovery_urls,
        });
        if let Some(wished) = wished {
            self.network.put(wished.clone(), now);
            self.events.push_back(Event::Announce(wished));
        }
    }

    /// mDNS has told of a server, for the first time or again.
    pub fn announced(&mut self, announcement: Announcement, now: Instant) {
        let instance = &announcement.instance;
        if self.is_ours(instance) {
            // What comes back of our own announcements.
            return;
        }
        let known = self.network.get(instance);
        if known.is_some_and(|known| known.announcement == announcement) {
            return;
        }
        if known.is_none() && !self.make_room_on_network(&announcement, now) {
            return;
        }
        let instance = announcement.instance.clone();
        let url = announcement.url.clone();
        if let Some(before) = self.network.put(announcement, now) {
            self.unwatch(&before.announcement.url);
        }
        self.watch.add(&url, self.settings.probe_every, now);
        let record = self.network.get(&instance).cloned();
        self.events.extend(record.map(Event::Seen));
    }

    /// mDNS has told that a server leaves, or what it told has run out.
    pub fn withdrawn(&mut self, instance: &str) {
        if !self.is_ours(instance) {
            self.vanish(instance, Loss::Goodbye);
        }
    }

    /// The semaphore file of a registered server is gone.
    pub fn semaphore_gone(&mut self, server_uri: &str) {
        self.forget_away(server_uri);
        self.end(server_uri, Loss::SemaphoreGone);
    }

    /// What we announce for a server is called otherwise from now on: another host has that name (RFC 6762, 9).
    pub fn renamed(&mut self, from: &str, to: &str, now: Instant) {
        let mut announced = self
            .servers
            .values_mut()
            .filter_map(|server| server.announced.as_mut());
        let Some(ours) = announced.find(|ours| ours.instance.eq_ignore_ascii_case(from)) else {
            return;
        };
        to.clone_into(&mut ours.instance);
        let ours = ours.clone();
        self.network.remove(from);
        self.network.put(ours, now);
    }

    /// Whether an endpoint is looked after.
    #[must_use]
    pub fn watches(&self, url: &str) -> bool {
        self.watch.contains(url)
    }

    /// Something says that a server may have ended, as a connection that broke off: it is tried at once.
    pub fn suspect(&mut self, url: &str) {
        self.watch.hasten(url);
    }

    /// The program did not run for some time, so that no answer and no repeated registration could come: that time does not
    /// count.
    pub fn stood_still(&mut self, how_long: Duration) {
        self.watch.stood_still(how_long);
        let servers = self.servers.values_mut().chain(self.away.values_mut());
        for server in servers {
            server.forget_at += how_long;
        }
    }

    /// The endpoint to try now, if any is due. To be asked until there is none.
    pub fn poll_probe(&mut self, now: Instant) -> Option<Probe> {
        self.watch.next(self.settings.probe_every, now)
    }

    /// When the run of the program that is known started, as it is told another way than before: a program says when it was
    /// announced, and its server when that began. Nobody is told of a restart.
    pub fn started(&mut self, url: &str, start_time: i64) {
        self.watch.started(url, start_time);
    }

    /// The server at this URL answers while it executes methods, so that silence is a sign that it hangs.
    pub fn answers_during_calls(&mut self, url: &str) {
        self.watch.answers_during_calls(url);
    }

    /// Returns whether the server at this URL is known to answer while it executes methods.
    #[must_use]
    pub fn is_concurrent(&self, url: &str) -> bool {
        self.watch.is_concurrent(url)
    }

    /// An announcement by `instance` says when its program started. It is no proof that the program runs; another start time
    /// than before is a restart, unless the name is a further one of an endpoint that has others.
    pub fn announced_start(&mut self, instance: &str, start_time: i64) {
        let Some(record) = self.network.get(instance) else {
            return;
        };
        let url = record.announcement.url.clone();
        if self.network.is_further(instance) {
            return;
        }
        if self.watch.announced_start(&url, start_time) == Sign::Restarted {
            self.restarted(&url);
        }
    }

    /// Returns whether an endpoint has answered a probe.
    #[must_use]
    pub fn has_answered(&self, url: &str) -> bool {
        self.watch.has_answered(url)
    }

    /// Returns whether probes of an endpoint failed lately, so that it is left alone for a while.
    #[must_use]
    pub fn is_paused(&self, url: &str, now: Instant) -> bool {
        self.watch.is_paused(url, now)
    }

    /// Reports a restart of the program behind an endpoint.
    fn restarted(&mut self, url: &str) {
        let place_of_url = place(url);
        let registered = self.servers.values();
        let urls: BTreeSet<&String> = registered
            .flat_map(|server| &server.asked.discovery_urls)
            .chain(self.network.iter().map(|record| &record.announcement.url))
            .filter(|url| place(url) == place_of_url)
            .collect();
        let urls: Vec<String> = urls.into_iter().cloned().collect();
        self.events
            .extend(urls.into_iter().map(|url| Event::Restarted { url }));
    }

    /// What came of a try.
    pub fn probed(&mut self, url: &str, outcome: Outcome, now: Instant) {
        match outcome {
            Outcome::Alive { .. } => self.welcome_back(url, now),
            // The host is there and the program is not: another run of it registers anew, and whoever else
            // gets its port is not it.
            Outcome::Refused => self.forget_away_at(url),
            Outcome::Silent | Outcome::Hanging | Outcome::Untried => {}
        }
        let patience = Patience {
            every: self.settings.probe_every,
            silent: self.settings.lost_after,
            hanging: self.settings.hangs_after,
            busy: self.settings.busy_for,
        };
        match self.watch.probed(url, outcome, patience, now) {
            Sign::Nothing => {}
            Sign::Restarted => self.restarted(url),
            Sign::Lost(loss) => self.lose(url, loss, outcome == Outcome::Refused, now),
        }
    }

    /// Forgets who has not registered again.
    pub fn handle_timeout(&mut self, now: Instant) {
        let away = self
            .away
            .iter()
            .filter(|(_, server)| server.forget_at <= now);
        let away: Vec<String> = away.map(|(uri, _)| uri.clone()).collect();
        for uri in away {
            self.forget_away(&uri);
        }
        let expired: Vec<String> = self
            .servers
            .iter()
            .filter(|(_, server)| server.expires() && server.forget_at <= now)
            .map(|(uri, _)| uri.clone())
            .collect();
        for uri in expired {
            self.end(&uri, Loss::Expired);
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) and [`poll_probe`](Self::poll_probe) are wanted next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let expiring = self.servers.values().filter(|server| server.expires());
        let expiry = expiring.map(|server| server.forget_at).min();
        expiry.into_iter().chain(self.watch.due()).min()
    }

    /// What has happened, oldest first.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// The registered servers, of all or of these URIs, with since when: FindServers.
    pub fn find_servers(&self, uris: &[&str]) -> impl Iterator<Item = (&Asked, Instant)> {
        self.servers
            .values()
            .filter(move |server| uris.is_empty() || uris.contains(&&*server.asked.server_uri))
            .map(|server| (&server.asked, server.since))
    }

    /// Records from an id on that have all of the capabilities, at most so many (0: all): FindServersOnNetwork.
    #[must_use]
    pub fn find_servers_on_network(
        &self,
        from: u32,
        most: u32,
        capabilities: &[&str],
    ) -> Vec<&NetworkRecord> {
        self.network.find(from, most, capabilities)
    }

    /// How often a server was refused for want of room: in the whole table, or in the share of its endpoint or sender.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// How often an unverified server gave way to another one.
    #[must_use]
    pub fn displaced(&self) -> u64 {
        self.displaced
    }

    /// Nobody answers at the endpoint of a URL: all that was said of it goes.
    fn lose(&mut self, url: &str, loss: Loss, ended: bool, now: Instant) {
        let place_of_url = place(url);
        let is_there = |known: &String| place(known) == place_of_url;
        let had_answered = self.watch.has_answered(url);
        self.watch.remove(url);
        let servers: Vec<(String, bool)> = self
            .servers
            .values()
            .filter(|server| server.asked.discovery_urls.iter().any(is_there))
            .map(|server| (server.asked.server_uri.clone(), server.certified))
            .collect();
        let records: Vec<String> = self
            .network
            .iter()
            .filter(|record| is_there(&record.announcement.url))
            .map(|record| record.announcement.instance.clone())
            .collect();
        for (uri, certified) in servers {
            // One that has another endpoint is looked after there, and announced with it.
            let Some(server) = self.servers.get_mut(&uri) else {
                continue;
            };
            if server.asked.discovery_urls.iter().all(is_there) {
                // What was never verified is not kept for its return. A program that hangs accepts connections, so it exists.
                let is_verified = had_answered || certified || loss == Loss::Hanging;
                self.leave(&uri, loss, ended || !is_verified);
                continue;
            }
            server.asked.discovery_urls.retain(|known| !is_there(known));
            let Some(other) = server.asked.discovery_urls.first() else {
                continue;
            };
            if let Some(announced) = server.announced.as_mut().filter(|old| is_there(&old.url)) {
                announced.url.clone_from(other);
                self.network.put(announced.clone(), now);
                self.events.push_back(Event::Announce(announced.clone()));
            }
        }
        for instance in records {
            if !self.is_ours(&instance) {
                self.vanish(&instance, loss);
            }
        }
        if let Some(url) = self.away_at(url).first().and_then(|uri| {
            let away = self.away.get(uri)?;
            away.asked.discovery_urls.iter().find(|url| is_there(url))
        }) {
            self.watch.add(url, self.settings.probe_every, now);
        }
    }

    /// A registered server is not to be reached. Unless it has ended its program may run on behind a cable that is cut,
    /// and registers again in some minutes only.
    fn leave(&mut self, server_uri: &str, loss: Loss, ended: bool) {
        let server = self.servers.get(server_uri).cloned();
        self.end(server_uri, loss);
        let room = !ended && self.away.len() < self.settings.most;
        if let Some(server) = server.filter(|_| room) {
            self.away.insert(server_uri.to_owned(), server);
        }
    }

    fn forget_away(&mut self, server_uri: &str) {
        if let Some(server) = self.away.remove(server_uri) {
            for url in &server.asked.discovery_urls {
                self.unwatch(url);
            }
        }
    }

    fn forget_away_at(&mut self, url: &str) {
        for uri in self.away_at(url) {
            self.forget_away(&uri);
        }
    }

    fn away_at(&self, url: &str) -> Vec<String> {
        let place_of_url = place(url);
        let is_there = |known: &String| place(known) == place_of_url;
        let has = |server: &Server| server.asked.discovery_urls.iter().any(is_there);
        let away = self.away.iter().filter(|(_, server)| has(server));
        away.map(|(uri, _)| uri.clone()).collect()
    }

    /// Who was not to be reached at a URL answers there again.
    fn welcome_back(&mut self, url: &str, now: Instant) {
        for uri in self.away_at(url) {
            let Some(server) = self.away.remove(&uri) else {
                continue;
            };
            if self.servers.len() >= self.settings.most {
                self.refused += 1;
                continue;
            }
            let announced = self.free(&server.asked);
            let server = Server {
                announced,
                since: now,
                ..server
            };
            self.take(server, now);
        }
    }

    fn end(&mut self, server_uri: &str, loss: Loss) {
        let Some(server) = self.servers.remove(server_uri) else {
            return;
        };
        if let Some(announcement) = server.announced {
            self.network.remove(&announcement.instance);
            self.events.push_back(Event::Withdraw {
                instance: announcement.instance,
            });
        }
        for url in &server.asked.discovery_urls {
            self.unwatch(url);
            // Where it is announced on the network as well, that is held against it at once.
            self.watch.hasten(url);
        }
        self.events.push_back(Event::Gone {
            server_uri: server_uri.to_owned(),
            loss,
        });
    }

    fn vanish(&mut self, instance: &str, loss: Loss) {
        if let Some(record) = self.network.remove(instance) {
            self.unwatch(&record.announcement.url);
            self.events.push_back(Event::Vanished { record, loss });
        }
    }

    /// Looks no longer after a URL that nobody is known by any more.
    fn unwatch(&mut self, url: &str) {
        let registered = self.servers.values().chain(self.away.values());
        let mut urls = registered
            .flat_map(|server| &server.asked.discovery_urls)
            .chain(self.network.iter().map(|record| &record.announcement.url));
        let place_of_url = place(url);
        if !urls.any(|known| place(known) == place_of_url) {
            self.watch.remove(url);
        }
    }

    /// Whether we announce that name for a registered server.
    fn is_ours(&self, instance: &str) -> bool {
        let mut announced = self
            .servers
            .values()
            .filter_map(|server| server.announced.as_ref());
        announced.any(|ours| ours.instance.eq_ignore_ascii_case(instance))
    }

    /// What to announce for a server: its wish, counted on where another server has that name (RFC 6762, 9). Nothing
    /// where the wish is heard on the network already with the same URL: then the server does it itself.
    fn free(&self, asked: &Asked) -> Option<Announcement> {
        let mut wish = asked.announcement()?;
        let others = |name: &str| {
            self.servers
                .values()
                .filter(|server| server.asked.server_uri != asked.server_uri)
                .filter_map(|server| server.announced.as_ref())
                .any(|announced| announced.instance.eq_ignore_ascii_case(name))
        };
        // Each turn passes by one of the names there are.
        for _ in 0..=self.servers.len() + self.network.len() {
            let heard = self
                .network
                .get(&wish.instance)
                .filter(|_| !self.is_ours(&wish.instance));
            match heard {
                Some(heard) if heard.announcement.url == wish.url => return None,
                None if !others(&wish.instance) => return Some(wish),
                Some(_) | None => wish.instance = renamed(&wish.instance),
            }
        }
        None
    }
}

impl Server {
    /// With a semaphore file it stays as long as the file does.
    fn expires(&self) -> bool {
        self.asked.semaphore_file_path.is_empty()
    }
}

impl Asked {
    /// How it is to be announced, if it is.
    fn announcement(&self) -> Option<Announcement> {
        let mdns = self.mdns.as_ref()?;
        let instance = label(&mdns.name);
        if instance.is_empty() {
            return None;
        }
        Some(Announcement {
            instance,
            url: self.discovery_urls.first()?.clone(),
            capabilities: mdns.capabilities.clone(),
        })
    }
}

/// ProductUris of servers that serve many requests at a time begin like this.
const CONCURRENT_PRODUCTS: &str = "urn:ua-bridge:";
