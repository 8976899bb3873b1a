//! Queries of servers and Local Discovery Servers without a session.

#![expect(
    clippy::wildcard_enum_match_arm,
    reason = "discovery uses some of the messages of all services"
)]

use std::path::Path;
use std::time::Duration;

use opcua::core::comms::secure_channel::Role;
use opcua::core::comms::security_header::AsymmetricSecurityHeader;
use opcua::core::comms::tcp_types::{AcknowledgeMessage, HelloMessage};
use opcua::core::{RequestMessage, ResponseMessage};
use opcua::crypto::SecurityPolicy;
use opcua::types::{
    ActivateSessionRequest, AnonymousIdentityToken, ApplicationDescription, ApplicationType,
    ByteString, CloseSecureChannelRequest, CloseSessionRequest, CreateSessionRequest, DateTime,
    EndpointDescription, ExtensionObject, FindServersOnNetworkRequest, FindServersRequest,
    GetEndpointsRequest, LocalizedText, MdnsDiscoveryConfiguration, MessageSecurityMode, NodeId,
    OpenSecureChannelRequest, ReadRequest, ReadValueId, RegisterServer2Request,
    RegisterServerRequest, RegisteredServer, RequestHeader, SecurityTokenRequestType, StatusCode,
    TimestampsToReturn, UAString, UserTokenType, VariableId, Variant,
};
use tokio::net::TcpStream;
use tokio::time::timeout;

use plant_opcua::supervision::Registrar;

use crate::description::ServerDescription;
use crate::security::ChannelSecurity;
use crate::wire::{Conversation, FrameKind, MOST_CHUNK, MOST_CHUNKS, MOST_HEARD, WireFault};
use mdns::Url;

/// An error of a query.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DiscoveryQueryFault {
    /// The URL is not an OPC UA URL over TCP.
    #[error("{0} is not a URL such as opc.tcp://host:port")]
    Url(String),
    /// The server is not reachable.
    #[error("{0}")]
    Connect(#[from] std::io::Error),
    /// The server did not answer in time.
    #[error("no response within {0:?}")]
    Late(Duration),
    /// The server refused the request with this StatusCode.
    #[error("refused: {0}")]
    Refused(StatusCode),
    /// The certificate of the server is not trusted, or the own certificate cannot be read.
    #[error("{0}")]
    Certificate(String),
    /// The server violates the protocol.
    #[error("{0}")]
    Protocol(String),
    /// No discovery server is reachable, and embedding a discovery server failed.
    #[error("no discovery server runs, and this program cannot start one: {0}")]
    Embed(String),
}

impl From<WireFault> for DiscoveryQueryFault {
    fn from(fault: WireFault) -> Self {
        match fault {
            WireFault::Io(error) => Self::Connect(error),
            WireFault::Told(status) => Self::Refused(status),
            other => Self::Protocol(other.to_string()),
        }
    }
}

/// A server in the result of FindServers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundServer {
    /// The ApplicationUri.
    pub application_uri: String,
    /// The application name.
    pub name: String,
    /// Whether the server is a discovery server.
    pub is_discovery_server: bool,
    /// The DiscoveryUrls.
    pub discovery_urls: Vec<String>,
}

/// The self-description of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SelfDescription {
    /// The application.
    pub application: FoundServer,
    /// The ProductUri, which identifies the product.
    pub product_uri: String,
    /// The security of its endpoints without duplicates: `None`, or policy and mode, for example
    /// `Basic256Sha256/Sign`.
    pub security: Vec<String>,
}

/// A server in the result of FindServersOnNetwork.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OnNetwork {
    /// The RecordId.
    pub record_id: u32,
    /// The mDNS instance name.
    pub name: String,
    /// The DiscoveryUrl.
    pub url: String,
    /// The server capabilities: codes of OPC 10000-12, Annex D.
    pub capabilities: Vec<String>,
}

/// Returns the servers registered at a server, including the server itself: FindServers.
///
/// # Errors
/// Returns [`DiscoveryQueryFault`], after `limit` at the latest.
pub async fn find_servers(
    url: &str,
    limit: Duration,
) -> Result<Vec<FoundServer>, DiscoveryQueryFault> {
    let request = FindServersRequest {
        request_header: header(),
        endpoint_url: url.into(),
        ..FindServersRequest::default()
    };
    match ask(url, None, request.into(), limit).await? {
        ResponseMessage::FindServers(response) => Ok(response
            .servers
            .into_iter()
            .flatten()
            .map(|server| application(&server))
            .collect()),
        other => Err(unexpected(&other)),
    }
}

