//! The programs of the cell: their spaces, topics, mappings, versions, clocks and certificates.

use std::collections::BTreeMap;

use supervisor::is_intended_drop;

use super::super::facts::CellFacts;
use super::DoctorSeverity::{Error, Note, Warning};
use super::{DoctorFinding, finding};
use crate::cell::StatusPage;

pub(super) fn two_bridges(facts: &CellFacts) -> Vec<DoctorFinding> {
    let twice = facts
        .bridges()
        .into_iter()
        .filter(|(_, senders)| senders.len() > 1);
    let each = twice.map(|(space, senders)| {
        let senders: Vec<&str> = senders.into_iter().collect();
        finding(
            ("D030", Error),
            format!(
                "space {space} has {} bridges: {}",
                senders.len(),
                senders.join(", ")
            ),
            "each sample crosses once for each bridge, and both publish under the same identifiers",
            "stop all bridges of this space but one",
        )
    });
    each.collect()
}

pub(super) fn duplicate_topics(facts: &CellFacts) -> Vec<DoctorFinding> {
    let known = facts.bridges();
    let two = facts.group.topics.iter().filter(|one| {
        let space = one
            .topic
            .split('_')
            .nth(1)
            .and_then(|space| space.parse().ok());
        let is_explained = space
            .is_some_and(|space: u16| known.get(&space).is_some_and(|senders| senders.len() > 1));
        // A restarted program changes the sender once.
        one.sender_changed > 1 && !is_explained
    });
    let each = two.take(MOST_EACH).map(|one| {
        finding(
            ("D031", Error),
            format!(
                "{} is sent from several addresses",
                called(one.name.as_deref(), &one.topic)
            ),
            "readers see two interleaved sequences of values",
            "give each program its own namespace number; `ua-space info` names the sender",
        )
    });
    each.collect()
}

fn called(name: Option<&str>, topic: &str) -> String {
    match name {
        Some(name) => format!("{name} ({topic})"),
        None => topic.to_owned(),
    }
}

pub(super) fn different_mappings(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut by_hash: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for page in facts
        .pages
        .iter()
        .filter(|page| !page.mapping.hash.is_empty() && !has_own_file(page))
    {
        let hash = page.mapping.hash.as_str();
        by_hash.entry(hash).or_default().push(page.label());
    }
    if by_hash.len() < 2 {
        return Vec::new();
    }
    let each = by_hash.iter().map(|(hash, programs)| {
        let hash: String = hash.chars().take(8).collect();
        format!("{hash} of {}", programs.join(", "))
    });
    let each: Vec<String> = each.collect();
    vec![finding(
        ("D032", Warning),
        format!("programs run different mappings: {}", each.join("; ")),
        "a value that one program maps may be unknown to the others, or have another type",
        "copy one file to all hosts; SIGHUP or saving the file reloads it",
    )]
}

/// Returns whether the file of a program is not the mapping of the cell.
fn has_own_file(page: &StatusPage) -> bool {
    ["ua-component", "ua-mes", "ua-station"].contains(&page.program.as_str())
}

pub(super) fn type_conflicts(facts: &CellFacts) -> Vec<DoctorFinding> {
    let conflicting = facts.group.topics.iter().filter(|one| one.types.len() > 1);
    let each = conflicting.take(MOST_EACH).map(|one| {
        finding(
            ("D033", Error),
            format!(
                "{} is announced with different types: {}",
                called(one.name.as_deref(), &one.topic),
                one.types.join(", ")
            ),
            "readers take the type of one sender, and drop the values of the other",
            "correct the type in the mapping of one of the senders",
        )
    });
    each.collect()
}

