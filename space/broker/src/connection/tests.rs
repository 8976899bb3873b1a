//! A session with a broker in memory: the packets of the broker are bytes, and nothing waits.

use mappings::{Broker, BrokerAddress};

use super::*;
use crate::json::PromotedTexts;
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
        promoted: PromotedTexts::default(),
    }
}

/// Returns a session that the broker has accepted.
fn accepted<'a>(settings: &'a BrokerSettings, shared: &'a ConnectionShared) -> Session<'a> {
    let opened = (MqttVersion::V3_1_1, true);
    let mut session = Session::new(settings, shared, opened);
    session.send(packets::connect(settings, opened).unwrap());
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
fn a_session_without_subscriptions_sends_as_soon_as_the_broker_accepts_it() {
    let (mut settings, shared) = (settings(), ConnectionShared::default());
    settings.filters.clear();
    let opened = (MqttVersion::V3_1_1, true);
    let mut session = Session::new(&settings, &shared, opened);
    session.send(packets::connect(&settings, opened).unwrap());
    let _connect = written(&mut session);
    let state = publication("state", 1, true);
    shared.state().queue.push(state, instant()).unwrap();
    let _is_closed = session.fill();
    assert!(!session.is_connected() && written(&mut session).is_empty());
    session.receive(&[0x20, 2, 0, 0]);
    let _is_closed = session.fill();
    assert!(session.is_connected() && has(&written(&mut session), "state"));
}

#[test]
fn a_session_keeps_the_response_of_the_broker_to_its_version() {
    let (settings, shared) = (settings(), ConnectionShared::default());
    let mut session = Session::new(&settings, &shared, (MqttVersion::V3_1_1, true));
    assert_eq!(session.response, VersionResponse::Unknown);
    session.send(packets::connect(&settings, (MqttVersion::V3_1_1, true)).unwrap());
    // The broker does not support the version (MQTT 3.1.1, 3.2.2.3).
    session.receive(&[0x20, 2, 0, 1]);
    assert_eq!(session.response, VersionResponse::Refused);
    assert!(session.accepted.is_none());
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

#[test]
fn a_broker_that_retains_nothing_receives_all_announcements_again_and_again() {
    let (settings, shared) = (settings(), ConnectionShared::default());
    let announcement = QueuedPublish {
        retained: true,
        confirmed: false,
        ..publication("metadata", 7, true)
    };
    let topic = announcement.topic.clone();
    shared.state().kept.insert(topic, announcement);
    let opened = (MqttVersion::V5, true);
    let mut session = Session::new(&settings, &shared, opened);
    session.send(packets::connect(&settings, opened).unwrap());
    // CONNACK with Retain Available 0, and the responses to the subscriptions.
    session.receive(&[0x20, 5, 0, 0, 2, 37, 0]);
    for id in session.subscriptions.requested_ids().collect::<Vec<_>>() {
        let [high, low] = id.to_be_bytes();
        session.receive(&[0x90, 4, high, low, 0, GRANTED]);
    }
    assert!(session.is_connected());
    let _subscribed = written(&mut session);
    let sent = |session: &mut Session<'_>| {
        let _is_closed = session.fill();
        written(session)
    };
    let first = sent(&mut session);
    assert!(has(&first, "metadata"));
    // The flag RETAIN is the last bit of a PUBLISH (MQTT 5, 3.3.1.3).
    assert_eq!(first.first(), Some(&0x30));
    assert!(!has(&sent(&mut session), "metadata"));
    session.fire(TokioInstant::now() + KEPT_REPEATED);
    assert!(has(&sent(&mut session), "metadata"));
}

#[test]
fn a_broker_that_refuses_a_retained_will_is_opened_without_one() {
    let (mut settings, shared) = (settings(), ConnectionShared::default());
    settings.will = Some(crate::settings::Will {
        topic: "status".to_owned(),
        payload: vec![1],
    });
    let mut session = Session::new(&settings, &shared, (MqttVersion::V5, true));
    session.receive(&[0x20, 3, 0, 0x9a, 0]);
    assert!(!session.retains);
    // The flag Will Retain is bit 5 of the connect flags (MQTT 5, 3.1.2.7).
    let flags = |retains| {
        let packet = packets::connect(&settings, (MqttVersion::V5, retains)).unwrap();
        packet.to_continuous_buffer()[9] & 0x20
    };
    assert_eq!((flags(true), flags(false)), (0x20, 0));
}
