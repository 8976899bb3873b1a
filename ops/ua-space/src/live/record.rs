//! `ua-space record`: records the messages of a group as pcapng, or its values as MCAP.
//!
//! Reading order: this module (the loop), `packets` and `values` (the two forms), `mcap` (records
//! of the container), `sink` (the file).

mod mcap;
mod packets;
mod sink;
mod values;

use std::io::{self, IsTerminal as _, Write as _};
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use serde::Serialize;
use transport::{Received, Senders};

use self::packets::Packets;
use self::sink::RecordingFile;
use self::values::{RecordOutcome, ValueRecorder};
use super::book::{DatagramContent, NameKind};
use super::channels::{DESCRIBED_WITHIN, is_value};
use super::prober::FIRST_ASKED;
use super::text::{harmless, json};
use super::{Go, Incoming, LOOK, Live, in_group_with_own, take, until};
use crate::arguments::RecordArguments;
use crate::capture::LinkLayer;
use crate::cell::own_drops;
use crate::exit::CommandFailure;
use crate::report::warn;

/// Runs `ua-space record`.
pub(crate) fn record(arguments: &RecordArguments) -> Result<(), CommandFailure> {
    let format = Format::of(&arguments.file)?;
    if format == Format::PcapNg && !arguments.models.model.is_empty() {
        return Err(CommandFailure::Usage(
            "--model is for recordings that viewers open: name the file .mcap".to_owned(),
        ));
    }
    // The drops of the socket are reported as lost messages.
    in_group_with_own(&arguments.group, async |mut live| {
        live.want_calls(FIRST_ASKED);
        // A model that cannot be read leaves no file.
        let mut models = Vec::new();
        for source in &arguments.models.model {
            models.push(source.load().await?);
        }
        let mut recording = Recording::new(format, &arguments.file, &live)?;
        let start = live.utc(live.now());
        if let RecordingForm::Values(values) = &mut recording.form {
            for model in &models {
                values.add_model(model, start);
            }
        }
        let ended = recording.run(&mut live, arguments).await;
        let now = live.now();
        let time = live.utc(now);
        let totals = recording.totals(now);
        let finished = recording.finish(time);
        ended?;
        let size = finished?;
        if totals.messages == 0 {
            return Err(nothing(&live, &arguments.file));
        }
        totals.print(size, arguments)
    })
}

/// Removes the empty recording and returns the failure.
fn nothing(live: &Live, file: &Path) -> CommandFailure {
    // The file has no messages, so nothing is lost with it or left with it.
    let _removed = std::fs::remove_file(file);
    if let Some(why) = live.carrier.lost() {
        return CommandFailure::Unavailable(why);
    }
    let group = live.group();
    CommandFailure::Unavailable(format!(
        "nothing was recorded from {group}\n  = help: is this the group and the interface (--address, --interface)?"
    ))
}

/// The form of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    PcapNg,
    Mcap,
}

impl Format {
    /// Returns the form by the ending of the file.
    fn of(file: &Path) -> Result<Self, CommandFailure> {
        let ending = file.extension().and_then(|ending| ending.to_str());
        match ending.map(str::to_ascii_lowercase).as_deref() {
            Some("pcapng") => Ok(Self::PcapNg),
            Some("mcap") => Ok(Self::Mcap),
            _ => Err(CommandFailure::Usage(format!(
                "{}: the name ends with .pcapng (all messages) or .mcap (values)",
                file.display()
            ))),
        }
    }
}

/// A recording in progress.
struct Recording {
    form: RecordingForm,
    /// Messages or values in the recording.
    messages: u64,
    /// Bytes of the received messages.
    bytes: u64,
    /// Messages dropped because the disk was too slow.
    slow: u64,
    /// The drops of the kernel before the recording.
    drops_before: u64,
    /// Whether further messages only describe the values in the recording.
    is_over: bool,
}

