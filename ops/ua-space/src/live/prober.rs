//! Asking publishers what their topics and calls are, a few times each and never fast.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use uadp::discovery::{List, Probe};
use uadp::{PublisherId, SecurityHeader};

/// What is still to be asked. A probe names a space and no WriterGroup: of several programs that publish for one space
/// each answers for itself.
#[derive(Debug, Default)]
pub(crate) struct Prober {
    wanted: BTreeMap<(u16, Question), Wanted>,
    /// When a probe was sent last.
    sent: Option<Duration>,
    /// How often was asked who there is, where that is to be asked.
    asked_all: Option<u32>,
}

/// What a space is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Question {
    /// All its calls. Asked for by their connections, the bridges tell them.
    Calls,
    /// What is behind a DataSetWriterId.
    Writer(u16),
}

#[derive(Debug, Clone, Copy)]
struct Wanted {
    next: Duration,
    attempts: u32,
}

impl Prober {
    /// Asks for a DataSetWriter, unless that is or was done.
    pub(crate) fn want(&mut self, space: u16, writer_id: u16, now: Duration) {
        self.ask(space, Question::Writer(writer_id), now);
    }

    /// Asks which calls a space has, unless that is or was done.
    pub(crate) fn want_calls(&mut self, space: u16, now: Duration) {
        self.ask(space, Question::Calls, now);
    }

    /// Asks who there is.
    pub(crate) fn want_all(&mut self) {
        self.asked_all.get_or_insert(0);
    }

    fn ask(&mut self, space: u16, question: Question, now: Duration) {
        if self.wanted.len() < MOST {
            self.wanted.entry((space, question)).or_insert(Wanted {
                next: now + GATHER,
                attempts: 0,
            });
        }
    }

    /// There is an answer.
    pub(crate) fn answered(&mut self, space: u16, writer_id: u16) {
        if let Some(wanted) = self.wanted.get_mut(&(space, Question::Writer(writer_id))) {
            wanted.attempts = ATTEMPTS;
        }
    }

    /// The datagram to send now, if any.
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
        let is_due = |wanted: &Wanted| wanted.attempts < ATTEMPTS && wanted.next <= now;
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
            Question::Writer(_) => Probe::DataSetMetaData(List::new(&ids)),
            Question::Calls => Probe::PubSubConnections {
                transport_profile_uris: List::null(),
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

/// The question who there is, which is for everybody.
fn all() -> Option<Vec<u8>> {
    let mut datagram = Vec::new();
    let encoded = Probe::FindApplications.encode(None, SecurityHeader::NONE, &mut datagram);
    encoded.is_ok().then_some(datagram)
}

/// How often is asked who there is: a datagram may be lost.
const ASK_ALL: u32 = 2;
/// Questions that are remembered, asked or not.
const MOST: usize = 8192;
/// DataSetWriters of one probe: as many as publishers of the bridges announce within half a second.
const TOGETHER: usize = 50;
/// What is heard meanwhile is asked for together.
const GATHER: Duration = Duration::from_millis(120);
/// Between two probes.
const PACE: Duration = Duration::from_millis(100);
/// Before asking again, and twice as long before the third time.
const WAIT: Duration = Duration::from_millis(700);
const ATTEMPTS: u32 = 3;

#[cfg(test)]
mod tests {
    use uadp::NetworkMessage;

    use super::*;

    /// The space and the DataSetWriters that are asked for; none are of a question for calls.
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
    fn what_was_answered_is_not_asked_again() {
        let mut prober = Prober::default();
        prober.want(0, 101, Duration::ZERO);
        let probe = prober.poll(GATHER).unwrap();
        assert_eq!(read(&probe), (Some(PublisherId::UInt16(0)), vec![101]));
        prober.answered(0, 101);
        prober.want(0, 101, GATHER);
        assert_eq!(prober.poll(Duration::from_secs(9)), None);
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
