//! The common interfaces, with a file per package.
//!
//! A line `message Name` starts a definition for both dialects. `message Name 1` and `message Name
//! 2` start a definition of ROS 1 or ROS 2 if the two differ. A line `service Name` or `action
//! Name`, with `1` or `2` likewise, starts a service or an action. The files contain only field
//! names, types and constants.

use crate::{Dialect, TypeName};

const PACKAGES: [(&str, &str); 26] = [
    ("action_msgs", include_str!("../bundle/action_msgs.txt")),
    (
        "action_tutorials_interfaces",
        include_str!("../bundle/action_tutorials_interfaces.txt"),
    ),
    ("actionlib", include_str!("../bundle/actionlib.txt")),
    (
        "actionlib_msgs",
        include_str!("../bundle/actionlib_msgs.txt"),
    ),
    (
        "actionlib_tutorials",
        include_str!("../bundle/actionlib_tutorials.txt"),
    ),
    (
        "builtin_interfaces",
        include_str!("../bundle/builtin_interfaces.txt"),
    ),
    (
        "diagnostic_msgs",
        include_str!("../bundle/diagnostic_msgs.txt"),
    ),
    (
        "example_interfaces",
        include_str!("../bundle/example_interfaces.txt"),
    ),
    ("geometry_msgs", include_str!("../bundle/geometry_msgs.txt")),
    (
        "lifecycle_msgs",
        include_str!("../bundle/lifecycle_msgs.txt"),
    ),
    (
        "move_base_msgs",
        include_str!("../bundle/move_base_msgs.txt"),
    ),
    ("nav_msgs", include_str!("../bundle/nav_msgs.txt")),
    (
        "rcl_interfaces",
        include_str!("../bundle/rcl_interfaces.txt"),
    ),
    ("roscpp", include_str!("../bundle/roscpp.txt")),
    ("rosgraph_msgs", include_str!("../bundle/rosgraph_msgs.txt")),
    ("sensor_msgs", include_str!("../bundle/sensor_msgs.txt")),
    ("shape_msgs", include_str!("../bundle/shape_msgs.txt")),
    ("std_msgs", include_str!("../bundle/std_msgs.txt")),
    ("std_srvs", include_str!("../bundle/std_srvs.txt")),
    ("stereo_msgs", include_str!("../bundle/stereo_msgs.txt")),
    ("test_msgs", include_str!("../bundle/test_msgs.txt")),
    ("tf2_msgs", include_str!("../bundle/tf2_msgs.txt")),
    (
        "trajectory_msgs",
        include_str!("../bundle/trajectory_msgs.txt"),
    ),
    ("ua_msgs", include_str!("../bundle/ua_msgs.txt")),
    (
        "unique_identifier_msgs",
        include_str!("../bundle/unique_identifier_msgs.txt"),
    ),
    (
        "visualization_msgs",
        include_str!("../bundle/visualization_msgs.txt"),
    ),
];

/// The kind of a definition in the bundle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BundledKind {
    Message,
    Service,
    Action,
}

/// Returns kind, name and text of each definition of the dialect.
pub(crate) fn texts(dialect: Dialect) -> Vec<(BundledKind, TypeName, String)> {
    let other = match dialect {
        Dialect::Ros1 => "2",
        Dialect::Ros2 => "1",
    };
    let mut found: Vec<(BundledKind, TypeName, String)> = Vec::new();
    for (package, text) in PACKAGES {
        let mut skip = true;
        for line in text.lines() {
            if let Some((kind, heading)) = heading(line) {
                let (name, only) = heading.split_once(' ').unwrap_or((heading, ""));
                skip = only == other;
                if !skip && let Ok(name) = TypeName::new(package, name) {
                    found.push((kind, name, String::new()));
                }
            } else if !skip && let Some((_, _, text)) = found.last_mut() {
                if !text.is_empty() {
                    text.push('\n');
                }
                text.push_str(line);
            }
        }
    }
    found
}

fn heading(line: &str) -> Option<(BundledKind, &str)> {
    [
        ("message ", BundledKind::Message),
        ("service ", BundledKind::Service),
        ("action ", BundledKind::Action),
    ]
    .into_iter()
    .find_map(|(word, kind)| Some((kind, line.strip_prefix(word)?)))
}
