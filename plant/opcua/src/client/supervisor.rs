//! The life of a connection: select the endpoint, create the session, read the properties of the
//! server, subscribe, supervise, reconnect. The reconnect of the library is not used: with some
//! servers it receives no notifications afterwards. Each connection has a new session.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use futures_util::TryStreamExt as _;
use opcua::client::{
    ClientBuilder, IdentityToken, Session, SessionActivity, SessionPollResult, SubscriptionActivity,
};
use opcua::sync::Mutex;
use opcua::types::{
    DataValue, DateTime, EndpointDescription, MessageSecurityMode, NodeId, ReadValueId, StatusCode,
    TimestampsToReturn, UserTokenType, VariableId, Variant,
};
use tokio::sync::{Notify, mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, timeout};
use tracing::{debug, info, warn};

use super::connection_fault::ConnectionFault;
use super::connector::Direct;
use super::reach::{Reach, Silence};
use super::shown::{AcceptedCertificate, ServerJudge};
use super::subscription::WantedSubscription;
use super::{
    ClientConfig, ClientError, ClientUser, LimitedService, Link, OperationLimits, SecurityChoice,
};
use crate::limits;
use crate::pki::NO_PKI;
use crate::pki::{OWN_CERTIFICATE, OWN_KEY, Pki};

/// The state that the handles and the supervisor share.
pub(crate) struct ConnectionState {
    pub(crate) config: ClientConfig,
    url: String,
    pub(crate) link: watch::Sender<Link>,
    connected: Mutex<Option<Arc<ConnectedClient>>>,
    pub(crate) wanted: Mutex<BTreeMap<u64, WantedSubscription>>,
    /// Signals a new or dropped subscription.
    pub(crate) changed: Notify,
    closing: watch::Sender<bool>,
    /// How often the certificate of the server was refused.
    pub(crate) refused: AtomicU64,
    /// `None` without certificates.
    servers: Option<ServerJudge>,
    pub(crate) calls: CallsInFlight,
}

/// The calls that wait for their results, of all clients of a server.
#[derive(Debug, Clone, Default)]
pub(crate) struct CallsInFlight(Arc<AtomicUsize>);

/// Counts a call as waiting until this value is dropped.
#[derive(Debug)]
pub(crate) struct CallInFlight(Arc<AtomicUsize>);

impl CallsInFlight {
    pub(crate) fn start(&self) -> CallInFlight {
        self.0.fetch_add(1, Ordering::Relaxed);
        CallInFlight(Arc::clone(&self.0))
    }

    pub(crate) fn any(&self) -> bool {
        self.0.load(Ordering::Relaxed) > 0
    }
}

impl Drop for CallInFlight {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// A connection.
pub(crate) struct ConnectedClient {
    pub(crate) session: Arc<Session>,
    pub(crate) namespaces: Vec<String>,
    /// The OperationLimits of the server.
    pub(crate) limits: OperationLimits,
    /// The number of connections so far, including this connection.
    pub(crate) connects: u64,
    /// The start time of the server, which identifies its run.
    pub(crate) started: DateTime,
    /// The cache of supertypes.
    pub(crate) supertypes: Mutex<HashMap<NodeId, Option<NodeId>>>,
    /// The event loop of the library, which sends and receives all messages.
    driving: JoinHandle<()>,
}

impl Drop for ConnectedClient {
    fn drop(&mut self) {
        self.driving.abort();
    }
}

impl ConnectionState {
    pub(crate) fn new(config: ClientConfig, url: &str) -> Self {
        Self {
            servers: ServerJudge::of(&config),
            refused: AtomicU64::new(0),
            config,
            url: url.to_owned(),
            link: watch::Sender::new(Link::Connecting),
            connected: Mutex::default(),
            wanted: Mutex::default(),
            changed: Notify::new(),
            closing: watch::Sender::new(false),
            calls: CallsInFlight::default(),
        }
    }

    /// Creates the state of another client of the same server.
    pub(crate) fn another(&self) -> Self {
        Self {
            calls: self.calls.clone(),
            ..Self::new(self.config.clone(), &self.url)
        }
    }

