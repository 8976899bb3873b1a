//! The mobile robot as a ROS 2 node, with an action to drive.

use std::time::Duration;

use anyhow::{Context as _, anyhow};
use ros2_client::action::{
    ActionServerQosPolicies, AsyncActionServer, ExecutingGoalHandle, GoalEndStatus,
};
use ros2_client::qos::{Durability, History, WhenFull};
use ros2_client::{ActionTypeName, Message, Name as RosName, Node, QosProfile, ServiceMapping};
use serde::{Deserialize, Serialize};
use tokio::time::{sleep, timeout};

use super::fact::MachineEvent;
use crate::event::tell;
use crate::pace::{LinePace, Speed};
use crate::ros2::join;
use crate::stop::EndSignal;

/// The goal of `ua_msgs/NavigateTo`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Goal {
    goal: [f64; 3],
    frame: String,
}

/// The result of `ua_msgs/NavigateTo`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Reached {
    run: u32,
    pose: [f64; 3],
}

/// The feedback of `ua_msgs/NavigateTo`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct OnTheWay {
    state: String,
    progress: f32,
    step: String,
    run: u32,
}

impl Message for Goal {}
impl Message for Reached {}
impl Message for OnTheWay {}

type Server = AsyncActionServer<Goal, Reached, OnTheWay>;

/// Runs the node until the process is stopped.
pub(crate) async fn run(speed: Speed) -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    let mut node = join("turtlebot3")?;
    let spinner = node
        .spinner()
        .map_err(|error| anyhow!("the node cannot watch its domain: {error}"))?;
    let server = serve(&mut node)?;
    let lasts = LinePace::at(speed).drive;
    tokio::select! {
        ended = spinner.spin() => Err(anyhow!("the node does not watch its domain any more: {ended:?}")),
        ended = drive(&server, lasts) => ended,
        () = stop.wait() => Ok(()),
    }
}

/// Executes goals sequentially.
async fn drive(server: &Server, lasts: Duration) -> anyhow::Result<()> {
    let broken = |error: &dyn std::fmt::Debug| anyhow!("the action does not work: {error:?}");
    loop {
        let new = server
            .receive_new_goal()
            .await
            .map_err(|error| broken(&error))?;
        let Some(goal) = server.get_new_goal(new.clone()) else {
            continue;
        };
        let accepted = server
            .accept_goal(new)
            .await
            .map_err(|error| broken(&error))?;
        let executing = server.start_executing_goal(accepted).await;
        let executing = executing.map_err(|error| broken(&error))?;
        tell(MachineEvent::Leaves).context(NOBODY)?;
        sleep(lasts).await;
        let [x, y, _] = goal.goal;
        tell(MachineEvent::Arrives { at: [x, y] }).context(NOBODY)?;
        let reached = Reached {
            run: 0,
            pose: goal.goal,
        };
        answer(server, executing, reached).await;
    }
}

/// Waits for a request of the result, and responds.
async fn answer(server: &Server, goal: ExecutingGoalHandle<Goal>, reached: Reached) {
    let told = server.send_result_response(goal, GoalEndStatus::Succeeded, reached);
    match timeout(RESULT_WITHIN, told).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => tracing::warn!(?error, "cannot send a result"),
        Err(_) => tracing::warn!("the result was not requested in time"),
    }
}

fn serve(node: &mut Node) -> anyhow::Result<Server> {
    let name = RosName::parse(ACTION).map_err(|error| anyhow!("{ACTION}: {error:?}"))?;
    let services = QosProfile::publisher_default()
        .reliability_reliable(WhenFull::Fail)
        .history(History::KeepLast { depth: 10 });
    let status = services.clone().durability(Durability::TransientLocal);
    let qos = ActionServerQosPolicies {
        goal_service: services.clone(),
        result_service: services.clone(),
        cancel_service: services.clone(),
        feedback_publisher: services,
        status_publisher: status,
    };
    let of_type = ActionTypeName::new("ua_msgs", "NavigateTo");
    let server = node
        .create_action_server(ServiceMapping::Enhanced, &name, &of_type, qos)
        .map_err(|error| anyhow!("cannot make an action: {error}"))?;
    Ok(AsyncActionServer::new(server))
}

const ACTION: &str = "/turtlebot3/navigate_to";
/// Time limit for the request of a result.
const RESULT_WITHIN: Duration = Duration::from_secs(5);
const NOBODY: &str = "the demo does not listen any more";
