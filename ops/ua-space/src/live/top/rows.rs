//! The figures of `ua-space top`: rates, delays and drops per topic, their order and filter.

use std::cmp::Ordering;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use clap::ValueEnum;
use mappings::TopicId;
use supervisor::is_intended_drop;
use uadp::MessageKind;

use super::super::book::DatagramContent;
use super::super::list::quality_name;
use super::super::text::{age, harmless, micros};
use super::super::{Live, utc};
use crate::cell::StatusPage;

/// The order of the rows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Sort {
    /// By topic
    #[default]
    Topic,
    /// By name
    Name,
    /// Fastest first
    Rate,
    /// Most dropped samples first
    Drops,
    /// Longest delay first
    Delay,
    /// Longest silent first
    Age,
}

impl Sort {
    pub(super) fn next(self) -> Self {
        self.moved(1)
    }

    pub(super) fn previous(self) -> Self {
        self.moved(Self::value_variants().len() - 1)
    }

    fn moved(self, by: usize) -> Self {
        let all = Self::value_variants();
        let at = all.iter().position(|one| *one == self).unwrap_or_default();
        all.get((at + by) % all.len()).copied().unwrap_or_default()
    }

    /// Returns the word for the screen.
    pub(super) const fn word(self) -> &'static str {
        match self {
            Self::Topic => "topic",
            Self::Name => "name",
            Self::Rate => "rate",
            Self::Drops => "drops",
            Self::Delay => "delay",
            Self::Age => "age",
        }
    }
}

/// The counts of all topics between two ticks, and the rates at the last tick.
#[derive(Default)]
pub(super) struct Figures {
    topics: BTreeMap<TopicId, Counting>,
    ticked: Duration,
}

#[derive(Default)]
struct Counting {
    /// Values since the last tick.
    values: u32,
    /// Values per second, of the last ticks.
    rates: VecDeque<f64>,
    /// The last delays from sending to arrival, in nanoseconds.
    delays: VecDeque<i128>,
}

impl Figures {
    /// Counts a value that arrived at `now` after `start`, which is in nanoseconds since 1970.
    pub(super) fn take(&mut self, news: &DatagramContent<'_>, (start, now): (i128, Duration)) {
        let DatagramContent::Sample(sample) = news else {
            return;
        };
        let is_known = self.topics.contains_key(&sample.topic);
        let is_value = sample.message.kind != MessageKind::KeepAlive;
        if !is_value || (!is_known && self.topics.len() >= MOST_TOPICS) {
            return;
        }
        let counting = self.topics.entry(sample.topic).or_default();
        counting.values = counting.values.saturating_add(1);
        if let Some(sent) = sample.sent() {
            push(&mut counting.delays, utc(start, now) - sent, MOST_DELAYS);
        }
    }

    /// Computes the rates since the previous tick.
    pub(super) fn tick(&mut self, now: Duration) {
        let span = now.saturating_sub(self.ticked).as_secs_f64();
        self.ticked = now;
        if span <= 0.0 {
            return;
        }
        for counting in self.topics.values_mut() {
            let values = std::mem::take(&mut counting.values);
            push(&mut counting.rates, f64::from(values) / span, MOST_RATES);
        }
    }

    fn rate(&self, topic: TopicId) -> Option<f64> {
        let rates = &self.topics.get(&topic)?.rates;
        let count = u32::try_from(rates.len()).ok().filter(|count| *count > 0)?;
        Some(rates.iter().sum::<f64>() / f64::from(count))
    }

    /// Returns the median delay in microseconds.
    #[expect(clippy::cast_precision_loss, reason = "a delay shown to people")]
    fn delay(&self, topic: TopicId) -> Option<f64> {
        let delays = &self.topics.get(&topic)?.delays;
        let mut sorted: Vec<i128> = delays.iter().copied().collect();
        sorted.sort_unstable();
        let middle = sorted.get(sorted.len() / 2)?;
        Some(*middle as f64 / 1_000.0)
    }
}

fn push<T>(queue: &mut VecDeque<T>, one: T, most: usize) {
    if queue.len() >= most {
        queue.pop_front();
    }
    queue.push_back(one);
}

/// A row of the screen.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct TopRow {
    pub(super) topic: String,
    pub(super) name: String,
    pub(super) rate: Option<f64>,
    pub(super) age: Option<Duration>,
    pub(super) delay_us: Option<f64>,
    /// Samples that programs of this host dropped, by reason.
    pub(super) drops: BTreeMap<String, u64>,
    pub(super) quality: String,
    pub(super) type_name: String,
}

impl TopRow {
    /// Returns the texts of the columns.
    pub(super) fn cells(&self) -> [String; 8] {
        let dash = || "-".to_owned();
        let delay = self.delay_us.map_or_else(dash, |us| match us < 0.0 {
            true => format!("-{}", micros(-us)),
            false => micros(us),
        });
        [
            self.topic.clone(),
            harmless(&self.name),
            self.rate.map_or_else(dash, |rate| format!("{rate:.1}")),
            self.age.map_or_else(dash, age),
            delay,
            harmless(&self.drop_text()),
            self.quality.clone(),
            harmless(&self.type_name),
        ]
    }

    fn dropped(&self) -> u64 {
        self.drops.values().sum()
    }

    /// Returns the number of dropped samples, and the reason of most of them.
    fn drop_text(&self) -> String {
        let most = self.drops.iter().max_by_key(|(_, count)| **count);
        match most {
            None => "-".to_owned(),
            Some((reason, _)) => format!("{} {reason}", self.dropped()),
        }
    }
}

