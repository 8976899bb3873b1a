//! `ua-space status`: shows all programs of the cell, whether they are ready, and what they wait
//! for.

use std::collections::BTreeSet;
use std::io::{self, Write as _};
use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use serde::Serialize;

use super::pages::{self, RedundancyPage, RedundantPeerPage, StatusPage};
use super::processes::{self, LocalProcess};
use crate::arguments::{GroupArguments, StatusArguments};
use crate::exit::CommandFailure;
use crate::live::{
    AnnouncedProgram, TextTable, harmless, in_the_group, is_coloured, json, wrapped,
};
use crate::report::warn;
use crate::survey::look;

/// Runs `ua-space status`.
pub(crate) fn status(arguments: &StatusArguments) -> Result<(), CommandFailure> {
    let found = look(find(&arguments.urls, &arguments.group, arguments.seconds))?;
    let programs = programs(&found);
    let mut out = io::stdout().lock();
    if arguments.json {
        writeln!(
            out,
            "{}",
            json(&ProgramJson {
                programs: &programs
            })?
        )?;
    } else if !programs.is_empty() {
        table(&programs).write(&mut out, is_coloured())?;
        for line in programs.iter().flat_map(ListedProgram::reasons) {
            write!(out, "{line}")?;
        }
        write!(out, "{}", without_status(&programs).unwrap_or_default())?;
    }
    out.flush()?;
    let unready = programs
        .iter()
        .filter(|one| one.state == ProgramCondition::NotReady)
        .count();
    match (programs.len(), unready) {
        (0, _) => Err(CommandFailure::Unavailable(NOBODY.to_owned())),
        (_, 0) => Ok(()),
        (all, 1) => Err(CommandFailure::Failed(format!(
            "1 of {all} programs is not ready"
        ))),
        (all, some) => Err(CommandFailure::Failed(format!(
            "{some} of {all} programs are not ready"
        ))),
    }
}

/// The programs on this host, at the given URLs and in the group.
pub(super) struct CellOverview {
    pub(super) processes: Vec<LocalProcess>,
    pub(super) pages: Vec<StatusPage>,
    /// Announced applications: space, sender and description.
    pub(super) applications: Vec<(u16, SocketAddr, AnnouncedProgram)>,
    pub(super) own_addresses: BTreeSet<IpAddr>,
}

async fn find(
    urls: &[String],
    group: &GroupArguments,
    seconds: f64,
) -> Result<CellOverview, CommandFailure> {
    let (processes, _) = processes::read(Path::new("/"));
    let (pages, heard) = tokio::join!(all_pages(&processes, urls), in_the_group(group, seconds));
    let applications = match heard {
        Ok((heard, ())) => applications(heard.applications),
        Err(failure) => {
            warn(&format!("the group is not heard: {failure}"));
            Vec::new()
        }
    };
    Ok(CellOverview {
        processes,
        pages,
        applications,
        own_addresses: own_addresses(),
    })
}

/// Returns the pages of the processes of this host and of the URLs. A URL without an answer is
/// reported.
pub(super) async fn all_pages(processes: &[LocalProcess], urls: &[String]) -> Vec<StatusPage> {
    let mut pages = pages::of_processes(processes).await;
    for url in urls {
        match pages::of_url(url).await {
            Ok(found) => {
                let is_new = |one: &StatusPage| {
                    !pages.iter().any(|known| {
                        known.url.trim_start_matches("http://")
                            == one.url.trim_start_matches("http://")
                    })
                };
                let new: Vec<StatusPage> = found.into_iter().filter(is_new).collect();
                pages.extend(new);
            }
            Err(failure) => {
                warn(&failure.to_string());
                pages.push(StatusPage {
                    program: "?".to_owned(),
                    not_ready: vec![format!("no status at {url}")],
                    url: url.clone(),
                    ..StatusPage::default()
                });
            }
        }
    }
    pages
}

pub(super) fn applications(
    heard: impl IntoIterator<Item = ((u16, String), AnnouncedProgram)>,
) -> Vec<(u16, SocketAddr, AnnouncedProgram)> {
    let all = heard.into_iter();
    all.filter_map(|((space, from), one)| Some((space, from.parse().ok()?, one)))
        .collect()
}

