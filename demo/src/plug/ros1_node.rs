//! The robot of the scenario as a ROS 1 node. It listens to skills of the space, and starts a skill
//! on request.

use anyhow::Context as _;
use bytes::Bytes;
use tcpros::{
    Inbox, InboxEvent, Node, NodeOptions, RequestedType, ServiceClient, ServiceClientOptions,
    SubscriberOptions, Subscription,
};
use tokio::io::{AsyncBufReadExt as _, BufReader};

use super::fact::{NodeEvent, PlugComponent, Ros};
use super::skill_messages::{SkillResult, SkillState, TRIGGER, trigger_response};
use super::{CALL_LIMIT, RESET, RESULT, START, STATE, topic};
use crate::event::tell;
use crate::stop::EndSignal;

const ROS: Ros = Ros::Ros1;

/// The namespace and the identifier of a message.
type TopicNumbers = (u16, u16);

/// Runs the node until the process is stopped. A line on its standard input starts the gripper's
/// first skill.
pub(crate) async fn run() -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    let node = Node::start(NodeOptions::from_env("old_robot"))?;
    let mut inbox = Inbox::new();
    let _subscriptions = subscribe(&node, &inbox)?;
    let options = ServiceClientOptions {
        md5sum: Some(TRIGGER.1.to_owned()),
        type_name: Some(TRIGGER.0.to_owned()),
        timeout: CALL_LIMIT,
        ..ServiceClientOptions::default()
    };
    let client = |id| {
        node.service_client(
            &topic(PlugComponent::Gripper.namespace(), id),
            options.clone(),
        )
    };
    let (reset, start) = (client(RESET)?, client(START)?);
    let mut halted = false;
    let mut orders = BufReader::new(tokio::io::stdin()).lines();
    tell(NodeEvent::Up { ros: ROS })?;
    loop {
        tokio::select! {
            (place, event) = inbox.recv() => {
                if let Some(event) = heard(place, &event) {
                    halted = event.halted().unwrap_or(halted);
                    tell(event).context("the demo does not listen any more")?;
                }
            }
            line = orders.next_line() => {
                if line?.is_none() {
                    break;
                }
                let reset = halted.then(|| reset.clone());
                // If standard output is closed, the demo has ended.
                let ask = ask(reset, start.clone());
                drop(tokio::spawn(async move { tell(ask.await).ok() }));
            }
            () = stop.wait() => break,
        }
    }
    node.shutdown().await;
    Ok(())
}

/// Starts the skill, after a Reset if necessary. Returns the response.
async fn ask(reset: Option<ServiceClient>, start: ServiceClient) -> NodeEvent {
    let mut answer = (true, String::new());
    if let Some(reset) = reset {
        tell(NodeEvent::Resets { ros: ROS }).ok();
        answer = trigger(&reset).await;
    }
    if answer.0 {
        tell(NodeEvent::Asks { ros: ROS }).ok();
        answer = trigger(&start).await;
    }
    let (success, message) = answer;
    NodeEvent::Answered {
        ros: ROS,
        success,
        message,
    }
}

async fn trigger(client: &ServiceClient) -> (bool, String) {
    match client.call(Bytes::new()).await {
        Ok(response) => trigger_response(&response)
            .unwrap_or_else(|| (false, "the response is no std_srvs/Trigger".to_owned())),
        Err(error) => (false, error.to_string()),
    }
}

fn subscribe(node: &Node, inbox: &Inbox<TopicNumbers>) -> anyhow::Result<Vec<Subscription>> {
    let states =
        PlugComponent::ALL.map(|part| (part.namespace(), STATE, "SkillState", SkillState::MD5));
    let result = (
        PlugComponent::Gripper.namespace(),
        RESULT,
        "SkillResult",
        SkillResult::MD5,
    );
    states
        .into_iter()
        .chain([result])
        .map(|(namespace, id, type_name, md5)| {
            let wanted = RequestedType {
                type_name: Some(format!("ua_msgs/{type_name}")),
                md5sum: Some(md5.to_owned()),
            };
            let options = SubscriberOptions::default();
            Ok(node.subscribe(
                &topic(namespace, id),
                wanted,
                options,
                (namespace, id),
                inbox,
            )?)
        })
        .collect()
}

fn heard((namespace, id): TopicNumbers, event: &InboxEvent) -> Option<NodeEvent> {
    let InboxEvent::Message(message) = event else {
        return None;
    };
    let read = if id == STATE {
        SkillState::from_ros1(&message.bytes).map(|state| NodeEvent::state(ROS, namespace, state))
    } else {
        SkillResult::from_ros1(&message.bytes)
            .map(|result| NodeEvent::result(ROS, namespace, result))
    };
    if read.is_none() {
        tracing::warn!(
            namespace,
            id,
            bytes = message.bytes.len(),
            "a message is of another type"
        );
    }
    read
}
