//! The keys of secured groups: read from files that are checked periodically, and fetched from
//! Security Key Services.

mod fetch;
mod file;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bridge_core::{KeyDelivery, Router};
use mappings::{KeySource, Mapping, SecurityGroup};
use service::{Failure, FailureKind};
use tokio::sync::{mpsc, watch};
use tracing::{info, warn};

pub use self::fetch::{Fetched, Fetching, KeyFetchError, KeyRequest, KeyService};
use crate::clock::now;

/// New keys of a group.
#[derive(Debug)]
pub(crate) struct NewKeys {
    pub(crate) group: String,
    pub(crate) delivery: KeyDelivery,
}

/// The sources of the keys of a run loop.
#[derive(Debug)]
pub(crate) struct KeyRing {
    /// The groups that replace the groups of the mapping, if the command line sets them.
    groups: Option<Vec<SecurityGroup>>,
    /// New keys from the keepers.
    incoming: mpsc::Receiver<NewKeys>,
    outgoing: mpsc::Sender<NewKeys>,
    service: Option<Arc<dyn KeyService>>,
    /// The keepers of the groups; each ends when its sender is dropped.
    keepers: BTreeMap<String, Keeper>,
}

#[derive(Debug)]
struct Keeper {
    group: SecurityGroup,
    wanted: watch::Sender<u64>,
}

impl KeyRing {
    pub(crate) fn new(
        groups: Option<Vec<SecurityGroup>>,
        service: Option<Arc<dyn KeyService>>,
    ) -> Self {
        let (outgoing, incoming) = mpsc::channel(WAITING);
        Self {
            groups,
            incoming,
            outgoing,
            service,
            keepers: BTreeMap::new(),
        }
    }

    /// Returns the mapping with the groups of the command line, if there are any.
    pub(crate) fn applied(&self, mapping: Arc<Mapping>) -> Arc<Mapping> {
        match &self.groups {
            Some(groups) => {
                let mapping = Mapping::clone(&mapping);
                Arc::new(mapping.with_security(groups.clone()))
            }
            None => mapping,
        }
    }

    /// Reads the keys from files, and starts a keeper for each group.
    ///
    /// # Errors
    /// A file is missing or unusable: the program could neither receive nor send.
    pub(crate) fn start(&mut self, mapping: &Mapping, router: &mut Router) -> Result<(), Failure> {
        for group in mapping.security() {
            if let Some(path) = path_of(group) {
                let delivery = file::read(&path?, group)?;
                give(router, &group.id, &delivery);
            }
        }
        self.follow(mapping);
        Ok(())
    }

    /// Starts and stops keepers for the groups of a mapping. The keepers read keys from files
    /// themselves.
    pub(crate) fn follow(&mut self, mapping: &Mapping) {
        let groups = mapping.security();
        let stays = |keeper: &Keeper| groups.contains(&keeper.group);
        self.keepers.retain(|_, keeper| stays(keeper));
        for group in groups {
            if group.keys.is_some() && !self.keepers.contains_key(&group.id) {
                let (wanted, wants) = watch::channel(0);
                let keeper = Keeper {
                    group: group.clone(),
                    wanted,
                };
                self.keepers.insert(group.id.clone(), keeper);
                let out = self.outgoing.clone();
                match (&group.keys, &self.service) {
                    (Some(KeySource::Own(_) | KeySource::Sks(_)), Some(service)) => {
                        let service = Arc::clone(service);
                        drop(tokio::spawn(fetch::keep(
                            group.clone(),
                            service,
                            (out, wants),
                        )));
                    }
                    (Some(KeySource::Own(_) | KeySource::Sks(_)), None) => warn!(
                        group = group.id,
                        "this program cannot fetch keys from a Security Key Service: it sends and receives \
                         nothing in the group; use a key file for the group, or the bridge of `ua-bridge`"
                    ),
                    (Some(KeySource::File(_) | KeySource::Credential(_)) | None, _) => {
                        drop(tokio::spawn(watch_file(group.clone(), (out, wants))));
                    }
                }
            }
        }
    }

    /// Returns the next new keys. Cancel-safe.
    pub(crate) async fn next(&mut self) -> Option<NewKeys> {
        self.incoming.recv().await
    }

    /// Requests new keys of a group because its keys are out of date.
    pub(crate) fn want(&self, group: &str) {
        if let Some(keeper) = self.keepers.get(group) {
            keeper.wanted.send_modify(|count| *count += 1);
        }
    }
}

/// Passes keys of a group to the Router.
pub(crate) fn give(router: &mut Router, group: &str, delivery: &KeyDelivery) {
    match router.set_keys(group, delivery, now()) {
        Ok(()) => info!(
            group,
            token = delivery.first_token_id,
            keys = delivery.keys.len(),
            "received keys of a secured group"
        ),
        Err(error) => warn!(group, %error, "rejected the keys of a secured group"),
    }
}

/// Returns the file with the keys of a group, if the group has one.
fn path_of(group: &SecurityGroup) -> Option<Result<PathBuf, Failure>> {
    match group.keys.as_ref()? {
        KeySource::File(path) => Some(Ok(path.clone())),
        KeySource::Credential(name) => Some(credential(name)),
        KeySource::Own(_) | KeySource::Sks(_) => None,
    }
}

/// Returns the path of a credential that systemd provides to a service.
fn credential(name: &str) -> Result<PathBuf, Failure> {
    let folder = std::env::var_os("CREDENTIALS_DIRECTORY").ok_or_else(|| {
        let message = format!(
            "the keys are in the credential {name}, and CREDENTIALS_DIRECTORY is not set: is the program started by \
             systemd, with LoadCredential={name}:FILE?"
        );
        Failure::new(FailureKind::Configuration, message)
    })?;
    Ok(Path::new(&folder).join(name))
}

/// Checks a file periodically, and sends its keys when it has changed.
async fn watch_file(
    group: SecurityGroup,
    (out, mut wants): (mpsc::Sender<NewKeys>, watch::Receiver<u64>),
) {
    let path = match path_of(&group) {
        Some(Ok(path)) => path,
        Some(Err(failure)) => {
            warn!(
                group = group.id,
                "{failure}; this program sends and receives nothing in the group"
            );
            return;
        }
        None => return,
    };
    let mut pause = Duration::ZERO;
    let mut before: Option<Option<Seen>> = None;
    loop {
        tokio::select! {
            () = idle_ticks::sleep(pause) => pause = LOOK,
            changed = wants.changed() => if changed.is_err() {
                return;
            },
        }
        let seen = seen(&path);
        // The first check counts as a change, even if the file is missing: a reload may have added
        // the group.
        if before == Some(seen) {
            continue;
        }
        before = Some(seen);
        if let Some(delivery) = read_again(&path, &group) {
            let group = group.id.clone();
            if out.send(NewKeys { group, delivery }).await.is_err() {
                return;
            }
        }
    }
}

fn read_again(path: &Path, group: &SecurityGroup) -> Option<KeyDelivery> {
    match file::read(path, group) {
        Ok(delivery) => Some(delivery),
        Err(failure) => {
            warn!("{failure}; the previous keys stay in use");
            None
        }
    }
}

/// Modification time and length of a file.
type Seen = (Option<SystemTime>, u64);

fn seen(path: &Path) -> Option<Seen> {
    let about = std::fs::metadata(path).ok()?;
    Some((about.modified().ok(), about.len()))
}

/// The maximal number of queued keys.
const WAITING: usize = 16;
/// Interval of the checks of a file.
const LOOK: Duration = Duration::from_secs(1);
