//! Schedules the announcements of a Publisher: several probes share an announcement, and the rate
//! is limited.

use alloc::collections::{BTreeMap, BTreeSet, VecDeque};
use alloc::vec::Vec;
use core::time::Duration;

use super::probe::Probe;

/// The subjects that a Publisher can announce, and their schedule (OPC 10000-14, 7.2.4.6.12.2).
///
/// A probed subject is announced once, after a delay, for all probes during the delay. The same
/// subject is announced again after 500 ms at the earliest. DataSetWriters of a WriterGroup share
/// the announcement of their configuration. Probes can neither cause more announcements than
/// [`AnnounceLimits::rate`], nor more entries than the Publisher's subjects and
/// [`AnnounceLimits::unknown`] unknown subjects.
/// ```
/// use std::time::Duration;
/// use uadp::discovery::{AnnounceLimits, Announcer, WireArray, Probe, AnnouncedSubject};
///
/// let ms = Duration::from_millis;
/// let mut announcer = Announcer::new([(5, 10), (5, 11)], AnnounceLimits::default());
/// announcer.handle_probe(&Probe::DataSetWriterConfiguration(WireArray::new(&[11])), ms(0));
/// announcer.handle_probe(&Probe::DataSetWriterConfiguration(WireArray::new(&[10, 11])), ms(20));
///
/// assert_eq!(announcer.poll_timeout(), Some(ms(50)));
/// let due = announcer.poll(ms(50)).unwrap();
/// assert_eq!(due.subject, AnnouncedSubject::DataSetWriterConfiguration(11));
/// assert_eq!(due.writer_ids, [10, 11]);
/// assert_eq!(due.sequence_number, 0);
/// assert_eq!(announcer.poll(ms(50)), None);
/// ```
#[derive(Debug, Clone)]
pub struct Announcer {
    limits: AnnounceLimits,
    /// WriterGroupId of each DataSetWriterId.
    writers: BTreeMap<u16, u16>,
    groups: BTreeSet<u16>,
    /// DataSetWriters of Actions.
    actions: BTreeSet<u16>,
    /// Planned subjects, and recently announced subjects.
    entries: BTreeMap<AnnouncedSubject, Entry>,
    /// The planned subjects by time, known subjects first.
    planned: BTreeSet<(Duration, bool, AnnouncedSubject)>,
    /// The other subjects by the earliest time of their next announcement.
    announced: BTreeSet<(Duration, AnnouncedSubject)>,
    /// Number of entries for unknown subjects.
    unknown: usize,
    /// Times of the last announcements, at most as many as the rate allows in 500 ms.
    sent: VecDeque<Duration>,
    sequence_number: u16,
    counters: AnnounceCounters,
}

/// Delays and limits of an [`Announcer`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct AnnounceLimits {
    /// Time from the first probe to the announcement, during which further probes for the subject
    /// are combined. It should differ between Publishers, because [`Probe::FindApplications`]
    /// probes all of them at once.
    pub gather: Duration,
    /// Maximum number of announcements in any 500 ms, at least 1. Further announcements are
    /// delayed.
    pub rate: usize,
    /// Maximum number of unknown DataSetWriters and WriterGroups that are announced in 500 ms, with
    /// a bad status. Further unknown ids get no announcement.
    pub unknown: usize,
}

/// Subject of an announcement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum AnnouncedSubject {
    /// The application, as [`AnnouncedContent::ApplicationDescription`](super::AnnouncedContent).
    ApplicationInformation,
    /// The Endpoints, as [`AnnouncedContent::PublisherEndpoints`](super::AnnouncedContent).
    PublisherEndpoints,
    /// The connections, as [`AnnouncedContent::PubSubConnections`](super::AnnouncedContent).
    PubSubConnections,
    /// A WriterGroup, as [`AnnouncedContent::DataSetWriterConfiguration`](super::AnnouncedContent).
    WriterGroupConfiguration(u16),
    /// A DataSetWriter, as
    /// [`AnnouncedContent::DataSetWriterConfiguration`](super::AnnouncedContent).
    DataSetWriterConfiguration(u16),
    /// The content of the DataSet of a DataSetWriter, as
    /// [`AnnouncedContent::DataSetMetaData`](super::AnnouncedContent).
    DataSetMetaData(u16),
    /// The connections with Action Responders, as
    /// [`AnnouncedContent::ActionResponder`](super::AnnouncedContent).
    ActionResponder,
    /// The Action of a DataSetWriter, as
    /// [`AnnouncedContent::ActionMetaData`](super::AnnouncedContent).
    ActionMetaData(u16),
}

