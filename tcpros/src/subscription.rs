//! Subscribing: one topic, its publishers, and the links to them.

use std::collections::{HashMap, HashSet};
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use log_limit::Throttle;
use tokio::sync::Notify;
use tokio::task::AbortHandle;

use crate::clock;
use crate::events;
use crate::inbox::{Deliver, Message, Peer};
use crate::link::{self, LinkContext};
use crate::node::Inner;
use crate::outbox::lock;

/// What a subscriber asks publishers for. `None` takes anything.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Such as `std_msgs/String`.
    pub type_name: Option<String>,
    /// Checksum of the definition.
    pub md5sum: Option<String>,
}

/// How much a subscription holds for a consumer that is late.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SubscriberOptions {
    /// How many messages may wait; then the oldest are dropped.
    pub queue_messages: usize,
    /// How many bytes may wait; then the oldest messages are dropped. The newest is always kept.
    pub queue_bytes: usize,
}

impl Default for SubscriberOptions {
    /// 1000 messages, 16 MiB.
    fn default() -> Self {
        Self {
            queue_messages: 1000,
            queue_bytes: 16 * 1024 * 1024,
        }
    }
}

/// Receives one topic into an inbox. Dropping it unsubscribes and discards what is still queued.
#[derive(Debug)]
pub struct Subscription {
    feed: Arc<Feed>,
    node: Arc<Inner>,
}

impl Subscription {
    pub(crate) const fn new(feed: Arc<Feed>, node: Arc<Inner>) -> Self {
        Self { feed, node }
    }

    /// The topic's resolved name.
    pub fn topic(&self) -> &str {
        &self.feed.topic
    }

    /// How many publishers are connected.
    pub fn publishers(&self) -> usize {
        self.feed.publishers.load(Ordering::Relaxed)
    }

    /// Messages lost so far because the consumer was late.
    pub fn dropped(&self) -> u64 {
        self.feed.dropped.load(Ordering::Relaxed)
    }

    /// Connections closed because a publisher announced a message past the limit.
    pub fn refused_frames(&self) -> u64 {
        self.feed.refused_frames.load(Ordering::Relaxed)
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.feed.close();
        self.node.withdraw_subscription(&self.feed);
    }
}

/// A subscribed topic, shared by the subscription and its links.
pub(crate) struct Feed {
    pub(crate) topic: String,
    pub(crate) wanted: Wanted,
    pub(crate) refused_frames: AtomicU64,
    entrance: Box<dyn Deliver>,
    links: Mutex<Links>,
    publishers: AtomicUsize,
    dropped: AtomicU64,
    crowded: Mutex<Throttle>,
}

#[derive(Debug, Default)]
struct Links {
    by_uri: HashMap<String, Link>,
    closed: bool,
}

#[derive(Debug)]
struct Link {
    /// Whether the master names this publisher. One that it no longer names is followed while it is connected:
    /// after a restart the master does not know the nodes that never register again, and they go on publishing.
    named: bool,
    state: Arc<LinkState>,
    task: AbortHandle,
}

/// What one link has done.
#[derive(Debug)]
pub(crate) struct LinkState {
    pub(crate) id: i32,
    pub(crate) bytes: AtomicU64,
    pub(crate) messages: AtomicU64,
    pub(crate) connected: AtomicBool,
    /// What `rosnode info` shows of the connection.
    pub(crate) transport: Mutex<String>,
    /// Rings when the publisher is named again, which ends the wait for the next try.
    pub(crate) named_again: Notify,
}

impl LinkState {
    fn new(id: i32) -> Self {
        Self {
            id,
            bytes: AtomicU64::new(0),
            messages: AtomicU64::new(0),
            connected: AtomicBool::new(false),
            transport: Mutex::default(),
            named_again: Notify::new(),
        }
    }
}

impl Feed {
    pub(crate) fn new(topic: String, wanted: Wanted, entrance: Box<dyn Deliver>) -> Self {
        Self {
            topic,
            wanted,
            refused_frames: AtomicU64::new(0),
            entrance,
            links: Mutex::default(),
            publishers: AtomicUsize::new(0),
            dropped: AtomicU64::new(0),
            crowded: Mutex::new(Throttle::new(LOG_PERIOD)),
        }
    }

