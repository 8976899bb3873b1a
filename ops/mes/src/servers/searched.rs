//! The server that is searched, and the faults of a search.

use async_trait::async_trait;
use plant_opcua::client::{Browse, BrowsedReferences, ClientError, OpcUaClient};
use plant_opcua::types::{AttributeId, DataValue, NodeId, VariableId, Variant};

/// A server, as the search uses it.
#[async_trait]
pub(super) trait BrowsableServer: Send + Sync {
    /// Returns the references of each node, at most `most` altogether.
    async fn references(
        &self,
        nodes: &[NodeId],
        what: &Browse,
        most: usize,
    ) -> Result<Vec<BrowsedReferences>, ClientError>;

    /// Returns the attributes, one value for each.
    async fn attributes(
        &self,
        what: &[(NodeId, AttributeId)],
    ) -> Result<Vec<DataValue>, ClientError>;
}

#[async_trait]
impl BrowsableServer for OpcUaClient {
    async fn references(
        &self,
        nodes: &[NodeId],
        what: &Browse,
        most: usize,
    ) -> Result<Vec<BrowsedReferences>, ClientError> {
        self.browse_within(nodes, what, (most, PAGE)).await
    }

    async fn attributes(
        &self,
        what: &[(NodeId, AttributeId)],
    ) -> Result<Vec<DataValue>, ClientError> {
        self.read_attributes(what).await
    }
}

/// Reads the NamespaceArray, which may change while a server runs.
pub(super) async fn namespaces(server: &dyn BrowsableServer) -> Result<Vec<String>, ClientError> {
    let id: NodeId = VariableId::Server_NamespaceArray.into();
    let read = server.attributes(&[(id, AttributeId::Value)]).await?;
    let value = read.into_iter().next().and_then(|value| value.value);
    let Some(Variant::Array(array)) = value else {
        return Err(ClientError::Answer("no NamespaceArray"));
    };
    let uris = array.values.into_iter().map(|uri| {
        if let Variant::String(uri) = uri {
            uri.as_ref().to_owned()
        } else {
            String::new()
        }
    });
    Ok(uris.collect())
}

/// The counts of all that is not in the graph.
#[derive(Debug, Default)]
pub(super) struct SearchFaults {
    /// Reasons for which the search ended early.
    pub(super) ends: Vec<String>,
    pub(super) missing: Vec<String>,
    pub(super) names: usize,
    pub(super) bad: usize,
    pub(super) large: usize,
    pub(super) undecoded: usize,
}

impl SearchFaults {
    /// Returns the faults as texts for people.
    pub(super) fn findings(self) -> Vec<String> {
        let ends = self.ends.into_iter();
        let mut all: Vec<String> = ends
            .map(|why| format!("the graph is incomplete: {why}"))
            .collect();
        let missing = self.missing.into_iter();
        all.extend(
            missing.map(|id| format!("the server has no start node `{id}`; correct `start`")),
        );
        for (count, what) in [
            (
                self.names,
                "references are left out: the server does not list their namespaces, or their NodeIds are too long",
            ),
            (self.bad, "nodes cannot be browsed"),
            (self.large, "values are left out because they are too large"),
            (
                self.undecoded,
                "values are left out: they are structures that cannot be decoded",
            ),
        ] {
            if count > 0 {
                all.push(format!("{count} {what}"));
            }
        }
        all
    }
}

/// Maximum number of references of a node in a response.
const PAGE: u32 = 1000;
