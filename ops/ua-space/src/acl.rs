//! `ua-space acl`: access rules for an MQTT broker, from a mapping.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::{self, Write as _};

use mappings::{Broker, Mapping, SpaceId, TopicForm};

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
    let _written = writeln!(text, "\n# ua-space; may also request each call\nuser tools");
    shared(&mut text, prefix);
    Ok(text)
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
    fn a_mapping_without_a_broker_has_no_rules() {
        assert!(rules(&Mapping::default()).is_err());
    }
}
