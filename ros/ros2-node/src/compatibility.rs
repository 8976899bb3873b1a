//! Finds the QoS policies that prevent a match of a writer and a reader.
//!
//! DDS matches a reader with a writer only if the writer offers at least the QoS that the reader
//! requests (DDS 1.4, 2.2.3). It reports a failed match only by a status, which usually goes
//! unnoticed, so the bridge compares the policies itself.

use rustdds::policy::{
    DataRepresentation, DataRepresentationId, XCDR_DATA_REPRESENTATION, XCDR2_DATA_REPRESENTATION,
    XML_DATA_REPRESENTATION,
};
use rustdds::qos::QosPolicyId;
use rustdds::{Duration, QosPolicies};

/// A policy in which a writer offers less than a reader requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Incompatibility {
    /// The name of the policy, in lower case.
    pub policy: &'static str,
    /// The offered value.
    pub offered: String,
    /// The requested value.
    pub requested: String,
}

impl Incompatibility {
    /// Returns the first incompatible policy, if any.
    #[must_use]
    pub fn between(offered: &QosPolicies, requested: &QosPolicies) -> Option<Self> {
        let id = offered.compliance_failure_wrt(requested)?;
        let of = |qos: &QosPolicies| described(&id, qos);
        let (offered, requested) = if id == QosPolicyId::Representation {
            representations(offered, requested)
        } else {
            (of(offered), of(requested))
        };
        Some(Self {
            policy: name(&id),
            offered,
            requested,
        })
    }
}

/// Returns the data representation that the writer uses, and the representations that the reader
/// accepts (DDS-XTypes 1.3, 7.6.3.1.1).
fn representations(offered: &QosPolicies, requested: &QosPolicies) -> (String, String) {
    let writes = offered.data_representation();
    let accepts = requested.data_representation();
    let writes = DataRepresentation::offered_representation(writes.as_ref());
    let accepts = DataRepresentation::accepted_representations(accepts.as_ref());
    let accepts: Vec<String> = accepts.iter().take(SHOWN).map(|id| encoding(*id)).collect();
    (encoding(writes), accepts.join(" or "))
}

fn encoding(id: DataRepresentationId) -> String {
    match id {
        XCDR_DATA_REPRESENTATION => "XCDR1".to_owned(),
        XML_DATA_REPRESENTATION => "XML".to_owned(),
        XCDR2_DATA_REPRESENTATION => "XCDR2".to_owned(),
        other => format!("representation {other}"),
    }
}

/// Maximum number of listed data representations: a peer may announce thousands.
const SHOWN: usize = 4;

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

/// Formats the value of a policy for log messages; `default` if the policy is not set.
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
            // RTPS expresses fractions of a second in powers of two: rounded to milliseconds.
            |deadline| format!("{} ms", (deadline.to_nanoseconds() + 500_000) / 1_000_000),
        ),
        QosPolicyId::Liveliness => show(qos.liveliness()),
        QosPolicyId::Ownership => show(qos.ownership()),
        QosPolicyId::Presentation => show(qos.presentation()),
        QosPolicyId::LatencyBudget => show(qos.latency_budget()),
        QosPolicyId::DestinationOrder => show(qos.destination_order()),
        QosPolicyId::TimeBasedFilter => show(qos.time_based_filter()),
        QosPolicyId::History => show(qos.history()),
        QosPolicyId::ResourceLimits => show(qos.resource_limits()),
        QosPolicyId::Lifespan => show(qos.lifespan()),
        QosPolicyId::Representation => representations(qos, qos).0,
        QosPolicyId::Property => "other properties".to_owned(),
    }
}

/// Returns the deadline of the policies, unless it is infinite.
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
    fn a_writer_of_xcdr2_is_told_by_the_name_of_its_encoding() {
        let xcdr2 = DataRepresentation {
            value: vec![XCDR2_DATA_REPRESENTATION],
        };
        let offered = builder().reliable(Duration::ZERO).build();
        let offered = offered.with_data_representation(xcdr2);
        let found = Incompatibility::between(&offered, &builder().build()).unwrap();
        assert_eq!(found.policy, "data representation");
        assert_eq!(
            (found.offered.as_str(), found.requested.as_str()),
            ("XCDR2", "XCDR1")
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
