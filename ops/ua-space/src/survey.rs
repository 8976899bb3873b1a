//! Inspects ROS graphs, OPC UA servers, NodeSets and SysML models for `init` and `check
//! --environment`.

pub(crate) mod data_types;
pub(crate) mod model;
pub(crate) mod nodeset;
pub(crate) mod opcua;
pub(crate) mod ros1;
pub(crate) mod ros2;

pub(crate) use ros1::master_uri;

use std::fmt::Display;

use mappings::{LiveSpace, NodeIdText, SpaceId};
use uadp::BuiltinType;

use crate::exit::CommandFailure;

/// An inspected ROS graph.
#[derive(Clone, Debug)]
pub(crate) struct SurveyedGraph {
    pub(crate) space: SpaceId,
    /// The DDS domain of a ROS 2 space.
    pub(crate) domain: Option<u16>,
    pub(crate) live: LiveSpace,
}

/// Nodes of a running server, or of a NodeSet.
#[derive(Clone, Debug, Default)]
pub(crate) struct SurveyedNodes {
    /// The name of the source, for people.
    pub(crate) place: String,
    /// The server, if the nodes are from a running server.
    pub(crate) server: Option<UaServer>,
    /// The URI of each namespace index in the node ids; 0 is the namespace of OPC UA.
    pub(crate) namespaces: Vec<String>,
    /// The variables below the Objects folder, except properties and components of variables.
    pub(crate) variables: Vec<UaVariable>,
    /// The Methods of a running server, except the Methods with which a server of the space offers
    /// its calls.
    pub(crate) methods: Vec<UaMethod>,
}

/// An inspected server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UaServer {
    pub(crate) endpoint: String,
    /// The ApplicationName.
    pub(crate) name: String,
    /// True if the server is the server of a cell, which shows the space.
    pub(crate) is_cell: bool,
}

/// A Method of a server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UaMethod {
    /// The object on which the Method is called.
    pub(crate) object: NodeIdText,
    pub(crate) method: NodeIdText,
    pub(crate) name: String,
    /// The name of the object; empty for the Objects folder.
    pub(crate) within: String,
}

/// A variable of a server or NodeSet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UaVariable {
    pub(crate) node: NodeIdText,
    pub(crate) name: String,
    /// The name of the object with the variable; empty for the Objects folder.
    pub(crate) within: String,
    /// The source of the value, if it is not the server of the cell.
    pub(crate) source: Option<UaSource>,
    /// The builtin type, and whether the value is an array; `None` for matrices and abstract types.
    pub(crate) value: Option<(BuiltinType, bool)>,
}

/// A node of a server other than the server of the cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UaSource {
    /// The name of the server in the mapping.
    pub(crate) server: String,
    /// The node, with the URI of its namespace.
    pub(crate) node: String,
}

/// Runs a survey on a runtime of its own.
pub(crate) fn look<T>(
    looking: impl Future<Output = Result<T, CommandFailure>>,
) -> Result<T, CommandFailure> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| CommandFailure::Io(format!("cannot start: {error}")))?;
    let found = runtime.block_on(looking);
    // A name resolution may never end, so the runtime does not wait for it.
    runtime.shutdown_background();
    found
}

/// Returns the failure for an unavailable source, with a hint.
fn away(what: impl Display, help: &str) -> CommandFailure {
    CommandFailure::Unavailable(format!("{what}\n  = help: {help}"))
}

/// Maximum number of inspected topics of a graph and variables of a server.
pub(crate) const MOST: usize = 20_000;
