//! Message security: signatures and encryption of NetworkMessages (OPC 10000-14, 7.2.4.4.3).
//!
//! The keys of a SecurityGroup are a list of [`TokenKeys`], each with a SecurityTokenId, which the
//! members of the group get from a Security Key Service. A Subscriber has an [`Opener`] for the
//! group, a Publisher has a [`Sealer`].

mod error;
mod keys;
mod opener;
mod replay;
mod ring;
mod sealer;
mod securing;

pub use error::{KeyError, SealError, SecurityError};
pub use keys::TokenKeys;
pub use opener::{CountedBy, OpenedMessage, Opener, OpenerOptions};
pub use sealer::{Seal, Sealer};

/// Algorithms of a SecurityGroup: HMAC-SHA2-256 signs, AES in counter mode encrypts (OPC 10000-7).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SecurityPolicy {
    /// AES with keys of 128 bits.
    PubSubAes128Ctr,
    /// AES with keys of 256 bits.
    PubSubAes256Ctr,
}

/// Security mode of messages; with `MessageSecurityMode.None` there is neither an [`Opener`] nor a
/// [`Sealer`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum SecurityMode {
    /// Messages are signed by members of the group and readable without keys.
    Sign,
    /// Payload and footer are also encrypted; the headers are never encrypted.
    SignAndEncrypt,
}

impl SecurityPolicy {
    /// Returns the SecurityPolicyUri.
    #[must_use]
    pub const fn uri(self) -> &'static str {
        match self {
            Self::PubSubAes128Ctr => AES128_URI,
            Self::PubSubAes256Ctr => AES256_URI,
        }
    }

    /// Returns the policy of a SecurityPolicyUri, or `None` if it is not a PubSub policy.
    #[must_use]
    pub fn from_uri(uri: &str) -> Option<Self> {
        match uri {
            AES128_URI => Some(Self::PubSubAes128Ctr),
            AES256_URI => Some(Self::PubSubAes256Ctr),
            _ => None,
        }
    }

    /// Returns the length of the key data of a SecurityTokenId: SigningKey, EncryptingKey and
    /// KeyNonce.
    #[must_use]
    pub const fn key_data_length(self) -> usize {
        SIGNING_KEY + self.encrypting_key_length() + KEY_NONCE
    }

    const fn encrypting_key_length(self) -> usize {
        match self {
            Self::PubSubAes128Ctr => 16,
            Self::PubSubAes256Ctr => 32,
        }
    }
}

const AES128_URI: &str = "http://opcfoundation.org/UA/SecurityPolicy#PubSub-Aes128-CTR";
const AES256_URI: &str = "http://opcfoundation.org/UA/SecurityPolicy#PubSub-Aes256-CTR";

/// Bytes of the SigningKey and of the KeyNonce (OPC 10000-14, 7.2.4.4.3.1).
const SIGNING_KEY: usize = 32;
const KEY_NONCE: usize = 4;
/// Bytes of the MessageNonce: 4 random bytes, and the sequence number as UInt32 (OPC 10000-14,
/// 7.2.4.4.3.2).
const MESSAGE_NONCE: usize = 8;
/// Bytes of the signature.
const SIGNATURE: usize = 32;

/// A MessageNonce.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Nonce {
    random: [u8; 4],
    sequence: u32,
}

impl Nonce {
    const fn from_bytes([a, b, c, d, sequence @ ..]: [u8; MESSAGE_NONCE]) -> Self {
        Self {
            random: [a, b, c, d],
            sequence: u32::from_le_bytes(sequence),
        }
    }

    const fn to_bytes(self) -> [u8; MESSAGE_NONCE] {
        let [a, b, c, d] = self.random;
        let [e, f, g, h] = self.sequence.to_le_bytes();
        [a, b, c, d, e, f, g, h]
    }
}
