//! The contents of a group as facts, for other commands.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;

use mappings::TopicId;
use serde::Serialize;

use super::book::{DatagramContent, NameKind};
use super::list::quality_name;
use super::{AnnouncedProgram, Go, Live, until, utc};
use crate::arguments::GroupArguments;
use crate::exit::CommandFailure;

/// The contents of a group after some time of listening.
pub(crate) struct Listened {
    pub(crate) group: String,
    /// The announced applications, by space and address.
    pub(crate) applications: BTreeMap<(u16, String), AnnouncedProgram>,
    pub(crate) topics: Vec<TopicSeen>,
    pub(crate) senders: Vec<SenderTiming>,
    /// Messages that were discarded, by reason.
    pub(crate) dropped: BTreeMap<String, u64>,
}

/// A received topic.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct TopicSeen {
    pub(crate) topic: String,
    pub(crate) name: Option<String>,
    /// The announced types; several if senders disagree.
    pub(crate) types: Vec<String>,
    pub(crate) sender: String,
    /// Number of changes of the sender.
    pub(crate) sender_changed: u64,
    pub(crate) values: u64,
    pub(crate) quality: String,
    pub(crate) secured: bool,
}

/// The delay of messages from a sender.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub(crate) struct SenderTiming {
    pub(crate) from: String,
    /// The shortest time from sending to arrival, in microseconds. A negative time, or a long time
    /// of all messages, shows that the clocks differ.
    pub(crate) shortest_delay_us: i64,
}

/// Listens in a group for `seconds`.
///
/// # Errors
/// The group or its interface is not available.
pub(crate) async fn listened(
    group: &GroupArguments,
    seconds: f64,
) -> Result<Listened, CommandFailure> {
    let mut live = Live::join(group)?;
    live.want_all();
    live.want_calls(super::prober::FIRST_ASKED);
    let end = until(live.now(), Some(seconds));
    let start = live.start_utc();
    let mut senders: BTreeMap<SocketAddr, i128> = BTreeMap::new();
    let mut each = |news: DatagramContent<'_>, now: std::time::Duration| {
        if let DatagramContent::Sample(sample) = &news
            && let Some(sent) = sample.sent()
            && (senders.len() < MOST_SENDERS || senders.contains_key(&sample.from))
        {
            let delay = utc(start, now) - sent;
            let shortest = senders.entry(sample.from).or_insert(delay);
            *shortest = (*shortest).min(delay);
        }
        Go::On
    };
    live.listen(end, &mut each).await?;
    let timing = |(from, nanos): (SocketAddr, i128)| SenderTiming {
        from: from.to_string(),
        shortest_delay_us: i64::try_from(nanos / 1_000).unwrap_or(i64::MAX),
    };
    let dropped = live.book.dropped();
    let dropped = dropped.map(|(reason, count)| (reason.label().to_owned(), count));
    Ok(Listened {
        group: live.group().to_owned(),
        applications: live.who().applications,
        topics: topics(&live),
        senders: senders.into_iter().map(timing).collect(),
        dropped: dropped.collect(),
    })
}

fn topics(live: &Live) -> Vec<TopicSeen> {
    let mut types: BTreeMap<TopicId, BTreeSet<String>> = BTreeMap::new();
    for (topic, kind, described, _) in live.book.all_announced() {
        if kind == NameKind::Value {
            types.entry(topic).or_default().insert(described.summary());
        }
    }
    let topics = live.book.topics().map(|(topic, heard)| TopicSeen {
        topic: topic.to_string(),
        name: live.name_of(topic),
        types: types.remove(&topic).into_iter().flatten().collect(),
        sender: heard.from.to_string(),
        sender_changed: heard.changed_hands,
        values: heard.values,
        quality: quality_name(heard.quality),
        secured: heard.secured,
    });
    topics.collect()
}

const MOST_SENDERS: usize = 1024;
