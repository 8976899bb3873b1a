//! Maps requests and replies to samples and correlates them, which each vendor's ROS 2 middleware
//! does differently.
//!
//! The mapping is chosen per peer by its vendor: a server replies to each client in the client's
//! mapping, and a client sends each server a request in the server's mapping. The module is pure:
//! bytes and identities in, bytes and identities out.

use bytes::{Bytes, BytesMut};
use rustdds::rpc::SampleIdentity;
use rustdds::{GUID, SequenceNumber};

/// The mapping of a vendor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ServiceMapping {
    /// The mapping of rmw_cyclonedds: 16 bytes in front of the body of requests and replies, which
    /// are 8 bytes that identify the client and an Int64 that counts its requests
    /// (`cdds_request_header_t`).
    Cyclone,
    /// The mapping of rmw_fastrtps, ros2-client and this bridge: the payload has no header. The
    /// reply names the request in its related sample identity (DDS-RPC 1.0, 7.8.2, "enhanced"), as
    /// client and sequence number. The client is the GUID in the request's own related sample
    /// identity, which is the GUID of the reader for the replies; without it, the GUID of the
    /// request's writer.
    Enhanced,
}

impl ServiceMapping {
    /// Returns the mapping of a vendor, by its number in the OMG's list.
    #[must_use]
    pub fn of(vendor: [u8; 2]) -> Self {
        if vendor == CYCLONE {
            Self::Cyclone
        } else {
            Self::Enhanced
        }
    }
}

/// A received sample.
#[derive(Debug, Clone)]
pub(crate) struct ReceivedServiceSample {
    /// The payload, which starts with the encapsulation header.
    pub(crate) payload: Bytes,
    pub(crate) writer: GUID,
    pub(crate) sequence: i64,
    pub(crate) related: Option<SampleIdentity>,
}

/// A sample to be written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct OutgoingServiceSample {
    /// The payload, which starts with the encapsulation header and is not padded.
    pub(super) payload: Bytes,
    pub(super) related: Option<SampleIdentity>,
}

/// The data of a request that a server needs for the reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ReplyTo {
    Cyclone {
        header: [u8; CYCLONE_HEADER],
        client: GUID,
    },
    Enhanced {
        identity: SampleIdentity,
        client: GUID,
    },
}

impl ReplyTo {
    /// Returns the writer of the request.
    pub(super) const fn client(&self) -> GUID {
        match self {
            Self::Cyclone { client, .. } | Self::Enhanced { client, .. } => *client,
        }
    }

    /// Returns the reader for the reply, if the request names it.
    pub(super) fn reader(&self) -> Option<GUID> {
        match self {
            Self::Cyclone { .. } => None,
            Self::Enhanced { identity, client } => {
                (identity.writer_guid != *client).then_some(identity.writer_guid)
            }
        }
    }
}

/// The reason for which a sample is not a valid request or reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fault {
    /// The encoding is not plain CDR.
    Encoding,
    /// The payload ends within its header.
    Short,
}

impl Fault {
    pub(super) const fn label(self) -> &'static str {
        match self {
            Self::Encoding => "not plain CDR",
            Self::Short => "ends within its header",
        }
    }
}

/// Splits a request into the data for its reply and the body after an encapsulation header.
pub(super) fn open_request(
    mapping: ServiceMapping,
    received: ReceivedServiceSample,
) -> Result<(ReplyTo, Bytes), Fault> {
    let order = ByteOrder::of(&received.payload)?;
    let client = received.writer;
    match mapping {
        ServiceMapping::Cyclone => {
            let (header, body) = split(&received.payload, order)?;
            Ok((ReplyTo::Cyclone { header, client }, body))
        }
        ServiceMapping::Enhanced => {
            let named = received
                .related
                .map(|related| related.writer_guid)
                .filter(|guid| *guid != GUID::GUID_UNKNOWN);
            let identity = SampleIdentity {
                writer_guid: named.unwrap_or(client),
                sequence_number: SequenceNumber::from(received.sequence),
            };
            Ok((ReplyTo::Enhanced { identity, client }, received.payload))
        }
    }
}

