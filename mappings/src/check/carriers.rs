//! The list of carriers.

use std::net::SocketAddr;

use super::network::{address, interface, settings, ttl};
use super::{broker, ethernet, shared_memory};
use crate::broker::{Broker, BrokerAddress};
use crate::carriers::{CarrierMedium, ConfiguredCarrier, ForwardedName, UdpGroup};
use crate::code::Code;
use crate::document::{CarrierEntry, MqttEntry, PubSubEntry, PubSubForm, UdpEntry};
use crate::findings::MappingFindings;
use crate::pubsub::PubSub;
use crate::read::{Located, given, short};
use crate::tree::TextSpan;

/// Returns the settings of the carriers, with defaults for faulty keys, which are noted.
pub(super) fn check(entry: Option<&Located<PubSubForm>>, findings: &mut MappingFindings) -> PubSub {
    let Some(Located { place, value }) = entry else {
        return PubSub::default();
    };
    match value {
        None => PubSub::default(),
        Some(PubSubForm::One(entry)) => {
            let mut pubsub = settings(entry, findings);
            pubsub.carriers.extend(alone(entry, findings));
            pubsub
        }
        Some(PubSubForm::Several(entries)) => listed(entries, *place, findings),
    }
}

/// Returns the only carrier of a mapping if it is neither UDP nor MQTT.
fn alone(entry: &PubSubEntry, findings: &mut MappingFindings) -> Option<ConfiguredCarrier> {
    let of_ethernet = entry.eth.as_ref().map(|at| ("Ethernet", at.place));
    let of_memory = entry.shm.as_ref().map(|at| ("shared memory", at.place));
    let (what, place) = of_ethernet.or(of_memory)?;
    let both = entry.shm.as_ref().filter(|_| of_ethernet.is_some());
    let others = [
        ("address", entry.address.as_ref().map(|at| at.place)),
        ("mqtt", entry.mqtt.as_ref().map(|at| at.place)),
        ("shm", both.map(|at| at.place)),
        ("interface", entry.interface.as_ref().map(|at| at.place)),
        ("ttl", entry.ttl.as_ref().map(|at| at.place)),
    ];
    for (key, place) in others {
        if let Some(place) = place {
            let message = format!("`{key}` is not a setting of {what}");
            let note = findings.error(Code::Carriers, place, message);
            note.help(match of_ethernet {
                Some(_) => ETHERNET_EXAMPLE,
                None => SHARED_MEMORY_EXAMPLE,
            });
        }
    }
    let medium = match (&entry.eth, &entry.shm) {
        (Some(eth), _) => {
            let group = ethernet::group(eth.value.as_ref()?, place, findings)?;
            CarrierMedium::Ethernet(group)
        }
        (None, shm) => {
            let entry = shm.as_ref()?.value.as_ref()?;
            CarrierMedium::SharedMemory(shared_memory::group(entry, findings)?)
        }
    };
    Some(ConfiguredCarrier {
        medium,
        forward: Vec::new(),
    })
}

