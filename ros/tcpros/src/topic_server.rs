//! The listener for subscribers and clients of services: accepting, the handshake, and writing to
//! each connection independently.
//!
//! The accept loop only accepts. Each connection is a task, which ends with the connection, with
//! its publisher, or with the node; the accept task of the node owns all tasks.

use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use bytes::{Buf, BufMut, Bytes, BytesMut};
use socket2::SockRef;
use thiserror::Error;
use tokio::io::{AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::tcp::ReadHalf;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use crate::crowd::{ConnectionAdmission, ConnectionLimits, Crowd, Settled};
use crate::events::{self, Refusals};
use crate::header::{ConnectionHeader, HeaderError, clipped};
use crate::link::{prepare, transport_info};
use crate::node::Inner;
use crate::publisher::{Joined, Subscriber};
use crate::reach::left_by;
use crate::refusal::ConnectionRefusal;
use crate::service::{self, ClientFault};

/// Serves the subscribers and clients of a node until it is dropped. Beyond the limit, connections
/// without a completed handshake are closed first; otherwise the new connection is refused.
pub(crate) async fn serve(listener: TcpListener, places: ConnectionLimits, node: Arc<Inner>) {
    let mut crowd = Crowd::new(places);
    let mut connections: JoinSet<Result<(), (SocketAddr, Refused)>> = JoinSet::new();
    let mut refusals = Refusals::new("TCPROS");
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            Some(ended) = connections.join_next() => {
                if let Ok(Err((peer, error))) = ended {
                    refusals.handshake_failed(&peer, &error);
                }
                continue;
            }
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                refusals.accept_failed(&error).await;
                continue;
            }
        };
        let node = Arc::clone(&node);
        let admission = crowd.admit(peer.ip(), |settled| {
            connections.spawn(async move {
                let served = serve_one(stream, &node, &settled).await;
                served.map_err(|error| (peer, error))
            })
        });
        match admission {
            ConnectionAdmission::Free => {}
            ConnectionAdmission::InPlaceOf(address) => refusals.gave_way(address),
            ConnectionAdmission::Full(limit) => refusals.too_many(limit),
        }
    }
}

async fn serve_one(mut stream: TcpStream, node: &Inner, settled: &Settled) -> Result<(), Refused> {
    let handshake = timeout(HANDSHAKE_LIMIT, shake_hands(&mut stream, node));
    let admitted = handshake
        .await
        .map_err(|_| Refused::Silent(HANDSHAKE_LIMIT))??;
    settled.settle();
    let joined = match admitted {
        Admitted::Subscriber(joined) => joined,
        Admitted::Service(service::ClientHandshake::Client(session)) => {
            return Ok(session.serve(&mut stream).await?);
        }
        Admitted::Service(service::ClientHandshake::Probe) => return Ok(()),
    };
    let subscriber = &joined.subscriber;
    let peer = stream.peer_addr()?;
    let ended = tokio::select! {
        biased;
        () = subscriber.is_to_reconnect(peer) => {
            // Discards what waits in the socket.
            SockRef::from(&stream).set_linger(Some(Duration::ZERO))?;
            ConnectionEnd::CutOff
        }
        ended = write_messages(&mut stream, subscriber) => ended,
    };
    let dropped = subscriber.outbox.dropped();
    events::subscriber_left(&joined.hub.topic, &subscriber.caller_id, dropped, &ended);
    if matches!(ended, ConnectionEnd::CutOff) {
        drop(stream);
        call_back(joined, node).await;
    }
    Ok(())
}

/// Has the master call a subscriber whose connection was reset: one of roscpp connects again by
/// itself, one of rospy when it receives the publishers of the topic. Ends when it is connected, or
/// after the last of [`CALLS`].
async fn call_back(joined: Joined, node: &Inner) {
    let hub = Arc::clone(&joined.hub);
    let caller = joined.subscriber.caller_id.clone();
    drop(joined);
    for wait in CALLS {
        sleep(wait).await;
        if hub.is_subscribed_by(&caller) {
            return;
        }
        node.renew_publication(&hub.topic);
    }
}

/// The times until the topic is registered once more. A subscriber that has not yet noticed the end
/// of its connection ignores the publishers.
const CALLS: [Duration; 4] = [
    Duration::from_millis(200),
    Duration::from_secs(1),
    Duration::from_secs(4),
    Duration::from_secs(15),
];

/// Role of an admitted peer.
enum Admitted {
    Subscriber(Joined),
    Service(service::ClientHandshake),
}

async fn shake_hands(stream: &mut TcpStream, node: &Inner) -> Result<Admitted, Refused> {
    prepare(stream)?;
    let request = ConnectionHeader::read(stream).await?;
    match admit(request, node, stream) {
        Ok((reply, admitted)) => {
            stream.write_all(&reply.encode()?).await?;
            Ok(admitted)
        }
        Err(refusal) => {
            let reply = ConnectionHeader::default().with("error", refusal.to_string());
            stream.write_all(&reply.encode()?).await?;
            stream.shutdown().await?;
            Err(Refused::Mismatch(refusal))
        }
    }
}

