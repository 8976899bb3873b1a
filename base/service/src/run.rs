//! A program of the plant that carries no space: its main function, without a mapping and a run
//! loop.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Parser;
use clap::error::ErrorKind;
use tracing::error;

use crate::exit::{Failure, FailureKind};
use crate::logging::{self, LogFormat};
use crate::{descriptors, restart, service_manager, signals};

/// The parts of a program, for [`run_service`].
pub trait ServiceProgram: Parser {
    /// Log directives that suppress noisy messages of a library.
    const QUIET: &'static str = "";

    /// Returns the format of log lines.
    fn log(&self) -> LogFormat;

    /// Runs the program until `stop` completes. A program that serves calls
    /// [`ready`](crate::service_manager::ready) as soon as it listens.
    ///
    /// # Errors
    /// The reason why the program cannot run.
    fn serve(
        self,
        stop: impl Future<Output = ()> + Send + 'static,
    ) -> impl Future<Output = Result<(), Failure>>;
}

/// Runs a program from its command line to its end, on one thread. `arguments` start with the name
/// of the program, as in [`std::env::args_os`].
#[must_use]
pub fn run_service<S: ServiceProgram>(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
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

fn serve<S: ServiceProgram>(service: S) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::new(FailureKind::Io, format!("cannot start: {error}")))?;
    let ended = runtime.block_on(async move {
        let signal = signals::stopped()?;
        service_manager::start_watchdog();
        let stop = async move {
            signal.await;
            service_manager::ending();
        };
        service.serve(stop).await
    });
    runtime.shutdown_background();
    ended
}

/// Parses the command line.
///
/// # Errors
/// The exit code if the command line asks for help or is invalid. The text is printed.
pub fn parse<P: Parser>(arguments: impl IntoIterator<Item = OsString>) -> Result<P, ExitCode> {
    P::try_parse_from(arguments).map_err(|usage| {
        // Printing fails if stdout or stderr is closed.
        let _printed = usage.print();
        let asked = [ErrorKind::DisplayHelp, ErrorKind::DisplayVersion];
        if asked.contains(&usage.kind()) {
            ExitCode::SUCCESS
        } else {
            FailureKind::Usage.into()
        }
    })
}
