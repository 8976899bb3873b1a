//! Messages between programs of one host in shared memory, by iceoryx2, without a network.
//!
//! All programs of a group share one service of iceoryx2 with a NetworkMessage as payload, and an
//! event that wakes the receivers. A message is written to shared memory once, however many
//! programs receive it. A receiver that does not read its messages loses further ones, which the
//! sender counts; it never blocks the sender. A message has the time at which it was sent, so a
//! program that was stopped knows that a command in it is late.

use std::collections::BTreeMap;
use std::fmt;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Waker};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::{BackpressureAction, LoanError, SendError as NotSent};
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, Config, LogLevel, NodeBuilder, Path, SemanticString,
    ServiceName, SignalHandlingMode, ipc_threadsafe::Service, set_log_level,
};

use crate::carrier::{
    Capacity, Carrier, CarrierChange, OutgoingMessage, Received, SendError, Senders,
};

/// Folder of the files of all groups. It lies in memory, and services with a private /tmp see it.
const FOLDER: &str = "/dev/shm/ua-bridge";
/// Messages of a sender that wait for a receiver. Further ones are dropped for this receiver.
const WAITING: usize = 128;
/// Maximum number of programs of a group.
const PROGRAMS: usize = 32;
/// The largest message in bytes. A sender has memory for as many of them as can wait for all
/// receivers, but only used memory is taken from the system.
const LARGEST: usize = 65_507;
/// Free memory in bytes below which no message is sent: a write into shared memory that the system
/// cannot provide would end the program.
const RESERVE: u64 = 32 << 20;
/// Time after which the thread that waits for messages looks whether the carrier is dropped.
const WAIT: Duration = Duration::from_millis(200);
/// Period in which the files of programs that were killed are removed, in calls of
/// [`Carrier::follow`], which come every [`LOOK`](crate::LOOK).
const CLEAN_UP: u32 = 5;

/// Reason why programs cannot exchange messages in shared memory.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SharedMemoryError {
    /// The files of the group cannot be made or opened.
    #[error(
        "the group `{group}` in shared memory cannot be opened ({step}: {why}): all programs of a \
         group need the same version of UA Bridge, the same user, and access to {FOLDER}; at most \
         {PROGRAMS} programs can be in a group"
    )]
    Open {
        /// The name of the group.
        group: String,
        /// The step that failed.
        step: &'static str,
        /// The error of iceoryx2.
        why: String,
    },
}

/// A carrier in shared memory.
pub struct SharedMemory {
    group: String,
    publisher: Publisher<Service, [u8], u64>,
    subscriber: Subscriber<Service, [u8], u64>,
    notifier: Notifier<Service>,
    node: Node<Service>,
    arrivals: Arrivals,
    /// The reason why nothing is sent.
    lost: Option<String>,
    /// The calls of [`Carrier::follow`] until the next clean-up.
    until_cleaned: u32,
    dropped: Dropped,
}

/// Numbers of dropped messages.
#[derive(Debug, Default)]
struct Dropped {
    /// Messages that a receiver did not get because too many wait for it.
    discarded: Arc<AtomicU64>,
    /// Messages that cannot be read.
    unreadable: u64,
}

impl fmt::Debug for SharedMemory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SharedMemory")
            .field("group", &self.group)
            .field("dropped", &self.dropped)
            .finish_non_exhaustive()
    }
}

impl SharedMemory {
    /// Joins a group of programs of this host, which the first program creates.
    ///
    /// # Errors
    /// The files of the group cannot be opened, e.g. because another user or another version of the
    /// program created them.
    pub fn open(group: &str) -> Result<Self, SharedMemoryError> {
        // Every error is returned and reported with its remedy.
        set_log_level(LogLevel::Fatal);
        let of = Opening { group };
        let mut config = Config::default();
        let folder = Path::new(FOLDER.as_bytes()).map_err(|why| of.failed("folder", why))?;
        config.global.set_root_path(&folder);
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>()
            .map_err(|why| of.failed("node", why))?;
        let name = format!("ua-bridge/{group}");
        let name = ServiceName::new(&name).map_err(|why| of.failed("name", why))?;
        let messages = node
            .service_builder(&name)
            .publish_subscribe::<[u8]>()
            .user_header::<u64>()
            .max_publishers(PROGRAMS)
            .max_subscribers(PROGRAMS)
            .max_nodes(PROGRAMS)
            .history_size(0)
            .subscriber_max_buffer_size(WAITING)
            .subscriber_max_borrowed_samples(2)
            .enable_safe_overflow(false)
            .open_or_create()
            .map_err(|why| of.failed("messages", why))?;
        let wakes = node
            .service_builder(&name)
            .event()
            .max_notifiers(PROGRAMS)
            .max_listeners(PROGRAMS)
            .max_nodes(PROGRAMS)
            .open_or_create()
            .map_err(|why| of.failed("event", why))?;
        let discarded = Arc::<AtomicU64>::default();
        let counter = Arc::clone(&discarded);
        let subscriber = messages
            .subscriber_builder()
            .buffer_size(WAITING)
            .create()
            .map_err(|why| of.failed("receiver", why))?;
        let listener = wakes
            .listener_builder()
            .create()
            .map_err(|why| of.failed("listener", why))?;
        let publisher = messages
            .publisher_builder()
            .initial_max_slice_len(LARGEST)
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(1)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .set_backpressure_handler(move |_| {
                counter.fetch_add(1, Ordering::Relaxed);
                BackpressureAction::DiscardData
            })
            .create()
            .map_err(|why| of.failed("sender", why))?;
        let notifier = wakes
            .notifier_builder()
            .create()
            .map_err(|why| of.failed("notifier", why))?;
        let arrivals = Arrivals::of(listener).map_err(|why| of.failed("thread", why))?;
        Ok(Self {
            group: group.to_owned(),
            publisher,
            subscriber,
            notifier,
            node,
            arrivals,
            lost: scarce(),
            until_cleaned: CLEAN_UP,
            dropped: Dropped {
                discarded,
                unreadable: 0,
            },
        })
    }

