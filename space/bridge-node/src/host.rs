//! The parts of a process that its programs share.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;

use service::{Ask, Failure, FailureKind, Pages, Site, service_manager};
use tokio::sync::watch;
use transport::ProcessHub;

use crate::status::StatusSnapshot;
use crate::tap::Taps;

/// The parts of a process that its programs share: the pages, the tapped topics, and the messages
/// between the programs.
#[derive(Debug, Clone)]
pub(crate) struct ProcessHost {
    hub: ProcessHub,
    taps: Arc<Taps>,
    pages: Arc<Pages<StatusSnapshot>>,
    /// The programs of the process; `None` for a program alone.
    programs: Option<Arc<watch::Sender<ProgramStates>>>,
}

/// The states of the programs of a process.
#[derive(Debug, Clone, Default)]
pub(crate) struct ProgramStates(BTreeMap<&'static str, ProgramState>);

/// The state of a program that shares its process.
#[derive(Debug, Clone, PartialEq, Eq)]
enum ProgramState {
    /// The program has not run yet.
    Starting,
    Running,
    /// The program has failed, and is started again soon.
    Failed,
    /// The program is started again after a change of its configuration.
    Refused(Failure),
}

impl ProgramStates {
    /// Returns whether each program has started or failed.
    pub(crate) fn have_started(&self) -> bool {
        !self
            .0
            .values()
            .any(|state| *state == ProgramState::Starting)
    }

    /// Returns the failure of the first program if none can run before a change of the
    /// configuration.
    pub(crate) fn refusal(&self) -> Option<Failure> {
        let refused = self.0.values().map(|state| match state {
            ProgramState::Refused(failure) => Some(failure),
            ProgramState::Starting | ProgramState::Running | ProgramState::Failed => None,
        });
        let all: Option<Vec<&Failure>> = refused.collect();
        all?.first().copied().cloned()
    }
}

impl ProcessHost {
    /// Returns the host of a program that is alone in its process.
    pub(crate) fn alone(program: &'static str) -> Self {
        let taps = Arc::<Taps>::default();
        Self {
            hub: ProcessHub::default(),
            pages: Arc::new(Pages::alone(program, Some(Arc::clone(&taps) as _))),
            taps,
            programs: None,
        }
    }

    /// Returns the host of several programs.
    pub(crate) fn of_cell(programs: &[&'static str]) -> Self {
        let taps = Arc::<Taps>::default();
        let starting = programs.iter().map(|name| (*name, ProgramState::Starting));
        let states = ProgramStates(starting.collect());
        Self {
            hub: ProcessHub::default(),
            pages: Arc::new(Pages::of_cell(programs, Arc::clone(&taps) as _)),
            taps,
            programs: Some(Arc::new(watch::Sender::new(states))),
        }
    }

    /// Returns the connection of the carriers of the process, if there may be several of them.
    pub(crate) fn hub(&self, several: bool) -> Option<&ProcessHub> {
        (several || self.programs.is_some()).then_some(&self.hub)
    }

    pub(crate) const fn taps(&self) -> &Arc<Taps> {
        &self.taps
    }

    pub(crate) fn pages(&self) -> &Pages<StatusSnapshot> {
        &self.pages
    }

    /// Follows the states of the programs of a cell.
    pub(crate) fn states(&self) -> Option<watch::Receiver<ProgramStates>> {
        self.programs.as_ref().map(|programs| programs.subscribe())
    }

    fn set(&self, program: &'static str, state: ProgramState) {
        if let Some(programs) = &self.programs {
            programs.send_modify(|programs| {
                programs.0.insert(program, state);
            });
        }
    }

    /// Notes that a program starts. A program alone serves its pages from here on; their requests
    /// wait for its run loops.
    ///
    /// # Errors
    /// The address of the pages cannot be bound.
    pub(crate) async fn starting(
        &self,
        program: &'static str,
        (asks, site): (&[Ask<StatusSnapshot>], Option<&Arc<dyn Site>>),
        address: Option<SocketAddr>,
    ) -> Result<(), Failure> {
        if self.programs.is_none() {
            self.pages.run(program, asks.to_vec());
            self.pages.listen(address).await?;
            if let Some(site) = site {
                self.pages.show(Arc::clone(site));
            }
        }
        Ok(())
    }

    /// Notes that a program runs.
    pub(crate) fn started(
        &self,
        program: &'static str,
        (asks, site): (Vec<Ask<StatusSnapshot>>, Option<Arc<dyn Site>>),
    ) {
        if self.programs.is_none() {
            return service_manager::ready();
        }
        self.pages.run(program, asks);
        if let Some(site) = site {
            self.pages.show(site);
        }
        self.set(program, ProgramState::Running);
    }

    /// Notes that a program has failed. `again` states when it is started again.
    pub(crate) fn failed(&self, program: &'static str, failure: &Failure, again: &str) {
        self.pages.down(program, format!("{failure}; {again}"));
        let refused = [FailureKind::Usage, FailureKind::Configuration];
        let state = if refused.contains(&failure.kind()) {
            ProgramState::Refused(failure.clone())
        } else {
            ProgramState::Failed
        };
        self.set(program, state);
    }

    /// Notes that a program is about to end. The end of a cell is noted by the cell.
    pub(crate) fn ending(&self) {
        if self.programs.is_none() {
            service_manager::ending();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_ends_when_no_program_can_run_before_a_change_of_the_configuration() {
        let host = ProcessHost::of_cell(&["bridge-ros1", "bridge-ros2"]);
        let states = host.states().unwrap();
        let failure = |kind| Failure::new(kind, "no");
        assert!(!states.borrow().have_started());
        let configuration = failure(FailureKind::Configuration);
        host.failed("bridge-ros2", &configuration, "later");
        assert!(!states.borrow().have_started() && states.borrow().refusal().is_none());
        host.failed("bridge-ros1", &failure(FailureKind::Unavailable), "soon");
        assert!(states.borrow().have_started() && states.borrow().refusal().is_none());
        host.failed("bridge-ros1", &failure(FailureKind::Usage), "later");
        assert_eq!(states.borrow().refusal(), Some(failure(FailureKind::Usage)));
        host.started("bridge-ros2", (Vec::new(), None));
        assert_eq!(states.borrow().refusal(), None);
    }
}
