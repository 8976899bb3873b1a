//! `ua-space acl`: access rules for an MQTT broker, from a mapping.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::{self, Write as _};

use mappings::{Broker, CarrierMedium, ForwardedName, Mapping, SpaceId, TopicForm};

use crate::arguments::Acl;
use crate::exit::CommandFailure;
use crate::live::broker_mapping;

/// Prints the `acl_file` of mosquitto, or the permissions of NATS.
pub(crate) fn acl(arguments: &Acl) -> Result<(), CommandFailure> {
    let mapping = broker_mapping(&arguments.mapping)?;
    let users = users(&mapping)?;
    let rules = if arguments.nats {
        nats(&users)
    } else {
        mosquitto(&users)
    };
    io::stdout().lock().write_all(rules.as_bytes())?;
    Ok(())
}

/// A user of the broker, with filters of MQTT.
struct BrokerUser {
    name: String,
    /// The programs that log in as the user.
    programs: &'static str,
    write: Vec<String>,
    read: String,
}

impl BrokerUser {
    /// Returns a user that may read everything, and request calls. A request and a probe have the
    /// topic of the space that they are sent to.
    fn new(name: impl Into<String>, programs: &'static str, prefix: &str) -> Self {
        let shared = OF_ALL.iter().map(|kind| format!("{prefix}/uadp/{kind}/#"));
        Self {
            name: name.into(),
            programs,
            write: shared.collect(),
            read: format!("{prefix}/#"),
        }
    }

    /// Allows the user to write the messages of a space.
    fn publishes(&mut self, space: SpaceId, (broker, mapping): (&Broker, &Mapping)) {
        let prefix = &broker.prefix;
        let kinds = OF_PUBLISHER.iter();
        let kinds = kinds.map(|kind| format!("{prefix}/+/{kind}/{space}/#"));
        self.write.extend(kinds);
        self.write.extend(names(broker, mapping, space));
    }
}

/// Returns a user of each space, a user that forwards, and a user that inspects.
fn users(mapping: &Mapping) -> Result<Vec<BrokerUser>, CommandFailure> {
    let Some(broker) = mapping.pubsub().broker.as_deref() else {
        let why =
            "the mapping names no broker; for example pubsub: {address: mqtt://broker.local:1883}";
        return Err(CommandFailure::Usage(why.to_owned()));
    };
    let prefix = &broker.prefix;
    let declared = mapping.spaces().iter().map(|space| space.id);
    let spaces: BTreeSet<SpaceId> = declared.chain([SpaceId::UA]).collect();
    let mut users = Vec::new();
    for space in spaces {
        let programs = match space {
            SpaceId::UA => "ua-server and the components",
            SpaceId::ROS1 => "bridge-ros1",
            _ => "bridge-ros2",
        };
        let mut user = BrokerUser::new(format!("space-{space}"), programs, prefix);
        user.publishes(space, (broker, mapping));
        users.push(user);
    }
    let forwarded = forwarded(mapping);
    if !forwarded.is_empty() {
        let programs = "the program that forwards from other carriers; add the rules of its space";
        let mut user = BrokerUser::new("forwarder", programs, prefix);
        for space in forwarded {
            user.publishes(space, (broker, mapping));
        }
        users.push(user);
    }
    let tools = BrokerUser::new("tools", "ua-space; may also request each call", prefix);
    users.push(tools);
    Ok(users)
}

/// Returns the `acl_file` of mosquitto.
fn mosquitto(users: &[BrokerUser]) -> String {
    let mut text = String::from(
        "# acl_file of mosquitto. Each user may write the messages of one space, so that a program\n\
         # cannot send in the name of another. Set the passwords with mosquitto_passwd.\n",
    );
    for user in users {
        // Writing to a string does not fail.
        let _written = writeln!(text, "\n# {}\nuser {}", user.programs, user.name);
        for filter in &user.write {
            let _written = writeln!(text, "topic write {filter}");
        }
        let _written = writeln!(text, "topic read {}", user.read);
    }
    text
}

