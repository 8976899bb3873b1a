//! A program of the plant that carries no space: from its command line to its end, without a
//! mapping and a run loop.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Parser;
use clap::error::ErrorKind;
use tracing::error;

use crate::exit::{Failure, FailureKind};
use crate::logging::{self, LogFormat};
use crate::{descriptors, restart, signals};

/// What one program is, for [`run_service`].
pub trait Service: Parser {
    /// Log directives that hush what a library says without need.
    const QUIET: &'static str = "";

    /// How log lines look.
    fn log(&self) -> LogFormat;

    /// Does its work until it is told to stop.
    ///
    /// # Errors
    /// What keeps it from its work.
    fn serve(
        self,
        stop: impl Future<Output = ()> + Send + 'static,
    ) -> impl Future<Output = Result<(), Failure>>;
}

/// Runs a program from its command line to its end, on one thread. `arguments` begin with the name
/// of the program, as those of [`std::env::args_os`] do.
#[must_use]
pub fn run_service<S: Service>(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let service: S = match parse(arguments) {
        Ok(service) => service,
        Err(code) => return code,
    };
    logging::start(service.log(), S::QUIET);
    descriptors::raise();
    restart::executed_again(match serve(service) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            error!("{failure}");
            failure.kind().into()
        }
    })
}

fn serve<S: Service>(service: S) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::new(FailureKind::Io, format!("cannot start: {error}")))?;
    let ended = runtime.block_on(async move { service.serve(signals::stopped()?).await });
    runtime.shutdown_background();
    ended
}

/// The command line; or how to end where it asks for help or cannot be read.
pub(crate) fn parse<P: Parser>(
    arguments: impl IntoIterator<Item = OsString>,
) -> Result<P, ExitCode> {
    P::try_parse_from(arguments).map_err(|usage| {
        // Nobody is left to tell when stdout or stderr is closed.
        let _printed = usage.print();
        let asked = [ErrorKind::DisplayHelp, ErrorKind::DisplayVersion];
        match asked.contains(&usage.kind()) {
            true => ExitCode::SUCCESS,
            false => FailureKind::Usage.into(),
        }
    })
}
