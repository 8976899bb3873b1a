//! `ua-space trace --recording`: the delays between hosts whose recordings were made at the same
//! time, and the offsets of their clocks.

use std::collections::{BTreeMap, HashMap};
use std::hash::{BuildHasher as _, RandomState};
use std::io::{self, Write as _};
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use mappings::TopicId;
use serde::Serialize;
use uadp::{MessageKind, NetworkMessage};

use super::clocks::{Estimate, Twice, estimate, median};
use super::{DelayWindow, called, figures, head};
use crate::arguments::Trace;
use crate::cell::HopPage;
use crate::exit::CommandFailure;
use crate::live::book::{Book, DatagramContent};
use crate::live::text::{TextTable, is_coloured, json, micros};
use crate::recorded::RecordingReader;
use crate::report::warn;

/// Shows the delays between the hosts of the recordings.
///
/// # Errors
/// A recording cannot be read, or is the only one, or two have no message in common.
pub(super) fn trace(arguments: &Trace) -> Result<(), CommandFailure> {
    let Some((first, others)) = arguments.recording.split_first() else {
        return Ok(());
    };
    if others.is_empty() {
        return Err(CommandFailure::Usage(
            "one recording has one clock: give a --recording for each host, made at the same time"
                .to_owned(),
        ));
    }
    let keys = RandomState::new();
    let reference = Arrivals::read(first, &keys)?;
    let mut hosts: BTreeMap<IpAddr, usize> = BTreeMap::new();
    let mut clocks = vec![Clock::reference(first)];
    for (number, file) in (1..).zip(others) {
        let arrivals = Arrivals::read(file, &keys)?;
        let compared = Compared::of(&reference, &arrivals);
        let (clock, own, other) = compared.clock(first, file)?;
        hosts.entry(own).or_insert(0);
        hosts.entry(other).or_insert(number);
        clocks.push(clock);
    }
    for (clock, number) in clocks.iter_mut().zip(0..) {
        let mut own = hosts.iter().filter(|(_, host)| **host == number);
        clock.host = own.next().map(|(ip, _)| ip.to_string());
    }
    let mut delays = Delays::default();
    for (file, number) in arguments.recording.iter().zip(0..) {
        delays.read((file, number), &hosts, &clocks)?;
    }
    print(arguments, &clocks, &delays.rows(&clocks))
}

/// The times at which a host received messages.
struct Arrivals {
    /// By the hash of the sender and the bytes; `None` for a message that was received twice.
    times: HashMap<u64, (IpAddr, Option<i128>)>,
}

impl Arrivals {
    fn read(file: &Path, keys: &RandomState) -> Result<Self, CommandFailure> {
        let mut recorded = RecordingReader::open(file)?;
        if recorded.has_only_values() {
            return Err(CommandFailure::Usage(format!(
                "{}: an MCAP file has no senders; `ua-space record` writes them as .pcapng",
                file.display()
            )));
        }
        let mut times = HashMap::new();
        let mut left_out: u64 = 0;
        while let Some(datagram) = recorded.next()? {
            let ip = datagram.from.ip();
            let key = keys.hash_one((datagram.from, &datagram.bytes));
            if times.len() >= MOST_MESSAGES && !times.contains_key(&key) {
                left_out += 1;
                continue;
            }
            let entry = times.entry(key).or_insert((ip, Some(datagram.time)));
            if entry.1 != Some(datagram.time) {
                entry.1 = None;
            }
        }
        if left_out > 0 {
            let name = file.display();
            warn(&format!(
                "{name}: the last {left_out} messages are left out"
            ));
        }
        Ok(Self { times })
    }
}

/// The messages in two recordings, by their sender.
struct Compared(BTreeMap<IpAddr, Vec<Twice>>);

impl Compared {
    fn of(first: &Arrivals, second: &Arrivals) -> Self {
        let mut senders: BTreeMap<IpAddr, Vec<Twice>> = BTreeMap::new();
        for (key, (ip, at)) in &first.times {
            if let (Some(at), Some((_, Some(other)))) = (at, second.times.get(key)) {
                senders.entry(*ip).or_default().push(Twice {
                    at: *at,
                    difference: other - at,
                });
            }
        }
        Self(senders)
    }

