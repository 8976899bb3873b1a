//! Every kind of action server with every kind of action client, and goals that end in every way.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Distribution, Peer};

use crate::call_matrix::{mapping, rows_of_page};

/// The time that rospy and rclpy need to start on a busy machine.
const SOON: Duration = Duration::from_secs(60);
const TYPE: &str = "test_msgs/Fibonacci";
const RCLPY: &str = "ros2_rclpy_action.py";

/// The kinds of action clients.
#[derive(Clone, Copy)]
enum Sending {
    SimpleActionClient,
    ActionClient,
    Rclpy(Distribution),
}

const SENDING: [Sending; 4] = [
    Sending::SimpleActionClient,
    Sending::ActionClient,
    Sending::Rclpy(Distribution::Jazzy),
    Sending::Rclpy(Distribution::Kilted),
];

impl Sending {
    const fn name(self) -> &'static str {
        match self {
            Self::SimpleActionClient => "SimpleActionClient",
            Self::ActionClient => "ActionClient",
            Self::Rclpy(Distribution::Jazzy) => "rclpy (Jazzy)",
            Self::Rclpy(Distribution::Kilted) => "rclpy (Kilted)",
        }
    }

    /// Starts a client of an action and waits until it has found its server.
    fn client(self, cell: &Cell, action: &str) -> Client {
        let of_ros1 = |args: &[&str]| cell.rospy_started("calls/actionlib_client.py", args);
        let started = match self {
            Self::SimpleActionClient => of_ros1(&[action, TYPE]),
            Self::ActionClient => of_ros1(&[action, TYPE, "--plain"]),
            Self::Rclpy(distribution) => cell
                .rclpy_started(
                    distribution,
                    RCLPY,
                    &["call", action, "--results", "--wait", "60"],
                )
                .env("ROS_DOMAIN_ID", "3"),
        };
        Client {
            of_ros1: !matches!(self, Self::Rclpy(_)),
            child: started.told().start().ready(SOON),
            sent: 0,
        }
    }
}

/// An action server.
struct Serving {
    name: &'static str,
    action: &'static str,
    of_ros1: bool,
    _child: Child,
}

struct Client {
    child: Child,
    of_ros1: bool,
    sent: u64,
}

/// The end of a goal, and the numbers of its result.
#[derive(Debug, PartialEq)]
enum End {
    Rejected,
    Of(String, Value),
}

impl Client {
    fn send(&mut self, order: i32) -> u64 {
        self.child.tell(&match self.of_ros1 {
            true => json!({"send": {"order": order}}).to_string(),
            false => format!("send {order}"),
        });
        self.sent += 1;
        self.sent - 1
    }

    fn cancel(&mut self, goal: u64) {
        self.child.tell(&match self.of_ros1 {
            true => json!({"cancel": goal}).to_string(),
            false => format!("cancel {goal}"),
        });
    }

    /// Waits until the feedback of a goal has these numbers.
    fn reported(&mut self, goal: u64, numbers: &Value) {
        self.child.wait_for_json("feedback", SOON, |line| {
            let told = match self.of_ros1 {
                true => (line.get("goal")? == goal).then(|| line["feedback"].get("sequence"))??,
                false => (line.get("feedback")? == goal).then(|| line.get("sequence"))??,
            };
            (told == numbers).then_some(())
        });
    }

    fn end(&mut self, goal: u64) -> End {
        self.child.wait_for_json("the end of a goal", SOON, |line| {
            if self.of_ros1 {
                let end = line.get("end").filter(|_| line["goal"] == goal)?;
                return Some(match end.as_str()? {
                    "REJECTED" => End::Rejected,
                    "PREEMPTED" => {
                        End::Of("CANCELED".to_owned(), line["result"]["sequence"].clone())
                    }
                    end => End::Of(end.to_owned(), line["result"]["sequence"].clone()),
                });
            }
            if line.get("goal").is_some_and(|of| *of == goal) && line["accepted"] == false {
                return Some(End::Rejected);
            }
            let status = line
                .get("status")
                .filter(|_| line.get("result") == Some(&json!(goal)))?;
            Some(End::Of(
                status.as_str()?.to_owned(),
                line["sequence"].clone(),
            ))
        })
    }

    /// Returns a letter for each way in which a goal ended as its server intends.
    fn seen(&mut self) -> String {
        let of = |status: &str, numbers: Value| End::Of(status.to_owned(), numbers);
        let mut seen = String::new();
        let cases = [
            ('S', 5, of("SUCCEEDED", json!([1, 1, 2, 3, 5]))),
            ('R', -1, End::Rejected),
            ('A', -2, of("ABORTED", json!([]))),
            ('C', 100, of("CANCELED", json!([1, 1, 2]))),
        ];
        for (letter, order, right) in cases {
            let goal = self.send(order);
            if letter == 'C' {
                self.reported(goal, &json!([1, 1, 2]));
                self.cancel(goal);
            }
            let end = self.end(goal);
            if end == right {
                seen.push(letter);
            } else {
                eprintln!("{letter}: {end:?}, and not {right:?}");
            }
        }
        seen
    }
}

fn servers(cell: &Cell) -> Vec<Serving> {
    let of_ros1 = |name, action, args: &[&str]| {
        let args = [&[action, TYPE, "--node", name][..], args].concat();
        let child = cell.rospy_started("calls/actionlib_server.py", &args);
        (name, action, true, child)
    };
    let of_ros2 = |name, action, distribution| {
        let child = cell.rclpy_started(distribution, RCLPY, &["serve", action]);
        (name, action, false, child)
    };
    let started = [
        of_ros1("SimpleActionServer", "/ua_1_2_70", &["--simple"]),
        of_ros1("ActionServer", "/ua_1_2_75", &[]),
        of_ros2("rclpy (Jazzy)", "/ua_2_2_70", Distribution::Jazzy),
        of_ros2("rclpy (Kilted)", "/ua_2_2_75", Distribution::Kilted),
    ];
    let started =
        started.map(|(name, action, of_ros1, child)| (name, action, of_ros1, child.told().start()));
    let ready = started
        .into_iter()
        .map(|(name, action, of_ros1, child)| Serving {
            name,
            action,
            of_ros1,
            _child: child.ready(SOON),
        });
    ready.collect()
}

/// Returns the row of the table for the observed results.
fn row(cell: &Cell, serving: &Serving) -> Vec<String> {
    let driven = SENDING.map(|sending| {
        let direct = serving.of_ros1 && !matches!(sending, Sending::Rclpy(_));
        match direct {
            true => "direct".to_owned(),
            false => sending.client(cell, serving.action).seen(),
        }
    });
    let mut row = vec![serving.name.to_owned()];
    row.extend(driven);
    row
}

#[test]
fn all_who_serve_actions_are_driven_by_all_who_send_goals() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let servers = servers(&cell);
    let [one, two] = [1, 2].map(|of| mapping(&cell, &format!("{of}.yaml"), of, ""));
    let _bridges = (
        cell.bridge_ros1(&[&one]),
        cell.bridge_ros2_alone(&[&two, "--space", "2,3"]).start(),
    );
    let mut head = vec!["served by".to_owned()];
    head.extend(SENDING.map(|sending| sending.name().to_owned()));
    let seen: Vec<Vec<String>> = servers.iter().map(|of| row(&cell, of)).collect();
    let lines = seen.iter().map(|row| format!("| {} |\n", row.join(" | ")));
    let table: String = lines.collect();
    assert_eq!(
        seen,
        rows_of_page(&head),
        "seen:\n| {} |\n{table}",
        head.join(" | ")
    );
}