    pub(crate) fn close(&self) {
        self.closing.send_replace(true);
    }

    pub(crate) fn connected(&self) -> Result<Arc<ConnectedClient>, ClientError> {
        let connected = self.connected.lock().clone();
        connected.ok_or_else(|| self.not_connected())
    }

    fn down(&self, why: &ConnectionFault) {
        let certificate = why.certificate();
        let is_refused = certificate.is_some();
        if is_refused {
            self.refused.fetch_add(1, Ordering::Relaxed);
        }
        let reason = why.to_string();
        let down = Link::Down {
            reason: reason.clone(),
            certificate,
        };
        let is_new = self.link.send_replace(down.clone()) != down;
        match (is_new, is_refused) {
            (true, true) => warn!(url = self.url, reason, "not connected"),
            (true, false) => info!(url = self.url, reason, "not connected"),
            (false, _) => {}
        }
    }

    pub(crate) fn not_connected(&self) -> ClientError {
        let reason = match &*self.link.borrow() {
            Link::Down { reason, .. } => reason.clone(),
            Link::Closed => "the client is closed".to_owned(),
            Link::Connecting | Link::Up { .. } => format!("{} has not responded yet", self.url),
        };
        ClientError::NotConnected(reason)
    }
}

/// Connects and reconnects until the client is closed.
pub(crate) async fn run(shared: Arc<ConnectionState>) {
    let mut closing = shared.closing.subscribe();
    {
        let living = pin!(live(&shared));
        let closed = pin!(closing.wait_for(|closing| *closing));
        tokio::select! {
            () = living => {}
            _ = closed => {}
        }
    }
    let last = shared.connected.lock().take();
    if let Some(last) = last {
        // Makes the server free the session at once instead of after the session timeout.
        let ended = timeout(shared.config.timeout, last.session.disconnect()).await;
        debug!(url = shared.url, ended = ended.is_ok(), "closed a session");
    }
    shared.wanted.lock().clear();
    shared.link.send_replace(Link::Closed);
}

async fn live(shared: &ConnectionState) {
    let client = match library_client(&shared.config) {
        Ok(client) => client,
        Err(why) => {
            shared.down(&why);
            return std::future::pending().await;
        }
    };
    let mut life = Life::default();
    let (first, longest) = shared.config.backoff;
    let mut wait = first;
    loop {
        let why = match connect(shared, &client, life.connects + 1).await {
            Ok(connection) => {
                wait = first;
                hold(shared, &mut life, connection).await
            }
            Err(why) => why,
        };
        shared.down(&why);
        sleep(wait).await;
        wait = (wait * 2).min(longest);
    }
}

/// The state that outlives each connection.
#[derive(Default)]
struct Life {
    connects: u64,
    started: Option<DateTime>,
}

/// Serves a connection until it is lost, and returns the reason.
async fn hold(
    shared: &ConnectionState,
    life: &mut Life,
    mut connection: Connection,
) -> ConnectionFault {
    life.connects += 1;
    let before = life.started.replace(connection.started);
    let restarted = before.is_some_and(|before| before != connection.started);
    for wanted in shared.wanted.lock().values_mut() {
        wanted.forget();
    }
    *shared.connected.lock() = Some(Arc::clone(&connection.connected));
    let endpoint = &connection.endpoint;
    let connects = life.connects;
    info!(url = shared.url, connects, restarted, "connected");
    shared.link.send_replace(Link::Up {
        restarted,
        connects,
        endpoint: endpoint.endpoint_url.as_ref().to_owned(),
        secured: endpoint.security_mode == MessageSecurityMode::SignAndEncrypt,
        application_uri: endpoint.server.application_uri.as_ref().to_owned(),
    });
    let why = watch_over(shared, &mut connection).await;
    *shared.connected.lock() = None;
    // Aborting the event loop fails the pending requests at once.
    connection.connected.driving.abort();
    why
}

fn library_client(config: &ClientConfig) -> Result<opcua::client::Client, ConnectionFault> {
    let root = match &config.pki {
        Some(root) => {
            let pki = Pki::open(root.clone())?;
            let host = opcua::crypto::hostname().unwrap_or_else(|_| "localhost".to_owned());
            pki.ensure_own(&config.application_uri, &host)?;
            root.clone()
        }
        None => PathBuf::from(NO_PKI),
    };
    let make = || {
        ClientBuilder::new()
            .application_name(&config.application_name)
            .application_uri(&config.application_uri)
            .product_uri("urn:ua-bridge:plant")
            .session_name(&config.application_name)
            .certificate_path(Path::new(OWN_CERTIFICATE))
            .private_key_path(Path::new(OWN_KEY))
            .pki_dir(&root)
            .session_retry_limit(0)
            .session_timeout(session_timeout(config.patience))
            .request_timeout(config.timeout)
            .keep_alive_interval(config.keep_alive)
            .max_failed_keep_alive_count(0)
            .recreate_subscriptions(false)
            .min_publish_interval(limits::SHORTEST_PUBLISHING)
            .max_array_length(limits::LARGEST_ARRAY)
            .max_string_length(limits::LARGEST_VALUE)
            .max_byte_string_length(limits::LARGEST_VALUE)
            .max_message_size(limits::LARGEST_MESSAGE)
            .max_chunk_count(limits::MOST_CHUNKS)
            .client()
    };
    // The library logs missing certificates even if the client does not need any.
    let made = if config.pki.is_some() {
        make()
    } else {
        tracing::subscriber::with_default(tracing::subscriber::NoSubscriber::new(), make)
    };
    made.map_err(ConnectionFault::Options)
}

/// A connection, and the state that ends with it.
struct Connection {
    connected: Arc<ConnectedClient>,
    endpoint: EndpointDescription,
    /// `None` without security.
    taken: Option<AcceptedCertificate>,
    started: DateTime,
    /// The activity of the library's event loop.
    activity: mpsc::Receiver<Activity>,
    ended: oneshot::Receiver<String>,
}

/// An activity that the supervision evaluates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Activity {
    Connected,
    KeptAlive,
    /// A keep-alive timed out.
    Missed,
    /// A keep-alive was answered by a server that is not in the state Running.
    NotRunning,
    Published,
}

