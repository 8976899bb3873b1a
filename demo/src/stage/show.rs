//! The printed output of a scenario: its timeline, and its report at the end.

use std::io;

use serde::Serialize;

use super::{DemoFailure, EventPrinter, EventSource, exit_code};
use crate::clock::{millis, wall_nanos};

/// Prints the events of a scenario, and its report at the end.
pub(crate) struct Show {
    timeline: EventPrinter,
    began_at: i64,
    json: bool,
}

/// A report as JSON: the outcome, then the fields of the report.
#[derive(Serialize)]
struct Ended<'a, R> {
    finished: bool,
    failure: Option<&'a str>,
    #[serde(flatten)]
    report: &'a R,
}

impl Show {
    /// Begins the timeline. With `json`, standard output is for the report.
    pub(crate) fn open(json: bool) -> Self {
        Self {
            timeline: EventPrinter::open(json),
            began_at: wall_nanos(),
            json,
        }
    }

    /// Prints text unchanged.
    pub(crate) fn text(&mut self, text: &str) -> Result<(), DemoFailure> {
        let printed = self.timeline.print_text(text);
        printed.map_err(DemoFailure::io("cannot print"))
    }

    /// Prints an event.
    pub(crate) fn note(&mut self, who: EventSource, what: String) -> Result<(), DemoFailure> {
        self.timeline.note(wall_nanos(), who, what);
        let began_at = self.began_at;
        let seconds = |at_ns: i64| Some(millis(at_ns - began_at) / 1e3);
        let printed = self.timeline.print_all(&seconds);
        printed.map_err(DemoFailure::io("cannot print"))
    }

    /// Prints the report: its table for people, and JSON if requested. Returns the exit code.
    pub(crate) fn conclude<R: Serialize>(
        mut self,
        outcome: &Result<(), DemoFailure>,
        report: &R,
        table: &str,
    ) -> u8 {
        let printed = self.print(outcome, report, table);
        exit_code(outcome, &printed)
    }

    fn print<R: Serialize>(
        &mut self,
        outcome: &Result<(), DemoFailure>,
        report: &R,
        table: &str,
    ) -> io::Result<()> {
        let failure = outcome.as_ref().err().map(ToString::to_string);
        let ended = Ended {
            finished: failure.is_none(),
            failure: failure.as_deref(),
            report,
        };
        let text = failure.as_deref();
        self.timeline
            .conclude(Some(table), text, (&ended, self.json))
    }
}
