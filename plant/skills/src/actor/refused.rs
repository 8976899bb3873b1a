//! The reasons why the task of a skill refuses a call.

use program::{Method, Refused, RunId, State};

use crate::refusal::{Code, Refusal};

pub(super) fn not_now(method: Method, state: State) -> Refusal {
    refusal(Refused::State { method, state })
}

pub(super) fn refusal(refused: Refused) -> Refusal {
    let code = if refused == Refused::CannotSuspend {
        Code::NotSupported
    } else {
        Code::InvalidState
    };
    Refusal::new(code, refused.to_string())
}

pub(super) fn unknown_outcome(run: u32) -> Refusal {
    let text = format!("the outcome of run {run} is unknown; Reset makes the skill ready");
    Refusal::new(Code::InvalidState, text)
}

pub(super) fn still_at_work(run: RunId) -> Refusal {
    let text = format!("the work of run {} has not come to an end", run.number());
    Refusal::new(Code::InvalidState, text)
}
