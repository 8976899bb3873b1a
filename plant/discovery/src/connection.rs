//! A client connection of the discovery server: Hello, OpenSecureChannel, requests,
//! CloseSecureChannel (OPC 10000-6, 6.7 and 7.1).

#![expect(
    clippy::wildcard_enum_match_arm,
    reason = "discovery uses some of the messages of all services"
)]

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use opcua::core::comms::secure_channel::Role;
use opcua::core::comms::security_header::AsymmetricSecurityHeader;
use opcua::core::comms::tcp_types::{AcknowledgeMessage, HelloMessage};
use opcua::core::{RequestMessage, ResponseMessage};
use opcua::crypto::SecurityPolicy;
use opcua::types::{
    ChannelSecurityToken, DateTime, MessageSecurityMode, OpenSecureChannelRequest,
    OpenSecureChannelResponse, ResponseHeader, SecurityTokenRequestType, ServiceFault, StatusCode,
};
use registry::Channel;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;
use tracing::debug;

use crate::security::{ChannelSecurity, application_uri};
use crate::services::{self, OwnDescription, RegistryAnswer, RegistryQuery};
use crate::uses::{ConnectionUse, UseOrder};
use crate::wire::{
    Conversation, FrameKind, MOST_CHUNK, MOST_CHUNKS, MOST_HEARD, ReceivedMessage, WireFault,
    policy,
};

/// A request to the owner of the registry, its channel, and the sender for the response.
pub(crate) type RegistryRequest = (RegistryQuery, Channel, oneshot::Sender<RegistryAnswer>);

/// The state that all connections share.
#[derive(Debug)]
pub(crate) struct ServerShared {
    pub(crate) own: OwnDescription,
    /// The certificate and key of the server; `None` without secured channels.
    pub(crate) security: Option<ChannelSecurity>,
    pub(crate) ask: mpsc::Sender<RegistryRequest>,
    pub(crate) counters: RequestCounters,
    /// Whether clients on this host may register over an unsecured channel.
    host_may: bool,
    last_channel: AtomicU32,
    pub(crate) uses: UseOrder,
}

/// Counters of requests and faults.
#[derive(Debug, Default)]
pub(crate) struct RequestCounters {
    pub(crate) connections: AtomicU64,
    pub(crate) refused_connections: AtomicU64,
    pub(crate) refused_certificates: AtomicU64,
    pub(crate) questions: AtomicU64,
    pub(crate) unsupported: AtomicU64,
    pub(crate) malformed: AtomicU64,
    pub(crate) timed_out: AtomicU64,
}

pub(crate) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

impl ServerShared {
    pub(crate) fn new(
        own: OwnDescription,
        security: Option<ChannelSecurity>,
        ask: mpsc::Sender<RegistryRequest>,
    ) -> Self {
        Self {
            own,
            security,
            ask,
            counters: RequestCounters::default(),
            host_may: true,
            last_channel: AtomicU32::new(0),
            uses: UseOrder::default(),
        }
    }

    /// Restricts registrations to secured channels.
    pub(crate) fn secured_only(self, secured_only: bool) -> Self {
        Self {
            host_may: !secured_only,
            ..self
        }
    }

    /// Returns the next SecureChannelId, which is never 0.
    fn next_channel(&self) -> u32 {
        self.last_channel.fetch_add(1, Ordering::Relaxed) % (u32::MAX - 1) + 1
    }

    async fn answer(&self, question: RegistryQuery, channel: Channel) -> RegistryAnswer {
        let (reply, answer) = oneshot::channel();
        let asked = self.ask.send((question, channel, reply)).await;
        let answer = answer.await;
        match (asked, answer) {
            (Ok(()), Ok(answer)) => answer,
            _ => RegistryAnswer::Refused(StatusCode::BadShutdown.bits()),
        }
    }
}

/// Serves a client until it disconnects, times out, or violates the protocol.
pub(crate) async fn serve<S>(
    stream: S,
    (peer, used): (SocketAddr, ConnectionUse),
    shared: &ServerShared,
) where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut conversation = Conversation::new(stream, Role::Server);
    if let Some(security) = &shared.security {
        let channel = &mut conversation.channel;
        channel.set_cert(Some(security.certificate.clone()));
        channel.set_private_key(Some(security.key.clone()));
    }
    let mut connection = Connection {
        conversation,
        peer,
        used,
        shared,
        lifetime: FIRST_IDLE,
        url: shared.own.url.clone(),
    };
    match connection.run().await {
        Ok(()) | Err(WireFault::Closed) => {}
        Err(fault) => {
            if let Some(status) = fault.status() {
                let late = status == StatusCode::BadTimeout;
                let counters = &shared.counters;
                count(if late {
                    &counters.timed_out
                } else {
                    &counters.malformed
                });
                let why = fault.to_string();
                let told = connection.conversation.tell(status, &why);
                drop(timeout(WRITE_LIMIT, told).await);
            }
            debug!(%peer, "a connection ended: {fault}");
        }
    }
}

