//! The findings: pure functions of the facts.

mod kernel;
mod network;
mod programs;
mod ros;

use serde::Serialize;

use super::facts::CellFacts;

/// A fault, or a setting that may cause a fault.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct DoctorFinding {
    pub(super) code: &'static str,
    pub(super) severity: DoctorSeverity,
    pub(super) what: String,
    /// The effect on the cell.
    pub(super) why: String,
    /// The remedy.
    #[serde(rename = "do")]
    pub(super) remedy: String,
    /// The safe repair, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) fix: Option<Fix>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum DoctorSeverity {
    Error,
    Warning,
    Note,
}

/// A setting of the kernel to write.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Fix {
    pub(super) path: String,
    pub(super) value: u64,
}

/// Returns all findings, the most severe first.
pub(super) fn of(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut found: Vec<DoctorFinding> = ALL.iter().flat_map(|check| check(facts)).collect();
    found.sort_by_key(|one| (one.severity, one.code));
    found
}

const ALL: [fn(&CellFacts) -> Vec<DoctorFinding>; 27] = [
    network::interfaces,
    network::membership,
    network::round_trips,
    network::route,
    network::port_holders,
    network::socket_drops,
    network::nothing_heard,
    ros::master,
    ros::unresolved_nodes,
    ros::own_ros_address,
    ros::discovery_range,
    ros::discovery_server,
    ros::middleware,
    ros::domain,
    programs::two_bridges,
    programs::duplicate_topics,
    programs::different_mappings,
    programs::type_conflicts,
    programs::dropped_samples,
    programs::not_ready,
    programs::stale_mappings,
    programs::different_versions,
    programs::clocks,
    kernel::kernel_settings,
    programs::descriptors,
    programs::certificates,
    network::filters,
];

fn finding(
    (code, severity): (&'static str, DoctorSeverity),
    what: impl Into<String>,
    why: &str,
    remedy: impl Into<String>,
) -> DoctorFinding {
    DoctorFinding {
        code,
        severity,
        what: what.into(),
        why: why.to_owned(),
        remedy: remedy.into(),
        fix: None,
    }
}

#[cfg(test)]
mod tests;
