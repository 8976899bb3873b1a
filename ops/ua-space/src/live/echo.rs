//! `ua-space echo` and `ua-space hz`: shows the values of a topic, and measures their rate.

use std::collections::VecDeque;
use std::io::{self, Write as _};
use std::time::Duration;

use mappings::TopicId;
use serde::Serialize;
use uadp::{DecodeError, MessageKind};

use super::book::{DatagramContent, NameKind, ReceivedSample};
use super::described::AnnouncedDescription;
use super::list::unheard;
use super::names::unknown;
use super::plain::{self, NamedValues};
use super::received::measured;
use super::text::{harmless, json};
use super::{Go, ListenEnd, Live, in_group, until};
use crate::arguments::{EchoArguments, Hz};
use crate::exit::CommandFailure;
use crate::iso_time;
use crate::report::warn;

/// Runs `ua-space echo`.
pub(crate) fn echo(arguments: &EchoArguments) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        let end = until(live.now(), arguments.seconds);
        let (topic, early) = found(&mut live, arguments, end).await?;
        let mut echo = Printing {
            arguments,
            topic,
            shown: 0,
            waiting: Some(VecDeque::new()),
            left_out: 0,
            unread: None,
        };
        echo.take_early(early);
        // The names of the fields may arrive shortly after the first value.
        let named = until(live.now(), Some(NAMED_WITHIN));
        let mut ended = echo.listen(&mut live, named.min(end)).await?;
        echo.print_waiting(live.book.described(topic).map(AsRef::as_ref))?;
        if ended == ListenEnd::Time && named < end && !echo.is_enough() {
            ended = echo.listen(&mut live, end).await?;
        }
        live.tell_dropped();
        match (echo.shown, ended) {
            (0, ListenEnd::Time) => Err(echo.nothing(&live)),
            (_, ListenEnd::Time | ListenEnd::Enough | ListenEnd::Interrupted) => Ok(()),
        }
    })
}

/// Returns the topic, and its values that came before the topic of a name was known.
async fn found(
    live: &mut Live,
    arguments: &EchoArguments,
    end: Duration,
) -> Result<(TopicId, Vec<Raw>), CommandFailure> {
    let mut early: VecDeque<(TopicId, Raw)> = VecDeque::new();
    let mut each = |news: DatagramContent<'_>, _| {
        if let DatagramContent::Sample(sample) = news
            && let Ok(Some(raw)) = Raw::of(&sample)
        {
            if early.len() >= MOST_EARLY {
                early.pop_front();
            }
            early.push_back((sample.topic, raw));
        }
        Go::On
    };
    let target = (&arguments.target, Some(NameKind::Value));
    let Some(topic) = live.resolve(target, end, &mut each).await? else {
        let seconds = arguments.seconds.unwrap_or_default();
        return Err(unknown(live, &arguments.target, seconds));
    };
    let early = early.into_iter().filter(|(of, _)| *of == topic);
    Ok((topic, early.map(|(_, raw)| raw).collect()))
}

struct Printing<'a> {
    arguments: &'a EchoArguments,
    topic: TopicId,
    shown: u64,
    /// Values that wait for names; `None` once waiting has ended.
    waiting: Option<VecDeque<Raw>>,
    left_out: u64,
    /// The reason why a value could not be shown.
    unread: Option<String>,
}

/// A received value, to be shown when the names are known.
struct Raw {
    /// The announced name of the topic.
    name: Option<String>,
    shown: NamedValues,
    has_names: bool,
    at: Option<String>,
    kind: MessageKind,
}

fn first_name(described: &AnnouncedDescription) -> Option<String> {
    described.names().next().map(str::to_owned)
}

impl Raw {
    /// Reads a message; `None` for a keep-alive message.
    ///
    /// # Errors
    /// [`DecodeError`] if its values cannot be read.
    fn of(sample: &ReceivedSample<'_>) -> Result<Option<Self>, DecodeError> {
        if sample.message.kind == MessageKind::KeepAlive {
            return Ok(None);
        }
        let described = sample.described.as_deref();
        let shown = plain::message(&sample.message, described)?;
        let time = sample.message.header().timestamp;
        let time = time.or(sample.network.timestamp);
        Ok(Some(Self {
            name: described.and_then(first_name),
            shown,
            has_names: described.is_some(),
            at: time.map(iso_time::of_date_time),
            kind: sample.message.kind,
        }))
    }
}

