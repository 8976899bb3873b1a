//! Skills wherever they are: found by their types in all servers that somebody tells of.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinHandle;
use tracing::debug;

use super::find::FoundSkill;
use super::{ClientOptions, SkillClient, SkillHandle};
use crate::model::alias;
use crate::parameters::TypeName;
use crate::runs::SkillFault;
use crate::skill::lock;

/// Knows the skills of the servers it is told of, and asks each as often as it has to until that has answered. Clones are of
/// the same one. It holds no connection: who runs a skill opens it.
///
/// Who looks for servers, by discovery or otherwise, tells it of them with [`seen`](Self::seen) and [`gone`](Self::gone).
#[derive(Clone)]
pub struct Detector {
    shared: Arc<Shared>,
}

struct Shared {
    options: ClientOptions,
    /// What servers have said, by what they are told apart by.
    servers: Mutex<BTreeMap<String, Told>>,
    /// Who is being asked.
    looks: Mutex<HashMap<String, JoinHandle<()>>>,
    changes: watch::Sender<u64>,
}

struct Told {
    application_uri: String,
    endpoint: String,
    skills: Vec<FoundSkill>,
}

/// A skill and the server it is of.
#[derive(Debug, Clone, PartialEq)]
pub struct Detected {
    /// The ApplicationUri of the server.
    pub application_uri: String,
    /// Where clients connect.
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
    /// Whether it is of that type or a subtype, under the name here or that of the earlier system.
    #[must_use]
    pub fn is_of(&self, wanted: &TypeName) -> bool {
        let known = alias::of(wanted).map(|known| TypeName::own(known.name));
        let wanted = known.as_ref().unwrap_or(wanted);
        self.types.iter().any(|of| of.name == *wanted)
    }
}

impl Detector {
    /// One that knows nobody yet, and asks servers as this client. Needs a tokio runtime when it is told of one.
    #[must_use]
    pub fn new(options: ClientOptions) -> Self {
        Self {
            shared: Arc::new(Shared {
                options,
                servers: Mutex::default(),
                looks: Mutex::default(),
                changes: watch::channel(0).0,
            }),
        }
    }

    /// A server is there, or says something else of itself, or was started anew: it is asked for its skills. `server` is what
    /// it is told apart by, as its name in discovery.
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

    /// A server is gone, and its skills with it.
    pub fn gone(&self, server: &str) {
        if let Some(look) = lock(&self.shared.looks).remove(server) {
            look.abort();
        }
        if lock(&self.shared.servers).remove(server).is_some() {
            self.shared.changed();
        }
    }

    /// All skills that are known, by server and in the order of each.
    #[must_use]
    pub fn all(&self) -> Vec<Detected> {
        let servers = lock(&self.shared.servers);
        let of = |told: &Told| {
            let detected = |skill: &FoundSkill| Detected {
                application_uri: told.application_uri.clone(),
                endpoint: told.endpoint.clone(),
                skill: skill.clone(),
            };
            told.skills.iter().map(detected).collect::<Vec<_>>()
        };
        servers.values().flat_map(of).collect()
    }

    /// Those of a type and its subtypes, whoever made them.
    #[must_use]
    pub fn of_type(&self, wanted: &TypeName) -> Vec<Detected> {
        let mut all = self.all();
        all.retain(|detected| detected.skill.is_of(wanted));
        all
    }

    /// The first of a type or a subtype that `fits`, waiting for one to come.
    ///
    /// # Errors
    /// [`SkillFault::Unexpected`] when there is none `within` that time.
    pub async fn one(
        &self,
        wanted: &TypeName,
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
                // The sender is our own.
                let _changed = changes.changed().await;
            }
        };
        let found = tokio::time::timeout(within, find).await;
        found.map_err(|_| {
            let text = format!("no {wanted} that fits was found within {within:?}");
            SkillFault::Unexpected(text)
        })
    }

    /// Connects to run it: with a session of its own, which has the lease of its component until it is closed.
    ///
    /// # Errors
    /// [`SkillFault::Lost`].
    pub async fn open(&self, of: &Detected) -> Result<(SkillClient, SkillHandle), SkillFault> {
        let client = SkillClient::connect(&of.endpoint, &self.shared.options).await?;
        let handle = client.handle(&of.skill);
        Ok((client, handle))
    }

    /// Counts whenever skills have come or gone.
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

/// Asks a server until it has answered.
async fn look(shared: Arc<Shared>, server: String, endpoint: String) {
    let mut again = AGAIN;
    let weak = Arc::downgrade(&shared);
    let options = shared.options.clone();
    drop(shared);
    loop {
        match ask(&endpoint, &options).await {
            Ok((application_uri, skills)) => {
                let Some(shared) = weak.upgrade() else { return };
                let told = Told {
                    application_uri,
                    endpoint,
                    skills,
                };
                lock(&shared.servers).insert(server, told);
                shared.changed();
                return;
            }
            Err(fault) => debug!(endpoint, "a server does not tell its skills: {fault}"),
        }
        tokio::time::sleep(again).await;
        again = (again * 2).min(AGAIN_AT_MOST);
    }
}

async fn ask(
    endpoint: &str,
    options: &ClientOptions,
) -> Result<(String, Vec<FoundSkill>), SkillFault> {
    let client = SkillClient::connect(endpoint, options).await?;
    let found = client.skills().await;
    let application_uri = client.application_uri();
    client.close().await;
    Ok((application_uri, found?))
}

const AGAIN: Duration = Duration::from_millis(100);
const AGAIN_AT_MOST: Duration = Duration::from_secs(5);
/// So many servers are asked; what there are more is not.
const MOST_SERVERS: usize = 4_096;
