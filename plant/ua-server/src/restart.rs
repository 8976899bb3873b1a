//! Starting anew as the same process, with the same arguments: the library reads the server's certificate once.
//!
//! The program ends as when somebody stops it, with goodbyes to the space and to clients, and begins again in its own place, so that
//! whoever looks after it sees one that runs on.

use std::env;
use std::os::unix::process::CommandExt as _;
use std::process::{Command, ExitCode};
use std::sync::atomic::{AtomicBool, Ordering};

use bridge_node::FailureKind;
use rustix::process::{Signal, getpid, kill_process};
use tracing::{error, warn};

static ASKED: AtomicBool = AtomicBool::new(false);

/// Has the program end, and begin again.
pub(crate) fn ask() {
    if ASKED.swap(true, Ordering::Relaxed) {
        return;
    }
    if let Err(error) = kill_process(getpid(), Signal::TERM) {
        ASKED.store(false, Ordering::Relaxed);
        warn!(%error, "the server cannot be started anew by itself: start it anew for its new certificate");
    }
}

/// Begins again where that was asked for; ends else.
pub(crate) fn again(ended: ExitCode) -> ExitCode {
    if !ASKED.load(Ordering::Relaxed) {
        return ended;
    }
    let mut arguments = env::args_os();
    let name = arguments.next().unwrap_or_default();
    let program = env::current_exe().unwrap_or_else(|_| name.clone().into());
    let error = Command::new(&program).arg0(name).args(arguments).exec();
    error!(%error, program = %program.display(), "the server cannot be started anew");
    FailureKind::Io.into()
}