/// Returns the settings of a list of carriers.
fn listed(
    entries: &[Located<CarrierEntry>],
    place: TextSpan,
    findings: &mut MappingFindings,
) -> PubSub {
    let mut pubsub = common(entries, findings);
    let mut carriers: Vec<ConfiguredCarrier> = Vec::new();
    let mut names: Vec<Listed> = Vec::new();
    for (number, at) in entries.iter().enumerate() {
        let Some(entry) = &at.value else {
            continue;
        };
        let Some(medium) = medium(entry, at.place, findings) else {
            continue;
        };
        let is_twice = carriers
            .iter()
            .any(|known| is_same_network(&known.medium, &medium));
        if is_twice {
            let message = "two entries have the same address, so each message would cross twice";
            let note = findings.error(Code::Carriers, at.place, message);
            note.help("remove one of the entries");
        }
        let forward = forwarded(entry, number, &mut names, findings);
        carriers.push(ConfiguredCarrier { medium, forward });
    }
    let most = PubSub::MOST_CARRIERS;
    if carriers.len() > most {
        let message = format!("{} carriers are too many", carriers.len());
        let note = findings.error(Code::Carriers, place, message);
        note.label(format!("at most {most}"));
    }
    let is_settings = |entry: &CarrierEntry| {
        entry.udp.is_none() && entry.mqtt.is_none() && entry.eth.is_none() && entry.shm.is_none()
    };
    let mut all = entries.iter();
    if all.all(|at| at.value.as_ref().is_some_and(is_settings)) {
        let note = findings.error(Code::Carriers, place, "the list has no carrier");
        note.help(EXAMPLE);
    }
    if let ([alone], [first, ..]) = (carriers.as_slice(), names.as_slice())
        && entries
            .iter()
            .filter(|at| !at.value.as_ref().is_some_and(is_settings))
            .count()
            == 1
        && !alone.forward.is_empty()
    {
        let message = "there is no other carrier to forward to";
        let note = findings.warning(Code::Forward, first.place, message);
        note.help(EXAMPLE);
    }
    adopt(&mut pubsub, carriers);
    pubsub
}

/// Sets the first carrier of UDP and MQTT, and the list if there are several carriers or others.
fn adopt(pubsub: &mut PubSub, carriers: Vec<ConfiguredCarrier>) {
    let udp = carriers.iter().find_map(|carrier| match &carrier.medium {
        CarrierMedium::Udp(group) => Some(group.clone()),
        CarrierMedium::Mqtt(_) | CarrierMedium::Ethernet(_) | CarrierMedium::SharedMemory(_) => {
            None
        }
    });
    if let Some(UdpGroup {
        address,
        interface,
        ttl,
        peers,
    }) = udp
    {
        pubsub.address = address;
        pubsub.interface = interface;
        pubsub.ttl = ttl;
        pubsub.peers = peers;
    }
    pubsub.broker = carriers.iter().find_map(|carrier| match &carrier.medium {
        CarrierMedium::Mqtt(broker) => Some(broker.clone()),
        CarrierMedium::Udp(_) | CarrierMedium::Ethernet(_) | CarrierMedium::SharedMemory(_) => None,
    });
    let is_other = |carrier: &ConfiguredCarrier| match carrier.medium {
        CarrierMedium::Udp(_) | CarrierMedium::Mqtt(_) => false,
        CarrierMedium::Ethernet(_) | CarrierMedium::SharedMemory(_) => true,
    };
    if carriers.len() > 1 || carriers.iter().any(is_other) {
        pubsub.carriers = carriers;
    }
}

/// Returns the settings of all carriers.
fn common(entries: &[Located<CarrierEntry>], findings: &mut MappingFindings) -> PubSub {
    let of = |at: &'_ Located<CarrierEntry>| at.value.as_ref()?.settings.clone();
    let mut all = entries.iter().filter_map(of);
    let Some(first) = all.next() else {
        return PubSub::default();
    };
    for other in all {
        let note = findings.error(
            Code::Carriers,
            other.place,
            "`settings` are for all carriers, and occur once",
        );
        note.help("move the keys into the first `settings`");
    }
    let Some(entry) = first.value else {
        return PubSub::default();
    };
    let PubSubEntry {
        address,
        mqtt,
        eth,
        shm,
        interface,
        ttl,
        ..
    } = &entry;
    let places = [
        ("address", address.as_ref().map(|at| at.place)),
        ("mqtt", mqtt.as_ref().map(|at| at.place)),
        ("eth", eth.as_ref().map(|at| at.place)),
        ("shm", shm.as_ref().map(|at| at.place)),
        ("interface", interface.as_ref().map(|at| at.place)),
        ("ttl", ttl.as_ref().map(|at| at.place)),
    ];
    for (key, place) in places {
        if let Some(place) = place {
            let message = format!("`{key}` is a setting of a carrier");
            let note = findings.error(Code::Carriers, place, message);
            note.help(EXAMPLE);
        }
    }
    settings(&entry, findings)
}

