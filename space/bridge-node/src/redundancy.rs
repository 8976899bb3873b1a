//! The settings of redundant bridges.

use std::collections::BTreeSet;

use bridge_core::RedundancyRank;
use mappings::{Mapping, SpaceId};
use service::{Failure, FailureKind};

use crate::arguments::Flags;

/// The arguments of a bridge that shares its space with other bridges.
#[derive(Debug, Clone, clap::Args)]
#[group(skip)]
pub struct RedundancyArguments {
    /// Run as one of up to three redundant bridges of the space, of which a single one is active:
    /// 1 for the first host, 2 for the second. All of them have the same mapping and the same group
    #[arg(long, value_name = "1|2|3", env = "UA_RANK", value_parser = rank)]
    pub rank: Option<RedundancyRank>,
    /// Carry only these namespaces in both directions, such as 2,5, because other bridges of the
    /// space carry the others
    #[arg(
        long,
        value_name = "NUMBERS",
        env = "UA_NAMESPACES",
        value_delimiter = ',',
        value_parser = clap::value_parser!(u16).range(1..),
        conflicts_with = "rank"
    )]
    pub namespaces: Vec<u16>,
}

impl RedundancyArguments {
    /// Returns the name of the node of a bridge: the nodes of bridges that share a space have
    /// different names, because a ROS 1 master ends the older of two nodes of a name.
    #[must_use]
    pub fn node_name(&self, name: &str) -> String {
        match (self.rank, self.namespaces.iter().min()) {
            (Some(rank), _) if rank.get() > 1 => format!("{name}_{}", rank.get()),
            (None, Some(first)) => format!("{name}_namespace_{first}"),
            (Some(_), _) | (None, None) => name.to_owned(),
        }
    }

    /// Returns the namespaces that the bridge carries; empty for all of them.
    #[must_use]
    pub fn part(&self) -> BTreeSet<u16> {
        self.namespaces.iter().copied().collect()
    }
}

/// Reads a rank of the command line.
///
/// # Errors
/// The text is no rank.
pub fn rank(text: &str) -> Result<RedundancyRank, NoRank> {
    let number = text.trim().parse().ok();
    let rank = number.and_then(RedundancyRank::new);
    rank.ok_or(NoRank)
}

/// A text that is no rank of a redundant bridge.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a rank is 1 to {most}", most = RedundancyRank::MOST)]
pub struct NoRank;

/// Checks that a redundant bridge can carry the mapping.
///
/// # Errors
/// The settings contradict redundancy.
pub(crate) fn check(flags: &Flags, mapping: &Mapping, spaces: &[SpaceId]) -> Result<(), Failure> {
    let refuse = |why: &str| {
        let message = format!("--rank: {why}");
        Err(Failure::new(FailureKind::Configuration, message))
    };
    if flags.dry_run {
        return refuse("a bridge with --dry-run takes over nothing; leave one of them out");
    }
    let is_mqtt = |url: &String| mappings::BrokerAddress::is_mqtt(url);
    let is_broker = match &flags.address {
        Some(url) => is_mqtt(url),
        None => mapping.pubsub().broker.is_some(),
    };
    let carriers = mapping.pubsub().carriers.len();
    if flags.address.is_none() && carriers == 1 {
        return refuse("redundant bridges need UDP multicast, and the carrier is Ethernet");
    }
    if flags.address.is_none() && carriers > 1 {
        return refuse(
            "redundant bridges need one carrier, UDP multicast, and `pubsub` is a list: the lease of the active \
             bridge does not hold on several networks. Make `pubsub` a map with the group only, and let a program \
             without --rank forward states to the other carriers",
        );
    }
    if is_broker {
        return refuse("redundant bridges need UDP multicast, and the group is an MQTT broker");
    }
    let address = match &flags.address {
        Some(url) => mappings::PubSub::parse_address(url),
        None => Some(mapping.pubsub().address),
    };
    if address.is_some_and(|address| !address.ip().is_multicast()) {
        return refuse(
            "redundant bridges receive the heartbeats of each other by multicast, and `pubsub.address` is no \
             multicast address",
        );
    }
    match spaces.iter().find_map(|own| uncovered(mapping, *own)) {
        Some(why) => refuse(&why),
        None => Ok(()),
    }
}