#[derive(Serialize)]
struct EchoJson<'a> {
    topic: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    time: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    kind: Option<&'static str>,
    value: &'a NamedValues,
}

impl Printing<'_> {
    /// Queues values that came before the topic of the name was known.
    fn take_early(&mut self, early: Vec<Raw>) {
        if let Some(waiting) = &mut self.waiting {
            waiting.extend(early);
        }
    }

    async fn listen(
        &mut self,
        live: &mut Live,
        end: Duration,
    ) -> Result<ListenEnd, CommandFailure> {
        if self.is_enough() && self.waiting.is_none() {
            return Ok(ListenEnd::Enough);
        }
        let mut fault = None;
        let mut each = |news: DatagramContent<'_>, _| {
            let DatagramContent::Sample(sample) = news else {
                return Go::On;
            };
            if sample.topic != self.topic {
                return Go::On;
            }
            match self.take(&sample) {
                Ok(go) => go,
                Err(failure) => {
                    fault = Some(failure);
                    Go::Enough
                }
            }
        };
        let ended = live.listen(end, &mut each).await?;
        fault.map_or(Ok(ended), Err)
    }

    fn is_enough(&self) -> bool {
        let waiting = self.waiting.as_ref().map_or(0, VecDeque::len);
        let waiting = u64::try_from(waiting).unwrap_or(u64::MAX);
        let most = self.arguments.count;
        most.is_some_and(|most| self.shown.saturating_add(waiting) >= most)
    }

    fn take(&mut self, sample: &ReceivedSample<'_>) -> Result<Go, CommandFailure> {
        let described = sample.described.as_deref();
        let raw = match Raw::of(sample) {
            Ok(Some(raw)) => raw,
            Ok(None) => return Ok(Go::On),
            Err(error) => {
                if self.unread.is_none() {
                    warn(&format!("{}: {error}", sample.topic));
                }
                self.unread = Some(error.to_string());
                return Ok(Go::On);
            }
        };
        match &mut self.waiting {
            Some(waiting) if !raw.has_names && waiting.len() < MOST_WAITING => {
                waiting.push_back(raw);
            }
            Some(waiting) if !raw.has_names => {
                waiting.pop_front();
                self.left_out += 1;
                waiting.push_back(raw);
            }
            Some(_) => {
                self.print_waiting(described)?;
                if !self.is_enough() {
                    self.print(&raw)?;
                }
            }
            None => self.print(&raw)?,
        }
        let printed = self.waiting.is_none() && self.is_enough();
        Ok(if printed { Go::Enough } else { Go::On })
    }

    /// Shows the waiting values by name, or by number if the names are unknown.
    fn print_waiting(
        &mut self,
        described: Option<&AnnouncedDescription>,
    ) -> Result<(), CommandFailure> {
        let waiting = self.waiting.take().unwrap_or_default();
        for mut raw in waiting {
            if let Some(described) = described {
                raw.shown.rename(described.fields());
                raw.name = first_name(described);
            }
            if !self.is_enough() {
                self.print(&raw)?;
            }
        }
        if self.left_out > 0 {
            warn(&format!(
                "{} values came before their names and are left out",
                self.left_out
            ));
        }
        Ok(())
    }

    fn print(&mut self, raw: &Raw) -> Result<(), CommandFailure> {
        self.shown += 1;
        let mut out = io::stdout().lock();
        let kind = match raw.kind {
            MessageKind::DeltaFrame => Some("delta"),
            MessageKind::Event => Some("event"),
            MessageKind::KeyFrame | MessageKind::KeepAlive => None,
        };
        if self.arguments.json {
            let shown = EchoJson {
                topic: self.topic.to_string(),
                name: raw.name.as_deref(),
                time: raw.at.as_deref(),
                kind,
                value: &raw.shown,
            };
            writeln!(out, "{}", json(&shown)?)?;
        } else {
            let at = raw.at.as_deref().unwrap_or("without a time");
            let kind = kind.map(|kind| format!(", {kind}")).unwrap_or_default();
            let name = raw.name.as_deref().map(|name| format!(", {name}"));
            let name = harmless(&name.unwrap_or_default());
            write!(out, "--- # {at}{kind}{name}\n{}", raw.shown.yaml())?;
        }
        out.flush()?;
        Ok(())
    }

    fn nothing(&self, live: &Live) -> CommandFailure {
        let topic = self.topic;
        let secured = live.book.heard(topic).is_some_and(|heard| heard.secured);
        match &self.unread {
            Some(why) => {
                CommandFailure::Data(format!("{topic}: nothing that came can be read: {why}"))
            }
            None if secured => CommandFailure::Data(format!(
                "{topic} is secured, and cannot be read without its keys: give them with --keys FILE"
            )),
            None => unheard(live, topic, self.arguments.seconds.unwrap_or_default()),
        }
    }
}

