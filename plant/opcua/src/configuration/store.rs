//! The trust list of a server, stored in the files of its certificate store.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use opcua::crypto::{CertificateStore, X509};
use opcua::types::{ByteString, StatusCode, TrustListDataType, Variant};
use tracing::{info, warn};
use trust::{Certificate, CertificateFault, Crl, TrustedCertificates};

use super::Answer;
use crate::certificates::{self, Standing};
use crate::known;
use crate::server::MethodRequest;
use crate::trust_file::{TrustList, masks};

/// The trust list of the store at a root.
#[derive(Debug, Clone)]
pub(crate) struct StoreList {
    root: PathBuf,
}

impl StoreList {
    pub(crate) fn new(root: &Path) -> Self {
        Self {
            root: root.to_owned(),
        }
    }

    /// AddCertificate: trusts the certificate of an application or of an authority. Issuer
    /// certificates are added only by writing the whole list (OPC 10000-12, 7.8.2.6).
    pub(crate) fn add(&self, request: &MethodRequest) -> Answer {
        let [Variant::ByteString(bytes), Variant::Boolean(true)] = request.arguments.as_slice()
        else {
            return Err(StatusCode::BadInvalidArgument.into());
        };
        let certificate = read(bytes)?;
        self.keep(&certificate, Standing::Trusted)
            .map_err(|error| told(&error))?;
        info!(name = ?certificate.name(), by = ?request.caller.user, "added a certificate to the trust list");
        Ok(Vec::new())
    }

    /// RemoveCertificate, by thumbprint.
    pub(crate) fn remove(&self, request: &MethodRequest) -> Answer {
        let [Variant::String(thumbprint), Variant::Boolean(is_trusted)] =
            request.arguments.as_slice()
        else {
            return Err(StatusCode::BadInvalidArgument.into());
        };
        let standing = match is_trusted {
            true => Standing::Trusted,
            false => Standing::Issuer,
        };
        let wanted = thumbprint.as_ref().to_lowercase();
        let all = certificates::list(&self.root).map_err(|error| {
            warn!(%error, "cannot read the certificate store");
            StatusCode::BadResourceUnavailable
        })?;
        let mut gone = all
            .iter()
            .filter(|one| one.standing == standing && one.thumbprint == wanted)
            .peekable();
        if gone.peek().is_none() {
            return Err(StatusCode::BadInvalidArgument.into());
        }
        for one in gone {
            fs::remove_file(&one.path).map_err(|error| told(&error))?;
            info!(name = ?one.name, by = ?request.caller.user, "removed a certificate from the trust list");
        }
        Ok(Vec::new())
    }

    /// Judges a new certificate of the server together with its issuer certificates: each signature
    /// has to be valid. The issuers need not be trusted by the server, because other applications
    /// verify the certificate (OPC 10000-12, 7.10.5).
    pub(crate) fn judge(
        &self,
        certificate: &Certificate,
        issuers: &Variant,
    ) -> Result<(), StatusCode> {
        self.judge_among(certificate, &given(issuers)?)
    }

    /// Judges a new certificate of the server with decoded issuer certificates.
    pub(crate) fn judge_among(
        &self,
        certificate: &Certificate,
        issuers: &[Certificate],
    ) -> Result<(), StatusCode> {
        let mut known = known::read(&self.root);
        // The issuers count as trusted here: an administrator who may replace the certificate is
        // responsible for it.
        known.trusted.append(&mut known.issuers);
        known.trusted.extend_from_slice(issuers);
        if certificate.is_self_signed() {
            known.trusted.push(certificate.clone());
        }
        match trust::check(certificate, &[], &known, known::now()) {
            // The authority may publish its revocation lists later.
            Ok(())
            | Err(
                CertificateFault::RevocationUnknown | CertificateFault::IssuerRevocationUnknown,
            ) => Ok(()),
            Err(fault) => {
                warn!(%fault, "rejected a new certificate of the server");
                Err(StatusCode::BadSecurityChecksFailed)
            }
        }
    }

    /// Stores the issuer certificates of a certificate, which clients may need.
    pub(crate) fn keep_issuers(&self, issuers: &Variant) -> Result<(), StatusCode> {
        self.keep_all(&given(issuers)?)
    }

    /// Stores decoded issuer certificates.
    pub(crate) fn keep_all(&self, issuers: &[Certificate]) -> Result<(), StatusCode> {
        for certificate in issuers.iter().filter(|one| one.is_authority()) {
            self.keep(certificate, Standing::Issuer)
                .map_err(|error| told(&error))?;
        }
        Ok(())
    }

    /// Trusts the certificates of a trust list, in addition to the trusted certificates.
    pub(crate) fn trust_all(&self, all: &[Certificate]) -> io::Result<()> {
        for certificate in all {
            let known = known::read(&self.root);
            if !known.trusted.contains(certificate) {
                self.keep(certificate, Standing::Trusted)?;
                info!(name = ?certificate.name(), "added a certificate of the plant's trust list");
            }
        }
        Ok(())
    }

    /// Writes a certificate to the folder that the library reads, and returns the file name.
    fn keep(&self, certificate: &Certificate, standing: Standing) -> io::Result<String> {
        let of_library = X509::from_der(certificate.der())
            .map_err(|error| io::Error::other(error.to_string()))?;
        let name = CertificateStore::cert_file_name(&of_library);
        let folder = self.root.join(standing.name());
        fs::create_dir_all(&folder)?;
        fs::write(folder.join(&name), certificate.der())?;
        if standing == Standing::Trusted {
            // The library refuses a certificate that is both trusted and rejected.
            match fs::remove_file(self.root.join(Standing::Rejected.name()).join(&name)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                Ok(()) | Err(_) => {}
            }
        }
        Ok(name)
    }

