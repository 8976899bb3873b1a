//! OPC UA over TCP (OPC 10000-6, 6.7 and 7.1) without sessions: frames, and messages in chunks on a SecureChannel.
//!
//! Both ends: [`client`](crate::client) opens a conversation, [`connection`](crate::connection) answers in one. What the
//! peer sends is bounded before it is kept.

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

/// Why a conversation ends.
#[derive(Debug, thiserror::Error)]
pub(crate) enum WireFault {
    /// The connection broke off.
    #[error("the connection broke off: {0}")]
    Io(#[from] io::Error),
    /// The peer closed it.
    #[error("the connection was closed")]
    Closed,
    /// What came is none of the protocol, or too much.
    #[error("{what} ({status})")]
    Bad {
        /// What to tell the peer.
        status: StatusCode,
        what: &'static str,
    },
    /// The peer told of an error and closes.
    #[error("the peer says {0}")]
    Told(StatusCode),
    /// What came was a message that cannot be read; the channel stays as it is.
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

    /// To tell the peer in an ERR message, where there is a peer to tell.
    pub(crate) fn status(&self) -> Option<StatusCode> {
        match self {
            Self::Io(_) | Self::Closed | Self::Told(_) => None,
            Self::Bad { status, .. } | Self::Unreadable { status, .. } => Some(*status),
        }
    }
}

/// The first three letters of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Hello,
    Acknowledge,
    Error,
    Open,
    Close,
    Message,
}

/// A frame with its header.
#[derive(Debug)]
pub(crate) struct Frame {
    pub(crate) kind: Kind,
    /// `F`, `C` or `A`.
    last: u8,
    pub(crate) bytes: Bytes,
}

/// A message and what came with it.
#[derive(Debug)]
pub(crate) struct Received<M> {
    pub(crate) message: M,
    pub(crate) request_id: u32,
    /// Of a message that opens the channel, or renews it.
    pub(crate) opening: Option<AsymmetricSecurityHeader>,
}

/// One connection.
pub(crate) struct Conversation<S> {
    stream: S,
    pub(crate) channel: SecureChannel,
    sent: SequenceNumberHandle,
    heard: SequenceNumberHandle,
    /// The largest chunk and message the peer takes.
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

    /// What the peer takes, of its HEL or ACK; 0 for any.
    pub(crate) fn limit(&mut self, chunk: u32, message: u32) {
        let size = |size: u32| usize::try_from(size).unwrap_or(usize::MAX);
        self.most.0 = size(chunk).clamp(MIN_CHUNK_SIZE, MOST_CHUNK);
        if message > 0 {
            self.most.1 = size(message).min(MOST_SENT);
        }
    }

