//! The servers that this program announces, and the daemon that announces them.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::ops::RangeInclusive;
use std::time::Duration;

use mdns_sd::{DaemonEvent, IfKind, Receiver, ServiceDaemon, ServiceInfo};
use registry::{AnnouncedServer, renamed};
use tokio::time::Instant;
use tracing::{debug, info, warn};

use crate::announcement::{
    Aside, MdnsEvent, MdnsFault, NUMBER, OwnAnnouncement, SERVICE, START, heard, is_own,
};
use crate::interface::{MdnsInterface, Subnets};
use crate::url::Url;

/// The announcements of this program on one interface, with a thread of its own that responds to
/// queries. They are withdrawn on drop.
pub(crate) struct OwnServers {
    interface: MdnsInterface,
    daemon: ServiceDaemon,
    monitor: Option<Receiver<DaemonEvent>>,
    ours: BTreeMap<String, Announced>,
    announce_at: Instant,
    /// The time of the last repetition of the announcements.
    announced_at: Option<Instant>,
}

#[derive(Debug)]
struct Announced {
    ours: OwnAnnouncement,
    /// `None` while the server listens on no address of the interface.
    sent: Option<SentRecords>,
    /// Number of announcements of another server under this name that had to give way.
    contested: u32,
    /// The time of the last of them.
    contested_at: Option<Instant>,
}

/// The records of an announcement.
#[derive(Debug)]
struct SentRecords {
    fullname: String,
    /// The URL in the received announcement: with an address in place of a host name.
    place: String,
    /// The host name of the announcement, which is unique.
    host: String,
}

impl SentRecords {
    fn of(info: &ServiceInfo, ours: &OwnAnnouncement, subnets: &Subnets) -> Self {
        let place = heard(&info.clone().as_resolved_service(), subnets);
        let place = place.map_or_else(
            || ours.announcement.url.clone(),
            |(announcement, _)| announcement.url,
        );
        Self {
            fullname: info.get_fullname().to_owned(),
            place,
            host: info.get_hostname().to_owned(),
        }
    }
}

impl OwnServers {
    pub(crate) fn open(interface: &MdnsInterface, port: u16) -> Result<Self, MdnsFault> {
        let fault = |source| MdnsFault::new(interface, source);
        let daemon = ServiceDaemon::new_with_port(port).map_err(fault)?;
        daemon.disable_interface(IfKind::All).map_err(fault)?;
        daemon.enable_interface(interface.kind()).map_err(fault)?;
        let monitor = daemon.monitor().ok();
        Ok(Self {
            interface: interface.clone(),
            daemon,
            monitor,
            ours: BTreeMap::new(),
            announce_at: Instant::now() + ANNOUNCE_EVERY,
            announced_at: None,
        })
    }

    pub(crate) const fn interface(&self) -> &MdnsInterface {
        &self.interface
    }

    pub(crate) const fn daemon(&self) -> &ServiceDaemon {
        &self.daemon
    }

    /// Announces a server at once, in place of the previous announcement of its name; or as soon as
    /// the interface has its address.
    pub(crate) fn put(&mut self, ours: OwnAnnouncement, subnets: &Subnets) {
        let info = self.info(&ours);
        if info.is_none() {
            warn!(
                name = ours.announcement.instance,
                url = ours.announcement.url,
                "cannot announce a server on {}: it does not listen on an address of this interface, or its host name belongs to another host",
                self.interface
            );
        }
        let instance = ours.announcement.instance.clone();
        let announced = Announced {
            sent: info
                .as_ref()
                .map(|info| SentRecords::of(info, &ours, subnets)),
            contested: 0,
            contested_at: None,
            ours,
        };
        if let Some(info) = info {
            self.register(info);
        }
        self.ours.insert(instance, announced);
    }

    /// Withdraws the announcement of a name. The future completes after the goodbye was sent.
    pub(crate) fn take_back(
        &mut self,
        instance: &str,
    ) -> Option<impl Future<Output = ()> + Send + use<>> {
        let sent = self.ours.remove(instance)?.sent?;
        let told = self.daemon.unregister(&sent.fullname).ok()?;
        Some(async move {
            // An error is the end of the daemon, which sends all goodbyes.
            let _told = told.recv_async().await;
        })
    }

    /// Returns whether this program announces a name.
    pub(crate) fn has(&self, instance: &str) -> bool {
        self.sent(instance).is_some()
    }

    /// Returns the URL in the announcement of a name of this program.
    pub(crate) fn place(&self, instance: &str) -> Option<&str> {
        Some(&self.sent(instance)?.place)
    }

