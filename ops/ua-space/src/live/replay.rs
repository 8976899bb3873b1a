//! `ua-space replay`: sends a recording into a group again.
//!
//! Reading order: this module (the loop), `contents` (sent and omitted messages),
//! `datagram` and `clock` (times).

mod clock;
mod contents;
mod datagram;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write as _};
use std::net::SocketAddr;
use std::time::Duration;

use mappings::TopicId;
use serde::Serialize;
use transport::{OutgoingMessage, Received, SendError, Senders};
use uadp::discovery::Probe;
use uadp::{NetworkMessage, NetworkMessageType};

use self::clock::ReplayClock;
use self::contents::{Prepared, RecordingContents, ReplayOmission, space};
use super::sealing::Sealing;
use super::text::{TextTable, harmless, is_coloured, json};
use super::{Go, Incoming, Live, in_group, until};
use crate::arguments::ReplayArguments;
use crate::exit::CommandFailure;
use crate::recorded::RecordingReader;
use crate::report::warn;

/// Runs `ua-space replay`.
pub(crate) fn replay(arguments: &ReplayArguments) -> Result<(), CommandFailure> {
    let group = &arguments.group;
    let keys = group.keys.as_deref();
    let mut sealing = keys
        .map(|keys| Sealing::read(keys, group.sign))
        .transpose()?;
    let contents = RecordingContents::read(arguments, &mut sealing)?;
    if arguments.dry_run {
        return plan(&contents);
    }
    let spaces = contents.spaces();
    if spaces.is_empty() {
        let file = arguments.file.display();
        return Err(CommandFailure::Data(format!(
            "{file} has nothing to send\n  = help: `ua-space replay --dry-run {file}` shows its topics, and why they are left out"
        )));
    }
    in_group(group, async |mut live| {
        if live.carrier.senders() != Senders::Addresses {
            let why = "a recording is sent into a UDP group: a broker would store its messages";
            return Err(CommandFailure::Usage(why.to_owned()));
        }
        if !arguments.onto_live {
            look_for_live(&mut live, &spaces).await?;
        }
        let mut replaying = Replaying::new(arguments, &contents, &live, sealing);
        let ended = replaying.run(&mut live).await;
        replaying.print(live.now(), arguments)?;
        ended
    })
}

/// Shows the topics of a recording, and what is left out.
fn plan(contents: &RecordingContents) -> Result<(), CommandFailure> {
    let columns = ["TOPIC", "NAME", "TYPE", "MESSAGES", "SENT"];
    let mut table = TextTable::new(columns.map(str::to_owned)).leaving_out([2]);
    for (topic, values, left_out) in contents.topics() {
        let described = contents.described(topic);
        let or_none = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
        let name = described.and_then(|described| described.names().next().map(str::to_owned));
        table.row([
            topic.to_string(),
            or_none(name),
            or_none(described.map(|described| described.summary())),
            values.to_string(),
            left_out.map_or_else(|| "yes".to_owned(), |why| format!("no: {}", why.label())),
        ]);
    }
    let mut out = io::stdout().lock();
    table.write(&mut out, is_coloured())?;
    warn_unusable(contents);
    Ok(())
}

/// Reports the values of an MCAP file that cannot be sent again.
fn warn_unusable(contents: &RecordingContents) {
    for (why, count) in &contents.unusable {
        warn(&format!("{count} left out: {}", why.label()));
    }
}

/// Looks for live programs of the spaces.
async fn look_for_live(live: &mut Live, spaces: &BTreeSet<u16>) -> Result<(), CommandFailure> {
    live.want_all();
    live.want_calls(spaces.iter().copied());
    let end = until(live.now(), Some(LISTEN));
    live.listen(end, &mut |_, _| Go::On).await?;
    let found = live.book.spaces();
    let Some(space) = found.intersection(spaces).next() else {
        return Ok(());
    };
    Err(CommandFailure::Failed(is_live(*space, live.group())))
}

fn is_live(space: u16, group: &str) -> String {
    format!(
        "live programs of space {space} are in {group}, and a recording of their values would mix with theirs\n  = help: stop them, choose another group with --address or other spaces with --space, or give --onto-live"
    )
}

