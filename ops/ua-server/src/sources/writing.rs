//! Writes the waiting values of a server.

use std::sync::Arc;

use opcua::types::{NodeId, StatusCode, Variant};
use plant_opcua::client::{ClientError, Link, OpcUaClient};
use plant_opcua::limits::MOST_PER_REQUEST;
use tokio::sync::watch;

use super::outbox::{ServerOutbox, WaitingValue};
use super::{Plan, Write, one_value};
use crate::executing::local_node;

/// Writes for as long as the server is in use.
pub(super) async fn run(
    client: OpcUaClient,
    mut plan: watch::Receiver<Arc<Plan>>,
    outbox: Arc<ServerOutbox>,
) {
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

/// Writes all waiting values that the server accepts.
async fn write(client: &OpcUaClient, outbox: &ServerOutbox) {
    loop {
        let batch = outbox.take(MOST_PER_REQUEST);
        if batch.is_empty() {
            return;
        }
        let mut writes: Vec<(Arc<Write>, WaitingValue)> = Vec::new();
        let mut values: Vec<(NodeId, Variant)> = Vec::new();
        for (write, waits) in batch {
            let node = local_node(client, &write.target.node);
            match (node, one_value(&waits.block)) {
                (Ok(node), Some(value)) => {
                    writes.push((write, waits));
                    values.push((node, value));
                }
                (Err(error), _) => {
                    let why = error.to_string();
                    outbox.refused(&write, waits, (StatusCode::BadNodeIdUnknown, &why));
                }
                (Ok(_), None) => {
                    let why = "it is none, or more than one value";
                    outbox.refused(&write, waits, (StatusCode::BadTypeMismatch, why));
                }
            }
        }
        if values.is_empty() {
            continue;
        }
        let mut is_lost = false;
        let written = client.write_each(&values).await;
        for ((write, value), result) in writes.into_iter().zip(written) {
            match result {
                Ok(status) | Err(ClientError::Status(status)) if status.is_bad() => {
                    outbox.refused(&write, value, (status, &refusal(&write, status)));
                }
                Ok(status) | Err(ClientError::Status(status)) => {
                    outbox.written(&write, value, status);
                }
                // A state is written again over the next connection.
                Err(
                    ClientError::NotConnected(_) | ClientError::Lost(_) | ClientError::Answer(_),
                ) => {
                    outbox.untold(&write, value);
                    is_lost = true;
                }
            }
        }
        if is_lost {
            return;
        }
    }
}

fn refusal(write: &Write, status: StatusCode) -> String {
    format!("the server answers {status} for {}", write.target.node)
}