/// Runs `ua-space hz`.
pub(crate) fn hz(arguments: &Hz) -> Result<(), CommandFailure> {
    measured(arguments, |received| {
        let newest = received.newest.iter();
        let times: VecDeque<Duration> = newest.map(|(at, _)| *at).collect();
        match Rhythm::of(&times, received.all) {
            Some(rhythm) => rhythm.print(arguments).map(|()| true),
            None => Ok(false),
        }
    })
}

/// The rate of values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Rhythm {
    rate_hz: f64,
    min_s: f64,
    max_s: f64,
    std_dev_s: f64,
    /// Number of intervals in the statistics.
    window: usize,
    /// Number of all received values.
    values: u64,
}

impl Rhythm {
    #[expect(clippy::cast_precision_loss, reason = "figures shown to people")]
    fn of(times: &VecDeque<Duration>, values: u64) -> Option<Self> {
        let gaps = times.iter().zip(times.iter().skip(1));
        let gaps: Vec<f64> = gaps
            .map(|(one, next)| next.saturating_sub(*one).as_secs_f64())
            .collect();
        let count = gaps.len();
        let sum: f64 = gaps.iter().sum();
        if count == 0 || sum <= 0.0 {
            return None;
        }
        let mean = sum / count as f64;
        let variance = gaps.iter().map(|gap| (gap - mean).powi(2)).sum::<f64>() / count as f64;
        Some(Self {
            rate_hz: 1.0 / mean,
            min_s: gaps.iter().copied().fold(f64::INFINITY, f64::min),
            max_s: gaps.iter().copied().fold(0.0, f64::max),
            std_dev_s: variance.sqrt(),
            window: count,
            values,
        })
    }

    fn print(&self, arguments: &Hz) -> Result<(), CommandFailure> {
        let mut out = io::stdout().lock();
        if arguments.json {
            writeln!(out, "{}", json(self)?)?;
        } else {
            let Self {
                rate_hz,
                min_s,
                max_s,
                std_dev_s,
                window,
                ..
            } = self;
            writeln!(out, "average rate: {rate_hz:.3}")?;
            writeln!(
                out,
                "\tmin: {min_s:.4}s max: {max_s:.4}s std dev: {std_dev_s:.5}s window: {window}"
            )?;
        }
        out.flush()?;
        Ok(())
    }
}

/// Time that values wait for their names, in seconds.
const NAMED_WITHIN: f64 = 1.2;
/// Maximum number of values that are stored while the topic of a name is not known.
const MOST_EARLY: usize = 1024;
/// Maximum number of waiting values.
const MOST_WAITING: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_that_of_the_gaps_between_values() {
        let times = [0, 100, 200, 320].map(Duration::from_millis).into();
        let rhythm = Rhythm::of(&times, 4).unwrap();
        assert!((rhythm.rate_hz - 9.375).abs() < 1e-9, "{rhythm:?}");
        assert!((rhythm.min_s - 0.1).abs() < 1e-9 && (rhythm.max_s - 0.12).abs() < 1e-9);
        assert_eq!((rhythm.window, rhythm.values), (3, 4));
        assert_eq!(Rhythm::of(&[Duration::ZERO].into(), 1), None);
    }
}