    /// Returns the second clock, and the addresses of the first and of the second host. Messages of
    /// the first host arrive at the second host last, and those of the second host first.
    fn clock(
        &self,
        first: &Path,
        second: &Path,
    ) -> Result<(Clock, IpAddr, IpAddr), CommandFailure> {
        let names = format!("{} and {}", first.display(), second.display());
        let mut middles: Vec<(i128, IpAddr)> = self
            .0
            .iter()
            .filter_map(|(ip, all)| {
                let mut differences: Vec<i128> = all.iter().map(|one| one.difference).collect();
                Some((median(&mut differences)?, *ip))
            })
            .collect();
        middles.sort_unstable();
        let (Some((_, other)), Some((_, own))) = (middles.first(), middles.last()) else {
            return Err(CommandFailure::Data(format!(
                "{names} have no message in common\n  = help: record on both hosts at the same time, in the same group"
            )));
        };
        let of = |ip: &IpAddr| self.0.get(ip).map_or(&[][..], Vec::as_slice);
        let found = if own == other {
            None
        } else {
            estimate(of(own), of(other))
        };
        let Some(estimate) = found else {
            return Err(CommandFailure::Data(format!(
                "{names} have messages of one direction only, from {own}\n  = help: a program on each of both hosts has to send"
            )));
        };
        let clock = Clock {
            recording: second.display().to_string(),
            host: None,
            estimate,
            messages: (of(own).len(), of(other).len()),
        };
        Ok((clock, *own, *other))
    }
}

/// The clock of a host, compared with that of the first recording.
struct Clock {
    recording: String,
    host: Option<String>,
    estimate: Estimate,
    /// The numbers of messages from the first host, and to it.
    messages: (usize, usize),
}

impl Clock {
    fn reference(file: &Path) -> Self {
        Self {
            recording: file.display().to_string(),
            host: None,
            estimate: Estimate::none(),
            messages: (0, 0),
        }
    }

    /// Returns a time of this clock as a time of the first clock.
    fn corrected(&self, time: i128) -> i128 {
        self.estimate.corrected(time)
    }
}

/// The delays by topic, and the numbers of the sending and of the receiving host.
#[derive(Default)]
struct Delays(BTreeMap<(TopicId, usize, usize), DelayWindow>);

impl Delays {
    /// Reads the samples of other hosts in a recording. Samples of hosts without a recording have
    /// no known clock.
    fn read(
        &mut self,
        (file, number): (&PathBuf, usize),
        hosts: &BTreeMap<IpAddr, usize>,
        clocks: &[Clock],
    ) -> Result<(), CommandFailure> {
        let Some(here) = clocks.get(number) else {
            return Ok(());
        };
        let mut recorded = RecordingReader::open(file)?;
        let mut book = Book::new();
        let mut first = None;
        while let Some(datagram) = recorded.next()? {
            let Ok(message) = NetworkMessage::decode(&datagram.bytes) else {
                continue;
            };
            let sender = hosts.get(&datagram.from.ip()).copied();
            let (Some(sender), Some(there)) = (sender, sender.and_then(|at| clocks.get(at))) else {
                continue;
            };
            if sender == number {
                continue;
            }
            let begin = *first.get_or_insert(datagram.time);
            let since = u64::try_from(datagram.time - begin).unwrap_or_default();
            let now = Duration::from_nanos(since);
            book.handle((&message, datagram.from), now, &mut |news| {
                if let DatagramContent::Sample(sample) = news
                    && sample.message.kind != MessageKind::KeepAlive
                    && let Some(sent) = sample.sent()
                {
                    let key = (sample.topic, sender, number);
                    if self.0.len() < MOST_ROWS || self.0.contains_key(&key) {
                        let delay = here.corrected(datagram.time) - there.corrected(sent);
                        self.0.entry(key).or_default().record(delay);
                    }
                }
            });
        }
        Ok(())
    }

    fn rows(&self, clocks: &[Clock]) -> Vec<HostDelayRow> {
        let name = |number: usize| {
            let host = clocks.get(number).and_then(|clock| clock.host.clone());
            host.unwrap_or_else(|| "-".to_owned())
        };
        let rows = self.0.iter().filter_map(|((topic, from, to), window)| {
            Some(HostDelayRow {
                topic: topic.to_string(),
                from: name(*from),
                to: name(*to),
                delays: HopPage::of(window)?,
            })
        });
        rows.collect()
    }
}

