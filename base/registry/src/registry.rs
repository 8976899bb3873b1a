//! The registry itself: registrations and announcements are inputs, the available servers are
//! outputs.

mod announcements;
mod room;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use crate::asked::{Channel, RegisterFault, RegistrationRequest};
use crate::loss::ServerLoss;
use crate::network::{AnnouncedServer, NetworkRecord, NetworkRecords, RecordSource, place};
use crate::watch::{EndpointProbe, EndpointWatch, Patience, ProbeOutcome, Sign};

/// Limits and time limits of a registry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RegistrySettings {
    /// Whether a server may register over a channel that is not secured. The standard requires a
    /// refusal (OPC 10000-12, 4.2.2).
    pub allow_unsecured: bool,
    /// Lifetime of a registration without semaphore file: twice the period in which servers repeat
    /// it.
    pub forget_after: Duration,
    /// Period of the probes of an endpoint. With more than 500 endpoints they are probed less
    /// often, 500 in a second.
    pub probe_every: Duration,
    /// Time after which a server without any answer is lost.
    pub lost_after: Duration,
    /// Time limit for a server that answers during calls and is silent while its host accepts
    /// connections. It exceeds `lost_after`, since a program that computes is not lost. It is ten
    /// times as long for a server that has never answered, since it may be starting.
    pub hangs_after: Duration,
    /// The same time limit for any other server: many serve one request at a time, and do not
    /// answer while they execute a method.
    pub busy_for: Duration,
    /// Maximum number of registered servers, and of records of the network. More are refused or
    /// ignored.
    pub most: usize,
}

impl Default for RegistrySettings {
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

/// Effect of a registration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Registered {
    /// The server was not registered before.
    New,
    /// The server was registered, with other properties.
    Changed,
    /// A repetition.
    Again,
    /// A withdrawal, of an existing registration or without effect.
    Withdrawn,
}

/// Event of a registry.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum RegistryEvent {
    /// A server registered, or changed its registration.
    Registered {
        /// Its ApplicationUri.
        server_uri: String,
        /// Its URLs for GetEndpoints requests.
        discovery_urls: Vec<String>,
    },
    /// A server appeared on the network, or its record changed.
    Seen(NetworkRecord),
    /// The program behind a URL was restarted: cached information about it is invalid.
    Restarted {
        /// The probed URL.
        url: String,
    },
    /// A registered server is lost.
    Gone {
        /// Its ApplicationUri.
        server_uri: String,
        /// Reason of the loss.
        loss: ServerLoss,
    },
    /// A server on the network is lost.
    Vanished {
        /// Its record.
        record: NetworkRecord,
        /// Reason of the loss.
        loss: ServerLoss,
    },
    /// A server requests to be announced by this program.
    Announce(AnnouncedServer),
    /// An announcement of this program has to be withdrawn with a goodbye.
    Withdraw {
        /// The instance name.
        instance: String,
    },
}

/// The available servers. The page of the crate describes its use.
#[derive(Debug)]
pub struct ServerRegistry {
    settings: RegistrySettings,
    servers: BTreeMap<String, Server>,
    /// Registered and unreachable servers. They are listed again if they answer before their
    /// registration expires.
    away: BTreeMap<String, Server>,
    network: NetworkRecords,
    /// The servers that a Global Discovery Server lists, by host and port. A server that answers
    /// has a record, unless another source reports it.
    listed: BTreeMap<String, AnnouncedServer>,
    watch: EndpointWatch,
    events: VecDeque<RegistryEvent>,
    refused: u64,
    displaced: u64,
    last_arrival: u64,
}

#[derive(Debug, Clone)]
struct Server {
    asked: RegistrationRequest,
    /// The announcement of this program for the server: the requested announcement, with another
    /// name if the requested name was taken.
    announced: Option<AnnouncedServer>,
    /// Whether the registration was made with a certificate.
    certified: bool,
    /// The address that sent the registration.
    sender: String,
    /// Host and port of its first endpoint.
    place: String,
    /// The order of arrival.
    arrival: u64,
    since: Instant,
    forget_at: Instant,
}

impl ServerRegistry {
    /// Creates an empty registry.
    #[must_use]
    pub fn new(settings: RegistrySettings) -> Self {
        Self {
            settings,
            servers: BTreeMap::new(),
            away: BTreeMap::new(),
            network: NetworkRecords::default(),
            listed: BTreeMap::new(),
            watch: EndpointWatch::default(),
            events: VecDeque::new(),
            refused: 0,
            displaced: 0,
            last_arrival: 0,
        }
    }