    fn put(&self, bytes: &[u8]) -> Result<(), SendError> {
        if bytes.len() > LARGEST {
            return Err(SendError::TooBig);
        }
        if self.lost.is_some() {
            return Err(SendError::Unreachable);
        }
        let memory = self.publisher.loan_slice_uninit(bytes.len());
        let mut memory = memory.map_err(|error| match error {
            LoanError::OutOfMemory | LoanError::ExceedsMaxLoans => SendError::Busy,
            LoanError::ExceedsMaxLoanSize => SendError::TooBig,
            LoanError::InternalFailure => SendError::Refused,
        })?;
        *memory.user_header_mut() = now();
        match memory.write_from_slice(bytes).send() {
            Ok(_) => Ok(()),
            Err(NotSent::LoanError(_)) => Err(SendError::Busy),
            Err(NotSent::ConnectionError(_) | NotSent::ConnectionCorrupted) => {
                Err(SendError::Unreachable)
            }
            Err(_) => Err(SendError::Refused),
        }
    }

    /// Wakes the receivers. They also look without it, at the latest after [`LOOK`](crate::LOOK).
    fn wake(&self) {
        if let Err(error) = self.notifier.notify() {
            tracing::debug!(%error, "the receivers in shared memory were not woken");
        }
    }

    /// Returns the next message of another program.
    fn take(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
        for _ in 0..WAITING {
            let sample = match self.subscriber.receive() {
                Ok(sample) => sample?,
                Err(error) => {
                    self.dropped.unreadable += 1;
                    return Some(Err(io::Error::other(error.to_string())));
                }
            };
            let from = sample.header().publisher_id();
            if from == self.publisher.id() {
                continue;
            }
            let bytes = sample.payload();
            if buffer.len() < bytes.len() {
                buffer.resize(bytes.len(), 0);
            }
            let Some(place) = buffer.get_mut(..bytes.len()) else {
                continue;
            };
            place.copy_from_slice(bytes);
            return Some(Ok(Received {
                length: bytes.len(),
                from: address(from.value()),
                stamp: UNIX_EPOCH.checked_add(Duration::from_nanos(*sample.user_header())),
            }));
        }
        // All of them were own messages.
        self.arrivals.set();
        None
    }
}

/// Returns the reason why no message may be written, if the system has hardly any shared memory
/// left.
fn scarce() -> Option<String> {
    let free = rustix::fs::statvfs("/dev/shm").ok()?;
    let bytes = free.f_bavail.saturating_mul(free.f_frsize);
    (bytes < RESERVE).then(|| {
        let [free, least] = [bytes, RESERVE].map(|bytes| bytes >> 20);
        format!(
            "/dev/shm has {free} MiB left, and {least} are needed: give it more, e.g. by --shm-size of Docker"
        )
    })
}

/// Returns the time of a message: nanoseconds since 1970.
#[expect(
    clippy::disallowed_methods,
    reason = "it stands for the stamp of the kernel"
)]
fn now() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    u64::try_from(now.unwrap_or_default().as_nanos()).unwrap_or(u64::MAX)
}

/// Returns the address that stands for a sender: addresses of two senders differ.
fn address(sender: u128) -> SocketAddr {
    let mut hasher = DefaultHasher::new();
    sender.hash(&mut hasher);
    let [a, b, c, port @ .., _, _, _] = hasher.finish().to_be_bytes();
    let ip = Ipv4Addr::new(127, a, b, c);
    SocketAddr::new(IpAddr::V4(ip), u16::from_be_bytes(port).max(1))
}

/// The opening of a group, for its errors.
struct Opening<'g> {
    group: &'g str,
}

