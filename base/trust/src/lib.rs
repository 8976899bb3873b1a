//! Certificates of a plant: an authority that issues and revokes them, and their validation.
//!
//! [`check`] validates a certificate with trusted certificates, issuer certificates and revocation
//! lists (OPC 10000-4, 6.1.3): the chain to its root, trust, times, usages and revocations.
//! [`CertificateAuthority`] issues certificates for [`CertificateSigningRequest`]s (OPC 10000-6,
//! 6.2.2) and signs the revocation list. [`Renewal`] schedules the renewal of a certificate.
//!
//! Times are parameters, as durations since 1970. Random data is a parameter too: keys and serial
//! numbers. This crate uses no file, no clock and no socket. It supports RSA keys only, as required
//! by the security policies of the servers.

mod authority;
mod certificate;
mod chain;
mod crl;
mod fingerprint;
mod renewal;
mod request;

pub use authority::{CertificateAuthority, Issue};
pub use certificate::{Certificate, Serial};
pub use chain::{CertificateFault, RequiredNames, TrustedCertificates, check, check_named};
pub use crl::{Crl, Revoked};
pub use fingerprint::{Fingerprint, NoFingerprint};
pub use renewal::{Renewal, RenewalStep, is_near_end};
pub use request::CertificateSigningRequest;

/// An invalid or unsupported certificate, request, revocation list or key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Unfit {
    /// The data is neither DER nor PEM of the expected type.
    #[error("it is neither valid DER nor valid PEM of the expected kind")]
    Unreadable,
    /// The key is not an RSA key.
    #[error("its key is not an RSA key")]
    Key,
    /// The signature is invalid, or its algorithm is not supported (RSA with SHA-256, SHA-384 or
    /// SHA-512 is).
    #[error("its signature is not from the expected issuer")]
    Signature,
    /// A name or a time is invalid in a certificate.
    #[error("the name or time is not valid in a certificate")]
    Name,
    /// The key length is outside of the range of the security policies.
    #[error("its key has {0} bits; 2048 to 4096 are allowed")]
    Length(usize),
    /// The request lacks the ApplicationUri, which the certificate of an application requires.
    #[error("the request has no ApplicationUri among the alternative names")]
    NoUri,
}

/// The key lengths in bits that the security policies allow.
const KEY_BITS: std::ops::RangeInclusive<usize> = 2048..=4096;