/// Returns the sums of all rows.
pub(super) fn summary(rows: &[TopRow]) -> String {
    let rate: f64 = rows.iter().filter_map(|row| row.rate).sum();
    let drops: u64 = rows.iter().map(TopRow::dropped).sum();
    format!("{} topics, {rate:.1} values/s, {drops} dropped", rows.len())
}

/// The order, the filter and the position of the screen.
pub(super) struct TopView {
    pub(super) sort: Sort,
    pub(super) is_reversed: bool,
    pub(super) filter: String,
    pub(super) is_typing: bool,
    /// The index of the first row on the screen.
    pub(super) first: usize,
    pub(super) is_over: bool,
}

impl TopView {
    pub(super) const fn new(sort: Sort, filter: String) -> Self {
        Self {
            sort,
            is_reversed: false,
            filter,
            is_typing: false,
            first: 0,
            is_over: false,
        }
    }

    /// Returns the rows in their order, as far as they match the filter.
    pub(super) fn rows(
        &mut self,
        figures: &Figures,
        (live, now): (&Live, Duration),
        pages: &[StatusPage],
    ) -> Vec<TopRow> {
        let mut drops: BTreeMap<&str, BTreeMap<String, u64>> = BTreeMap::new();
        for (topic, of) in pages.iter().flat_map(|page| &page.topics) {
            let all = drops.entry(topic).or_default();
            let lost = |(reason, count): &(&String, &u64)| **count > 0 && !is_intended_drop(reason);
            for (reason, count) in of.dropped.iter().filter(lost) {
                *all.entry(reason.clone()).or_default() += count;
            }
        }
        let rows = live.book.topics().map(|(topic, heard)| {
            let described = live.book.described(topic);
            let text = topic.to_string();
            let quality = match heard.secured {
                true => "secured".to_owned(),
                false => quality_name(heard.quality),
            };
            TopRow {
                drops: drops.remove(text.as_str()).unwrap_or_default(),
                topic: text,
                name: live.name_of(topic).unwrap_or_else(|| "-".to_owned()),
                rate: figures.rate(topic),
                age: Some(now.saturating_sub(heard.last)),
                delay_us: figures.delay(topic),
                quality,
                type_name: described.map_or_else(|| "-".to_owned(), |one| one.summary()),
            }
        });
        let rows = rows.collect();
        self.ordered(rows)
    }

    pub(super) fn ordered(&mut self, mut rows: Vec<TopRow>) -> Vec<TopRow> {
        let filter = self.filter.to_lowercase();
        rows.retain(|row| {
            let texts = [&row.topic, &row.name, &row.quality, &row.type_name];
            texts
                .iter()
                .any(|text| text.to_lowercase().contains(&filter))
        });
        rows.sort_by(|a, b| {
            let order = self.compare(a, b);
            if self.is_reversed {
                order.reverse()
            } else {
                order
            }
        });
        self.first = self.first.min(rows.len().saturating_sub(1));
        rows
    }

    fn compare(&self, a: &TopRow, b: &TopRow) -> Ordering {
        let most = |a: Option<f64>, b: Option<f64>| {
            let value = |of: Option<f64>| of.unwrap_or(f64::NEG_INFINITY);
            value(b).total_cmp(&value(a))
        };
        match self.sort {
            // Topics of a space come together in the order of their numbers.
            Sort::Topic => Ordering::Equal,
            Sort::Name => a.name.cmp(&b.name),
            Sort::Rate => most(a.rate, b.rate),
            Sort::Drops => b.dropped().cmp(&a.dropped()),
            Sort::Delay => most(a.delay_us, b.delay_us),
            Sort::Age => b.age.cmp(&a.age),
        }
        .then_with(|| number(&a.topic).cmp(&number(&b.topic)))
    }
}

fn number(topic: &str) -> Option<TopicId> {
    topic.parse().ok()
}

const MOST_TOPICS: usize = 4096;
const MOST_DELAYS: usize = 128;
/// The number of ticks of a rate.
const MOST_RATES: usize = 3;

#[cfg(test)]
mod tests {
    use super::*;

    fn row(topic: &str, name: &str, rate: f64) -> TopRow {
        TopRow {
            topic: topic.to_owned(),
            name: name.to_owned(),
            rate: Some(rate),
            ..TopRow::default()
        }
    }

    #[test]
    fn rows_are_sorted_filtered_and_reversed() {
        let rows = || {
            vec![
                row("ua_1_2_10", "Speed", 5.0),
                row("ua_1_2_9", "Area", 50.0),
                row("ua_2_2_1", "Speed2", 1.0),
            ]
        };
        let order = |view: &mut TopView| -> Vec<String> {
            let rows = view.ordered(rows());
            rows.into_iter().map(|row| row.topic).collect()
        };
        let mut view = TopView::new(Sort::Topic, String::new());
        assert_eq!(order(&mut view), ["ua_1_2_9", "ua_1_2_10", "ua_2_2_1"]);
        view.sort = Sort::Rate;
        view.is_reversed = true;
        assert_eq!(order(&mut view), ["ua_2_2_1", "ua_1_2_10", "ua_1_2_9"]);
        view.filter = "speed".to_owned();
        view.first = 9;
        assert_eq!(order(&mut view), ["ua_2_2_1", "ua_1_2_10"]);
        assert_eq!(view.first, 1);
    }

    #[test]
    fn drops_name_their_main_reason() {
        let mut one = row("ua_1_2_10", "Speed", 5.0);
        assert_eq!(one.drop_text(), "-");
        one.drops = [("full", 2), ("mismatch", 7)]
            .map(|(reason, count)| (reason.to_owned(), count))
            .into();
        assert_eq!(one.drop_text(), "9 mismatch");
        assert_eq!(summary(&[one]), "1 topics, 5.0 values/s, 9 dropped");
    }
}
