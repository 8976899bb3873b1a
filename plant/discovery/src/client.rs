//! Asking a server or a Local Discovery Server without a session.

#![expect(
    clippy::wildcard_enum_match_arm,
    reason = "of the messages of all services some are those of discovery"
)]

use std::time::Duration;

use opcua::core::comms::secure_channel::Role;
use opcua::core::comms::tcp_types::{AcknowledgeMessage, HelloMessage};
use opcua::core::{RequestMessage, ResponseMessage};
use opcua::types::{
    ApplicationType, CloseSecureChannelRequest, DateTime, ExtensionObject,
    FindServersOnNetworkRequest, FindServersRequest, LocalizedText, MdnsDiscoveryConfiguration,
    MessageSecurityMode, NodeId, OpenSecureChannelRequest, RegisterServer2Request,
    RegisterServerRequest, RegisteredServer, RequestHeader, SecurityTokenRequestType, StatusCode,
    UAString,
};
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::announce::Server;
use crate::url::Url;
use crate::wire::{Conversation, Kind, MOST_CHUNK, MOST_CHUNKS, MOST_HEARD, WireFault};

/// Why there is no answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AskFault {
    /// The URL is none of OPC UA over TCP.
    #[error("{0} is no URL as opc.tcp://host:port")]
    Url(String),
    /// Nobody is there.
    #[error("{0}")]
    Connect(#[from] std::io::Error),
    /// It did not answer in time.
    #[error("no answer in {0:?}")]
    Late(Duration),
    /// It refuses, with this StatusCode.
    #[error("refused: {0}")]
    Refused(StatusCode),
    /// It does not speak OPC UA as it should.
    #[error("{0}")]
    Protocol(String),
}

impl From<WireFault> for AskFault {
    fn from(fault: WireFault) -> Self {
        match fault {
            WireFault::Io(error) => Self::Connect(error),
            WireFault::Told(status) => Self::Refused(status),
            other => Self::Protocol(other.to_string()),
        }
    }
}

/// A server that FindServers lists.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Application {
    /// Its ApplicationUri.
    pub application_uri: String,
    /// Its name.
    pub name: String,
    /// Whether it is itself a discovery server.
    pub is_discovery_server: bool,
    /// Where its endpoints are asked for.
    pub discovery_urls: Vec<String>,
}

/// A server that FindServersOnNetwork lists.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OnNetwork {
    /// Its number there.
    pub record_id: u32,
    /// Its mDNS name.
    pub name: String,
    /// Where it is.
    pub url: String,
    /// Codes of OPC 10000-12, Annex D.
    pub capabilities: Vec<String>,
}

/// The servers that are registered, with the asked one itself: FindServers.
///
/// # Errors
/// [`AskFault`], after `limit` at the latest.
pub async fn find_servers(url: &str, limit: Duration) -> Result<Vec<Application>, AskFault> {
    let request = FindServersRequest {
        request_header: header(),
        endpoint_url: url.into(),
        ..FindServersRequest::default()
    };
    match ask(url, request.into(), limit).await? {
        ResponseMessage::FindServers(response) => Ok(response
            .servers
            .into_iter()
            .flatten()
            .map(|server| Application {
                application_uri: text(&server.application_uri),
                name: text(&server.application_name.text),
                is_discovery_server: server.application_type == ApplicationType::DiscoveryServer,
                discovery_urls: texts(server.discovery_urls.as_deref()),
            })
            .collect()),
        other => Err(unexpected(&other)),
    }
}