/// A recording that is being sent.
struct Replaying<'a> {
    contents: &'a RecordingContents,
    arguments: &'a ReplayArguments,
    spaces: BTreeSet<u16>,
    sealing: Option<Sealing>,
    clock: ReplayClock,
    /// The time of the first message since the group was joined.
    begin: Duration,
    sent: u64,
    left_out: BTreeMap<ReplayOmission, u64>,
    /// Messages that the network did not take.
    unsent: u64,
    /// The times at which topics were described last.
    described: BTreeMap<TopicId, Duration>,
}

impl<'a> Replaying<'a> {
    fn new(
        arguments: &'a ReplayArguments,
        contents: &'a RecordingContents,
        live: &Live,
        sealing: Option<Sealing>,
    ) -> Self {
        let begin = live.now() + LEAD;
        Self {
            contents,
            arguments,
            spaces: contents.spaces(),
            sealing,
            clock: ReplayClock::new(contents.first, live.utc(begin), arguments.speed),
            begin,
            sent: 0,
            left_out: BTreeMap::new(),
            unsent: 0,
            described: BTreeMap::new(),
        }
    }

    async fn run(&mut self, live: &mut Live) -> Result<(), CommandFailure> {
        let contents = self.contents;
        for (topic, datagram) in contents.announcements() {
            self.described.insert(topic, live.now());
            self.send(live, (datagram, self.sealing.is_some())).await;
        }
        let mut recorded = RecordingReader::open(&self.arguments.file)?;
        while let Some(datagram) = recorded.next()? {
            let prepared = match self.contents.prepare(&datagram.bytes, &mut self.sealing) {
                Ok(prepared) => prepared,
                Err(why) => {
                    *self.left_out.entry(why).or_default() += 1;
                    continue;
                }
            };
            let Prepared {
                mut plain,
                secured,
                removed,
            } = prepared;
            for (why, count) in removed {
                *self.left_out.entry(why).or_default() += count;
            }
            if plain.is_empty() {
                continue;
            }
            let since = self.clock.at(datagram.time) - self.clock.at(self.contents.first);
            let since = Duration::from_nanos(u64::try_from(since).unwrap_or_default());
            self.wait(live, self.begin + since).await?;
            datagram::move_times(&mut plain, &self.clock);
            // A recording of values has no security; with keys its values are secured again.
            let secured = secured || recorded.has_only_values();
            if self.send(live, (&plain, secured)).await {
                self.sent += 1;
            }
        }
        Ok(())
    }

    /// Waits until a time, and handles the messages of others meanwhile.
    async fn wait(&mut self, live: &mut Live, due: Duration) -> Result<(), CommandFailure> {
        loop {
            match live.receive(due).await? {
                Incoming::Interrupted => return Err(CommandFailure::Interrupted),
                Incoming::Nothing => break,
                Incoming::Message(received) => self.take(live, received).await?,
            }
        }
        for _ in 0..MOST_AT_ONCE {
            match live.carrier.try_recv(&mut live.buffer) {
                Some(Ok(received)) => self.take(live, received).await?,
                Some(Err(_)) | None => break,
            }
        }
        Ok(())
    }

    /// Handles a message of another program: answers a probe for descriptions, and ends the replay
    /// if a program of its spaces has started.
    async fn take(
        &mut self,
        live: &mut Live,
        Received { length, from, .. }: Received,
    ) -> Result<(), CommandFailure> {
        if live.is_own(from) {
            return Ok(());
        }
        let bytes = live.buffer.get(..length).unwrap_or_default();
        let mut wanted = Vec::new();
        match NetworkMessage::decode(bytes) {
            Ok(message) if message.message_type() == NetworkMessageType::Probe => {
                wanted = self.asked(&message, live.now());
            }
            Ok(message) if !self.arguments.onto_live => self.check(&message, from, live.group())?,
            Ok(_) | Err(_) => {}
        }
        for datagram in wanted {
            self.send(live, (&datagram, self.sealing.is_some())).await;
        }
        Ok(())
    }

