//! Fuzzes Action messages with arbitrary bytes.

use uadp::action::{
    ActionDialect, ActionEncoder, ActionEncoding, ActionFields, ActionMessage, ActionStart,
};
use uadp::{Extras, NetworkMessage, Variant};

/// Decodes an Action message. The first byte selects the dialect, the rest is the datagram. A
/// message that is decoded completely is encoded again and must decode to the same message.
pub fn action(input: &[u8]) {
    let Some((choice, datagram)) = input.split_first() else {
        return;
    };
    let dialect = match choice % 3 {
        0 => ActionDialect::Standard,
        1 => ActionDialect::UaNetStandard(ActionEncoding::Variant),
        _ => ActionDialect::UaNetStandard(ActionEncoding::RawData),
    };
    let Ok(network) = NetworkMessage::decode(datagram) else {
        return;
    };
    let Ok(actions) = network.actions(dialect) else {
        return;
    };
    assert!(network.is_action() && !network.is_sealed() && !network.is_chunk());
    assert!(
        network.messages().all(|message| message.is_err()),
        "taken for data"
    );
    let mut found = 0;
    for message in actions.clone() {
        found += 1;
        assert!(found <= 256, "more messages than a Count can say");
        if !message.is_ok_and(|message| is_readable(&message)) {
            return;
        }
    }
    let Some(written) = write(&network, dialect) else {
        return;
    };
    let again = NetworkMessage::decode(&written).expect("what was written can be read");
    assert_eq!(
        write(&again, dialect).as_ref(),
        Some(&written),
        "writing is not canonical"
    );
    let again = again.actions(dialect).expect("written");
    for (one, other) in actions.zip(again) {
        let (one, other) = (one.expect("read before"), other.expect("written"));
        assert_eq!(one.call(), other.call());
        assert_eq!(one.header(), other.header());
        assert_eq!(one.writer_id, other.writer_id);
        // NaN is not equal to itself, so the headers are compared by their debug output.
        assert_eq!(format!("{:?}", one.action), format!("{:?}", other.action));
        let _ = one.action.timeout();
    }
}

fn is_readable(message: &ActionMessage<'_>) -> bool {
    match message.fields {
        ActionFields::Variants(_) => message
            .fields
            .variants()
            .is_ok_and(|mut fields| fields.all(|field| field.is_ok())),
        ActionFields::RawData { .. } => true,
    }
}

/// Encodes the message from its values; `None` if the values do not fit.
fn write(network: &NetworkMessage<'_>, dialect: ActionDialect) -> Option<Vec<u8>> {
    let actions = network.actions(dialect).ok()?;
    let promoted: Option<Vec<Variant<'_>>> = match network.promoted_fields() {
        Some(fields) => Some(fields.collect::<Result<_, _>>().ok()?),
        None => None,
    };
    let start = ActionStart {
        network: network.header(),
        action: *actions.header(),
        dialect,
        extras: Extras {
            promoted_fields: promoted.as_deref(),
            security: network.security(),
        },
    };
    let ids: Vec<u16> = network.writer_ids()?.collect();
    let mut out = Vec::new();
    let mut encoder = ActionEncoder::new(&mut out, &start, &ids).ok()?;
    for message in actions {
        let message = message.ok()?;
        match message.fields {
            // The fields are written separately, so padding is left out.
            ActionFields::Variants(_) => {
                let mut fields = encoder.variants(&message.header(), message.call()).ok()?;
                for field in message.fields.variants().ok()? {
                    fields.variant(&field.ok()?).ok()?;
                }
                fields.finish().ok()?;
            }
            ActionFields::RawData { .. } => {
                let header = message.header();
                encoder
                    .fields(&header, message.call(), message.fields)
                    .ok()?;
            }
        }
    }
    encoder.finish_with_footer(network.footer()).ok()?;
    Some(out)
}