enum RecordingForm {
    Packets(Box<Packets>),
    Values(Box<ValueRecorder>),
}

impl Recording {
    fn new(format: Format, file: &Path, live: &Live) -> Result<Self, CommandFailure> {
        let sink = RecordingFile::create(file)?;
        let form = match format {
            Format::PcapNg => {
                let link = link(live);
                RecordingForm::Packets(Box::new(Packets::new(
                    sink,
                    link,
                    &live.carrier.interface(),
                )))
            }
            Format::Mcap => RecordingForm::Values(Box::new(ValueRecorder::new(sink))),
        };
        Ok(Self {
            form,
            messages: 0,
            bytes: 0,
            slow: 0,
            drops_before: own_drops(),
            is_over: false,
        })
    }

    /// Records until the end that the arguments name, or a signal.
    async fn run(
        &mut self,
        live: &mut Live,
        arguments: &RecordArguments,
    ) -> Result<(), CommandFailure> {
        let end = until(live.now(), arguments.seconds);
        let most_bytes = arguments.size.map_or(u64::MAX, |mib| mib << 20);
        let most = arguments.count.unwrap_or(u64::MAX);
        let (mut looked, mut flushed) = (Duration::ZERO, Duration::ZERO);
        loop {
            let now = live.now();
            if now >= looked {
                looked = now + LOOK;
                live.probe(now);
            }
            if now >= flushed {
                flushed = now + FLUSH;
                self.flush(now)?;
            }
            if now >= end || self.messages >= most || self.bytes >= most_bytes {
                return self.await_descriptions(live).await;
            }
            match live.receive(end.min(now + LOOK)).await? {
                Incoming::Interrupted => return Ok(()),
                Incoming::Nothing => {}
                Incoming::Message(received) => self.add(live, &received)?,
            }
        }
    }

    /// Waits for the descriptions of recorded values: a short recording ends before their writers
    /// have responded.
    async fn await_descriptions(&mut self, live: &mut Live) -> Result<(), CommandFailure> {
        self.is_over = true;
        let end = live.now() + DESCRIBED_WITHIN;
        while self.awaits_descriptions() && live.now() < end {
            match live.receive(end).await? {
                Incoming::Interrupted => return Ok(()),
                Incoming::Nothing => {}
                Incoming::Message(received) => self.add(live, &received)?,
            }
        }
        Ok(())
    }

    fn awaits_descriptions(&self) -> bool {
        match &self.form {
            RecordingForm::Packets(_) => false,
            RecordingForm::Values(values) => values.is_waiting(),
        }
    }