struct Connection<'a, S> {
    conversation: Conversation<S>,
    peer: SocketAddr,
    used: ConnectionUse,
    shared: &'a ServerShared,
    /// The timeout without a message.
    lifetime: Duration,
    url: String,
}

impl<S: AsyncRead + AsyncWrite + Unpin> Connection<'_, S> {
    async fn run(&mut self) -> Result<(), WireFault> {
        let hello = self.conversation.greeting::<HelloMessage>(FrameKind::Hello);
        let hello = timeout(HELLO_LIMIT, hello).await.map_err(|_| LATE)??;
        self.acknowledge(&hello).await?;
        loop {
            let shared = self.shared;
            let request = self
                .conversation
                .receive::<RequestMessage>(|header| admit(header, shared));
            let Ok(received) = timeout(self.lifetime, request).await else {
                return Err(LATE);
            };
            self.shared.uses.note(&self.used);
            let (response, request_id) = match received {
                Ok(ReceivedMessage {
                    message: RequestMessage::CloseSecureChannel(_),
                    ..
                }) => return Ok(()),
                Ok(ReceivedMessage {
                    message,
                    request_id,
                    opening,
                }) => (self.answer(message, opening).await?, request_id),
                Err(WireFault::Unreadable {
                    status,
                    request_id,
                    request_handle,
                }) if self.conversation.channel.secure_channel_id() != 0 => {
                    count(&self.shared.counters.malformed);
                    (ServiceFault::new(request_handle, status).into(), request_id)
                }
                Err(fault) => return Err(fault),
            };
            let sent = timeout(WRITE_LIMIT, self.conversation.send(request_id, &response)).await;
            match sent.map_err(|_| LATE)? {
                Err(WireFault::Bad { status, .. }) if status == StatusCode::BadResponseTooLarge => {
                    let handle = response.response_header().request_handle;
                    let fault = ResponseMessage::from(ServiceFault::new(handle, status));
                    self.conversation.send(request_id, &fault).await?;
                }
                sent => sent?,
            }
        }
    }

    async fn acknowledge(&mut self, hello: &HelloMessage) -> Result<(), WireFault> {
        if !hello.is_valid_buffer_sizes() {
            return Err(WireFault::Bad {
                status: StatusCode::BadConnectionRejected,
                what: "a chunk has room for 8192 bytes at least",
            });
        }
        if !hello.is_endpoint_valid_length() {
            return Err(WireFault::Bad {
                status: StatusCode::BadTcpEndpointUrlInvalid,
                what: "the endpoint's URL is too long",
            });
        }
        let number = |size: usize| u32::try_from(size).unwrap_or(u32::MAX);
        let chunk = number(MOST_CHUNK);
        let acknowledge = AcknowledgeMessage::new(
            0,
            chunk.min(hello.send_buffer_size),
            chunk.min(hello.receive_buffer_size),
            number(MOST_HEARD),
            number(MOST_CHUNKS),
        );
        self.conversation
            .limit(hello.receive_buffer_size, hello.max_message_size);
        self.conversation.greet(&acknowledge).await
    }

    async fn answer(
        &mut self,
        request: RequestMessage,
        opening: Option<AsymmetricSecurityHeader>,
    ) -> Result<ResponseMessage, WireFault> {
        match &request {
            RequestMessage::OpenSecureChannel(open) => {
                return self.open(
                    open,
                    &opening.unwrap_or_else(AsymmetricSecurityHeader::none),
                );
            }
            // The first message must open the channel.
            _ if self.conversation.channel.secure_channel_id() == 0 => {
                return Err(WireFault::Bad {
                    status: StatusCode::BadTcpSecureChannelUnknown,
                    what: "no channel is open",
                });
            }
            RequestMessage::GetEndpoints(request) => {
                count(&self.shared.counters.questions);
                return Ok(self.own().endpoints(request));
            }
            _ => {}
        }
        let Some(question) = services::question(&request) else {
            count(&self.shared.counters.unsupported);
            debug!(peer = %self.peer, service = request.type_name(), "a service that is not one of discovery");
            return Ok(services::fault(&request, StatusCode::BadServiceUnsupported));
        };
        count(&self.shared.counters.questions);
        if let Err(status) = self.stays(&question) {
            count(&self.shared.counters.refused_certificates);
            return Ok(services::fault(&request, status));
        }
        let channel = self.channel(&question);
        let answer = self.shared.answer(question, channel).await;
        Ok(services::response(&request, answer, &self.own()))
    }

    /// Checks that the certificate of a registering client is still trusted: it may have been
    /// revoked after the channel was opened.
    fn stays(&self, question: &RegistryQuery) -> Result<(), StatusCode> {
        let channel = &self.conversation.channel;
        let is_secured = channel.security_mode() != MessageSecurityMode::None;
        let certificate = channel.remote_cert().filter(|_| is_secured);
        match (certificate, question, &self.shared.security) {
            (Some(certificate), RegistryQuery::Register { .. }, Some(security)) => {
                security.admit(certificate.as_byte_string().as_ref())
            }
            _ => Ok(()),
        }
    }

    /// Returns the properties of the channel of a request.
    fn channel(&self, question: &RegistryQuery) -> Channel {
        let channel = &self.conversation.channel;
        let is_secured = channel.security_mode() != MessageSecurityMode::None;
        let certificate = channel.remote_cert().filter(|_| is_secured);
        let certificate_uri = match (certificate, question) {
            (Some(certificate), RegistryQuery::Register { .. }) => {
                let uri = application_uri(certificate.as_byte_string().as_ref());
                // A certificate without ApplicationUri matches no server.
                Some(uri.unwrap_or_default())
            }
            _ => None,
        };
        // A client on this host has the same power without a forged identity.
        let of_host = self.shared.host_may && self.peer.ip().to_canonical().is_loopback();
        Channel {
            is_secured: is_secured || of_host,
            certificate_uri,
            peer: Some(self.peer.ip().to_canonical()),
        }
    }

    fn own(&self) -> OwnDescription {
        OwnDescription {
            url: self.url.clone(),
            ..self.shared.own.clone()
        }
    }

    /// Issues or renews the security token of the channel (OPC 10000-4, 5.5.2).
    fn open(
        &mut self,
        request: &OpenSecureChannelRequest,
        header: &AsymmetricSecurityHeader,
    ) -> Result<ResponseMessage, WireFault> {
        let channel = &mut self.conversation.channel;
        let bad = |status, what| WireFault::Bad { status, what };
        let id = channel.secure_channel_id();
        let id = match request.request_type {
            SecurityTokenRequestType::Issue if id == 0 => self.shared.next_channel(),
            SecurityTokenRequestType::Renew if id != 0 => id,
            SecurityTokenRequestType::Issue | SecurityTokenRequestType::Renew => {
                return Err(WireFault::Bad {
                    status: StatusCode::BadTcpSecureChannelUnknown,
                    what: "a channel is issued once, and renewed after that",
                });
            }
        };
        let is_secured = channel.security_policy() != SecurityPolicy::None;
        let fits = match request.security_mode {
            MessageSecurityMode::None => !is_secured,
            MessageSecurityMode::Sign | MessageSecurityMode::SignAndEncrypt => is_secured,
            MessageSecurityMode::Invalid => false,
        };
        if !fits {
            return Err(bad(
                StatusCode::BadSecurityModeRejected,
                "the mode does not fit the policy",
            ));
        }
        if is_secured {
            let nonce = &request.client_nonce;
            if nonce.as_ref() == channel.remote_nonce() {
                return Err(bad(
                    StatusCode::BadNonceInvalid,
                    "the nonce was used before",
                ));
            }
            let taken = channel
                .set_remote_cert_from_byte_string(&header.sender_certificate)
                .and_then(|()| channel.validate_secure_channel_nonce_length(nonce))
                .and_then(|()| channel.set_remote_nonce_from_byte_string(nonce));
            taken.map_err(|error| bad(error.status(), "no nonce or certificate"))?;
        }
        let asked = Duration::from_millis(request.requested_lifetime.into());
        let lifetime = if asked.is_zero() {
            MOST_LIFETIME
        } else {
            asked.clamp(LEAST_LIFETIME, MOST_LIFETIME)
        };
        let revised_lifetime = u32::try_from(lifetime.as_millis()).unwrap_or(u32::MAX);
        let token = ChannelSecurityToken {
            channel_id: id,
            token_id: channel.token_id().wrapping_add(1),
            created_at: DateTime::now(),
            revised_lifetime,
        };
        channel.set_security_mode(request.security_mode);
        channel.set_security_token(token.clone());
        if is_secured {
            channel.create_random_nonce();
            channel.derive_keys();
        }
        // The standard adds 25 % for messages in transit.
        self.lifetime = lifetime + lifetime / 4;
        let response = OpenSecureChannelResponse {
            response_header: ResponseHeader::new_good(&request.request_header),
            server_protocol_version: 0,
            security_token: token,
            server_nonce: channel.local_nonce_as_byte_string(),
        };
        Ok(response.into())
    }
}

