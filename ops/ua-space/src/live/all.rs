//! `ua-space list`: lists the spaces, their programs, topics and calls.

use std::collections::BTreeMap;
use std::io::{self, Write as _};

use mappings::SpaceId;
use serde::Serialize;

use super::list::{self, ListRow, lines, origin};
use super::prober::FIRST_ASKED;
use super::text::{TextTable, is_coloured, json};
use super::{Go, InGroup, Live, until};
use crate::arguments::{DiscoverArguments, GroupArguments, ListArguments};
use crate::discover::{DiscoveredEntry, DiscoveredKind, around_and};
use crate::exit::CommandFailure;
use crate::survey::look;

/// Runs `ua-space list`.
pub(crate) fn list(arguments: &ListArguments) -> Result<(), CommandFailure> {
    if let Some(cells) = arguments.group.cell.as_deref()
        && cells.contains('+')
    {
        return super::cells::list(arguments, cells);
    }
    look(async {
        let (programs, mut groups) = found(arguments).await?;
        let elsewhere = elsewhere(arguments, &programs);
        for address in elsewhere {
            // The group that a bridge announced.
            let group = GroupArguments {
                address: Some(format!("opc.udp://{address}")),
                ..arguments.group.clone()
            };
            groups.push(heard(arguments, &group).await?.1);
        }
        tell(arguments, &programs, &groups)
    })
}

/// Returns the discovered programs, and the contents of the group.
async fn found(
    arguments: &ListArguments,
) -> Result<(Vec<DiscoveredEntry>, Vec<Live>), CommandFailure> {
    let hearing = heard(arguments, &arguments.group);
    if arguments.topics {
        return Ok((Vec::new(), vec![hearing.await?.1]));
    }
    let look = DiscoverArguments {
        seconds: arguments.seconds,
        group: arguments.group.clone(),
        ..DiscoverArguments::default()
    };
    let (around, live) = around_and(&look, hearing).await?;
    Ok((around.entries, vec![live?]))
}

async fn heard(
    arguments: &ListArguments,
    group: &GroupArguments,
) -> Result<(InGroup, Live), CommandFailure> {
    let mut live = Live::join(group)?;
    let end = until(live.now(), Some(arguments.seconds));
    if !arguments.topics {
        live.want_all();
    }
    live.want_calls(
        FIRST_ASKED
            .into_iter()
            .chain(arguments.space.map(u16::from)),
    );
    live.listen(end, &mut |_, _| Go::On).await?;
    Ok((live.who(), live))
}

/// Returns the other groups that bridges announce, unless a group was given.
fn elsewhere(arguments: &ListArguments, programs: &[DiscoveredEntry]) -> Vec<String> {
    if arguments.group.address.is_some() || arguments.group.broker.is_some() {
        return Vec::new();
    }
    let here = mappings::PubSub::ADDRESS.to_string();
    let mut groups: Vec<String> = programs
        .iter()
        .filter_map(|one| one.group.clone())
        .collect();
    groups.sort();
    groups.dedup();
    groups.retain(|group| *group != here);
    groups.truncate(MOST_GROUPS);
    groups
}

/// A space with its programs.
#[derive(Serialize)]
struct Space<'p> {
    space: u8,
    origin: &'static str,
    topics: usize,
    calls: usize,
    programs: Vec<&'p str>,
}

#[derive(Serialize)]
struct All<'a> {
    spaces: Vec<Space<'a>>,
    bridges: Vec<crate::discover::EntryJson<'a>>,
    servers: Vec<crate::discover::EntryJson<'a>>,
    components: Vec<crate::discover::EntryJson<'a>>,
    topics: Vec<Placed<'a>>,
}

/// A topic with the group in which it was received.
#[derive(Serialize)]
struct Placed<'a> {
    #[serde(flatten)]
    shown: list::ListJson<'a>,
    group: String,
}

