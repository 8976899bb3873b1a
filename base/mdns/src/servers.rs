//! Servers on one interface, announced and discovered by mDNS and DNS-SD (OPC 10000-12, Annex C):
//! `_opcua-tcp._tcp.local.`
//!
//! Any host on the network can send announcements, so their number is bounded. Invalid
//! announcements are ignored and counted.

use std::collections::BTreeMap;
use std::time::Duration;

use log_limit::LogLimit;
use mdns_sd::{MDNS_PORT, Receiver, ResolvedService, ServiceEvent};
use registry::AnnouncedServer;
use tokio::time::{Instant, sleep_until};
use tracing::{debug, info};

use crate::announcement::{
    Aside, MdnsEvent, MdnsFault, OwnAnnouncement, SERVICE, address, heard, instance, same_place,
};
use crate::group::{GroupSocket, goodbyes};
use crate::interface::{MdnsInterface, Subnets};
use crate::own::{ANNOUNCE_EVERY, OwnServers};

/// mDNS on one interface, with a thread of its own for queries and responses.
pub struct Mdns {
    interface: MdnsInterface,
    ours: OwnServers,
    events: Receiver<ServiceEvent>,
    /// Receives goodbyes before the daemon reports them; without this socket they are a second
    /// late.
    group: GroupSocket,
    /// Goodbyes that have not been reported yet.
    left: Vec<String>,
    /// Instances on the network, as announced last. A new instance has not received the
    /// announcements of this program.
    there: BTreeMap<String, (AnnouncedServer, Aside)>,
    /// Instances with a goodbye that the daemon has not reported yet, with a deadline for its
    /// report. The goodbye may be that of another host with the same name, or the server may be
    /// back at once. The daemon reports no event for a record that stays in its cache.
    doubted: BTreeMap<String, (AnnouncedServer, Aside, Instant)>,
    /// Instances that the daemon reports as outdated without a goodbye, with the time at which they
    /// are reported. The daemon treats a clock that is set forward as a sleep of the machine,
    /// clears its cache, and receives the announcements again in a moment.
    outdated: BTreeMap<String, (AnnouncedServer, Aside, Instant)>,
    /// Networks of announced servers, and the time at which they were read.
    subnets: (Subnets, Instant),
    ignored: u64,
    /// Rate limit of log entries about ignored announcements.
    ignored_log: LogLimit,
}

impl Mdns {
    /// Opens an interface and starts to receive announcements at once.
    pub fn open(interface: &MdnsInterface) -> Result<Self, MdnsFault> {
        Self::open_at(interface, MDNS_PORT)
    }

    pub(crate) fn open_at(interface: &MdnsInterface, port: u16) -> Result<Self, MdnsFault> {
        let ours = OwnServers::open(interface, port)?;
        let events = ours.daemon().browse(SERVICE);
        Ok(Self {
            interface: interface.clone(),
            ours,
            events: events.map_err(|source| MdnsFault::new(interface, source))?,
            group: GroupSocket::open(interface, port),
            left: Vec::new(),
            there: BTreeMap::new(),
            doubted: BTreeMap::new(),
            outdated: BTreeMap::new(),
            subnets: (interface.subnets(), Instant::now()),
            ignored: 0,
            ignored_log: LogLimit::every(LOG_EVERY),
        })
    }

    /// Announces a server at once, in place of the previous announcement of its name.
    pub fn put(&mut self, ours: OwnAnnouncement) {
        self.ours.put(ours, &self.subnets.0);
    }

    /// Withdraws the announcement of a name. The future completes after the goodbye was sent.
    pub fn take_back(&mut self, instance: &str) -> Option<impl Future<Output = ()> + Send + use<>> {
        self.ours.take_back(instance)
    }

    /// Returns the number of received announcements that were ignored.
    pub fn ignored(&self) -> u64 {
        self.ignored
    }

    /// Returns the next event. Cancel-safe.
    pub async fn next(&mut self) -> MdnsEvent {
        loop {
            while let Some(instance) = self.left.pop() {
                if self.outdated.remove(&instance).is_some() {
                    return MdnsEvent::Withdrawn { instance };
                }
                if !self.ours.has(&instance)
                    && let Some((announcement, aside)) = self.there.remove(&instance)
                {
                    let until = Instant::now() + DOUBT;
                    // Beyond the limit, a server that is back is reported with its next change.
                    if self.doubted.len() < MOST {
                        self.doubted
                            .insert(instance.clone(), (announcement, aside, until));
                    }
                    return MdnsEvent::Withdrawn { instance };
                }
            }
            if let Some(heard) = self.still_there().or_else(|| self.not_heard_again()) {
                return heard;
            }
            let announce_at = self.ours.announce_at();
            let waiting = self.doubted.values().chain(self.outdated.values());
            let due = waiting.map(|(_, _, until)| *until).min();
            let wake_at = due.map_or(announce_at, |until| until.min(announce_at));
            let Self { group, events, .. } = &mut *self;
            let heard = async {
                let (packet, _) = group.recv().await;
                goodbyes(packet)
            };
            let event = tokio::select! {
                event = events.recv_async() => event,
                left = heard => {
                    self.left = left;
                    continue;
                }
                () = sleep_until(wake_at) => {
                    if Instant::now() >= announce_at {
                        self.group.reopen();
                        self.read_subnets();
                        self.ours.announce_again(self.there.len(), &self.subnets.0);
                    }
                    continue;
                }
            };
            match event {
                Ok(event) => {
                    if let Some(heard) = self.take(event) {
                        return heard;
                    }
                }
                Err(_closed) => self.browse_again().await,
            }
        }
    }

