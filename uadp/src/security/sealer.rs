//! The sending side: assigns a nonce to each message, encrypts and signs it.

use super::ring::TokenKeyRing;
use super::{KeyError, MESSAGE_NONCE, Nonce, SealError, SecurityMode, TokenKeys};
use crate::reader::ByteReader;
use crate::{EncodeError, NetworkMessage, SecurityHeader};
use alloc::vec::Vec;

/// Secures the messages that a Publisher sends to a SecurityGroup (OPC 10000-14, 7.2.4.4.3).
///
/// Every message takes a separate [`Seal`]. The sequence numbers of each key start at 1 and
/// increase by 1. They end instead of wrapping around, because two messages with the same nonce and
/// key reveal both payloads. A publisher that restarts with the same key in use continues with
/// [`continue_after`](Self::continue_after).
///
/// # Examples
/// ```
/// use uadp::{
///     DataSetHeader, Extras, TokenKeys, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar,
///     Sealer, SecurityMode, SecurityPolicy, };
///
/// let key_data: Vec<u8> = (1..=32).chain(0xA0..=0xAF).chain(0x10..=0x13).collect();
/// let keys = TokenKeys::from_bytes(SecurityPolicy::PubSubAes128Ctr, &key_data)?;
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
    ring: TokenKeyRing<LastSequenceNumber>,
    /// SecurityTokenId until which messages request new keys.
    resets: Option<u32>,
}

/// Sequence number of the last message with a key.
#[derive(Debug, Clone, Copy, Default)]
struct LastSequenceNumber(u32);

/// Keys and nonce for a message. The type is not `Clone`, so that no nonce is used twice.
#[derive(Debug)]
#[must_use = "a seal not used leaves a gap in the sequence numbers"]
pub struct Seal<'a> {
    keys: &'a TokenKeys,
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
    /// Creates a sealer without keys.
    #[must_use]
    pub const fn new(mode: SecurityMode) -> Self {
        Self {
            mode,
            ring: TokenKeyRing::new(0),
            resets: None,
        }
    }

    /// Adds the keys of GetSecurityKeys with StartingTokenId 0, or of SetSecurityKeys: the current
    /// key with the SecurityTokenId `current_token_id`, and future keys. The highest
    /// SecurityTokenId is followed by 1 (OPC 10000-14, 8.3.2 and 9.1.3.3).
    ///
    /// If any of the keys is known, the new keys are added, and the first key becomes current
    /// unless a newer key is current. If all keys are new, they replace all present keys.
    ///
    /// # Errors
    /// [`KeyError::TokenId`] if `current_token_id` is 0; [`KeyError::Count`] for no keys and for
    /// more than 64.
    pub fn update_keys(
        &mut self,
        current_token_id: u32,
        keys: impl IntoIterator<Item = TokenKeys>,
    ) -> Result<(), KeyError> {
        self.ring.update(current_token_id, keys)
    }

    /// Makes the next key current, for example at the end of the KeyLifetime. Returns false without
    /// a next key; the present key then stays in use.
    pub fn next_key(&mut self) -> bool {
        match self.ring.next_token_id() {
            Some(next) => self.ring.advance(next),
            None => false,
        }
    }

    /// Makes the key with this SecurityTokenId current, for example because other members use it
    /// already. Returns false if the key is unknown or is not newer than the current key.
    pub fn move_to(&mut self, token_id: u32) -> bool {
        self.ring.get_mut(token_id).is_some() && self.ring.advance(token_id)
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

    /// Returns the sequence number of the last seal with the current key, 0 before the first seal.
    /// Store it for [`continue_after`](Self::continue_after).
    #[must_use]
    pub fn sequence_number(&self) -> u32 {
        self.ring.current().map_or(0, |entry| entry.state.0)
    }

    /// Continues after a sequence number that was used with the current key. The sequence number
    /// never decreases.
    pub fn continue_after(&mut self, sequence_number: u32) {
        if let Some(entry) = self.ring.current_mut() {
            entry.state.0 = entry.state.0.max(sequence_number);
        }
    }

    /// Requests subscribers to get new keys, until the key changes. They need five times the
    /// KeepAliveTime for it (OPC 10000-14, 7.2.4.4.2).
    pub fn force_key_reset(&mut self) {
        self.resets = self.ring.current_token_id();
    }

    /// Returns a seal for a message, with the next sequence number. `random` may be pseudo-random
    /// (OPC 10000-14, 7.2.4.4.3.2), but has to differ from the bytes of other publishers with the
    /// same keys, because they use the same sequence numbers.
    ///
    /// # Errors
    /// [`SealError::NoKeys`] without keys; [`SealError::Exhausted`] after 4294967295 messages with
    /// a key.
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
    /// Creates a seal with a given nonce, to reproduce a known message. Two different messages with
    /// the same nonce and key reveal each other's payload, so use [`Sealer::seal`] for messages to
    /// send.
    pub const fn with_nonce(
        keys: &'a TokenKeys,
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

    /// Adds a SecurityFooter, which is encrypted with the payload. The defined policies have no
    /// footer.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] if it has more than 65535 bytes.
    pub fn footer(mut self, bytes: &'a [u8]) -> Result<Self, EncodeError> {
        let size = u16::try_from(bytes.len()).map_err(|_| EncodeError::TooBig {
            what: "SecurityFooter",
            len: bytes.len(),
        })?;
        self.footer = Some(Footer { bytes, size });
        Ok(self)
    }

    /// Returns the SecurityHeader that the message has to be written with.
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

    /// Secures the NetworkMessage from `start` to the end of the buffer: encrypts it and appends
    /// the signature. The message, of any type, has to be written with [`header`](Self::header), up
    /// to the end of its payload. [`finish_sealed`](crate::NetworkMessageEncoder::finish_sealed)
    /// does the same while writing.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] if no NetworkMessage with this header starts there;
    /// [`EncodeError::TooBig`] if the payload has 64 GiB.
    pub fn apply(self, buf: &mut Vec<u8>, start: usize) -> Result<(), EncodeError> {
        let datagram = buf.get(start..).unwrap_or_default();
        let message = NetworkMessage::decode(datagram).ok();
        let Some(message) = message.filter(NetworkMessage::is_sealed) else {
            return Err(EncodeError::Misplaced("a seal without SecurityHeader"));
        };
        let payload_at = buf.len() - message.payload().len();
        self.finish(buf, start, payload_at)
    }

    /// Secures a message as [`apply`](Self::apply), with a known offset of the payload.
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

    /// Returns true if the headers of the message end with the SecurityHeader of this seal.
    fn is_announced(&self, headers: &[u8]) -> bool {
        let len = HEADER + self.footer.map_or(0, |_| size_of::<u16>());
        let at = headers.len().checked_sub(len);
        let Some(header) = at.and_then(|at| headers.get(at..)) else {
            return false;
        };
        SecurityHeader::read(&mut ByteReader::new(header)) == Ok(self.header())
    }
}

/// Bytes of the SecurityHeader without SecurityFooterSize: flags, SecurityTokenId, NonceLength and
/// nonce.
pub(super) const HEADER: usize = 1 + 4 + 1 + MESSAGE_NONCE;
