//! Certificate revocation lists.

use std::time::Duration;

use x509_cert::crl::CertificateList;
use x509_cert::der::{Decode as _, Encode as _, pem};

use crate::Unfit;
use crate::certificate::{Certificate, Serial, common_name};

/// A revoked certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Revoked {
    /// The serial number.
    pub serial: Serial,
    /// The time of the revocation.
    pub since: Duration,
}

/// A revocation list (RFC 5280, 5).
#[derive(Debug, Clone)]
pub struct Crl {
    inner: CertificateList,
    der: Vec<u8>,
}

impl Crl {
    /// Reads a list in DER or PEM. Does not check its issuer.
    ///
    /// # Errors
    /// Returns an error if the bytes are neither.
    pub fn read(bytes: &[u8]) -> Result<Self, Unfit> {
        let inner = if bytes.starts_with(b"-----BEGIN") {
            let (_, der) = pem::decode_vec(bytes).map_err(|_| Unfit::Unreadable)?;
            CertificateList::from_der(&der)
        } else {
            CertificateList::from_der(bytes)
        };
        Self::of(inner.map_err(|_| Unfit::Unreadable)?)
    }

    pub(crate) fn of(inner: CertificateList) -> Result<Self, Unfit> {
        let der = inner.to_der().map_err(|_| Unfit::Unreadable)?;
        Ok(Self { inner, der })
    }

    /// Returns the DER encoding.
    #[must_use]
    pub fn der(&self) -> &[u8] {
        &self.der
    }

    /// Returns the common name of its authority.
    #[must_use]
    pub fn issuer_name(&self) -> String {
        common_name(&self.inner.tbs_cert_list.issuer)
    }

    /// Returns the time of its creation, and the latest time of its next update, if present.
    #[must_use]
    pub fn times(&self) -> (Duration, Option<Duration>) {
        let list = &self.inner.tbs_cert_list;
        let next = list
            .next_update
            .map(x509_cert::time::Time::to_unix_duration);
        (list.this_update.to_unix_duration(), next)
    }

    /// Returns the revoked certificates.
    pub fn revoked(&self) -> impl Iterator<Item = Revoked> + '_ {
        let all = self
            .inner
            .tbs_cert_list
            .revoked_certificates
            .iter()
            .flatten();
        all.map(|one| Revoked {
            serial: Serial::of(one.serial_number.as_bytes()),
            since: one.revocation_date.to_unix_duration(),
        })
    }

    /// Returns whether this authority issued and signed the list.
    #[must_use]
    pub fn is_of(&self, authority: &Certificate) -> bool {
        let list = &self.inner.tbs_cert_list;
        if list.issuer != authority.inner.tbs_certificate.subject {
            return false;
        }
        let Ok(signed) = list.to_der() else {
            return false;
        };
        authority.verify(
            &signed,
            &self.inner.signature_algorithm,
            &self.inner.signature,
        )
    }

    /// Returns whether the list is current at this time. A list may lack recent revocations if its
    /// successor is overdue.
    #[must_use]
    pub fn is_current(&self, now: Duration) -> bool {
        let (from, next) = self.times();
        from <= now && next.is_none_or(|next| now <= next)
    }

    /// Returns whether the list contains a certificate of its authority.
    #[must_use]
    pub fn revokes(&self, certificate: &Certificate) -> bool {
        let serial = certificate.serial();
        self.revoked().any(|one| one.serial == serial)
    }
}
