//! SHA-256 fingerprints of certificates, keys and secrets.

use std::fmt;
use std::str::FromStr;

use rsa::sha2::{Digest as _, Sha256};
use x509_cert::der::Encode as _;
use x509_cert::spki::SubjectPublicKeyInfoOwned;

/// A SHA-256 digest, formatted as 64 hexadecimal digits. Parsing also accepts colons between the
/// digits, in the format of `openssl x509 -fingerprint`.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Fingerprint([u8; 32]);

impl Fingerprint {
    /// Returns the SHA-256 of bytes.
    #[must_use]
    pub fn of(bytes: &[u8]) -> Self {
        Self(Sha256::digest(bytes).into())
    }

    pub(crate) fn of_key(key: &SubjectPublicKeyInfoOwned) -> Self {
        // A key that was decoded can be encoded.
        Self::of(&key.to_der().unwrap_or_default())
    }

    /// Compares with the digest of a secret, in constant time.
    #[must_use]
    pub fn is_of_secret(&self, secret: &[u8]) -> bool {
        let other = Self::of(secret);
        let pairs = self.0.iter().zip(other.0);
        pairs.fold(0, |all, (own, other)| all | (own ^ other)) == 0
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// The text is not a SHA-256 digest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a SHA-256 fingerprint has 64 hexadecimal digits")]
pub struct NoFingerprint;

impl FromStr for Fingerprint {
    type Err = NoFingerprint;

    fn from_str(text: &str) -> Result<Self, NoFingerprint> {
        let digits: Vec<u8> = text.bytes().filter(|byte| *byte != b':').collect();
        let (pairs, []) = digits.as_chunks::<2>() else {
            return Err(NoFingerprint);
        };
        let byte = |pair: &[u8; 2]| {
            let digit = |byte: u8| char::from(byte).to_digit(16);
            let [high, low] = pair.map(digit);
            u8::try_from(high? * 16 + low?).ok()
        };
        let bytes: Option<Vec<u8>> = pairs.iter().map(byte).collect();
        let bytes = bytes.and_then(|bytes| bytes.try_into().ok());
        bytes.map(Self).ok_or(NoFingerprint)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fingerprint_is_read_as_it_is_written_and_with_colons() {
        let one = Fingerprint::of(b"abc");
        let text = one.to_string();
        assert!(text.starts_with("ba7816bf"), "{text}");
        assert_eq!(text.parse(), Ok(one));
        let pairs: Vec<&str> = text
            .as_bytes()
            .chunks(2)
            .map(|pair| std::str::from_utf8(pair).unwrap())
            .collect();
        assert_eq!(pairs.join(":").to_uppercase().parse(), Ok(one));
        for wrong in [
            "",
            "ba",
            &text[1..],
            &format!("{text}00"),
            &text.replace('b', "g"),
        ] {
            assert_eq!(wrong.parse::<Fingerprint>(), Err(NoFingerprint), "{wrong}");
        }
        assert!(one.is_of_secret(b"abc") && !one.is_of_secret(b"abd"));
    }
}
