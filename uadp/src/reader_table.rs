//! The readers of many writers, known by their triple.

use std::time::Duration;

use crate::{
    Accepted, Arrival, DataSetMessage, DataSetReaderState, NetworkHeader, OwnedPublisherId,
    PubSubState, PublisherId, ReaderDrop, ReaderSettings,
};

/// A [`DataSetReaderState`] for each DataSetWriter that is heard, made when it is first heard: for receivers that are
/// not told beforehand who sends.
///
/// It holds as many readers as it was made for. When it is full, a new writer takes the place of the one that was
/// silent longest, if that was for [`ReaderSettings::forget_after`]; else the new writer is refused. So nobody can
/// push out writers that live by inventing others.
#[derive(Debug)]
pub struct ReaderTable {
    settings: ReaderSettings,
    parent: PubSubState,
    capacity: usize,
    /// Sorted by the keys.
    readers: Vec<(ReaderKey, DataSetReaderState)>,
    refused: u64,
    replaced: u64,
}

/// What tells one DataSetWriter from another. `None` is what its NetworkMessages leave out.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ReaderKey {
    /// The publisher.
    pub publisher_id: Option<OwnedPublisherId>,
    /// The WriterGroup within the publisher.
    pub writer_group_id: Option<u16>,
    /// The DataSetWriter within the publisher.
    pub writer_id: Option<u16>,
}

/// A [`ReaderKey`] for looking up, without owning the PublisherId; ordered as the keys are.
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
    /// Bytes a PublisherId of type String may have here.
    pub const MAX_PUBLISHER_ID: usize = 1024;

    /// An empty table for so many writers. Its readers are enabled, below a ReaderGroup that is Operational.
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

    /// Has the writer's reader judge the message, which is at `position` among the DataSetMessages of its
    /// NetworkMessage.
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

    /// The reader of a writer, made if there is none.
    ///
    /// # Errors
    /// [`ReaderDrop::TableFull`] when there is no place for another, and [`ReaderDrop::PublisherIdTooLong`] past
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

    /// Notices for which readers the MessageReceiveTimeout passed; `failed` is told of each whose state became Error.
    pub fn handle_timeout(&mut self, now: Duration, mut failed: impl FnMut(&ReaderKey)) {
        for (key, reader) in &mut self.readers {
            if reader.handle_timeout(now) {
                failed(key);
            }
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to notice.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let timeouts = self.readers.iter();
        timeouts
            .filter_map(|(_, reader)| reader.poll_timeout())
            .min()
    }

    /// Tells all readers the state of their ReaderGroup, those to come included.
    pub fn set_parent(&mut self, parent: PubSubState, now: Duration) {
        self.parent = parent;
        for (_, reader) in &mut self.readers {
            reader.set_parent(parent, now);
        }
    }

    /// The readers there are.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = (&ReaderKey, &DataSetReaderState)> {
        self.readers.iter().map(|(key, reader)| (key, reader))
    }

    /// How often a writer was refused, once for each message.
    #[must_use]
    pub const fn refused(&self) -> u64 {
        self.refused
    }

    /// How often a silent writer made place for another.
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
        // A new reader is Disabled, which is the only state in which this does something.
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