    /// Returns the port and the host name in the announcement of a name of this program.
    pub(crate) fn host(&self, instance: &str) -> Option<(u16, &str)> {
        let announced = self.ours.get(instance)?;
        let port = Url::parse(&announced.ours.announcement.url)?.port;
        Some((port, &announced.sent.as_ref()?.host))
    }

    /// Returns the names of this program.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.ours.keys().map(String::as_str)
    }

    fn sent(&self, instance: &str) -> Option<&SentRecords> {
        self.ours.get(instance)?.sent.as_ref()
    }

    /// Returns the time of the next announcement.
    pub(crate) const fn announce_at(&self) -> Instant {
        self.announce_at
    }

    /// Plans an announcement for a new or changed server, which is not one for each of many servers
    /// that appear together. Any host can pretend to be a new server, so announcements are not
    /// repeated more often than usual.
    pub(crate) fn announce_soon(&mut self, servers: usize) {
        let now = Instant::now();
        self.announce_at = self.announce_at.min(soon(now, self.announced_at, servers));
    }

    /// Repeats the announcements, and plans the next. A late starter that sends its query from
    /// another port than that of mDNS gets the response at that port. Some programs do not listen
    /// there, and need announcements without a query.
    pub(crate) fn announce_again(&mut self, servers: usize, subnets: &Subnets) {
        let now = Instant::now();
        self.announced_at = Some(now);
        self.announce_at = now + shared(ANNOUNCE_EVERY..=ANNOUNCE_SELDOM, servers);
        self.follow_renames();
        let infos = self.ours.iter().filter_map(|(instance, announced)| {
            Some((instance.clone(), self.info(&announced.ours)?))
        });
        for (instance, info) in infos.collect::<Vec<_>>() {
            if let Some(announced) = self.ours.get_mut(&instance) {
                // The address of the interface may have changed.
                announced.sent = Some(SentRecords::of(&info, &announced.ours, subnets));
            }
            self.register(info);
        }
    }

    /// Logs the conflicts that the daemon itself resolved.
    fn follow_renames(&mut self) {
        let changes = self.monitor.iter().flat_map(Receiver::try_iter);
        for event in changes {
            if let DaemonEvent::NameChange(change) = event {
                info!(
                    from = change.original,
                    to = change.new_name,
                    "another host uses the mDNS name: this server is announced with another name"
                );
            }
        }
    }

    fn register(&self, info: ServiceInfo) {
        // A full queue is emptied in a moment, and announcements are repeated.
        if let Err(error) = self.daemon.register(info) {
            debug!(%error, "cannot send an announcement");
        }
    }

    /// Resolves a conflict for a name of this program (RFC 6762, 9). Of two programs of this
    /// project, the program with the later URL gives way. A program that does not give way in spite
    /// of repeated announcements is of another manufacturer, and keeps the name. `is_taken` returns
    /// whether another server has a name.
    pub(crate) fn conflict(
        &mut self,
        (from, theirs): (&str, &str),
        subnets: &Subnets,
        is_taken: impl Fn(&str) -> bool,
    ) -> Option<MdnsEvent> {
        let now = Instant::now();
        let announced = self.ours.get_mut(from)?;
        let first = *announced.sent.as_ref()?.place < *theirs;
        let answered = announced.contested_at.map(|at| at + CONTEST_AGAIN);
        if first && answered.is_some_and(|until| now < until) {
            // An announcement that was sent before the answer of this program.
            return None;
        }
        announced.contested += 1;
        announced.contested_at = Some(now);
        if first && announced.contested < MOST_CONTESTED {
            self.announce_at = self.announce_at.min(now + SETTLE);
            return None;
        }
        let mut ours = announced.ours.clone();
        let mut to = renamed(from);
        while is_taken(&to) || self.ours.contains_key(&to) {
            to = renamed(&to);
        }
        info!(
            from,
            to,
            theirs,
            "another server uses the mDNS name: this server is announced with another name"
        );
        ours.announcement.instance.clone_from(&to);
        drop(self.take_back(from));
        self.put(ours, subnets);
        Some(MdnsEvent::Renamed {
            from: from.to_owned(),
            to,
        })
    }

    /// Returns an announcement for the daemon, or `None` if the server listens on no address of the
    /// interface.
    fn info(&self, ours: &OwnAnnouncement) -> Option<ServiceInfo> {
        let AnnouncedServer {
            instance,
            url,
            capabilities,
        } = &ours.announcement;
        let url = Url::parse(url)?;
        let addresses = match url.ip() {
            Some(IpAddr::V4(ip)) if ip.is_loopback() && !self.interface.is_loopback() => {
                return None;
            }
            Some(IpAddr::V4(ip)) if !ip.is_unspecified() => vec![ip],
            Some(IpAddr::V6(ip)) if !ip.is_unspecified() => return None,
            // The address of another host is unknown to this program.
            None if !is_own(&url.host) => return None,
            _ => self.interface.addresses(),
        };
        let first = addresses.first()?;
        // A unique host name: the goodbye of a server removes the host's address from all servers
        // that share the name. No other program of this host has this name. A server that was
        // renamed after a conflict gets a new host name. The reason is that the goodbye to its
        // previous name is sent twice, and an address is sent at most once a second.
        let host = first.to_string().replace('.', "-");
        let number = instance
            .strip_suffix(')')
            .and_then(|name| name.rsplit_once(" ("))
            .and_then(|(_, number)| number.parse::<u32>().ok())
            .map_or_else(String::new, |number| format!("-{number}"));
        let host = format!("ua-{host}-{}{number}.local.", url.port);
        let addresses: Vec<IpAddr> = addresses.iter().copied().map(IpAddr::V4).collect();
        let path = match url.path.as_str() {
            "" => "/",
            path => path,
        };
        let mut texts = vec![
            ("path".to_owned(), path.to_owned()),
            ("caps".to_owned(), capabilities.join(",")),
        ];
        let Aside { start_time, number } = ours.aside;
        texts.extend(start_time.map(|at| (START.to_owned(), at.to_string())));
        texts.extend(number.map(|number| (NUMBER.to_owned(), number.to_string())));
        let info = ServiceInfo::new(SERVICE, instance, &host, &*addresses, url.port, &*texts);
        let mut info = info.ok()?;
        info.set_requires_probe(false);
        Some(info)
    }
}

