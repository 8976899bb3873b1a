//! The verbs of `ua-component` beside its component: arguments, runtime and exit codes.

use std::ffi::OsString;
use std::io;
use std::process::ExitCode;

use clap::Parser;

/// Runs a verb with its arguments, the first of which is its name.
pub(crate) fn run<A, F>(
    arguments: impl Iterator<Item = OsString>,
    verb: impl FnOnce(A) -> F,
) -> ExitCode
where
    A: Parser,
    F: Future<Output = io::Result<()>>,
{
    let arguments = match A::try_parse_from(arguments) {
        Ok(arguments) => arguments,
        Err(error) => {
            let code = if error.use_stderr() { USAGE } else { 0 };
            // If printing fails, the exit code still reports the error.
            error.print().ok();
            return ExitCode::from(code);
        }
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    match runtime.and_then(|runtime| runtime.block_on(verb(arguments))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            crate::print(&format!("error: {error}\n"));
            ExitCode::from(UNAVAILABLE)
        }
    }
}

/// `EX_USAGE` and `EX_UNAVAILABLE` of `sysexits.h`.
const USAGE: u8 = 64;
const UNAVAILABLE: u8 = 69;
