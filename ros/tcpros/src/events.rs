//! Log messages of this crate, with a function per event.
//!
//! DEBUG: something ended or was retried as expected. WARN: a peer or the set-up is wrong, and the
//! node continues.

use std::fmt::Display;
use std::net::IpAddr;
use std::time::Duration;

use log_limit::Throttle;
use tracing::{debug, info, warn};

use crate::clock;

pub(crate) fn master_awaited(uri: &str, error: &dyn Display) {
    warn!(
        ROS_MASTER_URI = uri,
        %error,
        "waiting for the ROS master: start roscore at this URI, or set ROS_MASTER_URI to the URI of the running master"
    );
}

pub(crate) fn master_found(uri: &str) {
    info!(ROS_MASTER_URI = uri, "registered with the ROS master");
}

pub(crate) fn master_restarted(uri: &str) {
    warn!(
        ROS_MASTER_URI = uri,
        "the ROS master has restarted or lost the registrations of this node: registering everything again"
    );
}

pub(crate) fn registration_refused(topic: &str, error: &dyn Display) {
    warn!(topic, %error, "the ROS master refused a registration: trying again");
}

pub(crate) fn unregistration_failed(topic: &str, error: &dyn Display) {
    warn!(topic, %error, "cannot unregister: remove the registration from the ROS master with `rosnode cleanup`");
}

pub(crate) fn parameter_failed(parameter: &str, error: &dyn Display) {
    warn!(parameter, %error, "cannot read or set a parameter at the ROS master: trying again");
}

pub(crate) fn time_source_changed(simulated: bool) {
    if simulated {
        info!("/use_sim_time is true: using the time of /clock");
    } else {
        info!("/use_sim_time is not true: using the system clock");
    }
}

pub(crate) fn shutdown_incomplete(limit: Duration) {
    warn!(
        ?limit,
        "cannot unregister everything in time: remove the remaining registrations from the ROS master with `rosnode cleanup`"
    );
}

pub(crate) fn hostname_unresolvable(hostname: &str, error: &dyn Display) {
    warn!(
        hostname,
        %error,
        "this node announces a host name that does not resolve on this host: other nodes may not reach it; \
         set ROS_IP or ROS_HOSTNAME"
    );
}

pub(crate) fn shutdown_asked(reason: &str) {
    warn!(reason, "shutting down on request, as by `rosnode kill`");
}

/// `suppressed`: the number of suppressed entries since the last entry.
pub(crate) fn name_kept(name: &str, suppressed: u64) {
    warn!(
        name,
        suppressed,
        "another node has registered with the name of this node: this node continues; give the other node another name"
    );
}

/// `missing`: the number of lost registrations; `first` is an example.
pub(crate) fn registrations_lost(uri: &str, first: &str, missing: usize) {
    warn!(
        ROS_MASTER_URI = uri,
        first,
        missing,
        "the ROS master has lost registrations of this node, as after `rosnode cleanup`: registering them again"
    );
}

pub(crate) fn subscriber_joined(topic: &str, subscriber: &str, nodelay: bool) {
    debug!(topic, subscriber, nodelay, "a subscriber connected");
}

pub(crate) fn subscriber_left(topic: &str, subscriber: &str, dropped: u64, why: &dyn Display) {
    if dropped > 0 {
        warn!(topic, subscriber, dropped, %why, "a subscriber that lost messages because it was too slow disconnected");
    } else {
        debug!(topic, subscriber, %why, "a subscriber disconnected");
    }
}

pub(crate) fn message_too_long(topic: &str, bytes: usize) {
    tracing::error!(
        topic,
        bytes,
        "cannot publish a message: it exceeds the length limit of TCPROS (4 GiB)"
    );
}

/// `suppressed`: the number of suppressed entries since the last entry.
pub(crate) fn service_failed(service: &str, client: &str, why: &dyn Display, suppressed: u64) {
    warn!(service, client, %why, suppressed, "a service request failed");
}

pub(crate) fn publisher_joined(topic: &str, publisher: &str) {
    debug!(topic, publisher, "connected to a publisher");
}

/// `suppressed`: the number of suppressed entries since the last entry.
pub(crate) fn link_failed(
    (topic, uri): (&str, &str),
    node: Option<&str>,
    error: &dyn Display,
    suppressed: u64,
) {
    let node = node.unwrap_or("(unknown)");
    warn!(
        topic,
        node,
        uri,
        %error,
        suppressed,
        "cannot connect to a registered publisher, trying again: if the node has died, remove it with \
         `rosnode cleanup`; if it runs, check that its host name resolves on this host"
    );
}

pub(crate) fn links_not_told(period: Duration) {
    warn!(
        ?period,
        "cannot connect to further registered publishers: the next such line has their number in `suppressed`"
    );
}

pub(crate) fn link_waits(topic: &str, suppressed: u64) {
    warn!(
        topic,
        suppressed,
        "cannot connect to a further publisher: the limit of connections is reached; raise the limit of open files (`LimitNOFILE=`, `ulimit -n`)"
    );
}

/// `named`: the number of publishers of the topic in the list from the master or another caller.
pub(crate) fn too_many_publishers(topic: &str, named: usize, limit: usize, suppressed: u64) {
    warn!(
        topic,
        named, limit, suppressed, "ignored publishers of a topic above the limit"
    );
}

pub(crate) fn link_retried(topic: &str, uri: &str, error: &dyn Display, wait: Duration) {
    debug!(topic, uri, %error, ?wait, "a connection to a publisher failed or ended");
}

/// Rate limits for logs of refused connections: an entry per kind in ten seconds.
pub(crate) struct Refusals {
    server: &'static str,
    accept: Throttle,
    crowd: Throttle,
    handshake: Throttle,
}

impl Refusals {
    pub(crate) const fn new(server: &'static str) -> Self {
        let every = Duration::from_secs(10);
        Self {
            server,
            accept: Throttle::new(every),
            crowd: Throttle::new(every),
            handshake: Throttle::new(every),
        }
    }

    /// Waits briefly, so that a lack of file descriptors does not cause a busy loop.
    pub(crate) async fn accept_failed(&mut self, error: &std::io::Error) {
        if let Some(suppressed) = self.accept.admit(clock::now()) {
            warn!(server = self.server, %error, suppressed, "cannot accept a connection");
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }

    pub(crate) fn too_many(&mut self, limit: usize) {
        if let Some(suppressed) = self.crowd.admit(clock::now()) {
            warn!(
                server = self.server,
                limit,
                suppressed,
                "refused a connection: the limit of connections, in total or of this address, is reached; it follows from the limit of open files (`LimitNOFILE=`, `ulimit -n`)"
            );
        }
    }

    /// Logs that a connection was closed in favour of another connection.
    pub(crate) fn gave_way(&mut self, address: IpAddr) {
        if let Some(suppressed) = self.crowd.admit(clock::now()) {
            warn!(
                server = self.server,
                %address,
                suppressed,
                "closed an idle connection: too many are open"
            );
        }
    }

    pub(crate) fn handshake_failed(&mut self, peer: &dyn Display, error: &dyn Display) {
        if let Some(suppressed) = self.handshake.admit(clock::now()) {
            warn!(server = self.server, %peer, %error, suppressed, "refused a peer");
        }
    }
}
