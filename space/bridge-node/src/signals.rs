//! The signal that switches over to another program of a redundant set.

use service::Failure;
use service::signals::listen;
use tokio::signal::unix::SignalKind;
use tokio::sync::watch;
use tracing::warn;

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