    /// Handles RegisterServer and RegisterServer2. The caller checks whether the semaphore file
    /// exists; `None` if the request has no such file.
    ///
    /// # Errors
    /// [`RegisterFault`], with the status of the response; a previous registration stays.
    pub fn register(
        &mut self,
        asked: RegistrationRequest,
        channel: &Channel,
        semaphore_is_there: Option<bool>,
        now: Instant,
    ) -> Result<Registered, RegisterFault> {
        asked.check(channel, self.settings.allow_unsecured)?;
        let certified = channel.certificate_uri.is_some();
        self.check_certified(&asked, certified)?;
        if !asked.is_online {
            self.forget_away(&asked.server_uri);
            self.end(&asked.server_uri.clone(), ServerLoss::Unregistered);
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

    /// Refuses to change a registration with a certificate without this certificate, as long as the
    /// registration is valid.
    fn check_certified(
        &self,
        asked: &RegistrationRequest,
        certified: bool,
    ) -> Result<(), RegisterFault> {
        let known = self.servers.get(&asked.server_uri);
        let known = known.or_else(|| self.away.get(&asked.server_uri));
        match known {
            Some(known) if known.certified && !certified => Err(RegisterFault::Certified {
                asked: asked.server_uri.clone(),
            }),
            Some(_) | None => Ok(()),
        }
    }

    /// Adds a server, in place of its previous registration.
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
            self.events.push_back(RegistryEvent::Withdraw {
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
        self.events.push_back(RegistryEvent::Registered {
            server_uri,
            discovery_urls: discovery_urls.clone(),
        });
        for url in &discovery_urls {
            self.supersede_at(&place(url));
        }
        if let Some(wished) = wished {
            self.supersede(&wished.instance);
            self.network
                .put(wished.clone(), RecordSource::Registration, now);
            self.events.push_back(RegistryEvent::Announce(wished));
        }
    }

    /// Handles the removal of a registered server's semaphore file.
    pub fn semaphore_gone(&mut self, server_uri: &str) {
        self.forget_away(server_uri);
        self.end(server_uri, ServerLoss::SemaphoreGone);
    }

    /// Returns whether an endpoint is supervised.
    #[must_use]
    pub fn watches(&self, url: &str) -> bool {
        self.watch.contains(url)
    }

    /// Probes an endpoint at once, because its server may have ended, for example after a lost
    /// connection.
    pub fn suspect(&mut self, url: &str) {
        self.watch.hasten(url);
    }

    /// Excludes a time in which the program did not run, so that no answer and no repeated
    /// registration could be received.
    pub fn stood_still(&mut self, how_long: Duration) {
        self.watch.stood_still(how_long);
        let servers = self.servers.values_mut().chain(self.away.values_mut());
        for server in servers {
            server.forget_at += how_long;
        }
    }

    /// Returns the next endpoint to probe, if any is due. Has to be called until it returns `None`.
    pub fn poll_probe(&mut self, now: Instant) -> Option<EndpointProbe> {
        self.watch.next(self.settings.probe_every, now)
    }

    /// Sets the start time of the known run of a program, from a source with another definition of
    /// it. A program announces its own start, while its server reports the start of the server.
    /// This is not reported as a restart.
    pub fn started(&mut self, url: &str, start_time: i64) {
        self.watch.started(url, start_time);
    }

    /// Records that the server at this URL answers while it executes methods, so that silence means
    /// that it hangs.
    pub fn answers_during_calls(&mut self, url: &str) {
        self.watch.answers_during_calls(url);
    }

    /// Returns whether the server at this URL is known to answer while it executes methods.
    #[must_use]
    pub fn is_concurrent(&self, url: &str) -> bool {
        self.watch.is_concurrent(url)
    }

    /// Handles the start time in an announcement of `instance`. It does not prove that the program
    /// runs. A changed start time is a restart, unless the name is a further name of an endpoint.
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

    /// Returns whether recent probes of an endpoint failed, so that it is not probed for a while.
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
            .extend(urls.into_iter().map(|url| RegistryEvent::Restarted { url }));
    }

    /// Handles the result of a probe.
    pub fn probed(&mut self, url: &str, outcome: ProbeOutcome, now: Instant) {
        match outcome {
            ProbeOutcome::Alive { .. } => self.welcome_back(url, now),
            // The host is available and the program has ended: its next run registers again, and
            // another program that gets its port is not the same server.
            ProbeOutcome::Refused => self.forget_away_at(url),
            ProbeOutcome::Silent | ProbeOutcome::Hanging | ProbeOutcome::Untried => {}
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
            Sign::Lost(loss) => self.lose(url, loss, outcome == ProbeOutcome::Refused, now),
        }
        if matches!(outcome, ProbeOutcome::Alive { .. }) {
            self.show_listed(&place(url), now);
        }
    }

    /// Removes expired registrations.
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
            self.end(&uri, ServerLoss::Expired);
        }
    }