    /// Replaces all certificates of a role. New files are written before old files are deleted.
    fn have(&self, all: &[Certificate], standing: Standing) -> io::Result<()> {
        let mut names = BTreeSet::new();
        for one in all {
            names.insert(self.keep(one, standing)?);
        }
        for entry in fs::read_dir(self.root.join(standing.name()))?.flatten() {
            let name = entry.file_name();
            if !name.to_str().is_some_and(|name| names.contains(name)) {
                fs::remove_file(entry.path())?;
            }
        }
        Ok(())
    }

    /// Replaces all revocation lists of trusted authorities, or of the other authorities.
    fn have_lists(&self, all: &[Crl], are_trusted: bool) -> Result<(), StatusCode> {
        let known = known::read(&self.root);
        let folder = self.root.join(known::CRLS);
        for entry in fs::read_dir(&folder).into_iter().flatten().flatten() {
            let list = fs::read(entry.path())
                .ok()
                .and_then(|bytes| Crl::read(&bytes).ok());
            let stays = list.is_some_and(|list| {
                is_trusted(&list, &known) != are_trusted
                    || all.iter().any(|one| one.der() == list.der())
            });
            if !stays {
                fs::remove_file(entry.path()).map_err(|error| told(&error))?;
            }
        }
        for one in all {
            match known::put_crl(&self.root, one) {
                Ok(Some(_)) => {}
                Ok(None) => {
                    warn!(issuer = ?one.issuer_name(), "ignored a revocation list of an unknown authority");
                    return Err(StatusCode::BadCertificateIssuerRevocationUnknown);
                }
                Err(error) => {
                    warn!(%error, "cannot store a revocation list");
                    return Err(StatusCode::BadResourceUnavailable);
                }
            }
        }
        Ok(())
    }
}

impl TrustList for StoreList {
    fn list(&self, masks: u32) -> TrustListDataType {
        let known = known::read(&self.root);
        let certificates = |mask: u32, all: &[Certificate]| {
            let each = all.iter().map(|one| ByteString::from(one.der().to_vec()));
            (masks & mask != 0).then(|| each.collect())
        };
        let lists = |mask: u32, are_trusted: bool| {
            let each = known
                .crls
                .iter()
                .filter(|list| is_trusted(list, &known) == are_trusted);
            let each = each.map(|list| ByteString::from(list.der().to_vec()));
            (masks & mask != 0).then(|| each.collect())
        };
        TrustListDataType {
            specified_lists: masks,
            trusted_certificates: certificates(masks::TRUSTED_CERTIFICATES, &known.trusted),
            trusted_crls: lists(masks::TRUSTED_CRLS, true),
            issuer_certificates: certificates(masks::ISSUER_CERTIFICATES, &known.issuers),
            issuer_crls: lists(masks::ISSUER_CRLS, false),
        }
    }

    fn replace(&self, list: TrustListDataType) -> Result<bool, StatusCode> {
        // The whole list is decoded before any file is changed.
        let certificates = |all: &Option<Vec<ByteString>>| -> Result<Vec<Certificate>, StatusCode> {
            all.iter().flatten().map(read).collect()
        };
        let lists = |all: &Option<Vec<ByteString>>| -> Result<Vec<Crl>, StatusCode> {
            let each = all.iter().flatten();
            each.map(|one| {
                let bytes = one.value.as_deref().unwrap_or_default();
                Crl::read(bytes).map_err(|_| StatusCode::BadInvalidArgument)
            })
            .collect()
        };
        let trusted = certificates(&list.trusted_certificates)?;
        let issuers = certificates(&list.issuer_certificates)?;
        let (trusted_lists, issuer_lists) = (lists(&list.trusted_crls)?, lists(&list.issuer_crls)?);
        let is_given = |mask: u32| list.specified_lists & mask != 0;
        if is_given(masks::TRUSTED_CERTIFICATES) {
            self.have(&trusted, Standing::Trusted)
                .map_err(|error| told(&error))?;
        }
        if is_given(masks::ISSUER_CERTIFICATES) {
            self.have(&issuers, Standing::Issuer)
                .map_err(|error| told(&error))?;
        }
        if is_given(masks::TRUSTED_CRLS) {
            self.have_lists(&trusted_lists, true)?;
        }
        if is_given(masks::ISSUER_CRLS) {
            self.have_lists(&issuer_lists, false)?;
        }
        Ok(false)
    }
}

fn is_trusted(list: &Crl, known: &TrustedCertificates) -> bool {
    known.trusted.iter().any(|one| list.is_of(one))
}

/// Returns the certificates in a method argument.
fn given(issuers: &Variant) -> Result<Vec<Certificate>, StatusCode> {
    let Variant::Array(array) = issuers else {
        return Ok(Vec::new());
    };
    let each = array.values.iter().take(MOST_ISSUERS).map(|one| {
        let Variant::ByteString(bytes) = one else {
            return Err(StatusCode::BadInvalidArgument);
        };
        read(bytes)
    });
    each.collect()
}

fn read(bytes: &ByteString) -> Result<Certificate, StatusCode> {
    let bytes = bytes.value.as_deref().unwrap_or_default();
    Certificate::read(bytes).map_err(|_| StatusCode::BadCertificateInvalid)
}

/// Logs an error of the store, and returns the status code for the client.
fn told(error: &io::Error) -> StatusCode {
    warn!(%error, "cannot change the certificate store");
    StatusCode::BadResourceUnavailable
}

const MOST_ISSUERS: usize = 10;
