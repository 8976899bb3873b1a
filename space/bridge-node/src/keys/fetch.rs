//! Keys from a Security Key Service: fetched at the start, before the keys expire, and when a peer
//! uses an unknown key.

use std::fmt;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use bridge_core::{KeyDelivery, policy_of};
use mappings::{KeySource, SecurityGroup};
use tokio::sync::{mpsc, watch};
use tokio::time::sleep;
use tracing::{info, warn};
use uadp::{KeyError, SecurityPolicy, TokenKeys};

use super::NewKeys;

/// A request to a Security Key Service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyRequest {
    /// The endpoint URL, such as opc.tcp://sks.local:4840.
    pub endpoint: String,
    /// Whether the endpoint is the own server of the cell.
    pub own: bool,
    /// The SecurityGroupId.
    pub group: String,
}

/// The response to GetSecurityKeys (OPC 10000-14, 8.3.2).
#[derive(Clone, PartialEq, Eq)]
pub struct Fetched {
    /// The SecurityPolicyUri.
    pub policy_uri: String,
    /// The SecurityTokenId of the first key.
    pub first_token_id: u32,
    /// The key data of the current key and the future keys.
    pub keys: Vec<Vec<u8>>,
    /// Time until the next key is used.
    pub time_to_next: Duration,
    /// How long each key is used.
    pub lifetime: Duration,
}

impl fmt::Debug for Fetched {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Fetched")
            .field("first_token_id", &self.first_token_id)
            .field("keys", &self.keys.len())
            .finish_non_exhaustive()
    }
}

/// The future of a fetch.
pub type Fetching<'a> = Pin<Box<dyn Future<Output = Result<Fetched, KeyFetchError>> + Send + 'a>>;

/// The reason why there are no keys.
#[derive(Debug, thiserror::Error)]
pub enum KeyFetchError {
    /// The thread that fetches keys cannot be started.
    #[error("cannot start the thread that fetches keys: {0}")]
    Thread(io::Error),
    /// The thread that fetches keys has ended.
    #[error("the thread that fetches keys has ended")]
    ThreadEnded,
    /// The session with the service failed, or the service refuses the request.
    #[error("{why} (as {application_uri})")]
    Session {
        /// The reason, as text for the user.
        why: String,
        /// The ApplicationUri of this program.
        application_uri: String,
    },
    /// The own server does not create the keys of the group.
    #[error("this server makes no keys of `{0}`")]
    NotMade(String),
    /// The keys have another policy.
    #[error("its keys are for the policy {found:.80}, but the mapping has {}", expected.uri())]
    Policy {
        /// The SecurityPolicyUri of the keys.
        found: String,
        /// The policy in the mapping.
        expected: SecurityPolicy,
    },
    /// A key has a wrong length.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// The service has no keys.
    #[error("the service has no keys of the group")]
    NoKeys,
}

/// Fetches keys. The program implements it, because this crate does not know OPC UA sessions.
pub trait KeyService: fmt::Debug + Send + Sync {
    /// Fetches the keys of a group, or returns the reason of the failure. Ends within a minute.
    fn fetch<'a>(&'a self, request: &'a KeyRequest) -> Fetching<'a>;
}

/// Fetches the keys of a group periodically.
pub(super) async fn keep(
    group: SecurityGroup,
    service: Arc<dyn KeyService>,
    (out, mut wants): (mpsc::Sender<NewKeys>, watch::Receiver<u64>),
) {
    let Some(request) = request_of(&group) else {
        return;
    };
    let mut fetches = FetchLog::default();
    loop {
        let fetched = service.fetch(&request).await;
        let fetched = fetched.and_then(|fetched| delivery(fetched, policy_of(group.policy)));
        let rest = match fetched {
            Ok(delivery) => {
                let rest = rest(&delivery);
                let group = group.id.clone();
                if out.send(NewKeys { group, delivery }).await.is_err() {
                    return;
                }
                let failures = fetches.received();
                tell_back(&request, failures);
                rest
            }
            Err(error) => {
                if let Some(message) = fetches.failed(&error.to_string()) {
                    let (group, endpoint, failures) =
                        (&request.group, &request.endpoint, fetches.failures);
                    warn!(group, endpoint, failures, "{message}");
                }
                let doubled = RETRY.saturating_mul(1 << fetches.failures.min(5));
                doubled.min(RETRY_MOST)
            }
        };
        tokio::select! {
            () = sleep(rest) => {}
            // A peer uses a key that is unknown here.
            changed = wants.changed() => if changed.is_err() {
                return;
            },
        }
    }
}

