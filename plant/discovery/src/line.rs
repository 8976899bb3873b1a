//! A persistent connection to a server, which is probed repeatedly. It closes at the moment the
//! server ends, and a probe needs two packets.
//!
//! The connection is not secured: a probe only checks whether the server answers.

use std::io::ErrorKind;
use std::time::Duration;

use opcua::core::RequestMessage;
use opcua::core::ResponseMessage;
use opcua::core::comms::secure_channel::Role;
use opcua::core::comms::tcp_types::{AcknowledgeMessage, HelloMessage};
use opcua::types::{
    DateTime, FindServersRequest, MessageSecurityMode, NodeId, OpenSecureChannelRequest,
    RequestHeader, SecurityTokenRequestType,
};
use tokio::net::{TcpStream, lookup_host};
use tokio::time::{Instant, timeout, timeout_at};

use crate::wire::{Conversation, FrameKind, MOST_CHUNK, MOST_CHUNKS, MOST_HEARD, WireFault};
use mdns::Url;

/// A connection with an open channel.
pub(crate) struct OpenChannel {
    conversation: Conversation<TcpStream>,
    url: String,
    last_request: u32,
    /// The time until which the security token is used, some time before its expiry.
    good_until: Instant,
}

/// The progress of a connection attempt.
pub(crate) enum Reached {
    /// A channel is open.
    Line(Box<OpenChannel>),
    /// The server answers, but opens no channel.
    Answers,
    /// The host accepts the connection, but the program does not answer.
    Accepts,
    /// The host refuses the connection.
    Refused,
    /// No answer.
    Nobody,
    /// The connection cannot be attempted.
    Untried,
}

impl OpenChannel {
    /// Connects, and opens a channel if `hold` is set.
    pub(crate) async fn reach(url: &str, place: &Url, hold: bool, limit: Duration) -> Reached {
        let until = Instant::now() + limit;
        let stream = match connect(place, until).await {
            Ok(stream) => stream,
            Err(reached) => return reached,
        };
        let mut conversation = Conversation::new(stream, Role::Client);
        match timeout_at(until, greet(&mut conversation, url)).await {
            Ok(Ok(())) => {}
            // The server sends an Error message, or closes the connection because it is full: it is
            // running.
            Ok(Err(WireFault::Told(_) | WireFault::Closed | WireFault::Io(_))) => {
                return Reached::Answers;
            }
            // Any other answer does not come from an OPC UA server.
            Ok(Err(WireFault::Bad { .. } | WireFault::Unreadable { .. })) | Err(_) => {
                return Reached::Accepts;
            }
        }
        if !hold {
            return Reached::Answers;
        }
        match timeout(OPEN_LIMIT, open(conversation, url)).await {
            Ok(Some(line)) => Reached::Line(Box::new(line)),
            Ok(None) | Err(_) => Reached::Answers,
        }
    }

    /// Probes the server with a query without results, which keeps the response short. Returns the
    /// line if the server answered. Cancelling the future closes the line.
    pub(crate) async fn ask(mut self) -> Option<Self> {
        self.last_request = self.last_request.wrapping_add(1).max(2);
        let request = FindServersRequest {
            request_header: header(self.last_request),
            endpoint_url: self.url.as_str().into(),
            server_uris: Some(vec![NOBODY.into()]),
            ..FindServersRequest::default()
        };
        let request = RequestMessage::from(request);
        let conversation = &mut self.conversation;
        conversation.send(self.last_request, &request).await.ok()?;
        match conversation.receive::<ResponseMessage>(|_| Ok(())).await {
            // Any response counts.
            Ok(_) | Err(WireFault::Unreadable { .. }) => Some(self),
            Err(_) => None,
        }
    }

    /// Returns whether the channel is still valid.
    pub(crate) fn is_good(&self) -> bool {
        Instant::now() < self.good_until
    }

    /// Waits until the connection closes; the server sends nothing unrequested. Cancel safe.
    pub(crate) async fn broken(&mut self) {
        self.conversation.stirred().await;
    }
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "few of the many errors concern the server"
)]
async fn connect(place: &Url, until: Instant) -> Result<TcpStream, Reached> {
    let looked_up = timeout_at(until, lookup_host((place.host.as_str(), place.port))).await;
    let address = looked_up.ok().and_then(Result::ok);
    let Some(address) = address.and_then(|mut all| all.next()) else {
        return Err(Reached::Untried);
    };
    match timeout_at(until, TcpStream::connect(address)).await {
        Ok(Ok(stream)) => match stream.set_nodelay(true) {
            Ok(()) => Ok(stream),
            Err(_gone) => Err(Reached::Answers),
        },
        Ok(Err(error)) => Err(match error.kind() {
            ErrorKind::ConnectionRefused => Reached::Refused,
            // A server that has reached its limit of connections resets them: it is running.
            ErrorKind::ConnectionReset => Reached::Answers,
            // Any other error, such as a lack of file descriptors, is not caused by the server.
            ErrorKind::HostUnreachable | ErrorKind::NetworkUnreachable | ErrorKind::TimedOut => {
                Reached::Nobody
            }
            _ => Reached::Untried,
        }),
        Err(_late) => Err(Reached::Nobody),
    }
}

async fn greet(conversation: &mut Conversation<TcpStream>, url: &str) -> Result<(), WireFault> {
    let (chunk, message, chunks) = (MOST_CHUNK, MOST_HEARD, MOST_CHUNKS);
    let hello = HelloMessage::new(url, chunk, chunk, message, chunks);
    conversation.greet(&hello).await?;
    let acknowledge: AcknowledgeMessage = conversation.greeting(FrameKind::Acknowledge).await?;
    conversation.limit(
        acknowledge.receive_buffer_size,
        acknowledge.max_message_size,
    );
    Ok(())
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "one message of all services opens a channel"
)]
async fn open(mut conversation: Conversation<TcpStream>, url: &str) -> Option<OpenChannel> {
    let request = OpenSecureChannelRequest {
        request_header: header(1),
        request_type: SecurityTokenRequestType::Issue,
        security_mode: MessageSecurityMode::None,
        requested_lifetime: LIFETIME,
        ..OpenSecureChannelRequest::default()
    };
    conversation
        .send(1, &RequestMessage::from(request))
        .await
        .ok()?;
    let received = conversation
        .receive::<ResponseMessage>(|_| Ok(()))
        .await
        .ok()?;
    let token = match received.message {
        ResponseMessage::OpenSecureChannel(opened) => opened.security_token,
        _ => return None,
    };
    let lifetime = Duration::from_millis(token.revised_lifetime.into());
    conversation.channel.set_security_token(token);
    Some(OpenChannel {
        conversation,
        url: url.to_owned(),
        last_request: 1,
        good_until: Instant::now() + lifetime * 3 / 4,
    })
}

fn header(handle: u32) -> RequestHeader {
    RequestHeader {
        timeout_hint: 1000,
        ..RequestHeader::new(&NodeId::null(), &DateTime::now(), handle)
    }
}

/// The URI that no server has.
const NOBODY: &str = "urn:ua-bridge:nobody";
/// Channel lifetime in milliseconds. After its end another channel is opened.
const LIFETIME: u32 = 3_600_000;
const OPEN_LIMIT: Duration = Duration::from_secs(1);
