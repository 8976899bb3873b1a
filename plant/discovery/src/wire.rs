//! OPC UA over TCP (OPC 10000-6, 6.7 and 7.1) without sessions: frames, and messages in chunks on a
//! SecureChannel.
//!
//! Both ends use this module: [`client`](crate::client) opens a conversation,
//! [`connection`](crate::connection) serves it. The size of received data is limited before it is
//! stored.

use std::io::{self, Cursor};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;

use bytes::{Bytes, BytesMut};
use opcua::core::Message;
use opcua::core::comms::chunker::Chunker;
use opcua::core::comms::message_chunk::{MESSAGE_CHUNK_HEADER_SIZE, MessageChunk};
use opcua::core::comms::secure_channel::{Role, SecureChannel};
use opcua::core::comms::security_header::AsymmetricSecurityHeader;
use opcua::core::comms::sequence_number::SequenceNumberHandle;
use opcua::core::comms::tcp_types::{ErrorMessage, MIN_CHUNK_SIZE};
use opcua::crypto::{CertificateStore, SecurityPolicy};
use opcua::sync::RwLock;
use opcua::types::{
    ContextOwned, DecodingOptions, DepthGauge, Error, MessageSecurityMode, NamespaceMap,
    SimpleBinaryDecodable, SimpleBinaryEncodable, StatusCode,
};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tracing::subscriber::NoSubscriber;

/// The reason for the end of a conversation.
#[derive(Debug, thiserror::Error)]
pub(crate) enum WireFault {
    /// The connection was lost.
    #[error("the connection failed: {0}")]
    Io(#[from] io::Error),
    /// The peer closed it.
    #[error("the connection was closed")]
    Closed,
    /// Received data violates the protocol or a limit.
    #[error("{what} ({status})")]
    Bad {
        /// The status code for the peer.
        status: StatusCode,
        what: &'static str,
    },
    /// The peer sent an Error message and closes.
    #[error("the peer reports {0}")]
    Told(StatusCode),
    /// A message cannot be decoded; the channel stays open.
    #[error("the message cannot be read: {status}")]
    Unreadable {
        status: StatusCode,
        request_id: u32,
        request_handle: u32,
    },
}

impl WireFault {
    const fn bad(status: StatusCode, what: &'static str) -> Self {
        Self::Bad { status, what }
    }

    fn of(error: &Error, what: &'static str) -> Self {
        Self::bad(error.status(), what)
    }

    /// Returns the status code for an Error message, if the peer is still connected.
    pub(crate) fn status(&self) -> Option<StatusCode> {
        match self {
            Self::Io(_) | Self::Closed | Self::Told(_) => None,
            Self::Bad { status, .. } | Self::Unreadable { status, .. } => Some(*status),
        }
    }
}

/// The MessageType: the first three letters of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FrameKind {
    Hello,
    Acknowledge,
    Error,
    Open,
    Close,
    Message,
}

/// A frame with its header.
#[derive(Debug)]
pub(crate) struct UaFrame {
    pub(crate) kind: FrameKind,
    /// The chunk type: `F`, `C` or `A`.
    last: u8,
    pub(crate) bytes: Bytes,
}

/// A message and its headers.
#[derive(Debug)]
pub(crate) struct ReceivedMessage<M> {
    pub(crate) message: M,
    pub(crate) request_id: u32,
    /// The security header of an OpenSecureChannel message.
    pub(crate) opening: Option<AsymmetricSecurityHeader>,
}

/// A connection with its channel.
pub(crate) struct Conversation<S> {
    stream: S,
    pub(crate) channel: SecureChannel,
    sent: SequenceNumberHandle,
    heard: SequenceNumberHandle,
    /// The largest chunk and message that the peer accepts.
    most: (usize, usize),
}

impl<S: AsyncRead + AsyncWrite + Unpin> Conversation<S> {
    pub(crate) fn new(stream: S, role: Role) -> Self {
        Self {
            stream,
            channel: channel(role),
            sent: SequenceNumberHandle::new(true),
            heard: SequenceNumberHandle::new(true),
            most: (MIN_CHUNK_SIZE, MOST_SENT),
        }
    }

    /// Sets the limits of the peer from its Hello or Acknowledge; 0 for no limit.
    pub(crate) fn limit(&mut self, chunk: u32, message: u32) {
        let size = |size: u32| usize::try_from(size).unwrap_or(usize::MAX);
        self.most.0 = size(chunk).clamp(MIN_CHUNK_SIZE, MOST_CHUNK);
        if message > 0 {
            self.most.1 = size(message).min(MOST_SENT);
        }
    }

