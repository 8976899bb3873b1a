//! What is there: ROS graphs, OPC UA servers and NodeSets, as `init` and `check --environment` look at them.

pub(crate) mod data_types;
pub(crate) mod nodeset;
pub(crate) mod opcua;
pub(crate) mod ros1;
pub(crate) mod ros2;

use std::fmt::Display;

use mappings::{LiveSpace, NodeIdText, SpaceId};
use uadp::BuiltinType;

use crate::exit::Failure;

/// A ROS graph that was looked at.
#[derive(Clone, Debug)]
pub(crate) struct Graph {
    pub(crate) space: SpaceId,
    /// Of a ROS 2 space.
    pub(crate) domain: Option<u16>,
    pub(crate) live: LiveSpace,
}

/// Nodes of a server that runs, or of a NodeSet.
#[derive(Clone, Debug, Default)]
pub(crate) struct Nodes {
    /// What they are from, for people.
    pub(crate) place: String,
    /// Of a server that runs.
    pub(crate) server: Option<UaServer>,
    /// The URI of each namespace index that its node ids use; 0 is OPC UA's own.
    pub(crate) namespaces: Vec<String>,
    /// Its variables below the Objects folder, properties and parts of variables aside.
    pub(crate) variables: Vec<UaVariable>,
    /// Of a server that runs: its Methods there, but for those by which a server of the space shows its calls.
    pub(crate) methods: Vec<UaMethod>,
}

/// A server that was looked at.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UaServer {
    pub(crate) endpoint: String,
    /// Its ApplicationName.
    pub(crate) name: String,
    /// Whether it is the server of a cell, which shows the space.
    pub(crate) is_cell: bool,
}

/// A Method of a server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UaMethod {
    /// What it is called on.
    pub(crate) object: NodeIdText,
    pub(crate) method: NodeIdText,
    pub(crate) name: String,
    /// The name of the object, where that is not the Objects folder.
    pub(crate) within: String,
}

/// A variable of a server or NodeSet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UaVariable {
    pub(crate) node: NodeIdText,
    pub(crate) name: String,
    /// The name of the object it is in, where that is not the Objects folder.
    pub(crate) within: String,
    /// Where its value comes from, if that is not the cell's own server.
    pub(crate) source: Option<UaSource>,
    /// Builtin type and whether it is an array; `None` for matrices and abstract types.
    pub(crate) value: Option<(BuiltinType, bool)>,
}

/// A node of a server that is not the cell's own.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UaSource {
    /// What the mapping calls the server.
    pub(crate) server: String,
    /// The node there, by the URI of its namespace.
    pub(crate) node: String,
}

/// Runs what looks around, on a runtime that ends with it.
pub(crate) fn look<T>(looking: impl Future<Output = Result<T, Failure>>) -> Result<T, Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::Io(format!("cannot start: {error}")))?;
    let found = runtime.block_on(looking);
    // Looking up a name of a host has no end of its own.
    runtime.shutdown_background();
    found
}

/// The failure of something that is not there, with what to do about it.
fn away(what: impl Display, help: &str) -> Failure {
    Failure::Unavailable(format!("{what}\n  = help: {help}"))
}

/// Most topics of a graph and variables of a server that are looked at.
pub(crate) const MOST: usize = 20_000;
