//! NodeId and ExpandedNodeId.

use crate::reader::ByteReader;
use crate::{DecodeError, EncodeError, Guid, writer};
use alloc::vec::Vec;

/// NodeId (OPC 10000-6, 5.2.2.9). It is encoded in its shortest form, independent of the form it
/// was decoded from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct NodeId<'a> {
    /// Index into the sender's namespace array.
    pub namespace: u16,
    /// Identifier of the node within the namespace.
    pub identifier: NodeIdValue<'a>,
}

/// Identifier part of a [`NodeId`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[expect(missing_docs, reason = "the names are those of the standard's IdType")]
pub enum NodeIdValue<'a> {
    Numeric(u32),
    String(Option<&'a str>),
    Guid(Guid),
    Opaque(Option<&'a [u8]>),
}

/// ExpandedNodeId (OPC 10000-6, 5.2.2.10).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ExpandedNodeId<'a> {
    /// The node; its namespace index is meaningless if there is a URI.
    pub node_id: NodeId<'a>,
    /// URI of the namespace. A null URI is decoded as `None`.
    pub namespace_uri: Option<&'a str>,
    /// Index into the sender's server array; 0, the local server, is not encoded.
    pub server_index: u32,
}

impl<'a> NodeId<'a> {
    /// The null NodeId, `i=0`.
    pub const NULL: Self = Self::numeric(0, 0);

    /// Creates a NodeId with a numeric identifier.
    #[must_use]
    pub const fn numeric(namespace: u16, identifier: u32) -> Self {
        Self {
            namespace,
            identifier: NodeIdValue::Numeric(identifier),
        }
    }

    /// Creates a NodeId with a string identifier.
    #[must_use]
    pub const fn string(namespace: u16, identifier: &'a str) -> Self {
        Self {
            namespace,
            identifier: NodeIdValue::String(Some(identifier)),
        }
    }

    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let encoding = reader.u8("NodeId")?;
        Self::read_encoded(encoding, reader)
    }

    fn read_encoded(encoding: u8, reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let (namespace, identifier) = match encoding {
            TWO_BYTE => (
                0,
                NodeIdValue::Numeric(reader.u8("NodeId identifier")?.into()),
            ),
            FOUR_BYTE => (
                reader.u8("NodeId namespace")?.into(),
                NodeIdValue::Numeric(reader.u16("NodeId identifier")?.into()),
            ),
            NUMERIC => (
                reader.u16("NodeId namespace")?,
                NodeIdValue::Numeric(reader.u32("NodeId identifier")?),
            ),
            STRING => (
                reader.u16("NodeId namespace")?,
                NodeIdValue::String(reader.text("NodeId identifier")?),
            ),
            GUID => (
                reader.u16("NodeId namespace")?,
                NodeIdValue::Guid(Guid(reader.array("NodeId identifier")?)),
            ),
            OPAQUE => (
                reader.u16("NodeId namespace")?,
                NodeIdValue::Opaque(reader.byte_string("NodeId identifier")?),
            ),
            _ => {
                return Err(DecodeError::Reserved {
                    field: "NodeId encoding",
                    value: encoding.into(),
                });
            }
        };
        Ok(Self {
            namespace,
            identifier,
        })
    }

    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        self.write_flagged(0, out)
    }

    fn write_flagged(&self, flags: u8, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let [low, high] = self.namespace.to_le_bytes();
        match self.identifier {
            NodeIdValue::Numeric(identifier) => {
                let [a, b, c, d] = identifier.to_le_bytes();
                match (high, low, [b, c, d]) {
                    (0, 0, [0, 0, 0]) => out.extend_from_slice(&[flags | TWO_BYTE, a]),
                    (0, _, [_, 0, 0]) => out.extend_from_slice(&[flags | FOUR_BYTE, low, a, b]),
                    _ => out.extend_from_slice(&[flags | NUMERIC, low, high, a, b, c, d]),
                }
                Ok(())
            }
            NodeIdValue::String(text) => {
                out.extend_from_slice(&[flags | STRING, low, high]);
                writer::byte_string(out, text.map(str::as_bytes), "NodeId identifier")
            }
            NodeIdValue::Guid(guid) => {
                out.extend_from_slice(&[flags | GUID, low, high]);
                out.extend_from_slice(&guid.0);
                Ok(())
            }
            NodeIdValue::Opaque(bytes) => {
                out.extend_from_slice(&[flags | OPAQUE, low, high]);
                writer::byte_string(out, bytes, "NodeId identifier")
            }
        }
    }
}

impl<'a> From<NodeId<'a>> for ExpandedNodeId<'a> {
    fn from(node_id: NodeId<'a>) -> Self {
        Self {
            node_id,
            namespace_uri: None,
            server_index: 0,
        }
    }
}

impl<'a> ExpandedNodeId<'a> {
    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let encoding = reader.u8("ExpandedNodeId")?;
        let node_id = NodeId::read_encoded(encoding & !(HAS_URI | HAS_SERVER), reader)?;
        let namespace_uri = match encoding & HAS_URI {
            0 => None,
            _ => reader.text("ExpandedNodeId NamespaceUri")?,
        };
        let server_index = match encoding & HAS_SERVER {
            0 => 0,
            _ => reader.u32("ExpandedNodeId ServerIndex")?,
        };
        Ok(Self {
            node_id,
            namespace_uri,
            server_index,
        })
    }

    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let mut flags = 0;
        if self.namespace_uri.is_some() {
            flags |= HAS_URI;
        }
        if self.server_index != 0 {
            flags |= HAS_SERVER;
        }
        self.node_id.write_flagged(flags, out)?;
        if let Some(uri) = self.namespace_uri {
            writer::byte_string(out, Some(uri.as_bytes()), "ExpandedNodeId NamespaceUri")?;
        }
        if self.server_index != 0 {
            out.extend_from_slice(&self.server_index.to_le_bytes());
        }
        Ok(())
    }
}

const TWO_BYTE: u8 = 0;
const FOUR_BYTE: u8 = 1;
const NUMERIC: u8 = 2;
const STRING: u8 = 3;
const GUID: u8 = 4;
const OPAQUE: u8 = 5;
const HAS_SERVER: u8 = 0x40;
const HAS_URI: u8 = 0x80;
