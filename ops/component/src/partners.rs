//! Discovers the components on which skills of this component depend.

use discovery::{Found, Interface, WatchSettings, watch};
use skills::{ClientOptions, Component, Detector};
use tokio::task::JoinSet;
use tracing::warn;

/// Starts to discover other components if a skill needs them, for as long as the tasks are kept.
pub(crate) fn look(
    component: &Component,
    mdns: Option<&Interface>,
) -> (Option<Detector>, JoinSet<()>) {
    let mut tasks = JoinSet::new();
    if !component.looks_for_others() {
        return (None, tasks);
    }
    let settings = WatchSettings {
        mdns: mdns.cloned(),
        ..WatchSettings::default()
    };
    let mut watcher = match watch(settings) {
        Ok(watcher) => watcher,
        Err(fault) => {
            warn!("nobody is found by mDNS: {fault}");
            return (None, tasks);
        }
    };
    let detector = Detector::new(ClientOptions {
        application_uri: component.application_uri.clone(),
        application_name: component.name.clone(),
        ..ClientOptions::default()
    });
    let told = detector.clone();
    tasks.spawn(async move {
        while let Some(found) = watcher.next().await {
            let known = found.known();
            match &found {
                Found::Gone { .. } => told.gone(&known.name),
                Found::Seen(_) | Found::Restarted(_) if known.is_lds() => {}
                Found::Seen(_) => told.seen(&known.name, &known.url),
                Found::Restarted(_) => {
                    told.gone(&known.name);
                    told.seen(&known.name, &known.url);
                }
            }
        }
    });
    (Some(detector), tasks)
}