    /// Receives the next frame.
    pub(crate) async fn frame(&mut self) -> Result<UaFrame, WireFault> {
        let mut header = [0; HEADER];
        match self.stream.read_exact(&mut header).await {
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
                return Err(WireFault::Closed);
            }
            read => read?,
        };
        let [a, b, c, last, size @ ..] = header;
        let kind = match &[a, b, c] {
            b"HEL" => FrameKind::Hello,
            b"ACK" => FrameKind::Acknowledge,
            b"ERR" => FrameKind::Error,
            b"OPN" => FrameKind::Open,
            b"CLO" => FrameKind::Close,
            b"MSG" => FrameKind::Message,
            _ => {
                return Err(WireFault::bad(
                    StatusCode::BadTcpMessageTypeInvalid,
                    "not a message type",
                ));
            }
        };
        let whole =
            matches!(last, b'F') || (kind == FrameKind::Message && matches!(last, b'C' | b'A'));
        if !whole {
            return Err(WireFault::bad(
                StatusCode::BadTcpMessageTypeInvalid,
                "not a chunk type",
            ));
        }
        let size = usize::try_from(u32::from_le_bytes(size)).unwrap_or(usize::MAX);
        if !(HEADER..=MOST_CHUNK).contains(&size) {
            return Err(WireFault::bad(
                StatusCode::BadTcpMessageTooLarge,
                "not a chunk size",
            ));
        }
        let mut bytes = BytesMut::zeroed(size);
        if let Some((start, rest)) = bytes.split_at_mut_checked(HEADER) {
            start.copy_from_slice(&header);
            self.stream.read_exact(rest).await?;
        }
        let bytes = bytes.freeze();
        Ok(UaFrame { kind, last, bytes })
    }

    /// Receives Hello or Acknowledge; an Error message becomes an error.
    pub(crate) async fn greeting<T: SimpleBinaryDecodable>(
        &mut self,
        kind: FrameKind,
    ) -> Result<T, WireFault> {
        let frame = self.frame().await?;
        if frame.kind == FrameKind::Error {
            return Err(told(&frame));
        }
        if frame.kind != kind {
            return Err(WireFault::bad(
                StatusCode::BadTcpMessageTypeInvalid,
                "expected another message of the handshake",
            ));
        }
        decode(&frame.bytes)
            .map_err(|error| WireFault::of(&error, "a malformed message of the handshake"))
    }

    /// Sends Hello, Acknowledge or Error.
    pub(crate) async fn greet(
        &mut self,
        greeting: &impl SimpleBinaryEncodable,
    ) -> Result<(), WireFault> {
        let mut bytes = Vec::with_capacity(greeting.byte_len());
        let encoded = SimpleBinaryEncodable::encode(greeting, &mut bytes);
        encoded
            .map_err(|error| WireFault::of(&error, "cannot encode a message of the handshake"))?;
        self.stream.write_all(&bytes).await?;
        Ok(())
    }

    /// Waits until the peer closes the connection or sends a byte. The byte is lost, because the
    /// caller closes the connection in either case. Cancel safe.
    pub(crate) async fn stirred(&mut self) {
        let mut byte = [0];
        // An error counts as an end too.
        let _ended = self.stream.read(&mut byte).await.is_err();
    }

    /// Sends an Error message, and closes the connection.
    pub(crate) async fn tell(&mut self, status: StatusCode, why: &str) {
        // The peer has probably disconnected.
        drop(self.greet(&ErrorMessage::new(status, why)).await);
        drop(self.stream.shutdown().await);
    }

    /// Receives the next message. `admit` decides on an OpenSecureChannel message before it is
    /// decrypted.
    pub(crate) async fn receive<M: Message>(
        &mut self,
        admit: impl Fn(&AsymmetricSecurityHeader) -> Result<(), StatusCode>,
    ) -> Result<ReceivedMessage<M>, WireFault> {
        let mut chunks: Vec<MessageChunk> = Vec::new();
        let mut size = 0;
        let mut opened = None;
        loop {
            let frame = self.frame().await?;
            match frame.kind {
                FrameKind::Error => return Err(told(&frame)),
                FrameKind::Hello | FrameKind::Acknowledge => {
                    return Err(WireFault::bad(
                        StatusCode::BadTcpMessageTypeInvalid,
                        "a second greeting",
                    ));
                }
                FrameKind::Open => {
                    let header = opening(&frame.bytes)?;
                    self.check_renewal(&header)?;
                    admit(&header)
                        .map_err(|status| WireFault::bad(status, "the channel is not admitted"))?;
                    opened = Some(header);
                    if !chunks.is_empty() {
                        return Err(WireFault::bad(
                            StatusCode::BadCommunicationError,
                            "a channel inside a message",
                        ));
                    }
                }
                FrameKind::Close | FrameKind::Message => self.check_channel(&frame.bytes)?,
            }
            let last = frame.last;
            let chunk = self.unsecured(frame.bytes)?;
            if last == b'A' {
                chunks.clear();
                size = 0;
                continue;
            }
            size += chunk.data.len();
            chunks.push(chunk);
            if chunks.len() > MOST_CHUNKS || size > MOST_HEARD {
                return Err(WireFault::bad(
                    StatusCode::BadTcpMessageTooLarge,
                    "the message is too large",
                ));
            }
            if last == b'F' {
                return self.decode(&chunks, opened);
            }
        }
    }

    /// Sends a message in as many chunks as necessary.
    pub(crate) async fn send<M: Message>(
        &mut self,
        request_id: u32,
        message: &M,
    ) -> Result<(), WireFault> {
        let (chunk_size, message_size) = self.most;
        let chunks = Chunker::encode(
            self.sent.clone(),
            request_id,
            message_size,
            chunk_size,
            &self.channel,
            message,
        );
        let chunks = chunks.map_err(|error| WireFault::of(&error, "cannot encode the message"))?;
        self.sent
            .increment(u32::try_from(chunks.len()).unwrap_or(u32::MAX));
        let mut secured = vec![0; chunk_size + MIN_CHUNK_SIZE];
        for chunk in &chunks {
            let size = self.channel.apply_security(chunk, &mut secured);
            let size =
                size.map_err(|status| WireFault::bad(status, "cannot secure the message"))?;
            self.stream
                .write_all(secured.get(..size).unwrap_or_default())
                .await?;
        }
        Ok(())
    }

    /// Checks that a renewal has the sender and the security policy of the open channel, so that
    /// its security cannot be removed.
    fn check_renewal(&self, header: &AsymmetricSecurityHeader) -> Result<(), WireFault> {
        let channel = &self.channel;
        if channel.secure_channel_id() == 0 || channel.is_client_role() {
            return Ok(());
        }
        let same_policy = policy(header) == Some(channel.security_policy());
        let same_sender = match channel.remote_cert() {
            Some(certificate) => certificate.as_byte_string() == header.sender_certificate,
            None => true,
        };
        if same_policy && same_sender {
            Ok(())
        } else {
            Err(WireFault::bad(
                StatusCode::BadSecurityChecksFailed,
                "the channel belongs to another connection",
            ))
        }
    }

    /// Checks that a chunk belongs to the open channel.
    fn check_channel(&self, frame: &[u8]) -> Result<(), WireFault> {
        let number = |at: usize| {
            let bytes = frame
                .get(at..at + 4)
                .and_then(|bytes| bytes.try_into().ok());
            bytes.map(u32::from_le_bytes)
        };
        let id = self.channel.secure_channel_id();
        if id == 0 || number(HEADER) != Some(id) {
            return Err(WireFault::bad(
                StatusCode::BadTcpSecureChannelUnknown,
                "not a channel of this connection",
            ));
        }
        // The previous token is valid until a message uses the new token (OPC 10000-4, 5.5.2).
        let token = self.channel.token_id();
        match number(MESSAGE_CHUNK_HEADER_SIZE) {
            Some(its) if its == token || its.checked_add(1) == Some(token) => Ok(()),
            _ => Err(WireFault::bad(
                StatusCode::BadSecureChannelTokenUnknown,
                "not a token of this channel",
            )),
        }
    }

    /// Verifies and decrypts a chunk.
    fn unsecured(&mut self, frame: Bytes) -> Result<MessageChunk, WireFault> {
        let channel = &mut self.channel;
        let signed = match channel.security_mode() {
            MessageSecurityMode::Sign | MessageSecurityMode::SignAndEncrypt => SIGNED,
            MessageSecurityMode::None | MessageSecurityMode::Invalid => 0,
        };
        if frame.len() < signed {
            return Err(WireFault::bad(
                StatusCode::BadSecurityChecksFailed,
                "a chunk without its signature",
            ));
        }
        // The library may panic on encrypted chunks of unusual length.
        let verified = catch_unwind(AssertUnwindSafe(|| {
            if channel.is_client_role() {
                channel.verify_and_remove_security(frame)
            } else {
                channel.verify_and_remove_security_server(frame)
            }
        }));
        let chunk = match verified {
            Ok(chunk) => {
                chunk.map_err(|error| WireFault::of(&error, "a chunk with a wrong signature"))?
            }
            Err(_panic) => {
                return Err(WireFault::bad(
                    StatusCode::BadSecurityChecksFailed,
                    "a malformed chunk",
                ));
            }
        };
        let info = chunk.chunk_info(&self.channel);
        let info = info.map_err(|error| WireFault::of(&error, "a chunk without its headers"))?;
        let number = info.sequence_header.sequence_number;
        let next = self.heard.validate_and_increment(number);
        next.map_err(|error| WireFault::of(&error, "a chunk out of sequence"))?;
        Ok(chunk)
    }

    fn decode<M: Message>(
        &self,
        chunks: &[MessageChunk],
        opening: Option<AsymmetricSecurityHeader>,
    ) -> Result<ReceivedMessage<M>, WireFault> {
        let checked = Chunker::validate_chunks(&self.channel, chunks);
        checked.map_err(|error| WireFault::of(&error, "chunks that do not belong together"))?;
        let first = chunks
            .first()
            .and_then(|chunk| chunk.chunk_info(&self.channel).ok());
        let request_id = first.map_or(0, |info| info.sequence_header.request_id);
        let message = Chunker::decode(chunks, &self.channel, None).map_err(|error| {
            let handle = error.with_request_id(request_id).full_context();
            WireFault::Unreadable {
                status: StatusCode::BadDecodingError,
                request_id,
                request_handle: handle.map_or(0, |(_, handle)| handle),
            }
        })?;
        Ok(ReceivedMessage {
            message,
            request_id,
            opening,
        })
    }
}

