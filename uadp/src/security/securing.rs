//! Securing a NetworkMessage that was written without security.

use super::Seal;
use crate::header::{EXTENDED_FLAGS1, SECURITY};
use crate::{EncodeError, NetworkMessage};
use alloc::vec::Vec;

impl Seal<'_> {
    /// Maximum number of bytes that securing adds to a message without footer: ExtendedFlags1,
    /// SecurityHeader and signature.
    pub const OVERHEAD: usize = 1 + super::sealer::HEADER + super::SIGNATURE;

    /// Appends the secured form of an unsecured NetworkMessage of any type to `buf`. For
    /// applications that secure all messages in a single place before sending.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] if `datagram` is not an unsecured NetworkMessage, or has a
    /// SecurityFooter. The length of `buf` is then unchanged.
    pub fn secure(self, datagram: &[u8], buf: &mut Vec<u8>) -> Result<(), EncodeError> {
        let start = buf.len();
        let payload_at = self.headers(datagram, buf).inspect_err(|_| {
            buf.truncate(start);
        })?;
        let finished = self.finish(buf, start, payload_at);
        if finished.is_err() {
            buf.truncate(start);
        }
        finished
    }

    /// Writes the headers with the SecurityHeader, and the payload. Returns the offset of the
    /// payload.
    fn headers(&self, datagram: &[u8], buf: &mut Vec<u8>) -> Result<usize, EncodeError> {
        const NO_MESSAGE: EncodeError =
            EncodeError::Misplaced("only a NetworkMessage can be secured");
        let message = NetworkMessage::decode(datagram).map_err(|_| NO_MESSAGE)?;
        if message.is_sealed() || !message.footer().is_empty() {
            return Err(EncodeError::Misplaced("a second seal"));
        }
        let payload = message.payload();
        let headers = datagram.len().checked_sub(payload.len());
        // The SecurityHeader is the last header, and has a fixed length without security.
        let before = message.security().map_or(0, |_| UNSECURED);
        let headers = headers.and_then(|len| datagram.get(..len.checked_sub(before)?));
        let Some(([flags], rest)) = headers.and_then(<[u8]>::split_first_chunk) else {
            return Err(NO_MESSAGE);
        };
        buf.reserve(datagram.len() + Self::OVERHEAD);
        buf.push(flags | EXTENDED_FLAGS1);
        let (extended, rest) = match flags & EXTENDED_FLAGS1 {
            0 => (0, rest),
            _ => match rest.split_first_chunk() {
                Some(([extended], rest)) => (*extended, rest),
                None => return Err(NO_MESSAGE),
            },
        };
        buf.push(extended | SECURITY);
        buf.extend_from_slice(rest);
        self.header().write(buf)?;
        let payload_at = buf.len();
        buf.extend_from_slice(payload);
        Ok(payload_at)
    }
}

/// Bytes of a SecurityHeader without security: flags, SecurityTokenId and NonceLength.
const UNSECURED: usize = 1 + 4 + 1;
