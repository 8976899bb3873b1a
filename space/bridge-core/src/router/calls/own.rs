//! The state of the calls of this program.

use std::sync::Arc;
use std::time::Instant;

use mappings::TopicId;

use crate::call_announcement::CallAnnouncement;
use crate::call_plan::ExecutedPlan;

/// A call of this program.
#[derive(Debug)]
pub(super) struct Own {
    /// The display name; may be empty.
    pub(super) name: String,
    pub(super) open: bool,
    /// The plan for its payloads, if the local side uses ROS messages.
    pub(super) plan: Option<Arc<ExecutedPlan>>,
    pub(super) announcement: Option<CallAnnouncement>,
}

/// A request that the local side executes.
#[derive(Debug)]
pub(super) struct RunningRequest {
    pub(super) topic: TopicId,
    pub(super) deadline: Instant,
    /// The plan with which the request was read. A later change of the call does not affect the
    /// execution.
    pub(super) plan: Option<Arc<ExecutedPlan>>,
}