    /// Adds the message in the buffer. Own probes are no part of the cell.
    fn add(&mut self, live: &mut Live, received: &Received) -> Result<(), CommandFailure> {
        let Received { length, from, .. } = *received;
        if live.is_own(from) {
            return Ok(());
        }
        let now = live.arrived(received);
        let time = live.utc(now);
        let datagram = live.buffer.get(..length).unwrap_or_default();
        let read = (&mut live.book, live.sealing.as_mut());
        let is_over = self.is_over;
        if !is_over {
            self.bytes += u64::try_from(length).unwrap_or_default();
        }
        let (mut added, mut dropped) = (0, 0);
        let mut fault = None;
        match &mut self.form {
            RecordingForm::Packets(packets) => {
                match packets.add(time, from, datagram)? {
                    true => added += 1,
                    false => dropped += 1,
                }
                take(read, (datagram, from), now, &mut |_, _| Go::On);
            }
            RecordingForm::Values(values) => {
                let mut each = |news: DatagramContent<'_>, now| {
                    let recorded = match &news {
                        DatagramContent::Sample(sample)
                            if !is_over && is_value(&sample.message) =>
                        {
                            values.add(sample, (now, time))
                        }
                        DatagramContent::Announced {
                            topic,
                            kind: NameKind::Value,
                            described,
                            announcement,
                            ..
                        } => {
                            values.described((*topic, announcement), described, now);
                            return Go::On;
                        }
                        DatagramContent::Sample(_)
                        | DatagramContent::Announced { .. }
                        | DatagramContent::Response(..) => {
                            return Go::On;
                        }
                    };
                    match recorded {
                        Ok(RecordOutcome::Value) => added += 1,
                        Ok(RecordOutcome::Copy) => {}
                        Ok(RecordOutcome::Dropped) => dropped += 1,
                        Err(failure) => fault = Some(failure),
                    }
                    Go::On
                };
                take(read, (datagram, from), now, &mut each);
            }
        }
        self.messages += added;
        self.slow += dropped;
        fault.map_or(Ok(()), Err)
    }

    /// Hands over the messages so far, and shows the progress on a terminal.
    fn flush(&mut self, now: Duration) -> Result<(), CommandFailure> {
        match &mut self.form {
            RecordingForm::Packets(packets) => packets.flush()?,
            RecordingForm::Values(values) => {
                values.give_up_waiting(now);
                values.flush()?;
            }
        }
        let mut err = io::stderr().lock();
        if err.is_terminal() {
            let (messages, seconds) = (self.messages, now.as_secs());
            // A terminal that is closed does not end the recording.
            let _shown = write!(err, "\r{messages} messages in {seconds} s");
            let _flushed = err.flush();
        }
        Ok(())
    }

    fn totals(&self, now: Duration) -> Totals {
        Totals {
            messages: self.messages,
            seconds: now.as_secs_f64(),
            slow_disk: self.slow,
            full_socket: own_drops().saturating_sub(self.drops_before),
        }
    }

    /// Ends the file. Returns its length.
    fn finish(self, time: i128) -> Result<u64, CommandFailure> {
        let dropped = self.slow + own_drops().saturating_sub(self.drops_before);
        match self.form {
            RecordingForm::Packets(packets) => packets.finish(time, (self.messages, dropped)),
            RecordingForm::Values(values) => values.finish(),
        }
    }
}

/// Returns the form of the packets of a group or broker.
fn link(live: &Live) -> LinkLayer {
    match (live.carrier.senders(), live.group().parse()) {
        (Senders::Addresses, Ok(SocketAddr::V4(group))) => LinkLayer::Udp(group),
        _ => LinkLayer::Exported,
    }
}

/// The summary of a recording.
#[derive(Debug, Serialize)]
struct Totals {
    messages: u64,
    seconds: f64,
    /// Messages dropped because the disk was too slow.
    slow_disk: u64,
    /// Messages that the kernel dropped because this program was too slow.
    full_socket: u64,
}

impl Totals {
    fn print(&self, size: u64, arguments: &RecordArguments) -> Result<(), CommandFailure> {
        #[derive(Serialize)]
        struct RecordSummary<'a> {
            file: String,
            bytes: u64,
            #[serde(flatten)]
            totals: &'a Totals,
        }
        let file = harmless(&arguments.file.display().to_string());
        let mut out = io::stdout().lock();
        if arguments.json {
            let shown = RecordSummary {
                file,
                bytes: size,
                totals: self,
            };
            writeln!(out, "{}", json(&shown)?)?;
            return Ok(());
        }
        if io::stderr().is_terminal() {
            // The line of the progress ends here.
            writeln!(io::stderr())?;
        }
        let (messages, seconds) = (self.messages, self.seconds);
        writeln!(
            out,
            "{file}: {messages} messages in {seconds:.1} s, {size} bytes"
        )?;
        for (count, why) in [
            (self.slow_disk, "the disk was too slow"),
            (self.full_socket, "the socket was full"),
        ] {
            if count > 0 {
                warn(&format!("{count} messages dropped: {why}"));
            }
        }
        Ok(())
    }
}

/// The interval at which the messages so far are handed over to the disk.
const FLUSH: Duration = Duration::from_secs(1);
