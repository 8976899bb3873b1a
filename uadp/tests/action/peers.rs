//! A Requestor and a Responder that exchange bytes.

use std::time::Duration;

use uadp::action::{
    ActionAddress, ActionDialect, ActionFields, ActionMessage, ActionRequest, RequestDrop,
    Requestor, RequestorSettings, RequiredAction, Responder, ResponderSettings, ResponseDrop,
    ResponseMeaning,
};
use uadp::{Extras, NetworkHeader, NetworkMessage, OwnedPublisherId};

use super::STANDARD;

pub(super) const INTERVAL: Duration = Duration::from_millis(100);

pub(super) fn at(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

pub(super) fn address(target_id: u16) -> ActionAddress {
    ActionAddress {
        publisher_id: OwnedPublisherId::UInt16(2),
        writer_group_id: Some(5),
        writer_id: 61,
        target_id,
    }
}

/// Returns arguments or a result: a block with a single Int32.
pub(super) fn block(number: i32) -> Vec<u8> {
    let mut block = vec![1, 0, 6];
    block.extend_from_slice(&number.to_le_bytes());
    block
}

pub(super) fn number(fields: ActionFields<'_>) -> i32 {
    let bytes = fields.bytes();
    assert_eq!(bytes[..3], [1, 0, 6], "{fields:?}");
    i32::from_le_bytes(bytes[3..].try_into().unwrap())
}

pub(super) fn request(fields: &[u8], timeout: Duration) -> ActionRequest<'_> {
    ActionRequest {
        address: address(1),
        dialect: STANDARD,
        fields: ActionFields::Variants(fields),
        timeout,
    }
}

pub(super) fn requestor() -> Requestor {
    Requestor::new(
        OwnedPublisherId::UInt16(1),
        [7; 16],
        RequestorSettings::default(),
    )
}

pub(super) fn responder() -> Responder<u16> {
    Responder::new(ResponderSettings::default())
}

/// Returns the requests that are due.
pub(super) fn requests(requestor: &mut Requestor, now: Duration) -> Vec<Vec<u8>> {
    let mut datagrams = Vec::new();
    while let Some(request) = requestor.poll_transmit(now) {
        let mut datagram = Vec::new();
        let encoder = request.encode(&mut datagram, &NetworkHeader::default(), &Extras::default());
        encoder.unwrap().finish().unwrap();
        datagrams.push(datagram);
    }
    datagrams
}

/// Returns the responses that are due.
pub(super) fn responses(responder: &mut Responder<u16>, now: Duration) -> Vec<Vec<u8>> {
    let mut datagrams = Vec::new();
    while let Some((_, response)) = responder.poll_transmit(now) {
        let mut datagram = Vec::new();
        let encoder = response.encode(&mut datagram, &NetworkHeader::default(), &Extras::default());
        encoder.unwrap().finish().unwrap();
        datagrams.push(datagram);
    }
    datagrams
}

/// Calls `then` with the single message of a datagram.
pub(super) fn message<T>(
    datagram: &[u8],
    dialect: ActionDialect,
    then: impl FnOnce(&ActionMessage<'_>) -> T,
) -> T {
    let network = NetworkMessage::decode(datagram).unwrap();
    let mut actions = network.actions(dialect).unwrap();
    let message = actions.next().unwrap().unwrap();
    assert!(actions.next().is_none());
    then(&message)
}

pub(super) fn ask(
    responder: &mut Responder<u16>,
    datagram: &[u8],
    now: Duration,
) -> Result<RequiredAction, RequestDrop> {
    ask_from(responder, 0, datagram, now)
}

/// Passes a request as [`ask`], from another sender.
pub(super) fn ask_from(
    responder: &mut Responder<u16>,
    sender: u16,
    datagram: &[u8],
    now: Duration,
) -> Result<RequiredAction, RequestDrop> {
    message(datagram, STANDARD, |request| {
        responder.handle_request(request, sender, now)
    })
}

/// Returns the meaning of the response, without the fields.
pub(super) fn answer(
    requestor: &mut Requestor,
    datagram: &[u8],
    now: Duration,
) -> Result<String, ResponseDrop> {
    message(datagram, STANDARD, |response| {
        let heard = requestor.handle_response(response, now)?;
        Ok(match heard {
            ResponseMeaning::Executing(_) => "executing".to_owned(),
            ResponseMeaning::Closed(_) => "closed".to_owned(),
            ResponseMeaning::Done(_, outcome) => format!("{outcome:?}"),
        })
    })
}
