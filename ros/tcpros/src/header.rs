//! The connection header, which two TCPROS peers exchange before the first message.
//!
//! On the wire: UInt32 length of all fields, then per field UInt32 length and `name=value`, little
//! endian.

use std::collections::BTreeMap;

use thiserror::Error;
use tokio::io::{AsyncRead, AsyncReadExt};

/// The fields of a connection header by name.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ConnectionHeader {
    fields: BTreeMap<String, String>,
}

impl ConnectionHeader {
    /// Reads the fields of a header without its leading total length. Text that is not UTF-8 (old
    /// message definitions have Latin-1 comments) is kept with U+FFFD in place of the bytes that do
    /// not decode.
    pub fn parse(mut bytes: &[u8]) -> Result<Self, HeaderError> {
        let mut fields = BTreeMap::new();
        while !bytes.is_empty() {
            let Some((len, rest)) = bytes.split_first_chunk::<4>() else {
                return Err(HeaderError::Truncated);
            };
            let len =
                usize::try_from(u32::from_le_bytes(*len)).map_err(|_| HeaderError::Truncated)?;
            let Some((field, rest)) = rest.split_at_checked(len) else {
                return Err(HeaderError::Truncated);
            };
            let text = String::from_utf8_lossy(field);
            let Some((name, value)) = text.split_once('=') else {
                return Err(HeaderError::NoEquals);
            };
            if fields.len() == MAX_FIELDS {
                return Err(HeaderError::TooManyFields);
            }
            fields.insert(name.to_owned(), value.to_owned());
            bytes = rest;
        }
        Ok(Self { fields })
    }

    /// Reads a whole header. The caller has to apply a time limit.
    pub(crate) async fn read(stream: &mut (impl AsyncRead + Unpin)) -> Result<Self, HeaderError> {
        let len = stream.read_u32_le().await?;
        if len > MAX_HEADER {
            return Err(HeaderError::TooLong(len));
        }
        let mut bytes = vec![0; usize::try_from(len).map_err(|_| HeaderError::TooLong(len))?];
        stream.read_exact(&mut bytes).await?;
        Self::parse(&bytes)
    }

    /// Returns the header as on the wire, with its leading total length.
    ///
    /// # Errors
    /// Fails if the header is longer than the limit of peers, 1 MiB.
    pub fn encode(&self) -> Result<Vec<u8>, HeaderError> {
        let mut out = vec![0; 4];
        for (name, value) in &self.fields {
            out.extend_from_slice(&length(name.len() + 1 + value.len())?.to_le_bytes());
            out.extend_from_slice(name.as_bytes());
            out.push(b'=');
            out.extend_from_slice(value.as_bytes());
        }
        let total = length(out.len() - 4)?;
        if let Some(head) = out.first_chunk_mut::<4>() {
            *head = total.to_le_bytes();
        }
        Ok(out)
    }

    /// Adds a field, replacing a field of the same name.
    #[must_use]
    pub fn with(mut self, name: &str, value: impl Into<String>) -> Self {
        self.fields.insert(name.to_owned(), value.into());
        self
    }

    /// Returns a field by name.
    pub fn get(&self, name: &str) -> Option<&str> {
        self.fields.get(name).map(String::as_str)
    }

    /// Returns `callerid`, the resolved name of the node that sent the header, or an empty text.
    pub fn caller_id(&self) -> &str {
        self.get("callerid").unwrap_or("")
    }

    /// Returns `type`, such as `std_msgs/String`; `*` stands for any type.
    pub fn type_name(&self) -> Option<&str> {
        self.get("type")
    }

    /// Returns `md5sum` of the type; `*` stands for any type.
    pub fn md5sum(&self) -> Option<&str> {
        self.get("md5sum")
    }

    /// Returns `message_definition`, the text of the type followed by the texts of the contained
    /// types.
    pub fn message_definition(&self) -> Option<&str> {
        self.get("message_definition")
    }

    /// Returns whether the publisher repeats its last message to late subscribers.
    pub fn latching(&self) -> bool {
        self.get("latching") == Some("1")
    }

