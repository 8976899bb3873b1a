//! Publishing: one topic, its subscribers, and the message a late one gets.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use tokio::sync::watch;

use crate::events;
use crate::header::{ConnectionHeader, clipped};
use crate::node::Inner;
use crate::outbox::{Limit, Outbox, lock};

/// The type of a topic, as publishers and subscribers compare it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicType {
    /// Such as `std_msgs/String`.
    pub name: String,
    /// Checksum of the definition, 32 hexadecimal digits.
    pub md5sum: String,
    /// Text of the definition with those it contains appended, as `rosbag` needs it.
    pub definition: String,
}

/// How a publisher treats its subscribers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublisherOptions {
    /// Whether late subscribers get the last message.
    pub latch: bool,
    /// How many messages may wait for one subscriber; then its oldest are dropped.
    pub queue_messages: usize,
    /// How many bytes may wait for one subscriber; then its oldest are dropped. The newest message is always kept.
    /// Subscribers that are slow at the same time wait for the same messages, which are held once: beyond this, each
    /// costs what is being written to it, 64 KiB or one longer message.
    pub queue_bytes: usize,
}

impl Default for PublisherOptions {
    /// Not latched, 1000 messages, 16 MiB.
    fn default() -> Self {
        Self {
            latch: false,
            queue_messages: 1000,
            queue_bytes: 16 * 1024 * 1024,
        }
    }
}

/// What became of one message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub struct Published {
    /// Subscribers it was queued for.
    pub sent_to: usize,
    /// Older messages that gave way to it, over all subscribers.
    pub dropped_oldest: u64,
}

/// Which of the messages for late subscribers a message is. They get them in the order of their keys.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Latched {
    /// It takes the place of all others.
    Alone(u64),
    /// It is one of several, and takes the place of the one with its key. Of more than [`MAX_LATCHED`] the first
    /// other one gives way.
    Beside(u64),
}

impl Latched {
    const fn key(self) -> u64 {
        match self {
            Self::Alone(key) | Self::Beside(key) => key,
        }
    }
}

/// Publishes on one topic. Dropping it withdraws the topic; what is queued is still sent, within a second.
#[derive(Debug)]
pub struct Publisher {
    hub: Arc<Hub>,
    node: Arc<Inner>,
}

impl Publisher {
    pub(crate) const fn new(hub: Arc<Hub>, node: Arc<Inner>) -> Self {
        Self { hub, node }
    }

    /// Queues a serialized message, without its length, for every subscriber. Never waits: a slow subscriber loses
    /// its oldest messages and nobody else's. A message past 4 GiB has no length on the wire: it goes to nobody, with
    /// a line in the log.
    pub fn publish(&self, message: Bytes) -> Published {
        self.hub.publish(message, Latched::Alone(0))
    }

    /// As [`publish`](Self::publish), where late subscribers may get the last message of several sources: `latched` says
    /// which of them stay. Without `latch` none does.
    pub fn publish_latched(&self, message: Bytes, latched: Latched) -> Published {
        self.hub.publish(message, latched)
    }

    /// Keeps a message for late subscribers under `key` beside others. It goes to those that came after it was published
    /// and did not find it, and to nobody else.
    pub fn latch(&self, key: u64, message: Bytes) {
        if u32::try_from(message.len()).is_ok() {
            self.hub.latch(message, Latched::Beside(key));
        }
    }

    /// Late subscribers no longer get what is latched under `key`.
    pub fn forget_latched(&self, key: u64) {
        lock(&self.hub.state)
            .latched
            .retain(|(other, _)| *other != key);
    }

    /// Late subscribers no longer get anything of what was published so far.
    pub fn forget_all_latched(&self) {
        lock(&self.hub.state).latched.clear();
    }

    /// Changes whether late subscribers get the last message. A publisher that stops to latch forgets what it latched.
    pub fn set_latching(&self, latch: bool) {
        let was = self.hub.latching.swap(latch, Ordering::Relaxed);
        if was && !latch {
            self.forget_all_latched();
        }
    }

    /// How many subscribers are connected.
    pub fn subscribers(&self) -> usize {
        lock(&self.hub.state).subscribers.len()
    }

    /// Whether the node of this resolved name is connected.
    pub fn is_subscribed_by(&self, node: &str) -> bool {
        let state = lock(&self.hub.state);
        state.subscribers.iter().any(|s| s.caller_id == node)
    }

