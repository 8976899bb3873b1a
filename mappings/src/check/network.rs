//! The settings of a carrier: addresses, interfaces and periods.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use super::broker;
use super::quantity::{duration, parse_duration, within};
use crate::broker::BrokerAddress;
use crate::code::Code;
use crate::document::{PubSubEntry, PublisherIdEntry};
use crate::findings::MappingFindings;
use crate::pubsub::{PubSub, PublisherIdRule};
use crate::read::{OptionalKey, given, short};
use crate::secret::has_user;
use crate::tree::TextSpan;

/// Returns the settings of a single carrier.
pub(super) fn settings(entry: &PubSubEntry, findings: &mut MappingFindings) -> PubSub {
    let default = PubSub::default();
    let broker = broker::check(entry, findings);
    let address = given(&entry.address)
        .filter(|(text, _)| !BrokerAddress::is_mqtt(text))
        .and_then(|(text, place)| address(text, place, findings));
    let interface =
        given(&entry.interface).and_then(|(text, place)| interface(text, place, findings));
    let ttl = ttl(&entry.ttl, findings);
    let publisher_id = match given(&entry.publisher_id) {
        Some((PublisherIdEntry::AnyWidth, _)) => PublisherIdRule::AnyWidth,
        Some((PublisherIdEntry::Exact, _)) | None => PublisherIdRule::Exact,
    };
    let key_frame_period = duration(&entry.key_frame_period, findings);
    let keep_alive_period = duration(&entry.keep_alive_period, findings);
    let receive_timeout = duration(&entry.receive_timeout, findings);
    let metadata_period = duration(&entry.metadata_period, findings);
    let largest = PubSub::SMALLEST_DATAGRAM..=PubSub::LARGEST_DATAGRAM;
    let max_datagram = within(&entry.max_datagram, largest, "bytes", findings);
    let max_message = within(&entry.max_message, 1..=1024, "MiB", findings);
    let together = within(&entry.messages_per_datagram, 1..=255, "messages", findings);
    let pubsub = PubSub {
        address: address.unwrap_or(default.address),
        broker,
        interface,
        ttl: ttl.unwrap_or(default.ttl),
        peers: default.peers,
        publisher_id,
        key_frame_period: key_frame_period.unwrap_or(default.key_frame_period),
        keep_alive_period: keep_alive_period.unwrap_or(default.keep_alive_period),
        receive_timeout: receive_timeout.unwrap_or(default.receive_timeout),
        metadata_period: metadata_period.unwrap_or(default.metadata_period),
        max_datagram: max_datagram.unwrap_or(default.max_datagram),
        max_message: max_message
            .map_or(default.max_message, |mebibytes| u32::from(mebibytes) << 20),
        messages_per_datagram: together
            .and_then(|count| u8::try_from(count).ok())
            .unwrap_or(default.messages_per_datagram),
        carriers: Vec::new(),
    };
    timing(entry, &pubsub, findings);
    pubsub
}

pub(super) fn ttl(field: &OptionalKey<u16>, findings: &mut MappingFindings) -> Option<u8> {
    let (number, place) = given(field)?;
    let ttl = u8::try_from(*number).ok();
    if ttl.is_none() {
        let message = format!("the ttl {number} exceeds 255");
        findings
            .error(Code::WrongValue, place, message)
            .label("0 to 255");
    }
    ttl
}

fn timing(entry: &PubSubEntry, pubsub: &PubSub, findings: &mut MappingFindings) {
    let faulty = |field: &OptionalKey<String>| {
        field
            .as_ref()
            .is_some_and(|at| at.value.as_deref().and_then(parse_duration).is_none())
    };
    if pubsub.receive_timeout > pubsub.keep_alive_period
        || faulty(&entry.receive_timeout)
        || faulty(&entry.keep_alive_period)
    {
        return;
    }
    let Some(at) = entry
        .receive_timeout
        .as_ref()
        .or(entry.keep_alive_period.as_ref())
    else {
        return;
    };
    let (timeout, period) = (pubsub.receive_timeout, pubsub.keep_alive_period);
    let message = format!(
        "the receive_timeout of {timeout:?} is not longer than the keep_alive_period of {period:?}"
    );
    let note = findings.error(Code::Timing, at.place, message);
    note.help(format!(
        "three periods tolerate two lost datagrams: receive_timeout: {:?}",
        period.saturating_mul(3)
    ));
}

/// Reads `opc.udp://host:port`; the default port is 4840 (OPC 10000-14, 7.3.2).
pub(super) fn address(
    text: &str,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<SocketAddr> {
    let Some(address) = PubSub::parse_address(text) else {
        let message = format!("`{}` is not a PubSub address", short(text));
        let mut note = findings.error(Code::Address, place, message);
        if has_user(text) {
            note = note.label("remove the user name and the password");
        }
        note.help(format!(
            "give the IP address of a group or host, such as opc.udp://{}, or a broker, such as {}",
            PubSub::ADDRESS,
            BrokerAddress::EXAMPLE
        ));
        return None;
    };
    let unusable = if address.port() == 0 {
        Some("port 0 is not a destination")
    } else if address.ip().is_unspecified() {
        Some("the unspecified address is not a destination")
    } else if address.ip() == IpAddr::V4(Ipv4Addr::BROADCAST) {
        Some("broadcasts are not supported")
    } else {
        None
    };
    if let Some(why) = unusable {
        findings.error(Code::Address, place, why).help(format!(
            "use an address such as opc.udp://{}",
            PubSub::ADDRESS
        ));
        return None;
    }
    if address.ip() == IpAddr::V4(PubSub::DISCOVERY_GROUP) {
        let message = format!(
            "{} is the group for discovery messages, not for data",
            PubSub::DISCOVERY_GROUP
        );
        let note = findings.error(Code::DiscoveryGroup, place, message);
        note.help(format!(
            "use an address such as opc.udp://{}",
            PubSub::ADDRESS
        ));
        return None;
    }
    if let IpAddr::V4(group) = address.ip()
        && group.is_multicast()
        && group.octets().first() != Some(&239)
    {
        let message = format!("{group} is not a group for free use within a site");
        let note = findings.warning(Code::UnscopedGroup, place, message);
        note.help(
            "use 239.0.0.0 to 239.255.255.255; keep this group only if a publisher requires it",
        );
    }
    Some(address)
}

/// Longest name of a network interface of Linux.
const MAX_INTERFACE: usize = 15;

pub(super) fn interface(
    text: &str,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<String> {
    let named = !text.is_empty()
        && text.len() <= MAX_INTERFACE
        && !text.contains(|c: char| c.is_whitespace() || c.is_control() || c == '/');
    if !named && text.parse::<IpAddr>().is_err() {
        let message = format!(
            "`{}` is not the name or the address of an interface",
            short(text)
        );
        findings
            .error(Code::Interface, place, message)
            .help("use a name or address of `ip -brief address`, such as eth0 or 192.168.1.5");
        return None;
    }
    Some(text.to_owned())
}
