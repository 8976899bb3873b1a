//! Certificate signing requests (PKCS #10).

use std::fmt;
use std::net::IpAddr;

use rsa::RsaPrivateKey;
use rsa::pkcs1v15::{Signature, SigningKey};
use rsa::pkcs8::DecodePrivateKey as _;
use rsa::sha2::Sha256;
use rsa::traits::PublicKeyParts as _;
use x509_cert::builder::{Builder as _, RequestBuilder};
use x509_cert::der::asn1::{Ia5String, OctetString, PrintableStringRef, Utf8StringRef};
use x509_cert::der::{Decode as _, DecodePem as _, Encode as _};
use x509_cert::ext::pkix::SubjectAltName;
use x509_cert::ext::pkix::name::{DirectoryString, GeneralName};
use x509_cert::name::Name;
use x509_cert::request::attributes::ChallengePassword;
use x509_cert::request::{CertReq, ExtensionReq};
use x509_cert::spki::SubjectPublicKeyInfoOwned;

use crate::certificate::{COMMON_NAME, ORGANIZATION, alternative, common_name, name_of, verify};
use crate::{Fingerprint, KEY_BITS, Unfit};

/// A request that is signed with the key of the requested certificate.
#[derive(Clone)]
pub struct CertificateSigningRequest {
    pub(crate) subject: Name,
    pub(crate) key: SubjectPublicKeyInfoOwned,
    application_uri: String,
    hosts: Vec<String>,
    challenge: Option<String>,
    der: Vec<u8>,
}

/// Omits the challengePassword, which is a secret.
impl fmt::Debug for CertificateSigningRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Request")
            .field("application_uri", &self.application_uri)
            .field("hosts", &self.hosts)
            .finish_non_exhaustive()
    }
}

impl CertificateSigningRequest {
    /// Creates a request for an application with a name and an organization at `hosts`, with a
    /// private key in the DER of PKCS #8.
    ///
    /// # Errors
    /// Returns an error for an invalid key, name or URI.
    pub fn make(
        key: &[u8],
        application_uri: &str,
        names: (&str, &str),
        hosts: &[String],
    ) -> Result<Self, Unfit> {
        Self::make_with(key, (application_uri, hosts), names, None)
    }

    /// Creates a request with a challengePassword (RFC 2985, 5.4.1), such as the one-time token of
    /// an invitation.
    ///
    /// # Errors
    /// Returns an error for an invalid key, name or URI.
    pub fn make_with(
        key: &[u8],
        (application_uri, hosts): (&str, &[String]),
        (name, organization): (&str, &str),
        challenge: Option<&str>,
    ) -> Result<Self, Unfit> {
        let key = RsaPrivateKey::from_pkcs8_der(key).map_err(|_| Unfit::Key)?;
        let signer = SigningKey::<Sha256>::new(key);
        let subject = name_of(&[(ORGANIZATION, organization), (COMMON_NAME, name)])?;
        let mut builder = RequestBuilder::new(subject, &signer).map_err(|_| Unfit::Name)?;
        let names = alternatives(application_uri, hosts)?;
        builder.add_extension(&names).map_err(|_| Unfit::Name)?;
        if let Some(challenge) = challenge {
            let challenge = DirectoryString::Utf8String(challenge.to_owned());
            let added = builder.add_attribute(&ChallengePassword(challenge));
            added.map_err(|_| Unfit::Name)?;
        }
        let made = builder.build::<Signature>().map_err(|_| Unfit::Signature)?;
        Self::of(made)
    }

    /// Reads a request in DER or PEM.
    ///
    /// # Errors
    /// Returns an error if the bytes are neither, if the ApplicationUri is missing, or if the
    /// signature is invalid.
    pub fn read(bytes: &[u8]) -> Result<Self, Unfit> {
        let read = if bytes.starts_with(b"-----BEGIN") {
            CertReq::from_pem(bytes)
        } else {
            CertReq::from_der(bytes)
        };
        Self::of(read.map_err(|_| Unfit::Unreadable)?)
    }