/// Content of an announcement of connections or of a WriterGroup.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Included {
    /// Include the WriterGroups of connections.
    pub writer_groups: bool,
    /// Include the DataSetWriters of WriterGroups.
    pub data_set_writers: bool,
}

/// An announcement that is due.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct DueAnnouncement {
    /// Subject of the announcement. An unknown DataSetWriter or WriterGroup is announced with a bad
    /// status.
    pub subject: AnnouncedSubject,
    /// Content of the announcement: the union of all its probes.
    pub included: Included,
    /// For the configuration of DataSetWriters: their ids in ascending order, all of the same
    /// WriterGroup or all unknown. Otherwise empty.
    pub writer_ids: Vec<u16>,
    /// SequenceNumber of the announcement.
    pub sequence_number: u16,
}

/// Reason why an announcement is not planned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum AnnounceRefusal {
    /// The subject is planned already.
    #[error("about to be announced anyway")]
    Duplicate,
    /// The subject is unknown, and the limit of unknown subjects is reached.
    #[error("unknown, as are too many others")]
    Unknown,
}

/// Counters of the subjects in probes, as handled by [`handle_probe`](Announcer::handle_probe).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct AnnounceCounters {
    /// Planned announcements.
    pub planned: u64,
    /// Refused as [`AnnounceRefusal::Duplicate`].
    pub duplicate: u64,
    /// Refused as [`AnnounceRefusal::Unknown`].
    pub unknown: u64,
}

#[derive(Debug, Clone, Copy)]
struct Entry {
    /// Time of the announcement; `None` if there was no probe after the last announcement.
    due: Option<Duration>,
    /// Earliest time of the next announcement.
    earliest: Duration,
    included: Included,
    known: bool,
}

impl Announcer {
    /// Creates an announcer for the given pairs of WriterGroupId and DataSetWriterId. The first
    /// SequenceNumber is 0.
    #[must_use]
    pub fn new(writers: impl IntoIterator<Item = (u16, u16)>, limits: AnnounceLimits) -> Self {
        let mut announcer = Self {
            limits,
            writers: BTreeMap::new(),
            groups: BTreeSet::new(),
            actions: BTreeSet::new(),
            entries: BTreeMap::new(),
            planned: BTreeSet::new(),
            announced: BTreeSet::new(),
            unknown: 0,
            sent: VecDeque::new(),
            sequence_number: 0,
            counters: AnnounceCounters::default(),
        };
        announcer.set_writers(writers);
        announcer
    }

    /// Replaces the DataSetWriters. Planned announcements are dropped, because they may be of other
    /// DataSetWriters. The SequenceNumber continues.
    pub fn set_writers(&mut self, writers: impl IntoIterator<Item = (u16, u16)>) {
        self.entries.clear();
        self.planned.clear();
        self.announced.clear();
        self.unknown = 0;
        self.writers.clear();
        self.groups.clear();
        for (group, writer) in writers {
            self.writers.insert(writer, group);
            self.groups.insert(group);
        }
    }

    /// Adds a DataSetWriter. Planned announcements are kept.
    pub fn add_writer(&mut self, group: u16, writer: u16) {
        self.writers.insert(writer, group);
        self.groups.insert(group);
    }

    /// Replaces the DataSetWriters of Actions; empty at first. They may also be among the
    /// [`set_writers`](Self::set_writers), so that their configuration is announced too.
    ///
    /// The standard has no probe for Actions. The announcer responds to a probe for connections
    /// with the connections that have Action Responders too, because that announcement follows the
    /// same settings (OPC 10000-14, 7.2.4.6.10). It responds to a probe for the DataSetMetaData of
    /// the Action's DataSetWriter with the Action, because that DataSetWriter has no other
    /// metadata.
    pub fn set_actions(&mut self, writers: impl IntoIterator<Item = u16>) {
        self.actions = writers.into_iter().collect();
    }

