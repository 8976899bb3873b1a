//! The link to a publisher of a topic: requesting its address, connecting, reading, and
//! reconnecting.

use std::net::IpAddr;
use std::os::fd::AsRawFd;
use std::pin::{Pin, pin};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use log_limit::Throttle;
use socket2::{SockRef, TcpKeepalive};
use thiserror::Error;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::time::{sleep, timeout};

use crate::clock;
use crate::crowd::Shares;
use crate::events;
use crate::frame::{FrameTooLong, Frames};
use crate::header::{ConnectionHeader, HeaderError, clipped};
use crate::inbox::{ConnectionPeer, InboxMessage};
use crate::master::{Master, MasterError, unwrap_triple};
use crate::outbox::lock;
use crate::reach::{NetworkReach, left_by};
use crate::rpc::{self, RpcEndpoint, RpcError};
use crate::subscription::{PublisherConnection, TopicFeed, TopicLink};
use crate::xmlrpc::XmlRpcValue;

/// State shared by all links of a node.
#[derive(Debug)]
pub(crate) struct LinkContext {
    caller_id: String,
    max_message: usize,
    pub(crate) master: Master,
    /// Whether the publishers on other hosts are within reach.
    pub(crate) reach: NetworkReach,
    /// Maximum number of connected publishers of a topic.
    pub(crate) publishers_of_topic: usize,
    /// A permit for each publisher that is connected or being connected.
    places: Semaphore,
    /// Rate limit for log entries about unreachable publishers.
    failures: Mutex<Throttle>,
    crowded: Mutex<Throttle>,
}

impl LinkContext {
    pub(crate) fn new(
        caller_id: String,
        max_message: usize,
        (master, reach): (Master, NetworkReach),
        shares: &Shares,
    ) -> Self {
        Self {
            caller_id,
            max_message,
            master,
            reach,
            publishers_of_topic: shares.publishers_of_topic,
            places: Semaphore::new(shares.publishers),
            failures: Mutex::new(Throttle::several(FAILURES_LOGGED, LOG_PERIOD)),
            crowded: Mutex::new(Throttle::new(LOG_PERIOD)),
        }
    }

    /// Waits for the permission to connect, in the order of the requests.
    async fn place(&self, topic: &str) -> Option<SemaphorePermit<'_>> {
        if let Ok(place) = self.places.try_acquire() {
            return Some(place);
        }
        if let Some(more) = lock(&self.crowded).admit(clock::now()) {
            events::link_waits(topic, more);
        }
        // The semaphore is never closed.
        self.places.acquire().await.ok()
    }

    /// Returns the number of suppressed log entries about unreachable publishers if an entry may be
    /// written now.
    fn may_tell(&self) -> Option<u64> {
        let mut failures = lock(&self.failures);
        let more = failures.admit(clock::now());
        let first_held_back = more.is_none() && failures.suppressed() == 1;
        drop(failures);
        if first_held_back {
            events::links_not_told(LOG_PERIOD);
        }
        more
    }
}

/// Keeps a subscription connected to a publisher until the master no longer lists the publisher.
/// Runs as a task of its own.
pub(crate) async fn run(
    feed: Arc<TopicFeed>,
    context: Arc<LinkContext>,
    uri: String,
    state: Arc<TopicLink>,
) {
    let mut wait = FIRST_WAIT;
    let mut failures = 0u32;
    let mut throttle = Throttle::new(LOG_PERIOD);
    let mut link = PublisherLink {
        feed: &feed,
        context: &context,
        state: &state,
        held: None,
        failed: 0,
    };
    loop {
        let before = state.messages.load(Ordering::Relaxed);
        let mut changed = pin!(context.reach.changed());
        let place = context.place(&feed.topic).await;
        let started = clock::now();
        let error = link.follow(&uri, changed.as_mut()).await;
        drop(place);
        if matches!(error, LinkError::Ourselves) {
            // The entry stays, so that the next update does not try again.
            return;
        }
        if matches!(error, LinkError::NetworkChanged) {
            events::link_retried(&feed.topic, &uri, &error, FIRST_WAIT);
            (wait, failures) = (FIRST_WAIT, 0);
            sleep(FIRST_WAIT).await;
            continue;
        }
        let is_kept = link.failed();
        if !is_kept && !feed.still_wanted(&uri, &state) {
            return;
        }
        let lived = state.messages.load(Ordering::Relaxed) > before
            || started.elapsed() > CONNECT_LIMIT + HANDSHAKE_LIMIT + REQUEST_LIMIT;
        if lived {
            (wait, failures) = (FIRST_WAIT, 0);
        }
        failures += 1;
        let is_lost = context.reach.is_lost();
        if !is_lost && (error.is_fault() || failures == PATIENCE) {
            if throttle.admit(clock::now()).is_some()
                && let Some(more) = context.may_tell()
            {
                let node = context.master.name_of(&feed.topic, &uri).await;
                events::link_failed((&feed.topic, &uri), node.as_deref(), &error, more);
            }
            failures = failures.min(PATIENCE - 1);
        } else {
            if is_lost {
                failures = 0;
            }
            events::link_retried(&feed.topic, &uri, &error, wait);
        }
        tokio::select! {
            () = sleep(wait) => wait = (wait * 2).min(LAST_WAIT),
            () = state.named_again.notified() => wait = FIRST_WAIT,
            () = changed => wait = FIRST_WAIT,
        }
    }
}

