//! Tracks other bridges of the domain: the values of the spaces that they serve are left to them.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use mappings::{Mapping, SpaceId, TopicId};
use ros2_node::graph::{Graph, bridge_topic};
use ros2_node::node::ParticipantPrefix;
use rustdds::GUID;

use super::side::Ros2Side;

impl Ros2Side {
    /// Returns whether another bridge serves the space in this domain. Any participant can announce
    /// a space; the announcement is ignored if the mapping has the space in another domain.
    pub(super) fn is_at_home(&self, space: SpaceId) -> bool {
        is_at_home(&self.graph, self.policy.mapping(), space, self.domain_id)
    }

    /// Logs other bridges of the domain, because their announcements exclude the values of their
    /// spaces.
    pub(super) fn tell_of_bridges(&mut self) {
        let own = u16::from(self.policy.own());
        let others = self.graph.bridges().filter(|(_, space)| *space != own);
        // Keyed by space, because a hostile participant may use any number of identities.
        let others: BTreeMap<_, _> = others.map(|(bridge, space)| (space, bridge)).collect();
        for (number, bridge) in others {
            let Some(space) = SpaceId::new(number) else {
                continue;
            };
            let who = match self.domain.nodes_of(&bridge).as_slice() {
                [] => format!("participant {} (no ROS node yet)", hex(&bridge)),
                nodes => format!("participant {} ({})", hex(&bridge), nodes.join(", ")),
            };
            let domain = self.domain_id;
            if is_possible(self.policy.mapping(), space, domain) {
                self.policy.told.once(&bridge_topic(number), "bridge", || {
                    format!(
                        "{who} announces that it is the bridge of space {space} in domain {domain}: this \
                         bridge leaves the values of the space to it"
                    )
                });
            } else {
                self.policy.told.once(&bridge_topic(number), "no bridge", || {
                    format!(
                        "ignored {who}, which announces that it is the bridge of space {space}: the mapping \
                         has the space in another domain than {domain}"
                    )
                });
            }
        }
    }
}

/// Returns whether another bridge serves the space in the domain of the graph.
pub(super) fn is_at_home(graph: &Graph, mapping: &Mapping, space: SpaceId, domain: u16) -> bool {
    graph.is_at_home(space.into()) && is_possible(mapping, space, domain)
}

/// The identity of this bridge among the bridges of its domain.
#[derive(Clone, Copy)]
pub(super) struct BridgeIdentity {
    /// The space that this bridge serves.
    pub(super) space: SpaceId,
    /// The participant of this bridge.
    pub(super) participant: GUID,
    /// Whether other bridges of the space are redundant: only the active one offers calls.
    pub(super) is_redundant: bool,
}

impl BridgeIdentity {
    /// Returns whether another bridge that precedes this bridge offers a call of a third space
    /// under the same name: a client would call both, and the call would be executed twice.
    pub(super) fn is_second(
        &self,
        graph: &Graph,
        mapping: &Mapping,
        (topic, service): (TopicId, &str),
        domain: u16,
    ) -> bool {
        let own = (u16::from(self.space), self.participant.prefix.as_ref());
        graph.bridges().any(|(bridge, number)| {
            let Some(space) = SpaceId::new(number) else {
                return false;
            };
            let is_peer = self.is_redundant && number == own.0;
            let before = !is_peer && (number, bridge.as_slice()) < own;
            before && is_possible(mapping, space, domain) && {
                match mapping.call(topic).and_then(|call| call.binding(space)) {
                    Some(binding) => binding.target.name == service,
                    None => service.strip_prefix('/') == Some(topic.to_string().as_str()),
                }
            }
        })
    }
}

/// Returns whether the mapping allows a bridge of the space in the domain.
fn is_possible(mapping: &Mapping, space: SpaceId, domain: u16) -> bool {
    mapping
        .space(space)
        .is_none_or(|declared| declared.domain == Some(domain))
}

fn hex(participant: &ParticipantPrefix) -> String {
    participant.iter().fold(String::new(), |mut text, byte| {
        // Writing to a String does not fail.
        write!(text, "{byte:02x}").unwrap_or_default();
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2_node::graph::{BRIDGE_TYPE, RemoteEndpoint};

    fn guid(first: u8) -> GUID {
        GUID::from_bytes([first; 16])
    }

    /// Returns a graph with bridges of these spaces; the GUIDs of their participants start with
    /// these bytes.
    fn domain_with(bridges: &[(u16, u8)]) -> Graph {
        let markers = bridges.iter().map(|(space, first)| {
            let endpoint = RemoteEndpoint {
                guid: guid(*first),
                type_name: BRIDGE_TYPE.into(),
                reliable: true,
                transient_local: false,
                type_hash: None,
                qos: std::sync::Arc::default(),
            };
            (bridge_topic(*space), endpoint)
        });
        Graph::from_endpoints(markers, [])
    }

    #[test]
    fn of_two_bridges_one_comes_first_unless_the_other_has_the_call_under_another_name() {
        let bridge = |space, first| BridgeIdentity {
            space: SpaceId::new(space).unwrap(),
            participant: guid(first),
            is_redundant: false,
        };
        let mapping = Mapping::default();
        let second = |one: BridgeIdentity, others: &[(u16, u8)], service: &str| {
            let topic = "ua_1_2_61".parse().unwrap();
            one.is_second(&domain_with(others), &mapping, (topic, service), 2)
        };
        let named = "/ua_1_2_61";
        assert!(!second(bridge(2, 9), &[], named));
        assert!(!second(bridge(2, 9), &[(3, 1)], named));
        assert!(second(bridge(3, 1), &[(2, 9)], named));
        assert!(second(bridge(2, 9), &[(2, 1)], named) && !second(bridge(2, 1), &[(2, 9)], named));
        assert!(!second(bridge(3, 1), &[(2, 9)], "/switch"));
    }

    #[test]
    fn a_bridge_of_a_space_that_the_mapping_has_elsewhere_is_not_believed() {
        let text = "spaces:\n  - {id: 2}\n  - {id: 3, domain: 7}\nvariables: []\n";
        let mapping = Mapping::from_yaml(text, "cell.yaml").mapping.unwrap();
        let space = |number| SpaceId::new(number).unwrap();
        let told = [(2, 2), (2, 7), (3, 7), (3, 2), (3, 3), (4, 2), (4, 7)];
        let believed = told.map(|(number, domain)| is_possible(&mapping, space(number), domain));
        assert_eq!(believed, [true, false, true, false, false, true, true]);
    }
}
