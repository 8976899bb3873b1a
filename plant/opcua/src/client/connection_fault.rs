//! The reasons for a missing connection.

use std::io;
use std::path::PathBuf;

use opcua::types::StatusCode;

use super::ClientError;
use crate::judge::RefusedCertificate;
use crate::pki::PkiError;

/// The reason for a missing connection.
#[derive(Debug, thiserror::Error)]
pub(super) enum ConnectionFault {
    /// The own certificate store cannot be used.
    #[error(transparent)]
    Pki(#[from] PkiError),
    /// The path of the own certificate store cannot be resolved.
    #[error(transparent)]
    Path(io::Error),
    /// The copy of the accepted certificate cannot be written.
    #[error("{} cannot be written: {error}", folder.display())]
    Store {
        /// The folder of the copy.
        folder: PathBuf,
        /// The error of the system.
        error: io::Error,
    },
    /// The library refuses the options of the client.
    #[error("{}", .0.join(", "))]
    Options(Vec<String>),
    /// The library reports an error.
    #[error(transparent)]
    Library(#[from] opcua::types::Error),
    /// A request failed.
    #[error(transparent)]
    Request(#[from] ClientError),
    /// The certificate of the server is refused.
    #[error(transparent)]
    Certificate(#[from] RefusedCertificate),
    /// The server at the URL does not answer GetEndpoints in time.
    #[error("{0} does not return its endpoints")]
    NoEndpoints(String),
    /// The mapping requires security, and the client has no certificate.
    #[error("a secured session needs a directory for certificates")]
    NoPki,
    /// No endpoint has the required security.
    #[error(
        "no usable security at {url}: it offers {offers}, but {wants} is required (`security` in the mapping)"
    )]
    Security {
        /// The URL of the server.
        url: String,
        /// The offered security.
        offers: String,
        /// The required security.
        wants: String,
    },
    /// The endpoint at the URL does not accept users with passwords.
    #[error("{0} does not accept passwords (`user`)")]
    NoPasswords(String),
    /// The endpoint at the URL does not accept anonymous users.
    #[error("{0} does not admit anonymous users (`user`)")]
    NotAnonymous(String),
    /// The server at the URL does not create the session in time.
    #[error("{0} does not open the session in time")]
    NoSession(String),
    /// The server does not answer the first read in time.
    #[error("the server does not return its namespaces")]
    NamespacesLate,
    /// The server has no NamespaceArray.
    #[error("the server has no NamespaceArray")]
    NoNamespaces,
    /// The event loop of the library has ended, for this reason.
    #[error("{0}")]
    Ended(String),
    /// The subscriptions get neither notifications nor keep-alives.
    #[error("the server sends no messages for its subscriptions")]
    NoPublishing,
    /// The server answers no keep-alives.
    #[error("the server does not respond")]
    Silent,
    /// The host does not accept connections.
    #[error("the host of the server does not respond")]
    HostLost,
}

impl ConnectionFault {
    /// Returns the status code if the certificate of the server is refused.
    pub(super) const fn certificate(&self) -> Option<StatusCode> {
        if let Self::Certificate(refused) = self {
            Some(refused.status)
        } else {
            None
        }
    }
}
