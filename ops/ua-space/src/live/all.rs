//! `ua-space list`: lists the spaces, their programs, topics and calls.

use std::collections::BTreeMap;
use std::io::{self, Write as _};

use mappings::SpaceId;
use serde::Serialize;

use super::list::{self, FIRST_ASKED, Line, json, lines, origin};
use super::text::{Table, is_coloured};
use super::{Go, InGroup, Live, until};
use crate::arguments::{Group, List, Look};
use crate::discover::{Entry, Kind, around_and};
use crate::exit::Failure;
use crate::survey::look;

/// Runs `ua-space list`.
pub(crate) fn list(arguments: &List) -> Result<(), Failure> {
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
            let group = Group {
                address: Some(format!("opc.udp://{address}")),
                ..arguments.group.clone()
            };
            groups.push(heard(arguments, &group).await?.1);
        }
        tell(arguments, &programs, &groups)
    })
}

/// Returns the discovered programs, and the contents of the group.
async fn found(arguments: &List) -> Result<(Vec<Entry>, Vec<Live>), Failure> {
    let hearing = heard(arguments, &arguments.group);
    if arguments.topics {
        return Ok((Vec::new(), vec![hearing.await?.1]));
    }
    let look = Look {
        seconds: arguments.seconds,
        group: arguments.group.clone(),
        ..Look::default()
    };
    let (around, live) = around_and(&look, hearing).await?;
    Ok((around.entries, vec![live?]))
}

async fn heard(arguments: &List, group: &Group) -> Result<(InGroup, Live), Failure> {
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
fn elsewhere(arguments: &List, programs: &[Entry]) -> Vec<String> {
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
    bridges: Vec<crate::discover::Shown<'a>>,
    servers: Vec<crate::discover::Shown<'a>>,
    components: Vec<crate::discover::Shown<'a>>,
    topics: Vec<Placed<'a>>,
}

/// A topic with the group in which it was received.
#[derive(Serialize)]
struct Placed<'a> {
    #[serde(flatten)]
    shown: list::Shown<'a>,
    group: String,
}

fn tell(arguments: &List, programs: &[Entry], groups: &[Live]) -> Result<(), Failure> {
    let is_wanted = |space: SpaceId| arguments.space.is_none_or(|wanted| wanted == space);
    let mut found: Vec<(String, Line<'_>)> = Vec::new();
    for live in groups {
        let group = live.group().to_string();
        let lines = lines(&live.book, live.now()).into_iter();
        let wanted = lines.filter(|line| is_wanted(line.topic.space));
        found.extend(wanted.map(|line| (group.clone(), line)));
    }
    let wanted = |one: &&Entry| {
        arguments
            .space
            .is_none_or(|wanted| one.space == Some(wanted.into()))
    };
    let programs: Vec<&Entry> = programs.iter().filter(wanted).collect();
    let spaces = spaces(&programs, &found);
    let mut out = io::stdout().lock();
    if arguments.json {
        let of = |kinds: &[Kind]| {
            let those = programs.iter().filter(|one| kinds.contains(&one.kind));
            those.map(|one| one.shown()).collect()
        };
        let all = All {
            bridges: of(&[Kind::Bridge]),
            servers: of(&[Kind::Lds, Kind::Cell, Kind::Server]),
            components: of(&[Kind::Component]),
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
    arguments: &List,
    (spaces, programs, found): (&[Space<'_>], &[&Entry], &[(String, Line<'_>)]),
    out: &mut impl io::Write,
) -> Result<(), Failure> {
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
        let lines: Vec<&Line<'_>> = found.iter().map(|(_, line)| line).collect();
        list::table(&lines).write(out, bold)?;
    }
    Ok(())
}

fn spaces<'p>(programs: &[&'p Entry], found: &[(String, Line<'_>)]) -> Vec<Space<'p>> {
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

fn table_of_spaces(spaces: &[Space<'_>]) -> Table {
    let head = ["SPACE", "ORIGIN", "TOPICS", "CALLS", "PROGRAMS"];
    let mut table = Table::new(head.map(str::to_owned));
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

fn table_of_programs(programs: &[&Entry]) -> Table {
    let head = [
        "KIND",
        "NAME",
        "WHERE",
        "SPACE",
        "FOUND BY",
        "CAPABILITIES",
        "URI",
    ];
    let mut table = Table::new(head.map(str::to_owned)).yielding([6, 5, 4, 2]);
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
