//! Announcements by mDNS of bridges, which carry a space but are not OPC UA servers:
//! `_uadp._udp.local.`
//!
//! The service of OPC 10000-12 is for servers only. A bridge has no server; it announces its space
//! and its PubSub group under a service of its own.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::str::FromStr;
use std::time::Duration;

use mdns_sd::{
    DaemonEvent, IfKind, MDNS_PORT, Receiver, ResolvedService, ServiceDaemon, ServiceEvent,
    ServiceInfo,
};
use registry::label;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tracing::{debug, info, warn};

use crate::announcement::MdnsFault;
use crate::host_name;
use crate::interface::MdnsInterface;

/// The command line option for the announcement of a bridge.
#[derive(Debug, Clone, PartialEq, Eq, clap::Args)]
pub struct TellingArguments {
    /// Where mDNS announces this bridge: an interface, by name or address; `group`, the interface
    /// of the PubSub group, or only this host if none is given; or `none`
    #[arg(
        long = "mdns",
        value_name = "NAME|ADDRESS|CHOICE",
        env = "UA_MDNS",
        default_value = "group"
    )]
    pub telling: Telling,
}

/// A bridge of a space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bridge {
    /// Name of the program, such as `bridge-ros1`.
    pub program: String,
    /// ApplicationUri of the bridge.
    pub uri: String,
    /// Number of the space.
    pub space: u16,
    /// PubSub group of the bridge.
    pub group: SocketAddr,
}

/// A bridge announced on the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HeardBridge {
    /// Instance name on the network.
    pub name: String,
    /// Address of the host.
    pub host: Ipv4Addr,
    /// Announced properties.
    pub bridge: Bridge,
}

/// The network on which a bridge is announced.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Telling {
    /// The network of the PubSub group; without a group, only this host.
    #[default]
    Group,
    /// No network.
    Nowhere,
    /// The network of this interface.
    On(MdnsInterface),
}

impl FromStr for Telling {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text {
            "none" => Self::Nowhere,
            "group" => Self::Group,
            interface => Self::On(MdnsInterface::parse(interface)),
        })
    }
}

/// An announcement of a bridge, which is withdrawn on drop.
pub struct ToldBridge {
    daemon: ServiceDaemon,
    fullname: String,
    /// Checks that the announcement is sent.
    looking: JoinHandle<()>,
}

impl fmt::Debug for ToldBridge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ToldBridge")
            .field("fullname", &self.fullname)
            .finish_non_exhaustive()
    }
}

/// Announces a bridge on the selected network; `group` is the interface of its PubSub group.
/// Returns `None` if no network is selected, or if the bridge cannot be announced, which is logged.
/// Needs a tokio runtime.
#[must_use]
pub fn tell_bridge(bridge: &Bridge, telling: &Telling, group: Option<&str>) -> Option<ToldBridge> {
    let interface = match telling {
        Telling::Nowhere => return None,
        Telling::On(interface) => interface.clone(),
        Telling::Group => group.map_or(MdnsInterface::LOOPBACK, MdnsInterface::parse),
    };
    match told(bridge, &interface) {
        Ok(told) => Some(told),
        Err(fault) => {
            warn!("cannot announce this bridge by mDNS: {fault}");
            None
        }
    }
}

fn told(bridge: &Bridge, interface: &MdnsInterface) -> Result<ToldBridge, MdnsFault> {
    let fault = |source| MdnsFault::new(interface, source);
    let addresses = interface.addresses();
    let Some(first) = addresses.first() else {
        return Err(fault(mdns_sd::Error::Msg(
            "it has no IPv4 address".to_owned(),
        )));
    };
    let daemon = ServiceDaemon::new_with_port(MDNS_PORT).map_err(fault)?;
    let monitor = daemon.monitor().map_err(fault)?;
    daemon.disable_interface(IfKind::All).map_err(fault)?;
    daemon.enable_interface(interface.kind()).map_err(fault)?;
    let info = info_of(bridge, (&addresses, *first)).map_err(fault)?;
    let fullname = info.get_fullname().to_owned();
    daemon.register(info).map_err(fault)?;
    Ok(ToldBridge {
        daemon,
        fullname,
        looking: tokio::spawn(look(monitor, interface.clone())),
    })
}

fn info_of(
    bridge: &Bridge,
    (addresses, first): (&[Ipv4Addr], Ipv4Addr),
) -> Result<ServiceInfo, mdns_sd::Error> {
    let Bridge {
        program,
        uri,
        space,
        group,
    } = bridge;
    let instance = label(&format!("{program} space {space} on {}", host_name()));
    let host = first.to_string().replace('.', "-");
    // A host name of its own, like the host name of a server.
    let host = format!("ua-{host}-space-{space}-{}.local.", std::process::id());
    let addresses: Vec<IpAddr> = addresses.iter().copied().map(IpAddr::V4).collect();
    let texts = [
        (PROGRAM, program.clone()),
        (URI, uri.clone()),
        (SPACE, space.to_string()),
        (GROUP, group.to_string()),
    ];
    let texts: Vec<(String, String)> = texts
        .into_iter()
        .map(|(key, text)| (key.to_owned(), text))
        .collect();
    let info = ServiceInfo::new(
        SERVICE,
        &instance,
        &host,
        &*addresses,
        group.port(),
        &*texts,
    );
    let mut info = info?;
    info.set_requires_probe(false);
    Ok(info)
}