/// Returns the network of an entry; `None` for an entry with settings, and for a faulty entry.
fn medium(
    entry: &CarrierEntry,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<CarrierMedium> {
    let CarrierEntry {
        udp,
        mqtt,
        eth,
        shm,
        settings,
        ..
    } = entry;
    match (udp, mqtt, eth, shm, settings) {
        (Some(udp), None, None, None, None) => {
            udp_group(udp.value.as_ref()?, findings).map(CarrierMedium::Udp)
        }
        (None, Some(mqtt), None, None, None) => {
            let broker = listed_broker(mqtt.value.as_ref()?, mqtt.place, findings)?;
            Some(CarrierMedium::Mqtt(broker))
        }
        (None, None, Some(eth), None, None) => {
            let group = ethernet::group(eth.value.as_ref()?, eth.place, findings)?;
            Some(CarrierMedium::Ethernet(group))
        }
        (None, None, None, Some(shm), None) => {
            let group = shared_memory::group(shm.value.as_ref()?, findings)?;
            Some(CarrierMedium::SharedMemory(group))
        }
        (None, None, None, None, Some(_)) => {
            if let Some(at) = &entry.forward {
                let message = "`forward` belongs to a carrier";
                findings
                    .error(Code::Carriers, at.place, message)
                    .help(EXAMPLE);
            }
            None
        }
        _ => {
            let message = "an entry has one of `udp`, `mqtt`, `eth`, `shm` and `settings`";
            findings.error(Code::Carriers, place, message).help(EXAMPLE);
            None
        }
    }
}

fn udp_group(entry: &UdpEntry, findings: &mut MappingFindings) -> Option<UdpGroup> {
    let url = match given(&entry.address) {
        None if entry.address.is_some() => return None,
        None => Some(PubSub::ADDRESS),
        Some((text, place)) => address(text, place, findings),
    };
    let named = given(&entry.interface);
    let interface = named.and_then(|(text, place)| interface(text, place, findings));
    let address = url?;
    Some(UdpGroup {
        address,
        interface,
        ttl: ttl(&entry.ttl, findings).unwrap_or(1),
        peers: peers(entry, address, findings),
    })
}

/// Reads the hosts that datagrams are sent to.
fn peers(entry: &UdpEntry, own: SocketAddr, findings: &mut MappingFindings) -> Vec<SocketAddr> {
    let Some((listed, place)) = given(&entry.peers) else {
        return Vec::new();
    };
    if own.ip().is_multicast() {
        let message = "with `peers`, `address` is the address of this host and not of a group";
        let note = findings.error(Code::Address, place, message);
        note.help("address: opc.udp://10.0.0.1:4840");
    }
    if listed.len() > MOST_PEERS {
        let message = format!(
            "{} hosts, but at most {MOST_PEERS} are possible",
            listed.len()
        );
        let note = findings.error(Code::Address, place, message);
        note.help("use multicast, or a broker");
    }
    let mut peers: Vec<SocketAddr> = Vec::new();
    for Located { place, value } in listed {
        let Some(text) = value else { continue };
        match text.parse::<SocketAddr>() {
            Ok(peer) if peer.is_ipv4() && peer.port() != 0 && !peer.ip().is_multicast() => {
                if peer != own && !peers.contains(&peer) {
                    peers.push(peer);
                }
            }
            Ok(_) | Err(_) => {
                let message = format!("`{}` is not the address and port of a host", short(text));
                let note = findings.error(Code::Address, *place, message);
                note.help("give an IPv4 address and a port, such as 10.0.0.2:4840");
            }
        }
    }
    peers
}

/// The most hosts that each datagram is sent to.
const MOST_PEERS: usize = 64;

fn listed_broker(
    entry: &MqttEntry,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Box<Broker>> {
    let Some(at) = &entry.address else {
        let message = "a broker in a list needs its `address`";
        let note = findings.error(Code::MissingKey, place, message);
        note.help(format!("address: {}", BrokerAddress::EXAMPLE));
        return None;
    };
    let text = at.value.as_deref()?;
    broker::at((text, at.place), Some(entry), findings)
}

fn is_same_network(one: &CarrierMedium, other: &CarrierMedium) -> bool {
    match (one, other) {
        (CarrierMedium::Udp(one), CarrierMedium::Udp(other)) => {
            one.address == other.address && one.interface == other.interface
        }
        (CarrierMedium::Mqtt(one), CarrierMedium::Mqtt(other)) => {
            one.address == other.address && one.prefix == other.prefix
        }
        (CarrierMedium::Ethernet(one), CarrierMedium::Ethernet(other)) => {
            (&one.interface, one.address, one.vlan) == (&other.interface, other.address, other.vlan)
        }
        (CarrierMedium::SharedMemory(one), CarrierMedium::SharedMemory(other)) => one == other,
        (
            CarrierMedium::Udp(_)
            | CarrierMedium::Mqtt(_)
            | CarrierMedium::Ethernet(_)
            | CarrierMedium::SharedMemory(_),
            _different,
        ) => false,
    }
}

/// A name under `forward`.
struct Listed {
    name: ForwardedName,
    place: TextSpan,
    /// The number of the entry.
    number: usize,
}

/// Returns the names that a carrier forwards.
fn forwarded(
    entry: &CarrierEntry,
    number: usize,
    names: &mut Vec<Listed>,
    findings: &mut MappingFindings,
) -> Vec<ForwardedName> {
    let mut own = Vec::new();
    let Some((entries, place)) = given(&entry.forward) else {
        return own;
    };
    if entries.len() > MOST_NAMES {
        let message = format!("{} names are too many", entries.len());
        let note = findings.error(Code::Forward, place, message);
        note.label(format!(
            "at most {MOST_NAMES}; a space or a namespace is one name"
        ));
        return own;
    }
    for at in entries {
        let Some(text) = &at.value else {
            continue;
        };
        let Ok(name) = text.parse::<ForwardedName>() else {
            let message = format!("`{}` is not a name of the space", short(text));
            let note = findings.error(Code::Forward, at.place, message);
            note.help("use a space (ua_1), a namespace of it (ua_1_2) or a topic (ua_1_2_10)");
            continue;
        };
        let before = names.iter().find(|listed| listed.name.overlaps(name));
        if let Some(Listed {
            name: other,
            place,
            number: at_entry,
        }) = before
        {
            let line = findings.line(*place, at.place);
            if *at_entry == number {
                let message = format!("`{name}` is also forwarded by `{other}`");
                let note = findings.warning(Code::Forward, at.place, message);
                note.label(format!("`{other}` is at {line}"));
            } else {
                let message = format!(
                    "`{name}` is forwarded from two carriers, but its publisher is at one of them"
                );
                let note = findings.error(Code::Forward, at.place, message);
                note.label(format!("`{other}` is at {line}"));
            }
        }
        names.push(Listed {
            name,
            place: at.place,
            number,
        });
        own.push(name);
    }
    own
}

const MOST_NAMES: usize = 1000;
const ETHERNET_EXAMPLE: &str = "pubsub: {eth: {interface: eth0, address: 01-00-5E-40-00-28}}";
const SHARED_MEMORY_EXAMPLE: &str = "pubsub: {shm: {group: cell}}";
const EXAMPLE: &str = "pubsub: [{udp: {address: opc.udp://239.192.0.40:4840}, forward: [ua_1]}, {mqtt: \
                       {address: mqtt://broker.local:1883}}, {settings: {key_frame_period: 1s}}]";
