//! Who is who in a plant, by certificates: an authority that issues and revokes them, and the check of those that others show.
//!
//! [`check`] judges a certificate by the certificates and revocation lists that are known (OPC 10000-4, 6.1.3): the chain to its
//! root, the trust in it, times, usages and revocations. [`Authority`] makes certificates from [`Request`]s (OPC 10000-6, 6.2.2)
//! and signs the list of those that are revoked. [`Renewal`] says when a certificate is to be asked for anew.
//!
//! Times are parameters, as durations since 1970, and so is what is to be random: keys and serial numbers. Here is no file, no
//! clock and no socket. RSA is the only kind of key there is, as in the security policies of the servers.

mod authority;
mod certificate;
mod chain;
mod crl;
mod fingerprint;
mod renewal;
mod request;

pub use authority::{Authority, Issue};
pub use certificate::{Certificate, Serial};
pub use chain::{Fault, Known, Names, check, check_named};
pub use crl::{Crl, Revoked};
pub use fingerprint::{Fingerprint, NoFingerprint};
pub use renewal::{Renewal, Step, is_near_end};
pub use request::Request;

/// What is no certificate, request, list or key of the kinds that are understood.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Unfit {
    /// Neither DER nor PEM of what it should be.
    #[error("it cannot be read: neither DER nor PEM of what is wanted")]
    Unreadable,
    /// Another kind of key than RSA.
    #[error("its key is not of RSA")]
    Key,
    /// The signature is not that of whose it should be, or of a kind that is not taken (RSA with SHA-256, SHA-384 or SHA-512 is).
    #[error("its signature is not that of whose it should be")]
    Signature,
    /// A name or a time that a certificate cannot have.
    #[error("a certificate cannot have that name or time")]
    Name,
    /// A key that is shorter or longer than the security policies allow.
    #[error("its key has {0} bits; 2048 to 4096 are allowed")]
    Length(usize),
    /// A request without the ApplicationUri that each application's certificate has.
    #[error("it asks for a certificate without an ApplicationUri among its alternative names")]
    NoUri,
}

/// Bits of RSA keys that the security policies allow.
const KEY_BITS: std::ops::RangeInclusive<usize> = 2048..=4096;
