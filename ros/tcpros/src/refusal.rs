//! The reasons why a node is refused. It gets their texts, which are those of roscpp.

use thiserror::Error;

/// The reason why the connection of a node is refused.
#[derive(Debug, Error)]
pub(crate) enum ConnectionRefusal {
    /// The header of a client has no checksum.
    #[error("bogus tcpros header. did not have the required elements: md5sum")]
    ClientHeader,
    /// The header of a subscriber has no checksum or no topic.
    #[error("Header from subscriber did not have the required elements: md5sum, topic")]
    SubscriberHeader,
    /// This node does not offer the service.
    #[error("received a tcpros connection for a nonexistent service [{0}]")]
    NoService(String),
    /// This node does not publish the topic.
    #[error("received a connection for a nonexistent topic [{topic}] from [{caller}]")]
    NoTopic {
        /// The topic.
        topic: String,
        /// The name of the subscriber.
        caller: String,
    },
    /// The client uses another type.
    #[error(
        "client wants service {service} to have md5sum {wanted}, but it has {ours}. Dropping connection."
    )]
    ServiceType {
        /// The service.
        service: String,
        /// The checksum of the client.
        wanted: String,
        /// The checksum of this node.
        ours: String,
    },
    /// The subscriber uses another type.
    #[error(
        "Client [{caller}] wants topic {topic} to have datatype/md5sum [{wanted}], but our version has [{ours}]. Dropping connection."
    )]
    TopicType {
        /// The topic.
        topic: String,
        /// The name of the subscriber.
        caller: String,
        /// The type and the checksum of the subscriber.
        wanted: String,
        /// The type and the checksum of this node.
        ours: String,
    },
    /// The service has its maximum of clients.
    #[error("service [{service}] has {clients} clients and takes no more")]
    Full {
        /// The service.
        service: String,
        /// The maximum.
        clients: usize,
    },
}