/// Returns the session timeout in milliseconds, which is longer than the patience with a busy
/// server.
fn session_timeout(patience: Duration) -> u32 {
    u32::try_from((SESSION_TIMEOUT + patience).as_millis()).unwrap_or(u32::MAX)
}

fn identity(config: &ClientConfig) -> IdentityToken {
    match &config.user {
        Some(ClientUser { name, password }) => IdentityToken::new_user_name(name, password),
        None => IdentityToken::Anonymous,
    }
}

/// Returns the meaning of a keep-alive of a session for its server.
fn kept_alive(activity: &SessionActivity) -> Activity {
    match activity {
        SessionActivity::KeepAliveSucceeded => Activity::KeptAlive,
        SessionActivity::KeepAliveFailed(StatusCode::BadTimeout) => Activity::Missed,
        SessionActivity::KeepAliveFailed(_) => Activity::NotRunning,
    }
}

async fn connect(
    shared: &ConnectionState,
    client: &opcua::client::Client,
    connects: u64,
) -> Result<Connection, ConnectionFault> {
    let within = shared.config.timeout;
    let endpoint = timeout(within * 2, endpoint(shared, client))
        .await
        .map_err(|_| ConnectionFault::NoEndpoints(shared.url.clone()))??;
    let taken = match &shared.servers {
        Some(servers) => servers.take(&endpoint)?,
        None => None,
    };
    let store = match (&shared.servers, &taken) {
        (Some(servers), Some(taken)) => servers.store(taken)?,
        _ => Arc::clone(client.certificate_store()),
    };
    let source = Direct::new(&shared.url, within);
    let (session, event_loop) = client
        .session_builder()
        .user_identity_token(identity(&shared.config))
        .with_connector(source)
        .connect_to_endpoint_directly(endpoint.clone())
        .and_then(|builder| builder.build(store))?;
    session.disable_reconnects();
    let (tell, mut activity) = mpsc::channel(64);
    let (end, mut ended) = oneshot::channel();
    let driving = tokio::spawn(async move {
        let mut events = pin!(event_loop.enter());
        let reason = loop {
            let happened = match events.try_next().await {
                Ok(Some(SessionPollResult::Reconnected(_))) => Activity::Connected,
                Ok(Some(SessionPollResult::SessionActivity(activity))) => kept_alive(&activity),
                Ok(Some(SessionPollResult::Subscription(SubscriptionActivity::Publish))) => {
                    Activity::Published
                }
                Ok(Some(SessionPollResult::ReconnectFailed(status))) => break status.to_string(),
                Ok(Some(_)) => continue,
                Ok(None) => break "the connection was closed".to_owned(),
                Err(status) => break status.to_string(),
            };
            if tell.try_send(happened).is_err() {
                debug!(
                    ?happened,
                    "the state of the connection is not read; it is reported again later"
                );
            }
        };
        drop(end.send(reason));
    });
    let opened = timeout(within * 2, async {
        tokio::select! {
            reason = &mut ended => Err(ConnectionFault::Ended(
                reason.unwrap_or_else(|_| "it ended".to_owned()),
            )),
            _ = activity.recv() => Ok(()),
        }
    });
    let opened = opened.await;
    let driving = AbortOnDrop(Some(driving));
    opened.map_err(|_| ConnectionFault::NoSession(shared.url.clone()))??;
    let limits = OperationLimits::default();
    let (namespaces, started) = timeout(within, what_it_is(&session, &limits))
        .await
        .map_err(|_| ConnectionFault::NamespacesLate)??;
    Ok(Connection {
        connected: Arc::new(ConnectedClient {
            session,
            namespaces,
            limits,
            connects,
            started,
            supertypes: Mutex::default(),
            driving: driving.keep(),
        }),
        endpoint,
        taken,
        started,
        activity,
        ended,
    })
}