/// Returns the first entry of the mapping that a redundant bridge of the space does not carry, as
/// text for the user: a value that calls a service or is made of its responses.
pub(crate) fn uncovered(mapping: &Mapping, own: SpaceId) -> Option<String> {
    let mut values = mapping.variables().iter();
    let value = values.find(|variable| {
        let service = variable.service.as_ref();
        service.is_some_and(|service| service.space == own)
    });
    value.map(|value| {
        format!(
            "values of services are not carried by redundant bridges, and variable `{}` has a service in space {own}; give it \
             to a bridge without --rank, or leave --rank out",
            value.name
        )
    })
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::arguments::Arguments;

    #[derive(clap::Parser)]
    struct Bridge {
        #[command(flatten)]
        arguments: Arguments,
        #[command(flatten)]
        redundancy: RedundancyArguments,
    }

    const VALUES: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:x}
variables:
  - {node: ns=5;i=10, name: A, origin: 2, ros: [{topic: /a, type: std_msgs/Bool}, {space: 1, topic: /a, type: std_msgs/Bool}]}
";
    const CALLS: &str = "
calls:
  - {node: ns=5;i=60, name: Grip, origin: 2, ros: [{service: /g, type: std_srvs/Trigger}, {space: 1, service: /g, type: std_srvs/Trigger}]}
";
    const SERVICE: &str = "
  - {node: ns=5;i=11, name: Light, origin: 1, ros: {space: 2, call: /l, type: std_srvs/SetBool, field: data}}
";

    fn checked(words: &[&str], yaml: &str) -> Result<(), String> {
        let all = std::iter::once(&"bridge").chain(words);
        let bridge = Bridge::try_parse_from(all).unwrap();
        let mapping = Mapping::from_yaml(yaml, "cell.yaml").mapping.unwrap();
        let spaces = [SpaceId::new(2).unwrap()];
        assert!(bridge.redundancy.rank.is_some());
        check(&bridge.arguments.flags, &mapping, &spaces).map_err(|failure| failure.to_string())
    }

    #[test]
    fn a_redundant_bridge_refuses_what_it_does_not_carry() {
        let rank = ["--rank", "2"];
        assert_eq!(checked(&rank, VALUES), Ok(()));
        assert_eq!(checked(&rank, &format!("{VALUES}{CALLS}")), Ok(()));
        let refused = |words: &[&str], yaml: &str, said: &str| {
            let words: Vec<&str> = rank.iter().chain(words).copied().collect();
            let why = checked(&words, yaml).unwrap_err();
            assert!(why.contains(said), "{why}");
        };
        refused(&["--dry-run"], VALUES, "--dry-run");
        let carriers = "pubsub: [{udp: {}}, {mqtt: {address: mqtt://broker.local:1883}}]";
        let several = format!("{carriers}{VALUES}");
        refused(&[], &several, "a program without --rank forward");
        refused(
            &["--address", "mqtt://broker.local:1883"],
            VALUES,
            "MQTT broker",
        );
        refused(
            &["--address", "opc.udp://127.0.0.1:4840"],
            VALUES,
            "multicast",
        );
        refused(&[], &format!("{VALUES}{SERVICE}"), "variable `Light`");
    }

    #[test]
    fn ranks_are_1_to_3_and_give_nodes_different_names() {
        let parsed = |rank: &str| Bridge::try_parse_from(["bridge", "--rank", rank]);
        for wrong in ["0", "4", "first"] {
            assert!(parsed(wrong).is_err(), "{wrong}");
        }
        let names = ["1", "2", "3"].map(|rank| {
            let bridge = parsed(rank).unwrap();
            bridge.redundancy.node_name("cell")
        });
        assert_eq!(names, ["cell", "cell_2", "cell_3"]);
    }

    #[test]
    fn bridges_of_parts_have_different_nodes_and_no_rank() {
        let bridge = Bridge::try_parse_from(["bridge", "--namespaces", "5,2"]).unwrap();
        assert_eq!(bridge.redundancy.part(), [2, 5].into());
        assert_eq!(bridge.redundancy.node_name("cell"), "cell_namespace_2");
        for wrong in [
            &["--namespaces", "0"][..],
            &["--namespaces", "2", "--rank", "1"],
        ] {
            let words = std::iter::once(&"bridge").chain(wrong);
            assert!(Bridge::try_parse_from(words).is_err(), "{wrong:?}");
        }
    }
}