/// Returns the reply with the body, which is little-endian CDR with its encapsulation header.
pub(super) fn seal_reply(to: &ReplyTo, body: Bytes) -> Result<OutgoingServiceSample, Fault> {
    match to {
        ReplyTo::Cyclone { header, .. } => Ok(OutgoingServiceSample {
            payload: join(*header, &body)?,
            related: None,
        }),
        ReplyTo::Enhanced { identity, .. } => Ok(OutgoingServiceSample {
            payload: little_endian(body)?,
            related: Some(*identity),
        }),
    }
}

/// The identity of a client in either mapping.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ClientId {
    pub(super) writer: GUID,
    pub(super) reader: GUID,
}

/// Identifies the request to which a reply belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum RequestKey {
    /// The number that the client assigned.
    Counted(i64),
    /// The sequence number that the client's writer assigned.
    Written(i64),
}

impl ClientId {
    /// Returns the request with the body. `count` distinguishes it from other requests of this
    /// client if the mapping has a header for it.
    pub(super) fn seal_request(
        self,
        mapping: ServiceMapping,
        count: i64,
        body: Bytes,
    ) -> Result<OutgoingServiceSample, Fault> {
        match mapping {
            ServiceMapping::Cyclone => {
                let mut header = [0; CYCLONE_HEADER];
                let (id, number) = header.split_at_mut(8);
                id.copy_from_slice(&self.cyclone_id());
                number.copy_from_slice(&count.to_le_bytes());
                Ok(OutgoingServiceSample {
                    payload: join(header, &body)?,
                    related: None,
                })
            }
            ServiceMapping::Enhanced => Ok(OutgoingServiceSample {
                payload: little_endian(body)?,
                // As in rmw_fastrtps: its servers wait for this reader before they reply.
                related: Some(SampleIdentity {
                    writer_guid: self.reader,
                    sequence_number: SequenceNumber::from_high_low(-1, 0),
                }),
            }),
        }
    }

    /// Splits a reply into its request key and its body. Returns `None` for a reply to another
    /// client.
    pub(super) fn open_reply(
        self,
        mapping: ServiceMapping,
        received: ReceivedServiceSample,
    ) -> Result<Option<(RequestKey, Bytes)>, Fault> {
        let order = ByteOrder::of(&received.payload)?;
        match mapping {
            ServiceMapping::Cyclone => {
                let (header, body) = split(&received.payload, order)?;
                let (id, number) = header.split_at(8);
                let number = number.try_into().map(i64::from_le_bytes);
                Ok(number
                    .ok()
                    .filter(|_| id == self.cyclone_id())
                    .map(|number| (RequestKey::Counted(number), body)))
            }
            ServiceMapping::Enhanced => Ok(received
                .related
                .filter(|related| {
                    related.writer_guid == self.reader || related.writer_guid == self.writer
                })
                .map(|related| {
                    let number = i64::from(related.sequence_number);
                    (RequestKey::Written(number), received.payload)
                })),
        }
    }

    /// Returns 8 bytes that are unique to the client: the end of its participant's prefix and its
    /// writer's entity id.
    fn cyclone_id(self) -> [u8; 8] {
        let [.., a, b, c, d, e, f, g, h] = self.writer.to_bytes();
        [a, b, c, d, e, f, g, h]
    }
}

/// The byte order of a CDR body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ByteOrder {
    Little,
    Big,
}

impl ByteOrder {
    /// Reads the encapsulation header (RTPS 2.5, 10.2).
    fn of(payload: &[u8]) -> Result<Self, Fault> {
        match payload.get(..ENCAPSULATION) {
            None => Err(Fault::Short),
            Some([0x00, 0x01, ..]) => Ok(Self::Little),
            Some([0x00, 0x00, ..]) => Ok(Self::Big),
            Some(_) => Err(Fault::Encoding),
        }
    }
}