fn request_of(group: &SecurityGroup) -> Option<KeyRequest> {
    let (endpoint, own) = match group.keys.as_ref()? {
        KeySource::Own(served) => (&served.endpoint, true),
        KeySource::Sks(endpoint) => (endpoint, false),
        KeySource::File(_) | KeySource::Credential(_) => return None,
    };
    Some(KeyRequest {
        endpoint: endpoint.to_string(),
        own,
        group: group.id.clone(),
    })
}

fn tell_back(request: &KeyRequest, failures: u32) {
    if failures > 0 {
        let (group, endpoint) = (&request.group, &request.endpoint);
        info!(
            group,
            endpoint, failures, "the Security Key Service responds again"
        );
    }
}

/// The fetches of a group, for the log.
#[derive(Debug, Default)]
struct FetchLog {
    /// The failures since the last keys.
    failures: u32,
    /// The reason that was logged last.
    logged: String,
    /// Keys were received since the start of the program.
    has_keys: bool,
}

impl FetchLog {
    /// Records received keys. Returns the number of failures before them.
    fn received(&mut self) -> u32 {
        self.has_keys = true;
        self.logged.clear();
        std::mem::take(&mut self.failures)
    }

    /// Records a failure. Returns the message if it is to be logged: at the first occurrence of a
    /// reason, and then from time to time.
    fn failed(&mut self, why: &str) -> Option<String> {
        self.failures = self.failures.saturating_add(1);
        if why == self.logged && !self.failures.is_multiple_of(TOLD_AGAIN) {
            return None;
        }
        why.clone_into(&mut self.logged);
        let meanwhile = match self.has_keys {
            true => "the previous keys stay in use",
            false => "nothing is sent or received in the group before there are keys",
        };
        Some(format!(
            "cannot get keys from the Security Key Service: {why}; trying again, and {meanwhile}"
        ))
    }
}

/// Returns the time until the next fetch: half the lifetime of a key (OPC 10000-14, 8.3.2). It is
/// short enough to notice a revoked key, and limits the load of the service.
fn rest(delivery: &KeyDelivery) -> Duration {
    (delivery.lifetime / 2).clamp(LEAST_REST, MOST_REST)
}

/// Checks the response against the mapping.
fn delivery(fetched: Fetched, policy: SecurityPolicy) -> Result<KeyDelivery, KeyFetchError> {
    if fetched.policy_uri != policy.uri() {
        return Err(KeyFetchError::Policy {
            found: fetched.policy_uri,
            expected: policy,
        });
    }
    let keys = fetched.keys.iter();
    let keys: Result<Vec<TokenKeys>, _> = keys
        .map(|data| TokenKeys::from_bytes(policy, data))
        .collect();
    let keys = keys?;
    if keys.is_empty() || fetched.first_token_id == 0 {
        return Err(KeyFetchError::NoKeys);
    }
    Ok(KeyDelivery {
        first_token_id: fetched.first_token_id,
        keys,
        time_to_next: Some(fetched.time_to_next),
        lifetime: fetched.lifetime,
    })
}

/// The first pause after a failure, doubled with each failure, and the longest pause.
const RETRY: Duration = Duration::from_millis(250);
const RETRY_MOST: Duration = Duration::from_secs(5);
/// An unchanged failure is logged again after this number of failures.
const TOLD_AGAIN: u32 = 60;
const LEAST_REST: Duration = Duration::from_millis(500);
const MOST_REST: Duration = Duration::from_secs(300);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_says_whether_there_are_keys_to_use() {
        let mut fetches = FetchLog::default();
        let first = fetches.failed("no route").unwrap();
        assert!(first.contains("no route; trying again"), "{first}");
        let without = "nothing is sent or received in the group before there are keys";
        assert!(first.ends_with(without), "{first}");
        assert_eq!(fetches.failed("no route"), None, "it was logged");
        assert_eq!(fetches.received(), 2);
        let later = fetches.failed("no route").unwrap();
        assert!(later.ends_with("the previous keys stay in use"), "{later}");
    }
}
