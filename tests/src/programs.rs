//! The programs under test, located and started as users start them.

use std::{
    collections::BTreeMap,
    env, fs,
    path::{Path, PathBuf},
    time::Duration,
};

use serde_json::Value;

use crate::{Cell, Child, StartedChild, eventually, metrics};

/// The metrics address of a cell's bridge-ros1.
pub const METRICS_ROS1: &str = "127.0.0.1:9101";
/// The metrics address of a cell's bridge-ros2.
pub const METRICS_ROS2: &str = "127.0.0.1:9102";
/// The metrics address of a cell's ua-server.
pub const METRICS_SERVER: &str = "127.0.0.1:9103";
/// The metrics address of a cell's ua-cell.
pub const METRICS_CELL: &str = "127.0.0.1:9107";
/// The endpoint of a cell's ua-server.
pub const SERVER_ENDPOINT: &str = "opc.tcp://127.0.0.1:4840";

const START: Duration = Duration::from_secs(20);

impl Cell {
    /// Starts bridge-ros1 and waits until it answers. `args` follow the arguments that every cell
    /// needs.
    #[must_use]
    pub fn bridge_ros1(&self, args: &[&str]) -> Child {
        let child = self.bridge_ros1_started(args).start();
        answers("bridge-ros1", METRICS_ROS1);
        child
    }

    /// Returns bridge-ros1, not started yet.
    #[must_use]
    pub fn bridge_ros1_started(&self, args: &[&str]) -> StartedChild {
        self.bridge_ros1_at(args, METRICS_ROS1)
    }

    /// Returns bridge-ros1 with another metrics address, not started yet.
    #[must_use]
    pub fn bridge_ros1_at(&self, args: &[&str], metrics: &str) -> StartedChild {
        self.with_ros1(StartedChild::new("bridge-ros1", &program("bridge-ros1")))
            .args(args)
            .args(["--interface", "lo", "--metrics", metrics])
    }

    /// Returns several programs in one process, with bridge-ros2 in domain 2, not started yet.
    /// `args` follow the arguments that every cell needs.
    #[must_use]
    pub fn ua_cell_started(&self, args: &[&str]) -> StartedChild {
        self.with_ros1(StartedChild::new("ua-cell", &program("ua-cell")))
            .env("ROS_DOMAIN_ID", "2")
            .env("UA_PKI", self.folder().join("pki"))
            .args(args)
            .args(["--interface", "lo", "--metrics", METRICS_CELL])
    }

    /// Starts the example of tcpros that republishes the first topic of each pair as the second
    /// topic. It does not report when it is ready.
    #[must_use]
    pub fn tcpros_relay(&self, node: &str, pairs: &[(String, String)]) -> Child {
        self.with_ros1(StartedChild::new("relay", &program("examples/relay")))
            .args([format!("__name:={node}")])
            .args(pairs.iter().flat_map(|(from, to)| [from, to]))
            .start()
    }

    /// Starts bridge-ros2 in domain 2 and waits until it answers. `args` follow the arguments that
    /// every cell needs.
    #[must_use]
    pub fn bridge_ros2(&self, args: &[&str]) -> Child {
        let child = self.bridge_ros2_started(args).start();
        answers("bridge-ros2", METRICS_ROS2);
        child
    }

    /// Returns bridge-ros2 in domain 2, not started yet.
    #[must_use]
    pub fn bridge_ros2_started(&self, args: &[&str]) -> StartedChild {
        self.bridge_ros2_alone(args).args(["--domain", "2"])
    }

    /// Returns bridge-ros2 in the domain of `args` or of the mapping, not started yet.
    #[must_use]
    pub fn bridge_ros2_alone(&self, args: &[&str]) -> StartedChild {
        self.bridge_ros2_at(args, METRICS_ROS2)
    }

    /// Returns bridge-ros2 with another metrics address, not started yet.
    #[must_use]
    pub fn bridge_ros2_at(&self, args: &[&str], metrics: &str) -> StartedChild {
        StartedChild::new("bridge-ros2", &program("bridge-ros2"))
            .args(args)
            .args(["--interface", "lo", "--metrics", metrics])
    }

