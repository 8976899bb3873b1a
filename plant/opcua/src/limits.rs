//! The bounds servers and clients of the plant put on each other, in one place: what one side sends, the other takes.

use std::time::Duration;

#[cfg(feature = "server")]
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
/// Bytes of the notifications that wait for all clients of a server.
pub const QUEUED_NOTIFICATIONS: usize = 64 << 20;
/// Requests of one connection that a server processes at a time, Publish requests apart.
pub const REQUESTS_IN_FLIGHT: usize = 1_000;
/// How long a method or a write may take until its client is told `BadTimeout`.
pub const LONGEST_REQUEST: Duration = Duration::from_secs(10);
/// Bytes of the largest NodeSet file.
pub const LARGEST_NODESET: u64 = 64 << 20;
/// Bytes of all NodeSet files of a server.
pub const LARGEST_NODESETS: u64 = 128 << 20;
/// NodeSet files of a server.
pub const MOST_NODESETS: usize = 64;

/// The number of clients that a server serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClientLimits {
    /// Sessions.
    pub sessions: usize,
    /// Sessions of one client address, while less than an eighth of the sessions is free; 0 is no limit. SCADA hosts and
    /// gateways run many clients on one address.
    pub sessions_per_address: usize,
    /// Connections. The oldest one without an activated session gives way.
    pub connections: usize,
    /// Connections of one client address; 0 is no limit.
    pub connections_per_address: usize,
}

impl ClientLimits {
    /// Returns the limits of a server with that number of sessions.
    #[must_use]
    pub const fn of(sessions: usize) -> Self {
        Self {
            sessions,
            sessions_per_address: sessions.div_ceil(2),
            connections: sessions.saturating_mul(4).saturating_add(100),
            connections_per_address: sessions.saturating_mul(2).saturating_add(50),
        }
    }

    /// Returns the limits that a file sets: sessions, sessions per address, connections, and connections per address. `None`
    /// is the usual limit.
    #[must_use]
    pub fn given([sessions, per_address, connections, per_peer]: [Option<u16>; 4]) -> Self {
        let set = |given: Option<u16>, usual| given.map_or(usual, usize::from);
        let usual = Self::of(set(sessions, MOST_SESSIONS));
        Self {
            sessions: usual.sessions,
            sessions_per_address: set(per_address, usual.sessions_per_address),
            connections: set(connections, usual.connections),
            connections_per_address: set(per_peer, usual.connections_per_address),
        }
    }

    /// Returns the limits of a server behind a [`crate::door::Door`]. All its connections come from one address, and the
    /// door has bounded those of each client.
    #[must_use]
    pub const fn behind_door(self) -> Self {
        Self {
            sessions_per_address: 0,
            connections_per_address: 0,
            ..self
        }
    }

    /// Sets these limits in those of the library. The published library has the number of sessions only, and ignores
    /// the others.
    #[cfg(feature = "server")]
    #[must_use]
    pub fn bound(self, mut limits: Limits) -> Limits {
        limits.max_sessions = self.sessions;
        let Ok(serde_json::Value::Object(mut all)) = serde_json::to_value(&limits) else {
            return limits;
        };
        for (name, limit) in [
            ("max_sessions_per_address", self.sessions_per_address),
            ("max_connections", self.connections),
            ("max_connections_per_address", self.connections_per_address),
            ("max_queued_bytes", QUEUED_NOTIFICATIONS),
            ("max_requests_in_flight", REQUESTS_IN_FLIGHT),
        ] {
            all.insert(name.to_owned(), limit.into());
        }
        serde_json::from_value(all.into()).unwrap_or(limits)
    }
}

impl Default for ClientLimits {
    fn default() -> Self {
        Self::of(MOST_SESSIONS)
    }
}

/// Returns the limits of a server.
#[cfg(feature = "server")]
#[must_use]
pub fn server(clients: ClientLimits) -> Limits {
    clients.bound(Limits {
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
        ..Limits::default()
    })
}

#[cfg(all(test, feature = "server"))]
mod tests {
    use super::*;

    #[test]
    fn the_limits_of_clients_are_those_of_the_library() {
        let clients = ClientLimits::of(7);
        let limits = server(clients);
        assert_eq!(limits.max_sessions, 7);
        assert_eq!(limits.max_chunk_count, MOST_CHUNKS);
        let shown = serde_json::to_value(server(clients.behind_door())).unwrap();
        for name in ["max_sessions_per_address", "max_connections_per_address"] {
            let limit = shown.get(name).and_then(serde_json::Value::as_u64);
            // The published library has none of them.
            assert!(limit.is_none_or(|limit| limit == 0), "{name}: {limit:?}");
        }
    }
}
