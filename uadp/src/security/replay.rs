//! Detection of replayed messages.

use alloc::boxed::Box;
use alloc::vec::Vec;
use core::time::Duration;

use super::{Nonce, OpenerOptions, SecurityError};
use crate::PublisherId;

/// Publishers of the messages with a key, separately for each WriterGroup.
#[derive(Debug, Default)]
pub(super) struct Streams {
    /// Sorted by [`StreamId`].
    streams: Vec<Stream>,
}

/// Identity of a sequence of messages. The last part is the random half of the nonce, if it
/// distinguishes the senders.
pub(super) type StreamId<'a> = (Option<PublisherId<'a>>, Option<u16>, Option<[u8; 4]>);

#[derive(Debug)]
struct Stream {
    publisher: Publisher,
    writer_group_id: Option<u16>,
    sender: Option<[u8; 4]>,
    window: Window,
    heard: Duration,
}

#[derive(Debug)]
enum Publisher {
    Unnamed,
    Numbered(PublisherId<'static>),
    Named(Box<str>),
}

/// Accepted sequence numbers. They never restart with the same key, because nonces would repeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Window {
    newest: u32,
    /// Bit n is set when `newest - n` was accepted.
    accepted: u128,
    /// Random half of the last accepted nonce.
    random: [u8; 4],
}

/// Result for an accepted message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Accepted {
    New,
    /// A replay cannot be detected, because the publisher does not increment the sequence number.
    Uncounted,
}

impl Streams {
    /// Accepts a message with valid signature, or rejects it. A rejection changes nothing except
    /// that expired streams are removed.
    pub(super) fn accept(
        &mut self,
        id: StreamId<'_>,
        nonce: Nonce,
        now: Duration,
        options: &OpenerOptions,
    ) -> Result<Accepted, SecurityError> {
        let found = self.find(id).ok();
        match found.and_then(|at| self.streams.get_mut(at)) {
            Some(stream) => stream.accept(nonce, now, options),
            None => self.insert(id, nonce, now, options),
        }
    }

    #[cold]
    fn insert(
        &mut self,
        id: StreamId<'_>,
        nonce: Nonce,
        now: Duration,
        options: &OpenerOptions,
    ) -> Result<Accepted, SecurityError> {
        if self.streams.len() >= options.max_streams {
            self.streams.retain(|stream| !stream.is_over(now, options));
        }
        if self.streams.len() >= options.max_streams {
            return Err(SecurityError::TooManyPublishers);
        }
        let at = self.find(id).unwrap_or_else(|at| at);
        self.streams.insert(at, Stream::new(id, nonce, now));
        Ok(Accepted::New)
    }

    fn find(&self, id: StreamId<'_>) -> Result<usize, usize> {
        self.streams.binary_search_by(|stream| stream.id().cmp(&id))
    }
}

impl Stream {
    fn new(
        (publisher_id, writer_group_id, sender): StreamId<'_>,
        nonce: Nonce,
        now: Duration,
    ) -> Self {
        Self {
            publisher: match publisher_id {
                None => Publisher::Unnamed,
                Some(PublisherId::Byte(id)) => Publisher::Numbered(PublisherId::Byte(id)),
                Some(PublisherId::UInt16(id)) => Publisher::Numbered(PublisherId::UInt16(id)),
                Some(PublisherId::UInt32(id)) => Publisher::Numbered(PublisherId::UInt32(id)),
                Some(PublisherId::UInt64(id)) => Publisher::Numbered(PublisherId::UInt64(id)),
                Some(PublisherId::String(id)) => Publisher::Named(id.into()),
            },
            writer_group_id,
            sender,
            window: Window::new(nonce),
            heard: now,
        }
    }

    fn id(&self) -> StreamId<'_> {
        let publisher_id = match &self.publisher {
            Publisher::Unnamed => None,
            Publisher::Numbered(id) => Some(*id),
            Publisher::Named(id) => Some(PublisherId::String(id)),
        };
        (publisher_id, self.writer_group_id, self.sender)
    }

    /// Returns true if the pause is long enough for the publisher to restart its sequence numbers.
    fn is_over(&self, now: Duration, options: &OpenerOptions) -> bool {
        options
            .forget_after
            .is_some_and(|after| now.saturating_sub(self.heard) >= after)
    }

    fn accept(
        &mut self,
        nonce: Nonce,
        now: Duration,
        options: &OpenerOptions,
    ) -> Result<Accepted, SecurityError> {
        let accepted = if self.is_over(now, options) {
            self.window = Window::new(nonce);
            Accepted::New
        } else if options.accept_constant_sequence && self.window.is_uncounted(nonce) {
            self.window.random = nonce.random;
            Accepted::Uncounted
        } else {
            self.window.accept(nonce)?;
            Accepted::New
        };
        self.heard = now;
        Ok(accepted)
    }
}

impl Window {
    const fn new(nonce: Nonce) -> Self {
        Self {
            newest: nonce.sequence,
            accepted: 1,
            random: nonce.random,
        }
    }

    /// Returns true if only the first sequence number was ever received, and the nonce differs from
    /// the last nonce.
    fn is_uncounted(&self, nonce: Nonce) -> bool {
        self.newest == UNCOUNTED && nonce.sequence == UNCOUNTED && nonce.random != self.random
    }

    fn accept(&mut self, nonce: Nonce) -> Result<(), SecurityError> {
        let Nonce { random, sequence } = nonce;
        let newest = self.newest;
        let accepted = if let Some(behind) = newest.checked_sub(sequence) {
            let Some(bit) = 1_u128.checked_shl(behind) else {
                return Err(SecurityError::TooOld { sequence, newest });
            };
            if self.accepted & bit != 0 {
                return Err(SecurityError::Replayed(sequence));
            }
            self.accepted | bit
        } else {
            let ahead = sequence - newest;
            if ahead > FARTHEST {
                return Err(SecurityError::TooFarAhead { sequence, newest });
            }
            self.accepted.checked_shl(ahead).unwrap_or_default() | 1
        };
        *self = Self {
            newest: newest.max(sequence),
            accepted,
            random,
        };
        Ok(())
    }
}

/// First sequence number of publishers, and the only number of publishers that do not increment it.
const UNCOUNTED: u32 = 1;
/// Maximum valid step forward (OPC 10000-14, 7.2.3).
const FARTHEST: u32 = 1 << 30;
