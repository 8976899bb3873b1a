//! The thread of a node: announces the node, receives other node lists, and serves `/rosout` and
//! `/clock`.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::{Wake, Waker};
use std::thread::Thread;
use std::time::Duration;

use bytes::Bytes;
use tokio::time::Instant;
use tracing::{debug, warn};

use super::{Channels, NodeShared, ParticipantPrefix, lock};
use crate::discovery_info::{GidLength, NodeEntities, ParticipantEntitiesInfo};
use crate::raw::{Payload, RawWriter};

/// The state of the thread.
pub(super) struct NodeThread {
    shared: Arc<NodeShared>,
    channels: Channels,
    /// The time at which the list is due for publication.
    due: Option<Instant>,
    /// The length with which the list was published.
    written: Option<GidLength>,
}

impl NodeThread {
    pub(super) fn new(shared: Arc<NodeShared>, channels: Channels) -> Self {
        Self {
            shared,
            channels,
            due: None,
            written: None,
        }
    }

    pub(super) fn run(mut self) {
        let waker = Waker::from(Arc::new(Unpark(std::thread::current())));
        while !self.shared.stop.load(Ordering::Acquire) {
            // Armed before each read: a sample that arrives between the read and the sleep ends the
            // sleep.
            self.channels.info_reader.set_waker(Some(waker.clone()));
            self.hear_others();
            let waits = self.serve(&waker);
            self.tell();
            let now = Instant::now();
            match (self.due, waits) {
                (None, false) => std::thread::park(),
                (None, true) => std::thread::park_timeout(RETRY),
                (Some(due), false) => std::thread::park_timeout(due.duration_since(now)),
                (Some(due), true) => std::thread::park_timeout(due.duration_since(now).min(RETRY)),
            }
        }
        self.withdraw();
    }

    fn hear_others(&mut self) {
        loop {
            match self.channels.info_reader.try_take_one() {
                Ok(Some(sample)) => {
                    let writer = sample.writer_guid;
                    if let Ok(prefix) = ParticipantPrefix::try_from(writer.prefix.as_ref()) {
                        self.heard(prefix, &sample.into_value().into_bytes());
                    }
                }
                Ok(None) => return,
                Err(error) => debug!(%error, "unreadable list of nodes"),
            }
        }
    }

    fn heard(&self, prefix: ParticipantPrefix, payload: &[u8]) {
        if self.channels.participant.starts_with(&prefix) {
            return;
        }
        let mut others = lock(&self.shared.others);
        let Ok((info, length)) = ParticipantEntitiesInfo::decode(payload) else {
            others.malformed += 1;
            debug!(total = others.malformed, "malformed list of nodes");
            return;
        };
        let own = self.shared.options.full_name();
        let double = info.nodes.iter().any(|node| node.full_name() == own);
        if others.insert(prefix, length, info.nodes) && double && others.doubles.insert(prefix) {
            // After the lock is released: a warning goes to all log sinks.
            drop(others);
            warn_of_double(&own);
        }
    }

    /// Serves `/rosout` and `/clock`; returns whether records wait for room.
    fn serve(&self, waker: &Waker) -> bool {
        let services = lock(&self.shared.services);
        let Some((services, rosout)) = &*services else {
            return false;
        };
        if let Some(reader) = &services.clock {
            reader.set_waker(Some(waker.clone()));
            while let Ok(Some(sample)) = reader.try_take_one() {
                self.shared.clock.hear(&sample.into_value().into_bytes());
            }
        }
        rosout.flush(&self.shared.options.logger(), |log| {
            write(&services.rosout, log)
        })
    }

    /// Publishes the list if it is due, and schedules the next publication.
    fn tell(&mut self) {
        let length = self
            .shared
            .options
            .gid
            .unwrap_or_else(|| lock(&self.shared.others).majority());
        let changed = lock(&self.shared.own).changed || self.written != Some(length);
        if !changed {
            self.due = None;
            return;
        }
        let now = Instant::now();
        let due = *self.due.get_or_insert(now + BATCH);
        if now < due {
            return;
        }
        self.due = None;
        let info = self.info();
        if write(&self.channels.info_writer, info.encode(length)) {
            self.written = Some(length);
        } else {
            // The send window is full.
            lock(&self.shared.own).changed = true;
            self.due = Some(now + RETRY);
        }
    }

    fn info(&self) -> ParticipantEntitiesInfo {
        let mut own = lock(&self.shared.own);
        own.changed = false;
        ParticipantEntitiesInfo {
            participant: self.channels.participant,
            nodes: vec![NodeEntities {
                namespace: self.shared.options.namespace.clone(),
                name: self.shared.options.name.clone(),
                readers: own.readers.iter().copied().collect(),
                writers: own.writers.iter().copied().collect(),
            }],
        }
    }

    /// Announces that the node has left before the participant is dropped.
    fn withdraw(self) {
        drop(lock(&self.shared.services).take());
        let info = ParticipantEntitiesInfo {
            participant: self.channels.participant,
            nodes: Vec::new(),
        };
        let writer = &self.channels.info_writer;
        if write(writer, info.encode(self.written.unwrap_or_default())) {
            // A participant that has not received it by then detects the loss of this participant.
            writer.wait_for_acknowledgments(WITHDRAW_WITHIN).ok();
        }
    }
}

fn warn_of_double(name: &str) {
    warn!(
        node = name,
        "another node of the domain has the same name, so ROS tools cannot distinguish them; rename this node with --node-name"
    );
}

/// Returns whether RustDDS accepted the sample.
fn write(writer: &RawWriter, bytes: Bytes) -> bool {
    // The thread only creates little-endian CDR.
    Payload::to_write(bytes).is_ok_and(|payload| writer.write(payload, None).is_ok())
}

struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

/// Changes of the list within this time are published together.
const BATCH: Duration = Duration::from_millis(50);
/// The delay before RustDDS is offered a refused sample again.
const RETRY: Duration = Duration::from_millis(100);
/// How long leaving waits for the acknowledgements of other participants.
const WITHDRAW_WITHIN: Duration = Duration::from_millis(200);
