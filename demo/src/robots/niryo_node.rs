//! Niryo Ned as a ROS 1 node.

use std::io;

use anyhow::Context as _;
use bytes::Bytes;
use tcpros::{
    Inbox, InboxEvent, Node, NodeOptions, Publisher, PublisherOptions, RequestedType,
    ServiceOptions, ServiceServer, ServiceTypeSum, SubscriberOptions, Subscription, TopicType,
};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, interval, sleep_until};

use super::niryo::{ArmInput, ArmOutputs, Niryo, NiryoEvent};
use super::{REPEAT, far_away};
use crate::clock::wall_nanos;
use crate::event::tell_at;
use crate::line::{LineValueName, SWITCH};
use crate::pace::{LinePace, Speed};
use crate::stop::EndSignal;

/// Runs the node until the process is stopped.
pub(crate) async fn run(covers: u32, speed: Speed) -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    let node = Node::start(NodeOptions::from_env("niryo_ned"))?;
    let outputs = Outputs::advertise(&node)?;
    let mut inbox = Inbox::new();
    let _subscriptions = subscribe(&node, &inbox)?;
    let (sender, mut orders) = mpsc::channel(MOST_ORDERS);
    let _switch = serve_switch(&node, sender)?;
    let started = Instant::now();
    let mut niryo = Niryo::new(covers, LinePace::at(speed));
    let mut repeat = interval(REPEAT);
    loop {
        let wake = niryo
            .timeout()
            .map_or_else(|| far_away(started), |at| started + at);
        let mut done = None;
        let heard = tokio::select! {
            Some(order) = orders.recv() => {
                done = Some(order.done);
                Some(ArmInput::Switch(order.on))
            }
            (name, event) = inbox.recv() => heard(name, &event),
            () = sleep_until(wake) => Some(ArmInput::Nothing),
            _ = repeat.tick() => { outputs.publish(niryo.counts()); None }
            () = stop.wait() => break,
        };
        let Some(heard) = heard else { continue };
        let before = niryo.counts();
        let events = niryo.handle(heard, started.elapsed());
        // The timestamp is the time of the action; publishing follows.
        let stamp = wall_nanos();
        if niryo.counts() != before {
            outputs.publish(niryo.counts());
        }
        if let Some(done) = done {
            // The caller may have given up.
            done.send(()).ok();
        }
        tell(stamp, &events).context("the demo does not listen any more")?;
    }
    node.shutdown().await;
    Ok(())
}

fn tell(stamp: i64, events: &[NiryoEvent]) -> io::Result<()> {
    events.iter().try_for_each(|event| tell_at(stamp, *event))
}

fn heard(name: LineValueName, event: &InboxEvent) -> Option<ArmInput> {
    let InboxEvent::Message(message) = event else {
        return None;
    };
    let Some(value) = read_bool(&message.bytes) else {
        tracing::warn!(%name, bytes = message.bytes.len(), "a message is no std_msgs/Bool");
        return None;
    };
    match name {
        LineValueName::ParkBusy => Some(ArmInput::Park(value)),
        LineValueName::BucketBusy => Some(ArmInput::Bucket(value)),
        LineValueName::ConveyorRunning
        | LineValueName::CoversInStorage
        | LineValueName::CoversOnConveyor
        | LineValueName::CoversOnTurtleBot3 => None,
    }
}

pub(crate) fn read_bool(message: &[u8]) -> Option<bool> {
    match message {
        [value] => Some(*value != 0),
        _ => None,
    }
}

fn subscribe(node: &Node, inbox: &Inbox<LineValueName>) -> anyhow::Result<Vec<Subscription>> {
    let wanted = RequestedType {
        type_name: Some(BOOL.0.to_owned()),
        md5sum: Some(BOOL.1.to_owned()),
    };
    [LineValueName::ParkBusy, LineValueName::BucketBusy]
        .into_iter()
        .map(|name| {
            let topic = format!("/{}", name.ros_topic());
            let options = SubscriberOptions::default();
            Ok(node.subscribe(&topic, wanted.clone(), options, name, inbox)?)
        })
        .collect()
}

/// A request to switch the conveyor.
struct Order {
    on: bool,
    /// Signals that the conveyor has followed.
    done: oneshot::Sender<()>,
}

