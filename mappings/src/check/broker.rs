//! The MQTT broker.

use std::path::PathBuf;

use super::quantity::{duration, within};
use crate::broker::{Broker, BrokerAddress, MessageMapping, MqttVersion, TopicForm};
use crate::code::Code;
use crate::document::{EncodingEntry, MqttEntry, MqttVersionEntry, PubSubEntry, TopicFormEntry};
use crate::findings::MappingFindings;
use crate::read::{OptionalKey, given, short};
use crate::secret::has_user;
use crate::tree::TextSpan;

/// Returns the broker of the mapping; `None` if the messages are carried by UDP.
pub(super) fn check(entry: &PubSubEntry, findings: &mut MappingFindings) -> Option<Box<Broker>> {
    let address = given(&entry.address).filter(|(text, _)| BrokerAddress::is_mqtt(text));
    let Some((text, place)) = address else {
        if let Some(at) = &entry.mqtt {
            let note = findings.error(
                Code::Address,
                at.place,
                "`mqtt` needs the address of a broker",
            );
            note.help(format!("address: {}", BrokerAddress::EXAMPLE));
        }
        return None;
    };
    if let Some((mqtt, _)) = given(&entry.mqtt)
        && let Some(at) = &mqtt.address
    {
        let message = "the broker has two addresses";
        let note = findings.error(Code::Address, at.place, message);
        note.help("remove this address: `address` of `pubsub` is the address");
    }
    let mqtt = given(&entry.mqtt).map(|(mqtt, _)| mqtt);
    at((text.as_str(), place), mqtt, findings)
}

/// Returns the broker at an address.
pub(super) fn at(
    (text, place): (&str, TextSpan),
    entry: Option<&MqttEntry>,
    findings: &mut MappingFindings,
) -> Option<Box<Broker>> {
    let Some(address) = BrokerAddress::parse(text) else {
        let message = format!("`{}` is not an address of a broker", short(text));
        let mut note = findings.error(Code::Address, place, message);
        if has_user(text) {
            note = note
                .label("put the user name and the password into a file: `mqtt: {credentials: ..}`");
        }
        note.help(format!("for example {}", BrokerAddress::EXAMPLE));
        return None;
    };
    let mut broker = Broker::new(address);
    let Some(mqtt) = entry else {
        return Some(Box::new(broker));
    };
    broker.version = given(&mqtt.version).map(|(version, _)| match version {
        MqttVersionEntry::V311 => MqttVersion::V3_1_1,
        MqttVersionEntry::V5 => MqttVersion::V5,
    });
    broker.encoding = match given(&mqtt.encoding) {
        None | Some((EncodingEntry::Uadp, _)) => MessageMapping::Uadp,
        Some((EncodingEntry::JsonVerbose, _)) => MessageMapping::JsonVerbose,
        Some((EncodingEntry::JsonCompact, _)) => MessageMapping::JsonCompact,
        Some((EncodingEntry::JsonReversible, _)) => MessageMapping::JsonReversible,
        Some((EncodingEntry::JsonNonReversible, _)) => MessageMapping::JsonNonReversible,
    };
    broker.topics = match given(&mqtt.topics) {
        Some((TopicFormEntry::Names, _)) => TopicForm::Names,
        Some((TopicFormEntry::Tree, _)) | None => TopicForm::Tree,
    };
    if let Some(prefix) = levels(&mqtt.prefix, findings) {
        broker.prefix = prefix;
    }
    broker.client_id = levels(&mqtt.client_id, findings);
    broker.at_least_once = within(&mqtt.qos, 0..=1, "for qos", findings) == Some(1);
    broker.within = duration(&mqtt.within, findings).unwrap_or(Broker::WITHIN);
    broker.acl = given(&mqtt.acl).is_some_and(|(set, _)| *set);
    if let Some((true, place)) = given(&mqtt.will) {
        broker.will = broker.encoding == MessageMapping::Uadp;
        if !broker.will {
            let message = "a connection has one will, and with JSON there are two statuses";
            let note = findings.error(Code::WrongValue, place, message);
            note.help("remove `will`, or use `encoding: uadp`");
        }
    }
    files(mqtt, &mut broker, findings);
    Some(Box::new(broker))
}

/// Sets the files for TLS and for the log-in.
fn files(mqtt: &MqttEntry, broker: &mut Broker, findings: &mut MappingFindings) {
    let path = |field: &OptionalKey<String>| given(field).map(|(file, _)| PathBuf::from(file));
    broker.ca = path(&mqtt.ca);
    broker.credentials = path(&mqtt.credentials);
    broker.client = match (path(&mqtt.certificate), path(&mqtt.key)) {
        (Some(certificate), Some(key)) => Some((certificate, key)),
        (None, None) => None,
        (certificate, _) => {
            let (at, missing) = match certificate {
                Some(_) => (&mqtt.certificate, "key"),
                None => (&mqtt.key, "certificate"),
            };
            if let Some(at) = at {
                let message = format!("a client certificate also needs `{missing}`");
                findings
                    .error(Code::MissingKey, at.place, message)
                    .help("certificate: client.pem, key: client.key");
            }
            None
        }
    };
    if broker.address.tls {
        return;
    }
    for at in [&mqtt.ca, &mqtt.certificate].into_iter().flatten() {
        let note = findings.error(Code::Address, at.place, "certificates require mqtts://");
        note.help(format!("address: mqtts://{}:8883", broker.address.host));
    }
    if let Some(at) = &mqtt.credentials
        && !is_loopback(&broker.address.host)
    {
        let message = "the password is sent unencrypted";
        let note = findings.warning(Code::Address, at.place, message);
        note.help(format!("address: mqtts://{}:8883", broker.address.host));
    }
}

fn is_loopback(host: &str) -> bool {
    host == "localhost"
        || host
            .parse()
            .is_ok_and(|ip: std::net::IpAddr| ip.is_loopback())
}

/// Reads levels of a topic.
fn levels(field: &OptionalKey<String>, findings: &mut MappingFindings) -> Option<String> {
    let (text, place) = given(field)?;
    if Broker::is_prefix(text) {
        return Some(text.clone());
    }
    let message = format!("`{}` cannot be part of an MQTT topic", short(text));
    findings
        .error(Code::WrongValue, place, message)
        .help("use letters, digits and `/` between levels, such as plant/cell-4");
    None
}
