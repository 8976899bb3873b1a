//! Which quality of service our endpoints ask for and offer.

use std::num::NonZeroU16;

use messages::TypeName;
use rustdds::policy::{Deadline, Durability, History, ResourceLimits};
use rustdds::{Duration, QosPolicies, QosPolicyBuilder};

use crate::graph::Endpoint;

/// What a reader asks for, derived from what the writers of its topic offer.
///
/// A reader that asks for more than a writer offers is not matched with it (DDS 1.4, 2.2.3), so it asks for the most
/// that all of them offer. Without any writer it asks for the defaults of a ROS publisher of its type:
/// sensor data best effort, all else reliable, so that the first message after a match is repaired when it was sent before we
/// noticed the match; and volatile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Requested {
    reliable: bool,
    transient_local: bool,
}

impl Requested {
    /// Whether what was written before counts as well.
    pub(crate) const fn is_transient_local(self) -> bool {
        self.transient_local
    }

    /// The most that every one of `writers` offers.
    #[must_use]
    pub fn from_writers(writers: &[Endpoint]) -> Self {
        Self {
            reliable: writers.iter().all(|writer| writer.reliable),
            transient_local: !writers.is_empty()
                && writers.iter().all(|writer| writer.transient_local),
        }
    }

    /// The request while no writer is known: the defaults of ROS publishers of that type. Drivers publish sensor data best
    /// effort, and their nodes warn of a reader that requests more.
    #[must_use]
    pub fn without_writers(message_type: &TypeName) -> Self {
        Self {
            reliable: message_type.package() != "sensor_msgs",
            transient_local: false,
        }
    }

    /// The policies of such a reader, with a history of [`READER_DEPTH`].
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

/// What a writer offers, and what its bounded queue does when it is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Offered {
    /// The last value counts: transient-local, so that who comes late gets it, and the newest value wins.
    KeepLatest,
    /// Every value counts, up to this many waiting: volatile, and the oldest is dropped.
    DropOldest(NonZeroU16),
}

impl Offered {
    /// The policies of such a writer.
    ///
    /// Always reliable, which best-effort readers match too, and never blocking: with a blocking time of zero a full
    /// send window is an immediate [`WouldBlock`](rustdds::dds::WriteError::WouldBlock). `max_samples` is that window
    /// in RustDDS: how many samples a reader may leave unacknowledged before the writer stops.
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

    /// The same with a deadline, in case readers ask for one: a reader that does is not matched by a writer that offers
    /// none.
    #[must_use]
    pub fn with_deadline(self, deadline: Option<Duration>) -> QosPolicies {
        match deadline {
            None => self.policies(),
            Some(deadline) => self
                .policies()
                .modify_by(&QosPolicyBuilder::new().deadline(Deadline(deadline)).build()),
        }
    }

    /// How many samples may wait on our side of a full send window.
    #[must_use]
    pub fn waiting_room(self) -> usize {
        match self {
            Self::KeepLatest => 1,
            Self::DropOldest(depth) => usize::from(depth.get()),
        }
    }
}

/// Samples a reader keeps for us: while we are busy, or while they wait for one before them that was lost and is repaired,
/// which takes seconds on an overloaded machine. What was read is released, and what is not is bounded by its bytes, too.
#[cfg(feature = "patched-dds")]
pub const READER_DEPTH: i32 = 4096;
/// Samples a reader keeps for us while we are busy. RustDDS as published keeps them until newer ones push them out, so this
/// is also the memory of a topic that carries large messages.
#[cfg(not(feature = "patched-dds"))]
pub const READER_DEPTH: i32 = 256;

/// How many values a reader may leave unacknowledged. RustDDS as published prunes a history by a timer only, and to this
/// window when there is a best-effort reader: so many old values, at most, reach a late joiner before the last one. The
/// patched one keeps the depth and what is not acknowledged, and gives a late joiner the depth.
const KEEP_LATEST_WINDOW: i32 = 256;
const DROP_OLDEST_DEPTH: i32 = 100;
/// Ten seconds of lease at 1 kHz, and some: what a reader that vanished without a word leaves unacknowledged.
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

    fn writer(reliable: bool, transient_local: bool) -> Endpoint {
        Endpoint {
            guid: GUID::GUID_UNKNOWN,
            type_name: "std_msgs::msg::dds_::Bool_".into(),
            reliable,
            transient_local,
            type_hash: None,
            qos: Default::default(),
        }
    }

    fn asked(writers: &[Endpoint]) -> (bool, bool) {
        let qos = Requested::from_writers(writers).policies();
        (
            matches!(qos.reliability(), Some(Reliability::Reliable { .. })),
            qos.durability() == Some(Durability::TransientLocal),
        )
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
