//! The texts of the timeline for the events of the line.

use crate::event::{ChildEvent, SupervisorEvent};
use crate::robots::niryo::{NiryoEvent, WaitCause};
use crate::robots::turtlebot::TurtlebotEvent;
use crate::stage::EventSource;

/// Returns the source and the text of an event, or `None` if it is not shown.
pub(crate) fn describe(event: &ChildEvent) -> Option<(EventSource, String)> {
    match event {
        ChildEvent::Master(_)
        | ChildEvent::Supervisor(SupervisorEvent::Awaits { .. } | SupervisorEvent::AwaitsSwitch)
        | ChildEvent::Node(_)
        | ChildEvent::Machine(_) => None,
        ChildEvent::Niryo(event) => Some((NIRYO, niryo(*event))),
        ChildEvent::Turtlebot(event) => Some((TURTLEBOT, turtlebot(*event))),
        ChildEvent::Supervisor(SupervisorEvent::Connected) => Some((
            SUPERVISOR,
            "has a session with the OPC UA server".to_owned(),
        )),
        ChildEvent::Supervisor(SupervisorEvent::Switched { on, .. }) => {
            let state = if *on { "on" } else { "off" };
            Some((SUPERVISOR, format!("calls Conveyor.Switch: {state}")))
        }
        ChildEvent::Supervisor(SupervisorEvent::Saw { name, value }) => {
            Some((SERVER, format!("{name} = {value}")))
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

const SUPERVISOR: EventSource = EventSource("supervisor", "35");
const NIRYO: EventSource = EventSource("Niryo Ned", "33");
const TURTLEBOT: EventSource = EventSource("TurtleBot3", "36");
const SERVER: EventSource = EventSource("OPC UA server", "32");
