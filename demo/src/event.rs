//! Events of the demo's own processes for their parent process: each is a line of JSON on standard
//! output.
//!
//! They are used for the timeline only. The robots communicate through the space.

use std::io::{self, Write as _};

use serde::{Deserialize, Serialize};

use crate::clock::wall_nanos;
use crate::line::LineValueName;
use crate::plug::NodeEvent;
use crate::robots::niryo::NiryoEvent;
use crate::robots::turtlebot::TurtlebotEvent;
use crate::skilled::MachineEvent;

/// An event and its time, in nanoseconds since 1970.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Stamped {
    pub(crate) at_ns: i64,
    pub(crate) event: ChildEvent,
}

/// An event in a child process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub(crate) enum ChildEvent {
    Master(MasterEvent),
    Niryo(NiryoEvent),
    Turtlebot(TurtlebotEvent),
    Supervisor(SupervisorEvent),
    Node(NodeEvent),
    Machine(MachineEvent),
}

/// An event of the ROS master.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "master", rename_all = "snake_case")]
pub(crate) enum MasterEvent {
    Listening { uri: String },
}

/// An event of the OPC UA client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "supervisor", rename_all = "snake_case")]
pub(crate) enum SupervisorEvent {
    Connected,
    /// The server has no values of these names yet.
    Awaits {
        names: Vec<LineValueName>,
    },
    /// The server has all values, but not the Method that switches the conveyor.
    AwaitsSwitch,
    /// The client called the switch of the conveyor, and Niryo Ned responded. The timestamp is the
    /// time of the call.
    Switched {
        on: bool,
        /// Nanoseconds from the call to its response.
        answered_after_ns: i64,
    },
    /// The server has a new value; the timestamp is the server's.
    Saw {
        name: LineValueName,
        value: LineValue,
    },
}

/// A value of the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub(crate) enum LineValue {
    Boolean(bool),
    Number(u32),
}

impl std::fmt::Display for LineValue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Boolean(value) => value.fmt(f),
            Self::Number(value) => value.fmt(f),
        }
    }
}

/// Prints an event that happens at this moment. Fails if standard output is closed.
pub(crate) fn tell(event: impl Into<ChildEvent>) -> io::Result<()> {
    tell_at(wall_nanos(), event)
}

/// Prints an event that happened at `at_ns`.
pub(crate) fn tell_at(at_ns: i64, event: impl Into<ChildEvent>) -> io::Result<()> {
    let mut line = serde_json::to_vec(&Stamped {
        at_ns,
        event: event.into(),
    })?;
    line.push(b'\n');
    let mut out = io::stdout().lock();
    out.write_all(&line)?;
    out.flush()
}

impl From<MasterEvent> for ChildEvent {
    fn from(event: MasterEvent) -> Self {
        Self::Master(event)
    }
}

impl From<NiryoEvent> for ChildEvent {
    fn from(event: NiryoEvent) -> Self {
        Self::Niryo(event)
    }
}

impl From<TurtlebotEvent> for ChildEvent {
    fn from(event: TurtlebotEvent) -> Self {
        Self::Turtlebot(event)
    }
}

impl From<SupervisorEvent> for ChildEvent {
    fn from(event: SupervisorEvent) -> Self {
        Self::Supervisor(event)
    }
}

impl From<MachineEvent> for ChildEvent {
    fn from(event: MachineEvent) -> Self {
        Self::Machine(event)
    }
}

impl From<NodeEvent> for ChildEvent {
    fn from(event: NodeEvent) -> Self {
        Self::Node(event)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robots::niryo::WaitCause;

    #[test]
    fn every_kind_of_event_comes_back_as_it_was_told() {
        let events: [ChildEvent; 7] = [
            MachineEvent::Arrives { at: [2.0, 0.5] }.into(),
            MasterEvent::Listening {
                uri: "http://127.0.0.1:1/".to_owned(),
            }
            .into(),
            NiryoEvent::Waits {
                cause: WaitCause::ParkFree,
            }
            .into(),
            NiryoEvent::StorageEmpty.into(),
            TurtlebotEvent::Unloaded { total: 3 }.into(),
            SupervisorEvent::Saw {
                name: LineValueName::ParkBusy,
                value: LineValue::Boolean(true),
            }
            .into(),
            SupervisorEvent::Saw {
                name: LineValueName::CoversInStorage,
                value: LineValue::Number(4),
            }
            .into(),
        ];
        for event in events {
            let stamped = Stamped {
                at_ns: 1_700_000_000_123_456_789,
                event,
            };
            let text = serde_json::to_string(&stamped).unwrap();
            assert_eq!(
                serde_json::from_str::<Stamped>(&text).unwrap(),
                stamped,
                "{text}"
            );
        }
    }
}
