//! Probes publishers for the descriptions of their topics and calls, a few times each and at a
//! limited rate.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use uadp::discovery::{Probe, WireArray};
use uadp::{PublisherId, SecurityHeader};

/// The open questions. A probe names a space but no WriterGroup: if several programs publish for a
/// space, each of them answers.
#[derive(Debug, Default)]
pub(crate) struct Prober {
    wanted: BTreeMap<(u16, Question), PendingProbe>,
    /// The time of the last probe.
    sent: Option<Duration>,
    /// The number of probes for applications; `None` if they are not wanted.
    asked_all: Option<u32>,
}

/// A question to a space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Question {
    /// All calls of the space. Bridges announce them in response to a probe for their
    /// PubSubConnections.
    Calls,
    /// The description of a DataSetWriterId.
    Writer(u16),
}

#[derive(Debug, Clone, Copy)]
struct PendingProbe {
    next: Duration,
    attempts: u32,
    answered: bool,
    /// Number of times that the question was asked anew after an answer.
    renewed: u32,
}

impl Prober {
    /// Queues a probe for a DataSetWriter, unless it was queued before. After an answer, the probe
    /// is queued again a few times: several programs may use a DataSetWriterId.
    pub(crate) fn want(&mut self, space: u16, writer_id: u16, now: Duration) {
        self.ask(space, Question::Writer(writer_id), now);
    }

    /// Probes for a DataSetWriter until [`answered`](Self::answered), at a limited rate, while this
    /// function is called.
    pub(crate) fn insist(&mut self, space: u16, writer_id: u16, now: Duration) {
        self.want(space, writer_id, now);
        if let Some(wanted) = self.wanted.get_mut(&(space, Question::Writer(writer_id))) {
            wanted.attempts = wanted.attempts.min(ATTEMPTS - 1);
            wanted.next = wanted.next.min(now + INSIST);
        }
    }

    /// Queues a probe for the calls of a space, unless it was queued before.
    pub(crate) fn want_calls(&mut self, space: u16, now: Duration) {
        self.ask(space, Question::Calls, now);
    }

    /// Queues a probe for applications.
    pub(crate) fn want_all(&mut self) {
        self.asked_all.get_or_insert(0);
    }

    fn ask(&mut self, space: u16, question: Question, now: Duration) {
        if let Some(wanted) = self.wanted.get_mut(&(space, question)) {
            if wanted.answered && wanted.renewed < RENEWED {
                *wanted = PendingProbe {
                    next: now + GATHER,
                    attempts: 0,
                    answered: false,
                    renewed: wanted.renewed + 1,
                };
            }
        } else if self.wanted.len() < MOST {
            let wanted = PendingProbe {
                next: now + GATHER,
                attempts: 0,
                answered: false,
                renewed: 0,
            };
            self.wanted.insert((space, question), wanted);
        }
    }

    /// Marks a question as answered.
    pub(crate) fn answered(&mut self, space: u16, writer_id: u16) {
        if let Some(wanted) = self.wanted.get_mut(&(space, Question::Writer(writer_id))) {
            (wanted.attempts, wanted.answered) = (ATTEMPTS, true);
        }
    }

    /// Returns the datagram that is due, if any.
    pub(crate) fn poll(&mut self, now: Duration) -> Option<Vec<u8>> {
        if self.sent.is_some_and(|sent| now < sent + PACE) {
            return None;
        }
        if let Some(asked) = &mut self.asked_all
            && *asked < ASK_ALL
            && now >= WAIT * *asked
        {
            *asked += 1;
            self.sent = Some(now);
            return all();
        }
        let is_due = |wanted: &PendingProbe| wanted.attempts < ATTEMPTS && wanted.next <= now;
        let first = *self.wanted.iter().find(|(_, wanted)| is_due(wanted))?.0;
        let space = first.0;
        let mut ids = BTreeSet::new();
        for ((_, question), wanted) in self
            .wanted
            .range_mut(first..=(space, Question::Writer(u16::MAX)))
        {
            let together = match question {
                Question::Calls => first.1 == Question::Calls,
                Question::Writer(_) => first.1 != Question::Calls && ids.len() < TOGETHER,
            };
            if together && is_due(wanted) {
                wanted.attempts += 1;
                wanted.next = now + WAIT * wanted.attempts;
                if let Question::Writer(id) = question {
                    ids.insert(*id);
                }
            }
        }
        self.sent = Some(now);
        let ids: Vec<u16> = ids.into_iter().collect();
        let probe = match first.1 {
            Question::Writer(_) => Probe::DataSetMetaData(WireArray::new(&ids)),
            Question::Calls => Probe::PubSubConnections {
                transport_profile_uris: WireArray::null(),
                include_writer_groups: false,
                include_data_set_writers: false,
            },
        };
        let mut datagram = Vec::new();
        let publisher = Some(PublisherId::UInt16(space));
        let encoded = probe.encode(publisher, SecurityHeader::NONE, &mut datagram);
        encoded.is_ok().then_some(datagram)
    }
}

