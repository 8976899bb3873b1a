//! Fetches keys of secured groups from a Security Key Service (OPC 10000-14, 8.3.2) for the
//! programs of the space.
//!
//! Each fetch uses a signed and encrypted session of its own in a separate thread, because signing
//! takes longer than a value should wait. The certificate of the service is trusted in the same way
//! as the certificate of any server: by itself, or by the authority that issued it.

use std::fmt;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bridge_node::{Fetched, Fetching, KeyFetchError, KeyRequest, KeyService};
use plant_opcua::client::{CallError, CallOptions, ClientConfig, OpcUaClient, SecurityChoice};
use plant_opcua::pki;
use plant_opcua::types::{MethodId, NodeId, ObjectId, StatusCode, Variant};
use tokio::sync::{mpsc, oneshot};
use tracing::warn;

pub use plant_opcua::QUIET;

/// The command line options for fetching keys.
#[derive(Debug, Clone, Default, PartialEq, Eq, clap::Args)]
pub struct KeyArguments {
    /// The certificate store for sessions with a Security Key Service: own, private, trusted and
    /// rejected in one directory
    #[arg(long, value_name = "DIR", env = "UA_PKI")]
    pub pki: Option<PathBuf>,
}

impl KeyArguments {
    /// Returns a key service for the program, which has no other OPC UA identity.
    #[must_use]
    pub fn service(&self, program: &str) -> Arc<dyn KeyService> {
        let usual = || {
            let root = pki::default_root(|name| std::env::var(name).ok());
            root.with_file_name(format!("pki-{program}"))
        };
        let host = gethostname::gethostname().to_string_lossy().into_owned();
        Arc::new(KeyFetcher::new(KeyClientIdentity {
            application_uri: format!("urn:{host}:ua-bridge:{program}"),
            application_name: program.to_owned(),
            pki: self.pki.clone().unwrap_or_else(usual),
        }))
    }
}

/// The identity of the program in its requests for keys.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyClientIdentity {
    /// The ApplicationUri, which is also in the certificate.
    pub application_uri: String,
    /// The ApplicationName.
    pub application_name: String,
    /// The certificate store. Missing parts are created at the first fetch.
    pub pki: PathBuf,
}

/// Fetches keys, one request after the other.
pub struct KeyFetcher {
    identity: KeyClientIdentity,
    /// The sender to the fetching thread, once the thread is running.
    asked: Mutex<Option<mpsc::Sender<Asked>>>,
}

struct Asked {
    request: KeyRequest,
    answer: oneshot::Sender<Result<Fetched, KeyFetchError>>,
}

impl KeyFetcher {
    /// Creates a service that requests keys as `identity`.
    #[must_use]
    pub const fn new(identity: KeyClientIdentity) -> Self {
        Self {
            identity,
            asked: Mutex::new(None),
        }
    }

    /// Returns the sender to the fetching thread, which is started again if it has ended.
    fn thread(&self) -> Result<mpsc::Sender<Asked>, KeyFetchError> {
        let mut asked = self.asked.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(sender) = asked.as_ref().filter(|sender| !sender.is_closed()) {
            return Ok(sender.clone());
        }
        let (sender, requests) = mpsc::channel(WAITING);
        let identity = self.identity.clone();
        let started = std::thread::Builder::new()
            .name("keys".to_owned())
            .spawn(move || serve(&identity, requests));
        started.map_err(KeyFetchError::Thread)?;
        *asked = Some(sender.clone());
        Ok(sender)
    }
}

impl fmt::Debug for KeyFetcher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Service")
            .field("identity", &self.identity)
            .finish_non_exhaustive()
    }
}

impl KeyService for KeyFetcher {
    fn fetch<'a>(&'a self, request: &'a KeyRequest) -> Fetching<'a> {
        Box::pin(async move {
            let thread = self.thread()?;
            let (answer, answered) = oneshot::channel();
            let request = request.clone();
            let asked = Asked { request, answer };
            let ended = KeyFetchError::ThreadEnded;
            if thread.send(asked).await.is_err() {
                return Err(ended);
            }
            answered.await.unwrap_or(Err(ended))
        })
    }
}

/// Fetches keys until all senders are dropped.
fn serve(identity: &KeyClientIdentity, mut requests: mpsc::Receiver<Asked>) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    let runtime = match runtime {
        Ok(runtime) => runtime,
        Err(error) => {
            warn!(%error, "cannot fetch keys");
            return;
        }
    };
    runtime.block_on(async {
        while let Some(Asked { request, answer }) = requests.recv().await {
            // The requester may have cancelled in the meantime.
            if !answer.is_closed() {
                let fetched = fetch(identity, &request).await;
                drop(answer.send(fetched));
            }
        }
    });
}

