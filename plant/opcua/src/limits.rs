//! The bounds servers and clients of the plant put on each other, in one place: what one side sends, the other takes.

use std::time::Duration;

use opcua::server::{Limits, OperationalLimits, SubscriptionLimits};

/// Bytes of the largest string, byte string or message.
pub const LARGEST_VALUE: usize = 64 << 20;
/// Elements of the largest array. Each takes up 24 bytes and more while a message is read.
pub const LARGEST_ARRAY: usize = 4 << 20;
/// Room of a message beside the value in it.
pub const LARGEST_MESSAGE: usize = LARGEST_VALUE + (1 << 20);
/// Chunks of a message, with room for peers that send chunks of half the usual size.
pub const MOST_CHUNKS: usize = 2_100;
/// How often subscriptions are looked at, in milliseconds: how late a notification may be beyond its publishing interval.
pub const POLL_MS: u64 = 5;
/// The shortest publishing interval a client gets.
pub const SHORTEST_PUBLISHING: Duration = Duration::from_millis(10);
/// Notifications in one response. Clients commonly refuse arrays of more than 1000 elements, and then hear nothing more.
pub const MOST_NOTIFICATIONS: usize = 1_000;
/// Nodes or items in one request of a client; servers commonly take 1000.
pub const MOST_PER_REQUEST: usize = 500;
/// Sessions of a server.
pub const MOST_SESSIONS: usize = 50;
/// How long a method or a write may take until its client is told `BadTimeout`.
pub const LONGEST_REQUEST: Duration = Duration::from_secs(10);
/// Bytes of the largest NodeSet file.
pub const LARGEST_NODESET: u64 = 64 << 20;
/// Bytes of all NodeSet files of a server.
pub const LARGEST_NODESETS: u64 = 128 << 20;
/// NodeSet files of a server.
pub const MOST_NODESETS: usize = 64;

/// The limits of a server.
#[must_use]
pub fn server() -> Limits {
    Limits {
        max_array_length: LARGEST_ARRAY,
        max_string_length: LARGEST_VALUE,
        max_byte_string_length: LARGEST_VALUE,
        max_message_size: LARGEST_MESSAGE,
        max_chunk_count: MOST_CHUNKS,
        subscriptions: SubscriptionLimits {
            max_subscriptions_per_session: 50,
            // 0 is what a client gets that asks for exception-based reporting: every change, as it comes.
            min_sampling_interval_ms: 0.0,
            min_publishing_interval_ms: SHORTEST_PUBLISHING.as_secs_f64() * 1e3,
            max_monitored_items_per_sub: 10_000,
            max_monitored_item_queue_size: 1_000,
            max_notifications_per_publish: MOST_NOTIFICATIONS as u64,
            max_queued_notifications: 100,
            ..SubscriptionLimits::default()
        },
        operational: OperationalLimits::default(),
        max_sessions: MOST_SESSIONS,
        ..Limits::default()
    }
}
