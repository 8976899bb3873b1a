//! The receiving side: verifying, refusing what was there before, decrypting.

use std::time::Duration;

use super::replay::{Accepted, StreamId, Streams};
use super::ring::KeyRing;
use super::{KeyError, Keys, Nonce, SIGNATURE, SecurityError, SecurityMode};
use crate::{NetworkMessage, NetworkMessageType, SecurityHeader};

/// Opens the secured messages of one SecurityGroup (OPC 10000-14, 7.2.4.4.3).
///
/// A message is accepted once, if it is at least as secure as the [`SecurityMode`], its signature is right and its
/// sequence number new: of each PublisherId, WriterGroupId and SecurityTokenId a window of the newest 128 sequence
/// numbers is kept, so those may come in any order. Publishers without a PublisherId count as one. Nothing changes
/// here before the signature was verified, and nothing at all by a message that is refused.
///
/// The first message with a future key makes that the current one; a number of past keys stay valid
/// ([`OpenerOptions::past_keys`]).
///
/// What no receiver can tell is whether a message recorded before it had its keys is new.
///
/// # Examples
/// ```
/// use std::time::Duration;
/// use uadp::{Keys, NetworkMessage, Opener, SecurityMode, SecurityPolicy};
///
/// // SigningKey 01 02 .. 20, EncryptingKey a0 a1 .. af, KeyNonce 10 11 12 13
/// let key_data: Vec<u8> = (1..=32).chain(0xA0..=0xAF).chain(0x10..=0x13).collect();
/// let keys = Keys::from_bytes(SecurityPolicy::PubSubAes128Ctr, &key_data)?;
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
    ring: KeyRing<Streams>,
}

/// What an [`Opener`] keeps, and what it lets pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OpenerOptions {
    /// Keys older than the current one that stay valid, for publishers which change later and messages under way.
    /// 2 by default.
    pub past_keys: usize,
    /// Pairs of PublisherId and WriterGroupId followed for each key. While there are as many,
    /// [`SecurityError::TooManyPublishers`] refuses others: to forget one instead would let its messages be replayed.
    /// 1024 by default. Only members of the group take up places.
    pub max_streams: usize,
    /// When nothing of a publisher was accepted for so long it may count anew. The standard wants twice the
    /// KeepAliveTime, for publishers that do not go on from the last sequence number after a restart
    /// (OPC 10000-14, 7.2.3). What was recorded of a publisher can be replayed when it was silent for as long; so by
    /// default this is `None`, and such a publisher is refused until there are new keys.
    pub forget_after: Option<Duration>,
    /// Whose messages share a sequence; [`CountedBy::Publisher`] by default.
    pub counted_by: CountedBy,
    /// Accept publishers that leave the sequence number at 1, as open62541 does up to version 1.5.7; `false` by
    /// default. Their messages are marked [`Opened::constant_sequence`] and can be replayed, bar the last one.
    pub accept_constant_sequence: bool,
}

/// Whose messages share a sequence.
///
/// Several programs may send with one PublisherId and WriterGroupId, each with sequence numbers of its own: those that
/// ask for Actions do, with those of the responder, and those that probe. A sender that keeps the random half of its nonces
/// for as long as it runs can be told from the others by it, since the signature covers the nonce. Nothing of it can be
/// replayed either, as long as it is followed; and it may count anew when it restarts, with another random half.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CountedBy {
    /// Those of a PublisherId and WriterGroupId, as the standard has it (OPC 10000-14, 7.2.3).
    Publisher,
    /// As `Publisher`; of Actions, probes and announcements those of a sender.
    PublisherOrSender,
    /// Those of a sender. One that takes other random bytes for each message takes up a place with each.
    Sender,
}

/// A message that was opened, and what to note about it.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Opened<'a> {
    /// The message, its payload and footer readable.
    pub message: NetworkMessage<'a>,
    /// It is the first with a future key, which is the current one from now on.
    pub key_changed: bool,
    /// The publisher is about to leave all present keys: get new ones (OPC 10000-14, 7.2.4.4.2).
    pub force_key_reset: bool,
    /// The publisher does not count its messages, see [`OpenerOptions::accept_constant_sequence`]. That is worth
    /// a warning: when its random bytes come twice, so does the key stream.
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
    /// An opener without keys. It refuses what is less secure than `mode`, and opens what is more secure too.
    #[must_use]
    pub fn new(mode: SecurityMode) -> Self {
        Self::with(mode, OpenerOptions::default())
    }

    /// As [`new`](Self::new), with other limits.
    #[must_use]
    pub const fn with(mode: SecurityMode, options: OpenerOptions) -> Self {
        Self {
            mode,
            options,
            ring: KeyRing::new(options.past_keys),
        }
    }

    /// Takes what GetSecurityKeys or SetSecurityKeys delivers: keys with consecutive SecurityTokenIds, the first of
    /// which is `first_token_id`. Behind the highest one comes 1 (OPC 10000-14, 8.3.2 and 9.1.3.3).
    ///
    /// If one of them is known they are added to those known, and the first becomes current unless a newer one is;
    /// past keys that were let go do not come back. If none is known they replace all others.
    ///
    /// # Errors
    /// [`KeyError::TokenId`] when `first_token_id` is 0, [`KeyError::Count`] without keys and with more than 64.
    pub fn update_keys(
        &mut self,
        first_token_id: u32,
        keys: impl IntoIterator<Item = Keys>,
    ) -> Result<(), KeyError> {
        self.ring.update(first_token_id, keys)
    }

    /// SecurityTokenId of the current key, `None` without keys.
    #[must_use]
    pub fn current_token_id(&self) -> Option<u32> {
        self.ring.current_token_id()
    }

    /// SecurityTokenId of the key that comes next, `None` when there is none: time to get more.
    #[must_use]
    pub fn next_token_id(&self) -> Option<u32> {
        self.ring.next_token_id()
    }

    /// Verifies a message, and decrypts it into `scratch` if it is encrypted; one that is only signed is read where
    /// it is. `now` counts from any fixed time.
    ///
    /// # Errors
    /// The reason why it is refused.
    pub fn open<'a>(
        &mut self,
        message: &NetworkMessage<'a>,
        now: Duration,
        scratch: &'a mut Vec<u8>,
    ) -> Result<Opened<'a>, SecurityError> {
        let header = self.checked_header(message)?;
        let nonce = read_nonce(header.nonce)?;
        let parts = Parts::of(message, &header)?;
        let token_id = header.token_id;
        let Some(entry) = self.ring.get_mut(token_id) else {
            return Err(match self.ring.is_retired(token_id) {
                true => SecurityError::RetiredToken(token_id),
                false => SecurityError::UnknownToken(token_id),
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
        let body = match header.encrypted {
            true => decrypt(&entry.keys, nonce, parts.body, scratch)?,
            false => parts.body,
        };
        let (payload, footer) = body
            .split_at_checked(parts.footer_at)
            .unwrap_or((body, &[]));
        Ok(Opened {
            message: message.opened(payload, footer),
            key_changed: self.ring.advance(token_id),
            force_key_reset: header.force_key_reset,
            constant_sequence: accepted == Accepted::Uncounted,
        })
    }

    /// The header of a message that is secured as the group wants it.
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

/// What a sealed message is made of.
struct Parts<'a> {
    /// All but the signature.
    signed: &'a [u8],
    signature: &'a [u8],
    /// Payload and footer, encrypted or not.
    body: &'a [u8],
    /// Where in the body the footer starts.
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
    keys: &Keys,
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
