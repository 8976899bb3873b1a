//! A published topic: its subscribers, and what was dropped for them.

use std::collections::VecDeque;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use tokio::sync::watch;

use super::latched::{Latched, LatchedAtJoin, LatchedMessages};
use super::{Published, PublisherOptions, TopicType};
use crate::events;
use crate::header::{ConnectionHeader, clipped};
use crate::outbox::{Limit, SubscriberQueue, lock};
use crate::reach::NetworkReach;
use crate::refusal::ConnectionRefusal;

/// Maximum number of recorded nodes without TCPROS per topic.
const MAX_WITHOUT_TCPROS: usize = 16;

/// A published topic, shared by the publisher and the tasks that serve its subscribers.
#[derive(Debug)]
pub(crate) struct PublishedTopic {
    pub(crate) topic: String,
    pub(crate) topic_type: TopicType,
    /// Distinguishes this registration from earlier registrations of the same topic.
    pub(crate) generation: u64,
    options: PublisherOptions,
    /// Whether late subscribers currently receive the last message.
    latching: AtomicBool,
    state: Mutex<HubState>,
    dropped: AtomicU64,
    /// The number of messages dropped for subscribers out of reach.
    cut_off: AtomicU64,
    /// The node's count of connections to subscribers.
    draining: watch::Sender<usize>,
}

#[derive(Debug, Default)]
struct HubState {
    subscribers: Vec<Arc<Subscriber>>,
    latched: LatchedMessages,
    refused_type: Option<String>,
    /// The nodes that requested only other protocols than TCPROS, at most [`MAX_WITHOUT_TCPROS`].
    without_tcpros: VecDeque<String>,
    closed: bool,
}

/// A connected subscriber.
#[derive(Debug)]
pub(crate) struct Subscriber {
    pub(crate) id: i32,
    pub(crate) caller_id: String,
    /// Description of the connection for `rosnode info`.
    pub(crate) transport: String,
    reach: SubscriberReach,
    /// Whether the connection was cut off. It ends when the link is back.
    was_cut_off: AtomicBool,
    joined: LatchedAtJoin,
    pub(crate) outbox: SubscriberQueue,
    pub(crate) bytes: AtomicU64,
    pub(crate) messages: AtomicU64,
}

impl Subscriber {
    /// Returns whether the subscriber is on another host, and its connection has or had no link.
    fn is_cut_off(&self) -> bool {
        let Some((network, address)) = &self.reach else {
            return false;
        };
        let is_lost = network.has_lost(*address);
        self.was_cut_off.fetch_or(is_lost, Ordering::Relaxed) || is_lost
    }

    /// Waits until the connection was cut off, its link is back, and the subscriber is to connect
    /// again: what was written before the loss was noticed would arrive late, and so would all that
    /// follows it. Never returns for a subscriber on this host.
    pub(crate) async fn is_to_reconnect(&self, peer: SocketAddr) {
        match &self.reach {
            Some((network, address)) => network.back_after_loss(*address, peer).await,
            None => std::future::pending().await,
        }
    }
}

/// The network of a subscriber on another host, and the address of this host that its connection
/// uses.
pub(crate) type SubscriberReach = Option<(NetworkReach, IpAddr)>;

