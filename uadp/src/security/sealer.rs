//! The sending side: a nonce for each message, encrypting it, signing it.

use super::ring::KeyRing;
use super::{KeyError, Keys, MESSAGE_NONCE, Nonce, SealError, SecurityMode};
use crate::reader::Reader;
use crate::{EncodeError, NetworkMessage, SecurityHeader};

/// Secures the messages one Publisher sends to a SecurityGroup (OPC 10000-14, 7.2.4.4.3).
///
/// Every message takes a [`Seal`] of its own. Its sequence numbers go up by one from 1 with every key, and end before
/// they would start over: a nonce that comes twice with one key gives the payloads of both messages away.
/// A publisher that restarts while the same key is in use goes on with [`continue_after`](Self::continue_after).
///
/// # Examples
/// ```
/// use uadp::{
///     DataSetHeader, Extras, Keys, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar, Sealer, SecurityMode,
///     SecurityPolicy,
/// };
///
/// let key_data: Vec<u8> = (1..=32).chain(0xA0..=0xAF).chain(0x10..=0x13).collect();
/// let keys = Keys::from_bytes(SecurityPolicy::PubSubAes128Ctr, &key_data)?;
/// let mut sealer = Sealer::new(SecurityMode::SignAndEncrypt);
/// sealer.update_keys(1, [keys])?;
///
/// let header = NetworkHeader { publisher_id: Some(PublisherId::UInt16(2)), ..NetworkHeader::default() };
/// let mut datagram = Vec::new();
/// let seal = sealer.seal([0xE5, 0xA9, 0x4D, 0xC9])?; // random bytes, others for each message
/// let extras = Extras { security: Some(seal.header()), ..Extras::default() };
/// let mut message = NetworkMessageEncoder::with(&mut datagram, &header, Some(&[10]), &extras)?;
/// let mut fields = message.key_frame(&DataSetHeader::default())?;
/// fields.scalar(Scalar::Int32(42))?;
/// fields.finish()?;
/// message.finish_sealed(seal)?;
/// assert_eq!(datagram.len(), 4 + 3 + 14 + 8 + 32); // headers, SecurityHeader, payload, signature
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Sealer {
    mode: SecurityMode,
    ring: KeyRing<LastSequenceNumber>,
    /// The SecurityTokenId until which new keys are asked for.
    resets: Option<u32>,
}

/// The sequence number the last message of a key had.
#[derive(Debug, Clone, Copy, Default)]
struct LastSequenceNumber(u32);

/// What one message is secured with. Not to be copied, so that no nonce is used twice.
#[derive(Debug)]
#[must_use = "a seal not used leaves a gap in the sequence numbers"]
pub struct Seal<'a> {
    keys: &'a Keys,
    mode: SecurityMode,
    token_id: u32,
    nonce: [u8; MESSAGE_NONCE],
    force_key_reset: bool,
    footer: Option<Footer<'a>>,
}

#[derive(Debug, Clone, Copy)]
struct Footer<'a> {
    bytes: &'a [u8],
    size: u16,
}

impl Sealer {
    /// A sealer without keys.
    #[must_use]
    pub const fn new(mode: SecurityMode) -> Self {
        Self {
            mode,
            ring: KeyRing::new(0),
            resets: None,
        }
    }

    /// Takes what GetSecurityKeys with StartingTokenId 0 or SetSecurityKeys delivers: the current key, whose
    /// SecurityTokenId is `current_token_id`, and future ones. Behind the highest SecurityTokenId comes 1
    /// (OPC 10000-14, 8.3.2 and 9.1.3.3).
    ///
    /// If one of them is known they are added to those known, and the first becomes current unless a newer one is.
    /// If none is known they replace all others.
    ///
    /// # Errors
    /// [`KeyError::TokenId`] when `current_token_id` is 0, [`KeyError::Count`] without keys and with more than 64.
    pub fn update_keys(
        &mut self,
        current_token_id: u32,
        keys: impl IntoIterator<Item = Keys>,
    ) -> Result<(), KeyError> {
        self.ring.update(current_token_id, keys)
    }

    /// Moves on to the key behind the current one, as when the KeyLifetime is over. False when there is none:
    /// then the present key goes on.
    pub fn next_key(&mut self) -> bool {
        match self.ring.next_token_id() {
            Some(next) => self.ring.advance(next),
            None => false,
        }
    }

