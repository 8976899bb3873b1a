//! Encodes JSON to a datagram.
//!
//! The datagram has the same contents as the decoded datagram, in the canonical encoding:
//!
//! - flag bytes without a set bit are left out,
//! - a Boolean that is true is 1,
//! - a NaN is the NaN of OPC 10000-6, 5.2.2.3,
//! - a NodeId has its shortest encoding,
//! - the dimensions of an array are written only if there are two or more,
//! - a key frame always has its FieldCount,
//! - a discovery message always has its SecurityHeader.

use std::str::FromStr;

use uadp::discovery::{Announcement, Probe};
use uadp::{
    ChunkBudget, ChunkEncoder, ChunkError, DataSetHeader, DataValue, DateTime, Extras,
    FieldEncoder, GroupHeader, Guid, Nested, NetworkHeader, NetworkMessageEncoder,
    NetworkMessageType, PublisherId, Seal, SecurityHeader, SecurityMode, Variant, Whole,
};

use crate::arguments::RawReading;
use crate::decode::DecodeContext;
use crate::raw_data::RawDataLayout;
use crate::values::{WrongValue, data_value_bytes, variant_bytes};
use crate::{actions, discovery, hex, iso_time, node_ids, shape};

type EncodingResult = Result<(), WrongValue>;

/// Returns the bytes of a datagram.
pub(crate) fn write(
    json: &shape::DatagramJson,
    context: &DecodeContext,
) -> Result<Vec<u8>, WrongValue> {
    if let Some(why) = &json.malformed {
        return Err(WrongValue::new(format!("is malformed ({why})")).at("the datagram"));
    }
    if json.uadp_version.is_some_and(|version| version != 1) {
        return Err(WrongValue::new("only version 1 is written").at("uadpVersion"));
    }
    let publisher_id = json.publisher_id.as_ref().map(publisher_id).transpose();
    let header = NetworkHeader {
        publisher_id: publisher_id.map_err(|wrong| wrong.at("publisherId.value"))?,
        data_set_class_id: json
            .data_set_class_id
            .as_deref()
            .map(class_id)
            .transpose()?,
        group: json.group_header.as_ref().map(|group| GroupHeader {
            writer_group_id: group.writer_group_id,
            group_version: group.group_version,
            network_message_number: group.network_message_number,
            sequence_number: group.sequence_number,
        }),
        timestamp: timestamp(json.timestamp.as_ref())?,
        picoseconds: json.pico_seconds,
    };
    let mut buffers = Vec::new();
    for (field, at) in json.promoted_fields.iter().flatten().zip(0..) {
        let bytes = variant_bytes(field);
        buffers.push(bytes.map_err(|wrong| wrong.at(&format!("promotedFields[{at}]")))?);
    }
    let promoted: Vec<_> = buffers
        .iter()
        .map(|bytes| Nested::<Variant<'_>>::new(bytes)?.get())
        .collect::<Result<_, _>>()?;
    let security = json
        .security_header
        .as_ref()
        .map(Security::read)
        .transpose()?;
    Writing {
        json,
        header,
        promoted_fields: json.promoted_fields.as_ref().map(|_| promoted.as_slice()),
        security: security.as_ref(),
        context,
    }
    .write()
}

/// A datagram in progress, with its headers parsed.
struct Writing<'a> {
    json: &'a shape::DatagramJson,
    header: NetworkHeader<'a>,
    promoted_fields: Option<&'a [Variant<'a>]>,
    security: Option<&'a Security>,
    context: &'a DecodeContext,
}

/// A SecurityHeader with its hexadecimal texts parsed.
struct Security {
    signed: bool,
    encrypted: bool,
    force_key_reset: bool,
    token_id: u32,
    nonce: Vec<u8>,
    footer: Option<Vec<u8>>,
    footer_size: Option<u16>,
}

