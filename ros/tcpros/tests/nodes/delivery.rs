//! Messages from node to node: complete, in order, not from the node itself, and counted when lost
//! by a late consumer.

use bytes::Bytes;
use tcpros::{Inbox, InboxEvent, Node, PublisherOptions, RequestedType, SubscriberOptions};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;

use crate::support::*;

#[tokio::test]
async fn messages_arrive_in_order_with_the_header_of_their_publisher() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/chatter", &inbox);
    let publisher = advertise(&talker, "/chatter", PublisherOptions::default());
    eventually("the subscriber", || publisher.subscribers() == 1).await;
    for n in 0..500u16 {
        let sent = publisher.publish(Bytes::from(vec![n.to_le_bytes()[0]; 1024]));
        assert_eq!((sent.sent_to, sent.dropped_oldest), (1, 0));
    }
    for n in 0..500u16 {
        let message = message(&mut inbox).await;
        assert_eq!(message.bytes, vec![n.to_le_bytes()[0]; 1024]);
        assert_eq!(message.peer.caller_id, "/talker");
        assert_eq!(message.peer.header.type_name(), Some("std_msgs/String"));
        assert_eq!(
            message.peer.header.message_definition(),
            Some("string data\n")
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_of_every_size_arrive_whole_on_several_threads() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/sizes", &inbox);
    let publisher = advertise(&talker, "/sizes", PublisherOptions::default());
    eventually("the subscriber", || publisher.subscribers() == 1).await;
    for size in [0, 1, 16 * 1024, 16 * 1024 + 1, 100_000, 1 << 20, 10 << 20] {
        let content: Vec<u8> = (0..=255).cycle().take(size).collect();
        assert_eq!(publisher.publish(Bytes::from(content.clone())).sent_to, 1);
        assert!(
            message(&mut inbox).await.bytes == content,
            "{size} bytes differ"
        );
    }
}

#[tokio::test]
async fn a_late_subscriber_gets_the_latched_message() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let publisher = advertise(
        &talker,
        "/state",
        PublisherOptions {
            latch: true,
            ..Default::default()
        },
    );
    assert_eq!(publisher.publish(Bytes::from_static(b"old")).sent_to, 0);
    assert_eq!(publisher.publish(Bytes::from_static(b"last")).sent_to, 0);
    let mut inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/state", &inbox);
    let first = message(&mut inbox).await;
    assert_eq!(first.bytes, b"last".as_slice());
    assert!(first.peer.header.latching());
}

#[tokio::test]
async fn a_burst_longer_than_the_queue_reaches_a_consumer_that_keeps_up() {
    let core = core();
    let listener = node("listener", &core);
    let mut inbox = Inbox::new();
    let bounds = SubscriberOptions {
        queue_messages: 200,
        ..Default::default()
    };
    let _subscription = listener
        .subscribe(
            "/t",
            RequestedType::default(),
            bounds,
            "/t".to_owned(),
            &inbox,
        )
        .unwrap();
    registered(&listener).await;
    let topics = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let (api, uri) = raw_publisher().await;
    name_publisher(&listener, &uri).await;
    answer_request_topic(&api, topics.local_addr().unwrap().port()).await;
    let mut stream = accept_subscriber(&topics, "/raw").await;
    let burst: Vec<u8> = (0..20_000u32)
        .flat_map(|n| [4u32.to_le_bytes(), n.to_le_bytes()])
        .flatten()
        .collect();
    let sending = tokio::spawn(async move {
        stream.write_all(&burst).await.unwrap();
        stream
    });
    let mut before = std::time::SystemTime::UNIX_EPOCH;
    for n in 0..20_000u32 {
        let message = message(&mut inbox).await;
        assert_eq!(message.bytes, n.to_le_bytes().as_slice());
        assert!(message.received > before, "two messages have one time");
        before = message.received;
    }
    drop(sending);
}

#[tokio::test]
async fn a_consumer_that_is_late_loses_the_oldest_and_is_told() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let bounds = SubscriberOptions {
        queue_messages: 3,
        ..Default::default()
    };
    let subscription = listener
        .subscribe("/t", RequestedType::default(), bounds, (), &inbox)
        .unwrap();
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    eventually("the link", || publisher.subscribers() == 1).await;
    for n in 0..10u8 {
        assert_eq!(publisher.publish(Bytes::from(vec![n])).sent_to, 1);
    }
    eventually("the overflow", || subscription.dropped() == 7).await;
    let mut seen = Vec::new();
    while let Some(((), event)) = inbox.try_recv() {
        match event {
            InboxEvent::Dropped(n) => seen.push(format!("lost {n}")),
            InboxEvent::Message(message) => seen.push(message.bytes[0].to_string()),
            _ => {}
        }
    }
    assert_eq!(seen, ["lost 7", "7", "8", "9"]);
}

#[tokio::test]
async fn a_node_does_not_hear_itself() {
    let core = core();
    let (both, other) = (node("both", &core), node("other", &core));
    let mut inbox = Inbox::new();
    let subscription = subscribe(&both, "/t", &inbox);
    let own = advertise(&both, "/t", PublisherOptions::default());
    let theirs = advertise(&other, "/t", PublisherOptions::default());
    eventually("the other publisher", || subscription.publishers() == 1).await;
    assert_eq!(own.publish(Bytes::from_static(b"own")).sent_to, 0);
    assert_eq!(theirs.publish(Bytes::from_static(b"theirs")).sent_to, 1);
    assert_eq!(message(&mut inbox).await.bytes, b"theirs".as_slice());
    assert_eq!(subscription.publishers(), 1);
}

#[tokio::test]
async fn a_publisher_with_our_name_under_another_address_is_not_heard() {
    let core = core();
    let listener = node("twin", &core);
    let inbox = Inbox::new();
    let subscription = subscribe(&listener, "/t", &inbox);
    registered(&listener).await;
    let topics = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let (api, uri) = raw_publisher().await;
    name_publisher(&listener, &uri).await;
    answer_request_topic(&api, topics.local_addr().unwrap().port()).await;
    let mut stream = accept_subscriber(&topics, "/twin").await;
    within("the end", stream.read_to_end(&mut Vec::new()))
        .await
        .unwrap();
    assert_eq!(subscription.publishers(), 0);
}

/// Requirement: a node recognizes its own messages by its resolved name, including namespace and
/// `__name`.
#[tokio::test]
async fn a_node_in_a_namespace_under_another_name_does_not_hear_itself_either() {
    let core = core();
    let mut renamed = options("both", core.uri());
    assert_eq!(
        renamed
            .apply_arguments(&["__ns:=/cell", "__name:=twin", "in:=/line/t"])
            .unwrap(),
        [""; 0]
    );
    let (both, other) = (Node::start(renamed).unwrap(), node("twin", &core));
    assert_eq!(both.name(), "/cell/twin");
    let mut inbox = Inbox::new();
    let subscription = subscribe(&both, "in", &inbox);
    assert_eq!(subscription.topic(), "/line/t");
    let own = advertise(&both, "in", PublisherOptions::default());
    // The same name without the namespace is another node.
    let theirs = advertise(&other, "/line/t", PublisherOptions::default());
    eventually("the other publisher", || subscription.publishers() == 1).await;
    assert_eq!(own.publish(Bytes::from_static(b"own")).sent_to, 0);
    assert_eq!(theirs.publish(Bytes::from_static(b"theirs")).sent_to, 1);
    let heard = message(&mut inbox).await;
    assert_eq!(
        (heard.bytes.as_ref(), heard.peer.caller_id.as_str()),
        (b"theirs".as_slice(), "/twin")
    );
}
