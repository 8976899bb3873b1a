//! The signals that end a program.

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;

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

/// Counts a signal and reports the count. Never completes. The signal keeps its default action if
/// the program does not listen.
pub(crate) fn count(
    listens: bool,
    kind: SignalKind,
    counted: watch::Sender<u64>,
) -> Result<impl Future<Output = ()> + Send + 'static, Failure> {
    let stream = listens.then(|| listen(kind)).transpose()?;
    Ok(async move {
        if let Some(mut stream) = stream {
            while stream.recv().await.is_some() {
                counted.send_modify(|count| *count += 1);
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