    /// Whether the node of this resolved name asked for the topic without TCPROS among its protocols.
    pub fn asks_for_udp(&self, node: &str) -> bool {
        let state = lock(&self.hub.state);
        state.without_tcpros.iter().any(|one| one == node)
    }

    /// The topic's resolved name.
    pub fn topic(&self) -> &str {
        &self.hub.topic
    }

    /// The type that a subscriber was turned away with last, such as `std_msgs/Float32`.
    pub fn refused_type(&self) -> Option<String> {
        lock(&self.hub.state).refused_type.clone()
    }

    /// Messages lost so far: by slow subscribers, by late ones whose queue does not hold all that is latched, and latched
    /// ones that gave way past [`MAX_LATCHED`].
    pub fn dropped(&self) -> u64 {
        self.hub.dropped.load(Ordering::Relaxed)
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        self.hub.close();
        self.node.withdraw_publication(&self.hub);
    }
}

/// A published topic, shared by the publisher and the tasks that serve its subscribers.
#[derive(Debug)]
pub(crate) struct Hub {
    pub(crate) topic: String,
    pub(crate) topic_type: TopicType,
    /// Tells this registration from an earlier one of the same topic.
    pub(crate) generation: u64,
    options: PublisherOptions,
    /// Whether late subscribers get the last message by now.
    latching: AtomicBool,
    state: Mutex<HubState>,
    dropped: AtomicU64,
    /// The node's count of connections to subscribers.
    draining: watch::Sender<usize>,
}

#[derive(Debug, Default)]
struct HubState {
    subscribers: Vec<Arc<Subscriber>>,
    /// Ordered by key.
    latched: Vec<(u64, Bytes)>,
    /// Messages published so far.
    count: u64,
    /// The keys of the last of them, each with the count before it; at most [`MAX_LATCHED`].
    recent: VecDeque<(u64, u64)>,
    refused_type: Option<String>,
    /// The nodes that asked for other protocols than TCPROS only, at most [`MAX_WITHOUT_TCPROS`].
    without_tcpros: VecDeque<String>,
    closed: bool,
}

/// One connected subscriber.
#[derive(Debug)]
pub(crate) struct Subscriber {
    pub(crate) id: i32,
    pub(crate) caller_id: String,
    /// What `rosnode info` shows of the connection.
    pub(crate) transport: String,
    /// The topic's count of messages when it came.
    joined: u64,
    /// The keys of the latched messages it found.
    found: Vec<u64>,
    pub(crate) outbox: Outbox,
    pub(crate) bytes: AtomicU64,
    pub(crate) messages: AtomicU64,
}

impl Hub {
    pub(crate) fn new(
        topic: String,
        topic_type: TopicType,
        options: PublisherOptions,
        generation: u64,
        draining: watch::Sender<usize>,
    ) -> Self {
        Self {
            topic,
            topic_type,
            generation,
            options,
            latching: AtomicBool::new(options.latch),
            state: Mutex::default(),
            dropped: AtomicU64::new(0),
            draining,
        }
    }

    fn publish(&self, message: Bytes, latched: Latched) -> Published {
        if u32::try_from(message.len()).is_err() {
            events::message_too_long(&self.topic, message.len());
            return Published {
                sent_to: 0,
                dropped_oldest: 0,
            };
        }
        let mut state = lock(&self.state);
        let mut published = Published {
            sent_to: 0,
            dropped_oldest: 0,
        };
        for subscriber in &state.subscribers {
            published.dropped_oldest += subscriber.outbox.push(message.clone());
            published.sent_to += 1;
        }
        let mut dropped = published.dropped_oldest;
        state.note(latched.key());
        if self.is_latching() {
            dropped += state.latch(message, latched);
        }
        drop(state);
        self.dropped.fetch_add(dropped, Ordering::Relaxed);
        published
    }

    fn is_latching(&self) -> bool {
        self.latching.load(Ordering::Relaxed)
    }

    fn latch(&self, message: Bytes, latched: Latched) {
        if self.is_latching() {
            let mut state = lock(&self.state);
            let mut dropped = state.make_up(latched.key(), &message);
            dropped += state.latch(message, latched);
            drop(state);
            self.dropped.fetch_add(dropped, Ordering::Relaxed);
        }
    }