/// Returns the self-description of the server at `url`: GetEndpoints (OPC 10000-4, 5.5.4).
///
/// # Errors
/// Returns [`DiscoveryQueryFault`], after `limit` at the latest.
pub async fn describe(url: &str, limit: Duration) -> Result<SelfDescription, DiscoveryQueryFault> {
    let request = GetEndpointsRequest {
        request_header: header(),
        endpoint_url: url.into(),
        ..GetEndpointsRequest::default()
    };
    let endpoints = match ask(url, None, request.into(), limit).await? {
        ResponseMessage::GetEndpoints(response) => response.endpoints.unwrap_or_default(),
        other => return Err(unexpected(&other)),
    };
    let Some(server) = endpoints.first().map(|endpoint| &endpoint.server) else {
        return Err(DiscoveryQueryFault::Protocol(
            "it has no endpoints".to_owned(),
        ));
    };
    let mut security = Vec::new();
    for endpoint in endpoints.iter().take(MOST_ENDPOINTS) {
        let policy = text(&endpoint.security_policy_uri);
        let policy = policy.rsplit('#').next().unwrap_or_default();
        let way = match endpoint.security_mode {
            MessageSecurityMode::None => "None".to_owned(),
            MessageSecurityMode::Sign => format!("{policy}/Sign"),
            MessageSecurityMode::SignAndEncrypt => format!("{policy}/SignAndEncrypt"),
            MessageSecurityMode::Invalid => continue,
        };
        if !security.contains(&way) {
            security.push(way);
        }
    }
    Ok(SelfDescription {
        product_uri: text(&server.product_uri),
        application: application(server),
        security,
    })
}

/// Returns the servers that are announced on the network: FindServersOnNetwork.
///
/// # Errors
/// Returns [`DiscoveryQueryFault`], after `limit` at the latest.
pub async fn find_servers_on_network(
    url: &str,
    limit: Duration,
) -> Result<Vec<OnNetwork>, DiscoveryQueryFault> {
    let request = FindServersOnNetworkRequest {
        request_header: header(),
        ..FindServersOnNetworkRequest::default()
    };
    match ask(url, None, request.into(), limit).await? {
        ResponseMessage::FindServersOnNetwork(response) => Ok(response
            .servers
            .into_iter()
            .flatten()
            .map(|server| OnNetwork {
                record_id: server.record_id,
                name: text(&server.server_name),
                url: text(&server.discovery_url),
                capabilities: texts(server.server_capabilities.as_deref()),
            })
            .collect()),
        other => Err(unexpected(&other)),
    }
}

/// Returns the start time of the program behind an endpoint, in 100 ns since 1601: the StartTime of
/// its ServerStatus (OPC 10000-5, 12.10). Reads it in a temporary anonymous session.
///
/// # Errors
/// Returns [`DiscoveryQueryFault`], after `limit` at the latest; a server without anonymous
/// sessions refuses.
pub(crate) async fn start_time(url: &str, limit: Duration) -> Result<i64, DiscoveryQueryFault> {
    match timeout(limit, Box::pin(read_start_time(url))).await {
        Ok(read) => read,
        Err(_) => Err(DiscoveryQueryFault::Late(limit)),
    }
}

async fn read_start_time(url: &str) -> Result<i64, DiscoveryQueryFault> {
    let mut conversation = opened(url, None).await?;
    let request = CreateSessionRequest {
        request_header: header(),
        client_description: ApplicationDescription {
            application_uri: "urn:ua-bridge:discovery".into(),
            application_type: ApplicationType::Client,
            ..ApplicationDescription::default()
        },
        endpoint_url: url.into(),
        session_name: "discovery".into(),
        requested_session_timeout: 10_000.0,
        max_response_message_size: number(MOST_HEARD),
        ..CreateSessionRequest::default()
    };
    let session = match answer(&mut conversation, 2, &request.into()).await? {
        ResponseMessage::CreateSession(session) => session,
        other => return Err(unexpected(&other)),
    };
    let request_header = RequestHeader {
        authentication_token: session.authentication_token.clone(),
        ..header()
    };
    let none_of =
        |endpoint: &&EndpointDescription| endpoint.security_mode == MessageSecurityMode::None;
    let endpoints = session.server_endpoints.as_deref().unwrap_or_default();
    let tokens = endpoints.iter().filter(none_of);
    let tokens = tokens.flat_map(|endpoint| endpoint.user_identity_tokens.iter().flatten());
    let anonymous = tokens
        .into_iter()
        .find(|token| token.token_type == UserTokenType::Anonymous)
        .map(|token| token.policy_id.clone());
    let read = match anonymous {
        Some(policy) => read_in_session(&mut conversation, &request_header, policy).await,
        None => Err(DiscoveryQueryFault::Refused(
            StatusCode::BadIdentityTokenRejected,
        )),
    };
    let close = CloseSessionRequest {
        request_header,
        delete_subscriptions: true,
    };
    // A failure to close the session does not affect the result.
    drop(answer(&mut conversation, 5, &close.into()).await);
    read
}

