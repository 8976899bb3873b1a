//! Converts requests and responses of Actions to JSON and back.

use uadp::action::{
    ActionCall, ActionDialect, ActionEncoder, ActionEncoding, ActionFields, ActionHeader,
    ActionKind, ActionMessage, ActionStart, ActionState,
};
use uadp::{DataSetHeader, Extras, NetworkHeader, NetworkMessage};

use crate::fault::{DecodeFault, FaultLocation, MessagePlace, PartialRead, in_field, offset};
use crate::values::{WrongValue, show_variant, variant_bytes};
use crate::{decode, encode, hex, shape};

/// The decoded part of an Action message, up to the first fault.
#[derive(Default)]
pub(crate) struct DecodedAction {
    pub(crate) header: Option<shape::ActionHeaderJson>,
    pub(crate) messages: Vec<shape::DataSetMessageJson>,
    pub(crate) fault: Option<DecodeFault>,
}

/// Reads an Action message in the dialect of the standard. If that fails and the dialect of
/// UA-.NETStandard succeeds, returns the reading of UA-.NETStandard.
pub(crate) fn read(message: &NetworkMessage<'_>) -> DecodedAction {
    let standard = read_as(message, ActionDialect::Standard);
    if standard.fault.is_none() {
        return standard;
    }
    let other = read_as(message, ONE_SHOT);
    match other.fault {
        None => other,
        Some(_) => standard,
    }
}

/// Appends the NetworkMessage with this ActionHeader, up to the end of its payload.
pub(crate) fn write(
    json: &shape::DatagramJson,
    header: &shape::ActionHeaderJson,
    (network, extras): (&NetworkHeader<'_>, &Extras<'_>),
    out: &mut Vec<u8>,
) -> Result<(), WrongValue> {
    let correlation_data = header.correlation_data_hex.as_deref().map(hex::parse);
    let correlation_data = correlation_data.transpose().map_err(|error| {
        WrongValue::new(error.to_string()).at("actionHeader.correlationDataHex")
    })?;
    let requestor_id = header
        .requestor_id
        .as_ref()
        .map(encode::publisher_id)
        .transpose();
    let dialect = match header.dialect {
        shape::ActionDialectJson::Standard => ActionDialect::Standard,
        shape::ActionDialectJson::UaNetStandard => ONE_SHOT,
    };
    let start = ActionStart {
        network: *network,
        action: ActionHeader {
            kind: match header.kind {
                shape::ActionKindJson::Request => ActionKind::Request,
                shape::ActionKindJson::Response => ActionKind::Response,
            },
            response_address: header.response_address.as_deref(),
            correlation_data: correlation_data.as_deref(),
            requestor_id: requestor_id.map_err(|wrong| wrong.at("actionHeader.requestorId"))?,
            timeout_hint: header.timeout_hint,
        },
        dialect,
        extras: *extras,
    };
    let ids = json.data_set_writer_ids.as_deref().unwrap_or_default();
    let messages = json.data_set_messages.as_deref().unwrap_or_default();
    let mut encoder = ActionEncoder::new(out, &start, ids)?;
    for (message, at) in messages.iter().zip(0..) {
        write_message(message, &mut encoder)
            .map_err(|wrong| wrong.at(&format!("dataSetMessages[{at}]")))?;
    }
    // A signature or SecurityFooter follows.
    if extras.security.is_none() {
        encoder.finish()?;
    }
    Ok(())
}

/// Appends the headers of a sealed Action message and returns the offset of its payload.
pub(crate) fn headers(
    json: &shape::DatagramJson,
    (network, extras): (&NetworkHeader<'_>, &Extras<'_>),
    out: &mut Vec<u8>,
) -> Result<usize, WrongValue> {
    let start = ActionStart {
        network: *network,
        action: ActionHeader::new(ActionKind::Request),
        dialect: ActionDialect::Standard,
        extras: *extras,
    };
    let ids = json.data_set_writer_ids.as_deref().unwrap_or_default();
    Ok(ActionEncoder::new(out, &start, ids)?.payload_offset())
}

fn read_as(message: &NetworkMessage<'_>, dialect: ActionDialect) -> DecodedAction {
    let mut shown = DecodedAction::default();
    let actions = match message.actions(dialect) {
        Ok(actions) => actions,
        Err(error) => {
            shown.fault = Some(fault(message, dialect, None, (None, error)));
            return shown;
        }
    };
    shown.header = Some(show_header(actions.header(), dialect));
    for (action, writer_id) in actions.zip(message.writer_ids().into_iter().flatten()) {
        let (part, stop) = match action {
            Ok(action) => show_message(&action),
            Err(error) => (shape::DataSetMessageJson::default(), Some((None, error))),
        };
        shown.messages.push(part);
        if let Some(stop) = stop {
            shown.fault = Some(fault(message, dialect, Some(writer_id), stop));
            return shown;
        }
    }
    // Bytes after the last Action message.
    if let Some(stop) = stop_of(message, dialect) {
        shown.fault = Some(fault(message, dialect, None, stop));
    }
    shown
}

fn show_header(header: &ActionHeader<'_>, dialect: ActionDialect) -> shape::ActionHeaderJson {
    shape::ActionHeaderJson {
        kind: match header.kind {
            ActionKind::Request => shape::ActionKindJson::Request,
            ActionKind::Response => shape::ActionKindJson::Response,
        },
        dialect: match dialect {
            ActionDialect::Standard => shape::ActionDialectJson::Standard,
            ActionDialect::UaNetStandard(_) => shape::ActionDialectJson::UaNetStandard,
        },
        response_address: header.response_address.map(str::to_owned),
        correlation_data_hex: header.correlation_data.map(hex::text),
        requestor_id: header.requestor_id.map(Into::into),
        timeout_hint: header.timeout_hint,
    }
}