impl Drop for OwnServers {
    fn drop(&mut self) {
        for sent in self.ours.values().filter_map(|ours| ours.sent.as_ref()) {
            drop(self.daemon.unregister(&sent.fullname));
        }
        // The thread ends in any case: it has no more senders of commands.
        drop(self.daemon.shutdown());
    }
}

/// Returns a time in the range that grows with the number of servers: each of them receives the
/// announcements of all others.
pub(crate) fn shared(range: RangeInclusive<Duration>, servers: usize) -> Duration {
    let (least, most) = range.into_inner();
    let servers = u32::try_from(servers).unwrap_or(u32::MAX);
    let wanted = least.saturating_mul(servers) / SERVERS_AT_FULL_RATE;
    wanted.clamp(least, most)
}

/// Returns the time of the next announcement for a new server, after the last announcement.
fn soon(now: Instant, last: Option<Instant>, servers: usize) -> Instant {
    let settled = now + shared(SETTLE..=SETTLE_LATE, servers);
    last.map_or(settled, |last| settled.max(last + ANNOUNCE_EVERY))
}

pub(crate) const ANNOUNCE_EVERY: Duration = Duration::from_secs(5);
/// Half of the time for which records of addresses are valid (RFC 6762, 10).
pub(crate) const ANNOUNCE_SELDOM: Duration = Duration::from_secs(60);
pub(crate) const SETTLE: Duration = Duration::from_millis(200);
pub(crate) const SETTLE_LATE: Duration = Duration::from_secs(5);
/// The number of servers above which announcements become less frequent.
pub(crate) const SERVERS_AT_FULL_RATE: u32 = 8;
const MOST_CONTESTED: u32 = 4;
/// Time in which another program receives an announcement of this program and gives way.
const CONTEST_AGAIN: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn announcements_become_less_frequent_with_the_number_of_servers() {
        let ms = Duration::from_millis;
        let soon = |servers| shared(SETTLE..=SETTLE_LATE, servers);
        assert_eq!([0, 8, 100].map(soon), [ms(200), ms(200), ms(2_500)]);
        // Invented servers do not silence this program.
        assert_eq!(soon(usize::MAX), SETTLE_LATE);
        let now = Instant::now();
        let after = |ago| super::soon(now, Some(now - ms(ago)), 1) - now;
        assert_eq!(super::soon(now, None, 1) - now, SETTLE);
        // Many queries of a host do not cause many announcements.
        assert_eq!(
            [0, 4_000, 10_000].map(after),
            [ms(5_000), ms(1_000), SETTLE]
        );
        let again = |servers| shared(ANNOUNCE_EVERY..=ANNOUNCE_SELDOM, servers);
        assert_eq!([1, 100].map(again), [ms(5_000), ms(60_000)]);
    }
}
