//! Empties what waits for one server.

use std::sync::Arc;

use mappings::ExpandedNodeIdText;
use opcua::types::{NodeId, StatusCode, Variant};
use plant_opcua::client::{Client, ClientError, Link};
use plant_opcua::limits::MOST_PER_REQUEST;
use tokio::sync::watch;

use super::outbox::Outbox;
use super::state::Way;
use super::{Plan, Write, one_value};
use crate::executing::local_node;

/// Writes for as long as the server is wanted.
pub(super) async fn run(client: Client, mut plan: watch::Receiver<Arc<Plan>>, outbox: Arc<Outbox>) {
    let mut link = client.link();
    outbox.plan(&plan.borrow_and_update().clone());
    let mut at = None;
    loop {
        let now = link.borrow_and_update().clone();
        match now {
            Link::Up { connects, .. } if at != Some(connects) => {
                at = Some(connects);
                outbox.up();
            }
            Link::Up { .. } => write(&client, &outbox).await,
            Link::Down { .. } if at.is_some() => {
                at = None;
                outbox.down();
            }
            Link::Down { .. } | Link::Connecting => {}
            Link::Closed => return,
        }
        tokio::select! {
            changed = link.changed() => if changed.is_err() { return },
            changed = plan.changed() => {
                if changed.is_err() {
                    return;
                }
                outbox.plan(&plan.borrow_and_update().clone());
            }
            () = outbox.filled.notified(), if at.is_some() => {}
        }
    }
}

/// Writes all that waits, as far as the server takes it.
async fn write(client: &Client, outbox: &Outbox) {
    loop {
        let batch = outbox.take(MOST_PER_REQUEST);
        if batch.is_empty() {
            return;
        }
        let mut writes: Vec<Arc<Write>> = Vec::new();
        let mut values: Vec<(NodeId, Variant)> = Vec::new();
        for (write, block) in batch {
            match (node(client, &write.target.node), one_value(&block)) {
                (Ok(node), Some(value)) => {
                    writes.push(write);
                    values.push((node, value));
                }
                (Err(why), _) => outbox.refused(&write, &why),
                (Ok(_), None) => outbox.refused(&write, "it is none, or more than one value"),
            }
        }
        if values.is_empty() {
            continue;
        }
        let told = client.write(&values).await;
        let statuses = match told {
            Ok(statuses) => statuses,
            Err(ClientError::Status(status)) => vec![status; writes.len()],
            // A state is told anew over the next connection.
            Err(ClientError::NotConnected(_) | ClientError::Lost(_) | ClientError::Answer(_)) => {
                writes.iter().for_each(|write| outbox.untold(write));
                return;
            }
        };
        for (write, status) in writes.iter().zip(statuses) {
            if status.is_bad() {
                outbox.refused(write, &refusal(write, status));
            } else {
                outbox.state.written(1);
                outbox.state.sound(&write.name, Way::To);
            }
        }
    }
}

fn node(client: &Client, text: &ExpandedNodeIdText) -> Result<NodeId, String> {
    local_node(client, text)
}

fn refusal(write: &Write, status: StatusCode) -> String {
    format!("the server answers {status} for {}", write.target.node)
}
