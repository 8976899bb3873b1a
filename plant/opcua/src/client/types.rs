//! The type hierarchy of a server.

use std::collections::HashSet;

use opcua::types::{NodeId, ReferenceTypeId};

use super::services::Browse;
use super::{ClientError, OpcUaClient};

impl OpcUaClient {
    /// Returns the supertype of a type. The result is cached for the connection.
    async fn supertype(&self, type_id: &NodeId) -> Result<Option<NodeId>, ClientError> {
        let connected = self.shared.connected()?;
        if let Some(known) = connected.supertypes.lock().get(type_id) {
            return Ok(known.clone());
        }
        let up = Browse {
            subtypes: false,
            ..Browse::of(ReferenceTypeId::HasSubtype).inverse()
        };
        let above = self.browse(type_id, up).await?;
        let above = above.into_iter().map(|one| one.node_id.node_id).next();
        let mut known = connected.supertypes.lock();
        if known.len() < MOST_TYPES {
            known.insert(type_id.clone(), above.clone());
        }
        Ok(above)
    }

    /// Returns the supertypes of a type, nearest first.
    ///
    /// # Errors
    /// Returns an error if the request has no response or the type does not exist.
    pub async fn supertypes(&self, type_id: &NodeId) -> Result<Vec<NodeId>, ClientError> {
        let mut found = Vec::new();
        let mut at = type_id.clone();
        while let Some(next) = self.supertype(&at).await? {
            // The type hierarchy of a faulty server may be cyclic.
            if found.contains(&next) || next == *type_id {
                break;
            }
            found.push(next.clone());
            at = next;
        }
        Ok(found)
    }

    /// Returns whether a type is `base` or a subtype of `base`.
    ///
    /// # Errors
    /// Returns an error if the request has no response or the type does not exist.
    pub async fn is_subtype_of(
        &self,
        type_id: &NodeId,
        base: &NodeId,
    ) -> Result<bool, ClientError> {
        Ok(type_id == base || self.supertypes(type_id).await?.contains(base))
    }

    /// Returns a type and its subtypes of all levels, at most [`MOST_TYPES`].
    ///
    /// # Errors
    /// Returns an error if the request has no response or the type does not exist.
    pub async fn subtypes(&self, base: &NodeId) -> Result<Vec<NodeId>, ClientError> {
        let mut found = vec![base.clone()];
        let mut seen: HashSet<NodeId> = HashSet::from([base.clone()]);
        let mut at = 0;
        while let Some(next) = found.get(at).cloned() {
            at += 1;
            let down = Browse {
                subtypes: false,
                ..Browse::of(ReferenceTypeId::HasSubtype)
            };
            for one in self.browse(&next, down).await? {
                let id = one.node_id.node_id;
                if found.len() < MOST_TYPES && seen.insert(id.clone()) {
                    found.push(id);
                }
            }
        }
        Ok(found)
    }
}

/// Maximum number of types of a server that are returned or cached.
pub const MOST_TYPES: usize = 10_000;
