//! Samples as bytes: the adapter that keeps RustDDS from interpreting a message.
//!
//! A payload is a serialized message in the format of RTPS (RTPS 2.5, 10.2): an encapsulation
//! header of 4 bytes, which names the byte order, then the CDR body. RustDDS removes the header of
//! received samples and adds it to sent samples, so the adapter does the reverse.

use bytes::Bytes;
use rustdds::no_key::{Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter};
use rustdds::{RepresentationIdentifier, no_key};

use crate::limits;
use crate::node::Listed;

/// The serialized payload of a sample, which starts with the encapsulation header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Payload(Bytes);

impl Payload {
    /// Wraps a payload to be written. With the published RustDDS, a payload is copied and padded if
    /// its length is not a multiple of 4: that version sends the last fragment of a large sample in
    /// its own length, and Cyclone DDS refuses a DATA_FRAG submessage that does not end on a 4 byte
    /// boundary.
    ///
    /// # Errors
    /// [`PayloadError`] if there is no header, or it announces an encoding other than little-endian
    /// CDR, the only encoding that our writers announce.
    pub fn to_write(payload: Bytes) -> Result<Self, PayloadError> {
        match payload.get(..HEADER_LEN) {
            None => return Err(PayloadError::NoHeader(payload.len())),
            Some([0x00, 0x01, _, _]) => {}
            Some(header) => {
                return Err(PayloadError::Encoding(u16::from_be_bytes([
                    header.first().copied().unwrap_or_default(),
                    header.get(1).copied().unwrap_or_default(),
                ])));
            }
        }
        if limits::PATCHED || payload.len().is_multiple_of(ALIGNMENT) {
            return Ok(Self(payload));
        }
        let mut padded = Vec::with_capacity(payload.len().next_multiple_of(ALIGNMENT));
        padded.extend_from_slice(&payload);
        padded.resize(payload.len().next_multiple_of(ALIGNMENT), 0);
        Ok(Self(padded.into()))
    }

    /// Returns the bytes, which start with the encapsulation header.
    #[must_use]
    pub fn into_bytes(self) -> Bytes {
        self.0
    }

    /// Returns the length in bytes, including the header.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Returns whether even the header is missing; no constructor creates such a payload.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

/// The reason for which a payload cannot be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum PayloadError {
    /// Shorter than its encapsulation header.
    NoHeader(usize),
    /// The header names an encoding that our writers do not announce.
    Encoding(u16),
}

impl PayloadError {
    /// Returns the label under which such a sample is counted.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::NoHeader(_) => "shorter than a CDR header",
            Self::Encoding(_) => "not little-endian CDR",
        }
    }
}

/// The adapter for both directions.
#[derive(Debug, Clone, Copy)]
pub struct Opaque;

/// A reader that returns [`Payload`]s, on the list of its node.
pub type PayloadReader = Listed<RawReader>;
/// A writer of [`Payload`]s, on the list of its node.
pub type PayloadWriter = Listed<RawWriter>;
/// A reader that returns [`Payload`]s.
pub type RawReader = no_key::SimpleDataReader<Payload, Opaque>;
/// A writer of [`Payload`]s.
pub type RawWriter = no_key::DataWriter<Payload, Opaque>;

impl DeserializerAdapter<Payload> for Opaque {
    type Error = std::convert::Infallible;
    type Decoded = Payload;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        // Every ROS 2 middleware writes plain CDR. Other encodings are passed on with their header
        // too, so that the decoder of the message, which knows the topic, refuses them by name.
        &[
            RepresentationIdentifier::CDR_LE,
            RepresentationIdentifier::CDR_BE,
            RepresentationIdentifier::PL_CDR_LE,
            RepresentationIdentifier::PL_CDR_BE,
            RepresentationIdentifier::XCDR2_LE,
            RepresentationIdentifier::XCDR2_BE,
            RepresentationIdentifier::D_CDR2_LE,
            RepresentationIdentifier::D_CDR2_BE,
        ]
    }

    fn transform_decoded(decoded: Payload) -> Payload {
        decoded
    }
}

impl DefaultDecoder<Payload> for Opaque {
    type Decoder = Self;
    const DECODER: Self = Self;
}

impl Decode<'_, Payload> for Opaque {
    type Error = std::convert::Infallible;

    fn decode_bytes(
        self,
        body: &[u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Payload, Self::Error> {
        let mut bytes = Vec::with_capacity(HEADER_LEN + body.len());
        bytes.extend_from_slice(&encoding.to_bytes());
        bytes.extend_from_slice(&[0, 0]);
        bytes.extend_from_slice(body);
        Ok(Payload(bytes.into()))
    }
}

impl SerializerAdapter<Payload> for Opaque {
    type Error = std::convert::Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(value: &Payload) -> Result<Bytes, Self::Error> {
        Ok(value.0.slice(HEADER_LEN.min(value.0.len())..))
    }
}

const HEADER_LEN: usize = 4;
const ALIGNMENT: usize = 4;

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(not(feature = "patched-dds"))]
    #[test]
    fn a_payload_is_padded_to_a_multiple_of_four() {
        let payload =
            Payload::to_write(Bytes::from_static(&[0, 1, 0, 0, 2, 0, 0, 0, b'x', 0])).unwrap();
        assert_eq!(
            payload.into_bytes().as_ref(),
            &[0, 1, 0, 0, 2, 0, 0, 0, b'x', 0, 0, 0]
        );
    }

    #[test]
    fn an_aligned_payload_is_not_copied() {
        let bytes = Bytes::from(vec![0, 1, 0, 0, 7, 0, 0, 0]);
        let payload = Payload::to_write(bytes.clone()).unwrap();
        assert_eq!(payload.into_bytes().as_ptr(), bytes.as_ptr());
    }

    #[test]
    fn only_little_endian_cdr_is_written() {
        assert_eq!(
            Payload::to_write(Bytes::from_static(&[0, 0, 0, 0, 7])),
            Err(PayloadError::Encoding(0))
        );
        assert_eq!(
            Payload::to_write(Bytes::from_static(&[0, 1, 0])),
            Err(PayloadError::NoHeader(3))
        );
    }

    #[test]
    fn a_received_payload_starts_with_its_byte_order() {
        let payload = Opaque
            .decode_bytes(&[0, 0, 0, 5], RepresentationIdentifier::CDR_BE)
            .unwrap();
        assert_eq!(payload.into_bytes().as_ref(), &[0, 0, 0, 0, 0, 0, 0, 5]);
    }

    #[test]
    fn the_header_is_not_written_twice() {
        let payload = Payload::to_write(Bytes::from_static(&[0, 1, 0, 0, 7, 0, 0, 0])).unwrap();
        assert_eq!(Opaque::to_bytes(&payload).unwrap().as_ref(), &[7, 0, 0, 0]);
    }
}