    /// Adds a subscriber, its queue beginning with the latched messages; `None` once the topic is withdrawn.
    pub(crate) fn join(
        self: &Arc<Self>,
        id: i32,
        caller_id: &str,
        transport: String,
    ) -> Option<Joined> {
        let limit = Limit {
            messages: self.options.queue_messages,
            bytes: self.options.queue_bytes,
        };
        let mut state = lock(&self.state);
        if state.closed {
            return None;
        }
        let subscriber = Arc::new(Subscriber {
            id,
            caller_id: caller_id.to_owned(),
            transport,
            joined: state.count,
            found: state.latched.iter().map(|(key, _)| *key).collect(),
            outbox: Outbox::new(limit),
            bytes: AtomicU64::new(0),
            messages: AtomicU64::new(0),
        });
        let mut dropped = 0;
        for (_, latched) in &state.latched {
            dropped += subscriber.outbox.push(latched.clone());
        }
        self.dropped.fetch_add(dropped, Ordering::Relaxed);
        state.subscribers.push(Arc::clone(&subscriber));
        drop(state);
        self.draining.send_modify(|open| *open += 1);
        Some(Joined {
            hub: Arc::clone(self),
            subscriber,
        })
    }

    /// Ends the connections once their queues are written.
    pub(crate) fn close(&self) {
        let mut state = lock(&self.state);
        state.closed = true;
        state.latched.clear();
        for subscriber in &state.subscribers {
            subscriber.outbox.close();
        }
    }

    pub(crate) fn connected(&self) -> Vec<Arc<Subscriber>> {
        lock(&self.state).subscribers.clone()
    }

    /// Notes that a node asked for the topic over other protocols than TCPROS only.
    pub(crate) fn refuse_protocols(&self, caller: &str) {
        let mut state = lock(&self.state);
        if state.without_tcpros.iter().any(|one| one == caller) {
            return;
        }
        if state.without_tcpros.len() >= MAX_WITHOUT_TCPROS {
            state.without_tcpros.pop_front();
        }
        state.without_tcpros.push_back(caller.to_owned());
    }

    /// What a subscriber is told of this topic, or why it does not fit.
    pub(crate) fn reply_to(
        &self,
        request: &ConnectionHeader,
        own_name: &str,
    ) -> Result<ConnectionHeader, String> {
        let ours = &self.topic_type;
        let fits = |wanted: Option<&str>, ours: &str| wanted.is_none_or(|w| w == "*" || w == ours);
        let Some(md5sum) = request.md5sum() else {
            return Err(
                "Header from subscriber did not have the required elements: md5sum, topic"
                    .to_owned(),
            );
        };
        // As roscpp and rospy do it: the checksum decides. Names alone differ where packages were renamed.
        if !fits(Some(md5sum), &ours.md5sum) {
            let wanted = clipped(request.type_name().unwrap_or("*"));
            lock(&self.state).refused_type = request.type_name().map(|_| wanted.to_owned());
            return Err(format!(
                "Client [{}] wants topic {} to have datatype/md5sum [{wanted}/{}], but our version has [{}/{}]. Dropping connection.",
                clipped(request.caller_id()),
                self.topic,
                clipped(md5sum),
                ours.name,
                ours.md5sum,
            ));
        }
        let reply = ConnectionHeader::default()
            .with("callerid", own_name)
            .with("md5sum", &*ours.md5sum)
            .with("type", &*ours.name)
            .with("message_definition", &*ours.definition)
            .with("topic", &*self.topic)
            .with("latching", if self.is_latching() { "1" } else { "0" });
        Ok(reply)
    }
}

impl HubState {
    /// Takes note of a message that goes to all who are there.
    fn note(&mut self, key: u64) {
        // One source after another is the rule: its messages take one place.
        if self.recent.back().is_some_and(|(last, _)| *last == key) {
            self.recent.pop_back();
        } else if self.recent.len() >= MAX_LATCHED {
            self.recent.pop_front();
        }
        self.recent.push_back((key, self.count));
        self.count += 1;
    }

    /// Gives a message that is latched anew to those who came between its publication and now, and returns how many
    /// other messages gave way to it.
    fn make_up(&self, key: u64, message: &Bytes) -> u64 {
        let latched = self.latched.binary_search_by_key(&key, |(key, _)| *key);
        let published = self.recent.iter().rev().find(|(other, _)| *other == key);
        let (Err(_), Some((_, before))) = (latched, published) else {
            return 0;
        };
        let late = |s: &&Arc<Subscriber>| s.joined > *before && !s.found.contains(&key);
        let late = self.subscribers.iter().filter(late);
        late.map(|s| s.outbox.push(message.clone())).sum()
    }

