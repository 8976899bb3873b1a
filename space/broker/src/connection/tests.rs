//! A session with a broker in memory: the packets of the broker are bytes, and nothing waits.

use mappings::{Broker, BrokerAddress};

use super::*;
use crate::topics::TopicFilter;

fn settings() -> BrokerSettings {
    let filter = |name: &str| TopicFilter {
        name: name.to_owned(),
        confirmed: true,
    };
    BrokerSettings {
        broker: Broker::new(BrokerAddress::parse("mqtt://localhost").unwrap()),
        client_id: "test".to_owned(),
        publisher: Some(1),
        credentials: None,
        tls: None,
        will: None,
        filters: vec![filter("opcua/uadp/status/#"), filter("opcua/uadp/data/#")],
    }
}

/// Returns a state, or an event, with this number as its payload.
fn publication(topic: &str, number: u8, is_state: bool) -> QueuedPublish {
    QueuedPublish {
        topic: topic.to_owned(),
        payload: vec![number],
        retained: false,
        confirmed: true,
        replaceable: is_state,
        outlasts: is_state,
        within: Some(Duration::from_secs(15)),
        message_type: "ua-data",
        content_type: "application/opcua+uadp",
    }
}

/// Returns a session that the broker has accepted.
fn accepted<'a>(settings: &'a BrokerSettings, shared: &'a ConnectionShared) -> Session<'a> {
    let mut session = Session::new(settings, shared, MqttVersion::V3_1_1);
    session.send(packets::connect(settings, MqttVersion::V3_1_1).unwrap());
    session.receive(&[0x20, 2, 0, 0]);
    session
}

/// Receives the responses of the broker to the requested subscriptions in their order.
fn respond(session: &mut Session<'_>, codes: &[u8]) {
    let ids: Vec<u16> = session.subscriptions.requested_ids().collect();
    assert_eq!(ids.len(), codes.len());
    for (id, code) in ids.into_iter().zip(codes) {
        let [high, low] = id.to_be_bytes();
        session.receive(&[0x90, 3, high, low, *code]);
    }
}

/// Writes everything, and returns it.
fn written(session: &mut Session<'_>) -> Vec<u8> {
    let bytes = session.out.0.clone();
    session.written(bytes.len());
    bytes
}

/// Returns whether the bytes contain a text.
fn has(bytes: &[u8], text: &str) -> bool {
    bytes.windows(text.len()).any(|of| of == text.as_bytes())
}

const GRANTED: u8 = 1;
const REFUSED: u8 = 0x80;

#[test]
fn a_session_requests_a_subscription_again_that_a_cluster_without_a_leader_refuses() {
    let (settings, shared) = (settings(), ConnectionShared::default());
    let mut session = accepted(&settings, &shared);
    let requested = written(&mut session);
    assert!(has(&requested, "opcua/uadp/status/#") && has(&requested, "opcua/uadp/data/#"));
    assert!(!session.is_connected(), "no subscription is confirmed");
    respond(&mut session, &[GRANTED, REFUSED]);
    assert!(session.is_connected(), "values can be sent");

    session.fire(TokioInstant::now() + Duration::from_millis(1500));
    let again = written(&mut session);
    assert!(has(&again, "opcua/uadp/data/#") && !has(&again, "opcua/uadp/status/#"));
    respond(&mut session, &[GRANTED]);
    session.fire(TokioInstant::now() + Duration::from_secs(60));
    assert!(!has(&written(&mut session), "opcua/uadp/data/#"));
}

#[test]
fn a_lost_connection_leaves_unconfirmed_states_for_the_next_and_counts_the_other_messages() {
    let (settings, shared) = (settings(), ConnectionShared::default());
    let mut session = accepted(&settings, &shared);
    respond(&mut session, &[GRANTED, GRANTED]);
    let _subscribed = written(&mut session);
    let mut send = |publication| {
        shared.state().queue.push(publication, instant()).unwrap();
        let is_closed = session.fill();
        assert!(!is_closed);
        written(&mut session)
    };

    let _first = send(publication("state", 1, true));
    let _second = send(publication("state", 2, true));
    let _event = send(publication("event", 3, false));
    let _third = send(publication("state", 4, true));
    // The broker confirms the first message only.
    let [high, low] = session.in_flight.front().unwrap().0.to_be_bytes();
    session.receive(&[0x40, 2, high, low]);
    // A command is taken from the queue, but not written.
    let command = QueuedPublish {
        confirmed: false,
        ..publication("command", 5, false)
    };
    shared.state().queue.push(command, instant()).unwrap();
    let _is_closed = session.fill();
    assert!(has(&session.out.0, "command"));

    assert!(shared.waits("cut", session.take_unsent()));
    let counted = {
        let queue = &shared.state().queue;
        (queue.unconfirmed, queue.discarded)
    };
    assert_eq!(counted, (1, 1), "the event; the command");

    let mut next = accepted(&settings, &shared);
    respond(&mut next, &[GRANTED, GRANTED]);
    let _subscribed = written(&mut next);
    let _is_closed = next.fill();
    let sent = written(&mut next);
    assert!(has(&sent, "state") && sent.ends_with(&[4]), "{sent:?}");
    assert!(!has(&sent, "event") && !has(&sent, "command"));
    let numbers = next.in_flight.iter().map(|(_, (of, _))| of.payload.clone());
    assert_eq!(numbers.collect::<Vec<_>>(), [[2], [4]]);
}
