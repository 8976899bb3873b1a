//! The limits that servers and clients of the plant apply to each other. Both sides use the same
//! values, so that each side accepts the messages of the other side.

use std::time::Duration;

#[cfg(feature = "server")]
use opcua::server::{Limits, OperationalLimits, SubscriptionLimits};

/// Largest string, ByteString or message body, in bytes.
pub const LARGEST_VALUE: usize = 64 << 20;
/// Maximum number of elements of an array. Each element takes at least 24 bytes while a message is
/// decoded.
pub const LARGEST_ARRAY: usize = 4 << 20;
/// Largest message in bytes, with space for the headers.
pub const LARGEST_MESSAGE: usize = LARGEST_VALUE + (1 << 20);
/// Maximum number of chunks of a message, with a reserve for peers that send chunks of half the
/// usual size.
pub const MOST_CHUNKS: usize = 2_100;
/// Interval of processing subscriptions in milliseconds: the largest delay of a notification after
/// its publishing interval.
pub const POLL_MS: u64 = 5;
/// Shortest publishing interval of a server.
pub const SHORTEST_PUBLISHING: Duration = Duration::from_millis(10);
/// Longest lifetime of a subscription that is not durable. It bounds the memory that vanished
/// clients leave behind.
pub const LONGEST_LIFETIME: Duration = Duration::from_secs(600);
/// Maximum number of notifications in a response. Many clients refuse arrays of more than 1000
/// elements, and then receive no further notifications.
pub const MOST_NOTIFICATIONS: usize = 1_000;
/// Maximum number of nodes or items in a request of a client. Many servers accept 1000.
pub const MOST_PER_REQUEST: usize = 500;
/// Maximum number of sessions of a server.
pub const MOST_SESSIONS: usize = 50;
/// Maximum number of bytes of queued notifications, for all clients of a server.
pub const QUEUED_NOTIFICATIONS: usize = 64 << 20;
/// Maximum number of waiting Publish requests of a session for each of its subscriptions.
pub const PUBLISH_REQUESTS: usize = 20;
/// Maximum number of waiting Publish requests of a session.
pub const MOST_PUBLISH_REQUESTS: usize = 200;
/// Maximum number of requests of a connection that a server processes at a time, without Publish
/// requests.
pub const REQUESTS_IN_FLIGHT: usize = 1_000;
/// Timeout of a method call or a write, after which the client receives `BadTimeout`.
pub const LONGEST_REQUEST: Duration = Duration::from_secs(10);
/// Largest NodeSet file in bytes.
pub const LARGEST_NODESET: u64 = 64 << 20;
/// Maximum number of bytes of all NodeSet files of a server.
pub const LARGEST_NODESETS: u64 = 128 << 20;
/// Maximum number of NodeSet files of a server.
pub const MOST_NODESETS: usize = 64;

/// The limits of the clients of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClientLimits {
    /// Maximum number of sessions.
    pub sessions: usize,
    /// Maximum number of sessions of a client address. The limit applies while less than an eighth
    /// of the sessions is free; 0 for no limit. SCADA hosts and gateways run many clients at one
    /// address.
    pub sessions_per_address: usize,
    /// Maximum number of connections. A new connection replaces the oldest connection without an
    /// activated session.
    pub connections: usize,
    /// Maximum number of connections of a client address; 0 for no limit.
    pub connections_per_address: usize,
}

/// The options that bound the clients of a server without a configuration file.
#[cfg(feature = "server")]
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct LimitArguments {
    /// The maximum number of sessions of clients, of all addresses together
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    sessions: Option<u16>,
    /// The maximum number of sessions of a client address, while less than an eighth of --sessions
    /// is free
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    sessions_per_address: Option<u16>,
    /// The maximum number of connections. Beyond it the oldest connection without an activated
    /// session is closed
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    connections: Option<u16>,
    /// The maximum number of connections of a client address
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    connections_per_address: Option<u16>,
}

#[cfg(feature = "server")]
impl LimitArguments {
    /// Returns the limits, with defaults for options that are not given.
    #[must_use]
    pub fn limits(self) -> ClientLimits {
        ClientLimits::given([
            self.sessions,
            self.sessions_per_address,
            self.connections,
            self.connections_per_address,
        ])
    }
}

impl ClientLimits {
    /// Returns the limits of a server with this number of sessions.
    #[must_use]
    pub const fn of(sessions: usize) -> Self {
        Self {
            sessions,
            sessions_per_address: sessions.div_ceil(2),
            connections: sessions.saturating_mul(4).saturating_add(100),
            connections_per_address: sessions.saturating_mul(2).saturating_add(50),
        }
    }

    /// Returns the limits of a configuration file: sessions, sessions per address, connections, and
    /// connections per address. `None` selects the default.
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

    /// Returns the limits of a server behind a [`crate::door::Door`]. All its connections come from
    /// the same address, and the door limits the connections of each client.
    #[must_use]
    pub const fn behind_door(self) -> Self {
        Self {
            sessions_per_address: 0,
            connections_per_address: 0,
            ..self
        }
    }

    /// Applies the limits to the limits of the library. The unpatched library supports the number
    /// of sessions only, and ignores the other limits.
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
        if let Some(serde_json::Value::Object(subscriptions)) = all.get_mut("subscriptions") {
            let longest = LONGEST_LIFETIME.as_secs().saturating_mul(1_000);
            subscriptions.insert("max_lifetime_ms".to_owned(), longest.into());
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
            // Value 0 permits exception-based reporting: every change is reported at once.
            min_sampling_interval_ms: 0.0,
            min_publishing_interval_ms: SHORTEST_PUBLISHING.as_secs_f64() * 1e3,
            max_monitored_items_per_sub: 10_000,
            max_monitored_item_queue_size: 1_000,
            max_notifications_per_publish: MOST_NOTIFICATIONS as u64,
            max_queued_notifications: 100,
            max_publish_requests_per_subscription: PUBLISH_REQUESTS,
            max_pending_publish_requests: MOST_PUBLISH_REQUESTS,
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
    fn options_set_limits_and_the_others_have_their_defaults() {
        #[derive(clap::Parser)]
        struct Program {
            #[command(flatten)]
            limits: LimitArguments,
        }
        let limits = |arguments: &[&str]| {
            let words = ["program"].iter().chain(arguments);
            let program = <Program as clap::Parser>::try_parse_from(words);
            program.map(|program| program.limits.limits()).ok()
        };
        assert_eq!(limits(&[]), Some(ClientLimits::default()));
        let usual = ClientLimits::of(8);
        let wanted = ClientLimits {
            connections_per_address: 5,
            ..usual
        };
        let given = ["--sessions", "8", "--connections-per-address", "5"];
        assert_eq!(limits(&given), Some(wanted));
        assert_eq!(limits(&["--sessions", "0"]), None);
    }

    #[test]
    fn the_limits_of_clients_are_those_of_the_library() {
        let clients = ClientLimits::of(7);
        let limits = server(clients);
        assert_eq!(limits.max_sessions, 7);
        assert_eq!(limits.max_chunk_count, MOST_CHUNKS);
        let shown = serde_json::to_value(server(clients.behind_door())).unwrap();
        for name in ["max_sessions_per_address", "max_connections_per_address"] {
            let limit = shown.get(name).and_then(serde_json::Value::as_u64);
            // The unpatched library has none of these limits.
            assert!(limit.is_none_or(|limit| limit == 0), "{name}: {limit:?}");
        }
    }
}
