//! TurtleBot3 as a ROS 2 node.

use anyhow::{Context as _, anyhow};
use futures_util::StreamExt as _;
use ros2_client::qos::{Durability, History, WhenFull};
use ros2_client::{MessageTypeName, Name as RosName, Node, Publisher, QosProfile, Subscription};
use tokio::time::{Instant, interval, sleep_until};

use super::turtlebot::{Turtlebot, TurtlebotOutputs};
use super::{REPEAT, far_away};
use crate::clock::wall_nanos;
use crate::event::tell_at;
use crate::line::LineValueName;
use crate::pace::{LinePace, Speed};
use crate::ros2::join;
use crate::stop::EndSignal;

/// Runs the node until the process is stopped.
pub(crate) async fn run(speed: Speed) -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    let mut node = join("turtlebot3")?;
    let outputs = Outputs {
        park: publisher(&mut node, LineValueName::ParkBusy)?,
        bucket: publisher(&mut node, LineValueName::BucketBusy)?,
    };
    let covers = subscription(&mut node)?;
    let mut covers = std::pin::pin!(covers.async_stream());
    let started = Instant::now();
    let mut robot = Turtlebot::new(LinePace::at(speed));
    let mut repeat = interval(REPEAT);
    loop {
        let wake = robot
            .timeout()
            .map_or_else(|| far_away(started), |at| started + at);
        let placed = tokio::select! {
            sample = covers.next() => match sample {
                Some(Ok((count, _))) => Some(count),
                Some(Err(error)) => {
                    tracing::warn!(?error, "a count was not read");
                    continue;
                }
                None => return Err(anyhow!("the subscription of the count of covers has ended")),
            },
            () = sleep_until(wake) => None,
            _ = repeat.tick() => { outputs.publish(robot.status()); continue }
            () = stop.wait() => return Ok(()),
        };
        let before = robot.status();
        let events = robot.handle(placed, started.elapsed());
        // The timestamp is the time of the action; publishing follows.
        let stamp = wall_nanos();
        if robot.status() != before {
            outputs.publish(robot.status());
        }
        for event in events {
            tell_at(stamp, event).context("the demo does not listen any more")?;
        }
    }
}

/// The last value counts, and late subscribers receive it.
const STATE: QosProfile = QosProfile::publisher_default()
    .reliability_reliable(WhenFull::Fail)
    .durability(Durability::TransientLocal)
    .history(History::KeepLast { depth: 1 });

fn topic(node: &Node, name: LineValueName, type_name: &str) -> anyhow::Result<rustdds::Topic> {
    let ros_name = RosName::parse(&format!("/{}", name.ros_topic()))
        .map_err(|error| anyhow!("{name} has no ROS 2 name: {error:?}"))?;
    node.create_topic(
        &ros_name,
        MessageTypeName::new("std_msgs", type_name),
        &STATE,
    )
    .map_err(|error| anyhow!("cannot make the topic of {name}: {error}"))
}

fn publisher(node: &mut Node, name: LineValueName) -> anyhow::Result<Publisher<bool>> {
    let topic = topic(node, name, "Bool")?;
    node.create_publisher(&topic, Some(STATE))
        .map_err(|error| anyhow!("cannot publish {name}: {error}"))
}

fn subscription(node: &mut Node) -> anyhow::Result<Subscription<u32>> {
    let name = LineValueName::CoversOnTurtleBot3;
    let topic = topic(node, name, "UInt32")?;
    node.create_subscription(&topic, Some(STATE))
        .map_err(|error| anyhow!("cannot subscribe {name}: {error}"))
}

struct Outputs {
    park: Publisher<bool>,
    bucket: Publisher<bool>,
}

impl Outputs {
    fn publish(&self, status: TurtlebotOutputs) {
        for (name, publisher, value) in [
            (LineValueName::BucketBusy, &self.bucket, status.bucket_busy),
            (LineValueName::ParkBusy, &self.park, status.park_busy),
        ] {
            if let Err(error) = publisher.publish(value) {
                // The state is repeated soon.
                tracing::warn!(%name, ?error, "a state was not published");
            }
        }
    }
}