/// Splits a payload into Cyclone's header, converted to little endian, and the rest. The header
/// length is a multiple of 8 bytes, so its removal keeps the alignment of the rest.
fn split(payload: &Bytes, order: ByteOrder) -> Result<([u8; CYCLONE_HEADER], Bytes), Fault> {
    let (encapsulation, rest) = payload
        .split_first_chunk::<ENCAPSULATION>()
        .ok_or(Fault::Short)?;
    let (header, body) = rest
        .split_first_chunk::<CYCLONE_HEADER>()
        .ok_or(Fault::Short)?;
    let mut header = *header;
    if order == ByteOrder::Big {
        for word in header.chunks_exact_mut(8) {
            word.reverse();
        }
    }
    let mut bytes = BytesMut::with_capacity(ENCAPSULATION + body.len());
    bytes.extend_from_slice(encapsulation);
    bytes.extend_from_slice(body);
    Ok((header, bytes.freeze()))
}

fn join(header: [u8; CYCLONE_HEADER], payload: &Bytes) -> Result<Bytes, Fault> {
    if ByteOrder::of(payload)? != ByteOrder::Little {
        return Err(Fault::Encoding);
    }
    let (encapsulation, body) = payload
        .split_first_chunk::<ENCAPSULATION>()
        .ok_or(Fault::Short)?;
    let mut bytes = BytesMut::with_capacity(payload.len() + CYCLONE_HEADER);
    bytes.extend_from_slice(encapsulation);
    bytes.extend_from_slice(&header);
    bytes.extend_from_slice(body);
    Ok(bytes.freeze())
}

fn little_endian(payload: Bytes) -> Result<Bytes, Fault> {
    match ByteOrder::of(&payload)? {
        ByteOrder::Little => Ok(payload),
        ByteOrder::Big => Err(Fault::Encoding),
    }
}

/// The vendor number of Eclipse Cyclone DDS in the OMG's list.
const CYCLONE: [u8; 2] = [0x01, 0x10];
const CYCLONE_HEADER: usize = 16;
const ENCAPSULATION: usize = 4;

#[cfg(test)]
mod tests {
    use super::*;

    const TRUE: &[u8] = &[0, 1, 0, 0, 1];

    fn guid(vendor: [u8; 2], entity: u8) -> GUID {
        let mut bytes = [7; 16];
        bytes[..2].copy_from_slice(&vendor);
        bytes[15] = entity;
        GUID::from_bytes(bytes)
    }

    fn ours() -> ClientId {
        ClientId {
            writer: guid([1, 0x12], 3),
            reader: guid([1, 0x12], 4),
        }
    }

    fn received(out: OutgoingServiceSample, writer: GUID, sequence: i64) -> ReceivedServiceSample {
        ReceivedServiceSample {
            payload: out.payload,
            writer,
            sequence,
            related: out.related,
        }
    }

    #[test]
    fn a_request_to_cyclone_has_client_and_number_before_the_body() {
        let request = ours()
            .seal_request(ServiceMapping::Cyclone, 0x0102, Bytes::from_static(TRUE))
            .unwrap();
        assert_eq!(
            request.payload.as_ref(),
            [
                &[0, 1, 0, 0][..],
                &[7, 7, 7, 7, 7, 7, 7, 3],
                &[2, 1, 0, 0, 0, 0, 0, 0],
                &[1]
            ]
            .concat()
        );
        assert_eq!(request.related, None);
    }