    /// The next frame.
    pub(crate) async fn frame(&mut self) -> Result<Frame, WireFault> {
        let mut header = [0; HEADER];
        match self.stream.read_exact(&mut header).await {
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
                return Err(WireFault::Closed);
            }
            read => read?,
        };
        let [a, b, c, last, size @ ..] = header;
        let kind = match &[a, b, c] {
            b"HEL" => Kind::Hello,
            b"ACK" => Kind::Acknowledge,
            b"ERR" => Kind::Error,
            b"OPN" => Kind::Open,
            b"CLO" => Kind::Close,
            b"MSG" => Kind::Message,
            _ => {
                return Err(WireFault::bad(
                    StatusCode::BadTcpMessageTypeInvalid,
                    "no type of a message",
                ));
            }
        };
        let whole = matches!(last, b'F') || (kind == Kind::Message && matches!(last, b'C' | b'A'));
        if !whole {
            return Err(WireFault::bad(
                StatusCode::BadTcpMessageTypeInvalid,
                "no type of a chunk",
            ));
        }
        let size = usize::try_from(u32::from_le_bytes(size)).unwrap_or(usize::MAX);
        if !(HEADER..=MOST_CHUNK).contains(&size) {
            return Err(WireFault::bad(
                StatusCode::BadTcpMessageTooLarge,
                "no size of a chunk",
            ));
        }
        let mut bytes = BytesMut::zeroed(size);
        if let Some((start, rest)) = bytes.split_at_mut_checked(HEADER) {
            start.copy_from_slice(&header);
            self.stream.read_exact(rest).await?;
        }
        let bytes = bytes.freeze();
        Ok(Frame { kind, last, bytes })
    }

    /// The frame as HEL or ACK; of an ERR what it tells.
    pub(crate) async fn greeting<T: SimpleBinaryDecodable>(
        &mut self,
        kind: Kind,
    ) -> Result<T, WireFault> {
        let frame = self.frame().await?;
        if frame.kind == Kind::Error {
            return Err(told(&frame));
        }
        if frame.kind != kind {
            return Err(WireFault::bad(
                StatusCode::BadTcpMessageTypeInvalid,
                "another greeting was expected",
            ));
        }
        decode(&frame.bytes)
            .map_err(|error| WireFault::of(&error, "a greeting that cannot be read"))
    }

    /// Sends HEL, ACK or ERR.
    pub(crate) async fn greet(
        &mut self,
        greeting: &impl SimpleBinaryEncodable,
    ) -> Result<(), WireFault> {
        let mut bytes = Vec::with_capacity(greeting.byte_len());
        let encoded = SimpleBinaryEncodable::encode(greeting, &mut bytes);
        encoded.map_err(|error| WireFault::of(&error, "a greeting that cannot be written"))?;
        self.stream.write_all(&bytes).await?;
        Ok(())
    }

    /// Waits until the peer closes, or says something. What it says is lost: for whom it is the end in any case. Whoever
    /// drops it before loses nothing.
    pub(crate) async fn stirred(&mut self) {
        let mut byte = [0];
        // An error is an end, too.
        let _ended = self.stream.read(&mut byte).await.is_err();
    }

    /// Tells the peer why the conversation ends.
    pub(crate) async fn tell(&mut self, status: StatusCode, why: &str) {
        // Most likely it is gone.
        drop(self.greet(&ErrorMessage::new(status, why)).await);
        drop(self.stream.shutdown().await);
    }

    /// The next message. `admit` decides on the one that opens the channel before anything of it is decrypted.
    pub(crate) async fn receive<M: Message>(
        &mut self,
        admit: impl Fn(&AsymmetricSecurityHeader) -> Result<(), StatusCode>,
    ) -> Result<Received<M>, WireFault> {
        let mut chunks: Vec<MessageChunk> = Vec::new();
        let mut size = 0;
        let mut opened = None;
        loop {
            let frame = self.frame().await?;
            match frame.kind {
                Kind::Error => return Err(told(&frame)),
                Kind::Hello | Kind::Acknowledge => {
                    return Err(WireFault::bad(
                        StatusCode::BadTcpMessageTypeInvalid,
                        "a second greeting",
                    ));
                }
                Kind::Open => {
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
                Kind::Close | Kind::Message => self.check_channel(&frame.bytes)?,
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
                    "a message that is too large",
                ));
            }
            if last == b'F' {
                return self.decode(&chunks, opened);
            }
        }
    }

    /// Sends a message in as many chunks as it takes.
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
        let chunks =
            chunks.map_err(|error| WireFault::of(&error, "a message that cannot be written"))?;
        self.sent
            .increment(u32::try_from(chunks.len()).unwrap_or(u32::MAX));
        let mut secured = vec![0; chunk_size + MIN_CHUNK_SIZE];
        for chunk in &chunks {
            let size = self.channel.apply_security(chunk, &mut secured);
            let size =
                size.map_err(|status| WireFault::bad(status, "a message that cannot be secured"))?;
            self.stream
                .write_all(secured.get(..size).unwrap_or_default())
                .await?;
        }
        Ok(())
    }

    /// Whether whoever renews the channel is who opened it: nobody takes its security away.
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
        match same_policy && same_sender {
            true => Ok(()),
            false => Err(WireFault::bad(
                StatusCode::BadSecurityChecksFailed,
                "the channel is another's",
            )),
        }
    }

    /// Whether a chunk belongs to the channel that is open.
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
                "no channel of this connection",
            ));
        }
        // The one before is good until a message comes with the new one (OPC 10000-4, 5.5.2).
        let token = self.channel.token_id();
        match number(MESSAGE_CHUNK_HEADER_SIZE) {
            Some(its) if its == token || its.checked_add(1) == Some(token) => Ok(()),
            _ => Err(WireFault::bad(
                StatusCode::BadSecureChannelTokenUnknown,
                "no token of this channel",
            )),
        }
    }

    /// The chunk as it was before it was signed and encrypted.
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
        // The crate's arithmetic on what a peer encrypted has not been held against every length.
        let verified = catch_unwind(AssertUnwindSafe(|| match channel.is_client_role() {
            true => channel.verify_and_remove_security(frame),
            false => channel.verify_and_remove_security_server(frame),
        }));
        let chunk = match verified {
            Ok(chunk) => {
                chunk.map_err(|error| WireFault::of(&error, "a chunk that does not verify"))?
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
        next.map_err(|error| WireFault::of(&error, "a chunk out of its turn"))?;
        Ok(chunk)
    }

    fn decode<M: Message>(
        &self,
        chunks: &[MessageChunk],
        opening: Option<AsymmetricSecurityHeader>,
    ) -> Result<Received<M>, WireFault> {
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
        Ok(Received {
            message,
            request_id,
            opening,
        })
    }
}

/// A channel that is not open yet.
fn channel(role: Role) -> SecureChannel {
    // The crate would look for a certificate of ours there; whoever has one sets it.
    let store = Arc::new(RwLock::new(CertificateStore::new(Path::new("/dev/null"))));
    let context = ContextOwned::new_default(NamespaceMap::new(), options());
    // It has an error logged that there is none.
    tracing::subscriber::with_default(NoSubscriber::default(), || {
        SecureChannel::new(store, role, Arc::new(RwLock::new(context)))
    })
}

/// The header that names policy and certificate of a channel to be opened.
fn opening(frame: &[u8]) -> Result<AsymmetricSecurityHeader, WireFault> {
    let rest = frame.get(MESSAGE_CHUNK_HEADER_SIZE..).unwrap_or_default();
    let header = AsymmetricSecurityHeader::decode(&mut Cursor::new(rest), &options());
    header.map_err(|error| WireFault::of(&error, "a channel that cannot be opened"))
}

fn decode<T: SimpleBinaryDecodable>(bytes: &[u8]) -> Result<T, Error> {
    T::decode(&mut Cursor::new(bytes), &options())
}

fn told(frame: &Frame) -> WireFault {
    let message: Result<ErrorMessage, _> = decode(&frame.bytes);
    WireFault::Told(message.map_or(StatusCode::BadUnknownResponse, |message| message.error))
}

/// The policy of the standard's name; `None` for one we do not speak.
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
/// Headers and the signature of a chunk.
const SIGNED: usize = 12 + 4 + 8 + 32;
/// The largest chunk that is taken and sent.
pub(crate) const MOST_CHUNK: usize = 65_536;
pub(crate) const MOST_CHUNKS: usize = 64;
/// The largest message that is taken.
pub(crate) const MOST_HEARD: usize = 2 << 20;
/// The largest message that is sent: a list of a thousand servers has room in it.
const MOST_SENT: usize = 4 << 20;
