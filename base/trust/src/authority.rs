//! A certificate authority: its own certificate and key, and the certificates and lists that it
//! signs.

use std::fmt;
use std::time::Duration;

use rsa::pkcs1v15::{Signature, SigningKey};
use rsa::pkcs8::DecodePrivateKey as _;
use rsa::sha2::Sha256;
use rsa::signature::{Keypair as _, SignatureEncoding as _, Signer as _};
use rsa::{RsaPrivateKey, RsaPublicKey};
use x509_cert::TbsCertificate;
use x509_cert::Version;
use x509_cert::builder::{Builder as _, CertificateBuilder, Profile};
use x509_cert::crl::{CertificateList, RevokedCert, TbsCertList};
use x509_cert::der::Encode as _;
use x509_cert::der::asn1::{BitString, GeneralizedTime, OctetString, Uint, UtcTime};
use x509_cert::ext::AsExtension;
use x509_cert::ext::pkix::crl::CrlNumber;
use x509_cert::ext::pkix::{
    AuthorityKeyIdentifier, BasicConstraints, ExtendedKeyUsage, KeyUsage, KeyUsages,
    SubjectKeyIdentifier,
};
use x509_cert::name::Name;
use x509_cert::serial_number::SerialNumber;
use x509_cert::spki::{DynSignatureAlgorithmIdentifier as _, SubjectPublicKeyInfoOwned};
use x509_cert::time::{Time, Validity};

use crate::Unfit;
use crate::certificate::{
    CLIENT_AUTH, COMMON_NAME, Certificate, ORGANIZATION, SERVER_AUTH, Serial, key_id, name_of,
};
use crate::crl::{Crl, Revoked};
use crate::request::{CertificateSigningRequest, alternatives};

/// An authority that issues certificates to applications.
pub struct CertificateAuthority {
    certificate: Certificate,
    signer: SigningKey<Sha256>,
}

impl fmt::Debug for CertificateAuthority {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Authority")
            .field("certificate", &self.certificate)
            .finish_non_exhaustive()
    }
}

/// The parameters of a certificate in addition to the request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Issue {
    /// The serial number.
    pub serial: Serial,
    /// The start of the validity.
    pub from: Duration,
    /// The end of the validity.
    pub until: Duration,
}

impl CertificateAuthority {
    /// Creates a self-signed root authority, with a private key in the DER of PKCS #8.
    ///
    /// # Errors
    /// Returns an error for an invalid key or an invalid name.
    pub fn make(
        key: &[u8],
        (name, organization): (&str, &str),
        issue: &Issue,
    ) -> Result<Self, Unfit> {
        let signer = signer(key)?;
        let subject = name_of(&[(ORGANIZATION, organization), (COMMON_NAME, name)])?;
        let public = SubjectPublicKeyInfoOwned::from_key(signer.verifying_key());
        let public = public.map_err(|_| Unfit::Key)?;
        let mut builder = builder(&signer, issue, (subject.clone(), subject), public.clone())?;
        let id = key_id(public.subject_public_key.raw_bytes());
        add(&mut builder, &SubjectKeyIdentifier(octets(&id)?))?;
        // The authority issues certificates to applications only.
        let constraints = BasicConstraints {
            ca: true,
            path_len_constraint: Some(0),
        };
        add(&mut builder, &constraints)?;
        let usages = KeyUsages::DigitalSignature | KeyUsages::KeyCertSign | KeyUsages::CRLSign;
        add(&mut builder, &KeyUsage(usages))?;
        let made = builder.build::<Signature>().map_err(|_| Unfit::Signature)?;
        Ok(Self {
            certificate: Certificate::of(made)?,
            signer,
        })
    }

    /// Opens an existing authority: its certificate, and its private key in the DER of PKCS #8.
    ///
    /// # Errors
    /// Returns an error for an invalid or foreign key, or if the certificate does not belong to an
    /// authority.
    pub fn open(certificate: Certificate, key: &[u8]) -> Result<Self, Unfit> {
        let signer = signer(key)?;
        let public: RsaPublicKey = signer.verifying_key().into();
        if !certificate.is_authority() || !certificate.has_key_of(&public) {
            return Err(Unfit::Key);
        }
        Ok(Self {
            certificate,
            signer,
        })
    }

    /// Returns its certificate.
    #[must_use]
    pub const fn certificate(&self) -> &Certificate {
        &self.certificate
    }

    /// Issues the certificate for a request. Its validity ends with the validity of the authority
    /// at the latest.
    ///
    /// # Errors
    /// Returns an error for invalid names or times.
    pub fn issue(
        &self,
        request: &CertificateSigningRequest,
        issue: &Issue,
    ) -> Result<Certificate, Unfit> {
        let (_, last) = self.certificate.validity();
        let issue = Issue {
            until: issue.until.min(last),
            ..issue.clone()
        };
        let own: &TbsCertificate = &self.certificate.inner.tbs_certificate;
        let names = (own.subject.clone(), request.subject.clone());
        let mut builder = builder(&self.signer, &issue, names, request.key.clone())?;
        let id = key_id(request.key.subject_public_key.raw_bytes());
        add(&mut builder, &SubjectKeyIdentifier(octets(&id)?))?;
        add(&mut builder, &self.key_identifier()?)?;
        let constraints = BasicConstraints {
            ca: false,
            path_len_constraint: None,
        };
        add(&mut builder, &constraints)?;
        // The usages of OPC 10000-6, 6.2.2.
        let usages = KeyUsages::DigitalSignature
            | KeyUsages::NonRepudiation
            | KeyUsages::KeyEncipherment
            | KeyUsages::DataEncipherment;
        add(&mut builder, &KeyUsage(usages))?;
        add(
            &mut builder,
            &ExtendedKeyUsage(vec![CLIENT_AUTH, SERVER_AUTH]),
        )?;
        add(
            &mut builder,
            &alternatives(request.application_uri(), request.hosts())?,
        )?;
        let made = builder.build::<Signature>().map_err(|_| Unfit::Signature)?;
        Certificate::of(made)
    }

