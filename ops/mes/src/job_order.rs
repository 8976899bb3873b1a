//! A job order (OPC 10031-4): its state, and the progress of its run.

use plant_opcua::job_control::JobOrder;
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;

/// The states of a job order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum OrderState {
    NotAllowedToStart,
    AllowedToStart,
    Running,
    /// The run is paused: no skill runs, and no further step begins. Clients see Interrupted.
    Paused,
    /// The outcome of the run is unknown: its machines may move.
    Interrupted,
    Ended,
    Aborted,
}

impl OrderState {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::NotAllowedToStart => "NotAllowedToStart",
            Self::AllowedToStart => "AllowedToStart",
            Self::Running => "Running",
            Self::Paused | Self::Interrupted => "Interrupted",
            Self::Ended => "Ended",
            Self::Aborted => "Aborted",
        }
    }

    pub(crate) const fn number(self) -> u32 {
        match self {
            Self::NotAllowedToStart => 1,
            Self::AllowedToStart => 2,
            Self::Running => 3,
            Self::Paused | Self::Interrupted => 4,
            Self::Ended => 5,
            Self::Aborted => 6,
        }
    }
}

/// The progress of a job. Times are in ms since 1970.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct JobProgress {
    /// Whether the job is paused, and no skill runs.
    pub(crate) is_paused: bool,
    pub(crate) outcome: JobOutcome,
    pub(crate) reason: Option<String>,
    pub(crate) started_ms: u64,
    pub(crate) ended_ms: Option<u64>,
    /// The results of the steps, by `step.Result`.
    pub(crate) results: Vec<(String, Json)>,
}

/// The outcome of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum JobOutcome {
    Running,
    Done,
    /// Its end is confirmed.
    Failed,
    Unknown,
}

/// A job order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct KeptJobOrder {
    pub(crate) order: JobOrder,
    pub(crate) state: OrderState,
    pub(crate) progress: Option<JobProgress>,
    /// The reason of the last change of the state, if there is one.
    pub(crate) reason: Option<String>,
    pub(crate) process: String,
    /// The job that is its run.
    pub(crate) job: Option<u64>,
    /// The state that a client wants the run to end in.
    pub(crate) wanted: Option<OrderState>,
}

impl KeptJobOrder {
    /// Creates a job order that may not start yet.
    pub(crate) const fn new(order: JobOrder, process: String) -> Self {
        Self {
            order,
            state: OrderState::NotAllowedToStart,
            progress: None,
            reason: None,
            process,
            job: None,
            wanted: None,
        }
    }

    pub(crate) fn id(&self) -> &str {
        self.order.id.as_ref()
    }

    /// Restores a job order of an earlier run of the program. Nothing is started again: an order
    /// that was allowed to start may have been started, so its outcome is unknown.
    pub(crate) fn restored(
        (order, process): (JobOrder, String),
        state: OrderState,
        (progress, reason): (Option<JobProgress>, Option<String>),
    ) -> Self {
        let (state, reason) = match state {
            OrderState::AllowedToStart
            | OrderState::Running
            | OrderState::Paused
            | OrderState::Interrupted => {
                let why = "the program ended before the end of the job was known";
                (OrderState::Interrupted, Some(why.to_owned()))
            }
            OrderState::NotAllowedToStart | OrderState::Ended | OrderState::Aborted => {
                (state, reason)
            }
        };
        Self {
            state,
            progress,
            reason,
            ..Self::new(order, process)
        }
    }
}

/// Maximum number of job orders.
pub(crate) const MOST_ORDERS: usize = 100;