pub(super) fn dropped_samples(facts: &CellFacts) -> Vec<DoctorFinding> {
    let names = facts.names();
    let each = facts.pages.iter().flat_map(|page| {
        let (unneeded, lost): (Vec<TopicDrop<'_>>, Vec<TopicDrop<'_>>) =
            drops(page).into_iter().partition(TopicDrop::is_unneeded);
        let lost = (!lost.is_empty()).then(|| {
            finding(
                ("D034", Warning),
                described_drops(page, &lost, &names),
                "dropped samples do not reach the other side",
                format!(
                    "docs/running.md explains each reason; `curl {}/status` shows all counters",
                    page.url
                ),
            )
        });
        let unneeded = (!unneeded.is_empty()).then(|| {
            finding(
                ("D034", Note),
                described_drops(page, &unneeded, &names),
                "no node subscribed to these events, or the first sample waited for its type",
                "nothing, if no node needs these samples",
            )
        });
        lost.into_iter().chain(unneeded)
    });
    each.collect()
}

/// Samples that a program dropped for one reason.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct TopicDrop<'a> {
    count: u64,
    /// The topic, or `others`.
    topic: &'a str,
    reason: &'a str,
}

impl TopicDrop<'_> {
    /// Returns true for events without a subscriber, and for the first sample of a topic, which
    /// waited for its type.
    fn is_unneeded(&self) -> bool {
        match self.reason {
            "no_subscriber" => true,
            "untyped" => self.count == 1,
            _ => false,
        }
    }
}

/// Returns the unintended drops of a program, the highest count first.
fn drops(page: &StatusPage) -> Vec<TopicDrop<'_>> {
    let topics = page.topics.iter().map(|(topic, of)| (topic.as_str(), of));
    let all = topics.chain([("others", &page.others)]);
    let mut drops: Vec<TopicDrop<'_>> = all
        .flat_map(|(topic, of)| {
            of.dropped.iter().map(move |(reason, count)| TopicDrop {
                count: *count,
                topic,
                reason,
            })
        })
        .filter(|drop| drop.count > 0 && !is_intended_drop(drop.reason))
        .collect();
    drops.sort_by(|a, b| b.cmp(a));
    drops
}

