//! The QoS that the bridge's endpoints request and offer.

use std::fmt;
use std::num::NonZeroU16;

use messages::TypeName;
use rustdds::policy::{Deadline, Durability, History, ResourceLimits};
use rustdds::{Duration, QosPolicies, QosPolicyBuilder};

use crate::graph::RemoteEndpoint;

/// The QoS that a reader requests, derived from the offers of its topic's writers.
///
/// A reader that requests more than a writer offers is not matched with it (DDS 1.4, 2.2.3), so it
/// requests the most that all writers offer. Without a writer it requests the defaults of a ROS
/// publisher of its type: best effort for sensor data, otherwise reliable, so that the first
/// message after a match is repaired if it was sent before the bridge noticed the match; and
/// volatile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Requested {
    reliable: bool,
    transient_local: bool,
}

impl Requested {
    /// Returns whether earlier samples are requested as well.
    #[must_use]
    pub const fn is_transient_local(self) -> bool {
        self.transient_local
    }

    /// Returns the most that all `writers` offer.
    #[must_use]
    pub fn from_writers(writers: &[RemoteEndpoint]) -> Self {
        Self {
            reliable: writers.iter().all(|writer| writer.reliable),
            transient_local: !writers.is_empty()
                && writers.iter().all(|writer| writer.transient_local),
        }
    }

    /// Returns the request without a known writer: the defaults of ROS publishers of the type.
    /// Drivers publish sensor data as best effort, and their nodes log a warning about a reader
    /// that requests more.
    #[must_use]
    pub fn without_writers(message_type: &TypeName) -> Self {
        Self {
            reliable: message_type.package() != "sensor_msgs",
            transient_local: false,
        }
    }

    /// Returns the policies of such a reader, with a history of [`READER_DEPTH`].
    #[must_use]
    pub fn policies(self) -> QosPolicies {
        let qos = QosPolicyBuilder::new()
            .durability(if self.transient_local {
                Durability::TransientLocal
            } else {
                Durability::Volatile
            })
            .history(History::KeepLast {
                depth: READER_DEPTH,
            })
            .resource_limits(limits(READER_DEPTH));
        if self.reliable {
            qos.reliable(Duration::ZERO).build()
        } else {
            qos.best_effort().build()
        }
    }
}

impl fmt::Display for Requested {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.reliable {
            "reliable"
        } else {
            "best effort"
        })?;
        f.write_str(if self.transient_local {
            ", transient local"
        } else {
            ", volatile"
        })
    }
}

/// The QoS that a writer offers, and the overflow policy of its bounded queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Offered {
    /// Only the last value counts: transient-local, so that late readers receive it, and the newest
    /// value replaces older values.
    KeepLatest,
    /// Every value counts, up to this number of waiting values: volatile, and the oldest value is
    /// dropped.
    DropOldest(NonZeroU16),
}

impl fmt::Display for Offered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::KeepLatest => f.write_str("reliable, transient local, keep latest"),
            Self::DropOldest(waiting) => write!(f, "reliable, volatile, up to {waiting} waiting"),
        }
    }
}

impl Offered {
    /// Returns the policies of such a writer.
    ///
    /// The writer is always reliable, which best-effort readers match too, and never blocks: with a
    /// blocking time of zero a full send window is an immediate
    /// [`WouldBlock`](rustdds::dds::WriteError::WouldBlock). `max_samples` is this window in
    /// RustDDS: the number of samples that a reader may leave unacknowledged before the writer
    /// stops.
    #[must_use]
    pub fn policies(self) -> QosPolicies {
        let qos = QosPolicyBuilder::new().reliable(Duration::ZERO);
        match self {
            Self::KeepLatest => qos
                .durability(Durability::TransientLocal)
                .history(History::KeepLast { depth: 1 })
                .resource_limits(limits(KEEP_LATEST_WINDOW))
                .build(),
            Self::DropOldest(_) => qos
                .durability(Durability::Volatile)
                .history(History::KeepLast {
                    depth: DROP_OLDEST_DEPTH,
                })
                .resource_limits(limits(DROP_OLDEST_WINDOW))
                .build(),
        }
    }

    /// Returns the policies with a deadline, if readers request one: a reader with a deadline does
    /// not match a writer without a deadline.
    #[must_use]
    pub fn with_deadline(self, deadline: Option<Duration>) -> QosPolicies {
        match deadline {
            None => self.policies(),
            Some(deadline) => self
                .policies()
                .modify_by(&QosPolicyBuilder::new().deadline(Deadline(deadline)).build()),
        }
    }

