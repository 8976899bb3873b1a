//! Actions: bytes from the tables of the standard, round trips, and exchanges of Requestors and
//! Responders.

mod codec;
mod link;
mod peers;
mod requestor;
mod responder;
mod secured;
mod vectors;

use uadp::action::{ActionDialect, ActionEncoder, ActionMessage, ActionStart};
use uadp::{EncodeError, Extras, NetworkMessage};

const STANDARD: ActionDialect = ActionDialect::Standard;

/// Returns the messages of a datagram; all of them have to be valid.
fn read(datagram: &[u8], dialect: ActionDialect) -> Vec<ActionMessage<'_>> {
    let network = NetworkMessage::decode(datagram).unwrap();
    network
        .actions(dialect)
        .unwrap()
        .map(Result::unwrap)
        .collect()
}

/// Encodes a datagram again from its decoded content.
fn rewrite(datagram: &[u8], dialect: ActionDialect) -> Result<Vec<u8>, EncodeError> {
    let network = NetworkMessage::decode(datagram).unwrap();
    let actions = network.actions(dialect).unwrap();
    let start = ActionStart {
        network: network.header(),
        action: *actions.header(),
        dialect,
        extras: Extras {
            security: network.security(),
            ..Extras::default()
        },
    };
    let ids: Vec<u16> = network.writer_ids().unwrap().collect();
    // The offset in the buffer is not 0, because all positions have to be relative.
    let mut out = vec![0xAA; 3];
    let mut encoder = ActionEncoder::new(&mut out, &start, &ids)?;
    for message in actions {
        let message = message.unwrap();
        encoder.fields(&message.header(), message.call(), message.fields)?;
    }
    encoder.finish()?;
    Ok(out.split_off(3))
}
