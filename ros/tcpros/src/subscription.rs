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
use crate::inbox::{ConnectionPeer, Deliver, InboxMessage};
use crate::link::{self, LinkContext};
use crate::node::Inner;
use crate::outbox::lock;

/// The type that a subscriber requests from publishers. `None` accepts any type.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RequestedType {
    /// Name, such as `std_msgs/String`.
    pub type_name: Option<String>,
    /// Checksum of the definition.
    pub md5sum: Option<String>,
}

/// Queue limits of a subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SubscriberOptions {
    /// Maximum number of waiting messages; beyond it the oldest are dropped.
    pub queue_messages: usize,
    /// Maximum number of waiting bytes; beyond it the oldest messages are dropped. The newest
    /// message is always kept.
    pub queue_bytes: usize,
    /// Whether a connection that is cut off is kept, so that messages sent meanwhile arrive when
    /// its link is back. For messages that do no harm when they are late.
    pub keep_cut_off: bool,
}

impl Default for SubscriberOptions {
    /// Returns limits of 1000 messages and 16 MiB.
    fn default() -> Self {
        Self {
            queue_messages: 1000,
            queue_bytes: 16 * 1024 * 1024,
            keep_cut_off: false,
        }
    }
}

/// Receives a topic into an inbox. Dropping it unsubscribes and discards the queued messages.
#[derive(Debug)]
pub struct Subscription {
    feed: Arc<TopicFeed>,
    node: Arc<Inner>,
}

impl Subscription {
    pub(crate) const fn new(feed: Arc<TopicFeed>, node: Arc<Inner>) -> Self {
        Self { feed, node }
    }

    /// Returns the resolved name of the topic.
    pub fn topic(&self) -> &str {
        &self.feed.topic
    }

    /// Returns the number of connected publishers.
    pub fn publishers(&self) -> usize {
        self.feed.publishers.load(Ordering::Relaxed)
    }

    /// Returns the number of messages lost because the consumer was late.
    pub fn dropped(&self) -> u64 {
        self.feed.dropped.load(Ordering::Relaxed)
    }

    /// Returns the number of connections closed because a publisher announced a message past the
    /// limit.
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
pub(crate) struct TopicFeed {
    pub(crate) topic: String,
    pub(crate) wanted: RequestedType,
    /// Whether a connection that is cut off is kept.
    pub(crate) keep_cut_off: bool,
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
    /// Whether the master lists this publisher. A publisher that is no longer listed is followed
    /// while it is connected. After a restart the master does not know the nodes that never
    /// register again, although they continue to publish.
    named: bool,
    state: Arc<TopicLink>,
    task: AbortHandle,
}

/// State and counters of a link.
#[derive(Debug)]
pub(crate) struct TopicLink {
    pub(crate) id: i32,
    pub(crate) bytes: AtomicU64,
    pub(crate) messages: AtomicU64,
    pub(crate) connected: AtomicBool,
    /// Description of the connection for `rosnode info`.
    pub(crate) transport: Mutex<String>,
    /// Notifies that the publisher is listed again, which ends the wait for the next attempt.
    pub(crate) named_again: Notify,
}

impl TopicLink {
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

impl TopicFeed {
    pub(crate) fn new(topic: String, wanted: RequestedType, entrance: Box<dyn Deliver>) -> Self {
        Self {
            topic,
            wanted,
            keep_cut_off: false,
            refused_frames: AtomicU64::new(0),
            entrance,
            links: Mutex::default(),
            publishers: AtomicUsize::new(0),
            dropped: AtomicU64::new(0),
            crowded: Mutex::new(Throttle::new(LOG_PERIOD)),
        }
    }

    /// Keeps connections that are cut off.
    #[must_use]
    pub(crate) fn keeping_cut_off(mut self, keep: bool) -> Self {
        self.keep_cut_off = keep;
        self
    }

    /// Applies the master's list of publishers: starts links to new publishers, and ends links to
    /// unlisted publishers unless they are connected. A publisher that is listed again may have
    /// restarted under its old address, so its link retries at once. The number of links is
    /// limited; beyond the limit only the first publishers of the list are followed.
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
            let state = Arc::new(TopicLink::new(next_id()));
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

    /// Returns whether a link that has lost its connection should reconnect. A link that is not
    /// wanted is removed.
    pub(crate) fn still_wanted(&self, uri: &str, state: &Arc<TopicLink>) -> bool {
        let mut links = lock(&self.links);
        // A later link to the same publisher is not affected by this call.
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

    /// Counts and reports a connection until the guard is dropped.
    pub(crate) fn connected<'a>(
        &'a self,
        peer: Arc<ConnectionPeer>,
        state: &'a TopicLink,
    ) -> PublisherConnection<'a> {
        state.connected.store(true, Ordering::Release);
        let publishers = self.publishers.fetch_add(1, Ordering::AcqRel) + 1;
        self.entrance.peer(true, publishers, Arc::clone(&peer));
        PublisherConnection {
            feed: self,
            peer,
            state,
            is_replaced: false,
        }
    }

    pub(crate) fn deliver(&self, message: InboxMessage) {
        let dropped = self.entrance.message(message);
        if dropped > 0 {
            self.dropped.fetch_add(dropped, Ordering::Relaxed);
        }
    }

    /// Ends all links; afterwards no event reaches the inbox.
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

    /// Returns the connected links with the URIs of their publishers.
    pub(crate) fn connections(&self) -> Vec<(String, Arc<TopicLink>)> {
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

impl fmt::Debug for TopicFeed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Feed")
            .field("topic", &self.topic)
            .field("links", &self.links)
            .finish_non_exhaustive()
    }
}

/// A connection to a publisher.
pub(crate) struct PublisherConnection<'a> {
    feed: &'a TopicFeed,
    peer: Arc<ConnectionPeer>,
    state: &'a TopicLink,
    /// Whether another connection of the link follows at once.
    is_replaced: bool,
}

impl PublisherConnection<'_> {
    /// Ends a connection in favour of another one of its link.
    pub(crate) fn replaced(mut self) {
        self.is_replaced = true;
    }
}

impl Drop for PublisherConnection<'_> {
    fn drop(&mut self) {
        if !self.is_replaced {
            self.state.connected.store(false, Ordering::Release);
        }
        let publishers = self.feed.publishers.fetch_sub(1, Ordering::AcqRel) - 1;
        self.feed
            .entrance
            .peer(false, publishers, Arc::clone(&self.peer));
    }
}

const LOG_PERIOD: Duration = Duration::from_secs(60);
/// Maximum length of a publisher's URI, in bytes: a host name has 253 at most.
const MAX_URI: usize = 1024;