/// A link to a publisher: its connection, and the former one while the network is lost.
struct PublisherLink<'a> {
    feed: &'a TopicFeed,
    context: &'a LinkContext,
    state: &'a TopicLink,
    /// The connection that the loss of its network ended, and the address that it used. The
    /// publisher counts as connected until the attempts after the loss fail, so that nothing is
    /// given up for a link that was down.
    held: Option<(PublisherConnection<'a>, Option<IpAddr>)>,
    /// The number of failed attempts since the network was found again.
    failed: u32,
}

impl PublisherLink<'_> {
    /// Connects to the publisher and delivers its messages until the connection ends. Returns the
    /// reason of the end.
    ///
    /// When the network is lost, a connection to another host ends: what the publisher sends
    /// meanwhile stays in its socket, and would be delivered later as if it were new. A change of
    /// the network (`changed`) ends an attempt to connect.
    async fn follow(
        &mut self,
        uri: &str,
        changed: Pin<&mut impl Future<Output = ()>>,
    ) -> LinkError {
        let connected = tokio::select! {
            biased;
            () = changed => return LinkError::NetworkChanged,
            connected = connect(self.feed, self.context, uri) => connected,
        };
        let (stream, peer) = match connected {
            Ok(connected) => connected,
            Err(error) => return error,
        };
        let address = left_by(&stream).filter(|_| !self.feed.keep_cut_off);
        events::publisher_joined(&self.feed.topic, &peer.caller_id);
        let connection = self.feed.connected(Arc::clone(&peer), self.state);
        self.failed = 0;
        if let Some((former, _)) = self.held.take() {
            former.replaced();
        }
        tokio::select! {
            biased;
            () = self.context.reach.cut_off(address) => {
                self.held = Some((connection, address));
                LinkError::NetworkChanged
            }
            error = read_messages(stream, peer, (self.feed, self.context, self.state)) => error,
        }
    }

    /// Notes a failed attempt to connect. Returns whether the link is still to be kept for the
    /// publisher that was connected before the network was lost.
    fn failed(&mut self) -> bool {
        let Some((_, address)) = &self.held else {
            return false;
        };
        if address.is_some_and(|address| self.context.reach.has_lost(address)) {
            self.failed = 0;
            return true;
        }
        self.failed += 1;
        if self.failed < ATTEMPTS_AFTER_LOSS {
            return true;
        }
        self.held = None;
        self.failed = 0;
        false
    }
}

async fn connect(
    feed: &TopicFeed,
    context: &LinkContext,
    uri: &str,
) -> Result<(TcpStream, Arc<ConnectionPeer>), LinkError> {
    let (host, port) = request_topic(feed, context, uri).await?;
    let connecting = timeout(
        CONNECT_LIMIT,
        rpc::connect(&host, port, context.master.prefers_ipv6()),
    );
    let mut stream = connecting
        .await
        .map_err(|_| LinkError::NoConnection(CONNECT_LIMIT))??;
    prepare(&stream)?;
    let shaking = timeout(HANDSHAKE_LIMIT, shake_hands(&mut stream, feed, context));
    let header = shaking
        .await
        .map_err(|_| LinkError::NoHeader(HANDSHAKE_LIMIT))??;
    Ok((
        stream,
        Arc::new(ConnectionPeer {
            caller_id: header.caller_id().to_owned(),
            header,
        }),
    ))
}

