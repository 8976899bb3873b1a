//! The printed output of a scenario: its timeline, and its report at the end.

use std::io::{self, Write as _};

use serde::Serialize;

use super::{Failure, Timeline, Who};
use crate::clock::{millis, wall_nanos};

/// Prints the events of a scenario, and its report at the end.
pub(crate) struct Show {
    timeline: Timeline,
    began_at: i64,
    json: bool,
}

/// A report as JSON: the outcome, then the fields of the report.
#[derive(Serialize)]
struct Ended<'a, R> {
    finished: bool,
    failure: Option<String>,
    #[serde(flatten)]
    report: &'a R,
}

impl Show {
    /// Begins the timeline. With `json`, standard output is for the report.
    pub(crate) fn open(json: bool) -> Self {
        Self {
            timeline: Timeline::open(json),
            began_at: wall_nanos(),
            json,
        }
    }

    /// Prints text unchanged.
    pub(crate) fn text(&mut self, text: &str) -> Result<(), Failure> {
        let printed = self.timeline.print_text(text);
        printed.map_err(Failure::io("cannot print"))
    }

    /// Prints an event.
    pub(crate) fn note(&mut self, who: Who, what: String) -> Result<(), Failure> {
        self.timeline.note(wall_nanos(), who, what);
        let began_at = self.began_at;
        let seconds = |at_ns: i64| Some(millis(at_ns - began_at) / 1e3);
        let printed = self.timeline.print_all(&seconds);
        printed.map_err(Failure::io("cannot print"))
    }

    /// Prints the report: its table for people, and JSON if requested. Returns the exit code.
    pub(crate) fn conclude<R: Serialize>(
        mut self,
        outcome: &Result<(), Failure>,
        report: &R,
        table: &str,
    ) -> u8 {
        let printed = self.print(outcome, report, table);
        match (outcome, printed) {
            (Err(failure), _) => failure.exit_code(),
            // Standard output is closed, for example by `| head`.
            (Ok(()), Err(_)) => 74,
            (Ok(()), Ok(())) => 0,
        }
    }

    fn print<R: Serialize>(
        &mut self,
        outcome: &Result<(), Failure>,
        report: &R,
        table: &str,
    ) -> io::Result<()> {
        let failure = outcome.as_ref().err().map(ToString::to_string);
        self.timeline.print_text(table)?;
        if let Some(failure) = &failure {
            self.timeline.print_text(&format!("error: {failure}\n"))?;
        }
        if self.json {
            let ended = Ended {
                finished: failure.is_none(),
                failure,
                report,
            };
            let mut out = io::stdout().lock();
            serde_json::to_writer(&mut out, &ended)?;
            out.write_all(b"\n")?;
            out.flush()?;
        }
        Ok(())
    }
}
