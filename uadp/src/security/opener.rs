//! The receiving side: verifies messages, rejects replayed messages, decrypts payloads.

use alloc::vec::Vec;
use core::time::Duration;

use super::replay::{Accepted, StreamId, Streams};
use super::ring::TokenKeyRing;
use super::{KeyError, Nonce, SIGNATURE, SecurityError, SecurityMode, TokenKeys};
use crate::{NetworkMessage, NetworkMessageType, SecurityHeader};

/// Opens the secured messages of a SecurityGroup (OPC 10000-14, 7.2.4.4.3).
///
/// A message is accepted once, if it is at least as secure as the [`SecurityMode`], its signature
/// is valid and its sequence number is new. For each PublisherId, WriterGroupId and SecurityTokenId
/// the opener keeps a window of the newest 128 sequence numbers, so that messages may arrive in any
/// order. Publishers without PublisherId share a window. The state changes only after the signature
/// is verified, and never for a rejected message.
///
/// The first message with a future key makes this key current. A number of past keys stay valid
/// ([`OpenerOptions::past_keys`]).
///
/// A receiver cannot detect the replay of a message that was recorded before the receiver had its
/// keys.
///
/// # Examples
/// ```
/// use std::time::Duration;
/// use uadp::{TokenKeys, NetworkMessage, Opener, SecurityMode, SecurityPolicy};
///
/// // SigningKey 01 02 .. 20, EncryptingKey a0 a1 .. af, KeyNonce 10 11 12 13
/// let key_data: Vec<u8> = (1..=32).chain(0xA0..=0xAF).chain(0x10..=0x13).collect();
/// let keys = TokenKeys::from_bytes(SecurityPolicy::PubSubAes128Ctr, &key_data)?;
/// let mut opener = Opener::new(SecurityMode::SignAndEncrypt);
/// opener.update_keys(1, [keys])?;
///
/// let datagram = [
///     0xF1, 0x11, 0xBA, 0x08, 0x01, 0x64, 0x00, 0x01, 0x01, 0x00, // headers up to the DataSetWriterId
///     0x03, 0x01, 0x00, 0x00, 0x00, // signed and encrypted with the keys of token 1
///     0x08, 0xE5, 0xA9, 0x4D, 0xC9, 0x01, 0x00, 0x00, 0x00, // nonce: 4 random bytes, sequence number 1
///     0xC4, 0x16, 0x3B, 0xE7, 0xC7, 0x5D, 0x25, 0x87, 0x3A, 0x70, 0xBA, 0x8F, 0x6A, 0xA7, 0x97, 0xCE, // ciphertext
///     0x4A, 0x92, 0xF4, 0xBB, 0xAF, 0x3A, 0x63, 0xE2, 0x3F, 0x1B, 0xA6, 0xDA,
///     0xC2, 0x66, 0xF1, 0x8F, 0x2D, 0x18, 0xB2, 0x5E, 0xC1, 0xFD, 0x71, 0x53, 0x8B, 0xC7, 0xD2, 0x46, // signature
///     0x19, 0x95, 0xBD, 0x3A, 0x64, 0xAE, 0xCB, 0x6F, 0x3C, 0x0E, 0xEB, 0x84, 0x7F, 0x18, 0xD2, 0xBA,
/// ];
/// let sealed = NetworkMessage::decode(&datagram)?;
/// let mut scratch = Vec::new(); // kept from message to message
/// let opened = opener.open(&sealed, Duration::ZERO, &mut scratch)?;
/// let message = opened.message.messages().next().unwrap()?;
/// assert_eq!(message.header().sequence_number, Some(0));
/// assert_eq!(message.fields()?.len(), 3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Opener {
    mode: SecurityMode,
    options: OpenerOptions,
    ring: TokenKeyRing<Streams>,
}

/// Limits and options of an [`Opener`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OpenerOptions {
    /// Number of past keys that stay valid, for publishers that change their key later and for
    /// delayed messages. Default 2.
    pub past_keys: usize,
    /// Maximum number of pairs of PublisherId and WriterGroupId for each key. At the limit, other
    /// publishers are rejected with [`SecurityError::TooManyPublishers`]: if a publisher were
    /// removed instead, its messages could be replayed. Only members of the group count. Default
    /// 1024.
    pub max_streams: usize,
    /// Time without an accepted message after which a publisher may restart its sequence numbers.
    /// The standard requires twice the KeepAliveTime, for publishers that do not continue from the
    /// last sequence number after a restart (OPC 10000-14, 7.2.3). After such a pause, recorded
    /// messages of the publisher can be replayed. With the default `None`, a restarted publisher is
    /// rejected until there are new keys.
    pub forget_after: Option<Duration>,
    /// Messages that share a sequence. Default [`CountedBy::Publisher`].
    pub counted_by: CountedBy,
    /// Accepts publishers with the constant sequence number 1, as in open62541 up to version 1.5.7.
    /// Their messages are marked [`OpenedMessage::constant_sequence`] and can be replayed, except
    /// the last message. Default `false`.
    pub accept_constant_sequence: bool,
}