pub(super) fn own_addresses() -> BTreeSet<IpAddr> {
    let interfaces = transport::interfaces().unwrap_or_default();
    interfaces
        .into_iter()
        .map(|interface| IpAddr::V4(interface.address))
        .collect()
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum ProgramCondition {
    Ready,
    NotReady,
    /// It runs on this host without a status page.
    Running,
    /// It is known by its announcement in the group only.
    Announced,
}

/// A program in a space.
#[derive(Debug, Serialize)]
struct ListedProgram {
    program: String,
    space: Option<u16>,
    state: ProgramCondition,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    not_ready: Vec<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    waiting_for: Vec<String>,
    version: Option<String>,
    uptime_s: Option<u64>,
    mapping_file: Option<String>,
    mapping_hash: Option<String>,
    /// The URL of its status, or its address in the group.
    address: Option<String>,
    pid: Option<u32>,
    /// The role of a redundant bridge.
    #[serde(skip_serializing_if = "Option::is_none")]
    redundancy: Option<RedundancyPage>,
}

#[derive(Serialize)]
struct ProgramJson<'a> {
    programs: &'a [ListedProgram],
}

fn programs(cell: &CellOverview) -> Vec<ListedProgram> {
    let mut all: Vec<ListedProgram> = cell.pages.iter().map(of_page).collect();
    let mut local = BTreeSet::new();
    for process in &cell.processes {
        let has_page = cell.pages.iter().any(|page| page.pid == Some(process.pid));
        let announced = cell.applications.iter().filter(|(_, from, _)| {
            let is_here = cell.own_addresses.contains(&from.ip());
            is_here && process.udp.iter().any(|own| own.port() == from.port())
        });
        let mut spaces = BTreeSet::new();
        for (space, from, _) in announced {
            local.insert((*space, *from));
            spaces.insert(*space);
        }
        if has_page {
            continue;
        }
        let spaces: Vec<Option<u16>> = if spaces.is_empty() {
            vec![None]
        } else {
            spaces.into_iter().map(Some).collect()
        };
        all.extend(spaces.into_iter().map(|space| of_process(process, space)));
    }
    for (space, from, application) in &cell.applications {
        if !local.contains(&(*space, *from)) {
            all.push(of_application((*space, *from), application));
        }
    }
    all.sort_by(|a, b| (a.space, &a.program, &a.address).cmp(&(b.space, &b.program, &b.address)));
    all
}

fn of_page(page: &StatusPage) -> ListedProgram {
    let has_mapping = !page.mapping.hash.is_empty();
    let mut not_ready = page.not_ready.clone();
    // A mapping that cannot run is no reason for /readyz, because the previous mapping runs.
    let mut waiting_for = page.waiting_for.clone();
    if let Some(stale) = &page.mapping.stale {
        waiting_for.push(format!("a mapping that can run: {stale}"));
    }
    not_ready.retain(|reason| !reason.is_empty());
    ListedProgram {
        program: page.program.clone(),
        space: Some(page.space.into()),
        state: if not_ready.is_empty() {
            ProgramCondition::Ready
        } else {
            ProgramCondition::NotReady
        },
        not_ready,
        waiting_for,
        version: page.version.clone(),
        uptime_s: page.uptime_s,
        mapping_file: page.mapping.file.clone(),
        mapping_hash: has_mapping.then(|| page.mapping.hash.clone()),
        address: Some(page.url.clone()),
        pid: page.pid,
        redundancy: page.redundancy.clone(),
    }
}

fn of_process(process: &LocalProcess, space: Option<u16>) -> ListedProgram {
    ListedProgram {
        program: process.program.clone(),
        space,
        state: ProgramCondition::Running,
        not_ready: Vec::new(),
        waiting_for: Vec::new(),
        version: None,
        uptime_s: process.uptime_s,
        mapping_file: None,
        mapping_hash: None,
        address: None,
        pid: Some(process.pid),
        redundancy: None,
    }
}

fn of_application(
    (space, from): (u16, SocketAddr),
    application: &AnnouncedProgram,
) -> ListedProgram {
    let name = match application.name.as_str() {
        "" => &application.uri,
        name => name,
    };
    ListedProgram {
        program: name.to_owned(),
        space: Some(space),
        state: ProgramCondition::Announced,
        not_ready: Vec::new(),
        waiting_for: Vec::new(),
        version: None,
        uptime_s: None,
        mapping_file: None,
        mapping_hash: None,
        address: Some(from.to_string()),
        pid: None,
        redundancy: None,
    }
}

