//! The timeline: a line for each event, in chronological order.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::io::{self, IsTerminal as _, Write};

use serde::Serialize;

/// Prints events. Events are delayed for a short time, so that events of different processes can be
/// sorted.
pub(crate) struct EventPrinter {
    out: Box<dyn Write>,
    colour: bool,
    held: BinaryHeap<Reverse<Entry>>,
    /// Keeps events with the same timestamp in the order of their arrival.
    number: u64,
}

#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct Entry {
    at_ns: i64,
    number: u64,
    who: EventSource,
    what: String,
}

/// The source of an event: its name, and its colour as a code of SGR.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct EventSource(pub(crate) &'static str, pub(crate) &'static str);

impl EventSource {
    pub(crate) const DEMO: Self = Self("demo", "2");
}

impl EventPrinter {
    /// Prints to standard output, or to standard error if standard output is used for JSON.
    pub(crate) fn open(json: bool) -> Self {
        let (out, terminal): (Box<dyn Write>, bool) = if json {
            (Box::new(io::stderr()), io::stderr().is_terminal())
        } else {
            (Box::new(io::stdout()), io::stdout().is_terminal())
        };
        let colour = terminal && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
        Self {
            out,
            colour,
            held: BinaryHeap::new(),
            number: 0,
        }
    }

    /// Adds a line.
    pub(crate) fn note(&mut self, at_ns: i64, who: EventSource, what: String) {
        self.number += 1;
        self.held.push(Reverse(Entry {
            at_ns,
            number: self.number,
            who,
            what,
        }));
    }

    /// Prints the events that are older than the delay. `seconds` converts a time to seconds of the
    /// scenario.
    pub(crate) fn print_before(&mut self, now_ns: i64, seconds: Seconds<'_>) -> io::Result<()> {
        self.print_while(seconds, |entry| entry.at_ns + HELD_NS <= now_ns)
    }

    /// Prints all events.
    pub(crate) fn print_all(&mut self, seconds: Seconds<'_>) -> io::Result<()> {
        self.print_while(seconds, |_| true)
    }

    /// Prints text unchanged.
    pub(crate) fn print_text(&mut self, text: &str) -> io::Result<()> {
        self.out.write_all(text.as_bytes())?;
        self.out.flush()
    }

    /// Prints the end of a scenario: the table, the failure, and the report as JSON on standard
    /// output if `json` is set.
    pub(crate) fn conclude(
        &mut self,
        table: Option<&str>,
        failure: Option<&str>,
        (report, json): (&impl Serialize, bool),
    ) -> io::Result<()> {
        self.print_text(table.unwrap_or_default())?;
        if let Some(failure) = failure {
            self.print_text(&format!("error: {failure}\n"))?;
        }
        if json {
            let mut out = io::stdout().lock();
            serde_json::to_writer(&mut out, report)?;
            out.write_all(b"\n")?;
            out.flush()?;
        }
        Ok(())
    }

    fn print_while(
        &mut self,
        seconds: Seconds<'_>,
        due: impl Fn(&Entry) -> bool,
    ) -> io::Result<()> {
        let mut printed = false;
        while self.held.peek().is_some_and(|Reverse(entry)| due(entry)) {
            let Some(Reverse(entry)) = self.held.pop() else {
                break;
            };
            let line = line(&entry, seconds, self.colour);
            self.out.write_all(line.as_bytes())?;
            printed = true;
        }
        if printed { self.out.flush() } else { Ok(()) }
    }
}

/// Converts nanoseconds since 1970 to seconds of the scenario; `None` before its start.
pub(crate) type Seconds<'a> = &'a dyn Fn(i64) -> Option<f64>;

fn line(entry: &Entry, seconds: Seconds<'_>, colour: bool) -> String {
    let time = match seconds(entry.at_ns) {
        // Events before the start have no time.
        Some(seconds) if seconds >= 0.0 => format!("{seconds:>9.3}"),
        Some(_) | None => format!("{:>9}", "-"),
    };
    let EventSource(who, code) = entry.who;
    if colour {
        format!(
            "\x1b[2m{time}\x1b[0m  \x1b[{code}m{who:<13}\x1b[0m  {}\n",
            entry.what
        )
    } else {
        format!("{time}  {who:<13}  {}\n", entry.what)
    }
}

/// Delay of events, several times the time that a child takes to report an event.
const HELD_NS: i64 = 200_000_000;

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;

    #[derive(Clone, Default)]
    struct Page(Arc<Mutex<Vec<u8>>>);

    impl Write for Page {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn events_are_printed_in_the_order_in_which_they_happened() {
        let page = Page::default();
        let out = Box::new(page.clone());
        let mut timeline = EventPrinter {
            out,
            colour: false,
            held: BinaryHeap::new(),
            number: 0,
        };
        let robot = EventSource("Niryo Ned", "33");
        for (at_ns, who, what) in [
            (5_000_000_000, EventSource::DEMO, "begins"),
            (
                5_902_000_000,
                EventSource("OPC UA server", "32"),
                "has the count",
            ),
            (5_900_000_000, robot, "places a cover"),
            (4_000_000_000, robot, "is there"),
        ] {
            timeline.note(at_ns, who, what.to_owned());
        }
        // At ten times the speed.
        let seconds = |at_ns: i64| Some(((at_ns - 5_000_000_000) / 1_000_000) as f64 / 100.0);
        timeline
            .print_before(5_000_000_000 + HELD_NS, &seconds)
            .unwrap();
        let early = page.0.lock().unwrap().len();
        timeline.print_all(&seconds).unwrap();
        let text = String::from_utf8(page.0.lock().unwrap().clone()).unwrap();
        assert_eq!(text[..early].lines().count(), 2);
        assert_eq!(
            text,
            "        -  Niryo Ned      is there\n    \
             0.000  demo           begins\n    \
             9.000  Niryo Ned      places a cover\n    \
             9.020  OPC UA server  has the count\n"
        );
    }
}