    /// Returns the time at which [`handle_timeout`](Self::handle_timeout) or
    /// [`poll_probe`](Self::poll_probe) has to be called next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let expiring = self.servers.values().filter(|server| server.expires());
        let expiry = expiring.map(|server| server.forget_at).min();
        expiry.into_iter().chain(self.watch.due()).min()
    }

    /// Returns the next event, oldest first.
    pub fn poll_event(&mut self) -> Option<RegistryEvent> {
        self.events.pop_front()
    }

    /// Returns the registered servers with their time of registration, all or with these URIs:
    /// FindServers.
    pub fn find_servers(
        &self,
        uris: &[&str],
    ) -> impl Iterator<Item = (&RegistrationRequest, Instant)> {
        self.servers
            .values()
            .filter(move |server| uris.is_empty() || uris.contains(&&*server.asked.server_uri))
            .map(|server| (&server.asked, server.since))
    }

    /// Returns the records from an id on that have all of the capabilities, with a maximum number
    /// (0: all): FindServersOnNetwork.
    #[must_use]
    pub fn find_servers_on_network(
        &self,
        from: u32,
        most: u32,
        capabilities: &[&str],
    ) -> Vec<&NetworkRecord> {
        self.network.find(from, most, capabilities)
    }

    /// Returns the number of servers refused for lack of space: in the whole table, or in the share
    /// of the endpoint or sender.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Returns the number of unverified servers that were displaced by another server.
    #[must_use]
    pub fn displaced(&self) -> u64 {
        self.displaced
    }

    /// Removes all registrations and records of the endpoint of a URL, which does not answer.
    fn lose(&mut self, url: &str, loss: ServerLoss, ended: bool, now: Instant) {
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
            // A server with another endpoint is supervised there, and announced with it.
            let Some(server) = self.servers.get_mut(&uri) else {
                continue;
            };
            if server.asked.discovery_urls.iter().all(is_there) {
                // An unverified server is not kept for its return. A program that hangs accepts
                // connections, so it exists.
                let is_verified = had_answered || certified || loss == ServerLoss::Hanging;
                self.leave(&uri, loss, ended || !is_verified);
                continue;
            }
            server.asked.discovery_urls.retain(|known| !is_there(known));
            let Some(other) = server.asked.discovery_urls.first() else {
                continue;
            };
            if let Some(announced) = server.announced.as_mut().filter(|old| is_there(&old.url)) {
                announced.url.clone_from(other);
                self.network
                    .put(announced.clone(), RecordSource::Registration, now);
                self.events
                    .push_back(RegistryEvent::Announce(announced.clone()));
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
        // A listed server is shown again when it answers.
        if let Some(listed) = self.listed.get(&place_of_url) {
            self.watch.add(&listed.url, self.settings.probe_every, now);
        }
    }

    /// Removes an unreachable registered server. Unless it has ended, its program may still run
    /// behind a disconnected cable, and would register again only after some minutes.
    fn leave(&mut self, server_uri: &str, loss: ServerLoss, ended: bool) {
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

    /// Lists the unreachable servers of a URL again, which has answered.
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

    fn end(&mut self, server_uri: &str, loss: ServerLoss) {
        let Some(server) = self.servers.remove(server_uri) else {
            return;
        };
        if let Some(announcement) = server.announced {
            self.network.remove(&announcement.instance);
            self.events.push_back(RegistryEvent::Withdraw {
                instance: announcement.instance,
            });
        }
        for url in &server.asked.discovery_urls {
            self.unwatch(url);
            // If it is announced on the network as well, its record is checked at once.
            self.watch.hasten(url);
        }
        self.events.push_back(RegistryEvent::Gone {
            server_uri: server_uri.to_owned(),
            loss,
        });
    }

    fn vanish(&mut self, instance: &str, loss: ServerLoss) {
        if let Some(record) = self.network.remove(instance) {
            self.unwatch(&record.announcement.url);
            self.events
                .push_back(RegistryEvent::Vanished { record, loss });
        }
    }

    /// Ends the supervision of a URL that no server has any more.
    fn unwatch(&mut self, url: &str) {
        let registered = self.servers.values().chain(self.away.values());
        let mut urls = registered
            .flat_map(|server| &server.asked.discovery_urls)
            .chain(self.network.iter().map(|record| &record.announcement.url));
        let place_of_url = place(url);
        let is_listed = self.listed.contains_key(&place_of_url);
        if !is_listed && !urls.any(|known| place(known) == place_of_url) {
            self.watch.remove(url);
        }
    }
}

impl Server {
    /// Returns whether the registration expires. With a semaphore file it stays as long as the file
    /// exists.
    fn expires(&self) -> bool {
        self.asked.semaphore_file_path.is_empty()
    }

    /// Returns whether one of its endpoints has this host and port.
    fn is_at(&self, at: &str) -> bool {
        self.place == at || self.asked.discovery_urls.iter().any(|url| place(url) == at)
    }
}

/// Prefix of the ProductUris of servers that serve many requests at a time.
const CONCURRENT_PRODUCTS: &str = "urn:ua-bridge:";
