//! Nodes and hand-made peers.

use std::future::Future;
use std::net::SocketAddr;
use std::time::Duration;

use tcpros::{
    ConnectionHeader, Core, Inbox, InboxEvent, InboxMessage, MasterState, Node, NodeOptions,
    Publisher, PublisherOptions, RequestedType, SubscriberOptions, Subscription, TopicType,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::timeout;

pub(crate) const MD5: &str = "992ce8a1687cec8c8bd883ec73ca41d1";
const DEADLINE: Duration = Duration::from_secs(20);

pub(crate) fn core() -> Core {
    Core::start(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap()
}

pub(crate) fn options(name: &str, master: &str) -> NodeOptions {
    let mut options = NodeOptions::from_env(name);
    master.clone_into(&mut options.master_uri);
    "/".clone_into(&mut options.namespace);
    options.advertise_as("127.0.0.1");
    options
}

pub(crate) fn node(name: &str, core: &Core) -> Node {
    Node::start(options(name, core.uri())).unwrap()
}

pub(crate) fn string() -> TopicType {
    TopicType {
        name: "std_msgs/String".to_owned(),
        md5sum: MD5.to_owned(),
        definition: "string data\n".to_owned(),
    }
}

pub(crate) fn advertise(node: &Node, topic: &str, options: PublisherOptions) -> Publisher {
    node.advertise(topic, string(), options).unwrap()
}

pub(crate) fn subscribe(node: &Node, topic: &str, inbox: &Inbox<String>) -> Subscription {
    let options = SubscriberOptions::default();
    node.subscribe(
        topic,
        RequestedType::default(),
        options,
        topic.to_owned(),
        inbox,
    )
    .unwrap()
}

pub(crate) async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    match timeout(DEADLINE, future).await {
        Ok(value) => value,
        Err(_) => panic!("waited {DEADLINE:?} for {what}"),
    }
}

pub(crate) async fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    within(what, async {
        while !condition() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

pub(crate) async fn message(inbox: &mut Inbox<String>) -> InboxMessage {
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

pub(crate) async fn registered(node: &Node) {
    let mut state = node.master_state();
    within(
        "the registration",
        state.wait_for(|s| *s == MasterState::Registered),
    )
    .await
    .unwrap();
}

/// Returns the port of a node's topics, requested as by any peer.
pub(crate) async fn topic_port(node: &Node, topic: &str) -> u16 {
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

pub(crate) async fn slave_call(node: &Node, body: &str) -> String {
    raw_call(node.uri(), body).await
}

/// Calls a method with text parameters only.
pub(crate) async fn call(uri: &str, method: &str, params: &[&str]) -> String {
    let params: String = params
        .iter()
        .map(|text| format!("<param><value>{text}</value></param>"))
        .collect();
    let body = format!(
        "<methodCall><methodName>{method}</methodName><params>{params}</params></methodCall>"
    );
    raw_call(uri, &body).await
}

async fn raw_call(uri: &str, body: &str) -> String {
    let address = uri.trim_start_matches("http://").trim_end_matches('/');
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

/// Connects as a hand-made subscriber and reads the publisher's header.
pub(crate) async fn raw_subscriber(
    port: u16,
    topic: &str,
    md5sum: &str,
) -> (TcpStream, ConnectionHeader) {
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

/// Returns the slave API of a hand-made publisher.
pub(crate) async fn raw_publisher() -> (TcpListener, String) {
    let api = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("http://{}/", api.local_addr().unwrap());
    (api, uri)
}

/// Notifies a node, as a master does, that `/t` has one publisher.
pub(crate) async fn name_publisher(node: &Node, uri: &str) {
    let update = format!(
        "<methodCall><methodName>publisherUpdate</methodName><params><param><value>/master</value></param>\
         <param><value>/t</value></param><param><value><array><data><value>{uri}</value></data></array></value></param>\
         </params></methodCall>"
    );
    assert!(slave_call(node, &update).await.contains("<i4>1</i4>"));
}

pub(crate) async fn answer_request_topic(api: &TcpListener, port: u16) {
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

pub(crate) async fn accept_subscriber(listener: &TcpListener, name: &str) -> TcpStream {
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