/// A task that is aborted if the connection attempt fails.
struct AbortOnDrop(Option<JoinHandle<()>>);

impl AbortOnDrop {
    fn keep(mut self) -> JoinHandle<()> {
        self.0.take().unwrap_or_else(|| tokio::spawn(async {}))
    }
}

impl Drop for AbortOnDrop {
    fn drop(&mut self) {
        if let Some(task) = self.0.take() {
            task.abort();
        }
    }
}

/// Selects the endpoint with the required security, and replaces its URL with the URL of the
/// client.
async fn endpoint(
    shared: &ConnectionState,
    client: &opcua::client::Client,
) -> Result<EndpointDescription, ConnectionFault> {
    let config = &shared.config;
    let asked = Direct::new(&shared.url, config.timeout);
    let offered = client.get_server_endpoints_from_url(asked).await?;
    let is_plain = |one: &EndpointDescription| one.security_mode == MessageSecurityMode::None;
    let has = |wanted: &dyn Fn(&EndpointDescription) -> bool| {
        let tcp = offered.iter().filter(|one| {
            let url: &str = one.endpoint_url.as_ref();
            url.starts_with("opc.tcp://")
        });
        tcp.into_iter().find(|one| wanted(one)).cloned()
    };
    let secured_by = |policies: &[&str]| {
        policies.iter().find_map(|policy| {
            has(&|one| {
                one.security_mode == MessageSecurityMode::SignAndEncrypt
                    && one.security_policy_uri.as_ref().rsplit('#').next() == Some(*policy)
            })
        })
    };
    let wanted: &[&str] = match config.security {
        SecurityChoice::Best => &POLICIES,
        SecurityChoice::None => &[],
        SecurityChoice::Basic256Sha256 => &["Basic256Sha256"],
        SecurityChoice::Aes128Sha256RsaOaep => &["Aes128_Sha256_RsaOaep"],
        SecurityChoice::Aes256Sha256RsaPss => &["Aes256_Sha256_RsaPss"],
    };
    let (is_best, is_none) = (
        config.security == SecurityChoice::Best,
        config.security == SecurityChoice::None,
    );
    let can_secure = config.pki.is_some();
    if !can_secure && !is_best && !is_none {
        return Err(ConnectionFault::NoPki);
    }
    let secured = can_secure.then(|| secured_by(wanted)).flatten();
    // A password must not be sent in clear text.
    let may_be_plain = is_none || is_best && config.user.is_none();
    let chosen = secured.or_else(|| may_be_plain.then(|| has(&is_plain)).flatten());
    let mut chosen = chosen.ok_or_else(|| no_security(shared, &offered))?;
    admits_user(shared, &chosen)?;
    // The host name in the server's own URL may not resolve here.
    chosen.endpoint_url = shared.url.as_str().into();
    Ok(chosen)
}