async fn read_in_session(
    conversation: &mut Conversation<TcpStream>,
    request_header: &RequestHeader,
    policy_id: UAString,
) -> Result<i64, DiscoveryQueryFault> {
    let request = ActivateSessionRequest {
        request_header: request_header.clone(),
        user_identity_token: ExtensionObject::from_message(AnonymousIdentityToken { policy_id }),
        ..ActivateSessionRequest::default()
    };
    match answer(conversation, 3, &request.into()).await? {
        ResponseMessage::ActivateSession(_) => {}
        other => return Err(unexpected(&other)),
    }
    let start_time = VariableId::Server_ServerStatus_StartTime;
    let request = ReadRequest {
        request_header: request_header.clone(),
        max_age: 0.0,
        timestamps_to_return: TimestampsToReturn::Neither,
        nodes_to_read: Some(vec![ReadValueId::new_value(start_time.into())]),
    };
    let results = match answer(conversation, 4, &request.into()).await? {
        ResponseMessage::Read(read) => read.results.unwrap_or_default(),
        other => return Err(unexpected(&other)),
    };
    match results.first().and_then(|result| result.value.as_ref()) {
        Some(Variant::DateTime(at)) => Ok(at.ticks()),
        _ => Err(DiscoveryQueryFault::Protocol(
            "it does not say when it started".to_owned(),
        )),
    }
}

/// A secured channel to a server, and the identity of the server.
#[derive(Debug)]
struct Way {
    security: ChannelSecurity,
    server: ByteString,
    mode: MessageSecurityMode,
    /// The ApplicationUri of the server, which its certificate contains.
    application_uri: String,
}

/// Selects the best secured channel between a server and the application of a certificate store.
/// Returns `None` if the server offers no secured channel. Also returns `None` for an untrusted
/// server on this host: an attacker on this host has the same power without a forged server.
async fn way(url: &str, pki: &Path) -> Result<Option<Way>, DiscoveryQueryFault> {
    let security = ChannelSecurity::existing(pki)
        .map_err(|failure| DiscoveryQueryFault::Certificate(failure.to_string()))?;
    let request = GetEndpointsRequest {
        request_header: header(),
        endpoint_url: url.into(),
        ..GetEndpointsRequest::default()
    };
    let endpoints = match ask(url, None, request.into(), REGISTER_LIMIT).await? {
        ResponseMessage::GetEndpoints(response) => response.endpoints.unwrap_or_default(),
        other => return Err(unexpected(&other)),
    };
    let basic = |endpoint: &&EndpointDescription| {
        let policy = SecurityPolicy::from_uri(endpoint.security_policy_uri.as_ref());
        policy == SecurityPolicy::Basic256Sha256
            && endpoint.endpoint_url.as_ref().starts_with(SCHEME)
    };
    let rank = |endpoint: &&EndpointDescription| match endpoint.security_mode {
        MessageSecurityMode::SignAndEncrypt => 2,
        MessageSecurityMode::Sign => 1,
        MessageSecurityMode::None | MessageSecurityMode::Invalid => 0,
    };
    let best = endpoints.iter().filter(basic).max_by_key(rank);
    let Some(best) = best.filter(|best| rank(best) > 0) else {
        return Ok(None);
    };
    let server = best.server_certificate.clone();
    let refused = match security.trusts(server.as_ref(), best.server.application_uri.as_ref()) {
        Ok(()) => {
            let mode = best.security_mode;
            return Ok(Some(Way {
                security,
                server,
                mode,
                application_uri: text(&best.server.application_uri),
            }));
        }
        Err(refused) => refused,
    };
    let ip = Url::parse(url).and_then(|url| url.ip());
    let is_here = ip.is_some_and(|ip| ip.to_canonical().is_loopback());
    // An explicit decision on a certificate also applies on this host.
    if is_here && !refused.may_be_told {
        Ok(None)
    } else {
        Err(DiscoveryQueryFault::Certificate(refused.to_string()))
    }
}