/// The network delays of a topic between two hosts.
#[derive(Serialize)]
struct HostDelayRow {
    topic: String,
    from: String,
    to: String,
    #[serde(flatten)]
    delays: HopPage,
}

#[derive(Serialize)]
struct ShownClock<'a> {
    recording: &'a str,
    host: Option<&'a str>,
    offset_us: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    drift_ppm: Option<f64>,
    within_us: f64,
    messages_forth: usize,
    messages_back: usize,
}

#[derive(Serialize)]
struct RecordingTraceJson<'a> {
    clocks: Vec<ShownClock<'a>>,
    topics: &'a [HostDelayRow],
}

#[expect(clippy::cast_precision_loss, reason = "a time shown to people")]
pub(super) fn in_micros(nanos: i128) -> f64 {
    nanos as f64 / 1000.0
}

fn print(arguments: &Trace, clocks: &[Clock], rows: &[HostDelayRow]) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    if arguments.json {
        let shown = clocks.iter().map(|clock| ShownClock {
            recording: &clock.recording,
            host: clock.host.as_deref(),
            offset_us: in_micros(clock.estimate.offset),
            drift_ppm: clock.estimate.drift_ppm,
            within_us: in_micros(clock.estimate.within),
            messages_forth: clock.messages.0,
            messages_back: clock.messages.1,
        });
        let shown = RecordingTraceJson {
            clocks: shown.collect(),
            topics: rows,
        };
        writeln!(out, "{}", json(&shown)?)?;
        return Ok(());
    }
    let columns = [
        "HOST",
        "OFFSET",
        "WITHIN",
        "DRIFT PPM",
        "FORTH",
        "BACK",
        "RECORDING",
    ];
    let mut table = TextTable::new(columns.map(str::to_owned)).yielding([6]);
    for (number, clock) in clocks.iter().enumerate() {
        let host = clock.host.clone().unwrap_or_else(|| "-".to_owned());
        let estimate = &clock.estimate;
        let figures = match number {
            0 => ["reference", "-", "-", "-", "-"].map(str::to_owned),
            _ => [
                signed(estimate.offset),
                micros(in_micros(estimate.within)),
                estimate
                    .drift_ppm
                    .map_or_else(|| "-".to_owned(), |drift| format!("{drift:+.1}")),
                clock.messages.0.to_string(),
                clock.messages.1.to_string(),
            ],
        };
        let recording = clock.recording.clone();
        table.row(std::iter::once(host).chain(figures).chain([recording]));
    }
    let bold = is_coloured();
    table.write(&mut out, bold)?;
    if !rows.is_empty() {
        writeln!(out)?;
        let mut table = head(&["TOPIC", "HOP", "FROM", "TO"]).leaving_out([1]);
        for row in rows {
            let first = [
                row.topic.clone(),
                called(super::NETWORK),
                row.from.clone(),
                row.to.clone(),
            ];
            table.row(first.into_iter().chain(figures(&row.delays)));
        }
        table.without_empty_columns().write(&mut out, bold)?;
    }
    Ok(())
}

/// Returns an offset with its sign.
pub(super) fn signed(nanos: i128) -> String {
    format!("{:+.3} ms", in_micros(nanos) / 1000.0)
}

