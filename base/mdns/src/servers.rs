//! Announcements by mDNS and DNS-SD (OPC 10000-12, Annex C): `_opcua-tcp._tcp.local.`, on one
//! interface.
//!
//! Any host on the network can send announcements, so their number is bounded, and URLs and
//! capabilities are validated. Invalid announcements are ignored and counted.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::num::NonZeroU16;
use std::ops::RangeInclusive;
use std::time::Duration;

use log_limit::LogLimit;
use mdns_sd::{
    DaemonEvent, IfKind, MDNS_PORT, Receiver, ResolvedService, ServiceDaemon, ServiceEvent,
    ServiceInfo,
};
use registry::{AnnouncedServer, label, renamed};
use tokio::net::UdpSocket;
use tokio::time::{Instant, sleep_until};
use tracing::{debug, info, warn};

use crate::goodbye::{goodbyes, listen};
use crate::host_name;
use crate::interface::{MdnsInterface, Subnets};
use crate::url::Url;

/// Error of starting the mDNS daemon.
#[derive(Debug, thiserror::Error)]
#[error("cannot use mDNS on {interface}: {source}")]
pub struct MdnsFault {
    interface: String,
    #[source]
    source: mdns_sd::Error,
}

impl MdnsFault {
    pub(crate) fn new(interface: &MdnsInterface, source: mdns_sd::Error) -> Self {
        Self {
            interface: interface.to_string(),
            source,
        }
    }
}

/// Event on the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MdnsEvent {
    /// A server was announced for the first time or with changes.
    Announced {
        /// Announcement of the server.
        announcement: AnnouncedServer,
        /// Additional properties of programs of this project.
        aside: Aside,
    },
    /// A server has ended: a goodbye was received, or its announcement has expired.
    Withdrawn {
        /// The instance name of the server.
        instance: String,
    },
    /// Another host has the name of an announced server, which is renamed.
    Renamed {
        /// The previous instance name.
        from: String,
        /// The new instance name.
        to: String,
    },
}

/// An announcement of this program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnAnnouncement {
    /// The standard part of the announcement.
    pub announcement: AnnouncedServer,
    /// The keys that programs of this project add.
    pub aside: Aside,
}

/// Additional properties of programs of this project, in TXT keys that other programs ignore.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Aside {
    /// Start time of the program, in 100 ns since 1601.
    pub start_time: Option<i64>,
    /// Number of the program in the space: the namespace of its values there.
    pub number: Option<NonZeroU16>,
}

impl Aside {
    /// Returns the properties of a program without a number.
    pub const fn of_start(start_time: i64) -> Self {
        Self {
            start_time: Some(start_time),
            number: None,
        }
    }
}

/// mDNS on one interface, with a thread of its own for queries and responses.
pub struct Mdns {
    interface: MdnsInterface,
    daemon: ServiceDaemon,
    events: Receiver<ServiceEvent>,
    monitor: Option<Receiver<DaemonEvent>>,
    ours: BTreeMap<String, Announced>,
    announce_at: Instant,
    /// Receives goodbyes before the daemon reports them; without this socket they are a second
    /// late.
    goodbyes: Option<UdpSocket>,
    packet: Vec<u8>,
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

#[derive(Debug)]
struct Announced {
    ours: OwnAnnouncement,
    fullname: String,
    /// The URL in the received announcement: with an address in place of a host name.
    place: String,
    /// Number of announcements of another server under this name that had to give way.
    contested: u32,
}

impl Mdns {
    /// Opens an interface and starts to receive announcements at once.
    pub fn open(interface: &MdnsInterface) -> Result<Self, MdnsFault> {
        Self::open_at(interface, MDNS_PORT)
    }

