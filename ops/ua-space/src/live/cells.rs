//! `ua-space list --cell 'plant/+'`: the cells that share a broker.

use std::collections::BTreeMap;
use std::io::{self, Write as _};
use std::time::Duration;

use broker::{CellStatus, CellWatch};
use mappings::Broker;
use serde::Serialize;
use tokio::time::{Instant, sleep_until};
use uadp::discovery::ConnectionState;

use super::carrier::{self, NO_BROKER};
use super::text::{TextTable, is_coloured, json};
use crate::arguments::ListArguments;
use crate::exit::CommandFailure;
use crate::report::warn;
use crate::survey::look;

/// Lists the cells with matching prefixes.
pub(super) fn list(arguments: &ListArguments, prefixes: &str) -> Result<(), CommandFailure> {
    // Each `+` is a level of its own.
    let example = prefixes.split('/').map(|level| match level {
        "+" => "any",
        other => other,
    });
    if !Broker::is_prefix(&example.collect::<Vec<_>>().join("/")) {
        return Err(CommandFailure::Usage(format!(
            "--cell {prefixes}: not the prefixes of cells; for example plant/+"
        )));
    }
    look(async {
        let broker = carrier::broker(&arguments.group)?;
        let broker = broker.ok_or_else(|| CommandFailure::Usage(NO_BROKER.to_owned()))?;
        let mut watch = CellWatch::open(&broker, prefixes)
            .map_err(|error| CommandFailure::Usage(format!("MQTT: {error}")))?;
        let known = listen(&mut watch, arguments.seconds).await;
        if known.is_empty() {
            let address = &broker.address;
            return Err(CommandFailure::Unavailable(match watch.lost() {
                Some(why) => format!("waiting for broker {address}: {why}"),
                None => format!("no cell with the prefix {prefixes} reports a status at {address}"),
            }));
        }
        if watch.overflow() > 0 {
            warn("some statuses were lost, because too many arrived at once");
        }
        tell(arguments, known)
    })
}

/// Returns the newest status of each publisher, by cell and PublisherId.
async fn listen(watch: &mut CellWatch, seconds: f64) -> BTreeMap<(String, u16), CellStatus> {
    let end = Instant::now() + Duration::from_secs_f64(seconds);
    let mut known = BTreeMap::new();
    loop {
        let status = tokio::select! {
            () = sleep_until(end) => return known,
            status = watch.next() => status,
        };
        let Some(status) = status else { return known };
        let key = (status.cell.clone(), status.publisher);
        if known.len() < MAX_KNOWN || known.contains_key(&key) {
            known.insert(key, status);
        }
    }
}

fn tell(
    arguments: &ListArguments,
    known: BTreeMap<(String, u16), CellStatus>,
) -> Result<(), CommandFailure> {
    let is_wanted = |publisher: u16| {
        let wanted = arguments.space.map(|space| u16::from(space.get()));
        wanted.is_none_or(|wanted| wanted == publisher)
    };
    let mut cells: Vec<ShownCell> = Vec::new();
    for ((cell, space), status) in known {
        if !is_wanted(space) {
            continue;
        }
        let program = ShownStatus {
            space,
            state: state(&status),
        };
        match cells.last_mut() {
            Some(last) if last.cell == cell => last.programs.push(program),
            _ => cells.push(ShownCell {
                cell,
                programs: vec![program],
            }),
        }
    }
    let mut out = io::stdout().lock();
    if arguments.json {
        writeln!(out, "{}", json(&ShownCells { cells })?)?;
        return Ok(());
    }
    let mut table = TextTable::new(["CELL", "SPACE", "STATE"].map(str::to_owned));
    for ShownCell { cell, programs } in &cells {
        for ShownStatus { space, state } in programs {
            table.row([cell.clone(), space.to_string(), (*state).to_owned()]);
        }
    }
    table.write(&mut out, is_coloured())?;
    Ok(())
}

/// Returns the name of a state; the publisher of an overdue status is lost.
fn state(status: &CellStatus) -> &'static str {
    match status.state {
        _ if status.is_overdue => "lost",
        ConnectionState::OPERATIONAL => "operational",
        ConnectionState::DISABLED => "disabled",
        ConnectionState::PAUSED => "paused",
        ConnectionState::ERROR => "error",
        _ => "pre-operational",
    }
}

#[derive(Serialize)]
struct ShownCells {
    cells: Vec<ShownCell>,
}

#[derive(Serialize)]
struct ShownCell {
    cell: String,
    programs: Vec<ShownStatus>,
}

#[derive(Serialize)]
struct ShownStatus {
    space: u16,
    state: &'static str,
}

/// The most publishers that are listed.
const MAX_KNOWN: usize = 100_000;