    /// Returns how many samples may wait in front of a full send window.
    #[must_use]
    pub fn waiting_room(self) -> usize {
        match self {
            Self::KeepLatest => 1,
            Self::DropOldest(depth) => usize::from(depth.get()),
        }
    }
}

/// Samples that a reader keeps while the bridge is busy, or while they wait for the repair of an
/// earlier lost sample, which takes seconds on an overloaded machine. Read samples are released,
/// and unread samples are limited by their bytes, too.
#[cfg(feature = "patched-dds")]
pub const READER_DEPTH: i32 = 4096;
/// Samples that a reader keeps while the bridge is busy. The published RustDDS keeps them until
/// newer samples replace them, so this also determines the memory of a topic with large messages.
#[cfg(not(feature = "patched-dds"))]
pub const READER_DEPTH: i32 = 256;

/// Maximum number of values that a reader may leave unacknowledged. The published RustDDS prunes a
/// history only by a timer, and to this window if there is a best-effort reader: up to this number
/// of old values reach a late joiner before the last value. The patched RustDDS keeps the depth and
/// unacknowledged samples, and sends a late joiner the depth.
const KEEP_LATEST_WINDOW: i32 = 256;
const DROP_OLDEST_DEPTH: i32 = 100;
/// Somewhat more than ten seconds of lease at 1 kHz: the samples that a lost reader leaves
/// unacknowledged.
const DROP_OLDEST_WINDOW: i32 = 16_384;

fn limits(max_samples: i32) -> ResourceLimits {
    ResourceLimits {
        max_samples,
        max_instances: 1,
        max_samples_per_instance: max_samples,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustdds::GUID;
    use rustdds::policy::Reliability;

    fn writer(reliable: bool, transient_local: bool) -> RemoteEndpoint {
        RemoteEndpoint {
            guid: GUID::GUID_UNKNOWN,
            type_name: "std_msgs::msg::dds_::Bool_".into(),
            reliable,
            transient_local,
            type_hash: None,
            qos: Default::default(),
        }
    }

    fn asked(writers: &[RemoteEndpoint]) -> (bool, bool) {
        let qos = Requested::from_writers(writers).policies();
        (
            matches!(qos.reliability(), Some(Reliability::Reliable { .. })),
            qos.durability() == Some(Durability::TransientLocal),
        )
    }

    #[test]
    fn logs_show_the_policies_in_the_words_of_ros() {
        let best_effort = Requested::from_writers(&[writer(false, true)]);
        assert_eq!(best_effort.to_string(), "best effort, transient local");
        let reliable = Requested::from_writers(&[writer(true, false)]);
        assert_eq!(reliable.to_string(), "reliable, volatile");
        let events = Offered::DropOldest(NonZeroU16::MIN);
        assert_eq!(events.to_string(), "reliable, volatile, up to 1 waiting");
    }

    #[test]
    fn a_reader_is_reliable_only_when_all_writers_are() {
        assert_eq!(asked(&[writer(true, false)]), (true, false));
        assert_eq!(
            asked(&[writer(true, false), writer(false, false)]),
            (false, false)
        );
    }

    #[test]
    fn a_reader_asks_for_old_values_only_when_all_writers_keep_them() {
        assert_eq!(asked(&[writer(true, true)]), (true, true));
        assert_eq!(
            asked(&[writer(true, true), writer(true, false)]),
            (true, false)
        );
    }

    #[test]
    fn a_reader_without_writers_matches_a_default_publisher() {
        assert_eq!(asked(&[]), (true, false));
    }

    #[test]
    fn a_reader_of_sensor_data_without_writers_asks_for_no_more_than_drivers_offer() {
        let asked = |name: &str| {
            let qos = Requested::without_writers(&name.parse().unwrap()).policies();
            let offered = QosPolicyBuilder::new().best_effort().build();
            offered.compliance_failure_wrt(&qos).is_none()
        };
        assert!(asked("sensor_msgs/LaserScan"));
        assert!(!asked("geometry_msgs/Twist"));
    }

    #[test]
    fn a_state_topic_offers_its_last_value_to_late_joiners() {
        let qos = Offered::KeepLatest.policies();
        assert_eq!(qos.durability(), Some(Durability::TransientLocal));
        assert_eq!(qos.history(), Some(History::KeepLast { depth: 1 }));
    }

    #[test]
    fn an_event_topic_replays_nothing() {
        let qos = Offered::DropOldest(NonZeroU16::MIN).policies();
        assert_eq!(qos.durability(), Some(Durability::Volatile));
    }
}
