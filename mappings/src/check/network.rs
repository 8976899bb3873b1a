//! Addresses and periods of PubSub, and the endpoint of the server.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use super::cell::is_uri;
use super::{broker, carriers, ethernet, permissions};
use crate::broker::BrokerAddress;
use crate::code::Code;
use crate::document::{
    HistoryEntry, LimitsEntry, PubSubEntry, PubSubForm, PublisherIdEntry, SecurityEntry,
    ServerEntry,
};
use crate::endpoint::Endpoint;
use crate::findings::MappingFindings;
use crate::pubsub::{PubSub, PublisherIdRule};
use crate::quality::History;
use crate::read::{Located, OptionalKey, given, short};
use crate::remote::ServerSecurityPolicy;
use crate::secret::has_user;
use crate::server::{Server, ServerLimits};
use crate::tree::TextSpan;

pub(super) fn pubsub(
    entry: Option<&Located<PubSubForm>>,
    findings: &mut MappingFindings,
) -> PubSub {
    let Some(Located { place, value }) = entry else {
        return PubSub::default();
    };
    match value {
        None => PubSub::default(),
        Some(PubSubForm::One(entry)) => {
            let mut pubsub = settings(entry, findings);
            pubsub.carriers.extend(ethernet::alone(entry, findings));
            pubsub
        }
        Some(PubSubForm::Several(entries)) => carriers::check(entries, *place, findings),
    }
}

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