/// Registers or unregisters a server by RegisterServer2, or by RegisterServer if the discovery
/// server does not support RegisterServer2. Uses a secured channel if the server has a certificate
/// store and the discovery server offers such a channel. Returns the discovery server if its
/// identity is known.
pub(crate) async fn register(
    lds: &str,
    server: &ServerDescription,
    (mdns_name, pki): (Option<&str>, Option<&Path>),
    is_online: bool,
) -> Result<Option<Registrar>, DiscoveryQueryFault> {
    let way = match pki {
        Some(pki) => way(lds, pki).await?,
        None => None,
    };
    let way = way.as_ref();
    let registered = RegisteredServer {
        server_uri: server.application_uri.as_str().into(),
        product_uri: server.product_uri.as_str().into(),
        server_names: Some(vec![LocalizedText::new("en", &server.name)]),
        server_type: ApplicationType::Server,
        discovery_urls: Some(vec![server.url.as_str().into()]),
        is_online,
        ..RegisteredServer::default()
    };
    let configuration = MdnsDiscoveryConfiguration {
        mdns_server_name: mdns_name.unwrap_or_default().into(),
        server_capabilities: Some(
            server
                .capabilities
                .iter()
                .map(|code| code.as_str().into())
                .collect(),
        ),
    };
    let request = RegisterServer2Request {
        request_header: header(),
        server: registered.clone(),
        discovery_configuration: Some(vec![ExtensionObject::from_message(configuration)]),
    };
    let unknown = [
        StatusCode::BadServiceUnsupported,
        StatusCode::BadNotImplemented,
    ];
    // Both requests run concurrently, so that the supervisor is known when it learns of the server.
    let described = async {
        match way {
            None if is_online => describe(lds, DESCRIBE_LIMIT).await.ok(),
            Some(_) | None => None,
        }
    };
    let registering = async {
        match ask(lds, way, request.into(), REGISTER_LIMIT).await {
            Err(DiscoveryQueryFault::Refused(status)) if unknown.contains(&status) => {
                let request = RegisterServerRequest {
                    request_header: header(),
                    server: registered,
                };
                ask(lds, way, request.into(), REGISTER_LIMIT).await
            }
            answer => answer,
        }
    };
    let (answer, described) = tokio::join!(registering, described);
    match answer? {
        ResponseMessage::RegisterServer2(_) | ResponseMessage::RegisterServer(_) => {}
        other => return Err(unexpected(&other)),
    }
    let registrar = match way {
        Some(way) => Some((way.application_uri.clone(), true)),
        // The registration is valid even if the discovery server does not describe itself.
        None => described.map(|described| (described.application.application_uri, false)),
    };
    Ok(registrar.map(|(application_uri, proven)| Registrar {
        application_uri,
        proven,
    }))
}

/// Sends a request on a new channel.
async fn ask(
    url: &str,
    way: Option<&Way>,
    request: RequestMessage,
    limit: Duration,
) -> Result<ResponseMessage, DiscoveryQueryFault> {
    match timeout(limit, Box::pin(converse(url, way, request))).await {
        Ok(answer) => answer,
        Err(_) => Err(DiscoveryQueryFault::Late(limit)),
    }
}

async fn converse(
    url: &str,
    way: Option<&Way>,
    request: RequestMessage,
) -> Result<ResponseMessage, DiscoveryQueryFault> {
    let mut conversation = opened(url, way).await?;
    let answered = answer(&mut conversation, 2, &request).await?;
    // A failure to close the channel does not affect the result.
    let close = CloseSecureChannelRequest {
        request_header: header(),
    };
    drop(conversation.send(3, &RequestMessage::from(close)).await);
    Ok(answered)
}

/// Connects and opens a new channel.
async fn opened(
    url: &str,
    way: Option<&Way>,
) -> Result<Conversation<TcpStream>, DiscoveryQueryFault> {
    let place = Url::parse(url).ok_or_else(|| DiscoveryQueryFault::Url(url.to_owned()))?;
    let stream = TcpStream::connect((place.host.as_str(), place.port)).await?;
    stream.set_nodelay(true)?;
    let mut conversation = Conversation::new(stream, Role::Client);
    let (chunk, message, chunks) = (MOST_CHUNK, MOST_HEARD, MOST_CHUNKS);
    conversation
        .greet(&HelloMessage::new(url, chunk, chunk, message, chunks))
        .await?;
    let acknowledge: AcknowledgeMessage = conversation.greeting(FrameKind::Acknowledge).await?;
    conversation.limit(
        acknowledge.receive_buffer_size,
        acknowledge.max_message_size,
    );
    open(&mut conversation, way).await?;
    Ok(conversation)
}

