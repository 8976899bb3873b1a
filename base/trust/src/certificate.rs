//! X.509 certificates and their fields.

use std::fmt;
use std::time::Duration;

use rsa::pkcs1v15::{Signature, VerifyingKey};
use rsa::pkcs8::DecodePrivateKey as _;
use rsa::sha2::{Digest as _, Sha256, Sha384, Sha512};
use rsa::signature::Verifier as _;
use rsa::traits::PublicKeyParts as _;
use rsa::{RsaPrivateKey, RsaPublicKey};
use x509_cert::attr::AttributeTypeAndValue;
use x509_cert::der::asn1::{Any, BitString, ObjectIdentifier, SetOfVec};
use x509_cert::der::{Decode as _, DecodePem as _, Encode as _, EncodePem as _, Tag};
use x509_cert::ext::pkix::name::GeneralName;
use x509_cert::ext::pkix::{BasicConstraints, ExtendedKeyUsage, KeyUsage, SubjectAltName};
use x509_cert::name::{Name, RelativeDistinguishedName};
use x509_cert::spki::AlgorithmIdentifierOwned;

use crate::{Fingerprint, Unfit};

/// The serial number of a certificate, unique for its authority.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Serial(Vec<u8>);

impl Serial {
    /// Creates a positive serial number from 16 random bytes.
    #[must_use]
    pub fn random(mut bytes: [u8; 16]) -> Self {
        bytes[0] = (bytes[0] & 0x7f) | 0x40;
        Self(bytes.to_vec())
    }

    /// Creates a serial number from big-endian bytes.
    #[must_use]
    pub fn of(bytes: &[u8]) -> Self {
        let zeros = bytes.iter().take_while(|byte| **byte == 0).count();
        Self(bytes.get(zeros..).unwrap_or_default().to_vec())
    }

    /// Parses hexadecimal digits, in the format of [`fmt::Display`].
    #[must_use]
    pub fn parse(digits: &str) -> Option<Self> {
        if digits.is_empty() || !digits.len().is_multiple_of(2) || digits.len() > 40 {
            return None;
        }
        let pairs = digits.as_bytes().chunks(2);
        let bytes: Option<Vec<u8>> = pairs
            .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok())
            .collect();
        bytes.map(|bytes| Self::of(&bytes))
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &self.0
    }
}

impl fmt::Display for Serial {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Serial {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// An X.509 certificate. Certificates with the same bytes are equal.
#[derive(Clone)]
pub struct Certificate {
    pub(crate) inner: x509_cert::Certificate,
    der: Vec<u8>,
}

impl PartialEq for Certificate {
    fn eq(&self, other: &Self) -> bool {
        self.der == other.der
    }
}

impl Eq for Certificate {}

impl fmt::Debug for Certificate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Certificate({} of {:?})", self.serial(), self.name())
    }
}

impl Certificate {
    /// Reads a certificate in DER or PEM.
    ///
    /// # Errors
    /// Returns an error if the bytes are neither.
    pub fn read(bytes: &[u8]) -> Result<Self, Unfit> {
        let inner = if bytes.starts_with(b"-----BEGIN") {
            x509_cert::Certificate::from_pem(bytes)
        } else {
            x509_cert::Certificate::from_der(bytes)
        };
        Self::of(inner.map_err(|_| Unfit::Unreadable)?)
    }

    /// Reads a certificate chain in DER, with the certificates concatenated (OPC 10000-6, 6.2.6):
    /// the certificate itself, then its issuer certificates.
    ///
    /// # Errors
    /// Returns an error if the chain is empty or contains other data.
    pub fn read_chain(bytes: &[u8]) -> Result<(Self, Vec<Self>), Unfit> {
        let mut rest = bytes;
        let mut all = Vec::new();
        while !rest.is_empty() && all.len() < LONGEST_CHAIN {
            let length = der_length(rest).ok_or(Unfit::Unreadable)?;
            let (one, behind) = rest.split_at_checked(length).ok_or(Unfit::Unreadable)?;
            all.push(Self::read(one)?);
            rest = behind;
        }
        if all.is_empty() || !rest.is_empty() {
            return Err(Unfit::Unreadable);
        }
        let own = all.remove(0);
        Ok((own, all))
    }