impl Writing<'_> {
    fn write(&self) -> Result<Vec<u8>, WrongValue> {
        let mut out = Vec::new();
        if let Some(sealed) = &self.json.sealed {
            self.sealed(sealed, &mut out)?;
            return Ok(out);
        }
        if let Some(chunk) = &self.json.chunk {
            self.chunk(chunk, &mut out)?;
        } else if let Some(probe) = &self.json.probe {
            let body = discovery::probe_body(probe).map_err(|wrong| wrong.at("probe"))?;
            self.probe(&body, &mut out)?;
        } else if let Some(announcement) = &self.json.announcement {
            let body = discovery::announcement_body(announcement);
            self.announcement(&body.map_err(|wrong| wrong.at("announcement"))?, &mut out)?;
        } else if let Some(action) = &self.json.action_header {
            let headers = (&self.header, &self.extras());
            actions::write(self.json, action, headers, &mut out)?;
        } else {
            self.messages(&mut out)?;
        }
        match self.security {
            Some(security) if security.is_secured() => self.seal(security, &mut out)?,
            Some(security) => out.extend(security.footer.iter().flatten()),
            None => {}
        }
        Ok(out)
    }

    /// Writes a chunk: encodes its data as a complete message, then replaces the offset and total
    /// size.
    fn chunk(&self, chunk: &shape::ChunkJson, out: &mut Vec<u8>) -> EncodingResult {
        let data = bytes(&chunk.chunk_data_hex).map_err(|wrong| wrong.at("chunk.chunkDataHex"))?;
        let payload_at = self.chunk_headers(chunk.message_sequence_number, &data, out)?;
        // The ChunkOffset and TotalSize follow the MessageSequenceNumber.
        let places = out.get_mut(payload_at + 2..).unwrap_or_default();
        let numbers = [chunk.chunk_offset, chunk.total_size].map(u32::to_le_bytes);
        for (place, byte) in places.iter_mut().zip(numbers.as_flattened()) {
            *place = *byte;
        }
        Ok(())
    }

    /// Writes the NetworkMessage with all data in one chunk and returns the offset of its payload.
    fn chunk_headers(
        &self,
        message_sequence_number: u16,
        data: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<usize, WrongValue> {
        let writer_id = match self.json.data_set_writer_ids.as_deref() {
            None => None,
            Some([id]) => Some(*id),
            Some(_) => return Err(WrongValue::new("a chunk has one").at("dataSetWriterIds")),
        };
        let whole = Whole {
            message_type: match self.json.network_message_type {
                None | Some(shape::NetworkMessageTypeJson::DataSet) => NetworkMessageType::DataSet,
                Some(shape::NetworkMessageTypeJson::DiscoveryProbe) => NetworkMessageType::Probe,
                Some(shape::NetworkMessageTypeJson::DiscoveryAnnouncement) => {
                    NetworkMessageType::Announcement
                }
            },
            writer_id,
            message_sequence_number,
            bytes: data,
        };
        let budget = ChunkBudget {
            network_message: usize::MAX,
            trailer: 0,
        };
        let wrong = |error: ChunkError| WrongValue::new(error.to_string()).at("chunk");
        let extras = self.extras();
        let mut chunks = ChunkEncoder::new(&self.header, &extras, whole, budget).map_err(wrong)?;
        match chunks.append(out, &extras) {
            Some(placed) => Ok(placed.map_err(wrong)?.payload_at),
            None => Ok(out.len()),
        }
    }

    /// Writes the headers of a chunk or discovery message with a placeholder payload, and returns
    /// the offset of the payload.
    fn other_headers(&self, is_chunk: bool, out: &mut Vec<u8>) -> Result<usize, WrongValue> {
        if is_chunk {
            return self.chunk_headers(0, &[0], out);
        }
        const FIND_APPLICATIONS: &[u8] = &[2];
        const NO_CONNECTIONS: &[u8] = &[4, 0, 0, 0, 0, 0, 0];
        let body = match self.json.network_message_type {
            Some(shape::NetworkMessageTypeJson::DiscoveryAnnouncement) => {
                self.announcement(NO_CONNECTIONS, out)?;
                NO_CONNECTIONS
            }
            Some(
                shape::NetworkMessageTypeJson::DiscoveryProbe
                | shape::NetworkMessageTypeJson::DataSet,
            )
            | None => {
                self.probe(FIND_APPLICATIONS, out)?;
                FIND_APPLICATIONS
            }
        };
        Ok(out.len() - body.len())
    }

    fn probe(&self, body: &[u8], out: &mut Vec<u8>) -> EncodingResult {
        self.only_discovery_headers()?;
        let security = self.security.map_or(SecurityHeader::NONE, Security::header);
        Ok(Probe::decode_body(body)?.encode(self.header.publisher_id, security, out)?)
    }

    fn announcement(&self, body: &[u8], out: &mut Vec<u8>) -> EncodingResult {
        self.only_discovery_headers()?;
        let publisher_id = self.header.publisher_id;
        let missing = || WrongValue::new("an announcement wants one").at("publisherId");
        let security = self.security.map_or(SecurityHeader::NONE, Security::header);
        Ok(Announcement::decode_body(body)?.encode(
            publisher_id.ok_or_else(missing)?,
            security,
            out,
        )?)
    }

    fn only_discovery_headers(&self) -> EncodingResult {
        let NetworkHeader {
            publisher_id: _,
            data_set_class_id: None,
            group: None,
            timestamp: None,
            picoseconds: None,
        } = self.header
        else {
            let what = "no other headers than publisherId and securityHeader";
            return Err(WrongValue::new(what).at("a discovery message has"));
        };
        Ok(())
    }

    fn extras(&self) -> Extras<'_> {
        Extras {
            promoted_fields: self.promoted_fields,
            security: self.security.map(Security::header),
        }
    }

    /// Writes the headers, followed by the encrypted bytes.
    fn sealed(&self, sealed: &shape::Sealed, out: &mut Vec<u8>) -> Result<(), WrongValue> {
        let payload_at = if sealed.action {
            if sealed.chunk {
                let what = "a chunk with an ActionHeader is not written";
                return Err(WrongValue::new(what).at("sealed"));
            }
            actions::headers(self.json, (&self.header, &self.extras()), out)?
        } else if sealed.chunk || self.json.network_message_type.is_some() {
            self.other_headers(sealed.chunk, out)?
        } else {
            let ids = self.json.data_set_writer_ids.as_deref();
            let encoder = NetworkMessageEncoder::with(out, &self.header, ids, &self.extras())?;
            encoder.payload_offset()
        };
        out.truncate(payload_at);
        out.extend(bytes(&sealed.hex).map_err(|wrong| wrong.at("sealed.hex"))?);
        Ok(())
    }

    /// Writes headers and DataSetMessages, before they are signed and encrypted.
    fn messages(&self, out: &mut Vec<u8>) -> Result<(), WrongValue> {
        let messages = self.json.data_set_messages.as_deref().unwrap_or_default();
        let ids = self.json.data_set_writer_ids.as_deref();
        if let Some(ids) = ids
            && ids.len() != messages.len()
        {
            return Err(WrongValue::new(format!(
                "{} ids for {} dataSetMessages",
                ids.len(),
                messages.len()
            ))
            .at("dataSetWriterIds"));
        }
        let mut encoder = NetworkMessageEncoder::with(out, &self.header, ids, &self.extras())?;
        if ids.is_none() {
            encoder = encoder.fixed_layout(messages.len())?;
        }
        for (message, at) in messages.iter().zip(0..) {
            let writer_id = ids.and_then(|ids| ids.get(at).copied());
            let layout = self.context.layout(self.json, writer_id);
            write_message(
                message,
                layout.as_ref(),
                self.context.raw_reading,
                &mut encoder,
            )
            .map_err(|wrong| wrong.at(&format!("dataSetMessages[{at}]")))?;
        }
        // A signature or SecurityFooter follows.
        if self.security.is_none() {
            encoder.finish()?;
        }
        Ok(())
    }

    fn seal(&self, security: &Security, out: &mut Vec<u8>) -> Result<(), WrongValue> {
        let wrong = |what: String| WrongValue::new(what).at("securityHeader");
        let keys =
            self.context.keys.as_ref().ok_or_else(|| {
                wrong("the message is secured: give its keys with --keys".to_owned())
            })?;
        let group = self.header.group.and_then(|group| group.writer_group_id);
        let publisher_id = self.json.publisher_id.as_ref();
        let found = keys
            .of(security.token_id, publisher_id, group)
            .ok_or_else(|| {
                let (token, file) = (security.token_id, keys.name());
                wrong(format!(
                    "no keys of SecurityTokenId {token} for this publisher in {file}"
                ))
            })?;
        let mode = match (security.signed, security.encrypted) {
            (true, true) => SecurityMode::SignAndEncrypt,
            (true, false) => SecurityMode::Sign,
            _ => return Err(wrong("encrypted, yet not signed".to_owned())),
        };
        let nonce = security.nonce.as_slice().try_into();
        let nonce = nonce.map_err(|_| wrong("a nonce of 8 bytes is wanted".to_owned()))?;
        let mut seal = Seal::with_nonce(found, security.token_id, mode, nonce);
        if let Some(footer) = &security.footer {
            seal = seal.footer(footer)?;
        }
        seal.apply(out, 0)?;
        Ok(())
    }
}

