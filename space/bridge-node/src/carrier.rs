//! The carrier of a program, from its command line and mapping.

mod drops;
mod routes;

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use std::sync::Arc;

use bridge_core::{LinkCapacity, Relay};
use broker::{BrokerIdentity, Mqtt};
use mappings::{
    Broker, BrokerAddress, CarrierMedium, ConfiguredCarrier, EthernetGroup, Mapping, PubSub,
    SharedMemoryGroup, SpaceId, UdpGroup,
};
use service::{Failure, FailureKind};
use tokio::sync::watch;
use transport::{
    Capacity, Carrier, CarrierRules, Carriers, Ethernet, EthernetError, EthernetOptions, Judgement,
    MessagePath, ProcessHub, Senders, Udp, UdpOptions, VlanTag,
};

use crate::arguments::Arguments;
use crate::mapping_file::RunningMapping;
pub(crate) use drops::rules;
use routes::LiveRoutes;

/// The source of own messages for a carrier that does not return them. No sender has this address.
pub(crate) const NO_SOURCE: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// Opens the carrier of a space, which `hub` connects with the other carriers of the process.
/// Returns the options of its socket too, if it uses UDP.
pub(crate) fn open(
    (program, own): (&str, SpaceId),
    (arguments, mapping): (&Arguments, &Arc<Mapping>),
    changes: &watch::Receiver<RunningMapping>,
    (several, hub): (bool, Option<&ProcessHub>),
) -> Result<(Box<dyn Carrier>, Option<UdpOptions>), Failure> {
    let identity = BrokerIdentity {
        program: program.to_owned(),
        publisher: (!arguments.flags.dry_run).then(|| own.into()),
    };
    let url = arguments.flags.address.as_deref();
    if let Some(group) = url.and_then(|url| url.strip_prefix(SharedMemoryGroup::SCHEME)) {
        return Ok((open_shared_memory(&shared_memory(group)?)?, None));
    }
    let listed = &mapping.pubsub().carriers;
    if url.is_none() && !listed.is_empty() {
        let (carriers, options) = open_all(listed, &identity, arguments, (several, hub))?;
        let rules: Box<dyn CarrierRules> = if arguments.flags.dry_run {
            Box::new(NoRoutes)
        } else {
            Box::new(LiveRoutes::new(mapping, Some(changes.clone())))
        };
        return Ok((Box::new(Carriers::new(carriers, rules)), options));
    }
    if let Some(broker) = broker_of(url, mapping.pubsub())? {
        return Ok((open_broker(&broker, &identity)?, None));
    }
    let options = options(arguments, mapping, several)?;
    Ok((open_udp(&options, hub)?, Some(options)))
}

/// Carriers, and the options of their first socket if one of them uses UDP.
type WithOptions<T> = (T, Option<UdpOptions>);

/// Opens the carriers of a list. Returns the options of the first socket too, if UDP is among them.
fn open_all(
    listed: &[ConfiguredCarrier],
    identity: &BrokerIdentity,
    arguments: &Arguments,
    (several, hub): (bool, Option<&ProcessHub>),
) -> Result<WithOptions<Vec<Box<dyn Carrier>>>, Failure> {
    let mut carriers = Vec::new();
    let mut first = None;
    // The programs of a process meet at one carrier, so that each message arrives once.
    let meet_by_udp = listed
        .iter()
        .any(|carrier| matches!(carrier.medium, CarrierMedium::Udp(_)));
    let ethernet_hub = hub.filter(|_| !meet_by_udp);
    for ConfiguredCarrier { medium, .. } in listed {
        let carrier = match medium {
            CarrierMedium::Mqtt(broker) => open_broker(broker, identity)?,
            CarrierMedium::Ethernet(group) => open_ethernet(group, arguments, ethernet_hub)?,
            CarrierMedium::SharedMemory(group) => open_shared_memory(group)?,
            CarrierMedium::Udp(group) => {
                let options = udp_options(arguments, group, several)?;
                let udp = open_udp(&options, hub)?;
                first.get_or_insert(options);
                udp
            }
        };
        carriers.push(carrier);
    }
    Ok((carriers, first))
}

fn open_broker(broker: &Broker, identity: &BrokerIdentity) -> Result<Box<dyn Carrier>, Failure> {
    let mqtt = Mqtt::open(broker, identity)
        .map_err(|error| Failure::new(FailureKind::Configuration, format!("MQTT: {error}")))?;
    Ok(Box::new(mqtt))
}

fn open_udp(options: &UdpOptions, hub: Option<&ProcessHub>) -> Result<Box<dyn Carrier>, Failure> {
    let udp = Udp::open(options)
        .map_err(|error| Failure::new(FailureKind::Unavailable, error.to_string()))?;
    Ok(match hub {
        Some(hub) => hub.connect(udp, options),
        None => Box::new(udp),
    })
}

/// Returns the group of a command line.
fn shared_memory(name: &str) -> Result<SharedMemoryGroup, Failure> {
    SharedMemoryGroup::new(name).ok_or_else(|| {
        let most = SharedMemoryGroup::LONGEST;
        let message = format!(
            "--address shm:{name}: use a name of 1 to {most} letters, digits, `-` and `_`, such as shm:cell"
        );
        Failure::new(FailureKind::Usage, message)
    })
}

/// Opens a carrier in shared memory.
///
/// # Errors
/// The program was built without it, or its files cannot be opened.
#[cfg(feature = "shm")]
pub fn open_shared_memory(group: &SharedMemoryGroup) -> Result<Box<dyn Carrier>, Failure> {
    let memory = transport::SharedMemory::open(group.name())
        .map_err(|error| Failure::new(FailureKind::Unavailable, error.to_string()))?;
    Ok(Box::new(memory))
}