    #[test]
    fn a_client_of_cyclone_gets_its_header_back_whatever_its_byte_order() {
        let client = guid(CYCLONE, 3);
        for (order, number) in [(1, [5, 0, 0, 0, 0, 0, 0, 0]), (0, [0, 0, 0, 0, 0, 0, 0, 5])] {
            let id = [1, 2, 3, 4, 5, 6, 7, 8];
            let payload = [&[0, order, 0, 0][..], &id, &number, &[1]].concat();
            let request = ReceivedServiceSample {
                payload: payload.into(),
                writer: client,
                sequence: 9,
                related: None,
            };
            let (to, body) = open_request(ServiceMapping::Cyclone, request).unwrap();
            assert_eq!(body.as_ref(), [0, order, 0, 0, 1]);
            let reply = seal_reply(&to, Bytes::from_static(TRUE)).unwrap();
            assert_eq!(reply.payload[12..20], [5, 0, 0, 0, 0, 0, 0, 0]);
            let mut said = id;
            if order == 0 {
                said.reverse();
            }
            assert_eq!(reply.payload[4..12], said);
            assert_eq!(reply.payload[20..], [1]);
        }
    }

    #[test]
    fn a_fast_dds_client_is_answered_under_the_reader_it_names() {
        let (writer, reader) = (guid([1, 0x0f], 3), guid([1, 0x0f], 4));
        let request = |related| ReceivedServiceSample {
            payload: Bytes::from_static(TRUE),
            writer,
            sequence: 12,
            related,
        };
        let named = SampleIdentity {
            writer_guid: reader,
            sequence_number: SequenceNumber::from_high_low(-1, 0),
        };
        for (related, client) in [(Some(named), reader), (None, writer)] {
            let (to, _) = open_request(ServiceMapping::Enhanced, request(related)).unwrap();
            let reply = seal_reply(&to, Bytes::from_static(TRUE)).unwrap();
            assert_eq!(reply.payload.as_ref(), TRUE);
            let identity = reply.related.unwrap();
            assert_eq!(identity.writer_guid, client);
            assert_eq!(identity.sequence_number, SequenceNumber::from(12));
            assert_eq!(to.reader(), (client == reader).then_some(reader));
        }
    }

    #[test]
    fn a_reply_is_taken_by_the_client_that_asked_alone() {
        let other = ClientId {
            writer: guid([1, 0x12], 13),
            reader: guid([1, 0x12], 14),
        };
        for (mapping, vendor, key) in [
            (ServiceMapping::Cyclone, CYCLONE, RequestKey::Counted(3)),
            (ServiceMapping::Enhanced, [1, 0x0f], RequestKey::Written(17)),
        ] {
            let request = ours()
                .seal_request(mapping, 3, Bytes::from_static(TRUE))
                .unwrap();
            // As a server of the vendor replies.
            let reply = match mapping {
                ServiceMapping::Cyclone => request,
                ServiceMapping::Enhanced => OutgoingServiceSample {
                    related: Some(SampleIdentity {
                        writer_guid: ours().reader,
                        sequence_number: SequenceNumber::from(17),
                    }),
                    ..request
                },
            };
            let reply = received(reply, guid(vendor, 3), 1);
            assert_eq!(
                ours().open_reply(mapping, reply.clone()),
                Ok(Some((key, Bytes::from_static(TRUE))))
            );
            assert_eq!(other.open_reply(mapping, reply), Ok(None));
        }
    }

    #[test]
    fn what_ends_early_or_is_no_cdr_is_refused() {
        for (bytes, fault) in [
            (&[0, 1, 0][..], Fault::Short),
            (&[0, 1, 0, 0, 1, 2, 3], Fault::Short),
            (&[0, 3, 0, 0, 1, 2, 3], Fault::Encoding),
        ] {
            let request = ReceivedServiceSample {
                payload: Bytes::copy_from_slice(bytes),
                writer: guid(CYCLONE, 3),
                sequence: 1,
                related: None,
            };
            assert_eq!(
                open_request(ServiceMapping::Cyclone, request).unwrap_err(),
                fault
            );
        }
        let to = ReplyTo::Cyclone {
            header: [0; CYCLONE_HEADER],
            client: guid(CYCLONE, 3),
        };
        assert_eq!(
            seal_reply(&to, Bytes::from_static(&[0, 0, 0, 0, 1])),
            Err(Fault::Encoding)
        );
    }
}