    /// Returns an error for a message of a live program of the spaces.
    fn check(
        &self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        group: &str,
    ) -> Result<(), CommandFailure> {
        let of_program = match message.message_type() {
            NetworkMessageType::Announcement => true,
            // Requests have the PublisherId of their executor.
            NetworkMessageType::DataSet => !message.is_action() && message.writer_ids().is_some(),
            NetworkMessageType::Probe => false,
        };
        let live = space(message).map(u16::from).filter(|_| of_program);
        match live.filter(|space| self.spaces.contains(space)) {
            None => Ok(()),
            Some(space) => Err(CommandFailure::Failed(format!(
                "stopped at a message from {from}: {}",
                is_live(space, group)
            ))),
        }
    }

    /// Returns the descriptions that a probe asks for, each at most once a second.
    fn asked(&mut self, message: &NetworkMessage<'_>, now: Duration) -> Vec<Vec<u8>> {
        let Ok(Probe::DataSetMetaData(ids)) = Probe::decode(message) else {
            return Vec::new();
        };
        let asked = space(message);
        let ids: BTreeSet<u16> = ids.iter().collect();
        let contents = self.contents;
        let mut wanted = Vec::new();
        for (topic, datagram) in contents.announcements() {
            let (_, _, id) = topic.triple();
            let last = self.described.get(&topic);
            let is_due = last.is_none_or(|last| now >= *last + DESCRIBE_AGAIN);
            if Some(topic.space) == asked && ids.contains(&id) && is_due {
                self.described.insert(topic, now);
                wanted.push(datagram.to_vec());
            }
        }
        wanted
    }

    /// Sends a message. Returns false if the network does not take it.
    async fn send(&mut self, live: &mut Live, (plain, secured): (&[u8], bool)) -> bool {
        let sealed = match (&mut live.sealing, secured) {
            (Some(sealing), true) => sealing.seal(plain).map(Some),
            _ => Ok(None),
        };
        let Ok(sealed) = sealed else {
            self.unsent += 1;
            return false;
        };
        let message = OutgoingMessage::new(sealed.as_deref().unwrap_or(plain));
        for _ in 0..MOST_ATTEMPTS {
            match live.carrier.try_send(&message) {
                Ok(()) => return true,
                // The kernel empties its buffer within a millisecond.
                Err(SendError::Busy) => tokio::time::sleep(Duration::from_millis(1)).await,
                Err(_) => break,
            }
        }
        self.unsent += 1;
        false
    }

    /// Prints the numbers of messages.
    fn print(&self, now: Duration, arguments: &ReplayArguments) -> Result<(), CommandFailure> {
        #[derive(Serialize)]
        struct ReplaySummary<'a> {
            file: &'a str,
            sent: u64,
            seconds: f64,
            unsent: u64,
            left_out: BTreeMap<&'static str, u64>,
        }
        let file = harmless(&arguments.file.display().to_string());
        let seconds = now.saturating_sub(self.begin).as_secs_f64();
        let mut out = io::stdout().lock();
        if arguments.json {
            let left_out = self.left_out.iter();
            let left_out = left_out.map(|(why, count)| (why.label(), *count));
            let unusable = self.contents.unusable.iter();
            let unusable = unusable.map(|(why, count)| (why.label(), *count));
            let shown = ReplaySummary {
                file: &file,
                sent: self.sent,
                seconds,
                unsent: self.unsent,
                left_out: left_out.chain(unusable).collect(),
            };
            writeln!(out, "{}", json(&shown)?)?;
            return Ok(());
        }
        writeln!(out, "{file}: {} messages sent in {seconds:.1} s", self.sent)?;
        for (why, count) in &self.left_out {
            warn(&format!("{count} left out: {}", why.label()));
        }
        warn_unusable(self.contents);
        if self.unsent > 0 {
            warn(&format!(
                "{} not sent: the network did not take them",
                self.unsent
            ));
        }
        Ok(())
    }
}

/// Time to listen for live programs, in seconds.
const LISTEN: f64 = 2.5;
/// Time between the descriptions and the first value, so that receivers know its type.
const LEAD: Duration = Duration::from_millis(300);
/// The interval at which a description is repeated for probes.
const DESCRIBE_AGAIN: Duration = Duration::from_secs(1);
const MOST_AT_ONCE: usize = 64;
/// Attempts to send a message while the buffer of the kernel is full.
const MOST_ATTEMPTS: usize = 500;

#[cfg(test)]
mod tests;