/// Joins before the reply is written, so that all messages published from then on arrive.
fn admit(
    request: ConnectionHeader,
    node: &Inner,
    stream: &TcpStream,
) -> Result<(ConnectionHeader, Admitted), ConnectionRefusal> {
    if let Some(name) = request.get("service") {
        let served = node
            .service(name)
            .ok_or_else(|| ConnectionRefusal::NoService(clipped(name).to_owned()))?;
        let (reply, admitted) = served.admit(request, node.name())?;
        return Ok((reply, Admitted::Service(admitted)));
    }
    let Some(topic) = request.get("topic") else {
        return Err(ConnectionRefusal::SubscriberHeader);
    };
    let caller = clipped(request.caller_id());
    let gone = || ConnectionRefusal::NoTopic {
        topic: clipped(topic).to_owned(),
        caller: caller.to_owned(),
    };
    let hub = node.publication(topic).ok_or_else(gone)?;
    let reply = hub.reply_to(&request, node.name())?;
    let reach = left_by(stream).map(|address| (node.reach(), address));
    let joined = hub
        .join(
            node.next_connection_id(),
            caller,
            (transport_info(stream), reach),
        )
        .ok_or_else(gone)?;
    let nodelay = request.get("tcp_nodelay") == Some("1");
    events::subscriber_joined(&joined.hub.topic, caller, nodelay);
    Ok((reply, Admitted::Subscriber(joined)))
}

async fn write_messages(stream: &mut TcpStream, subscriber: &Subscriber) -> ConnectionEnd {
    let outbox = &subscriber.outbox;
    let (mut reader, mut writer) = stream.split();
    let mut waiting = Vec::new();
    let mut batch = BytesMut::new();
    let mut overdue = std::pin::pin!(async {
        outbox.closed().await;
        sleep(DRAIN_LIMIT).await;
    });
    loop {
        waiting.clear();
        // Both branches are cancel-safe: `take` removes nothing before it returns, and data from
        // the subscriber is discarded.
        let more = tokio::select! {
            biased;
            more = outbox.take(&mut waiting, BATCH) => more,
            ended = until_closed(&mut reader) => return ended,
        };
        if !more {
            return ConnectionEnd::Withdrawn;
        }
        let bytes: usize = waiting.iter().map(|message| message.len() + 4).sum();
        let messages = waiting.len();
        if let Err(ended) = write_all(&mut writer, &mut waiting, &mut batch, overdue.as_mut()).await
        {
            return ended;
        }
        subscriber
            .bytes
            .fetch_add(u64::try_from(bytes).unwrap_or(u64::MAX), Ordering::Relaxed);
        subscriber.messages.fetch_add(
            u64::try_from(messages).unwrap_or(u64::MAX),
            Ordering::Relaxed,
        );
    }
}

/// Writes messages: small messages together in a single piece, a large message without copying it.
async fn write_all(
    writer: &mut (impl AsyncWrite + Unpin),
    messages: &mut Vec<Bytes>,
    batch: &mut BytesMut,
    mut overdue: Pin<&mut impl Future<Output = ()>>,
) -> Result<(), ConnectionEnd> {
    for message in messages.drain(..) {
        batch.put_slice(&length(&message));
        if message.len() <= COPIED {
            batch.put_slice(&message);
        } else {
            write(writer, batch.split().freeze(), message, overdue.as_mut()).await?;
        }
    }
    write(writer, batch.split().freeze(), Bytes::new(), overdue).await
}

/// Writes two pieces as one, the second without copying it. Fails if the peer accepts no data in
/// time or if `overdue` completes.
pub(crate) async fn write(
    writer: &mut (impl AsyncWrite + Unpin),
    head: Bytes,
    body: Bytes,
    mut overdue: Pin<&mut impl Future<Output = ()>>,
) -> Result<(), ConnectionEnd> {
    let mut data = head.chain(body);
    while data.has_remaining() {
        tokio::select! {
            biased;
            written = writer.write_buf(&mut data) => match written {
                Ok(0) => return Err(ConnectionEnd::Closed),
                Ok(_) => {}
                Err(error) => return Err(ConnectionEnd::Failed(error)),
            },
            () = sleep(STALL_LIMIT) => return Err(ConnectionEnd::Stalled),
            () = overdue.as_mut() => return Err(ConnectionEnd::Withdrawn),
        }
    }
    Ok(())
}

/// Reads until the subscriber disconnects. A subscriber sends nothing after its header, so reading
/// only detects the end.
pub(crate) async fn until_closed(reader: &mut ReadHalf<'_>) -> ConnectionEnd {
    let mut nothing = [0; 256];
    loop {
        match reader.read(&mut nothing).await {
            Ok(0) => return ConnectionEnd::Closed,
            Ok(_) => {}
            Err(error) => return ConnectionEnd::Failed(error),
        }
    }
}

fn length(message: &Bytes) -> [u8; 4] {
    // `publish` refuses longer messages.
    u32::try_from(message.len())
        .unwrap_or(u32::MAX)
        .to_le_bytes()
}