    pub(crate) fn of(inner: x509_cert::Certificate) -> Result<Self, Unfit> {
        let der = inner.to_der().map_err(|_| Unfit::Unreadable)?;
        Ok(Self { inner, der })
    }

    /// Returns the DER encoding.
    #[must_use]
    pub fn der(&self) -> &[u8] {
        &self.der
    }

    /// Returns the SHA-256 of the DER.
    #[must_use]
    pub fn fingerprint(&self) -> Fingerprint {
        Fingerprint::of(&self.der)
    }

    /// Returns the SHA-256 of the public key.
    #[must_use]
    pub fn key_fingerprint(&self) -> Fingerprint {
        Fingerprint::of_key(&self.inner.tbs_certificate.subject_public_key_info)
    }

    /// Returns the PEM encoding.
    #[must_use]
    pub fn pem(&self) -> String {
        // A certificate that was decoded can be encoded.
        self.inner
            .to_pem(x509_cert::der::pem::LineEnding::LF)
            .unwrap_or_default()
    }

    /// Returns the serial number.
    #[must_use]
    pub fn serial(&self) -> Serial {
        Serial::of(self.inner.tbs_certificate.serial_number.as_bytes())
    }

    /// Returns the common name of its subject; empty without a common name. The requester of the
    /// certificate chose it freely.
    #[must_use]
    pub fn name(&self) -> String {
        common_name(&self.inner.tbs_certificate.subject)
    }

    /// Returns the common name of its issuer.
    #[must_use]
    pub fn issuer_name(&self) -> String {
        common_name(&self.inner.tbs_certificate.issuer)
    }

    /// Returns the ApplicationUri: the first URI of its subject alternative names (OPC 10000-6,
    /// 6.2.2).
    #[must_use]
    pub fn application_uri(&self) -> Option<String> {
        let (uri, _) = alternative(&self.names()?);
        uri
    }

    /// Returns the hosts of its subject alternative names: DNS names and IP addresses.
    #[must_use]
    pub fn hosts(&self) -> Vec<String> {
        self.names()
            .map(|names| alternative(&names).1)
            .unwrap_or_default()
    }

    /// Returns whether the certificate names this host: a DNS name, ignoring case, or an IP
    /// address.
    #[must_use]
    pub fn is_for_host(&self, host: &str) -> bool {
        let host = host.trim_matches(['[', ']']).trim_end_matches('.');
        // An IP address has several notations.
        let address = host.parse::<std::net::IpAddr>();
        let host = address.map_or_else(|_| host.to_owned(), |address| address.to_string());
        self.hosts()
            .iter()
            .any(|one| one.eq_ignore_ascii_case(&host))
    }

    /// Returns the start and the end of its validity.
    #[must_use]
    pub fn validity(&self) -> (Duration, Duration) {
        let validity = &self.inner.tbs_certificate.validity;
        (
            validity.not_before.to_unix_duration(),
            validity.not_after.to_unix_duration(),
        )
    }

    /// Returns whether it is valid at this time.
    #[must_use]
    pub fn is_valid_at(&self, now: Duration) -> bool {
        let (from, until) = self.validity();
        (from..=until).contains(&now)
    }

    /// Returns whether it belongs to an authority, which may issue certificates.
    #[must_use]
    pub fn is_authority(&self) -> bool {
        self.constraints().is_some_and(|one| one.ca)
    }

    /// Returns whether it is self-signed.
    #[must_use]
    pub fn is_self_signed(&self) -> bool {
        self.is_named_issuer_of(self) && self.has_signed(self)
    }

    /// Returns the bits of its RSA key; `None` for other keys.
    #[must_use]
    pub fn key_bits(&self) -> Option<usize> {
        Some(self.public_key()?.size() * 8)
    }

