//! The two simulated robots: what they decide, and the nodes they decide it in.

pub(crate) mod niryo;
pub(crate) mod turtlebot;
pub(crate) mod niryo_node;
pub(crate) mod turtlebot_node;

#[cfg(test)]
mod line_tests;