impl Security {
    fn read(json: &shape::SecurityHeaderJson) -> Result<Self, WrongValue> {
        let part = |text: &str, key: &str| {
            bytes(text).map_err(|wrong| wrong.at(&format!("securityHeader.{key}")))
        };
        let footer = json.footer.as_deref().map(|text| part(text, "footer"));
        let footer = footer
            .transpose()?
            .or_else(|| json.footer_enabled.then(Vec::new));
        let len = footer.as_ref().map(Vec::len);
        let footer_size = match (len.map(u16::try_from), json.footer_size) {
            (_, Some(size)) if json.footer.is_none() => Some(size),
            (Some(Ok(len)), wanted) if wanted.is_none_or(|wanted| wanted == len) => Some(len),
            (None, None) => None,
            _ => {
                return Err(
                    WrongValue::new("not the size of the footer").at("securityHeader.footerSize")
                );
            }
        };
        Ok(Self {
            signed: json.signed,
            encrypted: json.encrypted,
            force_key_reset: json.force_key_reset,
            token_id: json.security_token_id,
            nonce: part(&json.nonce, "nonce")?,
            footer,
            footer_size,
        })
    }

    fn header(&self) -> SecurityHeader<'_> {
        SecurityHeader {
            signed: self.signed,
            encrypted: self.encrypted,
            force_key_reset: self.force_key_reset,
            token_id: self.token_id,
            nonce: &self.nonce,
            footer_size: self.footer_size,
        }
    }

    const fn is_secured(&self) -> bool {
        self.signed || self.encrypted
    }
}

