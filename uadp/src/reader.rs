//! A slice that is consumed from the left. Reads take the name of the field for the error of a
//! truncated field.

use crate::DecodeError;

/// The unread bytes. A reader over a prefix cannot read beyond the prefix.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ByteReader<'a> {
    rest: &'a [u8],
}

impl<'a> ByteReader<'a> {
    #[inline]
    pub(crate) const fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    #[inline]
    pub(crate) const fn rest(&self) -> &'a [u8] {
        self.rest
    }

    #[inline]
    pub(crate) const fn remaining(&self) -> usize {
        self.rest.len()
    }

    /// Returns the number of bytes read after `before`, an earlier copy of this reader.
    #[inline]
    pub(crate) const fn since_start(&self, before: &Self) -> usize {
        before.rest.len().saturating_sub(self.rest.len())
    }

    /// Returns the bytes read after `before`, an earlier copy of this reader.
    #[inline]
    pub(crate) fn since(&self, before: &Self) -> &'a [u8] {
        let read = before.rest.len().saturating_sub(self.rest.len());
        before.rest.get(..read).unwrap_or_default()
    }

    #[inline]
    pub(crate) const fn array<const N: usize>(
        &mut self,
        what: &'static str,
    ) -> Result<[u8; N], DecodeError> {
        match self.rest.split_first_chunk::<N>() {
            Some((head, rest)) => {
                self.rest = rest;
                Ok(*head)
            }
            None => Err(DecodeError::Truncated {
                field: what,
                expected: N,
                found: self.rest.len(),
            }),
        }
    }

    #[inline]
    pub(crate) const fn bytes(
        &mut self,
        len: usize,
        what: &'static str,
    ) -> Result<&'a [u8], DecodeError> {
        match self.rest.split_at_checked(len) {
            Some((head, rest)) => {
                self.rest = rest;
                Ok(head)
            }
            None => Err(DecodeError::Truncated {
                field: what,
                expected: len,
                found: self.rest.len(),
            }),
        }
    }

    /// Takes the remaining bytes.
    #[inline]
    pub(crate) const fn take_rest(&mut self) -> &'a [u8] {
        let rest = self.rest;
        self.rest = &[];
        rest
    }

    /// Splits off the last `len` bytes. Returns the bytes before them, and the last bytes.
    pub(crate) fn split_end(
        &self,
        len: usize,
        what: &'static str,
    ) -> Result<(Self, Self), DecodeError> {
        let cut = DecodeError::Truncated {
            field: what,
            expected: len,
            found: self.rest.len(),
        };
        let at = self.rest.len().checked_sub(len).ok_or(cut)?;
        let (head, tail) = self.rest.split_at_checked(at).ok_or(cut)?;
        Ok((Self::new(head), Self::new(tail)))
    }

    /// Takes `count` UInt16 without decoding them.
    #[inline]
    pub(crate) fn u16s(
        &mut self,
        count: u8,
        what: &'static str,
    ) -> Result<&'a [[u8; 2]], DecodeError> {
        let (pairs, _) = self.bytes(usize::from(count) * 2, what)?.as_chunks();
        Ok(pairs)
    }

    #[inline]
    pub(crate) fn u8(&mut self, what: &'static str) -> Result<u8, DecodeError> {
        self.array(what).map(u8::from_le_bytes)
    }

    #[inline]
    pub(crate) fn u16(&mut self, what: &'static str) -> Result<u16, DecodeError> {
        self.array(what).map(u16::from_le_bytes)
    }

    #[inline]
    pub(crate) fn u32(&mut self, what: &'static str) -> Result<u32, DecodeError> {
        self.array(what).map(u32::from_le_bytes)
    }

    #[inline]
    pub(crate) fn i32(&mut self, what: &'static str) -> Result<i32, DecodeError> {
        self.array(what).map(i32::from_le_bytes)
    }

    #[inline]
    pub(crate) fn i64(&mut self, what: &'static str) -> Result<i64, DecodeError> {
        self.array(what).map(i64::from_le_bytes)
    }

    /// Reads an Int32 length, `None` for -1.
    #[inline]
    pub(crate) fn length(&mut self, what: &'static str) -> Result<Option<usize>, DecodeError> {
        let length = self.i32(what)?;
        match usize::try_from(length) {
            Ok(length) => Ok(Some(length)),
            Err(_) if length == -1 => Ok(None),
            Err(_) => Err(DecodeError::Reserved {
                field: what,
                value: length.cast_unsigned(),
            }),
        }
    }

    /// Reads a ByteString (OPC 10000-6, 5.2.2.7), `None` for null.
    #[inline]
    pub(crate) fn byte_string(
        &mut self,
        what: &'static str,
    ) -> Result<Option<&'a [u8]>, DecodeError> {
        match self.length(what)? {
            Some(length) => self.bytes(length, what).map(Some),
            None => Ok(None),
        }
    }

    /// Reads a String (OPC 10000-6, 5.2.2.4), `None` for null.
    #[inline]
    pub(crate) fn text(&mut self, what: &'static str) -> Result<Option<&'a str>, DecodeError> {
        match self.byte_string(what)? {
            Some(bytes) => match str::from_utf8(bytes) {
                Ok(text) => Ok(Some(text)),
                Err(_) => Err(DecodeError::Text(what)),
            },
            None => Ok(None),
        }
    }
}
