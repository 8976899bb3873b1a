//! The reasons why a certificate or a trust list is not renewed.

use std::io;
use std::path::PathBuf;

use opcua::types::StatusCode;
use tokio::task::JoinError;
use trust::Unfit;

use super::LONGEST_VISIT;
use crate::certificates::StoreFault;
use crate::client::ClientError;
use crate::directory::DirectoryError;

/// The reason why a visit to the Global Discovery Server fails.
#[derive(Debug, thiserror::Error)]
pub enum EnrolmentFault {
    /// The server is unreachable.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The Directory refuses a request, or its answer is invalid.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// Without verification of the server's certificate, any server could answer.
    #[error("the server offers no secured channel")]
    Unsecured,
    /// The visit takes too long.
    #[error("the server has not responded within {LONGEST_VISIT:?}")]
    Late,
    /// The file of the own private key cannot be read.
    #[error("{}: {error}", path.display())]
    KeyFile {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        error: io::Error,
    },
    /// The file contains no private key.
    #[error("{} contains no private key", .0.display())]
    NoKey(PathBuf),
    /// The thread that signs the request failed.
    #[error(transparent)]
    Thread(#[from] JoinError),
    /// The request cannot be made.
    #[error("cannot request a certificate: {0}")]
    Request(#[from] Unfit),
    /// The certificates of the trust list cannot be stored.
    #[error("cannot store the trust list: {0}")]
    TrustList(io::Error),
    /// The issuers of the trust list cannot be stored.
    #[error("cannot store the trust list: {0}")]
    Issuers(StatusCode),
    /// A revocation list cannot be stored.
    #[error(transparent)]
    RevocationList(#[from] StoreFault),
    /// The issued certificate is not for this application.
    #[error("the issued certificate is for another ApplicationUri")]
    OtherApplication,
    /// The issued certificate is not valid yet, or not any more.
    #[error(
        "the issued certificate is not valid at this time: set the clocks of this host and of the GDS"
    )]
    NotValid,
    /// The program would restart endlessly.
    #[error("the issued certificate must be renewed at once")]
    ShortLived,
    /// The issued certificate does not belong to the own private key.
    #[error("the issued certificate is for another key")]
    OtherKey,
    /// The issued certificate is not trusted.
    #[error("rejected the issued certificate: {0}")]
    Rejected(StatusCode),
    /// The issued certificate cannot be written.
    #[error("cannot write the certificate: {0}")]
    Write(io::Error),
}