/// Returns the bytes of a single DataSetMessage.
pub(crate) fn message_bytes(
    json: &shape::DataSetMessageJson,
    layout: Option<&RawDataLayout<'_>>,
) -> Result<Vec<u8>, WrongValue> {
    let mut out = Vec::new();
    let mut encoder = NetworkMessageEncoder::new(&mut out, &NetworkHeader::default(), None)?;
    let headers = encoder.payload_offset();
    let reading = layout.map_or(RawReading::Standard, RawDataLayout::reading);
    write_message(json, layout, reading, &mut encoder)?;
    encoder.finish()?;
    Ok(out.split_off(headers))
}

fn write_message(
    json: &shape::DataSetMessageJson,
    known: Option<&RawDataLayout<'_>>,
    reading: RawReading,
    encoder: &mut NetworkMessageEncoder<'_>,
) -> EncodingResult {
    use shape::{FieldEncodingJson, MessageKindJson};

    if let Some(why) = &json.malformed {
        return Err(WrongValue::new(format!("is malformed ({why})")));
    }
    encoder.configured_size(json.configured_size.unwrap_or_default());
    if let Some(text) = &json.message_hex {
        let message = bytes(text).map_err(|wrong| wrong.at(".messageHex"))?;
        return Ok(encoder.raw_key_frame(&DataSetHeader::default(), |out| {
            // The message replaces the byte of flags.
            out.pop();
            out.extend(message);
            Ok(())
        })?);
    }
    let header = data_set_header(json)?;
    match (json.kind, json.field_encoding) {
        (MessageKindJson::KeepAlive, _) => Ok(encoder.keep_alive(&header)?),
        (MessageKindJson::KeyFrame, FieldEncodingJson::Variant) => {
            write_variants(json, encoder.key_frame(&header)?)
        }
        (MessageKindJson::Event, FieldEncodingJson::Variant) => {
            write_variants(json, encoder.event(&header)?)
        }
        (MessageKindJson::DeltaFrame, FieldEncodingJson::Variant) => {
            let mut frame = encoder.delta_frame(&header)?;
            each_field(json, |field| {
                let bytes = variant_bytes(&field.value)?;
                let value = Nested::<Variant<'_>>::new(&bytes)?.get()?;
                Ok(frame.field(index(field)?)?.variant(&value)?)
            })?;
            Ok(frame.finish()?)
        }
        (MessageKindJson::KeyFrame, FieldEncodingJson::DataValue) => {
            let mut frame = encoder.data_values(&header)?;
            each_field(json, |field| {
                let bytes = data_value_bytes(&field.value)?;
                let value = Nested::<DataValue<'_>>::new(&bytes)?.get()?;
                Ok(frame.value(&value)?)
            })?;
            Ok(frame.finish()?)
        }
        (MessageKindJson::DeltaFrame, FieldEncodingJson::DataValue) => {
            let mut frame = encoder.delta_data_values(&header)?;
            each_field(json, |field| {
                let bytes = data_value_bytes(&field.value)?;
                let value = Nested::<DataValue<'_>>::new(&bytes)?.get()?;
                Ok(frame.changed(index(field)?, &value)?)
            })?;
            Ok(frame.finish()?)
        }
        (MessageKindJson::KeyFrame, FieldEncodingJson::RawData) => {
            let payload = raw_data(json, known, reading)?;
            Ok(encoder.raw_key_frame(&header, |out| {
                out.extend(payload);
                Ok(())
            })?)
        }
        (kind, encoding) => Err(WrongValue::new(format!(
            "a {kind:?} is never encoded as {encoding:?}"
        ))),
    }
}

