//! `ua-space discover`: lists the programs and servers of the network.

mod around;
mod entry;

use std::io::{self, Write as _};

use crate::arguments::Discover;
use crate::exit::CommandFailure;
use crate::live::{TextTable, is_coloured};
use crate::survey::look;

pub(crate) use around::{around, around_and};
pub(crate) use entry::{DiscoveredEntry, DiscoveredKind, EntryJson};

pub(crate) fn discover(arguments: &Discover) -> Result<(), CommandFailure> {
    let found = look(around(&arguments.look))?;
    let mut out = io::stdout().lock();
    if arguments.json {
        let shown: Vec<_> = found.entries.iter().map(DiscoveredEntry::shown).collect();
        writeln!(out, "{}", crate::live::json(&shown)?)?;
        return Ok(out.flush()?);
    }
    if found.entries.is_empty() {
        writeln!(out, "no program was found")?;
    } else {
        table(&found.entries).write(&mut out, is_coloured())?;
    }
    if let Some(tried) = found.tried {
        writeln!(out, "{tried} addresses were tried")?;
    }
    Ok(out.flush()?)
}

const HEAD: [&str; 7] = [
    "KIND",
    "NAME",
    "URL",
    "FOUND BY",
    "CAPABILITIES",
    "SECURITY",
    "URI",
];

fn table(entries: &[DiscoveredEntry]) -> TextTable {
    let mut table = TextTable::new(HEAD.map(str::to_owned))
        .yielding([5, 2])
        .leaving_out([6, 4, 3]);
    let dash = |text: String| {
        if text.is_empty() {
            "-".to_owned()
        } else {
            text
        }
    };
    for entry in entries {
        let shown = entry.shown();
        let security = match &entry.fault {
            Some(fault) => fault.clone(),
            None => entry.security.join(" "),
        };
        table.row([
            shown.kind.to_owned(),
            dash(entry.name.clone()),
            dash(entry.urls.join(" ")),
            shown.found_by.join(" "),
            dash(shown.capabilities.join(" ")),
            dash(security),
            dash(entry.uri.clone()),
        ]);
    }
    table
}