/// Creates a channel that is not open.
fn channel(role: Role) -> SecureChannel {
    // The library expects a certificate store here; a caller with a certificate sets it on the
    // channel.
    let store = Arc::new(RwLock::new(CertificateStore::new(Path::new("/dev/null"))));
    let context = ContextOwned::new_default(NamespaceMap::new(), options());
    // The library logs an error if the own certificate is missing.
    tracing::subscriber::with_default(NoSubscriber::default(), || {
        SecureChannel::new(store, role, Arc::new(RwLock::new(context)))
    })
}

/// Decodes the header with the security policy and the certificate of an OpenSecureChannel message.
fn opening(frame: &[u8]) -> Result<AsymmetricSecurityHeader, WireFault> {
    let rest = frame.get(MESSAGE_CHUNK_HEADER_SIZE..).unwrap_or_default();
    let header = AsymmetricSecurityHeader::decode(&mut Cursor::new(rest), &options());
    header.map_err(|error| WireFault::of(&error, "cannot open the channel"))
}

fn decode<T: SimpleBinaryDecodable>(bytes: &[u8]) -> Result<T, Error> {
    T::decode(&mut Cursor::new(bytes), &options())
}

fn told(frame: &UaFrame) -> WireFault {
    let message: Result<ErrorMessage, _> = decode(&frame.bytes);
    WireFault::Told(message.map_or(StatusCode::BadUnknownResponse, |message| message.error))
}