    /// Returns the example of bridge-ros2 that republishes a topic of domain 2 as another topic,
    /// not started yet.
    #[must_use]
    pub fn ros2_relay_started(&self, from: &str, to: &str) -> StartedChild {
        StartedChild::new("relay", &program("examples/ros2_relay")).args([from, to, "2"])
    }

    /// Starts ua-server and waits until it answers. `args` follow the arguments that every cell
    /// needs.
    #[must_use]
    pub fn ua_server(&self, args: &[&str]) -> Child {
        let child = self.ua_server_started(args).start();
        answers("ua-server", METRICS_SERVER);
        child
    }

    /// Returns ua-server, not started yet.
    #[must_use]
    pub fn ua_server_started(&self, args: &[&str]) -> StartedChild {
        StartedChild::new("ua-server", &program("ua-server"))
            .args(args)
            .args(["--pki".into(), self.folder().join("pki")])
            .args(["--interface", "lo", "--metrics", METRICS_SERVER])
    }
}

fn answers(name: &str, address: &str) {
    eventually(
        &format!("{name} answers at {address}/status"),
        START,
        || metrics(address),
    );
}

/// Returns the sum of all numbers with the key `key`, at any depth: a status may count per topic or
/// in total.
#[must_use]
pub fn number(status: &Value, key: &str) -> u64 {
    match status {
        Value::Object(fields) => fields
            .iter()
            .map(|(name, value)| match value.as_u64() {
                Some(count) if name == key => count,
                _ => number(value, key),
            })
            .sum(),
        Value::Array(items) => items.iter().map(|item| number(item, key)).sum(),
        _ => 0,
    }
}

/// Returns the number of samples and datagrams that a program dropped, for any reason.
#[must_use]
pub fn drops(status: &Value) -> u64 {
    drops_by_reason(status).values().sum()
}

/// Returns the dropped values of a status by reason.
#[must_use]
pub fn drops_by_reason(status: &Value) -> BTreeMap<String, u64> {
    let mut sums = BTreeMap::new();
    add_drops(status, &mut sums);
    sums
}

fn add_drops(status: &Value, sums: &mut BTreeMap<String, u64>) {
    match status {
        Value::Object(fields) => {
            for (name, value) in fields {
                match value.as_object() {
                    Some(reasons) if name == "dropped" => {
                        for (reason, count) in reasons {
                            *sums.entry(reason.clone()).or_default() +=
                                count.as_u64().unwrap_or_default();
                        }
                    }
                    _ => add_drops(value, sums),
                }
            }
        }
        Value::Array(items) => items.iter().for_each(|item| add_drops(item, sums)),
        _ => {}
    }
}

/// Returns the path of a program of this workspace.
///
/// # Panics
/// Panics if the program has not been built, or if a program with the name of a link to `ua-bridge`
/// is left from another build.
#[must_use]
pub fn program(name: &str) -> PathBuf {
    let given = env::var_os("UA_BIN_DIR").map(PathBuf::from);
    let beside = env::current_exe()
        .ok()
        .and_then(|test| Some(test.parent()?.parent()?.to_path_buf()));
    let folders: Vec<PathBuf> = given.into_iter().chain(beside).collect();
    let path = folders
        .iter()
        .map(|folder| folder.join(name))
        .find(|path| Path::is_file(path))
        .unwrap_or_else(|| {
            panic!("{name} has not been built (looked in {folders:?}): run `cargo xtask test`, which builds it first")
        });
    let is_link = fs::read_link(&path).is_ok_and(|target| target == Path::new("ua-bridge"));
    assert!(
        is_link || !name.starts_with("ua-"),
        "{} is no link to ua-bridge: run `cargo xtask build`, which makes the links",
        path.display()
    );
    path
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn all_reasons_of_all_topics_are_drops() {
        let status = json!({"topics": {"a": {"sent": 7, "dropped": {"looped": 1, "malformed": 2}}},
                            "others": {"dropped": {"not_in_space": 4}}});
        assert_eq!(drops(&status), 7);
        assert_eq!(drops(&json!({"sent": 3})), 0);
    }

    #[test]
    fn a_count_is_summed_over_all_topics_of_a_status() {
        let status =
            json!({"malformed": 2, "topics": [{"malformed": 3}, {"malformed": 4, "looped": 9}]});
        assert_eq!(number(&status, "malformed"), 9);
    }
}
