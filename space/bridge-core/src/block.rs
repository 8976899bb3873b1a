//! Blocks of fields as in a key frame: the number of fields, followed by the fields as Variants.

use uadp::{
    DataSetHeader, EncodeError, FieldEncoder, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
};

use crate::counters::{DropCause, Reason};
use crate::fields;

/// Returns the block of the fields that `write` writes.
pub(crate) fn block(
    write: impl FnOnce(&mut FieldEncoder<'_>) -> Result<(), (DropCause, String)>,
) -> Result<Vec<u8>, (DropCause, String)> {
    let mut scratch = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut scratch, &NetworkHeader::default(), None)
        .map_err(too_big)?;
    let mut frame = message
        .key_frame(&DataSetHeader::default())
        .map_err(too_big)?;
    write(&mut frame)?;
    frame.finish().map_err(too_big)?;
    message.finish().map_err(too_big)?;
    let message = NetworkMessage::decode(&scratch).map_err(fields::undecodable)?;
    let fields = message
        .messages()
        .next()
        .transpose()
        .and_then(|message| message.map(|message| message.fields()).transpose())
        .map_err(fields::undecodable)?;
    Ok(fields.map_or_else(|| NO_FIELDS.to_vec(), |fields| fields.bytes().to_vec()))
}

pub(crate) fn too_big(error: EncodeError) -> (DropCause, String) {
    (Reason::TooBig.into(), error.to_string())
}

/// The block without fields.
pub(crate) const NO_FIELDS: [u8; 2] = [0, 0];