    /// Keeps a message for late subscribers, and returns how many others gave way for want of room.
    fn latch(&mut self, message: Bytes, latched: Latched) -> u64 {
        if self.closed {
            return 0;
        }
        let key = match latched {
            Latched::Alone(key) => {
                self.latched.clear();
                key
            }
            Latched::Beside(key) => key,
        };
        match self.latched.binary_search_by_key(&key, |(key, _)| *key) {
            Ok(at) => {
                if let Some((_, before)) = self.latched.get_mut(at) {
                    *before = message;
                }
                0
            }
            Err(at) => {
                self.latched.insert(at, (key, message));
                if self.latched.len() <= MAX_LATCHED {
                    return 0;
                }
                // Never the one that has just come, which may be the first itself.
                self.latched.remove(usize::from(at == 0));
                1
            }
        }
    }
}

/// A subscriber's place at a topic, given up on drop.
#[derive(Debug)]
pub(crate) struct Joined {
    pub(crate) hub: Arc<Hub>,
    pub(crate) subscriber: Arc<Subscriber>,
}

impl Drop for Joined {
    fn drop(&mut self) {
        self.subscriber.outbox.close();
        lock(&self.hub.state)
            .subscribers
            .retain(|other| !Arc::ptr_eq(other, &self.subscriber));
        self.hub.draining.send_modify(|open| *open -= 1);
    }
}

