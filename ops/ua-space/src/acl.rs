//! `ua-space acl`: access rules for an MQTT broker, from a mapping.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::{self, Write as _};

use mappings::{Broker, CarrierMedium, ForwardedName, Mapping, SpaceId, TopicForm};

use crate::arguments::Acl;
use crate::exit::Failure;
use crate::live::broker_mapping;

/// Prints the `acl_file` of mosquitto.
pub(crate) fn acl(arguments: &Acl) -> Result<(), Failure> {
    let mapping = broker_mapping(&arguments.mapping)?;
    let rules = rules(&mapping)?;
    io::stdout().lock().write_all(rules.as_bytes())?;
    Ok(())
}

/// Returns the rules for a user of each space, and for a user that inspects.
fn rules(mapping: &Mapping) -> Result<String, Failure> {
    let Some(broker) = mapping.pubsub().broker.as_deref() else {
        let why =
            "the mapping names no broker; for example pubsub: {address: mqtt://broker.local:1883}";
        return Err(Failure::Usage(why.to_owned()));
    };
    let prefix = &broker.prefix;
    let declared = mapping.spaces().iter().map(|space| space.id);
    let spaces: BTreeSet<SpaceId> = declared.chain([SpaceId::UA]).collect();
    let mut text = String::from(
        "# acl_file of mosquitto. Each user may write the messages of one space, so that a program\n\
         # cannot send in the name of another. Set the passwords with mosquitto_passwd.\n",
    );
    for space in spaces {
        let programs = match space {
            SpaceId::UA => "ua-server and the components",
            SpaceId::ROS1 => "bridge-ros1",
            _ => "bridge-ros2",
        };
        // Writing to a string does not fail.
        let _written = writeln!(text, "\n# {programs}\nuser space-{space}");
        for kind in OF_PUBLISHER {
            let _written = writeln!(text, "topic write {prefix}/+/{kind}/{space}/#");
        }
        for topic in names(broker, mapping, space) {
            let _written = writeln!(text, "topic write {topic}");
        }
        shared(&mut text, prefix);
    }
    let forwarded = forwarded(mapping);
    if !forwarded.is_empty() {
        let _written = writeln!(
            text,
            "\n# the program that forwards from the other carriers; add the rules of its own space\n\
             user forwarder"
        );
        for space in forwarded {
            for kind in OF_PUBLISHER {
                let _written = writeln!(text, "topic write {prefix}/+/{kind}/{space}/#");
            }
            for topic in names(broker, mapping, space) {
                let _written = writeln!(text, "topic write {topic}");
            }
        }
        shared(&mut text, prefix);
    }
    let _written = writeln!(text, "\n# ua-space; may also request each call\nuser tools");
    shared(&mut text, prefix);
    Ok(text)
}

/// Returns the spaces of which other carriers forward messages to the first broker. Confirmations
/// of commands go to the broker too, but they need a name of their space as well.
fn forwarded(mapping: &Mapping) -> BTreeSet<SpaceId> {
    let carriers = mapping.pubsub().carriers.iter();
    let is_broker = |medium: &CarrierMedium| matches!(medium, CarrierMedium::Mqtt(_));
    let others = carriers.filter(|carrier| !is_broker(&carrier.medium));
    let names = others.flat_map(|carrier| &carrier.forward);
    names.map(|name: &ForwardedName| name.space()).collect()
}

/// Adds the rules of all users. A request and a probe have the topic of the space that they are
/// sent to.
fn shared(text: &mut String, prefix: &str) {
    for kind in OF_ALL {
        let _written = writeln!(text, "topic write {prefix}/uadp/{kind}/#");
    }
    let _written = writeln!(text, "topic read {prefix}/#");
}

/// Returns the topics of the space, if values have the names of the space as topics: a wildcard
/// cannot stand for a part of a level.
fn names(broker: &Broker, mapping: &Mapping, space: SpaceId) -> Vec<String> {
    if broker.topics != TopicForm::Names {
        return Vec::new();
    }
    let topics = mapping.variables().iter().map(|variable| variable.topic);
    let own = topics.filter(|topic| topic.space == space);
    own.map(|topic| format!("{}/{topic}", broker.prefix))
        .collect()
}

/// The types of messages that only the publisher in the topic sends.
const OF_PUBLISHER: [&str; 10] = [
    "data",
    "metadata",
    "status",
    "connection",
    "application",
    "endpoints",
    "discovery",
    "action-response",
    "action-metadata",
    "action-responder",
];
const OF_ALL: [&str; 2] = ["action-request", "probe"];

#[cfg(test)]
mod tests {
    use super::*;

    const CELL: &str = "
pubsub: {address: \"mqtt://broker:1883\", mqtt: {prefix: cell, topics: names}}
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:x}
variables:
  - {node: ns=5;i=10, name: A, origin: 2, ros: {topic: /a, type: std_msgs/Bool}}
";

    #[test]
    fn each_space_may_write_its_own_topics_only() {
        let mapping = Mapping::from_yaml(CELL, "cell.yaml").mapping.unwrap();
        let rules = rules(&mapping).unwrap();
        let mut users = rules.split("\nuser ").skip(1);
        for (name, own) in [("space-0", 0), ("space-1", 1), ("space-2", 2)] {
            let user = users.next().unwrap();
            assert!(user.starts_with(name), "{user}");
            let data: Vec<&str> = user
                .lines()
                .filter(|line| line.contains("/data/"))
                .collect();
            assert_eq!(data, [format!("topic write cell/+/data/{own}/#")]);
            assert_eq!(user.contains("topic write cell/ua_2_5_10"), own == 2);
        }
        let tools = users.next().unwrap();
        assert!(!tools.contains("/data/") && !tools.contains("/discovery/"));
        assert!(tools.contains("topic read cell/#"));
    }

    #[test]
    fn a_program_that_forwards_may_write_the_messages_of_the_other_carrier() {
        let cell = "pubsub: [{udp: {}, forward: [ua_1_2, ua_1_3]}, {mqtt: {address: \"mqtt://b\"}, forward: [ua_2]}]\n\
                    spaces: [{id: 1}, {id: 2}]\n";
        let mapping = Mapping::from_yaml(cell, "cell.yaml").mapping.unwrap();
        let rules = rules(&mapping).unwrap();
        let (_, forwarder) = rules.split_once("\nuser forwarder\n").unwrap();
        let (forwarder, _) = forwarder.split_once("\nuser ").unwrap();
        let written = "topic write opcua/+/data/1/#";
        assert_eq!(forwarder.matches(written).count(), 1, "{forwarder}");
        assert!(!forwarder.contains("/data/2/"), "{forwarder}");
    }

    #[test]
    fn a_mapping_without_a_broker_has_no_rules() {
        assert!(rules(&Mapping::default()).is_err());
    }
}
