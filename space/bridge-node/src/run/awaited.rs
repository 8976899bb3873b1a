//! The missing peers that the mapping needs: peers of the port, and other spaces.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use bridge_core::Router;
use mappings::{ExecutedBy, Mapping, SpaceId};
use tracing::{info, warn};

use super::Shell;
use crate::awaited::{AwaitedPeers, PeerChanges};
use crate::clock::now;
use crate::port::Port;

impl<P: Port> Shell<P> {
    /// Compares the peers that the mapping needs with the peers that are present, and logs the
    /// changes.
    pub(super) fn look_for_peers(&mut self) {
        let now = now().monotonic;
        let mut missing = AwaitedPeers::default();
        self.port.add_awaited(&mut missing);
        // While the network is lost, the other spaces cannot be received, and its loss is reported
        // instead.
        if self.carrier.lost().is_none() {
            let interface = self.carrier.interface();
            add_spaces(&self.router, self.own, (&interface, now), &mut missing);
        }
        let PeerChanges { missing, arrived } = self.awaited.update(missing, now);
        if let Some(arrived) = arrived {
            info!("no longer waiting for: {arrived}");
        }
        if let Some(missing) = missing {
            warn!("waiting for: {missing}");
        }
    }
}

/// Adds the spaces that the program needs values or calls of and receives nothing from, and the
/// calls that no program offers.
fn add_spaces(
    router: &Router,
    own: SpaceId,
    (interface, now): (&str, Instant),
    missing: &mut AwaitedPeers,
) {
    let mapping = router.mapping();
    if !mapping.spaces().is_empty() && own != SpaceId::UA && mapping.space(own).is_none() {
        missing.add(format!("the mapping of space {own}"), || {
            let declared: Vec<String> = mapping.spaces().iter().map(|of| of.id.to_string()).collect();
            format!(
                "the mapping declares only {}, so only topics named ua_... are bridged; add `- {{id: \
                 {own}}}` to its `spaces`",
                declared.join(", ")
            )
        });
    }
    let spaces = needed_spaces(mapping, own);
    if spaces.is_empty() {
        return;
    }
    let timeout = mapping.pubsub().receive_timeout;
    let received = received_spaces(router, timeout, now);
    for space in &spaces {
        let reason = match received.get(space) {
            Some(Presence::Online) => continue,
            Some(Presence::Silent) => {
                format!(
                    "nothing received on {interface} for {} s",
                    timeout.as_secs_f64()
                )
            }
            None => format!("nothing received on {interface}"),
        };
        let reason = || {
            if *space == SpaceId::UA {
                format!(
                    "{reason}: check that ua-server or the component runs and uses this network and \
                     group"
                )
            } else {
                format!(
                    "{reason}: check that the bridge of the space runs and uses this network and \
                     group"
                )
            }
        };
        missing.add(format!("space {space}"), reason);
    }
    for call in mapping.calls() {
        let space = call.topic.space;
        let is_asked = if own == SpaceId::UA {
            !matches!(
                call.executed,
                ExecutedBy::OpcUa(_) | ExecutedBy::Acknowledging
            )
        } else {
            call.asked.iter().any(|binding| binding.space == own)
        };
        let is_online = matches!(received.get(&space), Some(Presence::Online));
        if space != own && is_asked && is_online && router.described_call(call.topic).is_none() {
            let name = format!("call {} ({})", call.name, call.topic);
            missing.add(name, || format!("no program of space {space} offers it"));
        }
    }
}

/// Returns the spaces from which the program needs values or calls, by the mapping.
fn needed_spaces(mapping: &Mapping, own: SpaceId) -> BTreeSet<SpaceId> {
    let values = mapping.variables().iter().filter(|variable| {
        let is_shown = own == SpaceId::UA;
        let is_called = || {
            let service = variable.service.as_ref();
            service.is_some_and(|service| service.space == own)
        };
        is_shown || variable.binding(own).is_some() || is_called()
    });
    let values = values.map(|variable| variable.topic.space);
    let calls = mapping.asked_in(own).map(|(call, _)| call.topic.space);
    values.chain(calls).filter(|space| *space != own).collect()
}

/// Whether anything is received from a space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Presence {
    Online,
    /// Its values were received and are overdue.
    Silent,
}

