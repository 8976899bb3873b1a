//! The timeline: a line per event, in the order in which things happened.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::io::{self, IsTerminal as _, Write};

use super::story::Story;
use crate::event::{Event, Stamped, SupervisorEvent};
use crate::robots::niryo::{NiryoEvent, WaitCause};
use crate::robots::turtlebot::TurtlebotEvent;

/// Prints events. Those of several processes are held back for a moment, to be put in order.
pub(crate) struct Timeline {
    out: Box<dyn Write>,
    colour: bool,
    held: BinaryHeap<Reverse<Entry>>,
    /// Keeps events of one instant in the order of their reading.
    number: u64,
}

#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct Entry {
    at_ns: i64,
    number: u64,
    who: Who,
    what: String,
}

/// Whose event it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Who {
    Demo,
    Supervisor,
    Niryo,
    Turtlebot,
    Server,
}

impl Timeline {
    /// On standard output, or on standard error when that is for JSON.
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

    /// Takes an event, unless it is not for people.
    pub(crate) fn add(&mut self, stamped: &Stamped) {
        if let Some((who, what)) = describe(&stamped.event) {
            self.note(stamped.at_ns, who, what);
        }
    }

    /// Takes a line that is no event of a process.
    pub(crate) fn note(&mut self, at_ns: i64, who: Who, what: String) {
        self.number += 1;
        self.held.push(Reverse(Entry {
            at_ns,
            number: self.number,
            who,
            what,
        }));
    }

    /// Prints what is older than the moment for which events are held back.
    pub(crate) fn print_before(&mut self, now_ns: i64, story: &Story) -> io::Result<()> {
        self.print_while(story, |entry| entry.at_ns + HELD_NS <= now_ns)
    }

    /// Prints all there is.
    pub(crate) fn print_all(&mut self, story: &Story) -> io::Result<()> {
        self.print_while(story, |_| true)
    }

    /// Prints text as it is.
    pub(crate) fn print_text(&mut self, text: &str) -> io::Result<()> {
        self.out.write_all(text.as_bytes())?;
        self.out.flush()
    }

    fn print_while(&mut self, story: &Story, due: impl Fn(&Entry) -> bool) -> io::Result<()> {
        let mut printed = false;
        while self.held.peek().is_some_and(|Reverse(entry)| due(entry)) {
            let Some(Reverse(entry)) = self.held.pop() else {
                break;
            };
            let line = line(&entry, story, self.colour);
            self.out.write_all(line.as_bytes())?;
            printed = true;
        }
        if printed { self.out.flush() } else { Ok(()) }
    }
}

fn line(entry: &Entry, story: &Story, colour: bool) -> String {
    let time = match story.seconds(entry.at_ns) {
        // What led to the start was before it.
        Some(seconds) if seconds >= 0.0 => format!("{seconds:>9.3}"),
        Some(_) | None => format!("{:>9}", "-"),
    };
    let (who, code) = match entry.who {
        Who::Demo => ("demo", "2"),
        Who::Supervisor => ("supervisor", "35"),
        Who::Niryo => ("Niryo Ned", "33"),
        Who::Turtlebot => ("TurtleBot3", "36"),
        Who::Server => ("OPC UA server", "32"),
    };
    if colour {
        format!(
            "\x1b[2m{time}\x1b[0m  \x1b[{code}m{who:<13}\x1b[0m  {}\n",
            entry.what
        )
    } else {
        format!("{time}  {who:<13}  {}\n", entry.what)
    }
}

fn describe(event: &Event) -> Option<(Who, String)> {
    match event {
        Event::Master(_) | Event::Supervisor(SupervisorEvent::Awaits { .. }) => None,
        Event::Niryo(event) => Some((Who::Niryo, niryo(*event))),
        Event::Turtlebot(event) => Some((Who::Turtlebot, turtlebot(*event))),
        Event::Supervisor(SupervisorEvent::Connected) => Some((
            Who::Supervisor,
            "has a session with the OPC UA server".to_owned(),
        )),
        Event::Supervisor(SupervisorEvent::Switched { on }) => {
            let state = if *on { "on" } else { "off" };
            Some((Who::Supervisor, format!("switches the conveyor {state}")))
        }
        Event::Supervisor(SupervisorEvent::Saw { name, value }) => {
            Some((Who::Server, format!("{name} = {value}")))
        }
    }
}

fn niryo(event: NiryoEvent) -> String {
    match event {
        NiryoEvent::ConveyorStarted => "the conveyor starts".to_owned(),
        NiryoEvent::ConveyorStopped {
            holding_cover: true,
        } => "the conveyor stops, with a cover in the gripper".to_owned(),
        NiryoEvent::ConveyorStopped {
            holding_cover: false,
        } => "the conveyor stops".to_owned(),
        NiryoEvent::Picked { left } => format!("picks a cover; {left} left in the storage"),
        NiryoEvent::PlacedOnConveyor { total } => {
            format!("places it on the conveyor: number {total} there")
        }
        NiryoEvent::PlacedOnTurtlebot { total } => {
            format!("places it on TurtleBot3: number {total} there")
        }
        NiryoEvent::Waits {
            cause: WaitCause::ParkFree,
        } => "waits: TurtleBot3 is not at the park".to_owned(),
        NiryoEvent::Waits {
            cause: WaitCause::BucketBusy,
        } => "waits: the bucket is busy".to_owned(),
        NiryoEvent::Waits {
            cause: WaitCause::Unknown,
        } => "waits: nothing has been heard of TurtleBot3".to_owned(),
        NiryoEvent::StorageEmpty => "is done: the storage is empty".to_owned(),
    }
}

fn turtlebot(event: TurtlebotEvent) -> String {
    match event {
        TurtlebotEvent::CoverInBucket { .. } => "feels a cover in the bucket".to_owned(),
        TurtlebotEvent::LeavesPark { .. } => "drives to the worker".to_owned(),
        TurtlebotEvent::Unloaded { total } => format!("is unloaded; {total} delivered so far"),
        TurtlebotEvent::BackAtPark => "stands at the park again".to_owned(),
    }
}

/// How long events wait for those that happened before them: several times what a child takes to tell.
const HELD_NS: i64 = 200_000_000;

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::event::Value;
    use crate::line::Name;
    use crate::pace::Speed;

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
        let mut timeline = Timeline {
            out,
            colour: false,
            held: BinaryHeap::new(),
            number: 0,
        };
        let mut story = Story::new(4, Speed::new(10.0).unwrap());
        let saw = SupervisorEvent::Saw {
            name: Name::CoversOnConveyor,
            value: Value::Number(1),
        };
        for (at_ns, event) in [
            (5_000_000_000, SupervisorEvent::Switched { on: true }.into()),
            (5_902_000_000, saw.into()),
            (
                5_900_000_000,
                NiryoEvent::PlacedOnConveyor { total: 1 }.into(),
            ),
            (4_000_000_000, SupervisorEvent::Connected.into()),
        ] {
            let stamped = Stamped { at_ns, event };
            story.observe(&stamped);
            timeline.add(&stamped);
        }
        timeline
            .print_before(5_000_000_000 + HELD_NS, &story)
            .unwrap();
        timeline.print_all(&story).unwrap();
        let text = String::from_utf8(page.0.lock().unwrap().clone()).unwrap();
        assert_eq!(
            text,
            "        -  supervisor     has a session with the OPC UA server\n    \
             0.000  supervisor     switches the conveyor on\n    \
             9.000  Niryo Ned      places it on the conveyor: number 1 there\n    \
             9.020  OPC UA server  CoversOnConveyor = 1\n"
        );
    }
}