impl ListedProgram {
    const fn word(&self) -> &'static str {
        match self.state {
            ProgramCondition::Ready if self.waiting_for.is_empty() => "ready",
            ProgramCondition::Ready => "ready, waiting",
            ProgramCondition::NotReady => "NOT READY",
            ProgramCondition::Running => "running",
            ProgramCondition::Announced => "announced",
        }
    }

    /// Returns the state. A ready redundant bridge has its role, which matters more than the peers
    /// for which it waits.
    fn state_text(&self) -> String {
        match (&self.redundancy, self.state) {
            (Some(redundancy), ProgramCondition::Ready) => format!("ready, {}", redundancy.role),
            (
                Some(redundancy),
                ProgramCondition::NotReady
                | ProgramCondition::Running
                | ProgramCondition::Announced,
            ) => {
                format!("{}, {}", self.word(), redundancy.role)
            }
            (None, _) => self.word().to_owned(),
        }
    }

    /// Returns a line for each reason and each missing peer, and a line about the redundancy.
    fn reasons(&self) -> Vec<String> {
        let space = self.space.map(|space| format!(" (space {space})"));
        let program = format!("{}{}", self.program, space.unwrap_or_default());
        let not_ready = self.not_ready.iter().map(|why| format!("not ready: {why}"));
        let waiting = self
            .waiting_for
            .iter()
            .map(|peer| format!("waiting for {peer}"));
        let redundancy = self.redundancy.iter().map(role_and_peers);
        let lines = not_ready.chain(waiting).chain(redundancy);
        lines
            .map(|line| wrapped(&format!("  {}: ", harmless(&program)), &harmless(&line)))
            .collect()
    }
}

/// Returns a line about the programs of this host without a status page.
fn without_status(programs: &[ListedProgram]) -> Option<String> {
    let silent = programs
        .iter()
        .filter(|one| one.state == ProgramCondition::Running);
    let names: BTreeSet<&str> = silent.map(|one| one.program.as_str()).collect();
    let names: Vec<&str> = names.into_iter().collect();
    (!names.is_empty()).then(|| {
        let text = format!(
            "no status of {}: start them with --metrics 127.0.0.1:PORT to see more",
            names.join(", ")
        );
        wrapped("  ", &harmless(&text))
    })
}

/// Describes the role of a redundant bridge.
fn role_and_peers(redundancy: &RedundancyPage) -> String {
    let RedundancyPage {
        role,
        rank,
        epoch,
        cut_off,
        rivals,
        last_takeover,
        peers,
    } = redundancy;
    let mut text = format!("{role}, rank {rank}, epoch {epoch}");
    if *cut_off {
        text.push_str(", the group is out of reach");
    }
    for peer in peers {
        let RedundantPeerPage {
            rank,
            role,
            address,
            age_ms,
        } = peer;
        text.push_str(&match age_ms {
            0..1_000 => format!("; rank {rank} at {address} is {role}"),
            _ => format!("; rank {rank} at {address} is lost"),
        });
    }
    if peers.is_empty() {
        text.push_str("; no other bridge of the space: nothing takes over");
    }
    if let Some(last) = last_takeover {
        let ago = uptime(last.seconds_ago);
        let became = match role.as_str() {
            "active" => "became active",
            _ => "was last made active",
        };
        text.push_str(&format!("; {became} {ago} ago, because {}", last.reason));
    }
    if *rivals > 0 {
        text.push_str(&format!("; {rivals} times with another active bridge"));
    }
    text
}

const HEAD: [&str; 7] = [
    "PROGRAM", "SPACE", "STATE", "VERSION", "UPTIME", "MAPPING", "WHERE",
];

fn table(programs: &[ListedProgram]) -> TextTable {
    let mut table = TextTable::new(HEAD.map(str::to_owned)).yielding([6, 0]);
    for one in programs {
        let dash = || "-".to_owned();
        let hash = one.mapping_hash.as_deref();
        let hash = hash.map(|hash| hash.chars().take(8).collect::<String>());
        table.row([
            one.program.clone(),
            one.space.map_or_else(dash, |space| space.to_string()),
            one.state_text(),
            one.version.clone().unwrap_or_else(dash),
            one.uptime_s.map_or_else(dash, uptime),
            hash.unwrap_or_else(dash),
            one.address.as_deref().map_or_else(dash, without_scheme),
        ]);
    }
    table
}

/// Returns an address of a status page without the scheme that all of them have.
fn without_scheme(address: &str) -> String {
    let short = address.strip_prefix("http://").unwrap_or(address);
    short.trim_end_matches('/').to_owned()
}

/// Formats a time as `42 s`, `12 min`, `3 h 5 min` or `2 d 4 h`.
pub(super) fn uptime(seconds: u64) -> String {
    match seconds {
        0..120 => format!("{seconds} s"),
        120..7_200 => format!("{} min", seconds / 60),
        7_200..172_800 => format!("{} h {} min", seconds / 3_600, seconds % 3_600 / 60),
        _ => format!("{} d {} h", seconds / 86_400, seconds % 86_400 / 3_600),
    }
}

