//! A connection to a server that is kept open and asked on again and again: it breaks off in the moment in which the server
//! ends, and a question on it costs two packets.
//!
//! Nothing is secured: what is asked is whether somebody answers, and no answer is believed in more than that.

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

use crate::wire::{Conversation, Kind, MOST_CHUNK, MOST_CHUNKS, MOST_HEARD, WireFault};
use mdns::Url;

/// An open channel.
pub(crate) struct Line {
    conversation: Conversation<TcpStream>,
    url: String,
    last_request: u32,
    /// Its token runs out some time after.
    good_until: Instant,
}

/// How far a connection came.
pub(crate) enum Reached {
    /// To a channel.
    Line(Box<Line>),
    /// The server is there, and gives us no channel.
    Answers,
    /// The host takes the connection; the program says nothing.
    Accepts,
    /// The host says that nobody listens there.
    Refused,
    /// Nothing came back.
    Nobody,
    /// It could not be tried.
    Untried,
}

impl Line {
    /// Connects, and opens a channel where `hold` says so.
    pub(crate) async fn reach(url: &str, place: &Url, hold: bool, limit: Duration) -> Reached {
        let until = Instant::now() + limit;
        let stream = match connect(place, until).await {
            Ok(stream) => stream,
            Err(reached) => return reached,
        };
        let mut conversation = Conversation::new(stream, Role::Client);
        match timeout_at(until, greet(&mut conversation, url)).await {
            Ok(Ok(())) => {}
            // It says something, or has no room and closes: it is there.
            Ok(Err(WireFault::Told(_) | WireFault::Closed | WireFault::Io(_))) => {
                return Reached::Answers;
            }
            // Whoever says something else is no server of OPC UA.
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

    /// Asks for something that there is not, which makes the answer short. The line, where it was answered. Whoever drops
    /// it before has no line any more.
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
            // Whatever it says.
            Ok(_) | Err(WireFault::Unreadable { .. }) => Some(self),
            Err(_) => None,
        }
    }

    /// Whether the channel still counts.
    pub(crate) fn is_good(&self) -> bool {
        Instant::now() < self.good_until
    }

    /// Waits until it breaks off; nothing is said on it unasked. Whoever drops it before loses nothing.
    pub(crate) async fn broken(&mut self) {
        self.conversation.stirred().await;
    }
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "there are many ways to fail, and few say something of the server"
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
            // Reset is what a server does that has no room: it is there.
            ErrorKind::ConnectionReset => Reached::Answers,
            // Our own want of descriptors, say, is nothing that the server did.
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
    let acknowledge: AcknowledgeMessage = conversation.greeting(Kind::Acknowledge).await?;
    conversation.limit(
        acknowledge.receive_buffer_size,
        acknowledge.max_message_size,
    );
    Ok(())
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "of the messages of all services one opens a channel"
)]
async fn open(mut conversation: Conversation<TcpStream>, url: &str) -> Option<Line> {
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
    Some(Line {
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

/// No server is called so.
const NOBODY: &str = "urn:ua-bridge:nobody";
/// In milliseconds. Where it has run out another channel is opened.
const LIFETIME: u32 = 3_600_000;
const OPEN_LIMIT: Duration = Duration::from_secs(1);