/// Checks that an endpoint admits the kind of user of the client. The library reports only that the
/// connection was closed. An endpoint without any policy admits anonymous users.
fn admits_user(
    shared: &ConnectionState,
    endpoint: &EndpointDescription,
) -> Result<(), ConnectionFault> {
    let url = shared.url.clone();
    let (wanted, refused) = match &shared.config.user {
        Some(_) => (UserTokenType::UserName, ConnectionFault::NoPasswords(url)),
        None => (UserTokenType::Anonymous, ConnectionFault::NotAnonymous(url)),
    };
    let policies = endpoint.user_identity_tokens.iter().flatten();
    let mut offered = policies.map(|policy| policy.token_type).peekable();
    let admits = offered.peek().is_none() || offered.any(|offered| offered == wanted);
    match admits {
        true => Ok(()),
        false => Err(refused),
    }
}

/// Returns the error for a server without a suitable endpoint, with the offered and the required
/// security.
fn no_security(shared: &ConnectionState, offered: &[EndpointDescription]) -> ConnectionFault {
    let each = offered.iter().map(|one| {
        let policy = one.security_policy_uri.as_ref().rsplit('#').next();
        let mode = one.security_mode;
        if mode == MessageSecurityMode::None {
            return "None".to_owned();
        }
        format!("{}/{mode:?}", policy.unwrap_or_default())
    });
    let mut each: Vec<String> = each.take(MOST_TOLD).collect();
    each.sort();
    each.dedup();
    let offers = match each.is_empty() {
        true => "nothing".to_owned(),
        false => each.join(", "),
    };
    let config = &shared.config;
    let mut wants = match config.security {
        SecurityChoice::Best if config.pki.is_some() => "the best secured policy".to_owned(),
        SecurityChoice::Best | SecurityChoice::None => "None".to_owned(),
        SecurityChoice::Basic256Sha256 => "Basic256Sha256/SignAndEncrypt".to_owned(),
        SecurityChoice::Aes128Sha256RsaOaep => "Aes128_Sha256_RsaOaep/SignAndEncrypt".to_owned(),
        SecurityChoice::Aes256Sha256RsaPss => "Aes256_Sha256_RsaPss/SignAndEncrypt".to_owned(),
    };
    if config.user.is_some() && config.security == SecurityChoice::Best {
        wants.push_str(", because a password is sent encrypted only");
    }
    ConnectionFault::Security {
        url: shared.url.clone(),
        offers,
        wants,
    }
}

/// Reads the namespaces, the start time and the OperationLimits of a server.
async fn what_it_is(
    session: &Session,
    limits: &OperationLimits,
) -> Result<(Vec<String>, DateTime), ConnectionFault> {
    let about = [
        VariableId::Server_NamespaceArray,
        VariableId::Server_ServerStatus_StartTime,
    ];
    let wanted: Vec<ReadValueId> = about
        .into_iter()
        .chain(OperationLimits::VARIABLES)
        .map(|id| ReadValueId::new_value(id.into()))
        .collect();
    let mut parts = limits.parts(LimitedService::Read, &wanted);
    while let Some(part) = parts.next_part() {
        let read = session.read(part, TimestampsToReturn::Neither, 0.0).await;
        parts.answered(read).map_err(ClientError::from)?;
    }
    let mut values = parts.into_answers().into_iter();
    let namespaces = values.next().and_then(strings);
    let started = values.next().and_then(|value| {
        let Some(Variant::DateTime(time)) = value.value else {
            return None;
        };
        Some(*time)
    });
    limits.learn(values.as_slice());
    let namespaces = namespaces.ok_or(ConnectionFault::NoNamespaces)?;
    // Restarts of a server without StartTime are not detected.
    Ok((namespaces, started.unwrap_or_else(DateTime::null)))
}