    /// Takes the master's list of publishers: links to new ones start, those to others end unless connected. One that
    /// is named again may just have come back under its old address, so its link does not wait any longer. There are
    /// so many links at most; of more publishers those that come first in the list are followed.
    pub(crate) fn update(
        self: &Arc<Self>,
        uris: &[String],
        context: &Arc<LinkContext>,
        next_id: impl Fn() -> i32,
    ) {
        let named: HashSet<&str> = uris.iter().map(String::as_str).collect();
        let mut links = lock(&self.links);
        if links.closed {
            return;
        }
        links.by_uri.retain(|uri, link| {
            link.named = named.contains(uri.as_str());
            let keep = link.named || link.state.connected.load(Ordering::Acquire);
            if !keep {
                link.task.abort();
            } else if link.named {
                link.state.named_again.notify_one();
            }
            keep
        });
        let limit = context.publishers_of_topic;
        let mut left_out = false;
        for uri in uris {
            if links.by_uri.contains_key(uri) {
                continue;
            }
            if links.by_uri.len() >= limit || uri.len() > MAX_URI {
                left_out = true;
                continue;
            }
            let state = Arc::new(LinkState::new(next_id()));
            let task = tokio::spawn(link::run(
                Arc::clone(self),
                Arc::clone(context),
                uri.clone(),
                Arc::clone(&state),
            ));
            let link = Link {
                named: true,
                state,
                task: task.abort_handle(),
            };
            links.by_uri.insert(uri.clone(), link);
        }
        drop(links);
        if left_out && let Some(more) = lock(&self.crowded).admit(clock::now()) {
            events::too_many_publishers(&self.topic, named.len(), limit, more);
        }
    }

    /// Asked by a link that has lost its connection. One that is not wanted is forgotten.
    pub(crate) fn still_wanted(&self, uri: &str, state: &Arc<LinkState>) -> bool {
        let mut links = lock(&self.links);
        // A later link to the same publisher is not this one's to judge or forget.
        let own = links
            .by_uri
            .get(uri)
            .filter(|link| Arc::ptr_eq(&link.state, state));
        let Some(named) = own.map(|link| link.named) else {
            return false;
        };
        if !named {
            links.by_uri.remove(uri);
        }
        named
    }

    /// Counts and reports a connection until the guard goes.
    pub(crate) fn connected<'a>(&'a self, peer: Arc<Peer>, state: &'a LinkState) -> Connected<'a> {
        state.connected.store(true, Ordering::Release);
        let publishers = self.publishers.fetch_add(1, Ordering::AcqRel) + 1;
        self.entrance.peer(true, publishers, Arc::clone(&peer));
        Connected {
            feed: self,
            peer,
            state,
        }
    }

    pub(crate) fn deliver(&self, message: Message) {
        let dropped = self.entrance.message(message);
        if dropped > 0 {
            self.dropped.fetch_add(dropped, Ordering::Relaxed);
        }
    }

    /// Ends all links; nothing reaches the inbox any more.
    pub(crate) fn close(&self) {
        let mut links = lock(&self.links);
        links.closed = true;
        for (_, link) in links.by_uri.drain() {
            link.task.abort();
        }
        drop(links);
        self.entrance.close();
    }

    pub(crate) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// The connected links with the URIs of their publishers.
    pub(crate) fn connections(&self) -> Vec<(String, Arc<LinkState>)> {
        let links = lock(&self.links);
        let connected = links
            .by_uri
            .iter()
            .filter(|(_, l)| l.state.connected.load(Ordering::Relaxed));
        connected
            .map(|(uri, link)| (uri.clone(), Arc::clone(&link.state)))
            .collect()
    }
}

impl fmt::Debug for Feed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Feed")
            .field("topic", &self.topic)
            .field("links", &self.links)
            .finish_non_exhaustive()
    }
}

/// One connection to a publisher.
pub(crate) struct Connected<'a> {
    feed: &'a Feed,
    peer: Arc<Peer>,
    state: &'a LinkState,
}

impl Drop for Connected<'_> {
    fn drop(&mut self) {
        self.state.connected.store(false, Ordering::Release);
        let publishers = self.feed.publishers.fetch_sub(1, Ordering::AcqRel) - 1;
        self.feed
            .entrance
            .peer(false, publishers, Arc::clone(&self.peer));
    }
}

const LOG_PERIOD: Duration = Duration::from_secs(60);
/// Bytes of a publisher's URI: a host name has 253 at most.
const MAX_URI: usize = 1024;