/// Checks the security policy and the certificate of a client. Without an own certificate only
/// policy None is admitted.
fn admit(header: &AsymmetricSecurityHeader, shared: &ServerShared) -> Result<(), StatusCode> {
    match (policy(header), &shared.security) {
        (Some(SecurityPolicy::None), _) => Ok(()),
        (Some(_), Some(security)) => {
            let admitted = security.admit(header.sender_certificate.as_ref());
            admitted.inspect_err(|_| count(&shared.counters.refused_certificates))
        }
        _ => Err(StatusCode::BadSecurityPolicyRejected),
    }
}

const LATE: WireFault = WireFault::Bad {
    status: StatusCode::BadTimeout,
    what: "nothing was received in time",
};
const HELLO_LIMIT: Duration = Duration::from_secs(5);
/// Timeout until a channel is open.
const FIRST_IDLE: Duration = Duration::from_secs(5);
const WRITE_LIMIT: Duration = Duration::from_secs(10);
const LEAST_LIFETIME: Duration = Duration::from_secs(5);
const MOST_LIFETIME: Duration = Duration::from_secs(300);

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use opcua::core::comms::tcp_types::ErrorMessage;
    use opcua::types::{
        ByteString, FindServersRequest, NodeId, ReadRequest, RequestHeader, SimpleBinaryEncodable,
    };
    use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};

    use super::*;

    const PEER: SocketAddr =
        SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 9);

    /// Creates a discovery server without registrations.
    fn shared() -> Arc<ServerShared> {
        let (ask, mut questions) = mpsc::channel::<RegistryRequest>(4);
        tokio::spawn(async move {
            while let Some((_, _, reply)) = questions.recv().await {
                drop(reply.send(RegistryAnswer::Servers(Vec::new())));
            }
        });
        let own = OwnDescription {
            application_uri: "urn:lds".to_owned(),
            name: "lds".to_owned(),
            url: "opc.tcp://h:4840".to_owned(),
            application_type: opcua::types::ApplicationType::DiscoveryServer,
            certificate: ByteString::null(),
        };
        Arc::new(ServerShared::new(own, None, ask))
    }

    fn connect(shared: &Arc<ServerShared>) -> DuplexStream {
        let (here, there) = duplex(1 << 20);
        let shared = Arc::clone(shared);
        tokio::spawn(async move {
            let used = shared.uses.begin();
            serve(there, (PEER, used), &shared).await;
        });
        here
    }

    fn header() -> RequestHeader {
        RequestHeader::new(&NodeId::null(), &DateTime::now(), 7)
    }

    /// Creates a client with an open channel.
    async fn opened(shared: &Arc<ServerShared>) -> Conversation<DuplexStream> {
        let mut client = Conversation::new(connect(shared), Role::Client);
        client
            .greet(&HelloMessage::new("opc.tcp://h:4840", 65_536, 65_536, 0, 0))
            .await
            .unwrap();
        client
            .greeting::<AcknowledgeMessage>(FrameKind::Acknowledge)
            .await
            .unwrap();
        open(&mut client, SecurityTokenRequestType::Issue).await;
        client
    }

    async fn open(client: &mut Conversation<DuplexStream>, request_type: SecurityTokenRequestType) {
        let request = OpenSecureChannelRequest {
            request_header: header(),
            client_protocol_version: 0,
            request_type,
            security_mode: MessageSecurityMode::None,
            client_nonce: ByteString::null(),
            requested_lifetime: 1000,
        };
        match ask(client, request).await {
            ResponseMessage::OpenSecureChannel(opened) => {
                client.channel.set_security_token(opened.security_token)
            }
            other => panic!("{other:?}"),
        }
    }

    async fn ask(
        client: &mut Conversation<DuplexStream>,
        request: impl Into<RequestMessage>,
    ) -> ResponseMessage {
        client.send(5, &request.into()).await.unwrap();
        let received = client.receive::<ResponseMessage>(|_| Ok(())).await.unwrap();
        assert_eq!(received.request_id, 5);
        received.message
    }

    fn find() -> FindServersRequest {
        FindServersRequest {
            request_header: header(),
            ..FindServersRequest::default()
        }
    }

    #[tokio::test]
    async fn a_channel_is_issued_used_renewed_and_used() {
        let shared = shared();
        let mut client = opened(&shared).await;
        for _ in 0..2 {
            let before = client.channel.token_id();
            match ask(&mut client, find()).await {
                ResponseMessage::FindServers(found) => {
                    assert_eq!(found.servers.unwrap().len(), 1, "itself")
                }
                other => panic!("{other:?}"),
            }
            open(&mut client, SecurityTokenRequestType::Renew).await;
            assert_eq!(client.channel.token_id(), before + 1);
        }
    }

    #[tokio::test]
    async fn what_is_no_service_of_discovery_is_unsupported_and_the_channel_stays() {
        let shared = shared();
        let mut client = opened(&shared).await;
        let read = ReadRequest {
            request_header: header(),
            ..ReadRequest::default()
        };
        let answer = ask(&mut client, read).await;
        assert_eq!(
            answer.response_header().service_result,
            StatusCode::BadServiceUnsupported
        );
        assert_eq!(answer.response_header().request_handle, 7);
        assert!(matches!(
            ask(&mut client, find()).await,
            ResponseMessage::FindServers(_)
        ));
    }

    /// Returns the status of the last Error message to a client that sends these bytes.
    async fn told(shared: &Arc<ServerShared>, bytes: &[u8]) -> Option<StatusCode> {
        let mut client = connect(shared);
        client.write_all(bytes).await.unwrap();
        client.shutdown().await.unwrap();
        let mut answer = Vec::new();
        client.read_to_end(&mut answer).await.unwrap();
        let at = answer.windows(4).rposition(|four| four == b"ERRF")?;
        let mut error = answer.get(at..)?;
        use opcua::types::{DecodingOptions, SimpleBinaryDecodable};
        Some(
            ErrorMessage::decode(&mut error, &DecodingOptions::default())
                .unwrap()
                .error,
        )
    }

    fn hello() -> Vec<u8> {
        let mut bytes = Vec::new();
        let hello = HelloMessage::new("opc.tcp://h:4840", 65_536, 65_536, 0, 0);
        hello.encode(&mut bytes).unwrap();
        bytes
    }

    #[tokio::test]
    async fn what_is_none_of_the_protocol_is_told_what_is_wrong_with_it() {
        let shared = shared();
        let after = |bytes: &[u8]| [hello(), bytes.to_vec()].concat();
        for (what, bytes, status) in [
            (
                "HTTP",
                b"GET / HTTP/1.1\r\n\r\n".to_vec(),
                StatusCode::BadTcpMessageTypeInvalid,
            ),
            (
                "4 GB",
                b"HELF\xff\xff\xff\xff".to_vec(),
                StatusCode::BadTcpMessageTooLarge,
            ),
            (
                "no size",
                b"HELF\0\0\0\0".to_vec(),
                StatusCode::BadTcpMessageTooLarge,
            ),
            (
                "a message before a channel",
                after(b"MSGF\x18\0\0\0\x01\0\0\0\x01\0\0\0\x01\0\0\0\x01\0\0\0"),
                StatusCode::BadTcpSecureChannelUnknown,
            ),
            (
                "a greeting twice",
                after(&hello()),
                StatusCode::BadTcpMessageTypeInvalid,
            ),
        ] {
            assert_eq!(told(&shared, &bytes).await, Some(status), "{what}");
        }
    }

    #[tokio::test]
    async fn no_cut_and_no_flipped_bit_ends_more_than_its_connection() {
        let shared = shared();
        // The bytes of a client that opens a channel and sends a request.
        let (here, mut there) = duplex(1 << 20);
        let mut client = Conversation::new(here, Role::Client);
        let request = OpenSecureChannelRequest {
            request_header: header(),
            requested_lifetime: 1000,
            security_mode: MessageSecurityMode::None,
            ..OpenSecureChannelRequest::default()
        };
        client
            .send(1, &RequestMessage::from(request))
            .await
            .unwrap();
        client.channel.set_security_token(ChannelSecurityToken {
            channel_id: 1,
            token_id: 1,
            ..ChannelSecurityToken::default()
        });
        client.send(2, &RequestMessage::from(find())).await.unwrap();
        drop(client);
        let mut said = hello();
        there.read_to_end(&mut said).await.unwrap();
        for at in 0..said.len() {
            let mut flipped = said.clone();
            for bit in [0x01, 0x80, 0xff] {
                flipped[at] = said[at] ^ bit;
                let _status = told(&shared, &flipped).await;
            }
            let _status = told(&shared, &said[..at]).await;
        }
        let mut reader = opened(&shared).await;
        assert!(matches!(
            ask(&mut reader, find()).await,
            ResponseMessage::FindServers(_)
        ));
    }
}
