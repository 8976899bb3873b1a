//! UADP, the binary message mapping of OPC UA PubSub: encodes and decodes NetworkMessages.
//!
//! The crate covers OPC 10000-14, 7.2.4, in the versions 1.04 and 1.05. Where implementations read
//! the standard differently, it supports each reading:
//!
//! | feature | items |
//! |---|---|
//! | headers, decoded on demand | [`NetworkMessage`], [`DataSetMessage`] |
//! | fields as Variants or DataValues, in key frames, delta frames and events | [`DataSetMessage::fields`], [`DataSetMessage::values`] |
//! | fields as RawData, decoded with their DataSetMetaData | [`RawLayout`] |
//! | encoding into a buffer of the caller | [`NetworkMessageEncoder`] |
//! | chunks | [`ChunkEncoder`], [`Reassembler`] |
//! | message security: PubSub-Aes128-CTR and PubSub-Aes256-CTR | [`Opener`], [`Sealer`] |
//! | probes and announcements, DataSetMetaData | [`discovery`] |
//! | requests and responses of Actions | [`action`] |
//! | calls over a network that loses messages | [`action::Requestor`], [`action::Responder`] |
//! | sequence numbers | [`SequenceOrder`] |
//!
//! Variants of the unassigned builtin types 26 to 31 are decoded as ByteStrings (OPC 10000-6,
//! 5.2.2.16). Chunks with an ActionHeader are [`DecodeError::Unsupported`].
//!
//! The crate has no sockets, clock, threads or randomness: bytes, times and random numbers are
//! parameters. Decoding borrows from the datagram and allocates nothing; decryption and reassembly
//! reuse their buffers. Counts and lengths are checked against the bytes that follow, nesting ends
//! at [`MAX_NESTING`], and no datagram causes a panic.
//!
//! # Features
//! Without the default feature `std`, the crate needs `alloc` only, for microcontrollers and other
//! targets without an operating system. The types and functions are the same.
//!
//! # Reading
//! ```
//! use uadp::{NetworkMessage, PublisherId, Scalar, Variant};
//!
//! let datagram = [
//!     0xF1, 0x01, 0x02, 0x00, // version 1, PublisherId UInt16 2
//!     0x01, 0x05, 0x00, // WriterGroupId 5
//!     0x01, 0x0A, 0x00, // one DataSetMessage, of DataSetWriterId 10
//!     0x01, 0x01, 0x00, // a valid key frame of one field
//!     0x06, 0x2A, 0x00, 0x00, 0x00, // Int32 42
//! ];
//! let message = NetworkMessage::decode(&datagram)?;
//! assert_eq!(message.header().publisher_id, Some(PublisherId::UInt16(2)));
//! for data_set_message in message.messages() {
//!     let data_set_message = data_set_message?;
//!     assert_eq!(data_set_message.writer_id, Some(10));
//!     for field in data_set_message.fields()? {
//!         assert_eq!(field?, Variant::Scalar(Scalar::Int32(42)));
//!     }
//! }
//! # Ok::<(), uadp::DecodeError>(())
//! ```
//!
//! # Writing
//! ```
//! use uadp::{BuiltinType, DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar};
//!
//! let header = NetworkHeader {
//!     publisher_id: Some(PublisherId::UInt16(2)),
//!     group: Some(GroupHeader { writer_group_id: Some(5), ..GroupHeader::default() }),
//!     ..NetworkHeader::default()
//! };
//! let mut datagram = Vec::new();
//! let mut message = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[10]))?;
//! let mut fields = message.key_frame(&DataSetHeader::default())?;
//! fields.scalar(Scalar::Int32(42))?;
//! fields.packed_array(BuiltinType::UInt16, 2, &[1, 0, 2, 0])?;
//! fields.finish()?;
//! message.finish()?;
//! assert_eq!(datagram[10..18], [0x01, 0x02, 0x00, 0x06, 0x2A, 0x00, 0x00, 0x00]);
//! # Ok::<(), uadp::EncodeError>(())
//! ```

#![cfg_attr(not(any(feature = "std", test)), no_std)]

extern crate alloc;

pub mod action;
mod builtin;
mod chunk;
mod configuration_version;
mod data_set_message;
mod delta;
pub mod discovery;
mod encoder;
mod error;
mod field_encoder;
mod hashing;
mod header;
mod header_writer;
mod nested;
mod network_message;
mod node_id;
mod publisher_id;
mod raw;
mod reader;
mod reassembler;
mod scalar;
mod security;
mod sequence;
mod state;
mod structure;
mod time;
mod variant;
mod writer;

pub use builtin::{BuiltinType, Guid, StatusCode};
pub use chunk::{ChunkBudget, ChunkEncoder, ChunkError, PlacedChunk, Whole};
pub use configuration_version::ConfigurationVersion;
pub use data_set_message::{
    DataSetHeader, DataSetMessage, FieldEncoding, FieldValue, FieldValues, Fields, MessageKind,
};
pub use delta::{DeltaNull, MergedFrame};
pub use encoder::NetworkMessageEncoder;
pub use error::{DecodeError, EncodeError};
pub use field_encoder::{DataValueEncoder, DeltaEncoder, FieldEncoder};
pub use header::{GroupHeader, NetworkHeader, NetworkMessageType, PublisherId, SecurityHeader};
pub use header_writer::Extras;
pub use nested::{DataValue, DiagnosticInfo, MAX_NESTING, Nested};
pub use network_message::{Chunk, Messages, NetworkMessage, PromotedFields};
pub use node_id::{ExpandedNodeId, NodeId, NodeIdValue};
pub use publisher_id::OwnedPublisherId;
pub use raw::{
    RawArray, RawDialect, RawElements, RawField, RawFields, RawLayout, RawLayoutError,
    RawLayoutFault, RawMembers, RawStructure, RawStructureType, RawValue, RawWriteError,
    RawWriteFault,
};
pub use reassembler::{
    ChunkRefusal, GiveUp, IncompleteWhole, Reassembled, Reassembler, ReassemblyCounters,
    ReassemblyLimits,
};
pub use scalar::{ExtensionBody, ExtensionObject, LocalizedText, QualifiedName, Scalar};
pub use security::{
    CountedBy, KeyError, OpenedMessage, Opener, OpenerOptions, Seal, SealError, Sealer,
    SecurityError, SecurityMode, SecurityPolicy, TokenKeys,
};
pub use sequence::SequenceOrder;
pub use state::PubSubState;
pub use structure::StructureReader;
pub use time::{DateTime, Timestamp};
pub use variant::{Array, Elements, Matrix, Variant};

/// Runs the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
