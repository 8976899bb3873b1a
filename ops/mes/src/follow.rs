//! Updates the graph from discovery: queries the skills and configurable fields of discovered
//! servers, and removes lost servers.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use discovery::{PresentServer, ServerChange, ServerWatcher};
use knowledge::{ComponentFacts, NodeName};
use skills::{FoundSkill, SkillClient, SkillFault, StationChanges};
use tokio::task::{AbortHandle, JoinSet};
use tracing::{debug, warn};

use crate::cell::{PlantState, QueriedComponent, SeenServer};
use crate::clock::{now, since_1970};
use crate::live;
use crate::servers::LiveServers;

/// Follows discovery until it ends. With `only_loopback`, servers at other addresses are ignored.
pub(crate) async fn follow(
    (cell, servers): (Arc<PlantState>, Arc<LiveServers>),
    mut watcher: ServerWatcher,
    only_loopback: bool,
) {
    let mut looks = JoinSet::new();
    let mut looking: HashMap<String, AbortHandle> = HashMap::new();
    loop {
        let found = tokio::select! {
            found = watcher.next() => found,
            Some(_) = looks.join_next() => continue,
        };
        let Some(found) = found else { return };
        let known = found.known();
        if known.is_lds() {
            continue;
        }
        if !only_loopback || is_loopback(&known.url) {
            servers.discovered(&found);
        }
        if let Some(earlier) = looking.remove(&known.name) {
            earlier.abort();
        }
        match found {
            ServerChange::Gone { known, loss } => cell.went(&known.name, loss.label()),
            ServerChange::Restarted(known) => {
                cell.went(&known.name, "it started anew");
                looking.insert(
                    known.name.clone(),
                    looks.spawn(look(Arc::clone(&cell), known, only_loopback)),
                );
            }
            ServerChange::Seen(known) => {
                looking.insert(
                    known.name.clone(),
                    looks.spawn(look(Arc::clone(&cell), known, only_loopback)),
                );
            }
        }
    }
}

/// Queries the skills of a server, and publishes their states while it is connected.
async fn look(cell: Arc<PlantState>, known: PresentServer, only_loopback: bool) {
    if only_loopback && !is_loopback(&known.url) {
        warn!(
            url = known.url,
            "ignored a server that is not on loopback; give --interface to connect to servers of other hosts"
        );
        return;
    }
    let seen = SeenServer {
        name: known.name,
        url: known.url,
        at_ms: since_1970(known.since),
    };
    let mut again = AGAIN;
    loop {
        let began = tokio::time::Instant::now();
        match once(&cell, &seen).await {
            Ok(()) if began.elapsed() > AGAIN_AT_MOST => again = AGAIN,
            Ok(()) => {}
            Err(fault) => debug!(url = seen.url, "a server does not tell its skills: {fault}"),
        }
        tokio::time::sleep(again).await;
        again = (again * 2).min(AGAIN_AT_MOST);
    }
}

async fn once(cell: &PlantState, seen: &SeenServer) -> Result<(), SkillFault> {
    let client = SkillClient::connect(&seen.url, cell.client()).await?;
    let read = async {
        let changes = client.station_changes().await?;
        Ok((changes, client.skills_and_configurations().await?))
    };
    let (changes, (skills, configurations)) = match read.await {
        Ok(read) => read,
        Err(fault) => {
            client.close().await;
            return Err(fault);
        }
    };
    if skills.is_empty() && configurations.is_empty() && changes.is_none() {
        client.close().await;
        debug!(
            url = seen.url,
            "a server has no skills and no configurable fields"
        );
        // Another announcement of the server starts another query.
        return std::future::pending().await;
    }
    let uri = client.application_uri();
    if uri.is_empty() {
        client.close().await;
        return Err(SkillFault::Unexpected(
            "it does not say who it is".to_owned(),
        ));
    }
    let components = QueriedComponent::all(&uri, (skills.clone(), configurations));
    cell.keeps_only(&seen.name, |uri| components.contains_key(uri));
    let listed = now();
    for (of, component) in components {
        let seen = SeenServer {
            url: component.endpoint(&seen.url),
            ..seen.clone()
        };
        cell.came(&seen, &of, component, listed);
    }
    show_states(cell, &client, (&uri, &skills), changes).await;
    client.close().await;
    Ok(())
}

/// Publishes the states of the skills of a server until its connection is lost, or its components
/// change.
async fn show_states(
    cell: &PlantState,
    client: &SkillClient,
    (uri, found): (&str, &[FoundSkill]),
    changes: Option<StationChanges>,
) {
    let iri = |found: &FoundSkill| {
        let behind = found.behind.as_deref();
        let facts = ComponentFacts {
            application_uri: behind.unwrap_or(uri).to_owned(),
            ..ComponentFacts::default()
        };
        Some(facts.skill_iri(&NodeName::parse(&found.node)?))
    };
    let states = live::skills(cell.knowledge(), client, (uri, found), iri);
    match changes {
        Some(mut changes) => tokio::select! {
            () = states => {}
            () = changes.next() => {}
        },
        None => states.await,
    }
}

fn is_loopback(url: &str) -> bool {
    let Some(rest) = url.strip_prefix("opc.tcp://") else {
        return false;
    };
    let authority = rest.split('/').next().unwrap_or_default();
    let host = match authority.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => authority.split(':').next().unwrap_or_default(),
    };
    host == "localhost"
        || host
            .parse::<IpAddr>()
            .is_ok_and(|address| address.is_loopback())
}

const AGAIN: Duration = Duration::from_millis(100);
const AGAIN_AT_MOST: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_is_told_from_elsewhere() {
        for url in [
            "opc.tcp://127.0.0.1:4840/",
            "opc.tcp://localhost:1",
            "opc.tcp://[::1]:4840/x",
            "opc.tcp://127.9.9.9",
        ] {
            assert!(is_loopback(url), "{url}");
        }
        for url in [
            "opc.tcp://10.0.0.1:4840",
            "http://127.0.0.1",
            "opc.tcp://127.0.0.1.example.com:1",
            "opc.tcp://localhost@evil:1",
        ] {
            assert!(!is_loopback(url), "{url}");
        }
    }
}