/// Returns the spaces from which anything was received. A program without values is known by the
/// description of its application or by its calls.
fn received_spaces(
    router: &Router,
    timeout: Duration,
    now: Instant,
) -> BTreeMap<SpaceId, Presence> {
    let mut spaces: BTreeMap<SpaceId, Presence> = BTreeMap::new();
    for (topic, at) in router.heard() {
        let of = spaces.entry(topic.space).or_insert(Presence::Silent);
        if now.saturating_duration_since(at) <= timeout {
            *of = Presence::Online;
        }
    }
    let applications = router.applications().map(|(space, ..)| space);
    let calls = router.calls().map(|(topic, _)| topic);
    let calls = calls.filter(|topic| router.described_call(*topic).is_some());
    for space in applications.chain(calls.map(|topic| topic.space)) {
        spaces.entry(space).or_insert(Presence::Online);
    }
    spaces
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;
    use std::sync::Arc;

    use bridge_core::{Local, RouterSettings};
    use uadp::{
        DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar,
    };

    use super::*;

    const CELL: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:x}
variables:
  - {node: ns=5;i=10, name: A, origin: 2, ros: [{topic: /a, type: std_msgs/Bool}, {space: 1, topic: /a, type: std_msgs/Bool}]}
  - {node: ns=5;i=11, name: B, origin: 1, ros: {topic: /b, type: std_msgs/Bool}}
calls:
  - {node: ns=5;i=60, name: Grip, origin: 2, ros: [{service: /g, type: std_srvs/Trigger}, {space: 1, service: /g, type: std_srvs/Trigger}]}
";

    fn router(own: SpaceId) -> Router {
        let checked = Mapping::from_yaml(CELL, "cell.yaml");
        let mapping = checked.mapping.unwrap();
        let settings = RouterSettings {
            own,
            local: Local::Fields,
            source: None,
        };
        Router::new(settings, Arc::new(mapping))
    }

    /// Returns a message with a value of `ua_2_5_10`.
    fn value() -> Vec<u8> {
        let network = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(2)),
            group: Some(GroupHeader {
                writer_group_id: Some(5),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        };
        let mut datagram = Vec::new();
        let mut message = NetworkMessageEncoder::new(&mut datagram, &network, Some(&[10])).unwrap();
        let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
        frame.scalar(Scalar::Boolean(true)).unwrap();
        frame.finish().unwrap();
        message.finish().unwrap();
        datagram
    }

    fn missing(router: &Router, own: SpaceId, at: Instant) -> Vec<String> {
        let mut missing = AwaitedPeers::default();
        add_spaces(router, own, ("eth0", at), &mut missing);
        let all = missing.iter();
        all.map(|(peer, reason)| {
            format!("{peer}: {}", reason.split(':').next().unwrap_or_default())
        })
        .collect()
    }

    #[test]
    fn a_space_is_awaited_until_anything_of_it_is_received_and_when_it_falls_silent() {
        for own in [SpaceId::ROS1, SpaceId::UA] {
            let mut router = router(own);
            let now = now();
            let expected = if own == SpaceId::UA {
                vec![
                    "space 1: nothing received on eth0",
                    "space 2: nothing received on eth0",
                ]
            } else {
                vec!["space 2: nothing received on eth0"]
            };
            assert_eq!(missing(&router, own, now.monotonic), expected);
            let from = SocketAddr::from(([127, 0, 0, 1], 50_001));
            router.handle_datagram(&value(), from, now);
            let offered = "call Grip (ua_2_5_60): no program of space 2 offers it";
            assert!(missing(&router, own, now.monotonic).contains(&offered.to_owned()));
            let later = now.monotonic + Duration::from_secs(4);
            let silent = "space 2: nothing received on eth0 for 3 s".to_owned();
            assert!(missing(&router, own, later).contains(&silent));
        }
    }

    #[test]
    fn a_space_that_no_value_is_needed_of_is_not_awaited() {
        let space2 = SpaceId::new(2).unwrap();
        let router = router(space2);
        assert_eq!(missing(&router, space2, now().monotonic), [""; 0]);
        let space3 = SpaceId::new(3).unwrap();
        let undeclared = "the mapping of space 3: the mapping declares only 1, 2, so only topics named ua_... are bridged; add `- {id";
        assert_eq!(missing(&router, space3, now().monotonic), [undeclared]);
    }
}
