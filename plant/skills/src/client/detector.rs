//! Finds skills by their types in all known servers.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinHandle;
use tracing::debug;

use super::found::FoundSkill;
use super::{ClientOptions, SkillClient, SkillHandle, StationChanges};
use crate::lock::lock;
use crate::model::alias;
use crate::parameters::ParameterType;
use crate::skill_fault::SkillFault;

/// An index of the skills of known servers. It reads the skills of each server and retries until
/// the server responds. Clones share the index. It keeps no connection open, except to stations,
/// whose skills come and go: a caller that runs a skill connects with [`open`](Self::open).
///
/// The discovery of servers reports them with [`seen`](Self::seen) and [`gone`](Self::gone).
#[derive(Clone)]
pub struct Detector {
    shared: Arc<Shared>,
}

struct Shared {
    options: ClientOptions,
    /// The skills of the servers, by the identifier of the server.
    servers: Mutex<BTreeMap<String, Told>>,
    /// Running queries, by the identifier of the server.
    looks: Mutex<HashMap<String, JoinHandle<()>>>,
    /// Why the skills of a server could not be read yet, by the identifier of the server.
    faults: Mutex<BTreeMap<String, String>>,
    changes: watch::Sender<u64>,
}

struct Told {
    application_uri: String,
    endpoint: String,
    skills: Vec<FoundSkill>,
}

/// A skill and its server.
#[derive(Debug, Clone, PartialEq)]
pub struct Detected {
    /// The ApplicationUri of its component, which may be behind a station.
    pub application_uri: String,
    /// The URL of the server. For a component behind a station it is the URL of the station, `#`
    /// and the ApplicationUri of the component.
    pub endpoint: String,
    /// The skill.
    pub skill: FoundSkill,
}

impl fmt::Debug for Detector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let servers: Vec<String> = lock(&self.shared.servers).keys().cloned().collect();
        f.debug_tuple("Detector").field(&servers).finish()
    }
}

impl FoundSkill {
    /// Returns whether the skill is of this type or a subtype. Names of the earlier system match
    /// their equivalents.
    #[must_use]
    pub fn is_of(&self, wanted: &ParameterType) -> bool {
        let known = alias::of(wanted).map(|known| ParameterType::own(known.name));
        let wanted = known.as_ref().unwrap_or(wanted);
        self.types.iter().any(|of| of.name == *wanted)
    }
}

impl Detector {
    /// Creates a detector without servers. It queries servers with these client options.
    /// [`seen`](Self::seen) needs a tokio runtime.
    #[must_use]
    pub fn new(options: ClientOptions) -> Self {
        Self {
            shared: Arc::new(Shared {
                options,
                servers: Mutex::default(),
                looks: Mutex::default(),
                faults: Mutex::default(),
                changes: watch::channel(0).0,
            }),
        }
    }

    /// Reads the skills of a server that appeared, changed or restarted. `server` identifies the
    /// server, for example by its name in discovery.
    pub fn seen(&self, server: &str, endpoint: &str) {
        let mut looks = lock(&self.shared.looks);
        if !looks.contains_key(server) && looks.len() >= MOST_SERVERS {
            debug!(server, "there are too many servers to ask this one");
            return;
        }
        let look = look(
            Arc::clone(&self.shared),
            server.to_owned(),
            endpoint.to_owned(),
        );
        if let Some(earlier) = looks.insert(server.to_owned(), tokio::spawn(look)) {
            earlier.abort();
        }
    }

    /// Removes a server and its skills.
    pub fn gone(&self, server: &str) {
        if let Some(look) = lock(&self.shared.looks).remove(server) {
            look.abort();
        }
        lock(&self.shared.faults).remove(server);
        if lock(&self.shared.servers).remove(server).is_some() {
            self.shared.changed();
        }
    }

    /// Returns all known skills, ordered by server and then as the server lists them.
    #[must_use]
    pub fn all(&self) -> Vec<Detected> {
        let servers = lock(&self.shared.servers);
        let of = |told: &Told| {
            let detected = |skill: &FoundSkill| Detected {
                application_uri: skill
                    .behind
                    .clone()
                    .unwrap_or_else(|| told.application_uri.clone()),
                endpoint: skill.endpoint(&told.endpoint),
                skill: skill.clone(),
            };
            told.skills.iter().map(detected).collect::<Vec<_>>()
        };
        servers.values().flat_map(of).collect()
    }

    /// Returns the skills of a type and its subtypes, from any vendor.
    #[must_use]
    pub fn of_type(&self, wanted: &ParameterType) -> Vec<Detected> {
        let mut all = self.all();
        all.retain(|detected| detected.skill.is_of(wanted));
        all
    }

