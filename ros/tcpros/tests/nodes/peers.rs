//! Peers that are slow, send nothing, or violate the protocol.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use tcpros::{ConnectionHeader, Inbox, Node, PublisherOptions};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, timeout};

use crate::support::*;

#[tokio::test]
async fn a_subscriber_that_does_not_read_does_not_hold_up_another() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let limits = PublisherOptions {
        queue_messages: 50,
        ..Default::default()
    };
    let publisher = advertise(&talker, "/t", limits);
    registered(&talker).await;
    let (stalled, header) = raw_subscriber(topic_port(&talker, "/t").await, "/t", "*").await;
    assert_eq!(header.caller_id(), "/talker");
    let mut inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/t", &inbox);
    eventually("both", || publisher.subscribers() == 2).await;
    for n in 0..2000u32 {
        let mut content = vec![0; 20_000];
        content[..4].copy_from_slice(&n.to_le_bytes());
        assert_eq!(publisher.publish(Bytes::from(content)).sent_to, 2);
        assert_eq!(message(&mut inbox).await.bytes[..4], n.to_le_bytes());
    }
    assert!(publisher.dropped() > 0, "40 MB do not fit into a socket");
    drop(stalled);
    eventually("its leaving", || publisher.subscribers() == 1).await;
}

#[tokio::test]
async fn garbage_at_the_topic_port_costs_only_itself() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    registered(&talker).await;
    let port = topic_port(&talker, "/t").await;
    let silent = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
    for garbage in [
        b"\xff\xff\xff\xff".as_slice(),
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x04\0\0\0\xff\xff\xff\x7f",
        b"\x05\0\0\0\x01\0\0\0a",
        b"\0\0\0\0",
        b"\x10",
    ] {
        let mut stream = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
        stream.write_all(garbage).await.unwrap();
        stream.shutdown().await.unwrap();
        let mut answer = Vec::new();
        // Closed, or reset because not all data was read: the connection has ended in both cases.
        within("the end", stream.read_to_end(&mut answer))
            .await
            .ok();
    }
    let mut inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/t", &inbox);
    eventually("the subscriber", || publisher.subscribers() == 1).await;
    assert_eq!(publisher.publish(Bytes::from_static(b"x")).sent_to, 1);
    assert_eq!(message(&mut inbox).await.bytes, b"x".as_slice());
    drop(silent);
}

#[tokio::test]
async fn a_subscriber_that_does_not_fit_is_told_why() {
    let core = core();
    let talker = node("talker", &core);
    let _publisher = advertise(&talker, "/t", PublisherOptions::default());
    let port = topic_port(&talker, "/t").await;
    let (_, other_type) = raw_subscriber(port, "/t", &"0".repeat(32)).await;
    assert!(
        other_type.get("error").unwrap().contains("datatype/md5sum"),
        "{other_type:?}"
    );
    let (_, no_topic) = raw_subscriber(port, "/nothing", "*").await;
    assert!(
        no_topic
            .get("error")
            .unwrap()
            .contains("nonexistent topic [/nothing]"),
        "{no_topic:?}"
    );
    let (_, fits) = raw_subscriber(port, "/t", MD5).await;
    assert_eq!(
        (fits.get("error"), fits.type_name()),
        (None, Some("std_msgs/String"))
    );
}

#[tokio::test]
async fn a_publisher_that_breaks_off_or_sends_nonsense_is_asked_again() {
    let core = core();
    let mut small = options("listener", core.uri());
    small.max_message = 1000;
    let listener_node = Node::start(small).unwrap();
    let mut inbox = Inbox::new();
    let subscription = subscribe(&listener_node, "/t", &inbox);
    let topics = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = topics.local_addr().unwrap().port();
    let (api, uri) = raw_publisher().await;
    registered(&listener_node).await;
    name_publisher(&listener_node, &uri).await;
    // A message past the limit, then a connection that ends within a message, then a working
    // connection.
    answer_request_topic(&api, port).await;
    let mut first = accept_subscriber(&topics, "/raw").await;
    first.write_all(&1001u32.to_le_bytes()).await.unwrap();
    answer_request_topic(&api, port).await;
    assert_eq!(subscription.refused_frames(), 1);
    let mut second = accept_subscriber(&topics, "/raw").await;
    second.write_all(b"\x05\0\0\0ab").await.unwrap();
    drop(second);
    answer_request_topic(&api, port).await;
    let mut third = accept_subscriber(&topics, "/raw").await;
    third.write_all(b"\x02\0\0\0ok").await.unwrap();
    assert_eq!(message(&mut inbox).await.bytes, b"ok".as_slice());
}