const NOBODY: &str = "no program of a cell runs on this host or announces itself in the group\n  \
                      = help: is this the group and the interface (--address, --interface)? \
                      `ua-space doctor` looks for faults";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::pages::TakeoverPage;

    fn application(name: &str) -> AnnouncedProgram {
        AnnouncedProgram {
            uri: format!("urn:{name}"),
            product_uri: String::new(),
            name: name.to_owned(),
            urls: Vec::new(),
            capabilities: Vec::new(),
        }
    }

    #[test]
    fn a_program_is_listed_once_whatever_is_known_of_it() {
        let here: IpAddr = "10.0.0.1".parse().unwrap();
        let process = |pid, program: &str, port| LocalProcess {
            pid,
            program: program.to_owned(),
            udp: vec![SocketAddr::new(here, port)],
            ..LocalProcess::default()
        };
        let page = StatusPage {
            program: "bridge-ros1".to_owned(),
            space: 1,
            not_ready: vec!["no ROS master".to_owned()],
            pid: Some(7),
            ..StatusPage::default()
        };
        let at = |ip: &str, port: u16| SocketAddr::new(ip.parse().unwrap(), port);
        let cell = CellOverview {
            processes: vec![
                process(7, "bridge-ros1", 1000),
                process(8, "bridge-ros2", 2000),
            ],
            pages: vec![page],
            applications: vec![
                (1, at("10.0.0.1", 1000), application("bridge-ros1")),
                (2, at("10.0.0.1", 2000), application("bridge-ros2")),
                (3, at("10.0.0.9", 2000), application("bridge-ros2 on other")),
            ],
            own_addresses: BTreeSet::from([here]),
        };
        let all = programs(&cell);
        let shown: Vec<_> = all.iter().map(|one| (one.space, one.word())).collect();
        assert_eq!(
            shown,
            [
                (Some(1), "NOT READY"),
                (Some(2), "running"),
                (Some(3), "announced")
            ]
        );
        let reasons = all[0].reasons();
        assert_eq!(
            reasons,
            ["  bridge-ros1 (space 1): not ready: no ROS master\n"]
        );
        let line = without_status(&all).unwrap();
        assert!(line.contains("no status of bridge-ros2: "), "{line}");
    }

    #[test]
    fn a_redundant_bridge_is_shown_with_its_role_and_peers() {
        let peer = |rank, role: &str, age_ms| RedundantPeerPage {
            rank,
            role: role.to_owned(),
            address: format!("10.0.0.{rank}:4000"),
            age_ms,
        };
        let page = StatusPage {
            program: "bridge-ros1".to_owned(),
            space: 1,
            redundancy: Some(RedundancyPage {
                role: "active".to_owned(),
                rank: 1,
                epoch: 3,
                last_takeover: Some(TakeoverPage {
                    reason: "the active bridge was lost".to_owned(),
                    seconds_ago: 5,
                }),
                peers: vec![peer(2, "standby", 12), peer(3, "standby", 4_000)],
                ..RedundancyPage::default()
            }),
            ..StatusPage::default()
        };
        let shown = of_page(&page);
        assert_eq!(shown.state_text(), "ready, active");
        let line = one_line(&shown.reasons());
        assert_eq!(
            line,
            "bridge-ros1 (space 1): active, rank 1, epoch 3; rank 2 at 10.0.0.2:4000 is standby; rank 3 at \
             10.0.0.3:4000 is lost; became active 5 s ago, because the active bridge was lost"
        );
    }

    fn one_line(lines: &[String]) -> String {
        let text = lines.concat();
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn a_standby_shows_its_role_while_it_waits_and_when_it_was_active() {
        let shown = of_page(&StatusPage {
            program: "bridge-ros1".to_owned(),
            space: 1,
            waiting_for: vec!["space 2".to_owned()],
            redundancy: Some(RedundancyPage {
                role: "standby".to_owned(),
                last_takeover: Some(TakeoverPage {
                    reason: "the active bridge was lost".to_owned(),
                    seconds_ago: 9,
                }),
                ..RedundancyPage::default()
            }),
            ..StatusPage::default()
        });
        assert_eq!(shown.state_text(), "ready, standby");
        let line = one_line(&shown.reasons());
        assert!(line.contains("waiting for space 2"), "{line}");
        assert!(
            line.ends_with("was last made active 9 s ago, because the active bridge was lost"),
            "{line}"
        );
    }

    #[test]
    fn an_uptime_is_shown_in_two_units() {
        let shown = [5, 130, 7_500, 200_000].map(uptime);
        assert_eq!(shown, ["5 s", "2 min", "2 h 5 min", "2 d 7 h"]);
    }
}
