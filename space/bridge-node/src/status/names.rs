//! The names of other programs that have series in `/metrics`.

use std::collections::BTreeSet;

use bridge_core::Router;
use mappings::TopicId;
use tracing::warn;

/// The names, announced by other programs, that are labels in `/metrics`.
///
/// A monitoring system stores a series for each name that it has ever read. The number of names is
/// therefore limited for the whole run of a program: a program that announces ever new names cannot
/// create series without bound. Names of the mapping and of the program itself are not limited.
#[derive(Debug, Default)]
pub(crate) struct AnnouncedNames {
    shown: BTreeSet<(TopicId, String)>,
    /// The names that did not fit at the time of the last status.
    left_out: BTreeSet<(TopicId, String)>,
    left_out_total: u64,
}

impl AnnouncedNames {
    /// Admits the announced names of all topics and calls, as long as there is room.
    pub(super) fn follow(&mut self, router: &Router) {
        let topics = router.topics().map(|(topic, _)| topic);
        let all = topics.chain(router.calls().map(|(call, _)| call));
        self.admit(all.filter_map(|topic| Some((topic, router.announced_name_of(topic)?))));
    }

    /// Admits names of topics and calls. The names that do not fit are left out and counted.
    pub(super) fn admit<'n>(&mut self, names: impl Iterator<Item = (TopicId, &'n str)>) {
        let mut left_out = BTreeSet::new();
        for (topic, name) in names {
            let named = (topic, name.to_owned());
            if self.shown.len() < MOST_NAMES {
                self.shown.insert(named);
            } else if !self.shown.contains(&named) {
                left_out.insert(named);
            }
        }
        let news = left_out.difference(&self.left_out).count();
        if news > 0 && self.left_out_total == 0 {
            warn!(
                most = MOST_NAMES,
                hint = "look for a program that keeps changing names of topics or calls",
                "too many announced names: further names are not in /metrics"
            );
        }
        self.left_out_total += u64::try_from(news).unwrap_or(u64::MAX);
        self.left_out = left_out;
    }

    /// Returns the topics and calls with names that have no series.
    pub(super) fn left_out(&self) -> BTreeSet<String> {
        let left_out = self.left_out.iter();
        left_out.map(|(topic, _)| topic.to_string()).collect()
    }

    /// Returns the number of names that were left out.
    pub(super) const fn left_out_total(&self) -> u64 {
        self.left_out_total
    }
}

/// The maximum number of announced names of topics and calls that a program shows in `/metrics`
/// from its start to its end: as many as it stores announcements at a time.
pub(super) const MOST_NAMES: usize = 8_192;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn new_names_are_left_out_and_counted_once_when_the_table_is_full() {
        let topic = |number: u16| TopicId::new(2, 1, number).unwrap();
        let mut names = AnnouncedNames::default();
        for number in 0..MOST_NAMES {
            names.admit([(topic(1), format!("Arm {number}").as_str())].into_iter());
        }
        assert_eq!(
            (names.left_out(), names.left_out_total()),
            (BTreeSet::new(), 0)
        );
        for _ in 0..2 {
            names.admit([(topic(1), "Arm 0"), (topic(2), "Gripper")].into_iter());
            assert_eq!(names.left_out(), ["ua_2_1_2".to_owned()].into());
            assert_eq!(names.left_out_total(), 1);
        }
        names.admit([(topic(1), "Arm"), (topic(2), "Gripper")].into_iter());
        assert_eq!((names.left_out().len(), names.left_out_total()), (2, 2));
        assert_eq!(names.shown.len(), MOST_NAMES);
    }
}
