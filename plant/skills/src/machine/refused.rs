//! The reasons why a skill refuses a call.

use program::{ProgramMachineState, ProgramMethod, RefusedMethod, RunId};

use crate::refusal::{RefusalCode, SkillRefusal};

pub(super) fn not_now(method: ProgramMethod, state: ProgramMachineState) -> SkillRefusal {
    refusal(RefusedMethod::State { method, state })
}

pub(super) fn refusal(refused: RefusedMethod) -> SkillRefusal {
    let code = if refused == RefusedMethod::CannotSuspend {
        RefusalCode::NotSupported
    } else {
        RefusalCode::InvalidState
    };
    SkillRefusal::new(code, refused.to_string())
}

pub(super) fn still_at_work(run: RunId) -> SkillRefusal {
    let text = format!("the work of run {} has not come to an end", run.number());
    SkillRefusal::new(RefusalCode::InvalidState, text)
}

pub(super) fn is_stopped(method: ProgramMethod, run: RunId) -> SkillRefusal {
    let text = format!(
        "{method} is not possible: run {} is being stopped",
        run.number()
    );
    SkillRefusal::new(RefusalCode::InvalidState, text)
}

pub(super) fn no_room() -> SkillRefusal {
    SkillRefusal::new(
        RefusalCode::TooManyOperations,
        "too many calls of this skill wait already",
    )
}
