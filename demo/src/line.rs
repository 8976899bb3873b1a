//! The names of the values and of the call of the line, in both ROS spaces and as nodes of the OPC
//! UA server.

use serde::{Deserialize, Serialize};

/// A value of the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "PascalCase")]
pub(crate) enum LineValueName {
    /// Boolean, from Niryo Ned.
    ConveyorRunning,
    /// UInt32, from Niryo Ned.
    CoversInStorage,
    /// UInt32, from Niryo Ned: number of covers placed on the conveyor.
    CoversOnConveyor,
    /// UInt32, from Niryo Ned: number of covers placed on TurtleBot3.
    CoversOnTurtleBot3,
    /// Boolean, from TurtleBot3.
    ParkBusy,
    /// Boolean, from TurtleBot3.
    BucketBusy,
}

impl LineValueName {
    pub(crate) const ALL: [Self; 6] = [
        Self::ConveyorRunning,
        Self::CoversInStorage,
        Self::CoversOnConveyor,
        Self::CoversOnTurtleBot3,
        Self::ParkBusy,
        Self::BucketBusy,
    ];

    /// Returns the ROS topic, without the leading slash.
    pub(crate) const fn ros_topic(self) -> &'static str {
        match self {
            Self::ConveyorRunning => "conveyor/running",
            Self::CoversInStorage => "storage/covers",
            Self::CoversOnConveyor => "conveyor/covers",
            Self::CoversOnTurtleBot3 => "turtlebot3/covers",
            Self::ParkBusy => "park/busy",
            Self::BucketBusy => "bucket/busy",
        }
    }

    /// Returns the numeric identifier of the node in namespace [`NAMESPACE`].
    pub(crate) const fn node(self) -> u32 {
        match self {
            Self::ConveyorRunning => 10,
            Self::CoversInStorage => 11,
            Self::CoversOnConveyor => 12,
            Self::CoversOnTurtleBot3 => 13,
            Self::ParkBusy => 20,
            Self::BucketBusy => 21,
        }
    }

    /// Returns the program that produces the value.
    pub(crate) const fn producer(self) -> &'static str {
        match self {
            Self::ConveyorRunning
            | Self::CoversInStorage
            | Self::CoversOnConveyor
            | Self::CoversOnTurtleBot3 => "Niryo Ned",
            Self::ParkBusy | Self::BucketBusy => "TurtleBot3",
        }
    }
}

impl std::fmt::Display for LineValueName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        std::fmt::Debug::fmt(self, f)
    }
}

/// The call that switches the conveyor: a service (std_srvs/SetBool) of Niryo Ned, without the
/// leading slash, and a Method of the OPC UA server.
pub(crate) const SWITCH: &str = "conveyor/switch";
/// The numeric identifier of that Method in namespace [`NAMESPACE`].
pub(crate) const SWITCH_NODE: u32 = 61;
/// The namespace of the values in the OPC UA server.
pub(crate) const NAMESPACE: &str = "urn:ua-bridge:assembly-line";
/// The endpoint of the OPC UA server.
pub(crate) const ENDPOINT: &str = "opc.tcp://127.0.0.1:4840";
/// The DDS domain of TurtleBot3.
pub(crate) const DOMAIN: u16 = 2;

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use mappings::{CallTarget, ExecutedBy, Identifier, Mapping, SpaceId};

    use super::*;

    #[test]
    fn the_names_are_those_of_the_shipped_mapping() {
        let text = include_str!("../../mappings/assembly-line.yaml");
        let checked = Mapping::from_yaml(text, "assembly-line.yaml");
        let mapping = checked.mapping.expect("the shipped mapping is in order");
        assert_eq!(
            mapping.namespaces().get(&2).map(String::as_str),
            Some(NAMESPACE)
        );
        assert_eq!(mapping.server().endpoint.to_string(), ENDPOINT);
        assert_eq!(mapping.space_of_domain(DOMAIN), SpaceId::new(2));
        let mapped: BTreeMap<String, _> = mapping
            .variables()
            .iter()
            .map(|variable| (variable.name.clone(), variable))
            .collect();
        assert_eq!(mapped.len(), LineValueName::ALL.len());
        for name in LineValueName::ALL {
            let variable = mapped[&name.to_string()];
            assert_eq!(variable.node.namespace, 2, "{name}");
            assert_eq!(
                variable.node.identifier,
                Identifier::Numeric(name.node()),
                "{name}"
            );
            for space in [1, 2] {
                let binding = variable.binding(SpaceId::new(space).unwrap()).unwrap();
                assert_eq!(binding.ros_topic, format!("/{}", name.ros_topic()));
            }
            let producer = match variable.topic.triple().0 {
                1 => "Niryo Ned",
                _ => "TurtleBot3",
            };
            assert_eq!(name.producer(), producer, "{name}");
        }
        let [call] = mapping.calls() else {
            panic!("{:?}", mapping.calls());
        };
        assert_eq!(call.node.namespace, 2);
        assert_eq!(call.node.identifier, Identifier::Numeric(SWITCH_NODE));
        let service = CallTarget {
            name: format!("/{SWITCH}"),
            type_name: "std_srvs/SetBool".parse().unwrap(),
        };
        assert_eq!(call.executed, ExecutedBy::Ros(service));
    }
}