/// Requirement: memory is bounded by the queue of the topic, independent of the number of slow
/// subscribers.
#[tokio::test]
async fn many_slow_subscribers_hold_the_same_messages_once() {
    const SLOW: usize = 20;
    const QUEUED: usize = 10;
    let core = core();
    let talker = node("talker", &core);
    let limits = PublisherOptions {
        queue_bytes: QUEUED * 100_000,
        ..Default::default()
    };
    let publisher = advertise(&talker, "/t", limits);
    let port = topic_port(&talker, "/t").await;
    let mut stalled = Vec::new();
    for _ in 0..SLOW {
        stalled.push(raw_subscriber(port, "/t", "*").await.0);
    }
    let held = Arc::new(());
    let mut most = 0;
    while publisher.dropped() < 20 * u64::try_from(SLOW).unwrap() {
        let content = Counted(vec![0; 100_000], Arc::clone(&held));
        assert_eq!(publisher.publish(Bytes::from_owner(content)).sent_to, SLOW);
        tokio::task::yield_now().await;
        most = most.max(Arc::strong_count(&held) - 1);
    }
    // The queue, and for each subscriber the message that is being written.
    assert!(most <= QUEUED + SLOW + 1, "{most} messages were held");
}

/// The content of a message that is counted as long as a reference exists.
struct Counted(
    Vec<u8>,
    #[expect(dead_code, reason = "it counts by being there")] Arc<()>,
);

