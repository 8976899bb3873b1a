//! Buffers for reuse.

/// The buffers of sent datagrams and delivered payloads, so that the next output needs no
/// allocation.
#[derive(Debug, Default)]
pub(crate) struct Buffers {
    spare: Vec<Vec<u8>>,
}

impl Buffers {
    /// Returns an empty buffer.
    pub(crate) fn take(&mut self) -> Vec<u8> {
        self.spare.pop().unwrap_or_default()
    }

    /// Takes a buffer back after use.
    pub(crate) fn give(&mut self, mut buffer: Vec<u8>) {
        if self.spare.len() < SPARE_BUFFERS && buffer.capacity() <= SPARE_CAPACITY {
            buffer.clear();
            self.spare.push(buffer);
        }
    }
}

/// The maximum number of buffers kept for reuse, and the maximum capacity of each.
const SPARE_BUFFERS: usize = 64;
const SPARE_CAPACITY: usize = 128 * 1024;