async fn request_topic(
    feed: &TopicFeed,
    context: &LinkContext,
    uri: &str,
) -> Result<(String, u16), LinkError> {
    let endpoint = RpcEndpoint::parse(uri)
        .ok_or(RpcError::Uri)?
        .ipv6_first(context.master.prefers_ipv6());
    let protocols = vec![XmlRpcValue::Array(vec!["TCPROS".into()])];
    let params = vec![
        context.caller_id.as_str().into(),
        feed.topic.as_str().into(),
        protocols.into(),
    ];
    let reply = rpc::call(&endpoint, "requestTopic", params, REQUEST_LIMIT).await?;
    let chosen = unwrap_triple(reply, "requestTopic")?;
    match chosen.as_array() {
        Some([protocol, XmlRpcValue::String(host), port, ..])
            if protocol.as_str() == Some("TCPROS") =>
        {
            let port = port.as_int().and_then(|port| u16::try_from(port).ok());
            Ok((
                host.clone(),
                port.ok_or(MasterError::Shape("requestTopic"))?,
            ))
        }
        _ => Err(MasterError::Shape("requestTopic").into()),
    }
}

async fn shake_hands(
    stream: &mut TcpStream,
    feed: &TopicFeed,
    context: &LinkContext,
) -> Result<ConnectionHeader, LinkError> {
    let wanted = &feed.wanted;
    let md5sum = wanted.md5sum.as_deref().unwrap_or("*");
    let request = ConnectionHeader::default()
        .with("callerid", &*context.caller_id)
        .with("topic", &*feed.topic)
        .with("type", wanted.type_name.as_deref().unwrap_or("*"))
        .with("md5sum", md5sum)
        .with("tcp_nodelay", "1");
    stream.write_all(&request.encode()?).await?;
    let reply = ConnectionHeader::read(stream).await?;
    if let Some(error) = reply.get("error") {
        return Err(LinkError::Refused(clipped(error).to_owned()));
    }
    if reply.caller_id() == context.caller_id {
        return Err(LinkError::Ourselves);
    }
    match reply.md5sum() {
        Some(theirs) if md5sum != "*" && theirs != "*" && theirs != md5sum => {
            Err(LinkError::OtherType {
                theirs: format!(
                    "{}/{}",
                    clipped(reply.type_name().unwrap_or("?")),
                    clipped(theirs)
                ),
                ours: format!("{}/{md5sum}", wanted.type_name.as_deref().unwrap_or("*")),
            })
        }
        _ => Ok(reply),
    }
}

/// Delivers the messages of the publisher until the connection ends, and returns the reason of the
/// end.
async fn read_messages(
    mut stream: TcpStream,
    peer: Arc<ConnectionPeer>,
    (feed, context, state): (&TopicFeed, &LinkContext, &TopicLink),
) -> LinkError {
    *lock(&state.transport) = transport_info(&stream);
    let mut frames = Frames::new(context.max_message);
    let mut ahead = 0;
    loop {
        match stream.read_buf(frames.room()).await {
            Ok(0) => return LinkError::Closed,
            Ok(read) => {
                frames.filled(read);
                state
                    .bytes
                    .fetch_add(u64::try_from(read).unwrap_or(u64::MAX), Ordering::Relaxed);
            }
            Err(error) => return LinkError::Io(error),
        }
        // A reading of the clock serves all messages that this read completes. The stamps still
        // differ, because a stamp identifies a sample.
        let mut received = clock::utc();
        loop {
            match frames.next() {
                Ok(Some(bytes)) => {
                    state.messages.fetch_add(1, Ordering::Relaxed);
                    ahead += 1 + bytes.len() / 4096;
                    feed.deliver(InboxMessage {
                        bytes,
                        peer: Arc::clone(&peer),
                        received,
                    });
                    received += Duration::from_nanos(1);
                    if ahead >= TURN {
                        // A read may contain more than the inbox holds: the consumer must be able
                        // to run in between.
                        ahead = 0;
                        tokio::task::yield_now().await;
                    }
                }
                Ok(None) => break,
                Err(error) => {
                    feed.refused_frames.fetch_add(1, Ordering::Relaxed);
                    return error.into();
                }
            }
        }
    }
}

