//! Nodes of this crate with one another and with peers that misbehave, around a master in this process.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

use std::future::Future;
use std::net::SocketAddr;
use std::time::Duration;

use bytes::Bytes;
use tcpros::{
    ConnectionHeader, Core, Inbox, InboxEvent, MasterState, Message, Node, NodeError, NodeOptions,
    Publisher, PublisherOptions, SubscriberOptions, Subscription, TopicType, Wanted,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::timeout;

const MD5: &str = "992ce8a1687cec8c8bd883ec73ca41d1";
const DEADLINE: Duration = Duration::from_secs(20);

fn core() -> Core {
    Core::start(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap()
}

fn options(name: &str, master: &str) -> NodeOptions {
    let mut options = NodeOptions::from_env(name);
    master.clone_into(&mut options.master_uri);
    "/".clone_into(&mut options.namespace);
    options.advertise_as("127.0.0.1");
    options
}

fn node(name: &str, core: &Core) -> Node {
    Node::start(options(name, core.uri())).unwrap()
}

fn string() -> TopicType {
    TopicType {
        name: "std_msgs/String".to_owned(),
        md5sum: MD5.to_owned(),
        definition: "string data\n".to_owned(),
    }
}

fn advertise(node: &Node, topic: &str, options: PublisherOptions) -> Publisher {
    node.advertise(topic, string(), options).unwrap()
}

fn subscribe(node: &Node, topic: &str, inbox: &Inbox<String>) -> Subscription {
    let options = SubscriberOptions::default();
    node.subscribe(topic, Wanted::default(), options, topic.to_owned(), inbox)
        .unwrap()
}

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    match timeout(DEADLINE, future).await {
        Ok(value) => value,
        Err(_) => panic!("waited {DEADLINE:?} for {what}"),
    }
}

async fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    within(what, async {
        while !condition() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

async fn message(inbox: &mut Inbox<String>) -> Message {
    within("a message", async {
        loop {
            match inbox.recv().await.1 {
                InboxEvent::Message(message) => return message,
                InboxEvent::Dropped(n) => panic!("{n} messages were dropped"),
                _ => {}
            }
        }
    })
    .await
}

async fn registered(node: &Node) {
    let mut state = node.master_state();
    within(
        "the registration",
        state.wait_for(|s| *s == MasterState::Registered),
    )
    .await
    .unwrap();
}

/// The port of a node's topics, as any peer would ask for it.
async fn topic_port(node: &Node, topic: &str) -> u16 {
    let answer = slave_call(
        node,
        &format!(
            "<methodCall><methodName>requestTopic</methodName><params><param><value>/test</value></param>\
             <param><value>{topic}</value></param><param><value><array><data><value><array><data>\
             <value>TCPROS</value></data></array></value></data></array></value></param></params></methodCall>"
        ),
    )
    .await;
    let port = answer
        .rsplit_once("<i4>")
        .unwrap()
        .1
        .split_once('<')
        .unwrap()
        .0;
    port.parse()
        .unwrap_or_else(|_| panic!("no port in {answer}"))
}

async fn slave_call(node: &Node, body: &str) -> String {
    let address = node
        .uri()
        .trim_start_matches("http://")
        .trim_end_matches('/');
    let mut stream = TcpStream::connect(address).await.unwrap();
    let head = "POST / HTTP/1.1\r\nHost: x\r\nConnection: close\r\nContent-Length:";
    stream
        .write_all(format!("{head} {}\r\n\r\n{body}", body.len()).as_bytes())
        .await
        .unwrap();
    let mut answer = String::new();
    within("the slave API", stream.read_to_string(&mut answer))
        .await
        .unwrap();
    answer
}

/// A subscriber made by hand, up to the publisher's header.
async fn raw_subscriber(port: u16, topic: &str, md5sum: &str) -> (TcpStream, ConnectionHeader) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
    let request = ConnectionHeader::default()
        .with("callerid", "/by_hand")
        .with("topic", topic)
        .with("md5sum", md5sum);
    stream.write_all(&request.encode().unwrap()).await.unwrap();
    let len = stream.read_u32_le().await.unwrap();
    let mut header = vec![0; usize::try_from(len).unwrap()];
    stream.read_exact(&mut header).await.unwrap();
    (stream, ConnectionHeader::parse(&header).unwrap())
}

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

#[tokio::test]
async fn a_node_that_starts_before_its_master_registers_when_it_comes() {
    let placeholder = core();
    let address = placeholder.address();
    drop(placeholder);
    let early = Node::start(options("early", &format!("http://{address}"))).unwrap();
    let _publisher = advertise(&early, "/t", PublisherOptions::default());
    assert_eq!(*early.master_state().borrow(), MasterState::Awaited);
    let core = within("the port", async {
        loop {
            match Core::start(address) {
                Ok(core) => return core,
                Err(_) => tokio::task::yield_now().await,
            }
        }
    })
    .await;
    registered(&early).await;
    let graph = early.graph().await.unwrap();
    assert_eq!(graph.publishers["/t"], ["/early"]);
    assert_eq!(graph.types["/t"], "std_msgs/String");
    drop(core);
}

#[tokio::test]
async fn after_a_restart_of_the_master_all_is_registered_again_and_links_have_stayed() {
    let core = core();
    let address = core.address();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let subscription = subscribe(&listener, "/t", &inbox);
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    eventually("the link", || publisher.subscribers() == 1).await;
    registered(&listener).await;
    drop(core);
    let mut state = talker.master_state();
    within("the loss", state.wait_for(|s| *s == MasterState::Awaited))
        .await
        .unwrap();
    assert_eq!(publisher.publish(Bytes::from_static(b"without")).sent_to, 1);
    assert_eq!(message(&mut inbox).await.bytes, b"without".as_slice());

    let _core = Core::start(address).unwrap();
    within("the new registrations", async {
        loop {
            let graph = talker.graph().await.unwrap_or_default();
            let known =
                |of: &std::collections::BTreeMap<String, Vec<String>>| of.contains_key("/t");
            if known(&graph.publishers) && known(&graph.subscribers) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    assert_eq!((publisher.subscribers(), subscription.publishers()), (1, 1));
    assert_eq!(publisher.publish(Bytes::from_static(b"again")).sent_to, 1);
    assert_eq!(message(&mut inbox).await.bytes, b"again".as_slice());
}

#[tokio::test]
async fn shutdown_leaves_nothing_in_the_master_and_delivers_what_was_queued() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let mut held: Vec<Publisher> = (0..40)
        .map(|n| advertise(&talker, &format!("/t{n}"), Default::default()))
        .collect();
    let own = subscribe(&talker, "/own", &inbox);
    let _subscription = subscribe(&listener, "/t0", &inbox);
    eventually("the link", || held[0].subscribers() == 1).await;
    registered(&talker).await;
    assert_eq!(held[0].publish(Bytes::from_static(b"farewell")).sent_to, 1);
    drop(held.pop());
    within("the shutdown", talker.shutdown()).await;
    let graph = listener.graph().await.unwrap();
    assert_eq!(graph.publishers.len(), 0);
    assert_eq!(graph.subscribers.keys().collect::<Vec<_>>(), ["/t0"]);
    assert_eq!(message(&mut inbox).await.bytes, b"farewell".as_slice());
    assert_eq!(held[0].publish(Bytes::new()).sent_to, 0);
    drop(own);
}

#[tokio::test]
async fn a_dropped_publisher_leaves_the_graph_and_its_subscribers_learn_it() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let subscription = subscribe(&listener, "/t", &inbox);
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    within("the link", async {
        while !matches!(
            inbox.recv().await.1,
            InboxEvent::Peer {
                connected: true,
                publishers: 1,
                ..
            }
        ) {}
    })
    .await;
    drop(publisher);
    within("the end", async {
        while !matches!(
            inbox.recv().await.1,
            InboxEvent::Peer {
                connected: false,
                publishers: 0,
                ..
            }
        ) {}
    })
    .await;
    assert_eq!(subscription.publishers(), 0);
    // The topic may be taken again at once, as another type.
    let other = TopicType {
        name: "std_msgs/Other".to_owned(),
        ..string()
    };
    let again = talker
        .advertise("/t", other, PublisherOptions::default())
        .unwrap();
    eventually("the link", || again.subscribers() == 1).await;
    assert_eq!(talker.graph().await.unwrap().types["/t"], "std_msgs/Other");
}

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
        // Closed, or reset because not all was read: either way it is over.
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

/// The slave API of a publisher made by hand.
async fn raw_publisher() -> (TcpListener, String) {
    let api = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("http://{}/", api.local_addr().unwrap());
    (api, uri)
}

/// Tells a node, as a master does, that `/t` has one publisher.
async fn name_publisher(node: &Node, uri: &str) {
    let update = format!(
        "<methodCall><methodName>publisherUpdate</methodName><params><param><value>/master</value></param>\
         <param><value>/t</value></param><param><value><array><data><value>{uri}</value></data></array></value></param>\
         </params></methodCall>"
    );
    assert!(slave_call(node, &update).await.contains("<i4>1</i4>"));
}

async fn answer_request_topic(api: &TcpListener, port: u16) {
    let (mut stream, _) = within("requestTopic", api.accept()).await.unwrap();
    let mut request = Vec::new();
    while !request.ends_with(b"</methodCall>\n") {
        assert!(stream.read_buf(&mut request).await.unwrap() > 0);
    }
    let body = format!(
        "<methodResponse><params><param><value><array><data><value><i4>1</i4></value><value/><value><array><data>\
         <value>TCPROS</value><value>127.0.0.1</value><value><int>{port}</int></value></data></array></value></data>\
         </array></value></param></params></methodResponse>"
    );
    let answer = format!(
        "HTTP/1.0 200 OK\r\nContent-length: {}\r\n\r\n{body}",
        body.len()
    );
    stream.write_all(answer.as_bytes()).await.unwrap();
}

async fn accept_subscriber(listener: &TcpListener, name: &str) -> TcpStream {
    let (mut stream, _) = within("the subscriber", listener.accept()).await.unwrap();
    let len = stream.read_u32_le().await.unwrap();
    let mut header = vec![0; usize::try_from(len).unwrap()];
    stream.read_exact(&mut header).await.unwrap();
    let header = ConnectionHeader::parse(&header).unwrap();
    assert_eq!(
        (header.get("tcp_nodelay"), header.md5sum()),
        (Some("1"), Some("*"))
    );
    let reply = ConnectionHeader::default()
        .with("callerid", name)
        .with("type", "a/B");
    stream.write_all(&reply.encode().unwrap()).await.unwrap();
    stream
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
    // A message past the limit, then a connection that ends within a message, then one that works.
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
        .subscribe("/t", Wanted::default(), bounds, "/t".to_owned(), &inbox)
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
        .subscribe("/t", Wanted::default(), bounds, (), &inbox)
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
async fn rosnode_gets_an_answer_to_everything_it_asks() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/t", &inbox);
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    eventually("the link", || publisher.subscribers() == 1).await;
    assert_eq!(publisher.publish(Bytes::from_static(b"abc")).sent_to, 1);
    let ask = async |method: &str| {
        let call = format!(
            "<methodCall><methodName>{method}</methodName><params><param><value>/rosnode</value></param></params></methodCall>"
        );
        slave_call(&talker, &call).await
    };
    assert!(
        ask("getPid")
            .await
            .contains(&format!("<i4>{}</i4>", std::process::id()))
    );
    assert!(ask("getMasterUri").await.contains(core.uri()));
    let publications = ask("getPublications").await;
    assert!(publications.contains("/t") && publications.contains("std_msgs/String"));
    assert!(!ask("getSubscriptions").await.contains("/t"));
    let info = ask("getBusInfo").await;
    assert!(
        info.contains("/listener") && info.contains("<string>o</string>"),
        "{info}"
    );
    within("the statistics", async {
        while !ask("getBusStats").await.contains("<i4>7</i4>") {}
    })
    .await;
    assert!(
        ask("paramUpdate")
            .await
            .contains("takes (caller_id, key, value)")
    );
    assert!(ask("nonsense").await.contains("no such method: nonsense"));
}

#[tokio::test]
async fn the_shutdown_call_reaches_the_program() {
    let core = core();
    let talker = node("talker", &core);
    let call = "<methodCall><methodName>shutdown</methodName><params><param><value>/master</value></param>\
                <param><value>new node registered with same name</value></param></params></methodCall>";
    slave_call(&talker, call).await;
    let reason = within("the request", talker.shutdown_requested()).await;
    assert_eq!(reason, "new node registered with same name");
}

#[tokio::test]
async fn a_topic_is_published_once_and_with_a_whole_type() {
    let core = core();
    let talker = node("talker", &core);
    let _publisher = advertise(&talker, "/t", PublisherOptions::default());
    let twice = talker.advertise("t", string(), PublisherOptions::default());
    assert!(matches!(twice, Err(NodeError::AlreadyPublished(topic)) if topic == "/t"));
    let any = TopicType {
        md5sum: "*".to_owned(),
        ..string()
    };
    assert!(matches!(
        talker.advertise("/u", any, Default::default()),
        Err(NodeError::Type { .. })
    ));
    let named = talker.advertise("/a b", string(), Default::default());
    assert!(matches!(named, Err(NodeError::Name(_))));
}

#[tokio::test]
async fn two_hundred_topics_leave_no_file_descriptor_behind() {
    let open = || std::fs::read_dir("/proc/self/fd").unwrap().count();
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    registered(&talker).await;
    registered(&listener).await;
    let alive = || {
        tokio::runtime::Handle::current()
            .metrics()
            .num_alive_tasks()
    };
    eventually("quiet", || alive() <= 9).await;
    let (files, tasks) = (open(), alive());
    let inbox = Inbox::new();
    let topics: Vec<String> = (0..200).map(|n| format!("/t{n}")).collect();
    let publishers: Vec<_> = topics
        .iter()
        .map(|t| advertise(&talker, t, PublisherOptions::default()))
        .collect();
    let subscriptions: Vec<_> = topics
        .iter()
        .map(|t| subscribe(&listener, t, &inbox))
        .collect();
    eventually("all links", || {
        publishers.iter().all(|p| p.subscribers() == 1)
    })
    .await;
    assert!(open() >= files + 400);
    drop((publishers, subscriptions));
    // Up to the few connections of the watchdogs, which come and go.
    eventually("the end of all links", || {
        open() <= files + 4 && alive() <= tasks + 4
    })
    .await;
}