fn tell(
    arguments: &ListArguments,
    programs: &[DiscoveredEntry],
    groups: &[Live],
) -> Result<(), CommandFailure> {
    let is_wanted = |space: SpaceId| arguments.space.is_none_or(|wanted| wanted == space);
    let mut found: Vec<(String, ListRow<'_>)> = Vec::new();
    for live in groups {
        let group = live.group().to_string();
        let lines = lines(&live.book, live.now()).into_iter();
        let wanted = lines.filter(|line| is_wanted(line.topic.space));
        found.extend(wanted.map(|line| (group.clone(), line)));
    }
    let wanted = |one: &&DiscoveredEntry| {
        arguments
            .space
            .is_none_or(|wanted| one.space == Some(wanted.into()))
    };
    let programs: Vec<&DiscoveredEntry> = programs.iter().filter(wanted).collect();
    let spaces = spaces(&programs, &found);
    let mut out = io::stdout().lock();
    if arguments.json {
        let of = |kinds: &[DiscoveredKind]| {
            let those = programs.iter().filter(|one| kinds.contains(&one.kind));
            those.map(|one| one.shown()).collect()
        };
        let all = All {
            bridges: of(&[DiscoveredKind::Bridge]),
            servers: of(&[
                DiscoveredKind::Lds,
                DiscoveredKind::Cell,
                DiscoveredKind::Server,
            ]),
            components: of(&[DiscoveredKind::Component]),
            spaces,
            topics: found
                .iter()
                .map(|(group, line)| Placed {
                    shown: line.shown(),
                    group: group.clone(),
                })
                .collect(),
        };
        writeln!(out, "{}", json(&all)?)?;
    } else {
        print(arguments, (&spaces, &programs, &found), &mut out)?;
        if found.is_empty() {
            let groups: Vec<String> = groups.iter().map(|live| live.group().to_string()).collect();
            let (groups, seconds) = (groups.join(", "), arguments.seconds);
            writeln!(out, "nothing was heard in {groups} for {seconds} s")?;
        }
    }
    for live in groups {
        live.tell_dropped();
    }
    Ok(())
}

fn print(
    arguments: &ListArguments,
    (spaces, programs, found): (&[Space<'_>], &[&DiscoveredEntry], &[(String, ListRow<'_>)]),
    out: &mut impl io::Write,
) -> Result<(), CommandFailure> {
    let bold = is_coloured();
    if !arguments.topics {
        if !spaces.is_empty() {
            table_of_spaces(spaces).write(out, bold)?;
            writeln!(out)?;
        }
        if !programs.is_empty() {
            table_of_programs(programs).write(out, bold)?;
            writeln!(out)?;
        }
    }
    if !found.is_empty() {
        let lines: Vec<&ListRow<'_>> = found.iter().map(|(_, line)| line).collect();
        list::table(&lines).write(out, bold)?;
    }
    Ok(())
}

fn spaces<'p>(programs: &[&'p DiscoveredEntry], found: &[(String, ListRow<'_>)]) -> Vec<Space<'p>> {
    let mut spaces: BTreeMap<u8, Space<'p>> = BTreeMap::new();
    let known = programs.iter().filter_map(|one| SpaceId::new(one.space?));
    let all = found.iter().map(|(_, line)| line.topic.space).chain(known);
    for space in all {
        spaces.entry(space.get()).or_insert_with(|| Space {
            space: space.get(),
            origin: origin(space),
            topics: 0,
            calls: 0,
            programs: Vec::new(),
        });
    }
    for (_, line) in found {
        if let Some(space) = spaces.get_mut(&line.topic.space.get()) {
            match line.is_call {
                true => space.calls += 1,
                false => space.topics += 1,
            }
        }
    }
    for one in programs {
        let of = one.space.and_then(|space| u8::try_from(space).ok());
        if let Some(space) = of.and_then(|space| spaces.get_mut(&space)) {
            space.programs.push(&one.name);
        }
    }
    spaces.into_values().collect()
}

fn table_of_spaces(spaces: &[Space<'_>]) -> TextTable {
    let head = ["SPACE", "ORIGIN", "TOPICS", "CALLS", "PROGRAMS"];
    let mut table = TextTable::new(head.map(str::to_owned));
    for space in spaces {
        table.row([
            space.space.to_string(),
            space.origin.to_owned(),
            space.topics.to_string(),
            space.calls.to_string(),
            or_dash(space.programs.join(", ")),
        ]);
    }
    table
}

fn table_of_programs(programs: &[&DiscoveredEntry]) -> TextTable {
    let head = [
        "KIND",
        "NAME",
        "WHERE",
        "SPACE",
        "FOUND BY",
        "CAPABILITIES",
        "URI",
    ];
    let mut table = TextTable::new(head.map(str::to_owned))
        .yielding([2])
        .leaving_out([6, 5, 4]);
    for one in programs {
        let shown = one.shown();
        let space = one.space.map(|space| space.to_string());
        table.row([
            shown.kind.to_owned(),
            or_dash(one.name.clone()),
            or_dash(one.urls.join(" ")),
            or_dash(space.unwrap_or_default()),
            shown.found_by.join(" "),
            or_dash(shown.capabilities.join(" ")),
            or_dash(one.uri.clone()),
        ]);
    }
    table
}

fn or_dash(text: String) -> String {
    match text.is_empty() {
        true => "-".to_owned(),
        false => text,
    }
}

/// Maximum number of further groups, because any host of the network can announce groups.
const MOST_GROUPS: usize = 4;