/// Returns the `authorization` of NATS, which turns topics into subjects.
fn nats(users: &[BrokerUser]) -> String {
    let mut text = String::from(
        "# authorization of nats-server. Each user may write the messages of one space, so that a\n\
         # program cannot send in the name of another. The passwords are environment variables.\n\
         authorization {\n  users = [\n",
    );
    for BrokerUser {
        name,
        programs,
        write,
        read,
    } in users
    {
        let variable = name.to_uppercase().replace('-', "_");
        let publish: BTreeSet<String> = write.iter().flat_map(|filter| subjects(filter)).collect();
        let publish = quoted(publish);
        // The server delivers messages with QoS 1 by subjects of its own.
        let subscribe = quoted(subjects(read).chain(["$MQTT.sub.>".to_owned()]));
        let _written = write!(
            text,
            "    # {programs}\n    {{\n      user: \"{name}\",\n      password: ${variable}_PASSWORD,\n      \
             permissions: {{\n        publish: [{publish}],\n        subscribe: [{subscribe}]\n      }}\n    }},\n"
        );
    }
    text.push_str("  ]\n}\n");
    text
}

/// Returns the subjects of a filter. `#` also stands for no level, and `>` for at least one.
fn subjects(filter: &str) -> impl Iterator<Item = String> {
    let (exact, below) = match filter.strip_suffix("/#") {
        Some(above) => (subject(above), Some(format!("{}.>", subject(above)))),
        None => (subject(filter), None),
    };
    std::iter::once(exact).chain(below)
}

fn subject(filter: &str) -> String {
    let mut subject = String::with_capacity(filter.len());
    for character in filter.chars() {
        match character {
            '.' => subject.push_str("//"),
            '/' => subject.push('.'),
            '+' => subject.push('*'),
            other => subject.push(other),
        }
    }
    subject
}

fn quoted(subjects: impl IntoIterator<Item = String>) -> String {
    let quoted: Vec<String> = subjects
        .into_iter()
        .map(|subject| format!("\"{subject}\""))
        .collect();
    quoted.join(", ")
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
        let rules = mosquitto(&users(&mapping).unwrap());
        let mut parts = rules.split("\nuser ").skip(1);
        for (name, own) in [("space-0", 0), ("space-1", 1), ("space-2", 2)] {
            let user = parts.next().unwrap();
            assert!(user.starts_with(name), "{user}");
            let data: Vec<&str> = user
                .lines()
                .filter(|line| line.contains("/data/"))
                .collect();
            assert_eq!(data, [format!("topic write cell/+/data/{own}/#")]);
            assert_eq!(user.contains("topic write cell/ua_2_5_10"), own == 2);
        }
        let tools = parts.next().unwrap();
        assert!(!tools.contains("/data/") && !tools.contains("/discovery/"));
        assert!(tools.contains("topic read cell/#"));
    }

    #[test]
    fn a_program_that_forwards_may_write_the_messages_of_the_other_carrier() {
        let cell = "pubsub: [{udp: {}, forward: [ua_1_2, ua_1_3]}, {mqtt: {address: \"mqtt://b\"}, forward: [ua_2]}]\n\
                    spaces: [{id: 1}, {id: 2}]\n";
        let mapping = Mapping::from_yaml(cell, "cell.yaml").mapping.unwrap();
        let rules = mosquitto(&users(&mapping).unwrap());
        let (_, forwarder) = rules.split_once("\nuser forwarder\n").unwrap();
        let (forwarder, _) = forwarder.split_once("\nuser ").unwrap();
        let written = "topic write opcua/+/data/1/#";
        assert_eq!(forwarder.matches(written).count(), 1, "{forwarder}");
        assert!(!forwarder.contains("/data/2/"), "{forwarder}");
    }

    #[test]
    fn subjects_of_nats_are_those_of_the_topics() {
        let all = |filter| subjects(filter).collect::<Vec<_>>();
        assert_eq!(all("cell/+/data/2/#"), ["cell.*.data.2", "cell.*.data.2.>"]);
        assert_eq!(all("plant.a/ua_1_2_10"), ["plant//a.ua_1_2_10"]);
        let mapping = Mapping::from_yaml(CELL, "cell.yaml").mapping.unwrap();
        let rules = nats(&users(&mapping).unwrap());
        let (_, user) = rules.split_once("user: \"space-1\"").unwrap();
        let (user, _) = user.split_once("user: ").unwrap();
        assert!(user.contains("password: $SPACE_1_PASSWORD,"), "{user}");
        assert!(user.contains("\"cell.*.status.1\""), "{user}");
        assert!(!user.contains("data.2"), "{user}");
        assert!(
            user.contains("subscribe: [\"cell\", \"cell.>\", \"$MQTT.sub.>\"]"),
            "{user}"
        );
    }

    #[test]
    fn a_mapping_without_a_broker_has_no_rules() {
        assert!(users(&Mapping::default()).is_err());
    }
}