/// The servers that are announced on the network: FindServersOnNetwork.
///
/// # Errors
/// [`AskFault`], after `limit` at the latest.
pub async fn find_servers_on_network(
    url: &str,
    limit: Duration,
) -> Result<Vec<OnNetwork>, AskFault> {
    let request = FindServersOnNetworkRequest {
        request_header: header(),
        ..FindServersOnNetworkRequest::default()
    };
    match ask(url, request.into(), limit).await? {
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

/// Registers a server, or takes its registration back: RegisterServer2, and RegisterServer where that is not known.
pub(crate) async fn register(
    lds: &str,
    server: &Server,
    mdns_name: Option<&str>,
    is_online: bool,
) -> Result<(), AskFault> {
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
    let answer = match ask(lds, request.into(), REGISTER_LIMIT).await {
        Err(AskFault::Refused(status)) if unknown.contains(&status) => {
            let request = RegisterServerRequest {
                request_header: header(),
                server: registered,
            };
            ask(lds, request.into(), REGISTER_LIMIT).await?
        }
        answer => answer?,
    };
    match answer {
        ResponseMessage::RegisterServer2(_) | ResponseMessage::RegisterServer(_) => Ok(()),
        other => Err(unexpected(&other)),
    }
}

/// One question on a channel of its own.
async fn ask(
    url: &str,
    request: RequestMessage,
    limit: Duration,
) -> Result<ResponseMessage, AskFault> {
    match timeout(limit, converse(url, request)).await {
        Ok(answer) => answer,
        Err(_) => Err(AskFault::Late(limit)),
    }
}

async fn converse(url: &str, request: RequestMessage) -> Result<ResponseMessage, AskFault> {
    let place = Url::parse(url).ok_or_else(|| AskFault::Url(url.to_owned()))?;
    let stream = TcpStream::connect((place.host.as_str(), place.port)).await?;
    stream.set_nodelay(true)?;
    let mut conversation = Conversation::new(stream, Role::Client);
    let (chunk, message, chunks) = (MOST_CHUNK, MOST_HEARD, MOST_CHUNKS);
    conversation
        .greet(&HelloMessage::new(url, chunk, chunk, message, chunks))
        .await?;
    let acknowledge: AcknowledgeMessage = conversation.greeting(Kind::Acknowledge).await?;
    conversation.limit(
        acknowledge.receive_buffer_size,
        acknowledge.max_message_size,
    );
    let open = OpenSecureChannelRequest {
        request_header: header(),
        client_protocol_version: 0,
        request_type: SecurityTokenRequestType::Issue,
        security_mode: MessageSecurityMode::None,
        client_nonce: opcua::types::ByteString::null(),
        requested_lifetime: CHANNEL_LIFETIME,
    };
    let open = RequestMessage::from(open);
    let opened = match answer(&mut conversation, 1, &open).await? {
        ResponseMessage::OpenSecureChannel(opened) => opened,
        other => return Err(unexpected(&other)),
    };
    conversation
        .channel
        .set_security_token(opened.security_token);
    let answered = answer(&mut conversation, 2, &request).await?;
    // The answer is there; whether the peer hears of the end changes nothing.
    let close = CloseSecureChannelRequest {
        request_header: header(),
    };
    drop(conversation.send(3, &RequestMessage::from(close)).await);
    Ok(answered)
}

async fn answer(
    conversation: &mut Conversation<TcpStream>,
    request_id: u32,
    request: &RequestMessage,
) -> Result<ResponseMessage, AskFault> {
    conversation.send(request_id, request).await?;
    let received = conversation.receive::<ResponseMessage>(|_| Ok(())).await?;
    let status = received.message.response_header().service_result;
    match received.message {
        ResponseMessage::ServiceFault(_) => Err(AskFault::Refused(status)),
        _ if status.is_bad() => Err(AskFault::Refused(status)),
        message => Ok(message),
    }
}

fn header() -> RequestHeader {
    RequestHeader {
        timeout_hint: 5000,
        ..RequestHeader::new(&NodeId::null(), &DateTime::now(), 1)
    }
}

fn unexpected(answer: &ResponseMessage) -> AskFault {
    AskFault::Protocol(format!(
        "{} is no answer to what was asked",
        answer.type_name()
    ))
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

const REGISTER_LIMIT: Duration = Duration::from_secs(5);
/// In milliseconds: for one question.
const CHANNEL_LIFETIME: u32 = 60_000;
