//! Which types are subtypes of which, as the server has them.

use std::collections::HashSet;

use opcua::types::{NodeId, ReferenceTypeId};

use super::services::Browse;
use super::{Client, ClientError};

impl Client {
    /// The supertype of a type, remembered as long as the connection holds.
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

    /// The supertypes of a type, nearest first.
    ///
    /// # Errors
    /// No answer, or the type is not there.
    pub async fn supertypes(&self, type_id: &NodeId) -> Result<Vec<NodeId>, ClientError> {
        let mut found = Vec::new();
        let mut at = type_id.clone();
        while let Some(next) = self.supertype(&at).await? {
            // A server may have a circle.
            if found.contains(&next) || next == *type_id {
                break;
            }
            found.push(next.clone());
            at = next;
        }
        Ok(found)
    }

    /// Whether a type is another one or a subtype of it.
    ///
    /// # Errors
    /// No answer, or the type is not there.
    pub async fn is_subtype_of(
        &self,
        type_id: &NodeId,
        base: &NodeId,
    ) -> Result<bool, ClientError> {
        Ok(type_id == base || self.supertypes(type_id).await?.contains(base))
    }

    /// A type and its subtypes of all levels, at most [`MOST_TYPES`].
    ///
    /// # Errors
    /// No answer, or the type is not there.
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

/// How many types of a server are looked at.
pub const MOST_TYPES: usize = 10_000;