fn strings(value: DataValue) -> Option<Vec<String>> {
    let Some(Variant::Array(array)) = value.value else {
        return None;
    };
    let each = array.values.into_iter().map(|value| {
        let Variant::String(text) = value else {
            return None;
        };
        Some(text.as_ref().to_owned())
    });
    each.collect()
}

/// Creates the subscriptions, supervises the connection, and returns the reason for its end.
async fn watch_over(shared: &ConnectionState, connection: &mut Connection) -> ConnectionFault {
    let mut silence = Silence::new(shared.config.patience, Instant::now());
    let mut reach = Reach::new(&shared.url);
    let mut published = Instant::now();
    let mut look = tokio::time::interval(LOOK);
    look.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut judged = tokio::time::interval(JUDGED_EVERY);
    judged.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        // A busy server does not answer requests, so the subscriptions are created after the call.
        if !shared.calls.any()
            && let Err(fault) = super::subscription::renew(shared, &connection.connected).await
        {
            return fault;
        }
        tokio::select! {
            reason = &mut connection.ended => {
                let reason = reason.unwrap_or_else(|_| "the connection ended".to_owned());
                return ConnectionFault::Ended(reason);
            }
            activity = connection.activity.recv() => match activity {
                // Missed keep-alives do not count while the server executes a call.
                Some(Activity::Missed) if shared.calls.any() => {}
                Some(Activity::Missed) => silence.missed(),
                Some(Activity::NotRunning) => silence.not_running(),
                Some(Activity::KeptAlive | Activity::Connected) => {
                    silence.answered(Instant::now());
                    reach.answered(Instant::now());
                }
                Some(Activity::Published) => published = Instant::now(),
                None => {}
            },
            () = reach.tried() => reach.answered(Instant::now()),
            () = shared.changed.notified() => {}
            _ = look.tick() => {
                let now = Instant::now();
                let is_calling = shared.calls.any();
                let subscribed = shared.wanted.lock().values().any(WantedSubscription::is_made);
                if !subscribed || is_calling || silence.is_tolerated(now) {
                    published = now;
                } else if published.elapsed() > LONGEST_SILENCE {
                    return ConnectionFault::NoPublishing;
                }
                if !reach.look(is_calling || silence.is_tolerated(now), now) {
                    return ConnectionFault::HostLost;
                }
            }
            _ = judged.tick() => {
                if let (Some(servers), Some(taken)) = (&shared.servers, &connection.taken)
                    && let Err(refused) = servers.again(taken)
                {
                    return refused.into();
                }
            }
        }
        if silence.is_too_long(shared.calls.any(), Instant::now()) {
            return ConnectionFault::Silent;
        }
    }
}

/// Converts the error of a failed request.
pub(crate) fn failed(error: &opcua::types::Error) -> ClientError {
    match error.status() {
        StatusCode::BadTimeout
        | StatusCode::BadConnectionClosed
        | StatusCode::BadNotConnected
        | StatusCode::BadServerNotConnected
        | StatusCode::BadCommunicationError
        | StatusCode::BadSecureChannelClosed
        | StatusCode::BadSessionClosed
        | StatusCode::BadShutdown => ClientError::Lost(error.to_string()),
        status => ClientError::Status(status),
    }
}

/// The security policies in the order of preference: the policy that most servers and certificates
/// support is first.
const POLICIES: [&str; 3] = [
    "Basic256Sha256",
    "Aes256_Sha256_RsaPss",
    "Aes128_Sha256_RsaOaep",
];
/// Maximum number of endpoints in an error message.
const MOST_TOLD: usize = 12;
/// Session timeout at the server, without the patience.
const SESSION_TIMEOUT: Duration = Duration::from_secs(30);
/// Interval of judging the certificate of a connected server, which may be revoked or expire.
const JUDGED_EVERY: Duration = Duration::from_secs(2);
/// Interval of checking the connection and the subscriptions.
const LOOK: Duration = Duration::from_millis(500);
/// Longest time without a notification; each subscription sends a keep-alive every second.
const LONGEST_SILENCE: Duration = Duration::from_secs(5);
