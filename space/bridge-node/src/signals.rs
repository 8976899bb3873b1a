//! The signals that end a program.

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;
use tracing::warn;

use crate::exit::{Failure, FailureKind};

/// Completes at the first SIGINT or SIGTERM.
pub(crate) fn stopped() -> Result<impl Future<Output = ()> + Send + 'static, Failure> {
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

/// Counts the requests to switch over (SIGUSR1) and reports the count. Never completes. A program
/// without a rank ignores the signal, whose default action would end it.
pub(crate) fn switches(
    is_ranked: bool,
    counted: watch::Sender<u64>,
) -> Result<impl Future<Output = ()> + Send + 'static, Failure> {
    let mut stream = listen(SignalKind::user_defined1())?;
    Ok(async move {
        while stream.recv().await.is_some() {
            if is_ranked {
                counted.send_modify(|count| *count += 1);
            } else {
                warn!("ignored SIGUSR1: this program runs without --rank");
            }
        }
        std::future::pending().await
    })
}

/// Returns a stream of a signal.
pub(crate) fn listen(kind: SignalKind) -> Result<Signal, Failure> {
    signal(kind).map_err(|error| {
        Failure::new(
            FailureKind::Io,
            format!("cannot listen for signals: {error}"),
        )
    })
}
