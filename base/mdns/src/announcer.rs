//! A program that announces its server and discovers no others: [`MdnsAnnouncer`].

use mdns_sd::MDNS_PORT;
use tokio::time::{Duration, Instant, sleep_until};

use crate::announcement::{MdnsEvent, MdnsFault, OwnAnnouncement, same_place};
use crate::group::GroupSocket;
use crate::interface::{MdnsInterface, Subnets};
use crate::nearby::{NearbyServers, Sighting};
use crate::own::OwnServers;

/// Announces servers on one interface. Unlike [`Mdns`](crate::Mdns) it sends no queries and stores
/// no records of others, so that hundreds of such programs on a network do not respond to each
/// other.
pub struct MdnsAnnouncer {
    ours: OwnServers,
    group: GroupSocket,
    nearby: NearbyServers,
    /// Networks of announced servers, and the time at which they were read.
    subnets: (Subnets, Instant),
    /// Events that were not yet returned.
    events: Vec<MdnsEvent>,
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
            events: Vec::new(),
        })
    }

    /// Reports the announcements of the server with this URL by [`next`](Self::next), in place of
    /// those of an earlier URL: the first one, and those of each restart.
    pub fn heed(&mut self, url: Option<&str>) {
        self.nearby.heed(url);
    }

    /// Announces a server at once, in place of the previous announcement of its name.
    pub fn put(&mut self, ours: OwnAnnouncement) {
        self.read_subnets();
        self.ours.put(ours, &self.subnets.0);
    }

    /// Withdraws the announcement of a name. The future completes after the goodbye was sent.
    pub fn take_back(&mut self, instance: &str) -> Option<impl Future<Output = ()> + Send + use<>> {
        self.ours.take_back(instance)
    }

    /// Returns the next event: an announcement of the [heeded](Self::heed) server, or a change of
    /// an own name. Cancel-safe.
    pub async fn next(&mut self) -> MdnsEvent {
        loop {
            if let Some(event) = self.events.pop() {
                return event;
            }
            let announce_at = self.ours.announce_at();
            let Self {
                ours,
                group,
                nearby,
                subnets: (subnets, _),
                ..
            } = &mut *self;
            let seen = tokio::select! {
                received = group.recv() => {
                    nearby.take(received, |name| ours.host(name), subnets, Instant::now())
                }
                () = sleep_until(announce_at) => {
                    nearby.forget(Instant::now());
                    group.reopen();
                    ours.announce_again(nearby.count());
                    self.read_subnets();
                    continue;
                }
            };
            for sighting in seen {
                let event = self.take(sighting);
                self.events.extend(event);
            }
        }
    }

    fn take(&mut self, sighting: Sighting) -> Option<MdnsEvent> {
        match sighting {
            Sighting::Newcomer => {
                self.ours.announce_soon(self.nearby.count());
                None
            }
            Sighting::Heeded {
                announcement,
                aside,
            } => Some(MdnsEvent::Announced {
                announcement,
                aside,
            }),
            Sighting::Rival { announcement } => {
                let (from, theirs) = (&*announcement.instance, &*announcement.url);
                if same_place(self.ours.place(from)?, theirs) {
                    return None;
                }
                // The names of others are not stored: another conflict is resolved like this one.
                self.ours
                    .conflict((from, theirs), &self.subnets.0, |_| false)
            }
        }
    }

    /// Reads the subnets of the interface, because its address may have changed.
    fn read_subnets(&mut self) {
        let now = Instant::now();
        if now.saturating_duration_since(self.subnets.1) >= READ_SUBNETS_EVERY {
            self.subnets = (self.ours.interface().subnets(), now);
        }
    }
}

const READ_SUBNETS_EVERY: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests;