impl Opening<'_> {
    fn failed(&self, step: &'static str, why: impl fmt::Debug) -> SharedMemoryError {
        SharedMemoryError::Open {
            group: self.group.to_owned(),
            step,
            why: format!("{why:?}"),
        }
    }
}

impl Carrier for SharedMemory {
    fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
        self.put(message.bytes)?;
        self.wake();
        Ok(())
    }

    fn try_send_all(&mut self, messages: &[OutgoingMessage<'_>]) -> BTreeMap<usize, SendError> {
        let sent = messages.iter().map(|message| self.put(message.bytes));
        let errors: BTreeMap<usize, SendError> = sent
            .enumerate()
            .filter_map(|(index, sent)| Some((index, sent.err()?)))
            .collect();
        if errors.len() < messages.len() {
            self.wake();
        }
        errors
    }

    fn poll_recv(
        &mut self,
        cx: &mut Context<'_>,
        buffer: &mut Vec<u8>,
    ) -> Poll<io::Result<Received>> {
        self.arrivals.clear();
        if let Some(received) = self.take(buffer) {
            return Poll::Ready(received);
        }
        // A message that has arrived since then wakes the task.
        self.arrivals.wait(cx);
        Poll::Pending
    }

    fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
        self.take(buffer)
    }

    /// Removes the files of programs that were killed, and looks whether there is memory to send.
    fn follow(&mut self) -> Option<CarrierChange> {
        self.until_cleaned = self.until_cleaned.saturating_sub(1);
        if self.until_cleaned == 0 {
            self.until_cleaned = CLEAN_UP;
            let cleaned = self.node.try_cleanup_dead_nodes();
            if cleaned.cleanups > 0 {
                tracing::info!(
                    programs = cleaned.cleanups,
                    "removed programs that were killed from shared memory"
                );
            }
        }
        let was_lost = self.lost.is_some();
        self.lost = scarce();
        match (&self.lost, was_lost) {
            (Some(reason), false) => Some(CarrierChange::Lost(reason.clone())),
            (None, true) => Some(CarrierChange::Back(self.interface())),
            _ => None,
        }
    }

    fn lost(&self) -> Option<String> {
        self.lost.clone()
    }

    fn source(&self) -> Option<SocketAddr> {
        None
    }

    fn interface(&self) -> String {
        format!("shm:{}", self.group)
    }

    fn senders(&self) -> Senders {
        Senders::Addresses
    }

    fn capacity(&self) -> Capacity {
        let bytes = WAITING.saturating_mul(LARGEST);
        Capacity::Host(u64::try_from(bytes).unwrap_or(u64::MAX))
    }

    fn dropped(&self) -> Vec<(&'static str, u64)> {
        vec![
            (
                "receiver_full",
                self.dropped.discarded.load(Ordering::Relaxed),
            ),
            ("unreadable", self.dropped.unreadable),
        ]
    }
}

/// Waits for messages in a thread: iceoryx2 has no interface for tasks.
struct Arrivals {
    shared: Arc<Waiting>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Waiting {
    /// Whether messages may have arrived since the task looked last.
    arrived: AtomicBool,
    ended: AtomicBool,
    task: Mutex<Option<Waker>>,
}

impl Arrivals {
    fn of(listener: Listener<Service>) -> io::Result<Self> {
        let shared = Arc::<Waiting>::default();
        let thread = {
            let shared = Arc::clone(&shared);
            std::thread::Builder::new()
                .name("shared-memory".to_owned())
                .spawn(move || shared.follow(&listener))?
        };
        Ok(Self {
            shared,
            thread: Some(thread),
        })
    }

    fn clear(&self) {
        self.shared.arrived.store(false, Ordering::SeqCst);
    }

    /// Lets the task look again, because it stopped before it had read everything.
    fn set(&self) {
        self.shared.arrived.store(true, Ordering::SeqCst);
    }

    fn wait(&self, cx: &Context<'_>) {
        *self.shared.task() = Some(cx.waker().clone());
        if self.shared.arrived.load(Ordering::SeqCst) {
            self.shared.wake();
        }
    }
}

impl Waiting {
    fn task(&self) -> std::sync::MutexGuard<'_, Option<Waker>> {
        self.task.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wake(&self) {
        let task = self.task().take();
        if let Some(task) = task {
            task.wake();
        }
    }

    fn follow(&self, listener: &Listener<Service>) {
        while !self.ended.load(Ordering::SeqCst) {
            match listener.timed_wait(|_| {}, WAIT) {
                Ok(0) => {}
                Ok(_) => {
                    self.arrived.store(true, Ordering::SeqCst);
                    self.wake();
                }
                Err(error) => {
                    tracing::debug!(%error, "cannot wait for messages in shared memory");
                    std::thread::park_timeout(WAIT);
                    self.arrived.store(true, Ordering::SeqCst);
                    self.wake();
                }
            }
        }
    }
}

impl Drop for Arrivals {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            let _panicked = thread.join();
        }
    }
}
