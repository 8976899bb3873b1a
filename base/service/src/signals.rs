//! The signals of a program.

use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::exit::{Failure, FailureKind};

/// Completes at the first SIGINT or SIGTERM.
///
/// # Errors
/// The system refuses to deliver signals.
pub fn stopped() -> Result<impl Future<Output = ()> + Send + 'static, Failure> {
    let (mut interrupt, mut terminate) = (
        listen(SignalKind::interrupt())?,
        listen(SignalKind::terminate())?,
    );
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    })
}

/// Returns a stream of a signal.
///
/// # Errors
/// The system refuses to deliver the signal.
pub fn listen(kind: SignalKind) -> Result<Signal, Failure> {
    signal(kind).map_err(|error| {
        Failure::new(
            FailureKind::Io,
            format!("cannot listen for signals: {error}"),
        )
    })
}