/// Logs a warning if nothing is sent, as on a network without multicast.
async fn look(monitor: Receiver<DaemonEvent>, interface: MdnsInterface) {
    let why = match timeout(ANNOUNCED_WITHIN, announced(&monitor)).await {
        Ok(Ok(name)) => return info!(?name, "announced by mDNS on {interface}"),
        Ok(Err(why)) => why,
        Err(_) => NotAnnounced::NoNetwork,
    };
    warn!(
        "cannot announce this bridge by mDNS on {interface}: {why} (`--mdns none` turns announcements off)"
    );
    // The dropped receiver gets no more events; the daemon bounds the channel.
}

/// The reason why nothing is announced.
#[derive(Debug, thiserror::Error)]
enum NotAnnounced {
    #[error(transparent)]
    Daemon(mdns_sd::Error),
    #[error("the daemon has ended")]
    Ended,
    #[error("nothing can be sent: the network is down or does not support multicast")]
    NoNetwork,
}

/// Returns the name of the first announcement, or the reason for which nothing is sent.
async fn announced(monitor: &Receiver<DaemonEvent>) -> Result<String, NotAnnounced> {
    loop {
        match monitor.recv_async().await {
            Ok(DaemonEvent::Announce(name, _)) => return Ok(name),
            Ok(DaemonEvent::Error(error)) => return Err(NotAnnounced::Daemon(error)),
            Ok(_) => {}
            Err(_) => return Err(NotAnnounced::Ended),
        }
    }
}

impl Drop for ToldBridge {
    fn drop(&mut self) {
        self.looking.abort();
        if let Ok(told) = self.daemon.unregister(&self.fullname) {
            // The goodbye is sent by then; otherwise it is not waited for.
            let _told = told.recv_timeout(GOODBYE);
        }
        drop(self.daemon.shutdown());
    }
}

/// Returns the bridges announced on an interface that answer within the limit.
///
/// # Errors
/// Fails if no mDNS daemon can be started.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "the crate reports further events; two of them concern presence"
)]
pub async fn heard_bridges(
    interface: &MdnsInterface,
    limit: Duration,
) -> Result<Vec<HeardBridge>, MdnsFault> {
    let fault = |source| MdnsFault::new(interface, source);
    let daemon = ServiceDaemon::new_with_port(MDNS_PORT).map_err(fault)?;
    daemon.disable_interface(IfKind::All).map_err(fault)?;
    daemon.enable_interface(interface.kind()).map_err(fault)?;
    let events = daemon.browse(SERVICE).map_err(fault)?;
    let mut bridges: Vec<HeardBridge> = Vec::new();
    let all = async {
        while let Ok(event) = events.recv_async().await {
            match event {
                ServiceEvent::ServiceResolved(service) => {
                    if let Some(heard) = heard(&service) {
                        bridges.retain(|known| known.name != heard.name);
                        if bridges.len() < MOST_BRIDGES {
                            bridges.push(heard);
                        }
                    } else {
                        debug!(name = ?service.fullname, "ignored an announcement that is not from a bridge");
                    }
                }
                ServiceEvent::ServiceRemoved(_, fullname) => {
                    bridges.retain(|known| !fullname.starts_with(&known.name));
                }
                _ => {}
            }
        }
    };
    // The limit ends the search.
    let _over = timeout(limit, all).await;
    drop(daemon.shutdown());
    Ok(bridges)
}

fn heard(service: &ResolvedService) -> Option<HeardBridge> {
    let text = |key| {
        let text = service.get_property_val(key).flatten()?;
        let text = std::str::from_utf8(text).ok()?;
        (!text.chars().any(char::is_control)).then(|| text.to_owned())
    };
    let name = service.fullname.strip_suffix(SERVICE)?.strip_suffix('.')?;
    let host = service.get_addresses_v4().into_iter().min()?;
    Some(HeardBridge {
        name: label(name),
        host,
        bridge: Bridge {
            program: text(PROGRAM)?,
            uri: text(URI)?,
            space: text(SPACE)?.parse().ok().filter(|space| *space <= 232)?,
            group: text(GROUP)?.parse().ok()?,
        },
    })
}

const SERVICE: &str = "_uadp._udp.local.";
const PROGRAM: &str = "program";
const URI: &str = "uri";
const SPACE: &str = "space";
const GROUP: &str = "group";
const ANNOUNCED_WITHIN: Duration = Duration::from_secs(5);
const GOODBYE: Duration = Duration::from_millis(300);
const MOST_BRIDGES: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    fn bridge() -> Bridge {
        Bridge {
            program: "bridge-ros1".to_owned(),
            uri: "urn:pc:ua-bridge:bridge-ros1".to_owned(),
            space: 1,
            group: "239.192.0.40:4840".parse().unwrap(),
        }
    }

    #[test]
    fn what_a_bridge_tells_is_read_as_it_was_told() {
        let address = Ipv4Addr::new(10, 0, 0, 2);
        let info = info_of(&bridge(), (&[address], address)).unwrap();
        let heard = heard(&info.as_resolved_service()).unwrap();
        assert_eq!(heard.bridge, bridge());
        assert_eq!(heard.host, address);
        assert!(
            heard.name.starts_with("bridge-ros1 space 1 on "),
            "{heard:?}"
        );
    }

    #[test]
    fn a_space_that_there_is_not_is_not_heard() {
        let evil = Bridge {
            space: 233,
            ..bridge()
        };
        let address = Ipv4Addr::new(10, 0, 0, 2);
        let info = info_of(&evil, (&[address], address)).unwrap();
        assert_eq!(heard(&info.as_resolved_service()), None);
    }

    #[test]
    fn where_it_is_told_of_is_a_word() {
        assert_eq!("none".parse(), Ok(Telling::Nowhere));
        assert_eq!("group".parse(), Ok(Telling::Group));
        assert_eq!(
            "eth0".parse(),
            Ok(Telling::On(MdnsInterface::parse("eth0")))
        );
    }
}
