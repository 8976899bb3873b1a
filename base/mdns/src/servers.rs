//! Announcements by mDNS and DNS-SD (OPC 10000-12, Annex C): `_opcua-tcp._tcp.local.`, on one interface.
//!
//! What is heard comes from whoever is on the network, so it is bounded and held against what a URL and a capability may
//! look like; what does not fit is not heard, and counted.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::num::NonZeroU16;
use std::time::Duration;

use log_limit::LogLimit;
use mdns_sd::{
    DaemonEvent, IfKind, MDNS_PORT, Receiver, ResolvedService, ServiceDaemon, ServiceEvent,
    ServiceInfo,
};
use registry::{Announcement, label, renamed};
use tokio::net::UdpSocket;
use tokio::time::{Instant, sleep_until};
use tracing::{debug, info, warn};

use crate::goodbye::{goodbyes, listen};
use crate::host_name;
use crate::interface::{Interface, Subnets};
use crate::url::Url;

/// No mDNS daemon can be started.
#[derive(Debug, thiserror::Error)]
#[error("nobody can be announced or heard on {interface}: {source}")]
pub struct MdnsFault {
    interface: String,
    #[source]
    source: mdns_sd::Error,
}

impl MdnsFault {
    pub(crate) fn new(interface: &Interface, source: mdns_sd::Error) -> Self {
        Self {
            interface: interface.to_string(),
            source,
        }
    }
}

/// What is heard on the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Heard {
    /// Of a server, for the first time or with something new.
    Announced {
        /// What the server announces.
        announcement: Announcement,
        /// What programs of this project tell beside it.
        aside: Aside,
    },
    /// Of the end of a server: a goodbye, or what was heard has run out.
    Withdrawn {
        /// The instance name of the server.
        instance: String,
    },
    /// That somebody else has the name of what we announce, which is called so from now on.
    Renamed {
        /// The instance name until now.
        from: String,
        /// The instance name from now on.
        to: String,
    },
}

/// What is announced.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ours {
    /// What every reader of mDNS understands.
    pub announcement: Announcement,
    /// The keys that programs of this project add.
    pub aside: Aside,
}

/// What programs of this project tell in keys of their own, which others pass over.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Aside {
    /// When the program started, in 100 ns since 1601.
    pub start_time: Option<i64>,
    /// Its number in the space: the namespace of what it produces there.
    pub number: Option<NonZeroU16>,
}

impl Aside {
    /// That of a program without a number.
    pub const fn of_start(start_time: i64) -> Self {
        Self {
            start_time: Some(start_time),
            number: None,
        }
    }
}

/// One interface, with a thread of its own that answers and asks.
pub struct Mdns {
    interface: Interface,
    daemon: ServiceDaemon,
    events: Receiver<ServiceEvent>,
    monitor: Option<Receiver<DaemonEvent>>,
    ours: BTreeMap<String, Announced>,
    announce_at: Instant,
    /// Hears goodbyes before the daemon tells of them; without it they come a second later.
    goodbyes: Option<UdpSocket>,
    packet: Vec<u8>,
    /// Goodbyes that have not been told of yet.
    left: Vec<String>,
    /// Instances that are there, as they were heard last: a new one has not heard of ours.
    there: BTreeMap<String, (Announcement, Aside)>,
    /// What a goodbye was heard of that the daemon has not taken yet, and when it must have. A goodbye may be that of another
    /// host to a name that two had, or the server is back at once: what stays in the daemon's cache is told by nobody.
    doubted: BTreeMap<String, (Announcement, Aside, Instant)>,
    /// What the daemon holds for outdated though no goodbye was heard, and when that is told. It takes a clock that is set
    /// forward for a sleep of the machine, forgets whom it knew, and hears of them anew in a moment.
    outdated: BTreeMap<String, (Announcement, Aside, Instant)>,
    /// Where announced servers may be, and when that was read.
    subnets: (Subnets, Instant),
    ignored: u64,
    /// Ignored announcements in the log.
    ignored_log: LogLimit,
}

#[derive(Debug)]
struct Announced {
    ours: Ours,
    fullname: String,
    /// The URL that is heard of it: an address where it has a name for its host.
    place: String,
    /// How often another was heard under its name that was to give way.
    contested: u32,
}

impl Mdns {
    /// Starts to hear at once.
    pub fn open(interface: &Interface) -> Result<Self, MdnsFault> {
        Self::open_at(interface, MDNS_PORT)
    }