/// Writes the fields of a key frame or event.
fn write_variants(json: &shape::DataSetMessageJson, mut frame: FieldEncoder<'_>) -> EncodingResult {
    each_field(json, |field| {
        if field.index.is_some() {
            return Err(WrongValue::new(
                "only the fields of a delta frame have an index",
            ));
        }
        let bytes = variant_bytes(&field.value)?;
        Ok(frame.variant(&Nested::<Variant<'_>>::new(&bytes)?.get()?)?)
    })?;
    Ok(frame.finish()?)
}

/// Returns RawData, encoded by the layout in the message or the given layout, or from its
/// hexadecimal text.
fn raw_data(
    json: &shape::DataSetMessageJson,
    known: Option<&RawDataLayout<'_>>,
    reading: RawReading,
) -> Result<Vec<u8>, WrongValue> {
    if let Some(text) = &json.raw_data_hex {
        return bytes(text).map_err(|wrong| wrong.at(".rawDataHex"));
    }
    match (&json.meta_data, known) {
        (Some(metadata), _) => RawDataLayout::new(metadata, reading)?.write(&json.fields),
        (None, Some(known)) => known.write(&json.fields),
        (None, None) if json.fields.is_empty() => Ok(Vec::new()),
        (None, None) => Err(WrongValue::new(
            "RawData wants its metaData, here or with --metadata",
        )),
    }
}

fn each_field(
    json: &shape::DataSetMessageJson,
    mut write: impl FnMut(&shape::FieldJson) -> EncodingResult,
) -> EncodingResult {
    for (field, at) in json.fields.iter().zip(0..) {
        write(field).map_err(|wrong| wrong.at(&format!(".fields[{at}]")))?;
    }
    Ok(())
}

fn index(field: &shape::FieldJson) -> Result<u16, WrongValue> {
    let missing = || WrongValue::new("a field of a delta frame wants its index");
    field.index.ok_or_else(missing)
}

pub(crate) fn data_set_header(
    json: &shape::DataSetMessageJson,
) -> Result<DataSetHeader, WrongValue> {
    Ok(DataSetHeader {
        valid: json.valid,
        sequence_number: json.sequence_number,
        timestamp: timestamp(json.timestamp.as_ref())?,
        picoseconds: json.pico_seconds,
        status: json.status16,
        major_version: json.major_version,
        minor_version: json.minor_version,
    })
}

pub(crate) fn publisher_id(json: &shape::PublisherIdJson) -> Result<PublisherId<'_>, WrongValue> {
    use shape::PublisherIdType;

    fn number<T: FromStr>(json: &shape::PublisherIdJson) -> Result<T, WrongValue> {
        let text = json.value.as_str().map(str::to_owned);
        let text = text.or_else(|| json.value.as_number().map(ToString::to_string));
        let number = text.and_then(|text| text.parse().ok());
        number.ok_or_else(|| WrongValue::expected(&format!("a {:?}", json.id_type), &json.value))
    }
    Ok(match json.id_type {
        PublisherIdType::Byte => PublisherId::Byte(number(json)?),
        PublisherIdType::UInt16 => PublisherId::UInt16(number(json)?),
        PublisherIdType::UInt32 => PublisherId::UInt32(number(json)?),
        PublisherIdType::UInt64 => PublisherId::UInt64(number(json)?),
        PublisherIdType::String => {
            let wrong = || WrongValue::expected("a text", &json.value);
            PublisherId::String(json.value.as_str().ok_or_else(wrong)?)
        }
    })
}

fn class_id(text: &str) -> Result<Guid, WrongValue> {
    let wrong = || WrongValue::expected("a Guid", &text.into()).at("dataSetClassId");
    node_ids::parse_guid(text).ok_or_else(wrong)
}

fn timestamp(json: Option<&shape::TimestampJson>) -> Result<Option<DateTime>, WrongValue> {
    let Some(json) = json else {
        return Ok(None);
    };
    let time = match (json.ticks100ns, &json.iso) {
        (Some(ticks), _) => Some(DateTime(ticks)),
        (None, Some(text)) => iso_time::parse(text),
        (None, None) => None,
    };
    let wrong = || WrongValue::new("ticks100ns or an iso time is wanted").at("timestamp");
    time.map(Some).ok_or_else(wrong)
}

fn bytes(text: &str) -> Result<Vec<u8>, WrongValue> {
    hex::parse(text).map_err(|error| WrongValue::new(error.to_string()))
}
