//! The group or broker that the commands inspect.

use std::fs;
use std::path::Path;

use broker::{BrokerIdentity, Mqtt};
use mappings::{Broker, BrokerAddress, Mapping, PubSub, SharedMemoryGroup};
use transport::{Carrier, Udp, UdpOptions};

use crate::arguments::GroupArguments;
use crate::exit::CommandFailure;

/// Opens the group or broker of the command line. Returns its address for output too.
pub(super) fn open(group: &GroupArguments) -> Result<(Box<dyn Carrier>, String), CommandFailure> {
    open_as(group, false)
}

/// Opens the group or broker like [`open`]. The kernel does not filter own datagrams of the group.
pub(super) fn open_with_own(
    group: &GroupArguments,
) -> Result<(Box<dyn Carrier>, String), CommandFailure> {
    open_as(group, true)
}

/// Returns the broker of the command line; `None` for a group.
pub(super) fn broker(group: &GroupArguments) -> Result<Option<Broker>, CommandFailure> {
    let settings = group.broker.as_deref().map(settings).transpose()?;
    Ok(match &group.address {
        Some(url) if BrokerAddress::is_mqtt(url) => {
            let address = BrokerAddress::parse(url).ok_or_else(|| {
                let example = BrokerAddress::EXAMPLE;
                CommandFailure::Usage(format!(
                    "--address: not the address of a broker; for example {example}"
                ))
            })?;
            let settings = settings.unwrap_or_else(|| Broker::new(address.clone()));
            Some(Broker {
                address,
                ..settings
            })
        }
        Some(_) => None,
        None => settings,
    })
}

fn open_as(
    group: &GroupArguments,
    own: bool,
) -> Result<(Box<dyn Carrier>, String), CommandFailure> {
    if let Some(mut broker) = broker(group)? {
        if let Some(cell) = &group.cell {
            if !Broker::is_prefix(cell) {
                return Err(CommandFailure::Usage(format!(
                    "--cell {cell}: not the prefix of a cell; for example plant/cell-4"
                )));
            }
            broker.prefix.clone_from(cell);
        }
        let identity = BrokerIdentity {
            program: "ua-space".to_owned(),
            publisher: None,
        };
        let mqtt = Mqtt::open(&broker, &identity)
            .map_err(|error| CommandFailure::Usage(format!("MQTT: {error}")))?;
        return Ok((Box::new(mqtt), broker.address.to_string()));
    }
    let name = group.address.as_deref();
    if let Some(name) = name.and_then(|url| url.strip_prefix(SharedMemoryGroup::SCHEME)) {
        let group = SharedMemoryGroup::new(name).ok_or_else(|| {
            let message = "--address: the name of a group in shared memory has letters, digits, `-` \
                           and `_`; for example shm:cell";
            CommandFailure::Usage(message.to_owned())
        })?;
        let memory = bridge_node::open_shared_memory(&group)
            .map_err(|failure| CommandFailure::Unavailable(failure.to_string()))?;
        return Ok((memory, format!("{}{name}", SharedMemoryGroup::SCHEME)));
    }
    if group.cell.is_some() {
        return Err(CommandFailure::Usage(NO_BROKER.to_owned()));
    }
    let address = match &group.address {
        None => PubSub::ADDRESS,
        Some(url) => PubSub::parse_address(url).ok_or_else(|| {
            let (udp, mqtt) = (PubSub::ADDRESS, BrokerAddress::EXAMPLE);
            CommandFailure::Usage(format!(
                "--address {url}: for example opc.udp://{udp}, or {mqtt} for a broker"
            ))
        })?,
    };
    let options = UdpOptions {
        interface: group.interface.clone(),
        own,
        ..UdpOptions::new(address)
    };
    let udp =
        Udp::open(&options).map_err(|error| CommandFailure::Unavailable(error.to_string()))?;
    Ok((Box::new(udp), address.to_string()))
}

/// The failure of `--cell` without a broker.
pub(super) const NO_BROKER: &str =
    "--cell needs a broker: --address mqtt://broker.local:1883, or --broker MAPPING";

/// Returns the broker of a mapping.
fn settings(path: &Path) -> Result<Broker, CommandFailure> {
    let mapping = broker_mapping(path)?;
    mapping.pubsub().broker.as_deref().cloned().ok_or_else(|| {
        let (name, example) = (path.display(), BrokerAddress::EXAMPLE);
        CommandFailure::Usage(format!(
            "--broker: {name} names no broker; for example pubsub: {{address: {example}}}"
        ))
    })
}

/// Reads a mapping for its broker. Faults in its other parts do not matter.
pub(crate) fn broker_mapping(path: &Path) -> Result<Mapping, CommandFailure> {
    let name = path.display().to_string();
    let text = fs::read_to_string(path)
        .map_err(|error| CommandFailure::Io(format!("cannot read {name}: {error}")))?;
    let checked = Mapping::from_yaml(&text, &name);
    let mapping = checked.outline().cloned();
    mapping.ok_or_else(|| {
        CommandFailure::Data(format!("{name} cannot be read: `ua-space check {name}`"))
    })
}
