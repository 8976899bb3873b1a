//! What a skill shows of itself, and to whom.

use std::sync::Arc;
use std::time::SystemTime;

use program::{Method, State, Transition};

use crate::authority::Owner;
use crate::parameters::Parameters;
use crate::refusal::Refusal;
use crate::value::Value;

/// Everything that can be seen of a skill at one moment. It outlives whoever had the run begin.
#[derive(Debug, Clone)]
pub struct Shown {
    /// The state.
    pub state: State,
    /// What led to it; `None` before the first transition.
    pub last: Option<&'static Transition>,
    /// When that was; else when the skill came to be.
    pub since: SystemTime,
    /// The number of the newest run; 0 before the first.
    pub run: u32,
    /// How much of it is done, 0 to 1.
    pub progress: f32,
    /// What it is about.
    pub step: String,
    /// What the newest run was started with.
    pub parameters: Arc<Parameters>,
    /// How the newest run that has ended did so.
    pub outcome: Option<Arc<Outcome>>,
    /// Who did what last.
    pub diagnostic: Diagnostic,
    /// Why a run that is being cancelled has not ended.
    pub pending: Option<String>,
    /// The outcome of the newest run is unknown: only a Reset makes the skill ready.
    pub needs_reset: bool,
    /// For each of [`Method::ALL`] whether a call would be taken now.
    pub executable: [bool; 5],
}

/// The end of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Which run.
    pub run: u32,
    /// Whether it did its work.
    pub succeeded: bool,
    /// Why not, or what there is to say.
    pub message: String,
    /// Its results, in the order of the type; where it failed, none.
    pub results: Vec<(String, Value)>,
    /// Its steps and what was done in them, in order, each with the seconds since its beginning: `0.412 MovePick`.
    pub trace: Vec<String>,
}

/// What ProgramDiagnostic says (OPC 10000-10, 5.2.9).
#[derive(Debug, Clone)]
pub struct Diagnostic {
    /// When the skill came to be.
    pub created: SystemTime,
    /// The last call, taken or refused.
    pub last_call: Option<LastCall>,
}

/// A call of a method.
#[derive(Debug, Clone)]
pub struct LastCall {
    /// Which.
    pub method: Method,
    /// By whom.
    pub by: Owner,
    /// When.
    pub at: SystemTime,
    /// Why it was refused, if it was.
    pub refused: Option<Refusal>,
}

/// A transition that has happened.
#[derive(Debug, Clone)]
pub struct Transitioned {
    /// Which.
    pub transition: &'static Transition,
    /// The newest run; 0 before the first.
    pub run: u32,
    /// For people.
    pub message: String,
    /// When.
    pub at: SystemTime,
}

/// What is told of a skill, in the order in which it happens.
#[derive(Debug, Clone, Copy)]
pub enum Told<'a> {
    /// A run is about to begin with these; its transition follows, and then the work.
    Parameters(&'a Parameters),
    /// A transition. Before the work of a run begins, and after the outcome of a run that ends.
    Transition(&'a Transitioned),
    /// The run has come to another step.
    Step,
    /// The run is being cancelled and has not ended, or cannot be cancelled: why, for people.
    Pending(&'a str),
    /// More of the run is done.
    Progress,
    /// How a run has ended; its transition follows.
    Outcome(&'a Outcome),
    /// A call was taken or refused.
    Called,
}

/// Hears of everything that happens to a skill, in order, from the task that owns it: it may not wait.
pub trait Observer: Send + Sync + 'static {
    /// Something has happened, after which the skill is as `shown`.
    fn told(&self, what: Told<'_>, shown: &Shown);

    /// Nothing more is told of it, since its server cannot be reached: of one that is executed elsewhere.
    fn lost(&self, why: &str) {
        let _is_told_otherwise = why;
    }
}
