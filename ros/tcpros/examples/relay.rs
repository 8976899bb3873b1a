//! Repeats topics of any type under other names: `relay IN OUT [IN OUT]..`.
//!
//! The types are not known beforehand: they come from the connection headers of the first
//! publishers.

use std::collections::HashMap;
use std::error::Error;
use std::pin::pin;
use std::sync::Arc;

use tcpros::{
    ConnectionPeer, Inbox, InboxEvent, Node, NodeError, NodeOptions, Publisher, PublisherOptions,
    RequestedType, SubscriberOptions, TopicType,
};
use tokio::signal::unix::{SignalKind, signal};

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .init();
    // A task, because waking the future of `main` costs a system call for each message.
    tokio::spawn(relay()).await?
}

async fn relay() -> Result<(), Box<dyn Error + Send + Sync>> {
    let mut options = NodeOptions::from_env("relay");
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let topics = options.apply_arguments(&arguments)?;
    let (pairs @ [_, ..], []) = topics.as_chunks::<2>() else {
        return Err("relay IN OUT [IN OUT]..".into());
    };
    let node = Node::start(options)?;
    let mut inbox = Inbox::new();
    let mut subscriptions = Vec::new();
    for [input, output] in pairs {
        let (wanted, queue) = (RequestedType::default(), SubscriberOptions::default());
        let output: Arc<str> = output.as_str().into();
        subscriptions.push(node.subscribe(input, wanted, queue, output, &inbox)?);
    }
    let mut publishers: HashMap<Arc<str>, Publisher> = HashMap::new();
    let mut stop = pin!(stop(&node)?);
    loop {
        let (output, event) = tokio::select! {
            event = inbox.recv() => event,
            () = &mut stop => break,
        };
        match event {
            InboxEvent::Peer {
                connected: true,
                peer,
                ..
            } if !publishers.contains_key(&output) => {
                match advertise(&node, &output, &peer) {
                    Ok(publisher) => {
                        publishers.insert(output, publisher);
                    }
                    // The next publisher may send a complete type.
                    Err(error) => {
                        tracing::warn!(publisher = peer.caller_id, %error, "a publisher is passed over");
                    }
                }
            }
            InboxEvent::Message(message) => {
                if let Some(publisher) = publishers.get(&output) {
                    // The publisher counts the losses of slow subscribers.
                    let _published = publisher.publish(message.bytes);
                }
            }
            InboxEvent::Peer { .. } | InboxEvent::Dropped(_) => {}
        }
    }
    drop(publishers);
    node.shutdown().await;
    Ok(())
}

/// Completes when a signal or the master requests the end.
fn stop(node: &Node) -> std::io::Result<impl Future<Output = ()> + use<>> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let asked = node.shutdown_requested();
    Ok(async move {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
            _ = asked => {}
        }
    })
}

fn advertise(node: &Node, topic: &str, peer: &ConnectionPeer) -> Result<Publisher, NodeError> {
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