    /// Returns whether it has this public key.
    #[must_use]
    pub fn has_key_of(&self, key: &RsaPublicKey) -> bool {
        self.public_key().is_some_and(|own| own == *key)
    }

    /// Returns whether it belongs to this private key, in the DER of PKCS #8.
    #[must_use]
    pub fn is_of_private_key(&self, key: &[u8]) -> bool {
        let key = RsaPrivateKey::from_pkcs8_der(key);
        key.is_ok_and(|key| self.has_key_of(&key.to_public_key()))
    }

    /// Returns whether its subject is the issuer of `other`.
    pub(crate) fn is_named_issuer_of(&self, other: &Self) -> bool {
        self.inner.tbs_certificate.subject == other.inner.tbs_certificate.issuer
    }

    /// Returns whether its key signed `other`.
    pub(crate) fn has_signed(&self, other: &Self) -> bool {
        let Ok(signed) = other.inner.tbs_certificate.to_der() else {
            return false;
        };
        self.verify(
            &signed,
            &other.inner.signature_algorithm,
            &other.inner.signature,
        )
    }

    /// Returns whether its key made a signature.
    pub(crate) fn verify(
        &self,
        signed: &[u8],
        algorithm: &AlgorithmIdentifierOwned,
        signature: &BitString,
    ) -> bool {
        self.public_key()
            .is_some_and(|key| verify(key, signed, algorithm, signature))
    }

    pub(crate) fn public_key(&self) -> Option<RsaPublicKey> {
        use x509_cert::der::referenced::OwnedToRef as _;
        let info = &self.inner.tbs_certificate.subject_public_key_info;
        RsaPublicKey::try_from(info.owned_to_ref()).ok()
    }

    pub(crate) fn constraints(&self) -> Option<BasicConstraints> {
        Some(
            self.inner
                .tbs_certificate
                .get::<BasicConstraints>()
                .ok()??
                .1,
        )
    }

    /// Returns the key usage; `None` without this extension.
    pub(crate) fn usage(&self) -> Option<KeyUsage> {
        Some(self.inner.tbs_certificate.get::<KeyUsage>().ok()??.1)
    }

    /// Returns whether it may belong to an application: the extended key usage, if present, permits
    /// clients or servers.
    pub(crate) fn is_for_applications(&self) -> bool {
        match self.inner.tbs_certificate.get::<ExtendedKeyUsage>() {
            Ok(None) => true,
            Ok(Some((_, ExtendedKeyUsage(all)))) => all
                .iter()
                .any(|one| [CLIENT_AUTH, SERVER_AUTH, ANY_USAGE].contains(one)),
            Err(_) => false,
        }
    }

    /// Returns whether its signature algorithm is secure.
    pub(crate) fn has_strong_signature(&self) -> bool {
        [SHA256, SHA384, SHA512].contains(&self.inner.signature_algorithm.oid)
    }

    fn names(&self) -> Option<SubjectAltName> {
        Some(self.inner.tbs_certificate.get::<SubjectAltName>().ok()??.1)
    }
}

/// Returns whether a key made a signature.
pub(crate) fn verify(
    key: RsaPublicKey,
    signed: &[u8],
    algorithm: &AlgorithmIdentifierOwned,
    signature: &BitString,
) -> bool {
    let Some(signature) = signature
        .as_bytes()
        .and_then(|bytes| Signature::try_from(bytes).ok())
    else {
        return false;
    };
    match algorithm.oid {
        SHA256 => VerifyingKey::<Sha256>::new(key)
            .verify(signed, &signature)
            .is_ok(),
        SHA384 => VerifyingKey::<Sha384>::new(key)
            .verify(signed, &signature)
            .is_ok(),
        SHA512 => VerifyingKey::<Sha512>::new(key)
            .verify(signed, &signature)
            .is_ok(),
        _ => false,
    }
}