fn described_drops(
    page: &StatusPage,
    drops: &[TopicDrop<'_>],
    names: &BTreeMap<&str, &str>,
) -> String {
    let total: u64 = drops.iter().map(|drop| drop.count).sum();
    let samples = if total == 1 { "sample" } else { "samples" };
    let most = drops.iter().take(3).map(|drop| {
        let topic = called(names.get(drop.topic).copied(), drop.topic);
        format!("{} of {topic} ({})", drop.count, drop.reason)
    });
    let most: Vec<String> = most.collect();
    let most = most.join(", ");
    format!("{} dropped {total} {samples}: {most}", page.label())
}

pub(super) fn not_ready(facts: &CellFacts) -> Vec<DoctorFinding> {
    let each = facts.pages.iter().flat_map(|page| {
        let reasons = page
            .not_ready
            .iter()
            .map(|why| (Error, "is not ready", why));
        let waiting = page
            .waiting_for
            .iter()
            .map(|why| (Warning, "waits for", why));
        reasons.chain(waiting).map(|(severity, how, why)| {
            let (what, remedy) = match severity {
                Error => (
                    format!("{} {how}: {why}", page.label()),
                    "remove this cause; the program then continues by itself",
                ),
                Warning | Note => (
                    format!("{} {how} {why}", page.label()),
                    "start or correct this peer, or change its entry in the mapping",
                ),
            };
            finding(
                ("D035", severity),
                what,
                "the values that depend on it do not cross",
                remedy,
            )
        })
    });
    each.collect()
}

pub(super) fn stale_mappings(facts: &CellFacts) -> Vec<DoctorFinding> {
    let each = facts.pages.iter().flat_map(|page| {
        let file = page.mapping.file.as_deref().unwrap_or("the mapping");
        let stale = page.mapping.stale.as_ref().map(|why| {
            finding(
                ("D037", Error),
                format!("{} runs an older mapping than {file}: {why}", page.label()),
                "changes of the saved file have no effect",
                format!("`ua-space check {file}` lists the faults"),
            )
        });
        let restart = page.mapping.restart_needed.as_slice();
        let restart = (!restart.is_empty()).then(|| {
            finding(
                ("D037", Warning),
                format!(
                    "{} needs a restart for: {}",
                    page.label(),
                    restart.join(", ")
                ),
                "these changes of the mapping have no effect yet",
                "restart the program",
            )
        });
        stale.into_iter().chain(restart)
    });
    each.collect()
}

pub(super) fn different_versions(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut by_version: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for page in &facts.pages {
        if let Some(version) = &page.version {
            by_version.entry(version).or_default().push(page.label());
        }
    }
    if by_version.len() < 2 {
        return Vec::new();
    }
    let each = by_version.iter();
    let each: Vec<String> = each
        .map(|(version, programs)| format!("{version} of {}", programs.join(", ")))
        .collect();
    vec![finding(
        ("D036", Warning),
        format!("programs have different versions: {}", each.join("; ")),
        "an older program may not know what a newer one announces",
        "install the same version on all hosts",
    )]
}

pub(super) fn clocks(facts: &CellFacts) -> Vec<DoctorFinding> {
    let each = facts.group.senders.iter().filter_map(|one| {
        // The transport takes less than this; the rest is the difference of the clocks.
        let offset = one.shortest_delay_us;
        let (how, size) = match offset {
            ..-2_000 => ("ahead of", offset.unsigned_abs()),
            250_000.. => ("behind", offset.unsigned_abs()),
            _ => return None,
        };
        let milliseconds = size / 1_000;
        Some(finding(
            ("D040", Warning),
            format!(
                "the clock of {} is about {milliseconds} ms {how} the clock of this host",
                one.from
            ),
            "ages, delays of hops, deadlines of calls and certificates depend on the clocks",
            "synchronise both hosts with chrony or PTP (`chronyc tracking` shows the offset)",
        ))
    });
    each.collect()
}

pub(super) fn descriptors(facts: &CellFacts) -> Vec<DoctorFinding> {
    let full = facts.host.processes.iter().filter_map(|one| {
        let most = one.most_open_files?;
        let open = u64::try_from(one.open_files).unwrap_or(u64::MAX);
        (open.saturating_mul(5) > most.saturating_mul(4)).then(|| {
            finding(
                ("D051", Error),
                format!(
                    "{} (process {}) has {open} of {most} files and sockets open",
                    one.program, one.pid
                ),
                "without descriptors it cannot open further topics or connections",
                "raise LimitNOFILE of its unit, or `ulimit -n`",
            )
        })
    });
    full.collect()
}

pub(super) fn certificates(facts: &CellFacts) -> Vec<DoctorFinding> {
    let today = facts.now / DAY;
    let each = facts.pages.iter().filter_map(|page| {
        let certificate = page.certificate.as_ref()?;
        let until = day_number(&certificate.until)?;
        let left = i64::try_from(until).ok()? - i64::try_from(today).ok()?;
        let (severity, when) = match left {
            ..0 => (Error, "expired".to_owned()),
            0..DAYS_LEFT => (Warning, format!("expires in {left} days")),
            _ => return None,
        };
        Some(finding(
            ("D060", severity),
            format!(
                "the certificate of {} {when} ({})",
                page.label(),
                certificate.until
            ),
            "peers refuse connections with an expired certificate",
            "renew it with `ua-server renew --pki DIR`, where DIR is its certificate store, and \
             restart the program; a GDS renews the certificates that it issued",
        ))
    });
    each.collect()
}

/// Returns the days from 1970 to a day as `2031-11-25`.
pub(super) fn day_number(text: &str) -> Option<u64> {
    let mut parts = text.split('-').map(|part| part.parse::<u64>().ok());
    let (year, month, day) = (parts.next()??, parts.next()??, parts.next()??);
    if !(1970..=9999).contains(&year) || !(1..=12).contains(&month) || !(1..=31).contains(&day) {
        return None;
    }
    // The year starts in March, so that the leap day is its last day.
    let (year, month) = match month {
        1 | 2 => (year - 1, month + 9),
        _ => (year, month - 3),
    };
    let days = year * 365 + year / 4 - year / 100 + year / 400 + (month * 153 + 2) / 5 + day - 1;
    days.checked_sub(719_468)
}

const MOST_EACH: usize = 10;
pub(super) const DAY: u64 = 86_400;
const DAYS_LEFT: i64 = 30;