    /// Moves on to the key with that SecurityTokenId, as when others use it already. False when it is not there, or no newer
    /// one than the current.
    pub fn move_to(&mut self, token_id: u32) -> bool {
        self.ring.get_mut(token_id).is_some() && self.ring.advance(token_id)
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

    /// Sequence number of the last seal with the current key, 0 before the first: what to note down for
    /// [`continue_after`](Self::continue_after).
    #[must_use]
    pub fn sequence_number(&self) -> u32 {
        self.ring.current().map_or(0, |entry| entry.state.0)
    }

    /// Goes on behind a sequence number used before with the current key; never back.
    pub fn continue_after(&mut self, sequence_number: u32) {
        if let Some(entry) = self.ring.current_mut() {
            entry.state.0 = entry.state.0.max(sequence_number);
        }
    }

    /// Asks the subscribers for new keys until the key changes. They need five times the KeepAliveTime for that
    /// (OPC 10000-14, 7.2.4.4.2).
    pub fn force_key_reset(&mut self) {
        self.resets = self.ring.current_token_id();
    }

    /// Secures one message with the next sequence number. `random` may be pseudo-random
    /// (OPC 10000-14, 7.2.4.4.3.2), but has to differ from what other publishers with the same keys take: they use
    /// the same sequence numbers.
    ///
    /// # Errors
    /// [`SealError::NoKeys`] before there are any, [`SealError::Exhausted`] after 4294967295 messages with one key.
    pub fn seal(&mut self, random: [u8; 4]) -> Result<Seal<'_>, SealError> {
        let (mode, resets) = (self.mode, self.resets);
        let entry = self.ring.current_mut().ok_or(SealError::NoKeys)?;
        let last = entry.state.0;
        let sequence = last
            .checked_add(1)
            .ok_or(SealError::Exhausted(entry.token_id))?;
        entry.state.0 = sequence;
        let nonce = Nonce { random, sequence };
        Ok(Seal {
            force_key_reset: resets == Some(entry.token_id),
            ..Seal::with_nonce(&entry.keys, entry.token_id, mode, nonce.to_bytes())
        })
    }
}

impl<'a> Seal<'a> {
    /// A seal with a nonce of the caller's, to write a known message once more. Two different messages with one
    /// nonce and one key give each other's payload away: what is sent takes [`Sealer::seal`].
    pub const fn with_nonce(
        keys: &'a Keys,
        token_id: u32,
        mode: SecurityMode,
        nonce: [u8; 8],
    ) -> Self {
        Self {
            keys,
            mode,
            token_id,
            nonce,
            force_key_reset: false,
            footer: None,
        }
    }

    /// Adds a SecurityFooter, which is encrypted with the payload. The policies there are have none.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] when it has more than 65535 bytes.
    pub fn footer(mut self, bytes: &'a [u8]) -> Result<Self, EncodeError> {
        let size = u16::try_from(bytes.len()).map_err(|_| EncodeError::TooBig {
            what: "SecurityFooter",
            len: bytes.len(),
        })?;
        self.footer = Some(Footer { bytes, size });
        Ok(self)
    }

    /// The SecurityHeader the message has to be written with.
    #[must_use]
    pub const fn header(&self) -> SecurityHeader<'_> {
        SecurityHeader {
            signed: true,
            encrypted: matches!(self.mode, SecurityMode::SignAndEncrypt),
            force_key_reset: self.force_key_reset,
            token_id: self.token_id,
            nonce: &self.nonce,
            footer_size: match self.footer {
                Some(footer) => Some(footer.size),
                None => None,
            },
        }
    }

    /// Secures the NetworkMessage from `start` to the end of the buffer, of whatever type, that was written with
    /// [`header`](Self::header) up to the end of its payload: encrypts it and appends the signature.
    /// [`finish_sealed`](crate::NetworkMessageEncoder::finish_sealed) does the same while writing.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] when no NetworkMessage with this header starts there, [`EncodeError::TooBig`] when
    /// the payload is one of 64 GiB.
    pub fn apply(self, buf: &mut Vec<u8>, start: usize) -> Result<(), EncodeError> {
        let datagram = buf.get(start..).unwrap_or_default();
        let message = NetworkMessage::decode(datagram).ok();
        let Some(message) = message.filter(NetworkMessage::is_sealed) else {
            return Err(EncodeError::Misplaced("a seal without SecurityHeader"));
        };
        let payload_at = buf.len() - message.payload().len();
        self.finish(buf, start, payload_at)
    }

    /// As [`apply`](Self::apply), when it is known where the payload starts.
    pub(crate) fn finish(
        self,
        buf: &mut Vec<u8>,
        start: usize,
        payload_at: usize,
    ) -> Result<(), EncodeError> {
        let headers = buf.get(start..payload_at).unwrap_or_default();
        if !self.is_announced(headers) {
            return Err(EncodeError::Misplaced("a seal of another SecurityHeader"));
        }
        buf.extend_from_slice(self.footer.map_or(&[], |footer| footer.bytes));
        if self.mode == SecurityMode::SignAndEncrypt {
            let body = buf.get_mut(payload_at..).unwrap_or_default();
            let len = body.len();
            self.keys
                .apply_keystream(Nonce::from_bytes(self.nonce), body)
                .map_err(|_| EncodeError::TooBig {
                    what: "payload",
                    len,
                })?;
        }
        let signature = self.keys.signature(buf.get(start..).unwrap_or_default());
        buf.extend_from_slice(&signature);
        Ok(())
    }

    /// The headers of the message end with the SecurityHeader of this seal.
    fn is_announced(&self, headers: &[u8]) -> bool {
        let len = HEADER + self.footer.map_or(0, |_| size_of::<u16>());
        let at = headers.len().checked_sub(len);
        let Some(header) = at.and_then(|at| headers.get(at..)) else {
            return false;
        };
        SecurityHeader::read(&mut Reader::new(header)) == Ok(self.header())
    }
}

/// Bytes of the SecurityHeader without SecurityFooterSize: flags, SecurityTokenId, NonceLength and nonce.
pub(super) const HEADER: usize = 1 + 4 + 1 + MESSAGE_NONCE;
