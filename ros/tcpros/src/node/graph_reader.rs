//! The graph of the master.

use std::sync::Arc;

use bytes::Bytes;

use crate::master::{Master, MasterError, MasterGraph};

/// Reads the graph from the master of a node.
#[derive(Clone, Debug)]
pub struct GraphReader {
    master: Master,
    /// The last reply of the master, and its graph.
    last: Option<(Bytes, Arc<MasterGraph>)>,
}

impl GraphReader {
    pub(super) const fn new(master: Master) -> Self {
        Self { master, last: None }
    }

    /// Returns the current graph of the master. Takes a few seconds at most; fails without a
    /// master.
    pub async fn read(&self) -> Result<MasterGraph, MasterError> {
        self.master.graph().await
    }

    /// Returns the current graph as [`read`](Self::read) does, and the same `Arc` as before if it
    /// has not changed.
    ///
    /// # Errors
    /// Fails without a master.
    pub async fn read_again(&mut self) -> Result<Arc<MasterGraph>, MasterError> {
        self.master.graph_since(&mut self.last).await
    }
}
