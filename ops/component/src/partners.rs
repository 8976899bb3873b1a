//! Discovers the components on which skills of this component depend.

use discovery::{Found, Interface, WatchSettings, watch};
use skills::PeerAccess;
use tokio::task::JoinSet;
use tracing::warn;

/// Starts to discover other components if a skill needs them, for as long as the tasks are kept.
pub(crate) fn look(peers: &PeerAccess, mdns: Option<&Interface>) -> JoinSet<()> {
    let mut tasks = JoinSet::new();
    let Some(detector) = peers.detector.clone() else {
        return tasks;
    };
    let settings = WatchSettings {
        mdns: mdns.cloned(),
        ..WatchSettings::default()
    };
    let mut watcher = match watch(settings) {
        Ok(watcher) => watcher,
        Err(fault) => {
            warn!(%fault, "cannot discover other components by mDNS");
            return tasks;
        }
    };
    tasks.spawn(async move {
        while let Some(found) = watcher.next().await {
            let known = found.known();
            match &found {
                Found::Gone { .. } => detector.gone(&known.name),
                Found::Seen(_) | Found::Restarted(_) if known.is_lds() => {}
                Found::Seen(_) => detector.seen(&known.name, &known.url),
                Found::Restarted(_) => {
                    detector.gone(&known.name);
                    detector.seen(&known.name, &known.url);
                }
            }
        }
    });
    tasks
}
