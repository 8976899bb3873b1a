//! The carrier of a program, from its command line and mapping.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use broker::{Identity, Mqtt};
use mappings::{Broker, BrokerAddress, Mapping, PubSub, SpaceId};
use transport::{Carrier, Options, ProcessHub, Udp};

use crate::arguments::Arguments;
use crate::exit::{Failure, FailureKind};

/// The source of own messages for a carrier that does not return them. No sender has this address.
pub(crate) const NO_SOURCE: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// Opens the carrier of a space, which is connected with the other carriers of the process by `hub`.
/// Returns the options of its socket too, if it uses UDP.
pub(crate) fn open(
    (program, own): (&str, SpaceId),
    (arguments, mapping): (&Arguments, &Mapping),
    (several, hub): (bool, Option<&ProcessHub>),
) -> Result<(Box<dyn Carrier>, Option<Options>), Failure> {
    let url = arguments.flags.address.as_deref();
    if let Some(broker) = broker_of(url, mapping.pubsub())? {
        let identity = Identity {
            program: program.to_owned(),
            publisher: (!arguments.flags.dry_run).then(|| own.into()),
        };
        let mqtt = Mqtt::open(&broker, &identity)
            .map_err(|error| Failure::new(FailureKind::Configuration, format!("MQTT: {error}")))?;
        return Ok((Box::new(mqtt), None));
    }
    let options = options(arguments, mapping, several)?;
    let udp = Udp::open(&options)
        .map_err(|error| Failure::new(FailureKind::Unavailable, error.to_string()))?;
    let carrier: Box<dyn Carrier> = match hub {
        Some(hub) => hub.connect(udp, &options),
        None => Box::new(udp),
    };
    Ok((carrier, Some(options)))
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
fn options(arguments: &Arguments, mapping: &Mapping, several: bool) -> Result<Options, Failure> {
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
    let options = Options {
        interface: arguments
            .flags
            .interface
            .clone()
            .or_else(|| pubsub.interface.clone()),
        ttl: u32::from(pubsub.ttl),
        ..Options::new(address)
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
