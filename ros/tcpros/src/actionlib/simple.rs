//! A server that works on one goal at a time; a newer goal replaces an older goal.

use super::server::{ActionlibServer, ActionlibServerEvent, ActionlibServerGoal};

/// The policy of actionlib's `SimpleActionServer`: one goal is active and one goal waits. A goal
/// with a later stamp than both replaces the waiting goal, and the active goal should give way to
/// it.
#[derive(Debug)]
pub struct SimpleActionServer {
    server: ActionlibServer,
    waiting: Option<ActionlibServerGoal>,
}

impl SimpleActionServer {
    /// Creates a server that takes the goals of `server` one at a time.
    pub const fn new(server: ActionlibServer) -> Self {
        Self {
            server,
            waiting: None,
        }
    }

    /// Waits for the next goal and accepts it. The goal may have a cancel request already.
    /// Cancel-safe.
    pub async fn next(&mut self) -> ActionlibServerGoal {
        loop {
            while let Some(event) = self.server.try_recv() {
                self.take(event, None);
            }
            if let Some(goal) = self.waiting.take() {
                if goal.accept("").is_ok() {
                    return goal;
                }
                continue;
            }
            let event = self.server.recv().await;
            self.take(event, None);
        }
    }

    /// Waits until work on `current` should stop: a client requested to cancel the goal, or a newer
    /// goal waits. Returns at once for a goal that has ended. Then call
    /// [`ActionlibServerGoal::cancelled`] and [`Self::next`]. Cancel-safe.
    pub async fn preempted(&mut self, current: &ActionlibServerGoal) {
        loop {
            if self.waiting.is_some()
                || current.is_cancel_requested()
                || current.status().is_terminal()
            {
                return;
            }
            let event = self.server.recv().await;
            self.take(event, Some(current));
        }
    }

    /// Keeps the goal with the latest stamp waiting. A cancel request is already in the status of
    /// its goal.
    fn take(&mut self, event: ActionlibServerEvent, current: Option<&ActionlibServerGoal>) {
        let ActionlibServerEvent::Goal(goal) = event else {
            return;
        };
        let newest = self.waiting.as_ref().or(current);
        let late = newest.is_some_and(|newest| goal.goal_id().stamp < newest.goal_id().stamp);
        let superseded = if late {
            Some(goal)
        } else {
            self.waiting.replace(goal)
        };
        // The goal cannot have ended, except with the server.
        if let Some(old) = superseded {
            let _closed = old.cancelled(None, SUPERSEDED).is_err();
        }
    }
}

const SUPERSEDED: &str = "another goal replaced it";
