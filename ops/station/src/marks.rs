//! Searches a node in the address space of a discovery server.

use std::time::Duration;

use async_trait::async_trait;
use discovery::Marks;
use plant_opcua::client::{ClientConfig, OpcUaClient};
use plant_opcua::types::{AttributeId, NodeId};

/// Searches with a client session.
pub(crate) struct SearchSession(pub(crate) ClientConfig);

#[async_trait]
impl Marks for SearchSession {
    async fn has(&self, url: &str, node: &str) -> bool {
        let client = OpcUaClient::open(self.0.clone(), url);
        let has = match client.up(LIMIT).await {
            Ok(()) => has(&client, node).await,
            Err(_) => false,
        };
        client.close().await;
        has
    }
}

async fn has(client: &OpcUaClient, text: &str) -> bool {
    let Some(node) = node(client, text) else {
        return false;
    };
    let read = client
        .read_attributes(&[(node, AttributeId::NodeClass)])
        .await;
    let value = read.ok().and_then(|values| values.into_iter().next());
    value.is_some_and(|value| value.status().is_good() && value.value.is_some())
}

/// Parses a NodeId, with the URI or the index of its namespace.
fn node(client: &OpcUaClient, text: &str) -> Option<NodeId> {
    let Some(rest) = text.strip_prefix("nsu=") else {
        return text.parse().ok();
    };
    let (uri, identifier) = rest.split_once(';')?;
    let index = client.namespace(uri)?;
    format!("ns={index};{identifier}").parse().ok()
}

const LIMIT: Duration = Duration::from_secs(2);
