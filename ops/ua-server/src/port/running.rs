//! The running OPC UA server, with its users, certificates and announcements.

use std::sync::Arc;
use std::time::Duration;

use bridge_node::{Failure, RedundancyRank, Router};
use discovery::ServerAnnouncement;
use mappings::{Mapping, Server};
use opcua::server::{ServerHandle, SubscriptionCache};
use opcua::types::{AttributeId, DataValue, NodeId, VariableId};
use plant_opcua::configuration::Configuration;
use plant_opcua::own;
use plant_opcua::pki::Pki;
use plant_opcua::users::UserAccess;
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;
use tokio::time::{Interval, MissedTickBehavior};
use tracing::warn;

use crate::access;
use crate::layout::Layout;
use crate::nodesets;
use crate::redundant::{ServerCondition, ServerRole, ServerSet};
use crate::sks::Sks;

/// The running server.
pub(super) struct RunningServer {
    handle: ServerHandle,
    /// The server's own threads, because signing for a client takes longer than a value should
    /// wait. Taken at shutdown.
    runtime: Option<Runtime>,
    serving: Option<JoinHandle<Result<(), String>>>,
    described: DescribedServer,
    rights: Rights,
    rank: Option<RedundancyRank>,
    role: ServerRole,
    set: ServerSet,
    /// The interval of checking refused certificates and the users.
    look: Interval,
    /// Announces the server. Taken at shutdown.
    told: Option<ServerAnnouncement>,
}

/// The server as the mapping describes it at the start.
pub(super) struct DescribedServer {
    pub(super) server: Server,
    /// True if the endpoint comes from the mapping, false if it comes from the command line.
    pub(super) mapped_url: bool,
    pub(super) nodesets: nodesets::RunningNodeSets,
}

/// The certificates and keys of the server, and the rights of its users.
pub(super) struct Rights {
    pub(super) pki: Pki,
    pub(super) sks: Arc<Sks>,
    pub(super) access: Arc<UserAccess>,
    /// The certificates of the server, which clients can manage.
    pub(super) certificates: Arc<Configuration>,
}

impl RunningServer {
    pub(super) fn new(
        handle: ServerHandle,
        (runtime, serving): (Runtime, JoinHandle<Result<(), String>>),
        (described, rights): (DescribedServer, Rights),
        (rank, role, set): (Option<RedundancyRank>, ServerRole, ServerSet),
        told: Option<ServerAnnouncement>,
    ) -> Self {
        let mut look = tokio::time::interval(LOOK_AT_REJECTED);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Self {
            handle,
            runtime: Some(runtime),
            serving: Some(serving),
            described,
            rights,
            rank,
            role,
            set,
            look,
            told,
        }
    }

    /// Returns the subscriptions of the clients.
    pub(super) fn subscriptions(&self) -> Arc<SubscriptionCache> {
        Arc::clone(self.handle.subscriptions())
    }

    /// Returns the ApplicationUri.
    pub(super) fn uri(&self) -> &str {
        &self.described.server.application_uri
    }

    /// Returns the users and their rights.
    pub(super) const fn access(&self) -> &Arc<UserAccess> {
        &self.rights.access
    }

    /// Returns the rank among redundant servers.
    pub(super) const fn rank(&self) -> Option<RedundancyRank> {
        self.rank
    }

    /// Returns whether another server sends the values that clients write.
    pub(super) fn is_standby(&self) -> bool {
        self.role.is_standby()
    }

    /// Sets the role among redundant servers.
    pub(super) fn set_active(&self, is_active: bool) {
        self.role.set_active(is_active);
    }

    /// Sets the ServiceLevel, for servers with redundancy.
    pub(super) fn show_service_level(&self, (topics, silent): (usize, usize)) {
        if self.rank.is_none() {
            return;
        }
        let condition = ServerCondition {
            is_standby: self.role.is_standby(),
            topics,
            silent,
        };
        let level = condition.service_level();
        self.handle.set_service_level(level);
        self.set.set_own(level);
    }

    /// Returns the ServiceLevel, for servers with redundancy.
    pub(super) fn service_level(&self) -> Option<u8> {
        self.set.own()
    }