    fn open_at(interface: &Interface, port: u16) -> Result<Self, MdnsFault> {
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

    /// Announces a server at once, in the place of what was announced under its name.
    pub fn put(&mut self, ours: Ours) {
        let Some(info) = self.info(&ours) else {
            warn!(
                name = ours.announcement.instance,
                url = ours.announcement.url,
                "a server cannot be announced on {}: it listens on no address there, or is of another host by name",
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

    /// Takes back what is announced under a name. The goodbye has been sent when the answer comes.
    pub fn take_back(&mut self, instance: &str) -> Option<impl Future<Output = ()> + Send + use<>> {
        let announced = self.ours.remove(instance)?;
        let told = self.daemon.unregister(&announced.fullname).ok()?;
        Some(async move {
            // An error is the end of the daemon, which says goodbye for all.
            let _told = told.recv_async().await;
        })
    }

    /// How much was heard that is no announcement of a server.
    pub fn ignored(&self) -> u64 {
        self.ignored
    }

    /// What is heard next. Whoever drops it before loses nothing.
    pub async fn next(&mut self) -> Heard {
        loop {
            while let Some(instance) = self.left.pop() {
                if self.outdated.remove(&instance).is_some() {
                    return Heard::Withdrawn { instance };
                }
                if !self.ours.contains_key(&instance)
                    && let Some((announcement, aside)) = self.there.remove(&instance)
                {
                    let until = Instant::now() + DOUBT;
                    // Of more than that, whoever is back is heard with its next change.
                    if self.doubted.len() < MOST {
                        self.doubted
                            .insert(instance.clone(), (announcement, aside, until));
                    }
                    return Heard::Withdrawn { instance };
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

    /// A server to which a goodbye was heard and that the daemon has kept for longer than it keeps one that left.
    fn still_there(&mut self) -> Option<Heard> {
        let now = Instant::now();
        let mut due = self
            .doubted
            .iter()
            .filter(|(_, (_, _, until))| *until <= now);
        let instance = due.next()?.0.clone();
        let (announcement, aside, _) = self.doubted.remove(&instance)?;
        self.there.insert(instance, (announcement.clone(), aside));
        Some(Heard::Announced {
            announcement,
            aside,
        })
    }

    /// A server that is outdated, and was not heard since.
    fn not_heard_again(&mut self) -> Option<Heard> {
        let now = Instant::now();
        let mut due = self
            .outdated
            .iter()
            .filter(|(_, (_, _, until))| *until <= now);
        let instance = due.next()?.0.clone();
        self.outdated.remove(&instance);
        Some(Heard::Withdrawn { instance })
    }

    fn take_goodbyes(&mut self, heard: std::io::Result<usize>) {
        match heard {
            Ok(length) => self.left = goodbyes(self.packet.get(..length).unwrap_or_default()),
            // Opened again with the next announcement.
            Err(error) => {
                debug!(%error, "goodbyes on {} are heard a second late", self.interface);
                self.goodbyes = None;
            }
        }
    }

    /// The crate closes the channel of whoever was slow, without a word.
    async fn browse_again(&mut self) {
        debug!("hearing on {} anew", self.interface);
        match self.daemon.browse(SERVICE) {
            Ok(events) => self.events = events,
            Err(error) => {
                debug!(%error, "mDNS cannot be heard on {}", self.interface);
                tokio::time::sleep(ANNOUNCE_EVERY).await;
            }
        }
    }

    /// Late starters that ask from another port than that of mDNS are answered to that port, where some never look: they
    /// need to be told without having asked.
    fn announce_again(&mut self) {
        self.announce_at = Instant::now() + ANNOUNCE_EVERY;
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

    /// A conflict that the daemon itself resolved.
    fn follow_renames(&mut self) {
        let changes = self.monitor.iter().flat_map(Receiver::try_iter);
        for event in changes {
            if let DaemonEvent::NameChange(change) = event {
                info!(
                    from = change.original,
                    to = change.new_name,
                    "another host has that mDNS name"
                );
            }
        }
    }

    fn register(&self, info: ServiceInfo) {
        // A full queue is emptied in a moment: what is announced comes again.
        if let Err(error) = self.daemon.register(info) {
            debug!(%error, "not announced this time");
        }
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "the crate may tell more, and two say who is there"
    )]
    fn take(&mut self, event: ServiceEvent) -> Option<Heard> {
        match event {
            ServiceEvent::ServiceResolved(service) => {
                self.read_subnets();
                let Some((announcement, aside)) = heard(&service, &self.subnets.0) else {
                    self.ignore(&service);
                    return None;
                };
                if let Some(ours) = self.ours.get(&announcement.instance) {
                    let theirs = &announcement.url;
                    return match same_place(&ours.place, theirs) {
                        true => Some(Heard::Announced {
                            announcement,
                            aside,
                        }),
                        false => self.conflict(&announcement.instance, theirs),
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
                    // At once, but not for each of many that appear together: a record is sent once a second at most.
                    self.announce_at = self.announce_at.min(Instant::now() + SETTLE);
                }
                let is_as_before = outdated.is_some_and(|(before, beside, _)| {
                    (before, beside) == (announcement.clone(), aside)
                });
                (!is_as_before).then_some(Heard::Announced {
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
                // Ours is announced still: the goodbye is of another of that name.
                (!self.ours.contains_key(&instance)).then_some(Heard::Withdrawn { instance })
            }
            _ => None,
        }
    }

    /// Reads the subnets of the interface, which may have got another address.
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
        let cause = match is_elsewhere {
            true => "address",
            false => "form",
        };
        let Some(suppressed) = self.ignored_log.admit(cause, Instant::now().into_std()) else {
            return;
        };
        let name: String = service.fullname.chars().take(MOST_NAME).collect();
        match is_elsewhere {
            true => info!(
                ?name, addresses = ?all, interface = %self.interface, suppressed,
                hint = "to accept servers there: --network, or server.find_skills.networks in the mapping",
                "ignored an announcement: its address is in no subnet of the interface"
            ),
            false => debug!(
                ?name,
                suppressed, "ignored an announcement that is none of a server"
            ),
        }
    }

    /// Somebody else has one of our names (RFC 6762, 9). Of two programs of this project the one whose URL comes later gives
    /// way; who does not, though told of ours again and again, is of another make, and keeps it.
    fn conflict(&mut self, from: &str, theirs: &str) -> Option<Heard> {
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
        info!(from, to, theirs, "another server has that mDNS name");
        ours.announcement.instance.clone_from(&to);
        drop(self.take_back(from));
        self.put(ours);
        Some(Heard::Renamed {
            from: from.to_owned(),
            to,
        })
    }

    /// For the daemon. `None` where the server listens on no address of the interface.
    fn info(&self, ours: &Ours) -> Option<ServiceInfo> {
        let Announcement {
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
            // Where another host is, is not ours to say.
            None if !is_own(&url.host) => return None,
            _ => self.interface.addresses(),
        };
        let first = addresses.first()?;
        // Of its own: the goodbye of one server takes the host's address away from all that share the name. And no other
        // program of this host has it. A server that gave way to another has a new one: the goodbye to its name before
        // goes out twice, and an address is told once a second at most.
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
        // The thread ends in any case: nobody can command it any more.
        drop(self.daemon.shutdown());
    }
}

fn hear_goodbyes(interface: &Interface) -> Option<UdpSocket> {
    let socket = listen(interface);
    let why = socket.as_ref().err();
    if let Some(error) = why {
        debug!(%error, "goodbyes on {interface} are heard a second late");
    }
    socket.ok()
}

/// Whether a name is that of this host, with or without a domain.
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

/// Whether two URLs are of one endpoint.
pub fn same_place(one: &str, other: &str) -> bool {
    one.trim_end_matches('/') == other.trim_end_matches('/')
}

/// An announcement as the registry takes it.
pub fn heard(service: &ResolvedService, subnets: &Subnets) -> Option<(Announcement, Aside)> {
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
    let announcement = Announcement {
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

/// Returns the address to try. Loopback addresses of a network and addresses outside its subnets are left out.
fn address(all: impl IntoIterator<Item = Ipv4Addr>, subnets: &Subnets) -> Option<Ipv4Addr> {
    let loopback = subnets.is_loopback();
    let usable = |ip: &Ipv4Addr| {
        let one = !(ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast());
        one && (loopback || !ip.is_loopback()) && subnets.contains(*ip)
    };
    // The one that says more first: of a host with several, its loopback address means this host only.
    let all = all.into_iter().filter(usable);
    all.min_by_key(|ip| (ip.is_loopback() != loopback, ip.is_link_local(), *ip))
}

/// A code of OPC 10000-12, Annex D, or of a maker.
fn is_code(text: &str) -> bool {
    !text.is_empty() && text.len() <= 32 && text.bytes().all(|byte| byte.is_ascii_graphic())
}

/// The name in front of the service; `None` where it is no name to be shown.
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

/// The service of OPC UA servers over TCP (OPC 10000-12, Annex C).
pub const SERVICE: &str = "_opcua-tcp._tcp.local.";
/// The key of the TXT record that tells one run of a program from the next. Ours alone; others pass over it.
const START: &str = "start";
/// The key of the number in the space. Likewise.
const NUMBER: &str = "ns";
const ANNOUNCE_EVERY: Duration = Duration::from_secs(5);
const SETTLE: Duration = Duration::from_millis(200);
/// The daemon keeps a server that left for a second (RFC 6762, 10.1).
const DOUBT: Duration = Duration::from_millis(2500);
/// The largest packet of mDNS (RFC 6762, 17).
const PACKET: usize = 9000;
/// Instances that are kept in mind.
const MOST: usize = 4096;
const MOST_CAPABILITIES: usize = 32;
/// Characters of a name in the log.
const MOST_NAME: usize = 256;
const READ_SUBNETS_EVERY: Duration = Duration::from_secs(1);
/// Announcements that are ignored for one cause are logged once in this time.
const LOG_EVERY: Duration = Duration::from_secs(60);
const MOST_CONTESTED: u32 = 4;

#[cfg(test)]
mod tests {
    use super::*;

    fn here() -> Subnets {
        Subnets::of(Ipv4Addr::LOCALHOST, Ipv4Addr::new(255, 0, 0, 0))
    }

    fn network() -> Subnets {
        Subnets::of(Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(255, 255, 255, 0))
    }

    fn resolved(instance: &str, address: &str, texts: &[(&str, &str)]) -> ResolvedService {
        let info = ServiceInfo::new(SERVICE, instance, "host.local.", address, 4841, texts);
        info.unwrap().as_resolved_service()
    }

    #[test]
    fn an_announcement_is_read_as_a_url_and_capabilities() {
        let texts = [
            ("path", "/arm"),
            ("caps", "DA, HD,,AC"),
            ("start", "17"),
            ("ns", "7"),
        ];
        let (announcement, aside) =
            heard(&resolved("arm.left", "127.0.0.1", &texts), &here()).unwrap();
        assert_eq!(announcement.instance, "arm.left");
        assert_eq!(announcement.url, "opc.tcp://127.0.0.1:4841/arm");
        assert_eq!(announcement.capabilities, ["DA", "HD", "AC"]);
        assert_eq!(aside.start_time, Some(17));
        assert_eq!(aside.number, NonZeroU16::new(7));
    }

    #[test]
    fn hostile_records_are_not_heard() {
        let plain = [("path", "/")];
        for (what, service, subnets) in [
            (
                "a line break in the name",
                resolved("a\nb", "127.0.0.1", &plain),
                here(),
            ),
            (
                "a line break in the path",
                resolved("a", "127.0.0.1", &[("path", "/\r\nX: y")]),
                here(),
            ),
            (
                "our own host, from the network",
                resolved("a", "127.0.0.1", &plain),
                network(),
            ),
            (
                "an address outside the subnets of the interface",
                resolved("a", "10.0.1.9", &plain),
                network(),
            ),
            (
                "no address of a host",
                resolved("a", "224.0.0.1", &plain),
                network(),
            ),
        ] {
            assert_eq!(heard(&service, &subnets), None, "{what}");
        }
        let many = vec!["X"; 200].join(",");
        let (kept, _) = heard(
            &resolved("a", "10.0.0.1", &[("caps", many.get(..250).unwrap())]),
            &network(),
        )
        .unwrap();
        assert_eq!(kept.capabilities.len(), MOST_CAPABILITIES);
        assert_eq!(instance("._opcua-tcp._tcp.local."), None);
        assert_eq!(instance("x._http._tcp.local."), None);
    }

    #[test]
    fn of_several_addresses_that_of_the_network_is_taken() {
        let all = || ["127.0.0.1", "169.254.7.7", "10.0.0.2"].map(|ip| ip.parse().unwrap());
        assert_eq!(address(all(), &network()), Some(Ipv4Addr::new(10, 0, 0, 2)));
        assert_eq!(address(all(), &here()), Some(Ipv4Addr::LOCALHOST));
    }

    #[tokio::test]
    async fn of_two_servers_with_one_name_one_is_called_otherwise() {
        // On a port of its own, so that no other program on this host takes part.
        let port = 20_000 + u16::try_from(std::process::id() % 20_000).unwrap();
        let open = |url: &str| {
            let mut mdns = Mdns::open_at(&Interface::LOOPBACK, port).unwrap();
            mdns.put(Ours {
                announcement: Announcement {
                    instance: "arm".to_owned(),
                    url: url.to_owned(),
                    capabilities: Vec::new(),
                },
                aside: Aside::default(),
            });
            mdns
        };
        let (mut one, mut other) = (
            open("opc.tcp://127.0.0.1:1001/"),
            open("opc.tcp://127.0.0.1:1002/"),
        );
        let renamed = async {
            loop {
                let (heard, first) = tokio::select! {
                    heard = one.next() => (heard, true),
                    heard = other.next() => (heard, false),
                };
                if let Heard::Renamed { from, to } = heard {
                    return (from, to, first);
                }
            }
        };
        let limit = Duration::from_secs(20);
        let (from, to, first) = tokio::time::timeout(limit, renamed).await.unwrap();
        assert_eq!((&*from, &*to), ("arm", "arm (2)"));
        assert!(!first, "the one whose URL comes later gives way");
    }
}