    /// Signs the revocation list with this number, which is valid until `until`.
    ///
    /// # Errors
    /// Returns an error for invalid times.
    pub fn crl(
        &self,
        revoked: &[Revoked],
        number: u64,
        (from, until): (Duration, Duration),
    ) -> Result<Crl, Unfit> {
        let mut all = Vec::new();
        for one in revoked {
            all.push(RevokedCert {
                serial_number: serial(&one.serial)?,
                revocation_date: time(one.since)?,
                crl_entry_extensions: None,
            });
        }
        let algorithm = self.signer.signature_algorithm_identifier();
        let algorithm = algorithm.map_err(|_| Unfit::Signature)?;
        let issuer = &self.certificate.inner.tbs_certificate.subject;
        let number = Uint::new(&number.to_be_bytes()).map_err(|_| Unfit::Name)?;
        let number = CrlNumber(number).to_extension(issuer, &[]);
        let identifier = self.key_identifier()?.to_extension(issuer, &[]);
        let extensions = [number, identifier]
            .into_iter()
            .collect::<Result<Vec<_>, _>>();
        let list = TbsCertList {
            version: Version::V2,
            signature: algorithm.clone(),
            issuer: issuer.clone(),
            this_update: time(from)?,
            next_update: Some(time(until)?),
            // An empty list is omitted (RFC 5280, 5.1.2.6).
            revoked_certificates: Some(all).filter(|all| !all.is_empty()),
            crl_extensions: Some(extensions.map_err(|_| Unfit::Name)?),
        };
        let signed = list.to_der().map_err(|_| Unfit::Name)?;
        let signature: Signature = self
            .signer
            .try_sign(&signed)
            .map_err(|_| Unfit::Signature)?;
        let signature = BitString::from_bytes(&signature.to_vec()).map_err(|_| Unfit::Signature)?;
        Crl::of(CertificateList {
            tbs_cert_list: list,
            signature_algorithm: algorithm,
            signature,
        })
    }

    fn key_identifier(&self) -> Result<AuthorityKeyIdentifier, Unfit> {
        let own = &self.certificate.inner.tbs_certificate;
        let known = own.get::<SubjectKeyIdentifier>().ok().flatten();
        let id = known.map(|(_, SubjectKeyIdentifier(id))| id);
        Ok(AuthorityKeyIdentifier {
            key_identifier: id,
            authority_cert_issuer: None,
            authority_cert_serial_number: None,
        })
    }
}

fn signer(key: &[u8]) -> Result<SigningKey<Sha256>, Unfit> {
    let key = RsaPrivateKey::from_pkcs8_der(key).map_err(|_| Unfit::Key)?;
    Ok(SigningKey::new(key))
}

fn builder<'s>(
    signer: &'s SigningKey<Sha256>,
    issue: &Issue,
    (issuer, subject): (Name, Name),
    key: SubjectPublicKeyInfoOwned,
) -> Result<CertificateBuilder<'s, SigningKey<Sha256>>, Unfit> {
    let validity = Validity {
        not_before: time(issue.from)?,
        not_after: time(issue.until)?,
    };
    let profile = Profile::Manual {
        issuer: Some(issuer),
    };
    let number = serial(&issue.serial)?;
    CertificateBuilder::new(profile, number, validity, subject, key, signer)
        .map_err(|_| Unfit::Name)
}

fn add<E: AsExtension>(
    builder: &mut CertificateBuilder<'_, SigningKey<Sha256>>,
    extension: &E,
) -> Result<(), Unfit> {
    builder.add_extension(extension).map_err(|_| Unfit::Name)
}

fn serial(serial: &Serial) -> Result<SerialNumber, Unfit> {
    SerialNumber::new(serial.bytes()).map_err(|_| Unfit::Name)
}

fn octets(bytes: &[u8]) -> Result<OctetString, Unfit> {
    OctetString::new(bytes).map_err(|_| Unfit::Name)
}

/// Encodes a time in whole seconds: until 2049 as UTCTime, later as GeneralizedTime (RFC 5280,
/// 4.1.2.5).
fn time(since_1970: Duration) -> Result<Time, Unfit> {
    let whole = Duration::from_secs(since_1970.as_secs());
    let short = UtcTime::from_unix_duration(whole).map(Time::UtcTime);
    let either =
        short.or_else(|_| GeneralizedTime::from_unix_duration(whole).map(Time::GeneralTime));
    either.map_err(|_| Unfit::Name)
}
