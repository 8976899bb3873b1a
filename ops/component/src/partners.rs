//! Discovers the components on which skills of this component depend.

use discovery::{MdnsInterface, ServerChange, WatchSettings, watch};
use skills::PeerAccess;
use tokio::task::JoinSet;
use tracing::warn;

/// Starts to discover other components if a skill needs them, for as long as the tasks are kept.
pub(crate) fn look(peers: &PeerAccess, mdns: Option<&MdnsInterface>) -> JoinSet<()> {
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
                ServerChange::Gone { .. } => detector.gone(&known.name),
                ServerChange::Seen(_) | ServerChange::Restarted(_) if known.is_lds() => {}
                ServerChange::Seen(_) => detector.seen(&known.name, &known.url),
                ServerChange::Restarted(_) => {
                    detector.gone(&known.name);
                    detector.seen(&known.name, &known.url);
                }
            }
        }
    });
    tasks
}
