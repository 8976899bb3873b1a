//! The arm as a ROS 1 node, with actions for its moves and its gripper.

use std::time::Duration;

use anyhow::{Context as _, anyhow};
use bytes::Bytes;
use messages::{Dialect, TypeRegistry};
use tcpros::actionlib::{
    ActionlibServer, ActionlibServerGoal, ActionlibServerOptions, ActionlibTypes,
    SimpleActionServer,
};
use tcpros::{Node, NodeOptions, TopicType};
use tokio::time::sleep;

use super::fact::MachineEvent;
use crate::event::tell;
use crate::pace::Speed;
use crate::stop::EndSignal;

/// Runs the node until the process is stopped.
pub(crate) async fn run(speed: Speed) -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    let node = Node::start(NodeOptions::from_env("niryo_ned"))?;
    let mut moves = serve(&node, MOVE, MOVED)?;
    let mut grasps = serve(&node, GRASP, GRASPED)?;
    let mut releases = serve(&node, RELEASE, RELEASED)?;
    let mut at = HOME;
    loop {
        // Goals are executed sequentially, because the arm has one body.
        tokio::select! {
            goal = moves.next() => {
                let to = target(goal.body());
                match to {
                    Some(to) if works(&mut moves, &goal, speed.real(MOVE_SECONDS)).await => {
                        at = to;
                        succeed(&goal, &moved(to));
                    }
                    Some(_) => {}
                    None => drop(goal.abort(None, "the goal is no ua_msgs/PtpMoveGoal")),
                }
            }
            goal = grasps.next() => {
                if works(&mut grasps, &goal, speed.real(GRIP_SECONDS)).await {
                    tell(MachineEvent::Grasps { at: position(at) }).context(NOBODY)?;
                    succeed(&goal, &[0, 0, 0, 0, 1]);
                }
            }
            goal = releases.next() => {
                if works(&mut releases, &goal, speed.real(GRIP_SECONDS)).await {
                    tell(MachineEvent::Releases { at: position(at) }).context(NOBODY)?;
                    succeed(&goal, &[0; RELEASED]);
                }
            }
            () = stop.wait() => break,
        }
    }
    node.shutdown().await;
    Ok(())
}

/// Works for a duration. Returns false if the goal was preempted; the goal has ended then.
async fn works(
    server: &mut SimpleActionServer,
    goal: &ActionlibServerGoal,
    lasts: Duration,
) -> bool {
    tokio::select! {
        () = sleep(lasts) => true,
        () = server.preempted(goal) => {
            // The goal may have ended already.
            goal.cancelled(None, "stopped on the way").ok();
            false
        }
    }
}

fn succeed(goal: &ActionlibServerGoal, result: &[u8]) {
    if let Err(error) = goal.succeed(result, "") {
        tracing::warn!(%error, "a goal has ended otherwise");
    }
}

/// Creates the server of an action of `ua_msgs` with an empty result of `empty` bytes.
fn serve(
    node: &Node,
    (name, type_name): (&str, &str),
    empty: usize,
) -> anyhow::Result<SimpleActionServer> {
    let options = ActionlibServerOptions::new(Bytes::from(vec![0; empty]));
    let server = ActionlibServer::new(node, name, action_type(type_name)?, options)?;
    Ok(SimpleActionServer::new(server))
}

fn action_type(name: &str) -> anyhow::Result<ActionlibTypes> {
    let name = format!("ua_msgs/{name}")
        .parse()
        .map_err(|error| anyhow!("{name}: {error}"))?;
    let action = TypeRegistry::bundle(Dialect::Ros1)
        .action(&name)
        .with_context(|| format!("{name} is not built in"))?;
    let of = |part: &messages::MessageType| TopicType {
        name: part.name().to_string(),
        md5sum: part.md5().to_owned(),
        definition: part.definition().to_owned(),
    };
    Ok(ActionlibTypes {
        goal: of(action.action_goal()),
        result: of(action.action_result()),
        feedback: of(action.action_feedback()),
    })
}

/// Returns the target of a goal of `ua_msgs/PtpMove`: its first six numbers.
fn target(goal: &[u8]) -> Option<[f64; 6]> {
    let mut at = [0.0; 6];
    let mut rest = goal;
    for number in &mut at {
        let (bytes, behind) = rest.split_first_chunk()?;
        *number = f64::from_le_bytes(*bytes);
        rest = behind;
    }
    Some(at)
}

/// Encodes a result of `ua_msgs/PtpMove`: the run, without a number here, and the position.
fn moved(at: [f64; 6]) -> Vec<u8> {
    let mut result = vec![0; 4];
    result.extend(at.into_iter().flat_map(f64::to_le_bytes));
    result
}

const fn position([x, y, z, ..]: [f64; 6]) -> [f64; 3] {
    [x, y, z]
}

/// The actions and their types.
const MOVE: (&str, &str) = ("/niryo_ned/move", "PtpMove");
const GRASP: (&str, &str) = ("/niryo_ned/grasp", "Grasp");
const RELEASE: (&str, &str) = ("/niryo_ned/release", "Release");
/// Sizes of their results in bytes.
const MOVED: usize = 4 + 6 * 8;
const GRASPED: usize = 5;
const RELEASED: usize = 4;
const HOME: [f64; 6] = [0.2, 0.0, 0.3, 0.0, 0.0, 0.0];
const MOVE_SECONDS: f64 = 0.8;
const GRIP_SECONDS: f64 = 0.4;
const NOBODY: &str = "the demo does not listen any more";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bodies_are_those_of_the_types() {
        let goal: Vec<u8> = (0..6)
            .flat_map(|number| f64::from(number).to_le_bytes())
            .chain([0; 20])
            .collect();
        let at = target(&goal).unwrap();
        assert_eq!(at, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(moved(at).len(), MOVED);
        assert_eq!(target(&goal[..47]), None);
    }

    #[test]
    fn the_types_are_built_in() {
        for (_, name) in [MOVE, GRASP, RELEASE] {
            let action = action_type(name).unwrap();
            assert_eq!(action.goal.name, format!("ua_msgs/{name}ActionGoal"));
        }
    }
}