    /// Shows the other servers of the redundant set.
    pub(super) fn show_set(&self, router: &Router) {
        let Some(redundancy) = router.redundancy() else {
            return;
        };
        self.set.follow(redundancy, bridge_node::now().monotonic);
        let Some(value) = self.set.take_change() else {
            return;
        };
        let node: NodeId = VariableId::Server_ServerRedundancy_RedundantServerArray.into();
        let change = (DataValue::new_now(value), &node, AttributeId::Value);
        let subscriptions = self.handle.subscriptions();
        subscriptions.notify_data_change(std::iter::once(change));
    }

    /// Waits for the end of the server, and returns its reason. Meanwhile, the refused certificates
    /// and the users are checked, and the program is restarted with a new certificate. Cancel-safe.
    pub(super) async fn ended(&mut self) -> String {
        loop {
            tokio::select! {
                reason = ended(&mut self.serving) => return reason,
                () = self.rights.certificates.applied() => bridge_node::restart(),
                _ = self.look.tick() => {
                    self.rights.pki.report_rejected();
                    self.rights.access.look();
                }
            }
        }
    }

    /// Returns the keys of another mapping that take effect at the next start.
    pub(super) fn differs(&self, mapping: &Mapping) -> Vec<String> {
        let (was, is) = (&self.described.server, mapping.server());
        let endpoint = self.described.mapped_url && was.endpoint != is.endpoint;
        [
            ("server.endpoint", endpoint),
            (
                "server.application_uri",
                was.application_uri != is.application_uri,
            ),
            ("server.redundant", was.redundant != is.redundant),
            (
                "server.redundant_endpoints",
                was.redundant_endpoints != is.redundant_endpoints,
            ),
            ("server.security", was.security != is.security),
            ("server.limits", was.limits != is.limits),
            (
                "server.reverse_connect",
                was.reverse_connect != is.reverse_connect,
            ),
            ("server.history.file", was.history_file != is.history_file),
        ]
        .into_iter()
        .filter(|(_, differs)| *differs)
        .map(|(key, _)| key.to_owned())
        .chain(self.described.nodesets.differs(mapping))
        .collect()
    }

    /// Sets the rights of the users of another mapping.
    pub(super) fn set_rules(&self, mapping: &Mapping, layout: &Layout) {
        self.rights.access.set_rules(access::rules(mapping, layout));
    }

    /// Follows the secured groups of another mapping.
    ///
    /// # Errors
    /// The keys of a group cannot be created.
    pub(super) fn follow_groups(&self, mapping: &Arc<Mapping>) -> Result<(), Failure> {
        self.rights.sks.follow(mapping)
    }

    /// Returns the state of the certificate.
    pub(super) fn certificate(&self) -> Option<serde_json::Value> {
        own::status(self.rights.pki.root())
    }

    /// Withdraws the announcement, and closes the connections of the clients.
    pub(super) async fn shutdown(&mut self) {
        if let Some(told) = self.told.take() {
            // If the time is over, other applications detect the loss themselves.
            let _late = tokio::time::timeout(GOODBYE, told.leave()).await;
        }
        self.handle.cancel();
        if let Some(serving) = &mut self.serving
            && tokio::time::timeout(SHUTDOWN, serving).await.is_err()
        {
            warn!("dropped the connections that clients did not close in time");
        }
    }
}

impl Drop for RunningServer {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // A runtime must not be waited for inside another runtime.
            runtime.shutdown_background();
        }
    }
}

/// Waits until the server has ended by itself; ready once.
async fn ended(serving: &mut Option<JoinHandle<Result<(), String>>>) -> String {
    let Some(running) = serving else {
        return std::future::pending().await;
    };
    let result = running.await;
    *serving = None;
    match result {
        Ok(Ok(())) => "the OPC UA server has ended".to_owned(),
        Ok(Err(error)) => format!("the OPC UA server has ended: {error}"),
        Err(error) => format!("the OPC UA server has ended: {error}"),
    }
}

const LOOK_AT_REJECTED: Duration = Duration::from_secs(1);
/// Within the limit of 2 s for the shutdown of a port.
const SHUTDOWN: Duration = Duration::from_millis(1_500);
/// Part of [`SHUTDOWN`] for the mDNS goodbye.
const GOODBYE: Duration = Duration::from_millis(400);
