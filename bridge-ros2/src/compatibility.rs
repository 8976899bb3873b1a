//! Which qualities of service keep a writer and a reader apart.
//!
//! DDS matches a reader with a writer only when the writer offers at least what the reader requests (DDS 1.4, 2.2.3), and
//! tells neither of a match that did not come about but by a status that nobody looks at. So it is looked for here.

use rustdds::qos::QosPolicyId;
use rustdds::{Duration, QosPolicies};

/// A policy in which a writer offers less than a reader requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Incompatibility {
    /// The policy, in lower case.
    pub policy: &'static str,
    /// What the writer offers.
    pub offered: String,
    /// What the reader requests.
    pub requested: String,
}

impl Incompatibility {
    /// The first policy that keeps these two apart, if any does.
    #[must_use]
    pub fn between(offered: &QosPolicies, requested: &QosPolicies) -> Option<Self> {
        let id = offered.compliance_failure_wrt(requested)?;
        let of = |qos: &QosPolicies| described(&id, qos);
        Some(Self {
            policy: name(&id),
            offered: of(offered),
            requested: of(requested),
        })
    }
}

fn name(id: &QosPolicyId) -> &'static str {
    match id {
        QosPolicyId::Durability => "durability",
        QosPolicyId::Presentation => "presentation",
        QosPolicyId::Deadline => "deadline",
        QosPolicyId::LatencyBudget => "latency budget",
        QosPolicyId::Ownership => "ownership",
        QosPolicyId::Liveliness => "liveliness",
        QosPolicyId::TimeBasedFilter => "time based filter",
        QosPolicyId::Reliability => "reliability",
        QosPolicyId::DestinationOrder => "destination order",
        QosPolicyId::History => "history",
        QosPolicyId::ResourceLimits => "resource limits",
        QosPolicyId::Lifespan => "lifespan",
        QosPolicyId::Representation => "data representation",
        QosPolicyId::Property => "property",
    }
}

/// What the policies say of one, as people read it; `default` where nothing is said.
fn described(id: &QosPolicyId, qos: &QosPolicies) -> String {
    fn show(value: Option<impl std::fmt::Debug>) -> String {
        value.map_or_else(
            || "default".to_owned(),
            |value| format!("{value:?}").to_lowercase(),
        )
    }
    match id {
        QosPolicyId::Reliability if qos.is_reliable() => "reliable".to_owned(),
        QosPolicyId::Reliability => "best effort".to_owned(),
        QosPolicyId::Durability => {
            show(qos.durability()).replace("transientlocal", "transient local")
        }
        QosPolicyId::Deadline => qos.deadline().map(|deadline| deadline.0).map_or_else(
            || "none".to_owned(),
            |deadline| format!("{} ms", deadline.to_std().as_millis()),
        ),
        QosPolicyId::Liveliness => show(qos.liveliness()),
        QosPolicyId::Ownership => show(qos.ownership()),
        QosPolicyId::Presentation => show(qos.presentation()),
        QosPolicyId::LatencyBudget => show(qos.latency_budget()),
        QosPolicyId::DestinationOrder => show(qos.destination_order()),
        QosPolicyId::TimeBasedFilter
        | QosPolicyId::History
        | QosPolicyId::ResourceLimits
        | QosPolicyId::Lifespan
        | QosPolicyId::Representation
        | QosPolicyId::Property => show(Some(qos)),
    }
}

/// The deadline of the policies, unless it is endless.
#[must_use]
pub fn finite_deadline(qos: &QosPolicies) -> Option<Duration> {
    qos.deadline()
        .map(|deadline| deadline.0)
        .filter(|deadline| *deadline != Duration::INFINITE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustdds::QosPolicyBuilder;
    use rustdds::policy::{Deadline, Durability};

    fn builder() -> QosPolicyBuilder {
        QosPolicyBuilder::new()
    }

    fn told(offered: QosPolicyBuilder, requested: QosPolicyBuilder) -> Option<(String, String)> {
        let found = Incompatibility::between(&offered.build(), &requested.build())?;
        Some((
            format!("{}: {}", found.policy, found.offered),
            found.requested,
        ))
    }

    #[test]
    fn both_sides_of_what_keeps_them_apart_are_told() {
        let pair = |a: &str, b: &str| Some((a.to_owned(), b.to_owned()));
        assert_eq!(
            told(builder().best_effort(), builder().reliable(Duration::ZERO)),
            pair("reliability: best effort", "reliable")
        );
        assert_eq!(
            told(
                builder().durability(Durability::Volatile),
                builder().durability(Durability::TransientLocal)
            ),
            pair("durability: volatile", "transient local")
        );
        assert_eq!(
            told(
                builder(),
                builder().deadline(Deadline(Duration::from_millis(100)))
            ),
            pair("deadline: none", "100 ms")
        );
    }

    #[test]
    fn more_than_is_asked_for_is_compatible() {
        let offered = builder()
            .reliable(Duration::ZERO)
            .durability(Durability::TransientLocal)
            .deadline(Deadline(Duration::from_millis(50)));
        let requested = builder()
            .best_effort()
            .deadline(Deadline(Duration::from_millis(100)));
        assert_eq!(told(offered, requested), None);
    }

    #[test]
    fn an_endless_deadline_is_none() {
        let of = |deadline| finite_deadline(&builder().deadline(Deadline(deadline)).build());
        assert_eq!(of(Duration::INFINITE), None);
        assert_eq!(of(Duration::from_millis(9)), Some(Duration::from_millis(9)));
    }
}
