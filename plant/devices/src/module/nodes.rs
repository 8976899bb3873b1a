//! The nodes of a module over OPC UA.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use mtp::{NodeIdentifier, OpcUaNode};
use plant_opcua::client::{ClientConfig, OpcUaClient};
use plant_opcua::types::{NodeId, Variant};
use skills::{ClientOptions, SkillValue, ValueShape, from_variant, to_variant};

use super::error::ModuleNodeError;
use super::handshake::ModuleNodes;

/// Clients of the servers of a module. Each is opened at the first connection, and reconnects by
/// itself.
pub(super) struct UaNodes {
    /// The endpoint in place of the endpoints of the manifest.
    endpoint: Option<String>,
    options: Mutex<ClientOptions>,
    clients: Mutex<HashMap<String, OpcUaClient>>,
}

impl UaNodes {
    pub(super) fn new(endpoint: Option<String>) -> Self {
        Self {
            endpoint,
            options: Mutex::default(),
            clients: Mutex::default(),
        }
    }

    fn client(&self, node: &OpcUaNode) -> OpcUaClient {
        let endpoint = self.endpoint.as_ref().unwrap_or(&node.endpoint);
        let mut clients = self.clients.lock().unwrap_or_else(PoisonError::into_inner);
        let open = || {
            let options = self.options.lock().unwrap_or_else(PoisonError::into_inner);
            let config = ClientConfig {
                pki: options.pki.clone(),
                user: options.user.clone(),
                security: options.security,
                timeout: options.within,
                ..ClientConfig::new(&options.application_uri, &options.application_name)
            };
            OpcUaClient::open(config, endpoint)
        };
        clients.entry(endpoint.clone()).or_insert_with(open).clone()
    }
}

#[async_trait]
impl ModuleNodes for UaNodes {
    fn identify(&self, options: &ClientOptions) {
        let mut known = self.options.lock().unwrap_or_else(PoisonError::into_inner);
        known.clone_from(options);
    }

    async fn connect(&self, node: &OpcUaNode, within: Duration) -> Result<(), ModuleNodeError> {
        let endpoint = self.endpoint.as_ref().unwrap_or(&node.endpoint);
        let connected = self.client(node).up(within).await;
        connected.map_err(|error| ModuleNodeError::Unreachable {
            endpoint: endpoint.clone(),
            error,
        })
    }

    async fn read(&self, nodes: &[&OpcUaNode]) -> Result<Vec<Option<SkillValue>>, ModuleNodeError> {
        let Some(first) = nodes.first() else {
            return Ok(Vec::new());
        };
        let client = self.client(first);
        let ids: Vec<NodeId> = nodes
            .iter()
            .map(|node| node_id(&client, node))
            .collect::<Result<_, _>>()?;
        let values = client.read(&ids).await?;
        let good = values.into_iter().map(|value| {
            let is_good = value.status.is_none_or(|status| status.is_good());
            value.value.filter(|_| is_good)
        });
        Ok(good.map(|value| from_variant(&value?)).collect())
    }

    async fn write(&self, node: &OpcUaNode, value: SkillValue) -> Result<(), ModuleNodeError> {
        let client = self.client(node);
        let id = node_id(&client, node)?;
        let [known] = self.read(&[node]).await?.try_into().unwrap_or([None]);
        let variant = match known {
            Some(known) => in_type_of(&known, &value)?,
            // A node without a value has no type here; the server checks the type.
            None => to_variant(&value),
        };
        let statuses = client.write(&[(id, variant)]).await?;
        match statuses.first() {
            Some(status) if status.is_good() => Ok(()),
            Some(status) => Err(ModuleNodeError::Refused(*status)),
            None => Err(ModuleNodeError::NoResult),
        }
    }
}

/// Returns the NodeId of a node in the namespaces of a server.
fn node_id(client: &OpcUaClient, node: &OpcUaNode) -> Result<NodeId, ModuleNodeError> {
    let index = match node.namespace.parse() {
        // Some manifests have an index in place of a URI.
        Ok(index) => Some(index),
        Err(_) => client.namespace(&node.namespace),
    };
    let index: u16 = index.ok_or_else(|| ModuleNodeError::NoNamespace {
        namespace: node.namespace.clone(),
    })?;
    Ok(match &node.identifier {
        NodeIdentifier::Numeric(number) => NodeId::new(index, *number),
        NodeIdentifier::Text(text) => NodeId::new(index, text.as_str()),
    })
}

/// Converts a value to the type of the present value of a node.
fn in_type_of(known: &SkillValue, value: &SkillValue) -> Result<Variant, ModuleNodeError> {
    let shape: ValueShape = known.shape();
    let is_same = value.shape() == shape;
    let converted = match (known, value.as_f64()) {
        _ if is_same => Some(value.clone()),
        #[expect(
            clippy::cast_possible_truncation,
            reason = "the module has fewer digits"
        )]
        (SkillValue::Float(_), Some(number)) => Some(SkillValue::Float(number as f32)),
        (SkillValue::Boolean(_) | SkillValue::String(_), _) => None,
        _ => shape.read_json(&value.to_json()).ok(),
    };
    let converted = converted.ok_or_else(|| ModuleNodeError::WrongType {
        value: value.clone(),
        shape,
    })?;
    Ok(to_variant(&converted))
}