    /// Plans the announcements for a probe. The caller has checked that the probe addresses this
    /// Publisher: by the PublisherId in its header, and for connections by the
    /// TransportProfileUris. The [`counters`](Self::counters) include refused subjects.
    pub fn handle_probe(&mut self, probe: &Probe<'_>, now: Duration) {
        self.forget(now);
        match *probe {
            Probe::FindApplications => self.ask(AnnouncedSubject::ApplicationInformation, now),
            Probe::PublisherEndpoints => self.ask(AnnouncedSubject::PublisherEndpoints, now),
            Probe::DataSetMetaData(writer_ids) => {
                for id in writer_ids {
                    let subject = if self.actions.contains(&id) {
                        AnnouncedSubject::ActionMetaData(id)
                    } else {
                        AnnouncedSubject::DataSetMetaData(id)
                    };
                    self.ask(subject, now);
                }
            }
            Probe::DataSetWriterConfiguration(writer_ids) => {
                for id in writer_ids {
                    self.ask(AnnouncedSubject::DataSetWriterConfiguration(id), now);
                }
            }
            Probe::WriterGroupConfiguration {
                writer_group_id,
                include_data_set_writers,
            } => {
                let included = Included {
                    writer_groups: false,
                    data_set_writers: include_data_set_writers,
                };
                let planned = self.plan(
                    AnnouncedSubject::WriterGroupConfiguration(writer_group_id),
                    included,
                    now,
                );
                self.count(planned);
            }
            Probe::PubSubConnections {
                include_writer_groups,
                include_data_set_writers,
                ..
            } => {
                let included = Included {
                    writer_groups: include_writer_groups,
                    data_set_writers: include_writer_groups && include_data_set_writers,
                };
                let planned = self.plan(AnnouncedSubject::PubSubConnections, included, now);
                self.count(planned);
                if !self.actions.is_empty() {
                    let planned = self.plan(AnnouncedSubject::ActionResponder, included, now);
                    self.count(planned);
                }
            }
        }
    }

    /// Plans an announcement without a probe: after a change, or at the DiscoveryAnnounceRate.
    ///
    /// # Errors
    /// [`AnnounceRefusal`] if the announcement is not sent, or was planned already.
    pub fn announce(
        &mut self,
        subject: AnnouncedSubject,
        included: Included,
        now: Duration,
    ) -> Result<(), AnnounceRefusal> {
        self.forget(now);
        self.plan(subject, included, now)
    }

    /// Returns the next announcement that is due. Call it until it returns `None`.
    pub fn poll(&mut self, now: Duration) -> Option<DueAnnouncement> {
        self.forget(now);
        let (due, subject) = self.next()?;
        if due.max(self.opens()) > now {
            return None;
        }
        self.count_sent(now);
        let writer_ids = match subject {
            AnnouncedSubject::DataSetWriterConfiguration(id) => self.writers_with(id, now),
            AnnouncedSubject::ApplicationInformation
            | AnnouncedSubject::PublisherEndpoints
            | AnnouncedSubject::PubSubConnections
            | AnnouncedSubject::WriterGroupConfiguration(_)
            | AnnouncedSubject::DataSetMetaData(_)
            | AnnouncedSubject::ActionResponder
            | AnnouncedSubject::ActionMetaData(_) => Vec::new(),
        };
        let included = self.finish(subject, now);
        for id in &writer_ids {
            self.finish(AnnouncedSubject::DataSetWriterConfiguration(*id), now);
        }
        let sequence_number = self.sequence_number;
        self.sequence_number = sequence_number.wrapping_add(1);
        Some(DueAnnouncement {
            subject,
            included,
            writer_ids,
            sequence_number,
        })
    }