impl AsRef<[u8]> for Counted {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

/// Requirement: a header is at most 1 MiB long, and a long text of a peer is not repeated in full.
#[tokio::test]
async fn a_header_past_the_limit_is_refused_and_a_long_one_answered_briefly() {
    let core = core();
    let talker = node("talker", &core);
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    let port = topic_port(&talker, "/t").await;

    let mut stream = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
    stream
        .write_all(&((1 << 20) + 1u32).to_le_bytes())
        .await
        .unwrap();
    let mut answer = Vec::new();
    within("the end", stream.read_to_end(&mut answer))
        .await
        .ok();
    assert_eq!(answer, b"");

    let (_, refused) = raw_subscriber(port, "/t", &"f".repeat(1_000_000)).await;
    let error = refused.get("error").unwrap();
    assert!(
        error.contains("datatype/md5sum") && error.len() < 2000,
        "{} bytes",
        error.len()
    );
    let (_stream, taken) = raw_subscriber(port, "/t", "*").await;
    assert_eq!((taken.get("error"), publisher.subscribers()), (None, 1));
}

/// Requirement: peers that reset their connection within the handshake affect only themselves.
#[tokio::test]
async fn twenty_resets_within_the_handshake_leave_the_topic_as_it_was() {
    let core = core();
    let talker = node("talker", &core);
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    let port = topic_port(&talker, "/t").await;
    for n in 0..20usize {
        let mut stream = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
        let request = ConnectionHeader::default()
            .with("callerid", "/by_hand")
            .with("topic", "/t")
            .with("md5sum", "*")
            .encode()
            .unwrap();
        // From nothing at all to a whole header.
        let sent = request.len() * n / 19;
        stream.write_all(&request[..sent]).await.unwrap();
        stream.set_zero_linger().unwrap();
    }
    let (mut whole, _) = raw_subscriber(port, "/t", "*").await;
    eventually("the resets are noticed", || publisher.subscribers() == 1).await;
    assert_eq!(publisher.publish(Bytes::from_static(b"x")).sent_to, 1);
    let mut message = [0; 5];
    within("the message", whole.read_exact(&mut message))
        .await
        .unwrap();
    assert_eq!(&message, b"\x01\0\0\0x");
}

/// Requirement: a publisher that accepts and sends nothing is abandoned after five seconds and
/// retried.
#[tokio::test]
async fn a_publisher_that_accepts_and_says_nothing_is_asked_again() {
    let core = core();
    let listener = node("listener", &core);
    let mut inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/t", &inbox);
    let topics = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = topics.local_addr().unwrap().port();
    let (api, uri) = raw_publisher().await;
    registered(&listener).await;
    name_publisher(&listener, &uri).await;
    answer_request_topic(&api, port).await;
    let (mut silent, _) = within("a connection", topics.accept()).await.unwrap();
    within("its end", silent.read_to_end(&mut Vec::new()))
        .await
        .unwrap();
    answer_request_topic(&api, port).await;
    let mut stream = accept_subscriber(&topics, "/raw").await;
    stream.write_all(b"\x02\0\0\0ok").await.unwrap();
    assert_eq!(message(&mut inbox).await.bytes, b"ok".as_slice());
}

/// Requirement: the address of a publisher is requested for each attempt, 0.1 s after the first
/// failure and doubling. It is requested at once when the master lists the publisher again, which
/// may have restarted under its old address.
#[tokio::test]
async fn tries_come_ever_later_until_the_master_names_the_publisher_again() {
    let core = core();
    let listener = node("listener", &core);
    let inbox = Inbox::new();
    let subscription = subscribe(&listener, "/t", &inbox);
    let topics = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let (api, uri) = raw_publisher().await;
    registered(&listener).await;
    name_publisher(&listener, &uri).await;
    let mut tries = Vec::new();
    for _ in 0..6 {
        // No server listens at port 1 of the cell.
        answer_request_topic(&api, 1).await;
        tries.push(Instant::now());
    }
    for (n, pair) in tries.windows(2).enumerate() {
        let waited = pair[1] - pair[0];
        let least = Duration::from_millis(90 << n);
        assert!(waited > least, "{waited:?} before try {}", n + 2);
    }
    // The next attempt is due in 3.2 s.
    let named = Instant::now();
    name_publisher(&listener, &uri).await;
    answer_request_topic(&api, topics.local_addr().unwrap().port()).await;
    let waited = named.elapsed();
    assert!(waited < Duration::from_millis(2500), "{waited:?}");
    let _stream = accept_subscriber(&topics, "/raw").await;
    eventually("the link", || subscription.publishers() == 1).await;
}

/// Requirement: the master gets its reply at once, however slow the listed publishers are.
#[tokio::test]
async fn an_update_is_answered_while_the_publishers_it_names_say_nothing() {
    let core = core();
    let listener = node("listener", &core);
    let inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/t", &inbox);
    let (api, uri) = raw_publisher().await;
    registered(&listener).await;
    let started = Instant::now();
    name_publisher(&listener, &uri).await;
    // It would wait five seconds for a reply.
    let (_silent, _) = within("requestTopic", api.accept()).await.unwrap();
    assert!(started.elapsed() < Duration::from_secs(4));
}

/// Requirement: a publisher that the master no longer lists is not retried.
#[tokio::test]
async fn a_publisher_that_is_no_longer_named_is_left_alone() {
    let core = core();
    let listener = node("listener", &core);
    let inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/t", &inbox);
    let (api, uri) = raw_publisher().await;
    registered(&listener).await;
    name_publisher(&listener, &uri).await;
    answer_request_topic(&api, 1).await;
    let (_, other) = raw_publisher().await;
    name_publisher(&listener, &other).await;
    // An attempt may have been on its way; the wait before the next attempt is at most 0.4 s.
    let mut tries = 0;
    while let Ok(accepted) = timeout(Duration::from_millis(600), api.accept()).await {
        accepted.unwrap();
        tries += 1;
    }
    assert!(tries <= 1, "{tries} more tries");
}

/// Requirement: the claims of a peer cost a bounded number of connections and log entries.
#[tokio::test]
async fn a_forged_list_of_publishers_is_followed_in_part_and_summed_up_in_the_log() {
    let log = Log::default();
    let to = log.clone();
    let lines = tracing_subscriber::fmt()
        .with_ansi(false)
        .with_writer(move || to.clone());
    let _guard = tracing::subscriber::set_default(lines.finish());
    let core = core();
    let listener = node("listener", &core);
    let inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/t", &inbox);
    registered(&listener).await;
    // No server listens there, which each attempt detects at once.
    let uris: String = (0..3000)
        .map(|n| format!("<value>http://127.0.0.1:1/{n}</value>"))
        .collect();
    let update = format!(
        "<methodCall><methodName>publisherUpdate</methodName><params><param><value>/master</value></param><param>\
         <value>/t</value></param><param><value><array><data>{uris}</data></array></value></param></params></methodCall>"
    );
    assert!(slave_call(&listener, &update).await.contains("<i4>1</i4>"));
    let named = || log.count("cannot connect to a registered publisher");
    eventually("the sum", || {
        let summed_up = log.count("cannot connect to further registered publishers") == 1;
        summed_up && named() == 20
    })
    .await;
    assert_eq!(
        log.count("ignored publishers of a topic above the limit"),
        1
    );
}

/// The log output.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl Log {
    fn count(&self, part: &str) -> usize {
        let written = self.0.lock().unwrap();
        String::from_utf8_lossy(&written).matches(part).count()
    }
}

impl std::io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}