    /// Waits for a skill of a type or a subtype that `fits`, and returns the first.
    ///
    /// # Errors
    /// [`SkillFault::Unexpected`] if no such skill is found `within` that time.
    pub async fn one(
        &self,
        wanted: &ParameterType,
        within: Duration,
        fits: impl Fn(&Detected) -> bool,
    ) -> Result<Detected, SkillFault> {
        let mut changes = self.changes();
        let find = async {
            loop {
                changes.borrow_and_update();
                let found = self.of_type(wanted).into_iter().find(|one| fits(one));
                if let Some(found) = found {
                    return found;
                }
                // The sender is owned by this detector.
                let _changed = changes.changed().await;
            }
        };
        let found = tokio::time::timeout(within, find).await;
        found.map_err(|_| {
            let text = format!("no {wanted} that fits was found within {within:?}");
            SkillFault::Unexpected(text)
        })
    }

    /// Returns the servers whose skills cannot be read, with the reasons, as the end of a message.
    #[must_use]
    pub fn unreadable(&self) -> String {
        let faults = lock(&self.shared.faults);
        let told: Vec<&str> = faults
            .values()
            .take(MOST_TOLD)
            .map(String::as_str)
            .collect();
        match told.is_empty() {
            true => String::new(),
            false => format!("; not readable: {}", told.join("; ")),
        }
    }

    /// Connects to the server of a skill to run it. The new session holds the lease of the
    /// component until it is closed.
    pub async fn open(&self, of: &Detected) -> Result<(SkillClient, SkillHandle), SkillFault> {
        let client = SkillClient::connect(&of.endpoint, &self.shared.options).await?;
        let handle = client.handle(&of.skill);
        Ok((client, handle))
    }

    /// Returns a counter that is incremented when the known skills change.
    #[must_use]
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.shared.changes.subscribe()
    }
}

impl Shared {
    fn changed(&self) {
        self.changes
            .send_modify(|changes| *changes = changes.wrapping_add(1));
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        for (_, look) in lock(&self.looks).drain() {
            look.abort();
        }
    }
}

/// Queries a server until it responds.
async fn look(shared: Arc<Shared>, server: String, endpoint: String) {
    let mut again = AGAIN;
    let weak = Arc::downgrade(&shared);
    let options = shared.options.clone();
    drop(shared);
    loop {
        match ask(&endpoint, &options).await {
            Ok(Answer {
                client,
                changes,
                skills,
            }) => {
                let told = Told {
                    application_uri: client.application_uri(),
                    endpoint: endpoint.clone(),
                    skills,
                };
                if let Some(shared) = weak.upgrade() {
                    lock(&shared.faults).remove(&server);
                    lock(&shared.servers).insert(server.clone(), told);
                    shared.changed();
                }
                let Some(mut changes) = changes else {
                    client.close().await;
                    return;
                };
                // The skills behind a station come and go.
                tokio::select! {
                    () = changes.next() => {}
                    _why = client.lost() => {}
                }
                client.close().await;
                again = AGAIN;
            }
            Err(fault) => {
                debug!(endpoint, %fault, "cannot read the skills of a server");
                let Some(shared) = weak.upgrade() else { return };
                lock(&shared.faults).insert(server.clone(), format!("{endpoint}: {fault}"));
            }
        }
        tokio::time::sleep(again).await;
        again = (again * 2).min(AGAIN_AT_MOST);
    }
}

/// The skills of a server.
struct Answer {
    client: SkillClient,
    /// The changes since the skills were read; `None` for a server that is no station.
    changes: Option<StationChanges>,
    skills: Vec<FoundSkill>,
}

async fn ask(endpoint: &str, options: &ClientOptions) -> Result<Answer, SkillFault> {
    let client = SkillClient::connect(endpoint, options).await?;
    let read = async {
        let changes = client.station_changes().await?;
        Ok((changes, client.skills().await?))
    };
    match read.await {
        Ok((changes, skills)) => Ok(Answer {
            client,
            changes,
            skills,
        }),
        Err(fault) => {
            client.close().await;
            Err(fault)
        }
    }
}

const AGAIN: Duration = Duration::from_millis(100);
const AGAIN_AT_MOST: Duration = Duration::from_secs(5);
/// Maximum number of servers; further servers are not queried.
const MOST_SERVERS: usize = 4_096;
/// Maximum number of servers in a message.
const MOST_TOLD: usize = 3;