/// Reason for which a peer was refused.
#[derive(Debug, Error)]
enum Refused {
    #[error("it sent no connection header within {0:?}")]
    Silent(Duration),
    #[error(transparent)]
    Header(#[from] HeaderError),
    #[error(transparent)]
    Mismatch(ConnectionRefusal),
    #[error(transparent)]
    Client(#[from] ClientFault),
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Reason for the end of a connection.
#[derive(Debug, Error)]
pub(crate) enum ConnectionEnd {
    #[error("its link was lost and is back, so it has to connect again")]
    CutOff,
    #[error("it closed the connection")]
    Closed,
    #[error("the topic or service was withdrawn")]
    Withdrawn,
    #[error("it received nothing for {STALL_LIMIT:?}")]
    Stalled,
    #[error("the connection failed: {0}")]
    Failed(std::io::Error),
}

const HANDSHAKE_LIMIT: Duration = Duration::from_secs(5);
pub(crate) const STALL_LIMIT: Duration = Duration::from_secs(10);
/// Time limit for sending the queued data of a withdrawn topic or service.
pub(crate) const DRAIN_LIMIT: Duration = Duration::from_secs(1);
/// Number of message bytes written at once.
const BATCH: usize = 64 * 1024;
/// Up to this size, copying a message into the batch is cheaper than a write of its own.
const COPIED: usize = 16 * 1024;

#[cfg(test)]
mod tests {
    use std::io::IoSlice;
    use std::pin::Pin;
    use std::task::{Context, Poll};

    use super::*;
    use crate::outbox::{Limit, SubscriberQueue};

    /// A writer that accepts all data and records the address and length of the pieces of each
    /// write.
    #[derive(Default)]
    struct Recorder {
        writes: Vec<Vec<(*const u8, usize)>>,
        bytes: Vec<u8>,
    }

    impl AsyncWrite for Recorder {
        fn poll_write(
            self: Pin<&mut Self>,
            cx: &mut Context<'_>,
            piece: &[u8],
        ) -> Poll<std::io::Result<usize>> {
            self.poll_write_vectored(cx, &[IoSlice::new(piece)])
        }

        fn poll_write_vectored(
            mut self: Pin<&mut Self>,
            _: &mut Context<'_>,
            pieces: &[IoSlice<'_>],
        ) -> Poll<std::io::Result<usize>> {
            let noted = pieces.iter().map(|p| (p.as_ptr(), p.len())).collect();
            self.writes.push(noted);
            for piece in pieces {
                self.bytes.extend_from_slice(piece);
            }
            Poll::Ready(Ok(pieces.iter().map(|p| p.len()).sum()))
        }

        fn is_write_vectored(&self) -> bool {
            true
        }

        fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<std::io::Result<()>> {
            Poll::Ready(Ok(()))
        }

        fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<std::io::Result<()>> {
            Poll::Ready(Ok(()))
        }
    }

    fn outbox() -> SubscriberQueue {
        SubscriberQueue::new(Limit {
            messages: 1000,
            bytes: 1 << 20,
        })
    }

    async fn written(messages: &[Bytes]) -> Recorder {
        let outbox = outbox();
        for message in messages {
            assert_eq!(outbox.push(message.clone()), 0);
        }
        outbox.close();
        let mut recorder = Recorder::default();
        let (mut waiting, mut batch) = (Vec::new(), BytesMut::new());
        while outbox.take(&mut waiting, BATCH).await {
            let never = std::pin::pin!(std::future::pending());
            let whole = write_all(&mut recorder, &mut waiting, &mut batch, never).await;
            assert!(whole.is_ok());
        }
        recorder
    }

    /// Requirement: small messages that wait leave in a single write.
    #[tokio::test]
    async fn small_messages_that_wait_leave_in_one_write() {
        let messages: Vec<Bytes> = (0..100u8).map(|n| Bytes::from(vec![n; 16])).collect();
        let recorder = written(&messages).await;
        assert_eq!(recorder.writes.len(), 1);
        assert_eq!(recorder.bytes.len(), 100 * 20);
        assert_eq!(recorder.bytes[..6], [16, 0, 0, 0, 0, 0]);
        assert_eq!(recorder.bytes[20..26], [16, 0, 0, 0, 1, 1]);
    }

    /// Requirement: a large message is not copied on its way out, and its length leaves with it.
    #[tokio::test]
    async fn a_large_message_leaves_from_where_it_is_together_with_its_length() {
        let small = Bytes::from_static(b"small");
        let large = Bytes::from(vec![7; 100_000]);
        let recorder = written(&[small, large.clone()]).await;
        // The message that fits a batch is written first; the other message is a single write of
        // two pieces.
        assert_eq!(recorder.writes[1][0].1, 4);
        assert_eq!(recorder.writes[1][1], (large.as_ptr(), large.len()));
        assert_eq!(recorder.writes.len(), 2);
        assert_eq!(recorder.bytes[9..13], 100_000u32.to_le_bytes());
    }
}
