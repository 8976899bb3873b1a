//! A program that announces its server and discovers no others: [`MdnsAnnouncer`].

use std::collections::VecDeque;

use mdns_sd::MDNS_PORT;
use tokio::time::{Duration, Instant, sleep_until};

use crate::announcement::{MdnsEvent, MdnsFault, OwnAnnouncement, same_place};
use crate::group::GroupSocket;
use crate::interface::{MdnsInterface, Subnets};
use crate::nearby::{NearbyServers, Sighting};
use crate::own::OwnServers;

/// Announces servers on one interface. Unlike [`Mdns`](crate::Mdns) it sends queries for its own
/// names only, and stores no records of others, so that hundreds of such programs on a network do
/// not respond to each other.
pub struct MdnsAnnouncer {
    ours: OwnServers,
    group: GroupSocket,
    nearby: NearbyServers,
    /// Networks of announced servers, and the time at which they were read.
    subnets: (Subnets, Instant),
    /// Queries for names of this program, which are sent while the group socket is open.
    queries: Vec<PlannedQuery>,
    /// Events that were not yet returned.
    events: VecDeque<MdnsEvent>,
}

/// A query for a name of this program: a program of another manufacturer with this name may have
/// announced its server before.
struct PlannedQuery {
    instance: String,
    at: Instant,
}

impl MdnsAnnouncer {
    /// Opens an interface.
    ///
    /// # Errors
    /// The mDNS daemon cannot be started.
    pub fn open(interface: &MdnsInterface) -> Result<Self, MdnsFault> {
        Self::open_at(interface, MDNS_PORT)
    }

    fn open_at(interface: &MdnsInterface, port: u16) -> Result<Self, MdnsFault> {
        Ok(Self {
            ours: OwnServers::open(interface, port)?,
            group: GroupSocket::open(interface, port),
            nearby: NearbyServers::default(),
            subnets: (interface.subnets(), Instant::now()),
            queries: Vec::new(),
            events: VecDeque::new(),
        })
    }

    /// Follows the server with this URL, and no earlier one: [`next`](Self::next) reports its first
    /// announcement, and the first one after each restart.
    pub fn heed(&mut self, url: Option<&str>) {
        self.nearby.heed(url);
    }

    /// Announces a server at once, in place of the previous announcement of its name.
    pub fn put(&mut self, ours: OwnAnnouncement) {
        read_subnets(self.ours.interface(), &mut self.subnets);
        let instance = &ours.announcement.instance;
        if !self.ours.has(instance) {
            self.plan_queries(instance);
        }
        self.ours.put(ours, &self.subnets.0);
    }

    /// Withdraws the announcement of a name. The future completes after the goodbye was sent.
    pub fn take_back(&mut self, instance: &str) -> Option<impl Future<Output = ()> + Send + use<>> {
        self.queries.retain(|query| query.instance != instance);
        self.ours.take_back(instance)
    }

    /// Returns whether the announcements of others are received.
    #[must_use]
    pub const fn receives(&self) -> bool {
        self.group.is_open()
    }

    /// Returns the next event: an announcement or a goodbye of the [heeded](Self::heed) server, or
    /// a change of an own name. Cancel-safe.
    pub async fn next(&mut self) -> MdnsEvent {
        loop {
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            self.ask().await;
            let announce_at = self.ours.announce_at();
            let query_at = self.query_at();
            let Self {
                ours,
                group,
                nearby,
                subnets,
                ..
            } = &mut *self;
            let seen = tokio::select! {
                received = group.recv() => {
                    read_subnets(ours.interface(), subnets);
                    nearby.take(received, |name| ours.host(name), &subnets.0, Instant::now())
                }
                () = sleep_until(query_at.map_or(announce_at, |at| at.min(announce_at))) => {
                    if Instant::now() >= announce_at {
                        self.announce_again();
                    }
                    continue;
                }
            };
            for sighting in seen {
                let event = self.take(sighting);
                self.events.extend(event);
            }
        }
    }

    fn announce_again(&mut self) {
        self.nearby.forget(Instant::now());
        if self.group.reopen() {
            let names: Vec<String> = self.ours.names().map(str::to_owned).collect();
            for instance in names {
                self.plan_queries(&instance);
            }
        }
        read_subnets(self.ours.interface(), &mut self.subnets);
        self.ours
            .announce_again(self.nearby.count(), &self.subnets.0);
    }

    /// Plans two queries for a name. A server that was announced less than a second ago does not
    /// answer the first (RFC 6762, 6).
    fn plan_queries(&mut self, instance: &str) {
        self.queries.retain(|query| query.instance != instance);
        let now = Instant::now();
        self.queries
            .extend([now, now + ASK_AGAIN].map(|at| PlannedQuery {
                instance: instance.to_owned(),
                at,
            }));
    }

    /// Returns the time of the next query.
    fn query_at(&self) -> Option<Instant> {
        let times = self.queries.iter().map(|query| query.at);
        times.min().filter(|_| self.group.is_open())
    }

    /// Sends the queries that are due. Cancel-safe.
    async fn ask(&mut self) {
        while self.group.is_open()
            && let Some(due) = (self.queries.iter()).position(|query| query.at <= Instant::now())
        {
            if let Some(query) = self.queries.get(due) {
                self.group.ask(&query.instance).await;
            }
            self.queries.remove(due);
        }
    }

    fn take(&mut self, sighting: Sighting) -> Option<MdnsEvent> {
        match sighting {
            Sighting::Newcomer => {
                self.ours.announce_soon(self.nearby.count());
                None
            }
            Sighting::Left { instance } => Some(MdnsEvent::Withdrawn { instance }),
            Sighting::Heeded {
                announcement,
                aside,
            } => Some(MdnsEvent::Announced {
                announcement,
                aside,
            }),
            Sighting::Rival { announcement } => {
                self.resolve(&announcement.instance, &announcement.url)
            }
        }
    }

    /// Resolves a conflict for a name of this program with the server at another URL.
    fn resolve(&mut self, from: &str, theirs: &str) -> Option<MdnsEvent> {
        if same_place(self.ours.place(from)?, theirs) {
            return None;
        }
        let nearby = &self.nearby;
        let is_taken = |name: &str| nearby.knows(name);
        let event = self
            .ours
            .conflict((from, theirs), &self.subnets.0, is_taken);
        if let Some(MdnsEvent::Renamed { to, .. }) = &event {
            self.queries.retain(|query| query.instance != from);
            self.plan_queries(to);
        } else if !self.queries.iter().any(|query| query.instance == from) {
            // The other program has to give way, and may not announce whether it does.
            self.queries.push(PlannedQuery {
                instance: from.to_owned(),
                at: Instant::now() + ASK_AGAIN,
            });
        }
        event
    }
}

/// Reads the subnets of the interface, because its address may have changed.
fn read_subnets(interface: &MdnsInterface, known: &mut (Subnets, Instant)) {
    let now = Instant::now();
    if now.saturating_duration_since(known.1) >= READ_SUBNETS_EVERY {
        *known = (interface.subnets(), now);
    }
}

/// Exceeds the second in which a record is sent at most once (RFC 6762, 6).
const ASK_AGAIN: Duration = Duration::from_millis(1500);
const READ_SUBNETS_EVERY: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests;
