//! Restarts the program in the same process with the same arguments: libraries read the
//! certificate of a server only once, and the address space of a component follows its file at the
//! start.
//!
//! The program ends as after SIGTERM, with goodbyes to the space and to clients, and then executes
//! its own file again. The process id stays the same.

use std::env;
use std::os::unix::process::CommandExt as _;
use std::process::{Command, ExitCode};
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::process::{Signal, getpid, kill_process};
use tracing::{error, warn};

use crate::exit::FailureKind;

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// Ends the program in order, and restarts it in the same process.
pub fn restart() {
    if REQUESTED.swap(true, Ordering::Relaxed) {
        return;
    }
    if let Err(error) = kill_process(getpid(), Signal::TERM) {
        REQUESTED.store(false, Ordering::Relaxed);
        warn!(%error, "cannot restart this program: restart it by hand");
    }
}

/// Returns whether the program ends in order to be executed again.
#[must_use]
pub fn is_requested() -> bool {
    REQUESTED.load(Ordering::Relaxed)
}

/// Ends the program in order, as after SIGTERM.
pub fn stop() {
    if let Err(error) = kill_process(getpid(), Signal::TERM) {
        warn!(%error, "cannot stop this program");
    }
}

/// Executes the program again after [`restart`]; otherwise returns its exit code.
#[must_use]
pub fn executed_again(ended: ExitCode) -> ExitCode {
    if !is_requested() {
        return ended;
    }
    let mut arguments = env::args_os();
    let name = arguments.next().unwrap_or_default();
    let program = env::current_exe().unwrap_or_else(|_| name.clone().into());
    let error = Command::new(&program).arg0(name).args(arguments).exec();
    error!(%error, program = %program.display(), "cannot start this program again");
    FailureKind::Io.into()
}
