//! Why keys, a message to open or a message to seal are refused.

use super::SecurityPolicy;

/// Why keys were not taken. What there was before stays in use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum KeyError {
    /// The key data is not as long as the policy has it.
    #[error("{found} bytes of key data, {expected} expected for {policy:?}")]
    Length {
        /// What the key data was said to be for.
        policy: SecurityPolicy,
        /// [`SecurityPolicy::key_data_length`].
        expected: usize,
        /// Bytes given.
        found: usize,
    },
    /// 0 stands for "no SecurityTokenId".
    #[error("0 is no SecurityTokenId")]
    TokenId,
    /// So many keys: none, or more than are kept.
    #[error("{0} keys given at once")]
    Count(usize),
}

/// Why a message was not opened. Nothing was taken from it, and the [`Opener`](crate::Opener) is as it was.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum SecurityError {
    /// Neither signed nor encrypted, or opened already.
    #[error("the message is not secured")]
    Unsecured,
    /// Encrypted, yet not signed, which the standard has no mode for (OPC 10000-14, 7.2.4.4.2).
    #[error("the message is encrypted but not signed")]
    Unsigned,
    /// Signed, and to be encrypted as well.
    #[error("the message is not encrypted")]
    Unencrypted,
    /// The MessageNonce has so many bytes instead of 8.
    #[error("a nonce of {0} bytes")]
    NonceLength(usize),
    /// Too short for its signature and footer.
    #[error("{found} bytes behind the headers, {expected} expected for footer and signature")]
    Truncated {
        /// Bytes of footer and signature.
        expected: usize,
        /// Bytes there are.
        found: usize,
    },
    /// So many bytes to decrypt: 4 GiB or more.
    #[error("{0} bytes of payload are too many")]
    TooLong(usize),
    /// No key for this SecurityTokenId: those known may be out of date. Nothing tells whether a member of the group
    /// has sent this, so limit how often you ask the Security Key Service because of it.
    #[error("no key for the SecurityTokenId {0}")]
    UnknownToken(u32),
    /// The key of this SecurityTokenId was let go since newer ones are in use.
    #[error("the SecurityTokenId {0} is out of use")]
    RetiredToken(u32),
    /// Not written with the key, or changed since.
    #[error("the signature is wrong")]
    Signature,
    /// A message with this sequence number was accepted already.
    #[error("sequence number {0} for the second time")]
    Replayed(u32),
    /// So far behind the newest message that nothing tells whether it came before.
    #[error("sequence number {sequence} is too far behind {newest}")]
    TooOld {
        /// Of the message.
        sequence: u32,
        /// The highest accepted.
        newest: u32,
    },
    /// So far ahead of the newest message that the standard calls it invalid (OPC 10000-14, 7.2.3).
    #[error("sequence number {sequence} is too far ahead of {newest}")]
    TooFarAhead {
        /// Of the message.
        sequence: u32,
        /// The highest accepted.
        newest: u32,
    },
    /// As many publishers are followed as may be, and this is one more.
    #[error("too many publishers")]
    TooManyPublishers,
}

/// Why there is no seal for another message: there have to be new keys first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum SealError {
    /// No keys were given.
    #[error("no keys to secure messages with")]
    NoKeys,
    /// Every sequence number was used with the key of this SecurityTokenId.
    #[error("no sequence number is left for the SecurityTokenId {0}")]
    Exhausted(u32),
}
