//! The list of certificates that an authority has revoked.

use std::time::Duration;

use x509_cert::crl::CertificateList;
use x509_cert::der::{Decode as _, Encode as _, pem};

use crate::Unfit;
use crate::certificate::{Certificate, Serial, common_name};

/// A certificate that is revoked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Revoked {
    /// Its number.
    pub serial: Serial,
    /// Since when.
    pub since: Duration,
}

/// A revocation list (RFC 5280, 5).
#[derive(Debug, Clone)]
pub struct Crl {
    inner: CertificateList,
    der: Vec<u8>,
}

impl Crl {
    /// Reads one in DER, or in PEM. Whose it is, is not looked at.
    ///
    /// # Errors
    /// It is neither.
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

    /// Its DER.
    #[must_use]
    pub fn der(&self) -> &[u8] {
        &self.der
    }

    /// The common name of its authority.
    #[must_use]
    pub fn issuer_name(&self) -> String {
        common_name(&self.inner.tbs_cert_list.issuer)
    }

    /// When it was made, and when the next one is to be there at the latest, where it says so.
    #[must_use]
    pub fn times(&self) -> (Duration, Option<Duration>) {
        let list = &self.inner.tbs_cert_list;
        let next = list
            .next_update
            .map(x509_cert::time::Time::to_unix_duration);
        (list.this_update.to_unix_duration(), next)
    }

    /// Those that it has.
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

    /// Whether that authority made and signed it.
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

    /// Whether it can be relied on at that time. A list whose successor is overdue may miss the latest revocations.
    #[must_use]
    pub fn is_current(&self, now: Duration) -> bool {
        let (from, next) = self.times();
        from <= now && next.is_none_or(|next| now <= next)
    }

    /// Whether it has that certificate, which is of the same authority.
    #[must_use]
    pub fn revokes(&self, certificate: &Certificate) -> bool {
        let serial = certificate.serial();
        self.revoked().any(|one| one.serial == serial)
    }
}
