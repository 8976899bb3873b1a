//! Securing a NetworkMessage that was written without security.

use super::Seal;
use crate::header::{EXTENDED_FLAGS1, SECURITY};
use crate::{EncodeError, NetworkMessage};

impl Seal<'_> {
    /// Bytes that a message is longer by, at most, once it is secured without a footer: ExtendedFlags1, the SecurityHeader and
    /// the signature.
    pub const OVERHEAD: usize = 1 + super::sealer::HEADER + super::SIGNATURE;

    /// Writes a NetworkMessage of whatever type, which is neither signed nor encrypted, secured at the end of `buf`. For who
    /// has many messages and secures them all on their way out.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] when `datagram` is no such message, or has a SecurityFooter; `buf` is as long as before then.
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

    /// Writes the headers with the SecurityHeader, and the payload behind them; says where that begins.
    fn headers(&self, datagram: &[u8], buf: &mut Vec<u8>) -> Result<usize, EncodeError> {
        const NO_MESSAGE: EncodeError = EncodeError::Misplaced("a seal on no NetworkMessage");
        let message = NetworkMessage::decode(datagram).map_err(|_| NO_MESSAGE)?;
        if message.is_sealed() || !message.footer().is_empty() {
            return Err(EncodeError::Misplaced("a second seal"));
        }
        let payload = message.payload();
        let headers = datagram.len().checked_sub(payload.len());
        // The SecurityHeader is the last of the headers, and without security it has one length.
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

/// Bytes of a SecurityHeader that says that there is no security: flags, SecurityTokenId and NonceLength.
const UNSECURED: usize = 1 + 4 + 1;
