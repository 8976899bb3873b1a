//! To run a skill to its end, wherever it is executed.

use std::future::pending;
use std::time::Duration;

use async_trait::async_trait;
use program::{Method, State};

use crate::authority::Owner;
use crate::refusal::{Code, Refusal};
use crate::shown::Outcome;
use crate::skill::Skill;
use crate::value::Value;

/// A skill that can be run: of another component, or of this program.
#[async_trait]
pub trait Runs: Send + Sync {
    /// What to call it in a message, as `parallel-gripper.Grasp`.
    fn name(&self) -> String;

    /// Makes it ready if it has to be, starts it and waits for the end of the run. A run that failed is an [`Outcome`] too.
    /// When `within` is over, the run is halted.
    ///
    /// # Errors
    /// Why there is no outcome.
    async fn run(
        &self,
        parameters: Vec<(String, Value)>,
        within: Duration,
    ) -> Result<Outcome, SkillFault>;

    /// Halts it, where it is anything but Halted, and waits until its run has ended: a run whose work is done elsewhere may go
    /// on for a while.
    ///
    /// # Errors
    /// Why it may not have come to a stand.
    async fn halt(&self) -> Result<(), SkillFault>;

    /// Ready, with the reason, when its component is not there any more. Pends for as long as it is.
    async fn lost(&self) -> String {
        pending().await
    }
}

/// Why a skill did not do what it was asked for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SkillFault {
    /// Its component does not answer: what has become of the run is not known.
    #[error("its component is lost: {0}")]
    Lost(String),
    /// It refused, and nothing has changed.
    #[error("{status}: {text}")]
    Refused {
        /// The name of the StatusCode, as `BadInvalidState`.
        status: String,
        /// Why, for people.
        text: String,
    },
    /// The run did not end in time, and was told to halt.
    #[error("it did not end within {0:?} and was halted")]
    TimedOut(Duration),
    /// It was told to halt, and its end was not confirmed: whether its machine moves is unknown.
    #[error("{0}")]
    NotHalted(String),
    /// It is not what it should be.
    #[error("{0}")]
    Unexpected(String),
}

impl From<Refusal> for SkillFault {
    fn from(refusal: Refusal) -> Self {
        Self::Refused {
            status: refusal.code.name().to_owned(),
            text: refusal.text,
        }
    }
}

/// A skill of this program, run by one who has the lease under that name.
#[derive(Debug, Clone)]
pub struct LocalRun {
    /// Which.
    pub skill: Skill,
    /// Who runs it.
    pub by: Owner,
}

#[async_trait]
impl Runs for LocalRun {
    fn name(&self) -> String {
        self.skill.facts().name.clone()
    }

    async fn run(
        &self,
        parameters: Vec<(String, Value)>,
        within: Duration,
    ) -> Result<Outcome, SkillFault> {
        let shown = self.skill.shown();
        if shown.needs_reset {
            return Err(SkillFault::Refused {
                status: Code::InvalidState.name().to_owned(),
                text: format!(
                    "the outcome of run {} is unknown; Reset makes the skill ready",
                    shown.run
                ),
            });
        }
        if shown.state == State::Halted {
            let reset = self.skill.call(self.by.clone(), Method::Reset).await;
            // One that was given up before may have come first.
            if self.skill.shown().state != State::Ready {
                reset?;
            }
        }
        let run = self.skill.start_with(self.by.clone(), parameters).await?;
        let mut watch = self.skill.watch();
        let ended = watch.wait_for(|shown| {
            shown.run != run || matches!(shown.state, State::Ready | State::Halted)
        });
        let ended = tokio::time::timeout(within, ended).await;
        match ended.map(|ended| ended.is_ok()) {
            Ok(true) => {}
            Ok(false) => return Err(SkillFault::Lost("the component ends".to_owned())),
            Err(_) => {
                self.halt().await?;
                return Err(SkillFault::TimedOut(within));
            }
        }
        let outcome = self.skill.outcome(run);
        let outcome =
            outcome.ok_or_else(|| SkillFault::Unexpected(format!("run {run} left no outcome")))?;
        Ok(Outcome::clone(&outcome))
    }

    async fn halt(&self) -> Result<(), SkillFault> {
        if self.skill.shown().state != State::Halted {
            self.skill.call(self.by.clone(), Method::Halt).await?;
        }
        let mut watch = self.skill.watch();
        let ended = watch.wait_for(|shown| matches!(shown.state, State::Ready | State::Halted));
        match tokio::time::timeout(HALTS_WITHIN, ended).await {
            Ok(_ended_or_gone) => Ok(()),
            Err(_) => Err(goes_on(&self.name())),
        }
    }
}

/// Why a skill that was told to halt may not have come to a stand.
pub(crate) fn goes_on(name: &str) -> SkillFault {
    SkillFault::NotHalted(format!(
        "{name} was told to halt, and its run has not ended within {HALTS_WITHIN:?}: whether it moves is unknown"
    ))
}

/// How long the end of a run that was told to halt is waited for.
pub(crate) const HALTS_WITHIN: Duration = Duration::from_secs(10);
/// How long after Halt a composite waits for the ends of the runs that it is made of.
pub const COMPOSITE_HALT_TIMEOUT: Duration = Duration::from_secs(12);
