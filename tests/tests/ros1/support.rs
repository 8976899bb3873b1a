//! A node of `tcpros` in the process of the test, on threads of the cell's network.

use std::time::Duration;

use bytes::Bytes;
use system_tests::{MASTER, eventually};
use tcpros::{
    Inbox, InboxEvent, InboxMessage, MasterState, Node, NodeOptions, Publisher, PublisherOptions,
    RequestedType, SubscriberOptions, Subscription, TopicType,
};
use tokio::runtime::{Builder, Runtime};

pub(crate) const SOON: Duration = Duration::from_secs(30);

/// A node and the runtime it runs on.
pub(crate) struct Ros1Node {
    pub(crate) runtime: Runtime,
    pub(crate) node: Option<Node>,
}

impl Ros1Node {
    pub(crate) fn start(name: &str) -> Self {
        Self::start_in("/", name)
    }

    /// Starts a node in a namespace. Its threads are in the network of the calling thread.
    pub(crate) fn start_in(namespace: &str, name: &str) -> Self {
        let runtime = Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let mut options = NodeOptions::from_env(name);
        options.master_uri = format!("http://{MASTER}");
        namespace.clone_into(&mut options.namespace);
        options.advertise_as("127.0.0.1");
        let node = {
            let _inside = runtime.enter();
            Node::start(options).unwrap()
        };
        Self {
            runtime,
            node: Some(node),
        }
    }

    pub(crate) fn node(&self) -> &Node {
        self.node.as_ref().unwrap()
    }

    pub(crate) fn is_registered(&self) -> bool {
        *self.node().master_state().borrow() == MasterState::Registered
    }

    pub(crate) fn advertise(&self, topic: &str, kind: TopicType, latch: bool) -> Publisher {
        let options = PublisherOptions {
            latch,
            ..PublisherOptions::default()
        };
        self.node().advertise(topic, kind, options).unwrap()
    }

    pub(crate) fn subscribe(&self, topic: &str) -> SubscribedTopic {
        let _inside = self.runtime.enter();
        let inbox = Inbox::new();
        let options = SubscriberOptions {
            queue_messages: 100_000,
            ..SubscriberOptions::default()
        };
        let subscription = self
            .node()
            .subscribe(topic, RequestedType::default(), options, (), &inbox)
            .unwrap();
        SubscribedTopic {
            inbox,
            subscription,
        }
    }

    /// Shuts the node down and returns the time this took.
    pub(crate) fn end(mut self) -> Duration {
        let started = std::time::Instant::now();
        let node = self.node.take().unwrap();
        self.runtime.block_on(node.shutdown());
        started.elapsed()
    }
}

/// A subscription and its received messages.
pub(crate) struct SubscribedTopic {
    inbox: Inbox<()>,
    pub(crate) subscription: Subscription,
}

impl SubscribedTopic {
    /// Returns the next waiting message.
    pub(crate) fn try_next(&mut self) -> Option<InboxMessage> {
        loop {
            match self.inbox.try_recv()?.1 {
                InboxEvent::Message(message) => return Some(message),
                InboxEvent::Dropped(count) => panic!("{count} messages were dropped"),
                InboxEvent::Peer { .. } => {}
            }
        }
    }

    pub(crate) fn next(&mut self, what: &str) -> InboxMessage {
        eventually(what, SOON, || self.try_next())
    }
}

pub(crate) fn string_type() -> TopicType {
    TopicType {
        name: "std_msgs/String".to_owned(),
        md5sum: "992ce8a1687cec8c8bd883ec73ca41d1".to_owned(),
        definition: "string data\n".to_owned(),
    }
}

pub(crate) fn twist_type() -> TopicType {
    TopicType {
        name: "geometry_msgs/Twist".to_owned(),
        md5sum: "9f195f881246fdfa2798d1d3eebca84a".to_owned(),
        definition: format!(
            "Vector3 linear\nVector3 angular\n{}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n",
            "=".repeat(80)
        ),
    }
}

/// Returns a `std_msgs/String`.
pub(crate) fn string(text: &str) -> Bytes {
    let length = u32::try_from(text.len()).unwrap();
    [&length.to_le_bytes()[..], text.as_bytes()].concat().into()
}

/// Returns a `geometry_msgs/Twist` with this forward speed.
pub(crate) fn twist(forward: f64) -> Bytes {
    let mut bytes = forward.to_le_bytes().to_vec();
    bytes.resize(48, 0);
    bytes.into()
}