/// Nodes without TCPROS that are remembered of a topic.
const MAX_WITHOUT_TCPROS: usize = 16;
/// Messages latched side by side.
pub const MAX_LATCHED: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    fn hub(latch: bool) -> Arc<Hub> {
        hub_of(latch, 2)
    }

    fn hub_of(latch: bool, queue_messages: usize) -> Arc<Hub> {
        let topic_type = TopicType {
            name: "std_msgs/String".to_owned(),
            md5sum: "992ce8a1687cec8c8bd883ec73ca41d1".to_owned(),
            definition: "string data\n".to_owned(),
        };
        let options = PublisherOptions {
            latch,
            queue_messages,
            ..PublisherOptions::default()
        };
        Arc::new(Hub::new(
            "/chatter".to_owned(),
            topic_type,
            options,
            1,
            watch::Sender::new(0),
        ))
    }

    fn request(md5sum: &str) -> ConnectionHeader {
        ConnectionHeader::default()
            .with("callerid", "/l")
            .with("md5sum", md5sum)
    }

    #[test]
    fn a_subscriber_of_any_type_is_told_ours_even_without_naming_one() {
        let reply = hub(true).reply_to(&request("*"), "/n").unwrap();
        assert_eq!(reply.type_name(), Some("std_msgs/String"));
        assert_eq!(reply.message_definition(), Some("string data\n"));
        assert_eq!(
            (reply.caller_id(), reply.get("topic"), reply.latching()),
            ("/n", Some("/chatter"), true)
        );
    }

    #[test]
    fn the_type_a_subscriber_was_turned_away_with_is_remembered() {
        let hub = hub(false);
        let error = hub.reply_to(&request("0123").with("type", "std_msgs/Bool"), "/n");
        assert!(error.unwrap_err().contains("[std_msgs/Bool/0123]"));
        assert_eq!(
            lock(&hub.state).refused_type.as_deref(),
            Some("std_msgs/Bool")
        );
    }

    #[test]
    fn a_subscriber_of_another_checksum_is_told_both() {
        let error = hub(false).reply_to(&request("0123"), "/n").unwrap_err();
        assert!(
            error.contains("[*/0123]") && error.contains("[std_msgs/String/992ce"),
            "{error}"
        );
        assert!(
            hub(false)
                .reply_to(&ConnectionHeader::default(), "/n")
                .unwrap_err()
                .contains("required")
        );
    }

    #[tokio::test]
    async fn a_late_subscriber_gets_the_last_message_of_a_latched_topic_only() {
        for latch in [true, false] {
            let hub = hub(latch);
            let none = hub.publish(Bytes::from_static(b"1"), Latched::Alone(0));
            assert_eq!(
                none,
                Published {
                    sent_to: 0,
                    dropped_oldest: 0
                }
            );
            let late = hub.join(1, "/late", String::new()).unwrap();
            hub.close();
            let mut taken = Vec::new();
            assert_eq!(late.subscriber.outbox.take(&mut taken, 64).await, latch);
            assert_eq!(taken.len(), usize::from(latch));
        }
    }

    #[tokio::test]
    async fn a_late_subscriber_gets_what_several_sources_latched_in_the_order_of_their_keys() {
        let hub = hub_of(true, 10);
        let message = |text: &'static str| Bytes::from_static(text.as_bytes());
        let _early = hub.publish(message("0"), Latched::Alone(10));
        let _third = hub.publish(message("3"), Latched::Beside(30));
        hub.latch(message("2"), Latched::Beside(20));
        let _again = hub.publish(message("4"), Latched::Beside(30));
        let late = async |id| {
            let late = hub.join(id, "/late", String::new()).unwrap();
            let mut taken = Vec::new();
            late.subscriber.outbox.take(&mut taken, 64).await;
            taken
        };
        assert_eq!(late(1).await, ["0", "2", "4"]);
        lock(&hub.state).latched.retain(|(key, _)| *key != 20);
        assert_eq!(late(2).await, ["0", "4"]);
        let _alone = hub.publish(message("5"), Latched::Alone(5));
        assert_eq!(late(3).await, ["5"]);
        for key in 0..100 {
            let _one_more = hub.publish(message("6"), Latched::Beside(key));
        }
        assert_eq!(lock(&hub.state).latched.len(), MAX_LATCHED);
    }

    #[test]
    fn past_the_most_that_is_latched_another_than_the_newest_gives_way_and_is_counted() {
        let hub = hub(true);
        for key in 1..=64 {
            let _kept = hub.publish(Bytes::new(), Latched::Beside(key));
        }
        assert_eq!(hub.dropped.load(Ordering::Relaxed), 0);
        hub.latch(Bytes::new(), Latched::Beside(0));
        let keys = || -> Vec<u64> {
            lock(&hub.state)
                .latched
                .iter()
                .map(|(key, _)| *key)
                .collect()
        };
        assert_eq!(keys()[..2], [0, 2]);
        let _last = hub.publish(Bytes::new(), Latched::Beside(99));
        assert_eq!((keys()[0], keys()[63]), (2, 99));
        assert_eq!(hub.dropped.load(Ordering::Relaxed), 2);
    }

    #[test]
    fn what_a_late_subscribers_queue_does_not_hold_is_counted() {
        let hub = hub_of(true, 2);
        for key in 0..5 {
            hub.latch(Bytes::new(), Latched::Beside(key));
        }
        let late = hub.join(1, "/late", String::new()).unwrap();
        assert_eq!(late.subscriber.outbox.dropped(), 3);
        assert_eq!(hub.dropped.load(Ordering::Relaxed), 3);
    }

    #[tokio::test]
    async fn who_came_before_it_was_known_that_there_are_several_gets_the_others_once() {
        let hub = hub(true);
        let text = Bytes::from_static;
        for (key, message) in [(1, "left"), (2, "right"), (3, "base")] {
            let _published = hub.publish(text(message.as_bytes()), Latched::Alone(key));
        }
        let early = hub.join(1, "/early", String::new()).unwrap();
        let mut heard = Vec::new();
        assert!(early.subscriber.outbox.take(&mut heard, 64).await);
        for _ in 0..2 {
            hub.latch(text(b"left"), Latched::Beside(1));
            hub.latch(text(b"base"), Latched::Beside(3));
        }
        hub.close();
        let mut made_up = Vec::new();
        assert!(early.subscriber.outbox.take(&mut made_up, 64).await);
        assert_eq!((heard, made_up), (vec![text(b"base")], vec![text(b"left")]));
    }

    #[test]
    fn a_subscriber_that_does_not_read_costs_only_itself() {
        let hub = hub(false);
        let joined = hub.join(1, "/slow", String::new()).unwrap();
        let published: Vec<_> = (0..3u8)
            .map(|n| {
                hub.publish(Bytes::from(vec![n]), Latched::Alone(0))
                    .dropped_oldest
            })
            .collect();
        assert_eq!(published, [0, 0, 1]);
        assert_eq!(joined.subscriber.outbox.dropped(), 1);
        drop(joined);
        assert_eq!(hub.publish(Bytes::new(), Latched::Alone(0)).sent_to, 0);
    }
}