/// Returns the ApplicationUri and the hosts of subject alternative names.
pub(crate) fn alternative(names: &SubjectAltName) -> (Option<String>, Vec<String>) {
    let mut uri = None;
    let mut hosts = Vec::new();
    for name in &names.0 {
        match name {
            GeneralName::UniformResourceIdentifier(one) => {
                uri.get_or_insert_with(|| one.as_str().to_owned());
            }
            GeneralName::DnsName(one) => hosts.push(one.as_str().to_owned()),
            GeneralName::IpAddress(bytes) => hosts.extend(address(bytes.as_bytes())),
            GeneralName::OtherName(_)
            | GeneralName::Rfc822Name(_)
            | GeneralName::DirectoryName(_)
            | GeneralName::EdiPartyName(_)
            | GeneralName::RegisteredId(_) => {}
        }
    }
    (uri, hosts)
}

fn address(bytes: &[u8]) -> Option<String> {
    if let Ok(four) = <[u8; 4]>::try_from(bytes) {
        return Some(std::net::Ipv4Addr::from(four).to_string());
    }
    let sixteen = <[u8; 16]>::try_from(bytes).ok()?;
    Some(std::net::Ipv6Addr::from(sixteen).to_string())
}

/// Returns the last common name of a distinguished name.
pub(crate) fn common_name(name: &Name) -> String {
    let each = name.0.iter().flat_map(|part| part.0.iter());
    let mut named = each.filter(|one| one.oid == COMMON_NAME);
    // All string types are accepted.
    let text = named
        .next_back()
        .map(|one| String::from_utf8_lossy(one.value.value()).into_owned());
    text.unwrap_or_default()
}

/// Creates a distinguished name from its parts, the most general part first.
pub(crate) fn name_of(parts: &[(ObjectIdentifier, &str)]) -> Result<Name, Unfit> {
    let mut all = Vec::new();
    for (oid, text) in parts.iter().filter(|(_, text)| !text.is_empty()) {
        if text.len() > LONGEST_NAME {
            return Err(Unfit::Name);
        }
        let value = Any::new(Tag::Utf8String, text.as_bytes()).map_err(|_| Unfit::Name)?;
        let one = AttributeTypeAndValue { oid: *oid, value };
        let set = SetOfVec::try_from(vec![one]).map_err(|_| Unfit::Name)?;
        all.push(RelativeDistinguishedName(set));
    }
    Ok(x509_cert::name::RdnSequence(all))
}

/// Returns the identifier of a key: the first 160 bits of its hash (RFC 7093, 2, method 1).
pub(crate) fn key_id(key: &[u8]) -> Vec<u8> {
    let hash = Sha256::digest(key);
    hash.iter().take(20).copied().collect()
}

/// Returns the length in bytes of the first DER element.
fn der_length(bytes: &[u8]) -> Option<usize> {
    let (tag, rest) = bytes.split_first()?;
    let (first, rest) = rest.split_first()?;
    if *tag != 0x30 {
        return None;
    }
    if *first < 0x80 {
        return Some(usize::from(*first) + 2);
    }
    let count = usize::from(first & 0x7f);
    let digits = rest
        .get(..count)
        .filter(|digits| (1..=3).contains(&digits.len()))?;
    let length = digits
        .iter()
        .fold(0, |sum, digit| (sum << 8) | usize::from(*digit));
    length.checked_add(2 + count)
}

pub(crate) const SHA256: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.113549.1.1.11");
const SHA384: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.113549.1.1.12");
const SHA512: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.113549.1.1.13");
pub(crate) const COMMON_NAME: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.4.3");
pub(crate) const ORGANIZATION: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.4.10");
pub(crate) const SERVER_AUTH: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.5.5.7.3.1");
pub(crate) const CLIENT_AUTH: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.5.5.7.3.2");
const ANY_USAGE: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.29.37.0");
/// Maximum number of certificates of a chain.
pub(crate) const LONGEST_CHAIN: usize = 10;
/// Maximum number of bytes of a part of a name that other stacks accept (RFC 5280, appendix A).
const LONGEST_NAME: usize = 64;