    /// Returns a server with a goodbye that the daemon has kept for longer than a server that left.
    fn still_there(&mut self) -> Option<MdnsEvent> {
        let now = Instant::now();
        let mut due = self
            .doubted
            .iter()
            .filter(|(_, (_, _, until))| *until <= now);
        let instance = due.next()?.0.clone();
        let (announcement, aside, _) = self.doubted.remove(&instance)?;
        self.there.insert(instance, (announcement.clone(), aside));
        Some(MdnsEvent::Announced {
            announcement,
            aside,
        })
    }

    /// Returns an outdated server that was not announced again.
    fn not_heard_again(&mut self) -> Option<MdnsEvent> {
        let now = Instant::now();
        let mut due = self
            .outdated
            .iter()
            .filter(|(_, (_, _, until))| *until <= now);
        let instance = due.next()?.0.clone();
        self.outdated.remove(&instance);
        Some(MdnsEvent::Withdrawn { instance })
    }

    /// Opens the channel again, which the crate closes without notice for a slow receiver.
    async fn browse_again(&mut self) {
        debug!("receiving mDNS on {} again", self.interface);
        match self.ours.daemon().browse(SERVICE) {
            Ok(events) => self.events = events,
            Err(error) => {
                debug!(%error, "cannot receive mDNS on {}", self.interface);
                tokio::time::sleep(ANNOUNCE_EVERY).await;
            }
        }
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "the crate may report further events; two of them concern presence"
    )]
    fn take(&mut self, event: ServiceEvent) -> Option<MdnsEvent> {
        match event {
            ServiceEvent::ServiceResolved(service) => {
                self.read_subnets();
                let Some((announcement, aside)) = heard(&service, &self.subnets.0) else {
                    self.ignore(&service);
                    return None;
                };
                if let Some(place) = self.ours.place(&announcement.instance) {
                    let theirs = (&*announcement.instance, &*announcement.url);
                    return if same_place(place, theirs.1) {
                        Some(MdnsEvent::Announced {
                            announcement,
                            aside,
                        })
                    } else {
                        let is_taken = |name: &str| self.there.contains_key(name);
                        self.ours.conflict(theirs, &self.subnets.0, is_taken)
                    };
                }
                self.doubted.remove(&announcement.instance);
                let outdated = self.outdated.remove(&announcement.instance);
                let is_known = self.there.contains_key(&announcement.instance);
                if is_known || self.there.len() < MOST {
                    let heard = (announcement.clone(), aside);
                    self.there.insert(announcement.instance.clone(), heard);
                }
                if !is_known && self.there.len() < MOST {
                    // At once, but not for each of many that appear together: a record is sent at
                    // most once a second.
                    self.ours.announce_soon(self.there.len());
                }
                let is_as_before = outdated.is_some_and(|(before, beside, _)| {
                    (before, beside) == (announcement.clone(), aside)
                });
                (!is_as_before).then_some(MdnsEvent::Announced {
                    announcement,
                    aside,
                })
            }
            ServiceEvent::ServiceRemoved(_, fullname) => {
                let instance = instance(&fullname)?;
                let known = self.there.remove(&instance);
                self.doubted.remove(&instance);
                if let Some((announcement, aside)) = known
                    && self.group.is_open()
                    && self.outdated.len() < MOST
                {
                    let until = Instant::now() + DOUBT;
                    self.outdated.insert(instance, (announcement, aside, until));
                    return None;
                }
                // If this program still announces the name, the goodbye is that of another server
                // of the same name.
                (!self.ours.has(&instance)).then_some(MdnsEvent::Withdrawn { instance })
            }
            _ => None,
        }
    }

    /// Reads the subnets of the interface, because its address may have changed.
    fn read_subnets(&mut self) {
        let now = Instant::now();
        if now.saturating_duration_since(self.subnets.1) >= READ_SUBNETS_EVERY {
            self.subnets = (self.interface.subnets(), now);
        }
    }

    fn ignore(&mut self, service: &ResolvedService) {
        self.ignored += 1;
        let all = service.get_addresses_v4();
        let is_elsewhere = !all.is_empty() && address(all.clone(), &self.subnets.0).is_none();
        let cause = if is_elsewhere { "address" } else { "form" };
        let Some(suppressed) = self.ignored_log.admit(cause, Instant::now().into_std()) else {
            return;
        };
        let name: String = service.fullname.chars().take(MOST_NAME).collect();
        if is_elsewhere {
            info!(
                ?name, addresses = ?all, interface = %self.interface, suppressed,
                hint = "to accept servers of this address, give --network, or set server.find_skills.networks in the mapping",
                "ignored an announcement: its address is in no subnet of the interface"
            )
        } else {
            debug!(
                ?name,
                suppressed, "ignored an announcement that is not from a server"
            )
        }
    }
}

/// Exceeds the second for which the daemon keeps a server that left (RFC 6762, 10.1).
const DOUBT: Duration = Duration::from_millis(2500);
/// Maximum number of stored instances.
const MOST: usize = 4096;
/// Maximum number of characters of a name in the log.
const MOST_NAME: usize = 256;
const READ_SUBNETS_EVERY: Duration = Duration::from_secs(1);
/// Period in which ignored announcements with the same cause are logged once.
const LOG_EVERY: Duration = Duration::from_secs(60);

#[cfg(test)]
mod tests;