/// Further messages of a recording are left out.
const MOST_MESSAGES: usize = 2_000_000;
const MOST_ROWS: usize = 4096;

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, SocketAddrV4};

    use uadp::{
        DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar,
        Timestamp,
    };

    use super::*;
    use crate::capture::{LinkLayer, PcapNg};

    const START: i128 = 1_700_000_000_000_000_000;
    const MS: i128 = 1_000_000;
    /// The network delay between the two hosts.
    const DELAY: i128 = 400_000;

    /// Returns a value of a space that was sent at a time of the clock of its host.
    fn message(space: u16, number: u16, sent: i128) -> Vec<u8> {
        let Timestamp { time, picoseconds } = Timestamp::from_unix_nanos(sent);
        let network = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(space)),
            group: Some(GroupHeader {
                writer_group_id: Some(2),
                ..GroupHeader::default()
            }),
            timestamp: Some(time),
            picoseconds: Some(picoseconds),
            ..NetworkHeader::default()
        };
        let header = DataSetHeader {
            sequence_number: Some(number),
            timestamp: Some(time),
            ..DataSetHeader::default()
        };
        let mut bytes = Vec::new();
        let mut encoder = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[10])).unwrap();
        let mut frame = encoder.key_frame(&header).unwrap();
        frame.scalar(Scalar::UInt16(number)).unwrap();
        frame.finish().unwrap();
        encoder.finish().unwrap();
        bytes
    }

    /// Writes the recordings of two hosts that send ten values per second for a minute. The second
    /// clock is 3 s ahead and gains 50 ppm.
    fn recordings(name: &str) -> [PathBuf; 2] {
        let second = |time: i128| time + 3_000 * MS + (time - START) * 50 / 1_000_000;
        let addresses = [1, 2].map(|last| SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, last), 4840));
        let group = SocketAddrV4::new(Ipv4Addr::new(239, 192, 0, 40), 4840);
        let files = ["a", "b"].map(|host| {
            let name = format!("ua-space-trace-{name}-{host}-{}.pcapng", std::process::id());
            std::env::temp_dir().join(name)
        });
        let mut bytes = [Vec::new(), Vec::new()];
        let mut writers = Vec::new();
        for out in &mut bytes {
            writers.push(PcapNg::begin(LinkLayer::Udp(group), "eth0", out));
        }
        for number in 0..600_u16 {
            let at = START + i128::from(number) * 100 * MS;
            for (from, space) in [(0, 1), (1, 2)] {
                let clock = |time: i128| if from == 0 { time } else { second(time) };
                let bytes_of = message(space, number, clock(at));
                // A late message in ten.
                let delay = if number % 10 == 3 { DELAY * 40 } else { DELAY };
                for (to, (writer, out)) in writers.iter_mut().zip(&mut bytes).enumerate() {
                    let arrival = if to == from { at + 5_000 } else { at + delay };
                    let arrival = if to == 0 { arrival } else { second(arrival) };
                    writer.packet(arrival, addresses[from], &bytes_of, out);
                }
            }
        }
        for (file, bytes) in files.iter().zip(&bytes) {
            std::fs::write(file, bytes).unwrap();
        }
        files
    }

    #[test]
    fn two_recordings_give_the_offset_and_the_delays_of_both_directions() {
        let [first, second] = recordings("both");
        let keys = RandomState::new();
        let arrivals = |file: &PathBuf| Arrivals::read(file, &keys).unwrap();
        let compared = Compared::of(&arrivals(&first), &arrivals(&second));
        let (clock, own, other) = compared.clock(&first, &second).unwrap();
        assert_eq!(
            [own, other].map(|ip| ip.to_string()),
            ["10.0.0.1", "10.0.0.2"]
        );
        for seconds in [0, 30, 60] {
            let at = START + seconds * 1_000 * MS;
            let wanted = 3_000 * MS + seconds * 50_000;
            let error = (clock.estimate.at(at) - wanted).abs();
            assert!(error < MS, "{error} ns, {:?}", clock.estimate);
        }
        let hosts = BTreeMap::from([(own, 0), (other, 1)]);
        let clocks = [Clock::reference(&first), clock];
        let mut delays = Delays::default();
        for (file, number) in [&first, &second].into_iter().zip(0..) {
            delays.read((file, number), &hosts, &clocks).unwrap();
        }
        let rows = delays.rows(&clocks);
        let topics: Vec<&str> = rows.iter().map(|row| row.topic.as_str()).collect();
        assert_eq!(topics, ["ua_1_2_10", "ua_2_2_10"]);
        for row in &rows {
            assert_eq!(
                (row.delays.count, row.delays.negative),
                (600, 0),
                "{}",
                row.topic
            );
            let error = (row.delays.p50_us - 400.0).abs();
            assert!(error < 200.0, "{} {}", row.topic, row.delays.p50_us);
        }
        // Messages of a single direction give no offset.
        let one = Compared::of(&arrivals(&first), &arrivals(&first));
        let refused = Compared(one.0.into_iter().take(1).collect());
        let refused = refused.clock(&first, &first).err().unwrap().to_string();
        assert!(refused.contains("one direction"), "{refused}");
        for file in [first, second] {
            std::fs::remove_file(file).unwrap();
        }
    }
}
