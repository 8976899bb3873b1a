//! Errors of keys, of opening messages and of sealing messages.

use super::SecurityPolicy;

/// Reason why keys were rejected. The previous keys stay in use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum KeyError {
    /// The key data does not have the length that the policy requires.
    #[error("{found} bytes of key data, {expected} expected for {policy:?}")]
    Length {
        /// Policy of the key data.
        policy: SecurityPolicy,
        /// [`SecurityPolicy::key_data_length`].
        expected: usize,
        /// Bytes of the key data.
        found: usize,
    },
    /// The SecurityTokenId is 0, which means "no SecurityTokenId".
    #[error("0 is not a valid SecurityTokenId")]
    TokenId,
    /// The number of keys, which is 0 or exceeds the limit.
    #[error("{0} keys given at once")]
    Count(usize),
}

/// Reason why a message was not opened. The state of the [`Opener`](crate::Opener) is unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum SecurityError {
    /// The message is neither signed nor encrypted, or was opened already.
    #[error("the message is not secured")]
    Unsecured,
    /// The message is encrypted but not signed; the standard has no such mode (OPC 10000-14,
    /// 7.2.4.4.2).
    #[error("the message is encrypted but not signed")]
    Unsigned,
    /// The message is signed, but not encrypted as required.
    #[error("the message is not encrypted")]
    Unencrypted,
    /// The MessageNonce has this many bytes instead of 8.
    #[error("a nonce of {0} bytes")]
    NonceLength(usize),
    /// The message is too short for its signature and footer.
    #[error("{found} bytes behind the headers, {expected} expected for footer and signature")]
    Truncated {
        /// Bytes of footer and signature.
        expected: usize,
        /// Bytes behind the headers.
        found: usize,
    },
    /// The encrypted part has this many bytes, 4 GiB or more.
    #[error("{0} bytes of payload exceed the limit")]
    TooLong(usize),
    /// There is no key for this SecurityTokenId, so the known keys may be outdated. The sender of
    /// the message is not verified: limit the rate of requests to the Security Key Service that
    /// such messages cause.
    #[error("no key for the SecurityTokenId {0}")]
    UnknownToken(u32),
    /// The key of this SecurityTokenId was removed because newer keys are in use.
    #[error("the SecurityTokenId {0} has expired")]
    RetiredToken(u32),
    /// The message was not signed with the key, or was changed.
    #[error("wrong signature")]
    Signature,
    /// A message with this sequence number was accepted before.
    #[error("repeated sequence number {0}")]
    Replayed(u32),
    /// The sequence number is so far behind the newest that a repetition cannot be detected.
    #[error("sequence number {sequence} is too far behind {newest}")]
    TooOld {
        /// Sequence number of the message.
        sequence: u32,
        /// Highest accepted sequence number.
        newest: u32,
    },
    /// The sequence number is so far ahead of the newest that the standard declares it invalid
    /// (OPC 10000-14, 7.2.3).
    #[error("sequence number {sequence} is too far ahead of {newest}")]
    TooFarAhead {
        /// Sequence number of the message.
        sequence: u32,
        /// Highest accepted sequence number.
        newest: u32,
    },
    /// The publisher is new, and the limit of publishers is reached.
    #[error("too many publishers")]
    TooManyPublishers,
}

/// Reason why a message cannot be sealed until there are new keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum SealError {
    /// There are no keys.
    #[error("no keys for securing messages")]
    NoKeys,
    /// All sequence numbers of the key with this SecurityTokenId are used.
    #[error("no sequence number is left for the SecurityTokenId {0}")]
    Exhausted(u32),
}