    /// Returns all fields in the order of their names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        self.fields
            .iter()
            .map(|(name, value)| (name.as_str(), value.as_str()))
    }
}

/// Error while reading or writing a connection header.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum HeaderError {
    /// A length exceeds the header.
    #[error("a field of the connection header runs past its end")]
    Truncated,
    /// A field is not `name=value`.
    #[error("a field of the connection header has no `=`")]
    NoEquals,
    /// The header is longer than 1 MiB.
    #[error("the connection header has {0} bytes, more than {MAX_HEADER}")]
    TooLong(u32),
    /// The header has more fields than any valid peer sends.
    #[error("the connection header has more than {MAX_FIELDS} fields")]
    TooManyFields,
    /// The connection failed while the header was read.
    #[error("the connection ended within the header")]
    Io(#[from] std::io::Error),
}

/// Clips a text of a peer to the length for replies and log entries.
pub(crate) fn clipped(text: &str) -> &str {
    let rest = text.char_indices().nth(MAX_QUOTED);
    rest.map_or(text, |(end, _)| text.split_at(end).0)
}

fn length(bytes: usize) -> Result<u32, HeaderError> {
    let len = u32::try_from(bytes).map_err(|_| HeaderError::TooLong(u32::MAX))?;
    if len > MAX_HEADER {
        Err(HeaderError::TooLong(len))
    } else {
        Ok(len)
    }
}

const MAX_HEADER: u32 = 1 << 20;
const MAX_FIELDS: usize = 256;
const MAX_QUOTED: usize = 256;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_header_of_roscpp_reads_by_name() {
        let header = ConnectionHeader::parse(
            b"\x10\0\0\0callerid=/talker\x0a\0\0\0latching=1\x14\0\0\0type=std_msgs/String",
        )
        .unwrap();
        assert_eq!(header.caller_id(), "/talker");
        assert_eq!(header.type_name(), Some("std_msgs/String"));
        assert!(header.latching());
        assert_eq!(header.md5sum(), None);
    }

    #[test]
    fn text_that_is_not_utf8_does_not_lose_the_connection() {
        let header = ConnectionHeader::parse(b"\x08\0\0\0comm=\xb0C.").unwrap();
        assert_eq!(header.get("comm"), Some("\u{fffd}C."));
    }

    #[test]
    fn a_value_may_hold_equals_signs() {
        let header = ConnectionHeader::parse(b"\x06\0\0\0a=b=c=").unwrap();
        assert_eq!(header.get("a"), Some("b=c="));
    }

    #[test]
    fn what_a_peer_says_is_quoted_in_part_only() {
        assert_eq!(clipped("/talker"), "/talker");
        assert_eq!(clipped(&"\u{20ac}".repeat(1000)), "\u{20ac}".repeat(256));
    }

    #[tokio::test]
    async fn a_header_that_announces_two_gibibytes_is_refused_unread() {
        let mut wire: &[u8] = &[0, 0, 0, 0x80, 1, 2, 3];
        let refused = ConnectionHeader::read(&mut wire).await;
        assert!(matches!(refused, Err(HeaderError::TooLong(0x8000_0000))));
    }

    proptest! {
        #[test]
        fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            if let Ok(header) = ConnectionHeader::parse(&bytes) {
                prop_assert!(header.fields.len() <= bytes.len() / 5);
            }
        }

        #[test]
        fn a_written_header_reads_back_equal(fields in prop::collection::btree_map("[a-z_]{0,8}", ".{0,20}", 0..8)) {
            let header = ConnectionHeader { fields };
            let wire = header.encode().unwrap();
            prop_assert_eq!(ConnectionHeader::parse(&wire[4..]).unwrap(), header);
        }

        #[test]
        fn a_cut_field_is_an_error(value in "[a-z]{1,20}", cut in 1usize..20) {
            let wire = ConnectionHeader::default().with("name", value.clone()).encode().unwrap();
            let cut = cut.min(value.len());
            prop_assert!(matches!(ConnectionHeader::parse(&wire[4..wire.len() - cut]), Err(HeaderError::Truncated)));
        }
    }
}