pub(super) fn within(
    field: &OptionalKey<u16>,
    range: RangeInclusive<u16>,
    unit: &str,
    findings: &mut MappingFindings,
) -> Option<u16> {
    let (number, place) = given(field)?;
    if range.contains(number) {
        return Some(*number);
    }
    let message = format!("{number} {unit} are out of range");
    let (least, most) = range.into_inner();
    findings
        .error(Code::WrongValue, place, message)
        .label(format!("{least} to {most}"));
    None
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

const SHORTEST: Duration = Duration::from_millis(10);
const LONGEST: Duration = Duration::from_secs(3600);

pub(super) fn duration(
    field: &OptionalKey<String>,
    findings: &mut MappingFindings,
) -> Option<Duration> {
    let (text, place) = given(field)?;
    let duration = parse_duration(text);
    if duration.is_none() {
        let message = format!("`{}` is not a duration from 10ms to 1h", short(text));
        let note = findings.error(Code::Duration, place, message);
        note.help("give a number with its unit: 500ms, 1s, 2.5s, 1min");
    }
    duration
}

/// Reads a duration. Returns `None` also outside 10 ms to 1 h.
fn parse_duration(text: &str) -> Option<Duration> {
    let unit = text.find(|c: char| c.is_ascii_alphabetic())?;
    let (number, unit) = text.split_at_checked(unit)?;
    let (whole, fraction) = number.split_once('.').unwrap_or((number, "0"));
    let digits =
        |text: &str| (1..=9).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
    if !digits(whole) || !digits(fraction) {
        return None;
    }
    let unit_nanos: u64 = match unit {
        "ms" => 1_000_000,
        "s" => 1_000_000_000,
        "min" => 60_000_000_000,
        "h" => 3_600_000_000_000,
        _ => return None,
    };
    let scale = 10_u64.checked_pow(u32::try_from(fraction.len()).ok()?)?;
    let whole = whole.parse::<u64>().ok()?.checked_mul(unit_nanos)?;
    let fraction =
        u128::from(fraction.parse::<u64>().ok()?) * u128::from(unit_nanos) / u128::from(scale);
    let nanos = whole.checked_add(u64::try_from(fraction).ok()?)?;
    let duration = Duration::from_nanos(nanos);
    (SHORTEST..=LONGEST).contains(&duration).then_some(duration)
}

pub(super) fn server(
    entry: Option<&Located<ServerEntry>>,
    findings: &mut MappingFindings,
) -> Server {
    let default = Server::default();
    let Some(entry) = entry.and_then(|at| at.value.as_ref()) else {
        return default;
    };
    let endpoint = given(&entry.endpoint).and_then(|(text, place)| {
        let endpoint = Endpoint::parse(text);
        if endpoint.is_none() {
            let message = format!("`{}` is not an endpoint", short(text));
            let mut note = findings.error(Code::Endpoint, place, message);
            if has_user(text) {
                note = note.label("remove the user name and the password");
            }
            note.help(format!("for example {}", default.endpoint));
        }
        endpoint
    });
    let application_uri = given(&entry.application_uri).and_then(|(text, place)| {
        if is_uri(text) {
            return Some(text.clone());
        }
        let message = format!("`{}` is not an ApplicationUri", short(text));
        let mut note = findings.error(Code::ApplicationUri, place, message);
        if has_user(text) {
            note = note.label("every client can read it: remove the user name and the password");
        }
        note.help(format!("for example {}", default.application_uri));
        None
    });
    let security =
        given(&entry.security).and_then(|(entries, place)| security(entries, place, findings));
    let redundant = redundant(&entry.redundant, findings);
    let redundant_endpoints =
        redundant_endpoints(&entry.redundant_endpoints, redundant.len(), findings);
    let server = Server {
        endpoint: endpoint.unwrap_or(default.endpoint),
        application_uri: application_uri.unwrap_or(default.application_uri),
        redundant,
        redundant_endpoints,
        security,
        anonymous: permissions::anonymous(entry),
        refuse_other_hosts: given(&entry.refuse_other_hosts).is_some_and(|(refuse, _)| *refuse),
        bad_after: duration(&entry.bad_after, findings),
        publisher_alarms: given(&entry.publisher_alarms).is_some_and(|(on, _)| *on),
        reverse_connect: reverse_connect(&entry.reverse_connect, findings),
        history: history(&entry.history, findings),
        history_file: given(&entry.history)
            .and_then(|(history, _)| given(&history.file))
            .map(|(file, _)| PathBuf::from(file)),
        limits: limits(&entry.limits, findings),
        find_skills: None,
        nodesets: Vec::new(),
    };
    permissions::left_open(entry, &server, findings);
    server
}

/// Reads the ApplicationUris of redundant servers.
fn redundant(
    field: &OptionalKey<Vec<Located<String>>>,
    findings: &mut MappingFindings,
) -> Vec<String> {
    let Some((entries, place)) = given(field) else {
        return Vec::new();
    };
    let mut uris: Vec<String> = Vec::new();
    for entry in entries {
        let Some(text) = entry.value.as_ref() else {
            return Vec::new();
        };
        if !is_uri(text) || uris.contains(text) {
            let message = if uris.contains(text) {
                format!("`{}` is the ApplicationUri of two servers", short(text))
            } else {
                format!("`{}` is not an ApplicationUri", short(text))
            };
            findings
                .error(Code::ApplicationUri, entry.place, message)
                .help("redundant: [\"urn:cell:server-1\", \"urn:cell:server-2\"]");
            return Vec::new();
        }
        uris.push(text.clone());
    }
    if !(2..=3).contains(&uris.len()) {
        let message = format!("{} redundant servers; 2 or 3 are possible", uris.len());
        findings
            .error(Code::ApplicationUri, place, message)
            .help("redundant: [\"urn:cell:server-1\", \"urn:cell:server-2\"]");
        return Vec::new();
    }
    uris
}

/// Reads the endpoints of redundant servers, one for each of their ApplicationUris.
fn redundant_endpoints(
    field: &OptionalKey<Vec<Located<String>>>,
    servers: usize,
    findings: &mut MappingFindings,
) -> Vec<Endpoint> {
    let Some((entries, place)) = given(field) else {
        return Vec::new();
    };
    let mut endpoints: Vec<Endpoint> = Vec::new();
    for Located { place, value } in entries {
        let Some(text) = value else {
            return Vec::new();
        };
        let Some(endpoint) = remote_endpoint(text, *place, findings) else {
            return Vec::new();
        };
        if endpoints.contains(&endpoint) {
            let message = format!("{endpoint} is the endpoint of two redundant servers");
            let note = findings.error(Code::Endpoint, *place, message);
            note.help("give each server an endpoint of its own");
            return Vec::new();
        }
        endpoints.push(endpoint);
    }
    if endpoints.len() != servers {
        let message = format!(
            "{} endpoints for {servers} servers of `redundant`",
            endpoints.len()
        );
        let note = findings.error(Code::Endpoint, place, message);
        note.help("list an endpoint for each ApplicationUri of `redundant`, in the same order");
        return Vec::new();
    }
    endpoints
}

/// Returns the clients to which the server connects.
fn reverse_connect(
    field: &OptionalKey<Vec<Located<String>>>,
    findings: &mut MappingFindings,
) -> Vec<Endpoint> {
    let Some((entries, place)) = given(field) else {
        return Vec::new();
    };
    if entries.len() > MAX_REVERSE {
        let message = format!("{} clients; at most {MAX_REVERSE}", entries.len());
        findings.error(Code::TooLarge, place, message);
        return Vec::new();
    }
    let mut clients: Vec<Endpoint> = Vec::new();
    for Located { place, value } in entries {
        let Some(text) = value else { continue };
        let Some(client) = remote_endpoint(text, *place, findings) else {
            continue;
        };
        if clients.contains(&client) {
            let message = format!("the client {client} is listed twice");
            findings.error(Code::Endpoint, *place, message);
            continue;
        }
        clients.push(client);
    }
    clients
}

/// Maximum number of clients to which the server connects.
const MAX_REVERSE: usize = 16;

fn history(field: &OptionalKey<HistoryEntry>, findings: &mut MappingFindings) -> History {
    let usual = History::default();
    let Some((entry, _)) = given(field) else {
        return usual;
    };
    let megabytes = within(&entry.megabytes, 1..=16_384, "MiB", findings);
    History {
        values: given(&entry.values).map_or(usual.values, |(count, _)| *count),
        bytes: megabytes.map_or(usual.bytes, |mebibytes| usize::from(mebibytes) << 20),
    }
}

fn limits(field: &OptionalKey<LimitsEntry>, findings: &mut MappingFindings) -> ServerLimits {
    let Some((entry, _)) = given(field) else {
        return ServerLimits::default();
    };
    ServerLimits {
        sessions: within(&entry.sessions, 1..=10_000, "sessions", findings),
        sessions_per_address: within(
            &entry.sessions_per_address,
            1..=10_000,
            "sessions of an address",
            findings,
        ),
        connections: within(&entry.connections, 1..=u16::MAX, "connections", findings),
        connections_per_address: within(
            &entry.connections_per_address,
            1..=u16::MAX,
            "connections of an address",
            findings,
        ),
        subscriptions: within(&entry.subscriptions, 1..=1_000, "subscriptions", findings),
        items: within(&entry.items, 1..=u16::MAX, "items", findings),
        operations: within(&entry.operations, 1..=u16::MAX, "operations", findings),
    }
}

/// Reads the endpoint of another server. Returns `None` for a faulty endpoint, which is noted.
pub(super) fn remote_endpoint(
    text: &str,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Endpoint> {
    let endpoint = Endpoint::parse(text);
    if endpoint.is_none() {
        let message = format!("`{}` is not an endpoint", short(text));
        let mut note = findings.error(Code::Endpoint, place, message);
        if has_user(text) {
            note = note.label("remove the user name and the password");
        }
        note.help("use an endpoint such as opc.tcp://192.168.0.10:4840");
    }
    endpoint
}

/// Returns `true` for the endpoint of the cell's own server.
pub(super) fn is_own(endpoint: &Endpoint, own: &Server) -> bool {
    own.endpoints()
        .any(|own| endpoint.host.eq_ignore_ascii_case(&own.host) && endpoint.port == own.port)
}

fn security(
    entries: &[Located<SecurityEntry>],
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Vec<ServerSecurityPolicy>> {
    if entries.is_empty() {
        let message = "a server without a security policy has no endpoint";
        findings
            .error(Code::WrongValue, place, message)
            .help("security: [None, Basic256Sha256]");
        return None;
    }
    let mut policies = Vec::new();
    for entry in entries {
        let Some(policy) = entry.value.map(policy) else {
            continue;
        };
        if policies.contains(&policy) {
            let message = format!("the security policy {} is listed twice", policy.name());
            findings
                .warning(Code::WrongValue, entry.place, message)
                .help("remove it here");
        } else {
            policies.push(policy);
        }
    }
    Some(policies)
}

pub(super) const fn policy(entry: SecurityEntry) -> ServerSecurityPolicy {
    match entry {
        SecurityEntry::None => ServerSecurityPolicy::None,
        SecurityEntry::Basic256Sha256 => ServerSecurityPolicy::Basic256Sha256,
        SecurityEntry::Aes128Sha256RsaOaep => ServerSecurityPolicy::Aes128Sha256RsaOaep,
        SecurityEntry::Aes256Sha256RsaPss => ServerSecurityPolicy::Aes256Sha256RsaPss,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_duration_is_a_number_with_its_unit() {
        for (text, millis) in [
            ("500ms", 500),
            ("1s", 1000),
            ("2.5s", 2500),
            ("1min", 60_000),
            ("1h", 3_600_000),
            ("0.010s", 10),
            ("10ms", 10),
        ] {
            assert_eq!(
                parse_duration(text),
                Some(Duration::from_millis(millis)),
                "{text}"
            );
        }
        for text in [
            "",
            "1",
            "s",
            "1 s",
            "-1s",
            "+1s",
            "1.s",
            ".5s",
            "1e3s",
            "9ms",
            "3601s",
            "1.1h",
            "0s",
            "1d",
            "1.2.3s",
            "99999999999999999999s",
            "999999999h",
            "١s",
        ] {
            assert_eq!(parse_duration(text), None, "{text}");
        }
    }
}