/// Fetches keys in a session that is opened for the request and closed again.
async fn fetch(
    identity: &KeyClientIdentity,
    request: &KeyRequest,
) -> Result<Fetched, KeyFetchError> {
    let config = ClientConfig {
        pki: Some(identity.pki.clone()),
        security: SecurityChoice::Basic256Sha256,
        timeout: WITHIN,
        ..ClientConfig::new(&identity.application_uri, &identity.application_name)
    };
    let client = OpcUaClient::open(config, &request.endpoint);
    let asked = async {
        let up = client.up(LONGEST_CONNECT).await;
        up.map_err(|error| error.to_string())?;
        let arguments = vec![
            Variant::from(request.group.as_str()),
            Variant::UInt32(CURRENT),
            Variant::UInt32(FUTURE_KEYS),
        ];
        let object: NodeId = ObjectId::PublishSubscribe.into();
        let method: NodeId = MethodId::PublishSubscribe_GetSecurityKeys.into();
        let options = CallOptions {
            within: WITHIN,
            connection: None,
        };
        let called = client.call_within((&object, &method), arguments, options);
        let outputs = called.await.map_err(|error| told(&error, request))?;
        answer(outputs)
            .ok_or_else(|| "its response is not a response to GetSecurityKeys".to_owned())
    };
    let fetched = asked.await;
    client.close().await;
    fetched.map_err(|why: String| KeyFetchError::Session {
        why,
        application_uri: identity.application_uri.clone(),
    })
}

/// Returns the reason why the service returns no keys.
fn told(error: &CallError, request: &KeyRequest) -> String {
    match error {
        CallError::Refused { status, .. } if *status == StatusCode::BadUserAccessDenied => {
            format!(
                "this program is not allowed to get the keys of `{}`: add its ApplicationUri to `members` of the group",
                request.group
            )
        }
        CallError::Refused { status, .. } if *status == StatusCode::BadNotFound => {
            format!("the service has no group `{}`", request.group)
        }
        CallError::Refused { .. } | CallError::Client(_) => error.to_string(),
    }
}

/// Reads the output arguments of GetSecurityKeys; `None` if their types differ.
fn answer(outputs: Vec<Variant>) -> Option<Fetched> {
    let outputs: [Variant; 5] = outputs.try_into().ok()?;
    let [
        Variant::String(policy),
        Variant::UInt32(first_token_id),
        Variant::Array(keys),
        Variant::Double(time_to_next),
        Variant::Double(lifetime),
    ] = outputs
    else {
        return None;
    };
    let keys = keys.values.into_iter().take(MOST_KEYS).map(|key| {
        if let Variant::ByteString(key) = key {
            key.value
        } else {
            None
        }
    });
    Some(Fetched {
        policy_uri: policy.as_ref().to_owned(),
        first_token_id,
        keys: keys.collect::<Option<_>>()?,
        time_to_next: duration(time_to_next)?,
        lifetime: duration(lifetime)?,
    })
}

/// Converts a Duration of OPC UA, in milliseconds.
fn duration(milliseconds: f64) -> Option<Duration> {
    let bounded = milliseconds.clamp(0.0, LONGEST_MS);
    Duration::try_from_secs_f64(bounded / 1e3).ok()
}

/// Maximum number of waiting requests.
const WAITING: usize = 64;
/// Time limit of each response of the service.
const WITHIN: Duration = Duration::from_secs(5);
/// Time limit of the connection.
const LONGEST_CONNECT: Duration = Duration::from_secs(10);
/// The StartingTokenId that stands for the current key.
const CURRENT: u32 = 0;
/// Number of requested future keys, which is the number of key lifetimes that the service may be
/// unavailable.
const FUTURE_KEYS: u32 = 4;
/// Maximum number of accepted keys, more than any service returns.
const MOST_KEYS: usize = 64;
/// A year.
const LONGEST_MS: f64 = 365.0 * 86_400_000.0;

#[cfg(test)]
mod tests {
    use plant_opcua::types::{ByteString, UAString};

    use super::*;

    fn outputs() -> Vec<Variant> {
        vec![
            Variant::String(UAString::from("policy")),
            Variant::UInt32(7),
            Variant::from(vec![ByteString::from(vec![1_u8, 2])]),
            Variant::Double(1500.0),
            Variant::Double(60_000.0),
        ]
    }

    #[test]
    fn the_outputs_of_get_security_keys_are_taken() {
        let fetched = answer(outputs()).unwrap();
        assert_eq!(
            (&*fetched.policy_uri, fetched.first_token_id),
            ("policy", 7)
        );
        assert_eq!(fetched.keys, [vec![1, 2]]);
        assert_eq!(fetched.time_to_next, Duration::from_millis(1500));
        assert_eq!(fetched.lifetime, Duration::from_secs(60));
    }

    #[test]
    fn outputs_of_other_types_or_numbers_are_not() {
        let mut fewer = outputs();
        fewer.pop();
        assert_eq!(answer(fewer), None);
        let mut others = outputs();
        others[2] = Variant::from(vec![1_u8, 2]);
        assert_eq!(answer(others), None);
        let mut never = outputs();
        never[3] = Variant::Double(f64::NAN);
        assert_eq!(answer(never), None, "no number is no time");
    }

    #[test]
    fn each_program_has_a_certificate_store_of_its_own() {
        let given = KeyArguments {
            pki: Some(PathBuf::from("/pki")),
        };
        let told = format!("{:?}", given.service("bridge-ros1"));
        assert!(
            told.contains("\"/pki\"") && told.contains(":ua-bridge:bridge-ros1"),
            "{told}"
        );
        let usual = format!("{:?}", KeyArguments::default().service("bridge-ros2"));
        assert!(usual.contains("pki-bridge-ros2"), "{usual}");
    }
}
