//! Reads the methods of a server, with the paths of their objects.

use std::collections::{BTreeSet, VecDeque};

use plant_opcua::client::{Browse, Client, ClientError};
use plant_opcua::server::arguments_in;
use plant_opcua::types::{
    Argument, DataTypeId, NodeClass, NodeClassMask, NodeId, ObjectId, ReferenceTypeId,
};
use tracing::debug;

use crate::configure::is_configure;

/// The methods of a server.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Mirror {
    /// Methods that can be forwarded.
    pub(crate) methods: Vec<Found>,
    /// Object and method of its `Configure`.
    pub(crate) configure: Option<(NodeId, NodeId)>,
    /// Number of methods that cannot be forwarded, because their arguments are valid only at that
    /// server.
    pub(crate) kept_back: usize,
}

/// A method of a server.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Found {
    /// The BrowseNames of the objects below Objects, followed by the BrowseName of the method.
    pub(crate) path: Vec<String>,
    pub(crate) object: NodeId,
    pub(crate) method: NodeId,
    pub(crate) takes: Vec<Argument>,
    pub(crate) gives: Vec<Argument>,
}

/// Reads the methods over the current connection.
///
/// # Errors
/// No response.
pub(crate) async fn look(client: &Client) -> Result<Mirror, ClientError> {
    let mut mirror = Mirror::default();
    let objects: NodeId = ObjectId::ObjectsFolder.into();
    let mut seen = BTreeSet::from([objects.to_string()]);
    let mut waiting = VecDeque::from([(objects, Vec::new())]);
    while let Some((object, path)) = waiting.pop_front() {
        let below = Browse {
            classes: NodeClassMask::OBJECT | NodeClassMask::METHOD,
            ..Browse::hierarchical()
        };
        for reference in client.browse(&object, below).await? {
            let id = reference.node_id.node_id;
            let elsewhere = reference.node_id.server_index != 0;
            // Nodes of namespace 0, such as the object Server, exist in every server and are
            // skipped.
            if id.namespace == 0 || elsewhere || path.len() >= DEEPEST {
                continue;
            }
            let mut path = path.clone();
            path.push(
                reference
                    .browse_name
                    .name
                    .as_ref()
                    .chars()
                    .take(LONGEST_NAME)
                    .collect(),
            );
            if reference.node_class == NodeClass::Method {
                if mirror.methods.len() < MOST_METHODS {
                    take(client, &mut mirror, (&object, id), path).await?;
                }
            } else if seen.len() < MOST_OBJECTS && seen.insert(id.to_string()) {
                waiting.push_back((id, path));
            }
        }
    }
    Ok(mirror)
}

async fn take(
    client: &Client,
    mirror: &mut Mirror,
    (object, method): (&NodeId, NodeId),
    path: Vec<String>,
) -> Result<(), ClientError> {
    let Some([takes, gives]) = signature(client, &method).await? else {
        mirror.kept_back += 1;
        debug!(?path, "cannot pass on a method");
        return Ok(());
    };
    let name = path.last().map(String::as_str).unwrap_or_default();
    if is_configure(name, &takes, &gives) {
        // Only the station configures the place, so the method is not shown.
        let known = mirror.configure.take();
        mirror.configure = known.or_else(|| Some((object.clone(), method)));
        return Ok(());
    }
    mirror.methods.push(Found {
        path,
        object: object.clone(),
        method,
        takes,
        gives,
    });
    Ok(())
}

/// Returns the input and output arguments of a method; `None` if it cannot be forwarded.
async fn signature(
    client: &Client,
    method: &NodeId,
) -> Result<Option<[Vec<Argument>; 2]>, ClientError> {
    let properties = Browse::of(ReferenceTypeId::HasProperty);
    let properties = client.browse(method, properties).await?;
    let mut both = [Vec::new(), Vec::new()];
    for (which, into) in ["InputArguments", "OutputArguments"].iter().zip(&mut both) {
        let named = |one: &&plant_opcua::types::ReferenceDescription| {
            one.browse_name.name.as_ref() == *which
        };
        let Some(property) = properties.iter().find(named) else {
            continue;
        };
        let read = client
            .read(std::slice::from_ref(&property.node_id.node_id))
            .await?;
        let Some(all) = arguments_in(read.into_iter().next()) else {
            return Ok(None);
        };
        if all.len() > MOST_ARGUMENTS {
            return Ok(None);
        }
        for argument in all {
            match passed(client, argument).await? {
                Some(argument) => into.push(argument),
                None => return Ok(None),
            }
        }
    }
    Ok(Some(both))
}

/// Returns the argument for this server. `None` if its values identify nodes or are custom
/// structures: their identifiers differ between servers.
async fn passed(client: &Client, argument: Argument) -> Result<Option<Argument>, ClientError> {
    let mut data_type = argument.data_type.clone();
    if data_type.namespace != 0 {
        let above = match client.supertypes(&data_type).await {
            Ok(above) => above,
            Err(ClientError::Status(_)) => return Ok(None),
            Err(error) => return Err(error),
        };
        match above.into_iter().find(|one| one.namespace == 0) {
            // An enumeration, or a subtype of a number.
            Some(known) if known != DataTypeId::Structure => data_type = known,
            Some(_) | None => return Ok(None),
        }
    }
    let names = [
        DataTypeId::NodeId,
        DataTypeId::ExpandedNodeId,
        DataTypeId::QualifiedName,
        DataTypeId::Structure,
    ];
    if names.iter().any(|one| data_type == *one) {
        return Ok(None);
    }
    Ok(Some(Argument {
        data_type,
        ..argument
    }))
}

const DEEPEST: usize = 12;
const LONGEST_NAME: usize = 128;
const MOST_OBJECTS: usize = 2000;
pub(crate) const MOST_METHODS: usize = 1000;
const MOST_ARGUMENTS: usize = 64;