/// Advertises the switch of the conveyor, a service that responds when the conveyor has followed.
fn serve_switch(node: &Node, orders: mpsc::Sender<Order>) -> anyhow::Result<ServiceServer> {
    let service_type = ServiceTypeSum {
        name: SET_BOOL.0.to_owned(),
        md5sum: SET_BOOL.1.to_owned(),
        request_type: format!("{}Request", SET_BOOL.0),
        response_type: format!("{}Response", SET_BOOL.0),
    };
    let serve = move |request: tcpros::ServiceRequest| {
        let orders = orders.clone();
        async move {
            let on = read_bool(&request.bytes).ok_or("the request is no std_srvs/SetBool")?;
            let (done, followed) = oneshot::channel();
            orders
                .try_send(Order { on, done })
                .map_err(|_| "too many want to switch the conveyor")?;
            followed.await.map_err(|_| "the arm is being ended")?;
            let message = if on {
                "the conveyor runs"
            } else {
                "the conveyor stands still"
            };
            Ok(set_bool_response(message))
        }
    };
    let options = ServiceOptions::default();
    Ok(node.advertise_service(&format!("/{SWITCH}"), service_type, options, serve)?)
}

/// Encodes a successful response of std_srvs/SetBool: the Boolean, then the text with its length
/// before it.
pub(crate) fn set_bool_response(message: &str) -> Bytes {
    let length = u32::try_from(message.len()).unwrap_or_default();
    let parts: [&[u8]; 3] = [&[1], &length.to_le_bytes(), message.as_bytes()];
    Bytes::from(parts.concat())
}

/// The latched topics of the arm.
struct Outputs {
    running: Publisher,
    storage: Publisher,
    conveyor: Publisher,
    turtlebot: Publisher,
}

impl Outputs {
    fn advertise(node: &Node) -> anyhow::Result<Self> {
        let advertise =
            |name: LineValueName, (type_name, md5sum, definition): (&str, &str, &str)| {
                let topic_type = TopicType {
                    name: type_name.to_owned(),
                    md5sum: md5sum.to_owned(),
                    definition: definition.to_owned(),
                };
                let options = PublisherOptions {
                    latch: true,
                    ..PublisherOptions::default()
                };
                node.advertise(&format!("/{}", name.ros_topic()), topic_type, options)
            };
        Ok(Self {
            running: advertise(LineValueName::ConveyorRunning, BOOL)?,
            storage: advertise(LineValueName::CoversInStorage, UINT32)?,
            conveyor: advertise(LineValueName::CoversOnConveyor, UINT32)?,
            turtlebot: advertise(LineValueName::CoversOnTurtleBot3, UINT32)?,
        })
    }

    fn publish(&self, counts: ArmOutputs) {
        let running = Bytes::copy_from_slice(&[u8::from(counts.conveyor_running)]);
        let number = |count: u32| Bytes::copy_from_slice(&count.to_le_bytes());
        for (publisher, message) in [
            (&self.running, running),
            (&self.storage, number(counts.in_storage)),
            (&self.conveyor, number(counts.on_conveyor)),
            (&self.turtlebot, number(counts.on_turtlebot)),
        ] {
            let published = publisher.publish(message);
            if published.dropped_oldest > 0 {
                tracing::warn!(topic = publisher.topic(), "a subscriber does not keep up");
            }
        }
    }
}

/// Type name, MD5 sum and definition of the two ROS types of the line.
const BOOL: (&str, &str, &str) = (
    "std_msgs/Bool",
    "8b94c1b53db61fb6aed406028ad6332a",
    "bool data\n",
);
const UINT32: (&str, &str, &str) = (
    "std_msgs/UInt32",
    "304a39449588c7f8ce2df6e8001c5fce",
    "uint32 data\n",
);

/// Type name and MD5 sum of the service that switches the conveyor.
pub(crate) const SET_BOOL: (&str, &str) = ("std_srvs/SetBool", "09fb03525b03e7ea1fd3992bafd87e16");
/// Maximum number of waiting calls of the switch.
const MOST_ORDERS: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_of_another_length_is_no_bool() {
        assert_eq!(read_bool(&[1]), Some(true));
        assert_eq!(read_bool(&[0]), Some(false));
        assert_eq!(read_bool(&[]), None);
        assert_eq!(read_bool(&[1, 0, 0, 0]), None);
    }

    #[test]
    fn the_response_is_that_of_the_type() {
        assert_eq!(&set_bool_response("on")[..], b"\x01\x02\0\0\0on");
    }
}
