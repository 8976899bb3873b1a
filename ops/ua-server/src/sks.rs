//! The server as the Security Key Service of the cell (OPC 10000-14, 8.3). It creates and rotates
//! the keys of groups, and distributes them over encrypted sessions to authorized clients.
//!
//! The keys are stored in a file beside the private key of the server. After a restart the same
//! keys remain in use.

mod ring;
mod store;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use bridge_core::{Now, policy_of};
use bridge_node::{Failure, Fetched, Fetching, KeyFetchError, KeyRequest, KeyService, now};
use mappings::{KeySource, Mapping, SecurityGroup, ServedKeys};
use opcua::crypto::random;
use opcua::sync::Mutex;
use opcua::types::{ByteString, MethodId, NodeId, ObjectId, StatusCode, UAString, Variant};
use plant_opcua::server::{
    CoreMethod, MethodHandler, MethodRefusal, MethodRequest, SessionCaller, method,
};
use tracing::{info, warn};
use uadp::SecurityPolicy;

use self::ring::{Handed, Ring};
use self::store::Store;

/// Creates and distributes keys. It is empty if the mapping has no group with own keys.
#[derive(Debug)]
pub(crate) struct Sks {
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    store: Store,
    groups: BTreeMap<String, Group>,
}

#[derive(Debug)]
struct Group {
    policy: SecurityPolicy,
    members: Members,
    ring: Ring,
}

/// The programs that have the role SecurityKeyServerAccess (OPC 10000-3, 4.9.2) for a group.
#[derive(Debug, Default)]
struct Members {
    /// The ApplicationUri of the cell's own server.
    server: String,
    /// The ApplicationUris of its redundant set, and the ApplicationUris that the mapping lists;
    /// `*` at the end stands for any characters.
    listed: Vec<String>,
}

impl Sks {
    /// Creates a service that stores its keys in `file`. The file is not opened before there is a
    /// group.
    pub(crate) const fn new(file: PathBuf) -> Self {
        Self {
            state: Mutex::new(State {
                store: Store::new(file),
                groups: BTreeMap::new(),
            }),
        }
    }

    /// Creates the keys of the groups of a mapping from now on, and of no other groups.
    ///
    /// # Errors
    /// Returns an error if the file with the keys cannot be used.
    pub(crate) fn follow(&self, mapping: &Mapping) -> Result<(), Failure> {
        let server = mapping.server();
        let groups = mapping.security().iter().filter(|_| server.creates_keys());
        let wanted: Vec<(&SecurityGroup, &ServedKeys)> = groups.filter_map(served).collect();
        let mut state = self.state.lock();
        let state = &mut *state;
        let now = now();
        if !wanted.is_empty() && state.groups.is_empty() {
            state.load(now)?;
            // The previous lifetimes apply to the stored keys.
            state.renew(now)?;
        }
        if wanted.is_empty() && state.groups.is_empty() {
            return Ok(());
        }
        let mut groups = std::mem::take(&mut state.groups);
        for (group, served) in wanted {
            let policy = policy_of(group.policy);
            let before = groups.remove(&group.id);
            let ring = match before {
                Some(mut before) if before.policy == policy => {
                    before.ring.set_lifetime(served.lifetime, now);
                    before.ring
                }
                Some(before) => Ring::after(&before.ring, served.lifetime, now),
                None => Ring::new(served.lifetime, now),
            };
            let others = server.redundant.iter();
            let members = Members {
                server: server.application_uri.clone(),
                listed: others.chain(&served.members).cloned().collect(),
            };
            let made = Group {
                policy,
                members,
                ring,
            };
            state.groups.insert(group.id.clone(), made);
        }
        state.renew(now)
    }

    /// Returns the methods of the key service.
    pub(crate) fn methods(self: &Arc<Self>) -> Vec<CoreMethod> {
        let sks = Arc::clone(self);
        let handler: Arc<dyn MethodHandler> =
            method(move |request| sks.get_security_keys(&request));
        let methods: [NodeId; 2] = [
            MethodId::PublishSubscribe_GetSecurityKeys.into(),
            MethodId::PubSubKeyServiceType_GetSecurityKeys.into(),
        ];
        vec![CoreMethod::new(
            ObjectId::PublishSubscribe,
            methods,
            "GetSecurityKeys",
            handler,
        )]
    }

    /// Executes GetSecurityKeys (OPC 10000-14, 8.3.2).
    fn get_security_keys(&self, request: &MethodRequest) -> Result<Vec<Variant>, MethodRefusal> {
        let [
            Variant::String(group),
            Variant::UInt32(starting),
            Variant::UInt32(count),
        ] = request.arguments.as_slice()
        else {
            return Err(StatusCode::BadTypeMismatch.into());
        };
        let group: &str = group.as_ref();
        let (application, user) = (&request.caller.application_uri, &request.caller.user);
        let handed = self.hand_out(&request.caller, group, (*starting, *count));
        match handed {
            Ok((policy, handed)) => {
                info!(
                    group,
                    application,
                    user,
                    token = handed.first_token_id,
                    keys = handed.keys.len(),
                    "keys of a secured group are handed out"
                );
                let keys: Vec<ByteString> = handed.keys.into_iter().map(ByteString::from).collect();
                Ok(vec![
                    Variant::String(UAString::from(policy.uri())),
                    Variant::UInt32(handed.first_token_id),
                    Variant::from(keys),
                    Variant::Double(milliseconds(handed.time_to_next)),
                    Variant::Double(milliseconds(handed.lifetime)),
                ])
            }
            Err(status) => {
                warn!(
                    group = format_args!("{group:.128}"),
                    application, user, "refused the keys of a secured group with {status}"
                );
                Err(status.into())
            }
        }
    }