fn show_message(action: &ActionMessage<'_>) -> (shape::DataSetMessageJson, Option<PartialRead>) {
    let header = action.header();
    let mut shown = shape::DataSetMessageJson {
        kind: match action.action.kind {
            ActionKind::Request => shape::MessageKindJson::ActionRequest,
            ActionKind::Response => shape::MessageKindJson::ActionResponse,
        },
        sequence_number: header.sequence_number,
        timestamp: header.timestamp.map(decode::show_timestamp),
        pico_seconds: header.picoseconds,
        status16: header.status,
        major_version: header.major_version,
        minor_version: header.minor_version,
        action: Some(shape::ActionJson {
            target_id: action.target_id,
            request_id: action.request_id,
            state: match action.state {
                ActionState::Idle => shape::ActionStateJson::Idle,
                ActionState::Executing => shape::ActionStateJson::Executing,
                ActionState::Done => shape::ActionStateJson::Done,
            },
            field_count: None,
        }),
        ..shape::DataSetMessageJson::default()
    };
    if let ActionFields::RawData { count, payload } = action.fields {
        shown.field_encoding = shape::FieldEncodingJson::RawData;
        shown.raw_data_hex = Some(hex::text(payload));
        if let Some(call) = &mut shown.action {
            call.field_count = count;
        }
        return (shown, None);
    }
    let stop = show_fields(action, &mut shown.fields).err();
    (shown, stop)
}

fn show_fields(
    action: &ActionMessage<'_>,
    shown: &mut Vec<shape::FieldJson>,
) -> Result<(), PartialRead> {
    let fields = action.fields.variants().map_err(|error| (None, error))?;
    for (field, at) in fields.zip(0..) {
        let value = field.and_then(|field| show_variant(&field));
        let value = value.map_err(|error| in_field(at, error))?;
        shown.push(shape::FieldJson { index: None, value });
    }
    Ok(())
}

/// Returns the field and the error at which reading stops.
fn stop_of(message: &NetworkMessage<'_>, dialect: ActionDialect) -> Option<PartialRead> {
    let actions = match message.actions(dialect) {
        Ok(actions) => actions,
        Err(error) => return Some((None, error)),
    };
    for action in actions {
        let stop = match action {
            Ok(action) => show_message(&action).1,
            Err(error) => Some((None, error)),
        };
        if stop.is_some() {
            return stop;
        }
    }
    None
}

fn fault(
    message: &NetworkMessage<'_>,
    dialect: ActionDialect,
    writer_id: Option<u16>,
    stop: PartialRead,
) -> DecodeFault {
    let (field, error) = stop;
    let start = message.payload_offset();
    let headers = message.datagram().get(..start).unwrap_or_default();
    // Decrypted payloads are not read again, so their fault is located at the start of the payload.
    let opened = message
        .security()
        .is_some_and(|security| security.is_secured());
    let in_payload = if opened {
        0
    } else {
        offset(message.payload(), stop, |payload| {
            let datagram = [headers, payload, message.footer()].concat();
            stop_of(&NetworkMessage::decode(&datagram).ok()?, dialect)
        })
    };
    DecodeFault {
        place: match writer_id {
            Some(_) => FaultLocation::Message(MessagePlace { writer_id, field }),
            None => FaultLocation::Payload,
        },
        error,
        offset: start + in_payload,
    }
}

fn write_message(
    json: &shape::DataSetMessageJson,
    encoder: &mut ActionEncoder<'_>,
) -> Result<(), WrongValue> {
    if let Some(why) = &json.malformed {
        return Err(WrongValue::new(format!("is malformed ({why})")));
    }
    let action = json.action.as_ref();
    let action = action.ok_or_else(|| WrongValue::new("an Action message wants its action"))?;
    let call = ActionCall {
        target_id: action.target_id,
        request_id: action.request_id,
        state: match action.state {
            shape::ActionStateJson::Idle => ActionState::Idle,
            shape::ActionStateJson::Executing => ActionState::Executing,
            shape::ActionStateJson::Done => ActionState::Done,
        },
    };
    let header: DataSetHeader = encode::data_set_header(json)?;
    if json.field_encoding == shape::FieldEncodingJson::RawData {
        let payload = hex::parse(json.raw_data_hex.as_deref().unwrap_or_default());
        let payload =
            payload.map_err(|error| WrongValue::new(error.to_string()).at(".rawDataHex"))?;
        let fields = ActionFields::RawData {
            count: action.field_count,
            payload: &payload,
        };
        return Ok(encoder.fields(&header, call, fields)?);
    }
    let count = u16::try_from(json.fields.len());
    let count = count.map_err(|_| WrongValue::new("more than 65535 fields"))?;
    let mut block = count.to_le_bytes().to_vec();
    for (field, at) in json.fields.iter().zip(0..) {
        let bytes = variant_bytes(&field.value);
        block.extend(bytes.map_err(|wrong| wrong.at(&format!(".fields[{at}]")))?);
    }
    Ok(encoder.fields(&header, call, ActionFields::Variants(&block))?)
}

const ONE_SHOT: ActionDialect = ActionDialect::UaNetStandard(ActionEncoding::Variant);
