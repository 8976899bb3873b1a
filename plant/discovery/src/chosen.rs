//! Finds the discovery server to register with by mDNS: [`find_lds`].

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use registry::hierarchy::{ChosenServer, ServerCandidate, ServerChoice};
use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval};
use tracing::{info, warn};

use crate::watch::{PresentServer, ServerChange, ServerWatcher, WatchSettings};
use mdns::MdnsFault;
use mdns::MdnsInterface;

/// Looks for marker nodes in the address space of a discovery server, which requires a session.
#[async_trait]
pub trait Marks: Send + Sync + 'static {
    /// Returns whether the server at `url` has a node such as `nsu=urn:cell;s=Marker`; `false` if
    /// the server does not answer in time.
    async fn has(&self, url: &str, node: &str) -> bool;
}

/// Follows the chosen discovery server of a network while the receiver exists. The value is `None`
/// while no discovery server fits, or while several fit, which is logged. The search browses the
/// announcements of all servers by mDNS, beside the announcement of the program itself.
///
/// # Errors
/// Returns an error if the mDNS daemon cannot be started.
pub fn find_lds(
    choice: ServerChoice,
    interface: &MdnsInterface,
    marks: Option<Arc<dyn Marks>>,
) -> Result<watch::Receiver<Option<String>>, MdnsFault> {
    if let ServerChoice::At(url) = choice {
        // The URL is fixed; without a sender the value does not change.
        return Ok(watch::channel(Some(url)).1);
    }
    let watcher = crate::watch(WatchSettings {
        mdns: Some(interface.clone()),
        lds_only: true,
        ..WatchSettings::default()
    })?;
    let (tell, chosen) = watch::channel(None);
    let finding = Finding {
        choice,
        marks,
        there: BTreeMap::new(),
        told: ChosenServer::Nobody,
    };
    tokio::spawn(finding.run(watcher, tell));
    Ok(chosen)
}

struct Finding {
    choice: ServerChoice,
    marks: Option<Arc<dyn Marks>>,
    there: BTreeMap<String, ServerCandidate>,
    told: ChosenServer,
}

impl Finding {
    async fn run(mut self, mut watcher: ServerWatcher, tell: watch::Sender<Option<String>>) {
        let mut again = interval(LOOK_AGAIN);
        again.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                found = watcher.next() => match found {
                    Some(found) => self.take(&found).await,
                    None => return,
                },
                // The marker node may appear later than the announcement of the server.
                _ = again.tick() => self.look_again().await,
                () = tell.closed() => return,
            }
            let chosen = self.choose();
            tell.send_if_modified(|known| {
                let changed = *known != chosen;
                *known = chosen;
                changed
            });
        }
    }

    async fn take(&mut self, found: &ServerChange) {
        match found {
            ServerChange::Seen(known) | ServerChange::Restarted(known) if known.is_lds() => {
                let candidate = self.candidate(known).await;
                self.there.insert(known.name.clone(), candidate);
            }
            ServerChange::Seen(known)
            | ServerChange::Restarted(known)
            | ServerChange::Gone { known, .. } => {
                self.there.remove(&known.name);
            }
        }
    }

    async fn candidate(&self, known: &PresentServer) -> ServerCandidate {
        ServerCandidate {
            name: known.name.clone(),
            url: known.url.clone(),
            application_uri: known.application_uri.clone(),
            is_marked: self.is_marked(&known.url).await,
        }
    }

    async fn look_again(&mut self) {
        let unmarked: Vec<(String, String)> = self
            .there
            .values()
            .filter(|one| !one.is_marked)
            .map(|one| (one.name.clone(), one.url.clone()))
            .collect();
        for (name, url) in unmarked {
            if self.is_marked(&url).await
                && let Some(candidate) = self.there.get_mut(&name)
            {
                candidate.is_marked = true;
            }
        }
    }

    async fn is_marked(&self, url: &str) -> bool {
        match (&self.choice, &self.marks) {
            (ServerChoice::Marker(node), Some(marks)) => marks.has(url, node).await,
            (
                ServerChoice::Marker(_)
                | ServerChoice::Any
                | ServerChoice::At(_)
                | ServerChoice::Uri(_)
                | ServerChoice::Name(_),
                _,
            ) => false,
        }
    }

    fn tell(&self, chosen: &ChosenServer) {
        let choice = &self.choice;
        let message = match chosen {
            ChosenServer::Nobody => "no discovery server found".to_owned(),
            ChosenServer::At(url) => format!("found the discovery server at {url}"),
            ChosenServer::Several(names) => {
                let names = names.join(", ");
                warn!(
                    %choice,
                    "not registered, because several discovery servers were found: {names}; choose with name=..."
                );
                return;
            }
        };
        info!(%choice, "{message}");
    }

    fn choose(&mut self) -> Option<String> {
        let candidates: Vec<ServerCandidate> = self.there.values().cloned().collect();
        let chosen = self.choice.among(&candidates);
        if chosen != self.told {
            self.tell(&chosen);
            self.told = chosen.clone();
        }
        match chosen {
            ChosenServer::At(url) => Some(url),
            ChosenServer::Nobody | ChosenServer::Several(_) => None,
        }
    }
}

const LOOK_AGAIN: Duration = Duration::from_secs(5);