    fn hand_out(
        &self,
        caller: &SessionCaller,
        group: &str,
        wanted: (u32, u32),
    ) -> Result<(SecurityPolicy, Handed), StatusCode> {
        if !caller.encrypted {
            return Err(StatusCode::BadSecurityModeInsufficient);
        }
        let mut state = self.state.lock();
        let known = state.groups.get(group).ok_or(StatusCode::BadNotFound)?;
        if !known.has(caller) {
            return Err(StatusCode::BadUserAccessDenied);
        }
        state.of(group, wanted).ok_or(StatusCode::BadNotFound)
    }

    /// Returns whether this server creates the keys of a group.
    fn creates(&self, group: &str) -> bool {
        self.state.lock().groups.contains_key(group)
    }

    /// Returns the keys of a group for this program itself.
    fn own(&self, group: &str) -> Result<Fetched, KeyFetchError> {
        let mut state = self.state.lock();
        let (policy, handed) = state
            .of(group, (0, ring::FUTURE))
            .ok_or_else(|| KeyFetchError::NotMade(group.to_owned()))?;
        Ok(Fetched {
            policy_uri: policy.uri().to_owned(),
            first_token_id: handed.first_token_id,
            keys: handed.keys,
            time_to_next: handed.time_to_next,
            lifetime: handed.lifetime,
        })
    }
}

impl State {
    /// Loads the keys of the previous run.
    fn load(&mut self, now: Now) -> Result<(), Failure> {
        for (id, policy, ring) in self.store.load(now)? {
            let members = Members::default();
            self.groups.insert(
                id,
                Group {
                    policy,
                    members,
                    ring,
                },
            );
        }
        Ok(())
    }

    /// Creates the next keys. New keys are used only after they are stored, because other keys
    /// would be created after a restart.
    fn renew(&mut self, now: Now) -> Result<(), Failure> {
        let mut changed = false;
        let mut before = Vec::new();
        for group in self.groups.values_mut() {
            before.push(group.ring.clone());
            let length = group.policy.key_data_length();
            changed |= group.ring.advance(now.monotonic, || random_key(length));
        }
        if !changed {
            return Ok(());
        }
        let groups = self.groups.iter();
        let kept = groups.map(|(id, group)| (id.as_str(), group.policy, &group.ring));
        let saved = self.store.save(kept, now);
        if saved.is_err() {
            for (group, ring) in self.groups.values_mut().zip(before) {
                group.ring = ring;
            }
        }
        saved
    }

    fn of(
        &mut self,
        group: &str,
        (starting, count): (u32, u32),
    ) -> Option<(SecurityPolicy, Handed)> {
        let now = now();
        if let Err(error) = self.renew(now) {
            warn!(
                "{error}; cannot renew the keys of secured groups, and the previous keys stay in use"
            );
        }
        let group = self.groups.get(group)?;
        let handed = group.ring.hand_out(starting, count, now.monotonic)?;
        Some((group.policy, handed))
    }
}

impl Group {
    /// Returns true if a client gets the keys. The ApplicationUri of its certificate decides, not
    /// its user.
    fn has(&self, caller: &SessionCaller) -> bool {
        caller.proven && self.members.contains(&caller.application_uri)
    }
}

impl Members {
    /// Returns true if an ApplicationUri is listed or belongs to a program of the cell.
    fn contains(&self, uri: &str) -> bool {
        let is_listed = |member: &String| match member.strip_suffix('*') {
            Some(start) => uri.starts_with(start),
            None => uri == member,
        };
        let parts: Vec<&str> = uri.split(':').collect();
        let is_bridge = matches!(
            parts.as_slice(),
            ["urn", _, "ua-bridge", "bridge-ros1" | "bridge-ros2"]
        );
        is_bridge || (!uri.is_empty() && uri == self.server) || self.listed.iter().any(is_listed)
    }
}

/// Fetches keys for the server: keys of its own groups from itself, other keys from their key
/// services. The key service of a redundant set is its first server.
#[derive(Debug)]
pub(crate) struct ServerKeys {
    pub(crate) own: Arc<Sks>,
    pub(crate) others: plant_keys::KeyFetcher,
}

impl KeyService for ServerKeys {
    fn fetch<'a>(&'a self, request: &'a KeyRequest) -> Fetching<'a> {
        if request.own && self.own.creates(&request.group) {
            return Box::pin(std::future::ready(self.own.own(&request.group)));
        }
        self.others.fetch(request)
    }
}

/// Returns a group with keys that this server creates.
fn served(group: &SecurityGroup) -> Option<(&SecurityGroup, &ServedKeys)> {
    match group.keys.as_ref()? {
        KeySource::Own(served) => Some((group, served)),
        KeySource::File(_) | KeySource::Credential(_) | KeySource::Sks(_) => None,
    }
}

fn random_key(length: usize) -> Vec<u8> {
    random::byte_string(length).value.unwrap_or_default()
}

fn milliseconds(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_for_listed_programs_and_those_of_the_cell() {
        let mut members = Members {
            server: "urn:cell:server".to_owned(),
            listed: Vec::new(),
        };
        for uri in [
            "urn:cell:server",
            "urn:robot-7:ua-bridge:bridge-ros1",
            "urn:robot-7:ua-bridge:bridge-ros2",
        ] {
            assert!(members.contains(uri), "{uri}");
        }
        for uri in [
            "",
            "urn:attacker",
            "urn:a:b:ua-bridge:bridge-ros1",
            "urn:robot-7:ua-bridge:bridge-ros1:x",
        ] {
            assert!(!members.contains(uri), "{uri}");
        }
        members.listed = vec!["urn:plant:*".to_owned(), "urn:one".to_owned()];
        assert!(members.contains("urn:plant:robot") && members.contains("urn:one"));
        assert!(!members.contains("urn:one:more"));
    }
}
