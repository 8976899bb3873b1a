//! The state of a server as it is reported.

use std::collections::BTreeMap;

use bridge_node::LinkState;
use mappings::Access;
use opcua::sync::Mutex;
use plant_opcua::client::Link;
use tracing::{info, warn};

use super::Plan;

/// The state of a server, shared by its two tasks.
pub(super) struct ServerState {
    told: Mutex<LinkState>,
}

/// The direction of a node's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Way {
    From,
    To,
}

impl Way {
    const fn word(self) -> &'static str {
        match self {
            Self::From => "from",
            Self::To => "to",
        }
    }
}

impl ServerState {
    pub(super) fn new(name: &str, access: &Access) -> Self {
        Self {
            told: Mutex::new(LinkState {
                name: name.to_owned(),
                url: access.endpoint.to_string(),
                ..LinkState::default()
            }),
        }
    }

    pub(super) fn told(&self) -> LinkState {
        self.told.lock().clone()
    }

    /// Records the state of the connection. Each change is logged once.
    pub(super) fn link(&self, link: &Link, certificates_refused: u64) {
        let mut told = self.told.lock();
        told.certificates_refused = certificates_refused;
        match link {
            Link::Up {
                connects, secured, ..
            } => {
                if !told.up || told.connects != *connects {
                    info!(
                        server = told.name,
                        url = told.url,
                        secured,
                        "connected to the server"
                    );
                }
                told.up = true;
                told.secured = *secured;
                told.connects = *connects;
                told.why = None;
            }
            Link::Down { reason, .. } => {
                if told.up || told.why.is_none() {
                    warn!(
                        server = told.name,
                        url = told.url,
                        "disconnected from the server, so its values are bad: {reason}"
                    );
                }
                told.up = false;
                told.secured = false;
                told.why = Some(reason.clone());
            }
            Link::Connecting | Link::Closed => {}
        }
    }

    pub(super) fn came(&self) {
        self.told.lock().values += 1;
    }

    pub(super) fn written(&self, many: u64) {
        self.told.lock().written += many;
    }

    pub(super) fn not_written(&self, many: u64) {
        self.told.lock().not_written += many;
    }

    /// Records a fault of a variable. Each reason is logged once.
    pub(super) fn fault(&self, variable: &str, way: Way, why: &str) {
        let mut told = self.told.lock();
        let before = told.faults.insert(key(variable, way), why.to_owned());
        if before.as_deref() != Some(why) {
            warn!(
                server = told.name,
                variable,
                "cannot transfer the value {} its node at the server: {why}",
                way.word()
            );
        }
    }

    pub(super) fn sound(&self, variable: &str, way: Way) {
        let mut told = self.told.lock();
        if !told.faults.is_empty() && told.faults.remove(&key(variable, way)).is_some() {
            info!(
                server = told.name,
                variable,
                "transfers the value {} its node at the server again",
                way.word()
            );
        }
    }

    /// Removes the faults of variables that are not wanted any more.
    pub(super) fn keep(&self, plan: &Plan) {
        let mut told = self.told.lock();
        if told.faults.is_empty() {
            return;
        }
        let reads = plan.reads.iter().map(|read| key(&read.name, Way::From));
        let writes = plan.writes.iter().map(|write| key(&write.name, Way::To));
        let mut kept = BTreeMap::new();
        for key in reads.chain(writes) {
            if let Some(why) = told.faults.remove(&key) {
                kept.insert(key, why);
            }
        }
        told.faults = kept;
    }
}

fn key(variable: &str, way: Way) -> String {
    format!("{variable} ({})", way.word())
}
