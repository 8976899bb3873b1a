//! CDR of the few interfaces that every ROS node has; `messages` encodes and decodes all others.
//!
//! Plain CDR (OMG CORBA 3.3 part 2, 9.3) after the encapsulation header of RTPS: both byte orders
//! are decoded, little endian is encoded. The reader stays within the bytes and validates every
//! length.

use bytes::Bytes;

/// Reads the fields of a message in order.
#[derive(Debug, Clone)]
pub(crate) struct CdrReader<'b> {
    body: &'b [u8],
    at: usize,
    big: bool,
}

/// The bytes end before the message does, or are invalid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Malformed;

impl<'b> CdrReader<'b> {
    /// Creates a reader of a payload with its encapsulation header.
    pub(crate) fn new(payload: &'b [u8]) -> Result<Self, Malformed> {
        let (header, body) = payload.split_first_chunk::<4>().ok_or(Malformed)?;
        let big = match header {
            [0, 0, ..] => true,
            [0, 1, ..] => false,
            _ => return Err(Malformed),
        };
        Ok(Self { body, at: 0, big })
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        let start = self.at.next_multiple_of(N);
        let rest = self.body.get(start..).ok_or(Malformed)?;
        let mut bytes = *rest.first_chunk::<N>().ok_or(Malformed)?;
        self.at = start + N;
        if self.big {
            bytes.reverse();
        }
        Ok(bytes)
    }

    pub(crate) fn u8(&mut self) -> Result<u8, Malformed> {
        self.take::<1>().map(u8::from_le_bytes)
    }

    pub(crate) fn bool(&mut self) -> Result<bool, Malformed> {
        self.u8().map(|byte| byte != 0)
    }

    pub(crate) fn i32(&mut self) -> Result<i32, Malformed> {
        self.take().map(i32::from_le_bytes)
    }

    pub(crate) fn u32(&mut self) -> Result<u32, Malformed> {
        self.take().map(u32::from_le_bytes)
    }

    pub(crate) fn u64(&mut self) -> Result<u64, Malformed> {
        self.take().map(u64::from_le_bytes)
    }

    pub(crate) fn i64(&mut self) -> Result<i64, Malformed> {
        self.take().map(i64::from_le_bytes)
    }

    pub(crate) fn f64(&mut self) -> Result<f64, Malformed> {
        self.take().map(f64::from_le_bytes)
    }

    /// Reads a string; U+FFFD replaces bytes that are not UTF-8.
    pub(crate) fn string(&mut self) -> Result<String, Malformed> {
        let length = usize::try_from(self.u32()?).map_err(|_| Malformed)?;
        let end = self.at.checked_add(length).ok_or(Malformed)?;
        let bytes = self.body.get(self.at..end).ok_or(Malformed)?;
        self.at = end;
        // The length includes the terminating zero; some writers send an empty string without it.
        let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        Ok(String::from_utf8_lossy(text).into_owned())
    }

    /// Reads a sequence; each element has at least one byte.
    pub(crate) fn sequence<T>(
        &mut self,
        mut element: impl FnMut(&mut Self) -> Result<T, Malformed>,
    ) -> Result<Vec<T>, Malformed> {
        let length = usize::try_from(self.u32()?).map_err(|_| Malformed)?;
        if length > self.body.len().saturating_sub(self.at) {
            return Err(Malformed);
        }
        (0..length).map(|_| element(self)).collect()
    }
}

/// Writes the fields of a message in order.
#[derive(Debug, Clone)]
pub(crate) struct CdrWriter {
    bytes: Vec<u8>,
}

impl CdrWriter {
    pub(crate) fn new() -> Self {
        Self {
            bytes: vec![0, 1, 0, 0],
        }
    }

    /// Returns the payload with its encapsulation header.
    pub(crate) fn finish(self) -> Bytes {
        self.bytes.into()
    }

    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        // The header of 4 bytes does not count for the alignment.
        let body = self.bytes.len() - 4;
        self.bytes.resize(4 + body.next_multiple_of(N), 0);
        self.bytes.extend_from_slice(&bytes);
    }

    pub(crate) fn u8(&mut self, value: u8) {
        self.put([value]);
    }

    pub(crate) fn bool(&mut self, value: bool) {
        self.put([u8::from(value)]);
    }

    pub(crate) fn i32(&mut self, value: i32) {
        self.put(value.to_le_bytes());
    }

    pub(crate) fn u32(&mut self, value: u32) {
        self.put(value.to_le_bytes());
    }

    pub(crate) fn u64(&mut self, value: u64) {
        self.put(value.to_le_bytes());
    }

    pub(crate) fn i64(&mut self, value: i64) {
        self.put(value.to_le_bytes());
    }

    pub(crate) fn f64(&mut self, value: f64) {
        self.put(value.to_le_bytes());
    }

    fn length(&mut self, length: usize) {
        // A length above 32 bits does not fit a sample either.
        self.u32(u32::try_from(length).unwrap_or(u32::MAX));
    }

    pub(crate) fn string(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.bytes.extend_from_slice(text.as_bytes());
        self.bytes.push(0);
    }

    pub(crate) fn sequence<T>(&mut self, values: &[T], mut element: impl FnMut(&mut Self, &T)) {
        self.length(values.len());
        for value in values {
            element(self, value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_aligned_and_read_again() {
        let mut writer = CdrWriter::new();
        writer.bool(true);
        writer.i64(-2);
        writer.string("ab");
        writer.sequence(&[1.5, 2.5], |writer, value| writer.f64(*value));
        let bytes = writer.finish();
        assert_eq!(bytes.len(), 4 + 8 + 8 + 7 + 1 + 4 + 4 + 16);
        let mut reader = CdrReader::new(&bytes).unwrap();
        assert_eq!(reader.bool(), Ok(true));
        assert_eq!(reader.i64(), Ok(-2));
        assert_eq!(reader.string().as_deref(), Ok("ab"));
        assert_eq!(reader.sequence(CdrReader::f64), Ok(vec![1.5, 2.5]));
        assert_eq!(reader.u8(), Err(Malformed));
    }

    #[test]
    fn big_endian_is_read() {
        let mut reader = CdrReader::new(&[0, 0, 0, 0, 0, 0, 0, 3, b'a', b'b', 0]).unwrap();
        assert_eq!(reader.string().as_deref(), Ok("ab"));
    }

    #[test]
    fn a_length_is_not_believed() {
        let bytes = [0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff, 1, 2];
        let mut reader = CdrReader::new(&bytes).unwrap();
        assert_eq!(reader.clone().string(), Err(Malformed));
        assert_eq!(reader.sequence(CdrReader::u8), Err(Malformed));
    }
}
