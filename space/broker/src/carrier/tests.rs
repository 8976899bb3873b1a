//! Tests of the end of a carrier. Its tasks do not run, because the tests do not wait.

use std::task::Waker;

use mappings::BrokerAddress;

use super::*;

/// Returns a carrier with two connections, and a retained message that is sent.
fn carrier() -> Mqtt {
    let mut broker = Broker::new(BrokerAddress::parse("mqtt://127.0.0.1:1").unwrap());
    broker.at_least_once = true;
    let identity = BrokerIdentity {
        program: "test".to_owned(),
        publisher: Some(1),
    };
    let mut carrier = Mqtt::open(&broker, &identity).unwrap();
    carrier.links.main().state().link = BrokerLink::Connected {
        at: SocketAddr::from(([127, 0, 0, 1], 1)),
        version: MqttVersion::V5,
        max_packet: None,
    };
    let address = Address {
        kind: TopicMessageType::MetaData,
        publisher: 1,
        group: Some(2),
        writer: Some(10),
    };
    carrier.keep(carrier.publication(UADP, address, vec![1]));
    assert_eq!(sent(&carrier), ["opcua/uadp/metadata/1/2/10: 1"]);
    carrier
}

/// Takes the messages of the main connection: their topics and the sizes of their payloads.
fn sent(carrier: &Mqtt) -> Vec<String> {
    let mut state = carrier.links.main().state();
    std::iter::from_fn(|| state.queue.pop(instant(), true))
        .map(|(of, _)| format!("{}: {}", of.topic, of.payload.len()))
        .collect()
}

#[tokio::test]
async fn the_end_follows_the_last_value_that_the_broker_confirms() {
    let mut carrier = carrier();
    carrier.close();
    let mut cx = Context::from_waker(Waker::noop());
    assert!(carrier.poll_closed(&mut cx).is_pending());
    assert_eq!(sent(&carrier), [""; 0], "the values are not sent yet");
    carrier.links.of(true).closed();
    assert!(carrier.poll_closed(&mut cx).is_pending());
    assert_eq!(sent(&carrier)[0], "opcua/uadp/metadata/1/2/10: 0");
    carrier.links.main().closed();
    assert!(carrier.poll_closed(&mut cx).is_ready());
}

#[tokio::test]
async fn a_carrier_that_is_dropped_while_it_closes_publishes_its_end() {
    let mut carrier = carrier();
    carrier.close();
    let main = Arc::clone(carrier.links.main());
    drop(carrier);
    let first = main.state().queue.pop(instant(), true).unwrap().0;
    assert_eq!(first.topic, "opcua/uadp/metadata/1/2/10");
    assert!(first.payload.is_empty());
}