    /// Returns the time of the next announcement, or `None` if no announcement is planned.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let (due, _) = self.next()?;
        Some(due.max(self.opens()))
    }

    /// Returns the counters of the subjects in probes.
    #[must_use]
    pub const fn counters(&self) -> &AnnounceCounters {
        &self.counters
    }

    fn ask(&mut self, subject: AnnouncedSubject, now: Duration) {
        let planned = self.plan(subject, Included::default(), now);
        self.count(planned);
    }

    const fn count(&mut self, planned: Result<(), AnnounceRefusal>) {
        let counter = match planned {
            Ok(()) => &mut self.counters.planned,
            Err(AnnounceRefusal::Duplicate) => &mut self.counters.duplicate,
            Err(AnnounceRefusal::Unknown) => &mut self.counters.unknown,
        };
        *counter += 1;
    }

    fn plan(
        &mut self,
        subject: AnnouncedSubject,
        included: Included,
        now: Duration,
    ) -> Result<(), AnnounceRefusal> {
        let due = now.saturating_add(self.limits.gather);
        if let Some(entry) = self.entries.get_mut(&subject) {
            entry.included.add(included);
            if entry.due.is_some() {
                return Err(AnnounceRefusal::Duplicate);
            }
            let due = due.max(entry.earliest);
            entry.due = Some(due);
            self.announced.remove(&(entry.earliest, subject));
            self.planned.insert((due, !entry.known, subject));
            return Ok(());
        }
        let known = self.has(subject);
        if !known {
            if self.unknown >= self.limits.unknown {
                return Err(AnnounceRefusal::Unknown);
            }
            self.unknown += 1;
        }
        let entry = Entry {
            due: Some(due),
            earliest: now,
            included,
            known,
        };
        self.entries.insert(subject, entry);
        self.planned.insert((due, !known, subject));
        Ok(())
    }

    fn has(&self, subject: AnnouncedSubject) -> bool {
        match subject {
            AnnouncedSubject::ApplicationInformation
            | AnnouncedSubject::PublisherEndpoints
            | AnnouncedSubject::PubSubConnections => true,
            AnnouncedSubject::WriterGroupConfiguration(group) => self.groups.contains(&group),
            AnnouncedSubject::DataSetWriterConfiguration(writer)
            | AnnouncedSubject::DataSetMetaData(writer) => self.writers.contains_key(&writer),
            AnnouncedSubject::ActionResponder => !self.actions.is_empty(),
            AnnouncedSubject::ActionMetaData(writer) => self.actions.contains(&writer),
        }
    }

    /// Returns the subject that is due first. At the same time, known subjects come before unknown
    /// subjects.
    fn next(&self) -> Option<(Duration, AnnouncedSubject)> {
        let (due, _, subject) = self.planned.first()?;
        Some((*due, *subject))
    }

    /// Returns the DataSetWriters that are announced together with `id`: planned, in the same
    /// WriterGroup, and not announced within the last 500 ms.
    fn writers_with(&self, id: u16, now: Duration) -> Vec<u16> {
        let group = self.writers.get(&id);
        let all = AnnouncedSubject::DataSetWriterConfiguration(0)
            ..=AnnouncedSubject::DataSetWriterConfiguration(u16::MAX);
        self.entries
            .range(all)
            .filter(|(_, entry)| entry.due.is_some() && entry.earliest <= now)
            .filter_map(|(subject, _)| match subject {
                AnnouncedSubject::DataSetWriterConfiguration(id) => Some(*id),
                AnnouncedSubject::ApplicationInformation
                | AnnouncedSubject::PublisherEndpoints
                | AnnouncedSubject::PubSubConnections
                | AnnouncedSubject::WriterGroupConfiguration(_)
                | AnnouncedSubject::DataSetMetaData(_)
                | AnnouncedSubject::ActionResponder
                | AnnouncedSubject::ActionMetaData(_) => None,
            })
            .filter(|id| self.writers.get(id) == group)
            .collect()
    }

    /// Returns the time from which on the rate permits another announcement.
    fn opens(&self) -> Duration {
        match self.sent.front() {
            Some(oldest) if self.sent.len() >= self.rate() => oldest.saturating_add(SPACING),
            _ => Duration::ZERO,
        }
    }

    fn count_sent(&mut self, now: Duration) {
        while self.sent.len() >= self.rate() {
            self.sent.pop_front();
        }
        self.sent.push_back(now);
    }

    const fn rate(&self) -> usize {
        match self.limits.rate {
            0 => 1,
            rate => rate,
        }
    }

    /// Marks the subject as announced, and returns the content to include.
    fn finish(&mut self, subject: AnnouncedSubject, now: Duration) -> Included {
        let Some(entry) = self.entries.get_mut(&subject) else {
            return Included::default();
        };
        match entry.due.take() {
            Some(due) => self.planned.remove(&(due, !entry.known, subject)),
            None => self.announced.remove(&(entry.earliest, subject)),
        };
        entry.earliest = now.saturating_add(SPACING);
        self.announced.insert((entry.earliest, subject));
        core::mem::take(&mut entry.included)
    }

    /// Removes subjects that were announced long enough ago.
    fn forget(&mut self, now: Duration) {
        while let Some((earliest, subject)) = self.announced.first().copied()
            && earliest <= now
        {
            self.announced.remove(&(earliest, subject));
            let entry = self.entries.remove(&subject);
            if entry.is_some_and(|entry| !entry.known) {
                self.unknown -= 1;
            }
        }
    }
}

impl Included {
    const fn add(&mut self, other: Self) {
        self.writer_groups |= other.writer_groups;
        self.data_set_writers |= other.data_set_writers;
    }
}

/// 50 ms of delay, 50 announcements and 8 unknown subjects in 500 ms.
impl Default for AnnounceLimits {
    fn default() -> Self {
        Self {
            gather: Duration::from_millis(50),
            rate: 50,
            unknown: 8,
        }
    }
}

/// Minimum time between two announcements of a subject.
const SPACING: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests;
