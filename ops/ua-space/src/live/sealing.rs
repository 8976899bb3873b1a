//! The keys of a running space: decrypts received messages and secures requests.

use std::path::Path;

use uadp::{EncodeError, NetworkMessage, Seal, SealError, Sealer, SecurityMode};

use crate::exit::CommandFailure;
use crate::keys::{self, KeyFile};
use crate::report::warn;

/// The reason why a message is not secured.
#[derive(Debug, thiserror::Error)]
pub(crate) enum UnsealedMessage {
    #[error(transparent)]
    Seal(#[from] SealError),
    #[error(transparent)]
    Encode(#[from] EncodeError),
}

/// The keys of a file, and the sealer with the first key.
#[derive(Debug)]
pub(crate) struct Sealing {
    file: KeyFile,
    sealer: Sealer,
    /// Random bytes of this process, which distinguish its messages from messages of other senders.
    mark: [u8; 4],
    refused: u64,
}

impl Sealing {
    pub(crate) fn read(path: &Path, signs_only: bool) -> Result<Self, CommandFailure> {
        let file = KeyFile::read(path, warn)?;
        let mode = if signs_only {
            SecurityMode::Sign
        } else {
            SecurityMode::SignAndEncrypt
        };
        let mut sealer = Sealer::new(mode);
        let (token_id, first) = file.first().ok_or_else(|| {
            CommandFailure::Data(format!("{}: there is no key in it", file.name()))
        })?;
        sealer
            .update_keys(token_id, [first.clone()])
            .map_err(|error| CommandFailure::Data(format!("{}: {error}", file.name())))?;
        let mut mark = [0; 4];
        keys::random(&mut mark)?;
        Ok(Self {
            file,
            sealer,
            mark,
            refused: 0,
        })
    }

    /// Verifies and decrypts a message into `scratch`; returns the message unchanged if this fails.
    pub(crate) fn open<'a>(
        &mut self,
        message: NetworkMessage<'a>,
        scratch: &'a mut Vec<u8>,
    ) -> NetworkMessage<'a> {
        if !message.is_sealed() {
            return message;
        }
        let found = self.file.find(&message);
        let found = found.map(|found| found.first().copied().cloned());
        match found {
            Ok(Some(found)) => keys::open(&found, &message, scratch).unwrap_or(message),
            Ok(None) => message,
            Err(why) => {
                self.refused += 1;
                if self.refused == 1 {
                    warn(&format!("a secured message is not read: {why}"));
                }
                message
            }
        }
    }

    pub(crate) fn seal(&mut self, datagram: &[u8]) -> Result<Vec<u8>, UnsealedMessage> {
        let seal = self.sealer.seal(self.mark)?;
        let mut sealed = Vec::with_capacity(datagram.len() + Seal::OVERHEAD);
        seal.secure(datagram, &mut sealed)?;
        Ok(sealed)
    }
}
