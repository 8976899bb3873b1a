//! The robot of the scenario as a ROS 2 node. It listens to skills of the space, and starts a skill
//! on request.

use std::pin::Pin;

use anyhow::{Context as _, anyhow};
use futures_util::stream::{Stream, StreamExt as _, select_all};
use ros2_client::qos::{History, WhenFull};
use ros2_client::{
    Client, Message, MessageTypeName, Name as RosName, Node, QosProfile, ServiceMapping,
    ServiceTypeName, Subscription,
};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::time::timeout;

use super::fact::{NodeEvent, PlugComponent, Ros};
use super::skill_messages::{SkillResult, SkillState};
use super::{CALL_LIMIT, RESET, RESULT, START, STATE, topic};
use crate::event::tell;
use crate::ros2::join;
use crate::stop::EndSignal;

const ROS: Ros = Ros::Ros2;

/// The request of `std_srvs/Trigger`. It has no fields, which CDR encodes as one byte.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct TriggerRequest {
    structure_needs_at_least_one_member: u8,
}

impl Message for TriggerRequest {}

/// The response of `std_srvs/Trigger`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct TriggerResponse {
    success: bool,
    message: String,
}

impl Message for TriggerResponse {}

type Trigger = Client<TriggerRequest, TriggerResponse>;

type Events = Pin<Box<dyn Stream<Item = NodeEvent>>>;

/// Runs the node until the process is stopped. A line on its standard input starts the gripper's
/// first skill.
pub(crate) async fn run() -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    let mut node = join("new_robot")?;
    let states: Vec<(u16, Subscription<SkillState>)> = PlugComponent::ALL
        .into_iter()
        .map(|part| {
            let namespace = part.namespace();
            Ok((
                namespace,
                subscription(&mut node, (namespace, STATE), "SkillState")?,
            ))
        })
        .collect::<anyhow::Result<_>>()?;
    let gripper = PlugComponent::Gripper.namespace();
    let results: Subscription<SkillResult> =
        subscription(&mut node, (gripper, RESULT), "SkillResult")?;
    let (reset, start) = (client(&mut node, RESET)?, client(&mut node, START)?);
    let spinner = node
        .spinner()
        .map_err(|error| anyhow!("the node cannot watch its domain: {error}"))?;
    let mut spinning = std::pin::pin!(spinner.spin());
    let mut events = select_all(
        states
            .into_iter()
            .map(|(namespace, states)| {
                events(states, move |state| NodeEvent::state(ROS, namespace, state))
            })
            .chain([events(results, move |result| {
                NodeEvent::result(ROS, gripper, result)
            })]),
    );
    let mut orders = BufReader::new(tokio::io::stdin()).lines();
    let mut asking: Option<Pin<Box<dyn Future<Output = NodeEvent> + '_>>> = None;
    let mut halted = false;
    tell(NodeEvent::Up { ros: ROS })?;
    loop {
        let answer = async {
            match asking.as_mut() {
                Some(asking) => asking.await,
                None => std::future::pending().await,
            }
        };
        let event = tokio::select! {
            Some(event) = events.next() => event,
            event = answer => {
                asking = None;
                event
            }
            line = orders.next_line() => {
                if line?.is_none() {
                    return Ok(());
                }
                asking = Some(Box::pin(ask(&node, halted.then_some(&reset), &start)));
                continue;
            }
            ended = &mut spinning => {
                return Err(anyhow!("the node does not watch its domain any more: {ended:?}"));
            }
            () = stop.wait() => return Ok(()),
        };
        halted = event.halted().unwrap_or(halted);
        tell(event).context("the demo does not listen any more")?;
    }
}

/// Starts the skill, after a Reset if necessary. Returns the response.
async fn ask(node: &Node, reset: Option<&Trigger>, start: &Trigger) -> NodeEvent {
    let mut answer = (true, String::new());
    if let Some(reset) = reset {
        answer = trigger(node, reset, NodeEvent::Resets { ros: ROS }).await;
    }
    if answer.0 {
        answer = trigger(node, start, NodeEvent::Asks { ros: ROS }).await;
    }
    let (success, message) = answer;
    NodeEvent::Answered {
        ros: ROS,
        success,
        message,
    }
}

/// Calls a service when it is available.
async fn trigger(node: &Node, client: &Trigger, begins: NodeEvent) -> (bool, String) {
    let call = async {
        client.wait_for_service(node).await;
        // If standard output is closed, the demo has ended.
        tell(begins).ok();
        let request = TriggerRequest {
            structure_needs_at_least_one_member: 0,
        };
        client.async_call_service(request).await
    };
    match timeout(CALL_LIMIT, call).await {
        Ok(Ok(response)) => (response.success, response.message),
        Ok(Err(error)) => (false, format!("{error:?}")),
        Err(_) => (false, format!("no answer within {CALL_LIMIT:?}")),
    }
}

/// Converts the messages of a subscription to events, until the end of the program.
fn events<M: Message + DeserializeOwned + 'static>(
    subscription: Subscription<M>,
    event: impl Fn(M) -> NodeEvent + 'static,
) -> Events {
    // The stream borrows the subscription, which lives as long as the program.
    let subscription: &'static Subscription<M> = Box::leak(Box::new(subscription));
    Box::pin(subscription.async_stream().filter_map(move |sample| {
        let event = match sample {
            Ok((message, _)) => Some(event(message)),
            Err(error) => {
                tracing::warn!(?error, "a message was not read");
                None
            }
        };
        std::future::ready(event)
    }))
}

impl Message for SkillState {}
impl Message for SkillResult {}

const LISTENS: QosProfile = QosProfile::publisher_default()
    .reliability_reliable(WhenFull::Fail)
    .history(History::KeepLast { depth: 20 });

fn ros_name(namespace: u16, id: u16) -> anyhow::Result<RosName> {
    let name = topic(namespace, id);
    RosName::parse(&name).map_err(|error| anyhow!("{name} is no ROS 2 name: {error:?}"))
}

fn subscription<M: Message + DeserializeOwned + 'static>(
    node: &mut Node,
    (namespace, id): (u16, u16),
    type_name: &str,
) -> anyhow::Result<Subscription<M>> {
    let name = ros_name(namespace, id)?;
    let topic = node
        .create_topic(&name, MessageTypeName::new("ua_msgs", type_name), &LISTENS)
        .map_err(|error| anyhow!("cannot make a topic: {error}"))?;
    node.create_subscription(&topic, Some(LISTENS))
        .map_err(|error| anyhow!("cannot subscribe: {error}"))
}

fn client(node: &mut Node, id: u16) -> anyhow::Result<Trigger> {
    node.create_client(
        ServiceMapping::Enhanced,
        &ros_name(PlugComponent::Gripper.namespace(), id)?,
        &ServiceTypeName::new("std_srvs", "Trigger"),
        LISTENS,
        LISTENS,
    )
    .map_err(|error| anyhow!("cannot make a client: {error}"))
}