    fn of(read: CertReq) -> Result<Self, Unfit> {
        use x509_cert::der::referenced::OwnedToRef as _;
        let der = read.to_der().map_err(|_| Unfit::Unreadable)?;
        let signed = read.info.to_der().map_err(|_| Unfit::Unreadable)?;
        let public = rsa::RsaPublicKey::try_from(read.info.public_key.owned_to_ref());
        let public = public.map_err(|_| Unfit::Key)?;
        let bits = public.size() * 8;
        if !KEY_BITS.contains(&bits) {
            return Err(Unfit::Length(bits));
        }
        if !verify(public, &signed, &read.algorithm, &read.signature) {
            return Err(Unfit::Signature);
        }
        let (uri, hosts) = names(&read).map_or((None, Vec::new()), |names| alternative(&names));
        Ok(Self {
            application_uri: uri.ok_or(Unfit::NoUri)?,
            hosts,
            challenge: challenge(&read),
            subject: read.info.subject,
            key: read.info.public_key,
            der,
        })
    }

    /// Returns the DER encoding.
    #[must_use]
    pub fn der(&self) -> &[u8] {
        &self.der
    }

    /// Returns the requested common name.
    #[must_use]
    pub fn name(&self) -> String {
        common_name(&self.subject)
    }

    /// Returns the requested ApplicationUri.
    #[must_use]
    pub fn application_uri(&self) -> &str {
        &self.application_uri
    }

    /// Returns the requested hosts.
    #[must_use]
    pub fn hosts(&self) -> &[String] {
        &self.hosts
    }

    /// Returns the challengePassword.
    #[must_use]
    pub fn challenge(&self) -> Option<&str> {
        self.challenge.as_deref()
    }

    /// Returns the SHA-256 of the public key, like
    /// [`Certificate::key_fingerprint`](crate::Certificate::key_fingerprint).
    #[must_use]
    pub fn key_fingerprint(&self) -> Fingerprint {
        Fingerprint::of_key(&self.key)
    }
}

fn challenge(read: &CertReq) -> Option<String> {
    let mut wanted = read.info.attributes.iter();
    let value = wanted.find(|one| one.oid == CHALLENGE)?.values.get(0)?;
    let text = value.decode_as::<Utf8StringRef<'_>>();
    let text = text.map(|text| text.as_str().to_owned());
    let printable = || {
        let text = value.decode_as::<PrintableStringRef<'_>>();
        text.map(|text| text.as_str().to_owned())
    };
    text.or_else(|_| printable()).ok()
}

fn names(read: &CertReq) -> Option<SubjectAltName> {
    let mut wanted = read.info.attributes.iter();
    let extensions = wanted
        .find(|one| one.oid == EXTENSIONS)?
        .values
        .iter()
        .next()?;
    let ExtensionReq(all) = ExtensionReq::from_der(&extensions.to_der().ok()?).ok()?;
    let one = all
        .into_iter()
        .find(|one| one.extn_id == ALTERNATIVE_NAMES)?;
    SubjectAltName::from_der(one.extn_value.as_bytes()).ok()
}

/// Returns the subject alternative names for an ApplicationUri and hosts. A host that is an IP
/// address becomes an IP address entry.
pub(crate) fn alternatives(
    application_uri: &str,
    hosts: &[String],
) -> Result<SubjectAltName, Unfit> {
    let text = |text: &str| Ia5String::new(text).map_err(|_| Unfit::Name);
    let mut names = vec![GeneralName::UniformResourceIdentifier(text(
        application_uri,
    )?)];
    for host in hosts {
        let bare = host.trim_matches(['[', ']']);
        let name = match bare.parse::<IpAddr>() {
            Ok(IpAddr::V4(four)) => OctetString::new(four.octets()).map(GeneralName::IpAddress),
            Ok(IpAddr::V6(six)) => OctetString::new(six.octets()).map(GeneralName::IpAddress),
            Err(_) => Ok(GeneralName::DnsName(text(bare)?)),
        };
        names.push(name.map_err(|_| Unfit::Name)?);
    }
    Ok(SubjectAltName(names))
}

/// The OID of extensionRequest (PKCS #9).
const EXTENSIONS: x509_cert::der::asn1::ObjectIdentifier =
    x509_cert::der::asn1::ObjectIdentifier::new_unwrap("1.2.840.113549.1.9.14");
/// The OID of challengePassword (PKCS #9).
const CHALLENGE: x509_cert::der::asn1::ObjectIdentifier =
    x509_cert::der::asn1::ObjectIdentifier::new_unwrap("1.2.840.113549.1.9.7");
const ALTERNATIVE_NAMES: x509_cert::der::asn1::ObjectIdentifier =
    x509_cert::der::asn1::ObjectIdentifier::new_unwrap("2.5.29.17");
