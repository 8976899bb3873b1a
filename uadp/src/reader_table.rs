//! Readers of many writers, by PublisherId, WriterGroupId and DataSetWriterId.

use std::time::Duration;

use crate::{
    Accepted, Arrival, DataSetMessage, DataSetReaderState, NetworkHeader, OwnedPublisherId,
    PubSubState, PublisherId, ReaderDrop, ReaderSettings,
};

/// A table with a [`DataSetReaderState`] for each DataSetWriter, created at its first message. For
/// receivers without a configured list of publishers.
///
/// The table has a fixed capacity. If it is full, a new writer replaces the writer with the longest
/// pause, if that pause is at least [`ReaderSettings::forget_after`]. Otherwise the new writer is
/// rejected. So invented writers cannot displace active writers.
#[derive(Debug)]
pub struct ReaderTable {
    settings: ReaderSettings,
    parent: PubSubState,
    capacity: usize,
    /// Sorted by key.
    readers: Vec<(ReaderKey, DataSetReaderState)>,
    refused: u64,
    replaced: u64,
}

/// Identity of a DataSetWriter. Fields that its NetworkMessages omit are `None`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ReaderKey {
    /// The publisher.
    pub publisher_id: Option<OwnedPublisherId>,
    /// The WriterGroup within the publisher.
    pub writer_group_id: Option<u16>,
    /// The DataSetWriter within the publisher.
    pub writer_id: Option<u16>,
}

/// A [`ReaderKey`] for lookups, which borrows the PublisherId and has the same order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Triple<'a> {
    publisher_id: Option<PublisherId<'a>>,
    writer_group_id: Option<u16>,
    writer_id: Option<u16>,
}

impl ReaderKey {
    fn triple(&self) -> Triple<'_> {
        Triple {
            publisher_id: self.publisher_id.as_ref().map(OwnedPublisherId::as_id),
            writer_group_id: self.writer_group_id,
            writer_id: self.writer_id,
        }
    }
}

impl From<Triple<'_>> for ReaderKey {
    fn from(triple: Triple<'_>) -> Self {
        Self {
            publisher_id: triple.publisher_id.map(Into::into),
            writer_group_id: triple.writer_group_id,
            writer_id: triple.writer_id,
        }
    }
}

impl ReaderTable {
    /// Maximum bytes of a PublisherId of type String.
    pub const MAX_PUBLISHER_ID: usize = 1024;

    /// Creates an empty table with a capacity. Its readers are enabled, below a ReaderGroup that is
    /// Operational.
    #[must_use]
    pub const fn new(capacity: usize, settings: ReaderSettings) -> Self {
        Self {
            settings,
            parent: PubSubState::Operational,
            capacity,
            readers: Vec::new(),
            refused: 0,
            replaced: 0,
        }
    }

    /// Passes the message at `position` of its NetworkMessage to the reader of its writer.
    ///
    /// # Errors
    /// As [`reader`](Self::reader) and [`DataSetReaderState::receive`].
    pub fn receive(
        &mut self,
        network: &NetworkHeader<'_>,
        position: usize,
        message: &DataSetMessage<'_>,
        now: Duration,
    ) -> Result<Accepted, ReaderDrop> {
        let reader = self.reader(network, message.writer_id, now)?;
        reader.receive(&Arrival::of(network, position, message), now)
    }

    /// Returns the reader of a writer, and creates it if there is none.
    ///
    /// # Errors
    /// [`ReaderDrop::TableFull`] if the table is full; [`ReaderDrop::PublisherIdTooLong`] above
    /// [`MAX_PUBLISHER_ID`](Self::MAX_PUBLISHER_ID).
    pub fn reader(
        &mut self,
        network: &NetworkHeader<'_>,
        writer_id: Option<u16>,
        now: Duration,
    ) -> Result<&mut DataSetReaderState, ReaderDrop> {
        let triple = Triple {
            publisher_id: network.publisher_id,
            writer_group_id: network.group.and_then(|group| group.writer_group_id),
            writer_id,
        };
        let at = match self.find(&triple) {
            Ok(at) => at,
            Err(_) => match self.add(triple, now) {
                Ok(at) => at,
                Err(reason) => {
                    self.refused += 1;
                    return Err(reason);
                }
            },
        };
        self.readers
            .get_mut(at)
            .map(|(_, reader)| reader)
            .ok_or(ReaderDrop::TableFull)
    }

    /// Checks the MessageReceiveTimeout of all readers. Calls `failed` for each reader whose state
    /// changed to Error.
    pub fn handle_timeout(&mut self, now: Duration, mut failed: impl FnMut(&ReaderKey)) {
        for (key, reader) in &mut self.readers {
            if reader.handle_timeout(now) {
                failed(key);
            }
        }
    }

    /// Returns the time of the next [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let timeouts = self.readers.iter();
        timeouts
            .filter_map(|(_, reader)| reader.poll_timeout())
            .min()
    }

    /// Sets the state of the ReaderGroup for present and future readers.
    pub fn set_parent(&mut self, parent: PubSubState, now: Duration) {
        self.parent = parent;
        for (_, reader) in &mut self.readers {
            reader.set_parent(parent, now);
        }
    }

    /// Returns the readers.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = (&ReaderKey, &DataSetReaderState)> {
        self.readers.iter().map(|(key, reader)| (key, reader))
    }

    /// Returns the number of messages of rejected writers.
    #[must_use]
    pub const fn refused(&self) -> u64 {
        self.refused
    }

    /// Returns the number of replaced writers.
    #[must_use]
    pub const fn replaced(&self) -> u64 {
        self.replaced
    }

    fn find(&self, triple: &Triple<'_>) -> Result<usize, usize> {
        self.readers
            .binary_search_by(|(key, _)| key.triple().cmp(triple))
    }

    fn add(&mut self, triple: Triple<'_>, now: Duration) -> Result<usize, ReaderDrop> {
        if let Some(PublisherId::String(name)) = triple.publisher_id
            && name.len() > Self::MAX_PUBLISHER_ID
        {
            return Err(ReaderDrop::PublisherIdTooLong { len: name.len() });
        }
        if self.readers.len() >= self.capacity {
            self.make_room(now)?;
        }
        let mut reader = DataSetReaderState::new(self.settings, self.parent);
        // Enabling succeeds, because a new reader is Disabled.
        if reader.enable(now).is_err() {
            return Err(ReaderDrop::Inactive);
        }
        let at = self.find(&triple).unwrap_or_else(|at| at);
        self.readers.insert(at, (triple.into(), reader));
        Ok(at)
    }

    fn make_room(&mut self, now: Duration) -> Result<(), ReaderDrop> {
        let readers = self.readers.iter().enumerate();
        let silent = readers.min_by_key(|(_, (_, reader))| reader.heard_at());
        match silent {
            Some((at, (_, reader)))
                if now.saturating_sub(reader.heard_at()) >= self.settings.forget_after() =>
            {
                self.readers.remove(at);
                self.replaced += 1;
                Ok(())
            }
            _ => Err(ReaderDrop::TableFull),
        }
    }
}