/// Sets the socket options: small messages are sent without delay, and keepalive detects a lost
/// peer in minutes.
pub(crate) fn prepare(stream: &TcpStream) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    let keepalive = TcpKeepalive::new()
        .with_time(Duration::from_secs(60))
        .with_interval(Duration::from_secs(10))
        .with_retries(6);
    SockRef::from(stream).set_tcp_keepalive(&keepalive)
}

/// Returns the description of a connection for `rosnode info`.
pub(crate) fn transport_info(stream: &TcpStream) -> String {
    match (stream.local_addr(), stream.peer_addr()) {
        (Ok(local), Ok(peer)) => format!(
            "TCPROS connection on port {} to [{peer} on socket {}]",
            local.port(),
            stream.as_raw_fd()
        ),
        // The connection has just failed.
        _ => String::new(),
    }
}

/// Reason for which a publisher is not connected.
#[derive(Debug, Error)]
enum LinkError {
    #[error("it does not announce its address: {0}")]
    Request(#[from] MasterError),
    #[error("no response from its address within {0:?}")]
    NoConnection(Duration),
    #[error("it sent no connection header within {0:?}")]
    NoHeader(Duration),
    #[error(transparent)]
    Header(#[from] HeaderError),
    #[error("it refuses: {0}")]
    Refused(String),
    #[error("it publishes {theirs}, but {ours} is required")]
    OtherType { theirs: String, ours: String },
    #[error("it is this node")]
    Ourselves,
    #[error(transparent)]
    FrameTooLong(#[from] FrameTooLong),
    #[error("the network of this host was lost or found again")]
    NetworkChanged,
    #[error("it closed the connection")]
    Closed,
    #[error("the connection failed: {0}")]
    Io(#[from] std::io::Error),
}

impl LinkError {
    /// Returns whether the error needs an action of an operator, even if it occurs once.
    const fn is_fault(&self) -> bool {
        matches!(
            self,
            Self::Refused(_)
                | Self::OtherType { .. }
                | Self::FrameTooLong(_)
                | Self::Header(
                    HeaderError::TooLong(_)
                        | HeaderError::Truncated
                        | HeaderError::NoEquals
                        | HeaderError::TooManyFields
                )
        )
    }
}

impl From<RpcError> for LinkError {
    fn from(error: RpcError) -> Self {
        Self::Request(error.into())
    }
}

/// Amount of work between two turns of the consumer, in messages plus their pages.
const TURN: usize = 64;
const REQUEST_LIMIT: Duration = Duration::from_secs(5);
const CONNECT_LIMIT: Duration = Duration::from_secs(5);
const HANDSHAKE_LIMIT: Duration = Duration::from_secs(5);
const FIRST_WAIT: Duration = Duration::from_millis(100);
const LAST_WAIT: Duration = Duration::from_secs(20);
/// Number of consecutive failures before the first warning: a publisher that is starting or
/// stopping is not worth a warning.
const PATIENCE: u32 = 4;
/// The number of failed attempts after a loss of the network until a publisher that was connected
/// before counts as lost.
const ATTEMPTS_AFTER_LOSS: u32 = 3;
const LOG_PERIOD: Duration = Duration::from_secs(60);
/// Number of unreachable publishers named in the log per period; the others are counted.
const FAILURES_LOGGED: u32 = 20;

#[cfg(test)]
mod tests {
    use super::*;

    /// Requirement: small messages are not delayed, and a peer that is lost without a message is
    /// detected.
    #[tokio::test]
    async fn a_connection_has_no_delay_and_is_kept_alive() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let stream = TcpStream::connect(listener.local_addr().unwrap())
            .await
            .unwrap();
        let (accepted, _) = listener.accept().await.unwrap();
        for stream in [&stream, &accepted] {
            prepare(stream).unwrap();
            assert!(stream.nodelay().unwrap());
            let socket = SockRef::from(stream);
            assert!(socket.keepalive().unwrap());
            assert_eq!(
                socket.tcp_keepalive_time().unwrap(),
                Duration::from_secs(60)
            );
        }
    }

    #[tokio::test]
    async fn a_connection_is_described_as_rosnode_reads_it() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server = listener.local_addr().unwrap();
        let stream = TcpStream::connect(server).await.unwrap();
        let own = stream.local_addr().unwrap().port();
        let text = transport_info(&stream);
        let expected = format!("TCPROS connection on port {own} to [{server} on socket ");
        assert!(text.starts_with(&expected), "{text}");
    }
}
