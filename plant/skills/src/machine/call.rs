//! Calls of a skill, and the driver of its next runs.

use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use program::ProgramMethod;

use crate::authority::SkillOwner;
use crate::driver::Driver;
use crate::lock::lock;
use crate::value::SkillValue;

/// The way to a caller. It is consumed by the response, so a call has at most one response.
pub(crate) trait CallReply {
    /// Returns whether the caller still waits for the response.
    fn is_wanted(&self) -> bool;
}

/// A call of a method.
#[derive(Debug)]
pub(crate) struct SkillCallRequest<R> {
    pub(crate) by: SkillOwner,
    pub(crate) method: ProgramMethod,
    pub(crate) given: Given,
    pub(crate) reply: R,
}

impl<R: CallReply> SkillCallRequest<R> {
    /// Returns whether the caller gave up a call that moves the machine. A call that stops the
    /// machine takes effect without its caller.
    pub(super) fn is_withdrawn(&self) -> bool {
        let moves = matches!(self.method, ProgramMethod::Start | ProgramMethod::Resume);
        moves && !self.reply.is_wanted()
    }
}

/// The arguments of a Start call.
#[derive(Debug, Default)]
pub(crate) struct Given {
    /// The parameters; `None` uses the parameters that the caller wrote before.
    pub(crate) parameters: Option<Vec<(String, SkillValue)>>,
    /// Time limit of the run. It applies if it is shorter than the limit of the skill.
    pub(crate) within: Option<Duration>,
    /// Whether a Halted skill is reset first.
    pub(crate) readies: bool,
}

/// The caller of a method, until its response.
#[derive(Debug)]
pub(super) struct Caller<R> {
    pub(super) by: SkillOwner,
    pub(super) method: ProgramMethod,
    pub(super) reply: R,
}

/// The driver and the time limit of the next runs.
pub(crate) struct Successor {
    pub(crate) driver: Arc<dyn Driver>,
    pub(crate) timeout: Option<Duration>,
}

impl fmt::Debug for Successor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut shown = f.debug_struct("Successor");
        shown
            .field("timeout", &self.timeout)
            .finish_non_exhaustive()
    }
}

/// The driver of the run in progress or of the next run, and its replacement.
pub(super) struct DriverSlot {
    driver: Arc<dyn Driver>,
    /// Time limit of a run.
    timeout: Option<Duration>,
    successor: Arc<Mutex<Option<Successor>>>,
}

impl DriverSlot {
    pub(super) const fn new(
        driver: Arc<dyn Driver>,
        timeout: Option<Duration>,
        successor: Arc<Mutex<Option<Successor>>>,
    ) -> Self {
        Self {
            driver,
            timeout,
            successor,
        }
    }

    pub(super) fn driver(&self) -> &Arc<dyn Driver> {
        &self.driver
    }

    /// Adopts a replaced driver, while there is no run. Returns whether there was one.
    pub(super) fn adopt(&mut self) -> bool {
        let Some(Successor { driver, timeout }) = lock(&self.successor).take() else {
            return false;
        };
        self.driver = driver;
        self.timeout = timeout;
        true
    }

    /// Returns the time limit of a run whose caller gave this limit.
    pub(super) fn limit(&self, given: Option<Duration>) -> Option<Duration> {
        [given, self.timeout].into_iter().flatten().min()
    }
}
