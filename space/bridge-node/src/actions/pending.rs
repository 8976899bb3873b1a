//! Goals with a pending cancellation, as `/status` and the end of the program show them.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Instant;

use mappings::TopicId;

use super::graph::GraphGoalId;

/// The withdrawn goals of one action that its server has neither ended nor started to cancel.
#[derive(Debug, Clone, Default)]
pub(super) struct WithdrawnGoals(Arc<Mutex<Goals>>);

/// The withdrawn goals of all actions of a program, including actions that are not served any more.
#[derive(Debug, Default)]
pub(super) struct AllPending(Vec<(TopicId, Weak<Mutex<Goals>>)>);

/// Each goal with the time of its withdrawal.
type Goals = Vec<(GraphGoalId, Instant)>;

impl WithdrawnGoals {
    pub(super) fn show(&self, goals: Goals) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = goals;
    }
}

impl AllPending {
    /// Adds an action.
    pub(super) fn of(&mut self, action: TopicId) -> WithdrawnGoals {
        self.0.retain(|(_, goals)| goals.strong_count() > 0);
        let pending = WithdrawnGoals::default();
        self.0.push((action, Arc::downgrade(&pending.0)));
        pending
    }

    /// Lists the goals, a line each.
    pub(super) fn lines(&self, now: Instant) -> Vec<String> {
        let mut lines = Vec::new();
        for (action, goals) in &self.0 {
            let Some(goals) = goals.upgrade() else {
                continue;
            };
            let goals = goals.lock().unwrap_or_else(PoisonError::into_inner);
            lines.extend(goals.iter().map(|(id, since)| {
                let age = now.saturating_duration_since(*since).as_secs_f64();
                format!(
                    "goal {} of {action}: cancellation pending for {age:.1} s: the action server has not \
                     accepted or rejected the goal, or has not responded",
                    Hex(*id)
                )
            }));
        }
        lines
    }
}

/// A goal id as `ros2 action` prints it.
pub(super) struct Hex(pub(super) GraphGoalId);

impl fmt::Display for Hex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}