impl PublishedTopic {
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
            cut_off: AtomicU64::new(0),
            draining,
        }
    }

    pub(super) fn publish(&self, message: Bytes, latched: Latched) -> Published {
        if u32::try_from(message.len()).is_err() {
            events::message_too_long(&self.topic, message.len());
            return Published::default();
        }
        let mut state = lock(&self.state);
        let mut published = Published::default();
        for subscriber in &state.subscribers {
            if subscriber.is_cut_off() {
                published.cut_off += 1;
            } else {
                published.dropped_oldest += subscriber.outbox.push(message.clone());
                published.sent_to += 1;
            }
        }
        let mut dropped = published.dropped_oldest;
        state.latched.note(latched.key());
        if self.is_latching() && !state.closed {
            dropped += state.latched.keep(message, latched);
        }
        drop(state);
        self.dropped.fetch_add(dropped, Ordering::Relaxed);
        self.note_cut_off(published.cut_off);
        published
    }

    fn is_latching(&self) -> bool {
        self.latching.load(Ordering::Relaxed)
    }

    /// Keeps a message for late subscribers beside others, and sends it to those that missed it.
    pub(super) fn latch(&self, key: u64, message: Bytes) {
        if self.is_latching() && u32::try_from(message.len()).is_ok() {
            let mut state = lock(&self.state);
            let mut dropped = state.send_again(key, &message);
            if !state.closed {
                dropped += state.latched.keep(message, Latched::Beside(key));
            }
            drop(state);
            self.dropped.fetch_add(dropped, Ordering::Relaxed);
        }
    }

    /// Removes the message latched under a key.
    pub(super) fn forget_latched(&self, key: u64) {
        lock(&self.state).latched.forget(key);
    }

    /// Removes all latched messages.
    pub(super) fn forget_all_latched(&self) {
        lock(&self.state).latched.clear();
    }

    /// Changes whether late subscribers receive the last message.
    pub(super) fn set_latching(&self, latch: bool) {
        let was = self.latching.swap(latch, Ordering::Relaxed);
        if was && !latch {
            self.forget_all_latched();
        }
    }

    /// Drops the messages that wait for subscribers out of reach.
    pub(crate) fn drop_cut_off(&self) {
        let state = lock(&self.state);
        let cut_off = state.subscribers.iter().filter(|s| s.is_cut_off());
        let dropped: u64 = cut_off.map(|subscriber| subscriber.outbox.clear()).sum();
        drop(state);
        self.note_cut_off(dropped);
    }

    fn note_cut_off(&self, count: impl TryInto<u64>) {
        let count = count.try_into().unwrap_or(u64::MAX);
        self.cut_off.fetch_add(count, Ordering::Relaxed);
    }

    /// Returns whether the node of this resolved name is connected and not cut off.
    pub(crate) fn is_subscribed_by(&self, node: &str) -> bool {
        let state = lock(&self.state);
        let mut subscribers = state.subscribers.iter();
        subscribers.any(|s| s.caller_id == node && !s.is_cut_off())
    }

    /// Adds a subscriber; its queue starts with the latched messages. Returns `None` if the topic
    /// is withdrawn.
    pub(crate) fn join(
        self: &Arc<Self>,
        id: i32,
        caller_id: &str,
        (transport, reach): (String, SubscriberReach),
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
            reach: reach.filter(|_| !self.options.keep_cut_off),
            was_cut_off: AtomicBool::new(false),
            joined: state.latched.at_join(),
            outbox: SubscriberQueue::new(limit),
            bytes: AtomicU64::new(0),
            messages: AtomicU64::new(0),
        });
        let mut dropped = 0;
        for latched in state.latched.kept() {
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

    /// Returns the number of lost messages, other than those for subscribers out of reach.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Returns the number of messages dropped for subscribers out of reach.
    pub(super) fn cut_off(&self) -> u64 {
        self.cut_off.load(Ordering::Relaxed)
    }

    /// Returns the type of the last subscriber that was refused for its type.
    pub(super) fn refused_type(&self) -> Option<String> {
        lock(&self.state).refused_type.clone()
    }

    /// Returns the number of connected subscribers.
    pub(super) fn subscribers(&self) -> usize {
        lock(&self.state).subscribers.len()
    }

    /// Returns whether a node requested the topic over other protocols than TCPROS only.
    pub(super) fn is_without_tcpros(&self, node: &str) -> bool {
        let state = lock(&self.state);
        state.without_tcpros.iter().any(|one| one == node)
    }

    /// Records that a node requested the topic over other protocols than TCPROS only.
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

    /// Returns the reply header for a subscriber, or the reason for which the subscriber is
    /// refused.
    pub(crate) fn reply_to(
        &self,
        request: &ConnectionHeader,
        own_name: &str,
    ) -> Result<ConnectionHeader, ConnectionRefusal> {
        let ours = &self.topic_type;
        let fits = |wanted: Option<&str>, ours: &str| wanted.is_none_or(|w| w == "*" || w == ours);
        let Some(md5sum) = request.md5sum() else {
            return Err(ConnectionRefusal::SubscriberHeader);
        };
        // As in roscpp and rospy, only the checksum decides. The names alone differ if packages
        // were renamed.
        if !fits(Some(md5sum), &ours.md5sum) {
            let wanted = clipped(request.type_name().unwrap_or("*"));
            lock(&self.state).refused_type = request.type_name().map(|_| wanted.to_owned());
            return Err(ConnectionRefusal::TopicType {
                topic: self.topic.clone(),
                caller: clipped(request.caller_id()).to_owned(),
                wanted: format!("{wanted}/{}", clipped(md5sum)),
                ours: format!("{}/{}", ours.name, ours.md5sum),
            });
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
    /// Sends a message that is latched again to the subscribers that joined after its publication.
    /// Returns the number of other messages that were dropped for it.
    fn send_again(&self, key: u64, message: &Bytes) -> u64 {
        let Some(again) = self.latched.again(key) else {
            return 0;
        };
        let subscribers = self.subscribers.iter();
        let late = subscribers.filter(|s| again.was_missed_since(&s.joined));
        late.map(|s| s.outbox.push(message.clone())).sum()
    }
}

/// The membership of a subscriber in a topic, which ends on drop.
#[derive(Debug)]
pub(crate) struct Joined {
    pub(crate) hub: Arc<PublishedTopic>,
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

#[cfg(test)]
mod tests {
    use super::*;

    fn hub(latch: bool) -> Arc<PublishedTopic> {
        hub_of(latch, 2)
    }

    fn hub_of(latch: bool, queue_messages: usize) -> Arc<PublishedTopic> {
        hub_with(PublisherOptions {
            latch,
            queue_messages,
            ..PublisherOptions::default()
        })
    }

    fn hub_with(options: PublisherOptions) -> Arc<PublishedTopic> {
        let topic_type = TopicType {
            name: "std_msgs/String".to_owned(),
            md5sum: "992ce8a1687cec8c8bd883ec73ca41d1".to_owned(),
            definition: "string data\n".to_owned(),
        };
        Arc::new(PublishedTopic::new(
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
        let error = error.unwrap_err().to_string();
        assert!(error.contains("[std_msgs/Bool/0123]"), "{error}");
        assert_eq!(hub.refused_type().as_deref(), Some("std_msgs/Bool"));
    }

    #[test]
    fn a_subscriber_of_another_checksum_is_told_both() {
        let error = hub(false).reply_to(&request("0123"), "/n").unwrap_err();
        let error = error.to_string();
        assert!(
            error.contains("[*/0123]") && error.contains("[std_msgs/String/992ce"),
            "{error}"
        );
        assert!(
            hub(false)
                .reply_to(&ConnectionHeader::default(), "/n")
                .unwrap_err()
                .to_string()
                .contains("required")
        );
    }

    #[tokio::test]
    async fn a_late_subscriber_gets_the_last_message_of_a_latched_topic_only() {
        for latch in [true, false] {
            let hub = hub(latch);
            let none = hub.publish(Bytes::from_static(b"1"), Latched::Alone(0));
            assert_eq!(none, Published::default());
            let late = hub.join(1, "/late", Default::default()).unwrap();
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
        hub.latch(20, message("2"));
        let _again = hub.publish(message("4"), Latched::Beside(30));
        let late = async |id| {
            let late = hub.join(id, "/late", Default::default()).unwrap();
            let mut taken = Vec::new();
            late.subscriber.outbox.take(&mut taken, 64).await;
            taken
        };
        assert_eq!(late(1).await, ["0", "2", "4"]);
        hub.forget_latched(20);
        assert_eq!(late(2).await, ["0", "4"]);
        let _alone = hub.publish(message("5"), Latched::Alone(5));
        assert_eq!(late(3).await, ["5"]);
    }

    #[test]
    fn what_a_late_subscribers_queue_does_not_hold_is_counted() {
        let hub = hub_of(true, 2);
        for key in 0..5 {
            hub.latch(key, Bytes::new());
        }
        let late = hub.join(1, "/late", Default::default()).unwrap();
        assert_eq!(late.subscriber.outbox.dropped(), 3);
        assert_eq!(hub.dropped(), 3);
    }

    #[tokio::test]
    async fn who_came_before_it_was_known_that_there_are_several_gets_the_others_once() {
        let hub = hub(true);
        let text = Bytes::from_static;
        for (key, message) in [(1, "left"), (2, "right"), (3, "base")] {
            let _published = hub.publish(text(message.as_bytes()), Latched::Alone(key));
        }
        let early = hub.join(1, "/early", Default::default()).unwrap();
        let mut heard = Vec::new();
        assert!(early.subscriber.outbox.take(&mut heard, 64).await);
        for _ in 0..2 {
            hub.latch(1, text(b"left"));
            hub.latch(3, text(b"base"));
        }
        hub.close();
        let mut made_up = Vec::new();
        assert!(early.subscriber.outbox.take(&mut made_up, 64).await);
        assert_eq!((heard, made_up), (vec![text(b"base")], vec![text(b"left")]));
    }

    #[test]
    fn a_subscriber_that_does_not_read_costs_only_itself() {
        let hub = hub(false);
        let joined = hub.join(1, "/slow", Default::default()).unwrap();
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

    #[test]
    fn a_subscriber_out_of_reach_gets_no_message_late_but_the_latched_one() {
        for (latch, keep_cut_off) in [(false, false), (true, false), (false, true)] {
            let options = PublisherOptions {
                latch,
                keep_cut_off,
                ..PublisherOptions::default()
            };
            let hub = hub_with(options);
            let (network, reach) = NetworkReach::new();
            let lost = IpAddr::from([10, 0, 0, 1]);
            let other = IpAddr::from([10, 0, 1, 1]);
            let join = |id, name: &str, reach| hub.join(id, name, (String::new(), reach)).unwrap();
            let away = join(1, "/away", Some((reach.clone(), lost)));
            let beside = join(2, "/beside", Some((reach, other)));
            let here = join(3, "/here", None);
            let publish =
                |text: &'static [u8]| hub.publish(Bytes::from_static(text), Latched::Alone(0));
            let _all = publish(b"1");
            network.send_replace([lost].into());
            hub.drop_cut_off();
            let cut = publish(b"2");
            network.send_replace(Arc::default());
            // It is cut off until it connects again.
            let back = publish(b"3");
            let dropped = usize::from(!keep_cut_off);
            for published in [cut, back] {
                let counts = (published.sent_to, published.cut_off);
                assert_eq!(counts, (3 - dropped, dropped));
            }
            let counted = (hub.dropped(), hub.cut_off());
            assert_eq!(counted, (0, if keep_cut_off { 0 } else { 3 }));
            for whole in [here, beside] {
                assert_eq!(whole.subscriber.outbox.clear(), 3);
            }
            let expected = if keep_cut_off { 3 } else { 0 };
            assert_eq!(away.subscriber.outbox.clear(), expected);
            // When it connects again, it receives what is latched.
            let again = join(4, "/away", None);
            assert_eq!(again.subscriber.outbox.clear(), u64::from(latch));
        }
    }
}
