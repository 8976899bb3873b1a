//! The errors of a node.

use std::net::IpAddr;

use thiserror::Error;

use crate::names::ResourceNameError;

/// Error of starting a node, or of a topic or service.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum NodeError {
    /// Called outside a tokio runtime.
    #[error("a node needs a running tokio runtime")]
    NoRuntime,
    /// A name is not a valid ROS name.
    #[error(transparent)]
    Name(#[from] ResourceNameError),
    /// The master's URI is not `http://host:port`.
    #[error("the master's URI `{0}` is not of the form http://host:11311 (ROS_MASTER_URI)")]
    MasterUri(String),
    /// No port can be opened.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address.
        address: IpAddr,
        /// The error of the system.
        #[source]
        source: std::io::Error,
    },
    /// This node publishes the topic already.
    #[error("{0} is already published by this node")]
    AlreadyPublished(String),
    /// The type has no package or no checksum.
    #[error("{topic} cannot be published with the incomplete type `{type_name}`")]
    Type {
        /// The resolved topic.
        topic: String,
        /// The given type name.
        type_name: String,
    },
    /// This node offers the service already.
    #[error("{0} is already offered by this node")]
    AlreadyOffered(String),
    /// The type of the service has no package or no checksum.
    #[error("{service} cannot be offered with the incomplete type `{type_name}`")]
    ServiceType {
        /// The resolved service.
        service: String,
        /// The given type name.
        type_name: String,
    },
}