/// Opens the secure channel on a connection.
async fn open(
    conversation: &mut Conversation<TcpStream>,
    way: Option<&Way>,
) -> Result<(), DiscoveryQueryFault> {
    let bad = |error: opcua::types::Error| DiscoveryQueryFault::Protocol(error.to_string());
    let channel = &mut conversation.channel;
    if let Some(way) = way {
        channel.set_security_policy(SecurityPolicy::Basic256Sha256);
        channel.set_security_mode(way.mode);
        channel.set_cert(Some(way.security.certificate.clone()));
        channel.set_private_key(Some(way.security.key.clone()));
        let set = channel.set_remote_cert_from_byte_string(&way.server);
        set.map_err(bad)?;
        channel.create_random_nonce();
    }
    let request = OpenSecureChannelRequest {
        request_header: header(),
        client_protocol_version: 0,
        request_type: SecurityTokenRequestType::Issue,
        security_mode: way.map_or(MessageSecurityMode::None, |way| way.mode),
        client_nonce: way.map_or_else(ByteString::null, |_| channel.local_nonce_as_byte_string()),
        requested_lifetime: CHANNEL_LIFETIME,
    };
    let request = RequestMessage::from(request);
    let opened = match answer_from(conversation, way, 1, &request).await? {
        ResponseMessage::OpenSecureChannel(opened) => opened,
        other => return Err(unexpected(&other)),
    };
    let channel = &mut conversation.channel;
    channel.set_security_token(opened.security_token);
    if way.is_some() {
        let set = channel.set_remote_nonce_from_byte_string(&opened.server_nonce);
        set.map_err(bad)?;
        channel.derive_keys();
    }
    Ok(())
}

async fn answer(
    conversation: &mut Conversation<TcpStream>,
    request_id: u32,
    request: &RequestMessage,
) -> Result<ResponseMessage, DiscoveryQueryFault> {
    answer_from(conversation, None, request_id, request).await
}

/// Returns the response to a request. The response that opens a channel must be signed by the
/// expected server.
async fn answer_from(
    conversation: &mut Conversation<TcpStream>,
    way: Option<&Way>,
    request_id: u32,
    request: &RequestMessage,
) -> Result<ResponseMessage, DiscoveryQueryFault> {
    conversation.send(request_id, request).await?;
    let whose = |header: &AsymmetricSecurityHeader| match way {
        Some(way) if header.sender_certificate != way.server => {
            Err(StatusCode::BadSecurityChecksFailed)
        }
        Some(_) | None => Ok(()),
    };
    let received = conversation.receive::<ResponseMessage>(whose).await?;
    let status = received.message.response_header().service_result;
    match received.message {
        ResponseMessage::ServiceFault(_) => Err(DiscoveryQueryFault::Refused(status)),
        _ if status.is_bad() => Err(DiscoveryQueryFault::Refused(status)),
        message => Ok(message),
    }
}

fn application(told: &ApplicationDescription) -> FoundServer {
    FoundServer {
        application_uri: text(&told.application_uri),
        name: text(&told.application_name.text),
        is_discovery_server: told.application_type == ApplicationType::DiscoveryServer,
        discovery_urls: texts(told.discovery_urls.as_deref()),
    }
}

fn header() -> RequestHeader {
    RequestHeader {
        timeout_hint: 5000,
        ..RequestHeader::new(&NodeId::null(), &DateTime::now(), 1)
    }
}

fn unexpected(answer: &ResponseMessage) -> DiscoveryQueryFault {
    DiscoveryQueryFault::Protocol(format!(
        "{} is not a response to this request",
        answer.type_name()
    ))
}

fn number(size: usize) -> u32 {
    u32::try_from(size).unwrap_or(u32::MAX)
}

fn text(text: &UAString) -> String {
    text.as_ref()
        .chars()
        .filter(|letter| !letter.is_control())
        .take(1024)
        .collect()
}

fn texts(all: Option<&[UAString]>) -> Vec<String> {
    all.unwrap_or_default().iter().take(64).map(text).collect()
}

/// Maximum number of endpoints with their security in a response.
const MOST_ENDPOINTS: usize = 64;
const SCHEME: &str = "opc.tcp:";
const REGISTER_LIMIT: Duration = Duration::from_secs(5);
const DESCRIBE_LIMIT: Duration = Duration::from_secs(1);
/// Channel lifetime in milliseconds, for a single request.
const CHANNEL_LIFETIME: u32 = 60_000;
