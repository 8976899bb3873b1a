//! Repeats a topic of any type under another name: `relay IN OUT`.
//!
//! The type is not known beforehand: it comes from the connection header of the first publisher.

use tcpros::{
    Inbox, InboxEvent, Node, NodeOptions, Peer, Publisher, PublisherOptions, SubscriberOptions,
    TopicType, Wanted,
};
use tokio::signal::unix::{SignalKind, signal};

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .init();
    let mut options = NodeOptions::from_env("relay");
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let topics = options.apply_arguments(&arguments)?;
    let [input, output] = topics.as_slice() else {
        return Err("relay IN OUT".into());
    };
    let node = Node::start(options)?;
    let mut inbox = Inbox::new();
    let _subscription = node.subscribe(
        input,
        Wanted::default(),
        SubscriberOptions::default(),
        (),
        &inbox,
    )?;
    let mut publisher: Option<Publisher> = None;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    loop {
        let event = tokio::select! {
            ((), event) = inbox.recv() => event,
            _ = terminate.recv() => break,
            _ = interrupt.recv() => break,
            _ = node.shutdown_requested() => break,
        };
        match event {
            InboxEvent::Peer {
                connected: true,
                peer,
                ..
            } if publisher.is_none() => {
                publisher = Some(repeat(&node, output, &peer)?);
            }
            InboxEvent::Message(message) => {
                if let Some(publisher) = &publisher {
                    // Losses of slow subscribers are counted by the publisher.
                    let _published = publisher.publish(message.bytes);
                }
            }
            InboxEvent::Peer { .. } | InboxEvent::Dropped(_) => {}
        }
    }
    drop(publisher);
    node.shutdown().await;
    Ok(())
}

fn repeat(node: &Node, topic: &str, peer: &Peer) -> Result<Publisher, tcpros::NodeError> {
    let field = |text: Option<&str>| text.unwrap_or_default().to_owned();
    let topic_type = TopicType {
        name: field(peer.header.type_name()),
        md5sum: field(peer.header.md5sum()),
        definition: field(peer.header.message_definition()),
    };
    let options = PublisherOptions {
        latch: peer.header.latching(),
        ..PublisherOptions::default()
    };
    node.advertise(topic, topic_type, options)
}