/// Opens a carrier in shared memory.
///
/// # Errors
/// The program was built without it.
#[cfg(not(feature = "shm"))]
pub fn open_shared_memory(group: &SharedMemoryGroup) -> Result<Box<dyn Carrier>, Failure> {
    let message = format!(
        "the group `{}` in shared memory needs a program with the feature `shm`, which this one \
         was built without: use UDP, or build the programs with `--features shm`",
        group.name()
    );
    Err(Failure::new(FailureKind::Configuration, message))
}

/// Opens a carrier of Ethernet. The interface of the command line takes precedence.
fn open_ethernet(
    group: &EthernetGroup,
    arguments: &Arguments,
    hub: Option<&ProcessHub>,
) -> Result<Box<dyn Carrier>, Failure> {
    let flag = arguments.flags.interface.clone();
    let interface = flag.unwrap_or_else(|| group.interface.clone());
    let tag = match (group.vlan, group.priority) {
        (None, None) => None,
        (vlan, priority) => VlanTag::new(vlan.unwrap_or_default(), priority.unwrap_or_default()),
    };
    let options = EthernetOptions {
        tag,
        ..EthernetOptions::new(interface, group.address.octets())
    };
    let ethernet = Ethernet::open(&options).map_err(|error| {
        let is_denied = matches!(error, EthernetError::NotPermitted(_));
        let kind = match is_denied {
            true => FailureKind::Configuration,
            false => FailureKind::Unavailable,
        };
        Failure::new(kind, error.to_string())
    })?;
    Ok(match hub {
        Some(hub) => hub.connect_ethernet(ethernet),
        None => Box::new(ethernet),
    })
}

/// Returns the rules of the carriers of a mapping, for [`Carriers`].
#[must_use]
pub fn carrier_rules(mapping: &Arc<Mapping>) -> Box<dyn CarrierRules> {
    Box::new(LiveRoutes::new(mapping, None))
}

/// The rules of a program that sends nothing.
#[derive(Debug)]
struct NoRoutes;

impl CarrierRules for NoRoutes {
    fn sent(&mut self, _: &[u8]) {}

    fn judge(&mut self, _: &[u8], _: MessagePath) -> Judgement {
        Judgement::default()
    }
}

/// Returns the broker of the command line, else that of the mapping. The address of the command
/// line is used with the other settings of the mapping.
fn broker_of(url: Option<&str>, pubsub: &PubSub) -> Result<Option<Broker>, Failure> {
    let Some(url) = url else {
        return Ok(pubsub.broker.as_deref().cloned());
    };
    if !BrokerAddress::is_mqtt(url) {
        return Ok(None);
    }
    let address = BrokerAddress::parse(url).ok_or_else(|| {
        let example = BrokerAddress::EXAMPLE;
        let message = format!("--address: expected the address of a broker, such as {example}");
        Failure::new(FailureKind::Usage, message)
    })?;
    Ok(Some(match pubsub.broker.as_deref() {
        Some(broker) => Broker {
            address,
            ..broker.clone()
        },
        None => Broker::new(address),
    }))
}

/// Returns the socket options for the group.
fn options(arguments: &Arguments, mapping: &Mapping, several: bool) -> Result<UdpOptions, Failure> {
    let pubsub = mapping.pubsub();
    let address: SocketAddr = match &arguments.flags.address {
        Some(url) => PubSub::parse_address(url).ok_or_else(|| {
            let message = format!(
                "--address {url}: expected an address such as opc.udp://{}, or {} for a broker",
                PubSub::ADDRESS,
                BrokerAddress::EXAMPLE
            );
            Failure::new(FailureKind::Usage, message)
        })?,
        None => pubsub.address,
    };
    let group = UdpGroup {
        address,
        interface: pubsub.interface.clone(),
        ttl: pubsub.ttl,
        peers: match arguments.flags.address {
            Some(_) => Vec::new(),
            None => pubsub.peers.clone(),
        },
    };
    udp_options(arguments, &group, several)
}

/// Returns the socket options for a group. The interface of the command line takes precedence.
fn udp_options(
    arguments: &Arguments,
    group: &UdpGroup,
    several: bool,
) -> Result<UdpOptions, Failure> {
    let UdpGroup {
        address,
        interface,
        ttl,
        peers,
    } = group;
    let flag = arguments.flags.interface.clone();
    let options = UdpOptions {
        interface: flag.or_else(|| interface.clone()),
        ttl: u32::from(*ttl),
        peers: peers.clone(),
        ..UdpOptions::new(*address)
    };
    if several && !address.ip().is_multicast() {
        let message = format!(
            "several spaces in one program need a multicast address, and {address} is not one: start a \
             program for each space"
        );
        return Err(Failure::new(FailureKind::Usage, message));
    }
    Ok(options)
}

/// Returns the properties of the broker, if the carrier uses one.
pub(crate) fn relay(carrier: &dyn Carrier) -> Option<Relay> {
    Some(Relay {
        within: carrier.within()?,
        authorized: carrier.senders() == Senders::Authorized,
    })
}

/// Returns the largest message in bytes that the network takes, if it is known.
pub(crate) fn limit(carrier: &dyn Carrier) -> Option<u16> {
    let limit = carrier.limit()?;
    Some(u16::try_from(limit).unwrap_or(u16::MAX))
}

/// Returns the capacity of the network of the carrier.
pub(crate) fn link(carrier: &dyn Carrier) -> LinkCapacity {
    match carrier.capacity() {
        Capacity::Wire(speed) => LinkCapacity::Wire { speed },
        Capacity::Host(receive_buffer) => LinkCapacity::Host { receive_buffer },
        Capacity::Unknown => LinkCapacity::Unknown,
    }
}
