//! Settings of the kernel.

use super::super::facts::CellFacts;
use super::super::host::{HALT_POLL, IPFRAG_HIGH, RMEM_MAX};
use super::DoctorSeverity::{Note, Warning};
use super::{DoctorFinding, Fix, finding};

pub(super) fn kernel_settings(facts: &CellFacts) -> Vec<DoctorFinding> {
    let setting = |path: &str| facts.host.settings.get(path).copied();
    let mut found = Vec::new();
    if let Some(bytes) = setting(RMEM_MAX).filter(|bytes| *bytes < LEAST_RMEM) {
        let one = finding(
            ("D050", Warning),
            format!("socket buffers are limited to {bytes} bytes (net.core.rmem_max)"),
            "a burst of large messages overflows the buffer, and samples are lost",
            format!("set net.core.rmem_max to {WANTED_RMEM}"),
        );
        found.push(with_fix(one, RMEM_MAX, WANTED_RMEM));
    }
    found.extend(setting(IPFRAG_HIGH).and_then(|bytes| fragments(facts, bytes)));
    if facts.host.is_virtual && setting(HALT_POLL) == Some(0) {
        let one = finding(
            ("D053", Note),
            "guest_halt_poll_ns is 0 on this virtual machine",
            "waking an idle processor of a virtual machine takes up to a tenth of a millisecond",
            format!("`echo 200000 > {HALT_POLL}` where delays matter more than processor time"),
        );
        found.push(one);
    }
    found
}

/// Checks the buffer for IP fragments, which has this many bytes.
fn fragments(facts: &CellFacts, bytes: u64) -> Option<DoctorFinding> {
    let failures = facts.host.reassembly_failures;
    if bytes >= LEAST_IPFRAG && failures == 0 {
        return None;
    }
    let failed = match failures {
        0 => String::new(),
        1 => ", and 1 reassembly of fragments failed since the start of this host".to_owned(),
        count => {
            format!(", and {count} reassemblies of fragments failed since the start of this host")
        }
    };
    let what = format!("IP fragments may take {bytes} bytes (net.ipv4.ipfrag_high_thresh){failed}");
    let why = "DDS sends large messages in fragments; a lost fragment loses the whole message";
    if bytes < WANTED_IPFRAG {
        let remedy = format!("set net.ipv4.ipfrag_high_thresh to {WANTED_IPFRAG}");
        let one = finding(("D052", Warning), what, why, remedy);
        return Some(with_fix(one, IPFRAG_HIGH, WANTED_IPFRAG));
    }
    // The buffer is large enough: fragments were lost before it was enlarged, or on the way.
    let remedy = "if `nstat -az IpReasmFails` shows that the count still grows, look for a firewall \
                  that drops fragments, or for a network that loses packets";
    Some(finding(("D052", Note), what, why, remedy))
}

/// Adds the safe repair to a finding.
fn with_fix(one: DoctorFinding, path: &str, value: u64) -> DoctorFinding {
    DoctorFinding {
        fix: Some(Fix {
            path: path.to_owned(),
            value,
        }),
        ..one
    }
}

const LEAST_RMEM: u64 = 1 << 20;
const WANTED_RMEM: u64 = 8 << 20;
const LEAST_IPFRAG: u64 = 4 << 20;
const WANTED_IPFRAG: u64 = 32 << 20;
