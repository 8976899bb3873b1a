//! The domain of the ROS 2 nodes of the demo.

use std::net::{IpAddr, Ipv4Addr};

use anyhow::{Context as _, anyhow};
use ros2_client::{Context, Node, NodeName, NodeOptions};
use rustdds::DomainParticipantBuilder;

use crate::line::DOMAIN;

/// Joins the domain with a node of this name, on the loopback interface only.
///
/// # Errors
/// The domain cannot be joined, or the node cannot be made.
pub(crate) fn join(node: &str) -> anyhow::Result<Node> {
    let participant = DomainParticipantBuilder::new(DOMAIN)
        .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
        .same_host_loopback(true)
        .build()
        .with_context(|| format!("cannot join DDS domain {DOMAIN}"))?;
    let context = Context::from_domain_participant(participant)
        .map_err(|error| anyhow!("cannot make a ROS 2 context: {error}"))?;
    let name = NodeName::new("/", node).map_err(|error| anyhow!("{error:?}"))?;
    let options = NodeOptions::new()
        .start_parameter_services(false)
        .enable_rosout(false);
    context
        .new_node(name, options)
        .map_err(|error| anyhow!("cannot make a ROS 2 node: {error}"))
}