    fn open_at(interface: &MdnsInterface, port: u16) -> Result<Self, MdnsFault> {
        let fault = |source| MdnsFault::new(interface, source);
        let daemon = ServiceDaemon::new_with_port(port).map_err(fault)?;
        daemon.disable_interface(IfKind::All).map_err(fault)?;
        daemon.enable_interface(interface.kind()).map_err(fault)?;
        let events = daemon.browse(SERVICE).map_err(fault)?;
        let monitor = daemon.monitor().ok();
        Ok(Self {
            interface: interface.clone(),
            daemon,
            events,
            monitor,
            ours: BTreeMap::new(),
            announce_at: Instant::now() + ANNOUNCE_EVERY,
            goodbyes: hear_goodbyes(interface),
            packet: vec![0; PACKET],
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
        let Some(info) = self.info(&ours) else {
            warn!(
                name = ours.announcement.instance,
                url = ours.announcement.url,
                "cannot announce a server on {}: it does not listen on an address of this interface, or its host name belongs to another host",
                self.interface
            );
            return;
        };
        let fullname = info.get_fullname().to_owned();
        let place = heard(&info.clone().as_resolved_service(), &self.subnets.0);
        let place = place.map_or_else(
            || ours.announcement.url.clone(),
            |(announcement, _)| announcement.url,
        );
        self.register(info);
        let instance = ours.announcement.instance.clone();
        let announced = Announced {
            ours,
            fullname,
            place,
            contested: 0,
        };
        self.ours.insert(instance, announced);
    }

    /// Withdraws the announcement of a name. The future completes after the goodbye was sent.
    pub fn take_back(&mut self, instance: &str) -> Option<impl Future<Output = ()> + Send + use<>> {
        let announced = self.ours.remove(instance)?;
        let told = self.daemon.unregister(&announced.fullname).ok()?;
        Some(async move {
            // An error is the end of the daemon, which sends all goodbyes.
            let _told = told.recv_async().await;
        })
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
                if !self.ours.contains_key(&instance)
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
            let announce_at = self.announce_at;
            let waiting = self.doubted.values().chain(self.outdated.values());
            let due = waiting.map(|(_, _, until)| *until).min();
            let wake_at = due.map_or(announce_at, |until| until.min(announce_at));
            let Self {
                goodbyes,
                packet,
                events,
                ..
            } = &mut *self;
            let heard = async {
                match goodbyes {
                    Some(socket) => socket.recv(packet).await,
                    None => std::future::pending().await,
                }
            };
            let event = tokio::select! {
                event = events.recv_async() => event,
                heard = heard => {
                    self.take_goodbyes(heard);
                    continue;
                }
                () = sleep_until(wake_at) => {
                    if Instant::now() >= announce_at {
                        self.announce_again();
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

    fn take_goodbyes(&mut self, heard: std::io::Result<usize>) {
        match heard {
            Ok(length) => self.left = goodbyes(self.packet.get(..length).unwrap_or_default()),
            // Opened again with the next announcement.
            Err(error) => {
                debug!(%error, "goodbyes on {} are received a second late", self.interface);
                self.goodbyes = None;
            }
        }
    }

    /// Opens the channel again, which the crate closes without notice for a slow receiver.
    async fn browse_again(&mut self) {
        debug!("receiving mDNS on {} again", self.interface);
        match self.daemon.browse(SERVICE) {
            Ok(events) => self.events = events,
            Err(error) => {
                debug!(%error, "cannot receive mDNS on {}", self.interface);
                tokio::time::sleep(ANNOUNCE_EVERY).await;
            }
        }
    }

    /// Plans an announcement for a new or changed server, which is not one for each of many servers
    /// that appear together.
    fn announce_soon(&mut self) {
        let settled = Instant::now() + shared(SETTLE..=SETTLE_LATE, self.there.len());
        self.announce_at = self.announce_at.min(settled);
    }

    /// Repeats the announcements. A late starter that sends its query from another port than that
    /// of mDNS gets the response at that port. Some programs do not listen there, and need
    /// announcements without a query.
    fn announce_again(&mut self) {
        self.announce_at =
            Instant::now() + shared(ANNOUNCE_EVERY..=ANNOUNCE_SELDOM, self.there.len());
        self.follow_renames();
        if self.goodbyes.is_none() {
            self.goodbyes = hear_goodbyes(&self.interface);
        }
        let infos: Vec<ServiceInfo> = self
            .ours
            .values()
            .filter_map(|ours| self.info(&ours.ours))
            .collect();
        for info in infos {
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
                if let Some(ours) = self.ours.get(&announcement.instance) {
                    let theirs = &announcement.url;
                    return if same_place(&ours.place, theirs) {
                        Some(MdnsEvent::Announced {
                            announcement,
                            aside,
                        })
                    } else {
                        self.conflict(&announcement.instance, theirs)
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
                    self.announce_soon();
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
                    && self.goodbyes.is_some()
                    && self.outdated.len() < MOST
                {
                    let until = Instant::now() + DOUBT;
                    self.outdated.insert(instance, (announcement, aside, until));
                    return None;
                }
                // If this program still announces the name, the goodbye is that of another server
                // of the same name.
                (!self.ours.contains_key(&instance)).then_some(MdnsEvent::Withdrawn { instance })
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

    /// Resolves a conflict for a name of this program (RFC 6762, 9). Of two programs of this
    /// project, the program with the later URL gives way. A program that does not give way in spite
    /// of repeated announcements is of another manufacturer, and keeps the name.
    fn conflict(&mut self, from: &str, theirs: &str) -> Option<MdnsEvent> {
        let announced = self.ours.get_mut(from)?;
        announced.contested += 1;
        let first = *announced.place < *theirs;
        if first && announced.contested < MOST_CONTESTED {
            self.announce_at = self.announce_at.min(Instant::now() + SETTLE);
            return None;
        }
        let mut ours = announced.ours.clone();
        let mut to = renamed(from);
        while self.there.contains_key(&to) || self.ours.contains_key(&to) {
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
        self.put(ours);
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

impl Drop for Mdns {
    fn drop(&mut self) {
        for announced in self.ours.values() {
            drop(self.daemon.unregister(&announced.fullname));
        }
        // The thread ends in any case: it has no more senders of commands.
        drop(self.daemon.shutdown());
    }
}

fn hear_goodbyes(interface: &MdnsInterface) -> Option<UdpSocket> {
    let socket = listen(interface);
    let why = socket.as_ref().err();
    if let Some(error) = why {
        debug!(%error, "goodbyes on {interface} are received a second late");
    }
    socket.ok()
}

/// Returns whether a name is that of this host, with or without a domain.
pub fn is_own(name: &str) -> bool {
    let first = |name: &str| {
        name.split('.')
            .next()
            .unwrap_or_default()
            .to_ascii_lowercase()
    };
    let name = first(name);
    name == "localhost" || name == first(&host_name())
}

/// Returns whether two URLs have the same endpoint.
pub fn same_place(one: &str, other: &str) -> bool {
    one.trim_end_matches('/') == other.trim_end_matches('/')
}

/// Converts a received announcement for the registry.
pub fn heard(service: &ResolvedService, subnets: &Subnets) -> Option<(AnnouncedServer, Aside)> {
    let instance = instance(&service.fullname)?;
    let text = |key| service.get_property_val(key).flatten();
    let path = match text("path").map(std::str::from_utf8) {
        None => "",
        Some(Ok(path)) if path.bytes().all(|byte| byte.is_ascii_graphic()) => path,
        Some(_) => return None,
    };
    let slash = if path.is_empty() || path.starts_with('/') {
        ""
    } else {
        "/"
    };
    let ip = address(service.get_addresses_v4(), subnets)?;
    let port = service.port;
    if port == 0 {
        return None;
    }
    let url = Url::of(IpAddr::V4(ip), port, &format!("{slash}{path}")).to_string();
    let texts = |key| text(key).and_then(|value| std::str::from_utf8(value).ok());
    let capabilities = texts("caps").unwrap_or_default().split(',').map(str::trim);
    let capabilities = capabilities
        .filter(|code| is_code(code))
        .take(MOST_CAPABILITIES);
    let announcement = AnnouncedServer {
        instance,
        url,
        capabilities: capabilities.map(str::to_owned).collect(),
    };
    let aside = Aside {
        start_time: texts(START).and_then(|at| at.parse().ok()),
        number: texts(NUMBER).and_then(|number| number.parse().ok()),
    };
    Some((announcement, aside))
}

/// Returns the address to try. Loopback addresses of a network and addresses outside its subnets
/// are excluded.
fn address(all: impl IntoIterator<Item = Ipv4Addr>, subnets: &Subnets) -> Option<Ipv4Addr> {
    let loopback = subnets.is_loopback();
    let usable = |ip: &Ipv4Addr| {
        let one = !(ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast());
        one && (loopback || !ip.is_loopback()) && subnets.contains(*ip)
    };
    // The more specific address first: a loopback address among several addresses is valid on its
    // own host only.
    let all = all.into_iter().filter(usable);
    all.min_by_key(|ip| (ip.is_loopback() != loopback, ip.is_link_local(), *ip))
}

/// Returns whether a text is a code of OPC 10000-12, Annex D, or of a manufacturer.
fn is_code(text: &str) -> bool {
    !text.is_empty() && text.len() <= 32 && text.bytes().all(|byte| byte.is_ascii_graphic())
}

/// Returns the name before the service, or `None` if the name cannot be displayed.
fn instance(fullname: &str) -> Option<String> {
    let at = fullname.len().checked_sub(SERVICE.len() + 1)?;
    let (name, service) = fullname.split_at_checked(at)?;
    let service = service.strip_prefix('.')?;
    if !service.eq_ignore_ascii_case(SERVICE) || name.is_empty() {
        return None;
    }
    let name = name.replace("\\.", ".").replace("\\\\", "\\");
    (label(&name) == name).then_some(name)
}

/// Returns a time in the range that grows with the number of servers: each of them receives the
/// announcements of all others.
fn shared(range: RangeInclusive<Duration>, servers: usize) -> Duration {
    let (least, most) = range.into_inner();
    let servers = u32::try_from(servers).unwrap_or(u32::MAX);
    let wanted = least.saturating_mul(servers) / SERVERS_AT_FULL_RATE;
    wanted.clamp(least, most)
}

/// The service of OPC UA servers over TCP (OPC 10000-12, Annex C).
pub const SERVICE: &str = "_opcua-tcp._tcp.local.";
/// The key of the TXT record with the start time, which distinguishes the runs of a program. Only
/// programs of this project use it.
const START: &str = "start";
/// The key of the TXT record with the number in the space. Only programs of this project use it.
const NUMBER: &str = "ns";
const ANNOUNCE_EVERY: Duration = Duration::from_secs(5);
/// Half of the time for which records of addresses are valid (RFC 6762, 10).
const ANNOUNCE_SELDOM: Duration = Duration::from_secs(60);
const SETTLE: Duration = Duration::from_millis(200);
const SETTLE_LATE: Duration = Duration::from_secs(5);
/// The number of servers above which announcements become less frequent.
const SERVERS_AT_FULL_RATE: u32 = 8;
/// Exceeds the second for which the daemon keeps a server that left (RFC 6762, 10.1).
const DOUBT: Duration = Duration::from_millis(2500);
/// The largest packet of mDNS (RFC 6762, 17).
const PACKET: usize = 9000;
/// Maximum number of stored instances.
const MOST: usize = 4096;
const MOST_CAPABILITIES: usize = 32;
/// Maximum number of characters of a name in the log.
const MOST_NAME: usize = 256;
const READ_SUBNETS_EVERY: Duration = Duration::from_secs(1);
/// Period in which ignored announcements with the same cause are logged once.
const LOG_EVERY: Duration = Duration::from_secs(60);
const MOST_CONTESTED: u32 = 4;

#[cfg(test)]
mod tests;
