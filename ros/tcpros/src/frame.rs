//! Decodes messages from a TCP stream: UInt32 length, little endian, then that many bytes.

use bytes::{Bytes, BytesMut};
use thiserror::Error;

/// A read buffer that returns complete messages without copying them.
#[derive(Debug)]
pub(crate) struct Frames {
    buffer: BytesMut,
    limit: usize,
    /// Size of a read; grows while reads fill it, so that idle links stay small.
    window: usize,
    /// Size of the last message with its length field: the next message is likely to have the same
    /// size.
    last: usize,
}

impl Frames {
    pub(crate) fn new(limit: usize) -> Self {
        Self {
            buffer: BytesMut::with_capacity(MIN_WINDOW),
            limit,
            window: MIN_WINDOW,
            last: 0,
        }
    }

    /// Returns the next complete message if its last byte was received.
    pub(crate) fn next(&mut self) -> Result<Option<Bytes>, FrameTooLong> {
        let Some((len, _)) = self.buffer.split_first_chunk::<4>() else {
            return Ok(None);
        };
        let announced = u32::from_le_bytes(*len);
        let too_long = FrameTooLong {
            announced,
            limit: self.limit,
        };
        let len = usize::try_from(announced).map_err(|_| too_long)?;
        if len > self.limit {
            return Err(too_long);
        }
        if self.buffer.len() - 4 < len {
            return Ok(None);
        }
        self.last = 4 + len;
        let frame = self.buffer.split_to(self.last).freeze();
        Ok(Some(frame.slice(4..)))
    }

    /// Returns whether the buffer holds no part of another message.
    pub(crate) fn is_empty(&self) -> bool {
        self.buffer.is_empty()
    }

    /// Returns the buffer with space for the next read: for the missing part of a message, or for a
    /// message of the size of the last message. Messages of equal size are thus neither read in two
    /// pieces nor moved. An announced length is trusted only as far as the peer delivers: the
    /// buffer at most doubles past `TRUSTED`.
    pub(crate) fn room(&mut self) -> &mut BytesMut {
        let missing = match self.buffer.split_first_chunk::<4>() {
            Some((len, rest)) => usize::try_from(u32::from_le_bytes(*len))
                .unwrap_or(usize::MAX)
                .saturating_sub(rest.len()),
            // An additional byte: a read that does not fill the space has emptied the socket, so
            // that no second read is needed to detect this.
            None => (self.last + 1).saturating_sub(self.buffer.len()),
        };
        let trusted = TRUSTED.max(self.buffer.len());
        let wanted = missing.min(trusted).max(1);
        if self.buffer.capacity() - self.buffer.len() < wanted {
            self.buffer.reserve(wanted.max(self.window));
        }
        &mut self.buffer
    }

    /// Adapts the read size to the number of bytes of a read.
    pub(crate) fn filled(&mut self, read: usize) {
        if read >= self.window {
            self.window = (self.window * 2).min(MAX_WINDOW);
        }
    }
}

/// The peer announced a message longer than the limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error("the peer announced a message of {announced} bytes, more than the limit of {limit}")]
pub(crate) struct FrameTooLong {
    pub(crate) announced: u32,
    pub(crate) limit: usize,
}

const MIN_WINDOW: usize = 4 * 1024;
const MAX_WINDOW: usize = 64 * 1024;
const TRUSTED: usize = 1024 * 1024;

#[cfg(test)]
mod tests {
    use bytes::BufMut;
    use proptest::prelude::*;

    use super::*;

    fn wire(messages: &[Vec<u8>]) -> Vec<u8> {
        let mut out = Vec::new();
        for message in messages {
            out.put_u32_le(u32::try_from(message.len()).unwrap());
            out.put_slice(message);
        }
        out
    }

    #[test]
    fn a_length_past_the_limit_is_refused_before_anything_is_allocated() {
        let mut frames = Frames::new(1000);
        frames.room().put_u32_le(1001);
        assert_eq!(
            frames.next(),
            Err(FrameTooLong {
                announced: 1001,
                limit: 1000
            })
        );
        assert!(frames.buffer.capacity() <= MIN_WINDOW);
    }

    #[test]
    fn an_announced_length_reserves_no_more_than_is_trusted() {
        let mut frames = Frames::new(usize::MAX);
        frames.room().put_u32_le(u32::MAX);
        assert_eq!(frames.next(), Ok(None));
        assert!(frames.room().capacity() < 2 * TRUSTED);
    }

    #[test]
    fn there_is_always_more_room_than_a_message_like_the_last_one_takes() {
        let wire = wire(&[vec![7; 1000]]);
        let mut frames = Frames::new(1000);
        for _ in 0..20 {
            let room = frames.room();
            assert!(room.len() + wire.len() < room.capacity());
            room.put_slice(&wire);
            frames.filled(wire.len());
            assert_eq!(frames.next().unwrap().unwrap().len(), 1000);
        }
    }

    #[test]
    fn a_message_without_content_is_a_message() {
        let mut frames = Frames::new(10);
        frames.room().put_u32_le(0);
        assert_eq!(frames.next(), Ok(Some(Bytes::new())));
        assert_eq!(frames.next(), Ok(None));
    }

    proptest! {
        #[test]
        fn messages_come_out_as_they_went_in_however_tcp_cuts_them(
            messages in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..300), 0..20),
            cuts in prop::collection::vec(1usize..500, 1..50),
        ) {
            let wire = wire(&messages);
            let mut frames = Frames::new(300);
            let mut seen = Vec::new();
            let (mut at, mut cuts) = (0, cuts.into_iter().cycle());
            while at < wire.len() {
                let end = wire.len().min(at + cuts.next().unwrap());
                frames.room().put_slice(&wire[at..end]);
                frames.filled(end - at);
                at = end;
                while let Some(frame) = frames.next().unwrap() {
                    seen.push(frame.to_vec());
                }
            }
            prop_assert_eq!(seen, messages);
        }

        #[test]
        fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            let mut frames = Frames::new(64);
            frames.room().put_slice(&bytes);
            let mut taken = 0;
            while let Ok(Some(frame)) = frames.next() {
                taken += 4 + frame.len();
            }
            prop_assert!(taken <= bytes.len());
        }
    }
}
