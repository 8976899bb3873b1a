//! The two simulated robots: what they decide, and the nodes they decide it in.

use std::time::Duration;

use tokio::time::Instant;

pub(crate) mod niryo;
pub(crate) mod niryo_node;
pub(crate) mod turtlebot;
pub(crate) mod turtlebot_node;

#[cfg(test)]
mod line_tests;

/// How often a robot repeats its states.
const REPEAT: Duration = Duration::from_millis(500);

/// An instant that no story reaches.
fn far_away(from: Instant) -> Instant {
    from + Duration::from_secs(365 * 24 * 3600)
}