/// Returns the security policy of a header; `None` if it is not supported.
pub(crate) fn policy(header: &AsymmetricSecurityHeader) -> Option<SecurityPolicy> {
    let policy = SecurityPolicy::from_uri(header.security_policy_uri.as_ref());
    matches!(
        policy,
        SecurityPolicy::None | SecurityPolicy::Basic256Sha256
    )
    .then_some(policy)
}

fn options() -> DecodingOptions {
    DecodingOptions {
        max_message_size: MOST_HEARD,
        max_chunk_count: MOST_CHUNKS,
        max_string_length: 65_536,
        max_byte_string_length: 65_536,
        max_array_length: 10_000,
        decoding_depth_gauge: DepthGauge::new(8),
        ..DecodingOptions::default()
    }
}

const HEADER: usize = 8;
/// The size of the headers and the signature of a chunk.
const SIGNED: usize = 12 + 4 + 8 + 32;
/// The largest chunk that is received or sent.
pub(crate) const MOST_CHUNK: usize = 65_536;
pub(crate) const MOST_CHUNKS: usize = 64;
/// The largest message that is received.
pub(crate) const MOST_HEARD: usize = 2 << 20;
/// The largest message that is sent, enough for a list of a thousand servers.
const MOST_SENT: usize = 4 << 20;
