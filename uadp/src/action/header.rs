//! The ActionHeader, shared by all requests or responses of a NetworkMessage.

use alloc::vec::Vec;
use core::time::Duration;

use crate::reader::ByteReader;
use crate::writer::{self, flag};
use crate::{DecodeError, EncodeError, PublisherId, Scalar, Variant};

/// Direction of an Action message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ActionKind {
    /// From a Requestor (OPC 10000-14, 7.2.4.5.9).
    Request,
    /// From the Responder (OPC 10000-14, 7.2.4.5.10).
    Response,
}

/// ActionHeader of a NetworkMessage (OPC 10000-14, 7.2.4.4.2). Fields that are `None` are not
/// encoded.
///
/// The header follows the SecurityHeader and is encrypted with the payload. The bits of the
/// ActionFlags are numbered as in UA-.NETStandard 2.0, the only implementation available for
/// comparison: bit 0 request, 1 ResponseAddress, 2 CorrelationData, 3 RequestorId, 4 TimeoutHint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionHeader<'a> {
    /// Requests or responses.
    pub kind: ActionKind,
    /// Requested address of the response, such as `opc.udp://239.0.0.1:4840`. Without it, the
    /// response goes to the source of the request (OPC 10000-14, 7.3.2.3). The field is not
    /// trustworthy: a sender can name any host, and responding to that host lets the sender attack
    /// it.
    pub response_address: Option<&'a str>,
    /// Data that the Responder copies into the response.
    pub correlation_data: Option<&'a [u8]>,
    /// PublisherId of the Requestor. The PublisherId in the NetworkMessage header is the
    /// Responder's.
    pub requestor_id: Option<PublisherId<'a>>,
    /// Time that the Requestor waits for the response, in milliseconds: see
    /// [`timeout`](Self::timeout).
    pub timeout_hint: Option<f64>,
}

impl<'a> ActionHeader<'a> {
    /// Creates a header without optional fields.
    #[must_use]
    pub const fn new(kind: ActionKind) -> Self {
        Self {
            kind,
            response_address: None,
            correlation_data: None,
            requestor_id: None,
            timeout_hint: None,
        }
    }

    /// Returns the TimeoutHint as a duration, or `None` if it is absent, 0, negative or not a
    /// number.
    #[must_use]
    pub fn timeout(&self) -> Option<Duration> {
        let seconds = self.timeout_hint.filter(|hint| *hint > 0.0)? / 1000.0;
        Some(Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX))
    }

    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let flags = reader.u8("ActionFlags")?;
        if flags & RESERVED != 0 {
            return Err(DecodeError::Reserved {
                field: "ActionFlags",
                value: (flags & RESERVED).into(),
            });
        }
        let kind = match flags & REQUEST {
            0 => ActionKind::Response,
            _ => ActionKind::Request,
        };
        let response_address = match flags & RESPONSE_ADDRESS {
            0 => None,
            _ => Some(present(
                reader.text("ResponseAddress")?,
                "ResponseAddress length",
            )?),
        };
        let correlation_data = match flags & CORRELATION_DATA {
            0 => None,
            _ => Some(present(
                reader.byte_string("CorrelationData")?,
                "CorrelationData length",
            )?),
        };
        let requestor_id = match flags & REQUESTOR_ID {
            0 => None,
            _ => Some(read_requestor_id(reader)?),
        };
        let timeout_hint = match flags & TIMEOUT_HINT {
            0 => None,
            _ => Some(f64::from_le_bytes(reader.array("TimeoutHint")?)),
        };
        Ok(Self {
            kind,
            response_address,
            correlation_data,
            requestor_id,
            timeout_hint,
        })
    }

    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        out.push(
            flag(self.kind == ActionKind::Request, REQUEST)
                | flag(self.response_address.is_some(), RESPONSE_ADDRESS)
                | flag(self.correlation_data.is_some(), CORRELATION_DATA)
                | flag(self.requestor_id.is_some(), REQUESTOR_ID)
                | flag(self.timeout_hint.is_some(), TIMEOUT_HINT),
        );
        if let Some(address) = self.response_address {
            writer::byte_string(out, Some(address.as_bytes()), "ResponseAddress")?;
        }
        if let Some(data) = self.correlation_data {
            writer::byte_string(out, Some(data), "CorrelationData")?;
        }
        if let Some(id) = self.requestor_id {
            let id = match id {
                PublisherId::Byte(id) => Scalar::Byte(id),
                PublisherId::UInt16(id) => Scalar::UInt16(id),
                PublisherId::UInt32(id) => Scalar::UInt32(id),
                PublisherId::UInt64(id) => Scalar::UInt64(id),
                PublisherId::String(id) => Scalar::String(Some(id)),
            };
            Variant::Scalar(id).write(out)?;
        }
        if let Some(hint) = self.timeout_hint {
            out.extend_from_slice(&hint.to_le_bytes());
        }
        Ok(())
    }
}

/// Reads a Variant of a type that a PublisherId can have (OPC 10000-14, 6.2.7.1).
fn read_requestor_id<'a>(reader: &mut ByteReader<'a>) -> Result<PublisherId<'a>, DecodeError> {
    let reserved = DecodeError::Reserved {
        field: "RequestorId",
        value: reader.rest().first().copied().unwrap_or_default().into(),
    };
    let Variant::Scalar(id) = Variant::read(reader)? else {
        return Err(reserved);
    };
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "the types a PublisherId has; all others are not one"
    )]
    match id {
        Scalar::Byte(id) => Ok(PublisherId::Byte(id)),
        Scalar::UInt16(id) => Ok(PublisherId::UInt16(id)),
        Scalar::UInt32(id) => Ok(PublisherId::UInt32(id)),
        Scalar::UInt64(id) => Ok(PublisherId::UInt64(id)),
        Scalar::String(Some(id)) => Ok(PublisherId::String(id)),
        _ => Err(reserved),
    }
}

/// Rejects a null value, because its flag is set.
fn present<T>(value: Option<T>, field: &'static str) -> Result<T, DecodeError> {
    value.ok_or(DecodeError::Reserved {
        field,
        value: u32::MAX,
    })
}

const REQUEST: u8 = 0x01;
const RESPONSE_ADDRESS: u8 = 0x02;
const CORRELATION_DATA: u8 = 0x04;
const REQUESTOR_ID: u8 = 0x08;
const TIMEOUT_HINT: u8 = 0x10;
const RESERVED: u8 = 0xE0;