/// Messages that share a sequence of sequence numbers.
///
/// Several programs may send with the same PublisherId and WriterGroupId and separate sequence
/// numbers: Requestors of Actions send with the ids of the Responder, and programs that probe send
/// with the ids of the Publisher. If a sender keeps the random half of its nonces until it
/// restarts, that half identifies the sender, because the signature covers the nonce. Its messages
/// cannot be replayed while it is tracked, and it may restart its sequence numbers with a new
/// random half.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CountedBy {
    /// Messages of a PublisherId and WriterGroupId, as in the standard (OPC 10000-14, 7.2.3).
    Publisher,
    /// As `Publisher`, but for Actions, probes and announcements the messages of a sender.
    PublisherOrSender,
    /// Messages of a sender. A sender with new random bytes for each message uses an entry for each
    /// message.
    Sender,
}

/// An opened message, and events that it causes.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct OpenedMessage<'a> {
    /// The message with readable payload and footer.
    pub message: NetworkMessage<'a>,
    /// The message is the first with a future key, which is the current key from then on.
    pub key_changed: bool,
    /// The publisher is about to replace all present keys: get new keys (OPC 10000-14, 7.2.4.4.2).
    pub force_key_reset: bool,
    /// The publisher does not increment the sequence number, see
    /// [`OpenerOptions::accept_constant_sequence`]. Log a warning: if its random bytes repeat, its
    /// key stream repeats.
    pub constant_sequence: bool,
}

impl Default for OpenerOptions {
    fn default() -> Self {
        Self {
            past_keys: 2,
            max_streams: 1024,
            forget_after: None,
            counted_by: CountedBy::Publisher,
            accept_constant_sequence: false,
        }
    }
}

impl Opener {
    /// Creates an opener without keys. It rejects messages that are less secure than `mode`, and
    /// accepts messages that are more secure.
    #[must_use]
    pub fn new(mode: SecurityMode) -> Self {
        Self::with(mode, OpenerOptions::default())
    }

    /// Creates an opener with options, as [`new`](Self::new).
    #[must_use]
    pub const fn with(mode: SecurityMode, options: OpenerOptions) -> Self {
        Self {
            mode,
            options,
            ring: TokenKeyRing::new(options.past_keys),
        }
    }

    /// Adds the keys of GetSecurityKeys or SetSecurityKeys: keys with consecutive SecurityTokenIds
    /// from `first_token_id` on. The highest SecurityTokenId is followed by 1 (OPC 10000-14, 8.3.2
    /// and 9.1.3.3).
    ///
    /// If any of the keys is known, the new keys are added, and the first key becomes current
    /// unless a newer key is current. Removed past keys are not added again. If all keys are new,
    /// they replace all present keys.
    ///
    /// # Errors
    /// [`KeyError::TokenId`] if `first_token_id` is 0; [`KeyError::Count`] for no keys and for more
    /// than 64.
    pub fn update_keys(
        &mut self,
        first_token_id: u32,
        keys: impl IntoIterator<Item = TokenKeys>,
    ) -> Result<(), KeyError> {
        self.ring.update(first_token_id, keys)
    }

    /// Returns the SecurityTokenId of the current key, or `None` without keys.
    #[must_use]
    pub fn current_token_id(&self) -> Option<u32> {
        self.ring.current_token_id()
    }

    /// Returns the SecurityTokenId of the next key. `None` means that it is time to get more keys.
    #[must_use]
    pub fn next_token_id(&self) -> Option<u32> {
        self.ring.next_token_id()
    }

