//! The two simulated robots: their logic and their nodes.

use std::time::Duration;

use tokio::time::Instant;

pub(crate) mod niryo;
pub(crate) mod niryo_node;
pub(crate) mod turtlebot;
pub(crate) mod turtlebot_node;

#[cfg(test)]
mod line_tests;

/// Interval in which a robot repeats its states.
const REPEAT: Duration = Duration::from_millis(500);

/// Returns an instant after the end of any scenario.
fn far_away(from: Instant) -> Instant {
    from + Duration::from_secs(365 * 24 * 3600)
}
