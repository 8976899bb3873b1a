//! The times and sizes of the values of a topic.

use std::collections::VecDeque;
use std::time::Duration;

use uadp::MessageKind;

use super::book::{DatagramContent, NameKind};
use super::list::unheard;
use super::names::unknown;
use super::{Go, ListenEnd, in_group, until};
use crate::arguments::Hz;
use crate::exit::CommandFailure;
use crate::report::warn;

/// The received values of a topic.
#[derive(Debug, Default)]
pub(super) struct ReceivedValues {
    /// The time and the size in bytes of the newest values.
    pub(super) newest: VecDeque<(Duration, usize)>,
    /// Number of all values.
    pub(super) all: u64,
}

/// Listens to a topic. `print` prints figures about its values each second; it returns
/// `false` if there are too few values to print.
pub(super) fn measured(
    arguments: &Hz,
    print: impl Fn(&ReceivedValues) -> Result<bool, CommandFailure>,
) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        let end = until(live.now(), arguments.seconds);
        let seconds = arguments.seconds.unwrap_or_default();
        let target = (&arguments.target, Some(NameKind::Value));
        let found = live.resolve(target, end, &mut |_, _| Go::On).await?;
        let Some(topic) = found else {
            return Err(unknown(&live, &arguments.target, seconds));
        };
        let mut received = ReceivedValues::default();
        loop {
            let next = until(live.now(), Some(REPORT)).min(end);
            let mut each = |news: DatagramContent<'_>, now| {
                if let DatagramContent::Sample(sample) = news
                    && sample.topic == topic
                    && sample.message.kind != MessageKind::KeepAlive
                {
                    received.all += 1;
                    if received.newest.len() >= arguments.window {
                        received.newest.pop_front();
                    }
                    let size = sample.message.payload().len();
                    received.newest.push_back((now, size));
                }
                Go::On
            };
            let ended = live.listen(next, &mut each).await?;
            let last = ended == ListenEnd::Interrupted || live.now() >= end;
            if !print(&received)? && !arguments.json && !last {
                warn("no two values yet");
            }
            if last && received.all == 0 && ended == ListenEnd::Time {
                return Err(unheard(&live, topic, seconds));
            }
            if last {
                return Ok(());
            }
        }
    })
}

/// Interval of the printed figures, in seconds.
const REPORT: f64 = 1.0;