    /// Verifies a message, and decrypts an encrypted message into `scratch`. A message that is only
    /// signed is read in place. `now` counts from any fixed time.
    ///
    /// # Errors
    /// The reason why the message is rejected.
    pub fn open<'a>(
        &mut self,
        message: &NetworkMessage<'a>,
        now: Duration,
        scratch: &'a mut Vec<u8>,
    ) -> Result<OpenedMessage<'a>, SecurityError> {
        let header = self.checked_header(message)?;
        let nonce = read_nonce(header.nonce)?;
        let parts = Parts::of(message, &header)?;
        let token_id = header.token_id;
        let Some(entry) = self.ring.get_mut(token_id) else {
            return Err(if self.ring.is_retired(token_id) {
                SecurityError::RetiredToken(token_id)
            } else {
                SecurityError::UnknownToken(token_id)
            });
        };
        if !entry.keys.verify(parts.signed, parts.signature) {
            return Err(SecurityError::Signature);
        }
        let accepted = entry.state.accept(
            stream_id(message, nonce, self.options.counted_by),
            nonce,
            now,
            &self.options,
        )?;
        let body = if header.encrypted {
            decrypt(&entry.keys, nonce, parts.body, scratch)?
        } else {
            parts.body
        };
        let (payload, footer) = body
            .split_at_checked(parts.footer_at)
            .unwrap_or((body, &[]));
        Ok(OpenedMessage {
            message: message.opened(payload, footer),
            key_changed: self.ring.advance(token_id),
            force_key_reset: header.force_key_reset,
            constant_sequence: accepted == Accepted::Uncounted,
        })
    }

    /// Returns the SecurityHeader if it satisfies the security mode.
    fn checked_header<'a>(
        &self,
        message: &NetworkMessage<'a>,
    ) -> Result<SecurityHeader<'a>, SecurityError> {
        let sealed = message.security().filter(|_| message.is_sealed());
        let header = sealed.ok_or(SecurityError::Unsecured)?;
        if !header.signed {
            return Err(SecurityError::Unsigned);
        }
        if !header.encrypted && self.mode >= SecurityMode::SignAndEncrypt {
            return Err(SecurityError::Unencrypted);
        }
        Ok(header)
    }
}

/// Parts of a sealed message.
struct Parts<'a> {
    /// All bytes except the signature.
    signed: &'a [u8],
    signature: &'a [u8],
    /// Payload and footer, possibly encrypted.
    body: &'a [u8],
    /// Offset of the footer in the body.
    footer_at: usize,
}

impl<'a> Parts<'a> {
    fn of(
        message: &NetworkMessage<'a>,
        header: &SecurityHeader<'_>,
    ) -> Result<Self, SecurityError> {
        let sealed = message.payload();
        let footer = usize::from(header.footer_size.unwrap_or_default());
        let truncated = SecurityError::Truncated {
            expected: footer + SIGNATURE,
            found: sealed.len(),
        };
        let (signed, signature) = message
            .datagram()
            .split_last_chunk::<SIGNATURE>()
            .ok_or(truncated)?;
        let (body, _) = sealed.split_last_chunk::<SIGNATURE>().ok_or(truncated)?;
        if u32::try_from(body.len()).is_err() {
            return Err(SecurityError::TooLong(body.len()));
        }
        Ok(Self {
            signed,
            signature,
            body,
            footer_at: body.len().checked_sub(footer).ok_or(truncated)?,
        })
    }
}

fn read_nonce(nonce: &[u8]) -> Result<Nonce, SecurityError> {
    nonce
        .try_into()
        .map(Nonce::from_bytes)
        .map_err(|_| SecurityError::NonceLength(nonce.len()))
}

fn stream_id<'a>(
    message: &NetworkMessage<'a>,
    nonce: Nonce,
    counted_by: CountedBy,
) -> StreamId<'a> {
    let writer_group_id = message.group().and_then(|group| group.writer_group_id);
    let by_sender = match counted_by {
        CountedBy::Publisher => false,
        CountedBy::PublisherOrSender => {
            message.is_action() || message.message_type() != NetworkMessageType::DataSet
        }
        CountedBy::Sender => true,
    };
    let sender = by_sender.then_some(nonce.random);
    (message.publisher_id(), writer_group_id, sender)
}

fn decrypt<'a>(
    keys: &TokenKeys,
    nonce: Nonce,
    body: &[u8],
    scratch: &'a mut Vec<u8>,
) -> Result<&'a [u8], SecurityError> {
    scratch.clear();
    scratch.extend_from_slice(body);
    keys.apply_keystream(nonce, scratch)
        .map_err(|_| SecurityError::TooLong(body.len()))?;
    Ok(scratch)
}