/// Returns the probe for applications, which is addressed to all publishers.
fn all() -> Option<Vec<u8>> {
    let mut datagram = Vec::new();
    let encoded = Probe::FindApplications.encode(None, SecurityHeader::NONE, &mut datagram);
    encoded.is_ok().then_some(datagram)
}

/// Number of probes for applications, because a datagram may be lost.
const ASK_ALL: u32 = 2;
/// Maximum number of questions, open or answered.
const MOST: usize = 8192;
/// Maximum number of DataSetWriters in a probe: the number that a publisher of the bridges
/// announces within half a second.
const TOGETHER: usize = 50;
/// Topics received within this time are probed together.
const GATHER: Duration = Duration::from_millis(120);
/// Minimum interval between two probes.
const PACE: Duration = Duration::from_millis(100);
/// Time before the second probe; the third probe follows after twice this time.
const WAIT: Duration = Duration::from_millis(700);
const ATTEMPTS: u32 = 3;
/// Maximum number of times that an answered question is asked anew.
const RENEWED: u32 = 8;
/// Interval of the probes for the values that a command cannot do without.
const INSIST: Duration = Duration::from_millis(500);

/// Spaces that are probed for calls before any message is received from them.
pub(super) const FIRST_ASKED: [u16; 3] = [0, 1, 2];

#[cfg(test)]
mod tests {
    use uadp::NetworkMessage;

    use super::*;

    /// Returns the space and the probed DataSetWriters; empty for a probe for calls.
    fn read(datagram: &[u8]) -> (Option<PublisherId<'_>>, Vec<u16>) {
        let message = NetworkMessage::decode(datagram).unwrap();
        let probe = Probe::decode(&message).unwrap();
        if let Probe::DataSetMetaData(ids) = probe {
            return (message.publisher_id(), ids.iter().collect());
        }
        assert!(matches!(probe, Probe::PubSubConnections { .. }));
        (message.publisher_id(), Vec::new())
    }

    #[test]
    fn each_writer_is_asked_three_times_at_most_and_thousands_slowly() {
        let mut prober = Prober::default();
        for id in 1..=20_000 {
            prober.want(2, id, Duration::ZERO);
        }
        let (mut probes, mut asked) = (0, BTreeMap::<u16, u32>::new());
        for millis in 0..60_000 {
            if let Some(probe) = prober.poll(Duration::from_millis(millis)) {
                let (space, ids) = read(&probe);
                assert_eq!(space, Some(PublisherId::UInt16(2)));
                assert!((1..=TOGETHER).contains(&ids.len()));
                probes += 1;
                for id in ids {
                    *asked.entry(id).or_default() += 1;
                }
            }
        }
        assert!(probes <= 600, "{probes} in a minute");
        assert!(asked.len() <= MOST && asked.values().all(|times| *times <= ATTEMPTS));
    }

    #[test]
    fn who_there_is_is_asked_twice_and_only_where_it_is_wanted() {
        let asked = |prober: &mut Prober| {
            let all = (0..10_000).filter_map(|millis| prober.poll(Duration::from_millis(millis)));
            let is_it = |datagram: &Vec<u8>| {
                let message = NetworkMessage::decode(datagram).unwrap();
                Probe::decode(&message).unwrap() == Probe::FindApplications
            };
            all.filter(is_it).count()
        };
        let mut prober = Prober::default();
        assert_eq!(asked(&mut prober), 0);
        prober.want_all();
        assert_eq!(asked(&mut prober), 2);
    }

    #[test]
    fn an_answered_question_is_asked_anew_a_few_times() {
        let mut prober = Prober::default();
        prober.want(0, 101, Duration::ZERO);
        let probe = prober.poll(GATHER).unwrap();
        assert_eq!(read(&probe), (Some(PublisherId::UInt16(0)), vec![101]));
        prober.answered(0, 101);
        assert_eq!(prober.poll(Duration::from_secs(9)), None);
        // A second program uses the same DataSetWriterId.
        let mut probes = 0;
        for second in 10..100 {
            let now = Duration::from_secs(second);
            prober.want(0, 101, now);
            probes += u32::from(prober.poll(now + GATHER).is_some());
            prober.answered(0, 101);
        }
        assert_eq!(probes, RENEWED);
    }

    #[test]
    fn a_needed_description_is_asked_for_until_it_comes() {
        let mut prober = Prober::default();
        let mut probes = 0;
        for millis in 0..10_000 {
            let now = Duration::from_millis(millis);
            prober.insist(0, 101, now);
            probes += u32::from(prober.poll(now).is_some());
        }
        assert_eq!(probes, 20);
    }

    #[test]
    fn calls_are_asked_for_once_a_space_and_apart_from_writers() {
        let mut prober = Prober::default();
        prober.want(0, 101, Duration::ZERO);
        prober.want_calls(0, Duration::ZERO);
        let first = prober.poll(GATHER).unwrap();
        assert_eq!(read(&first), (Some(PublisherId::UInt16(0)), vec![]));
        let second = prober.poll(GATHER + PACE).unwrap();
        assert_eq!(read(&second), (Some(PublisherId::UInt16(0)), vec![101]));
    }
}
