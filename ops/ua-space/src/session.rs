//! The commands `decode` and `encode`.

use std::borrow::Cow;
use std::io::{self, Read, Write as _};
use std::path::Path;

use crate::arguments::{Decode, DecoderArguments, Encode};
use crate::capture::CaptureReader;
use crate::decode::{ChunkReassembler, DecodeContext, DecodedDatagram};
use crate::encode;
use crate::exit::CommandFailure;
use crate::input::{self, InputFile};
use crate::keys::KeyFile;
use crate::metadata::MetaDataFile;
use crate::packet::{self, Fragments, PacketContent, UdpPacket};
use crate::report::{Style, StyledOutput, warn};
use crate::{hex, iso_time, json_file, shape};

/// Runs `ua-space decode`.
pub(crate) fn decode(arguments: &Decode) -> Result<(), CommandFailure> {
    let name = input::name(&arguments.file);
    let context = context(&arguments.known)?;
    let input = input::open(&arguments.file, arguments.lines)?;
    let style = match &input {
        InputFile::Mcap(_) => return Err(no_datagrams(name)),
        _ if arguments.array => Style::Array,
        InputFile::Datagram(_) => Style::Single,
        InputFile::Lines(_) | InputFile::Capture(_) => Style::Lines,
    };
    let mut session = Session {
        name,
        port: arguments.port,
        context,
        chunks: ChunkReassembler::new(),
        report: StyledOutput::new(style),
        counters: Counters::default(),
    };
    let ended = session.run(input);
    session.tell();
    let finished = session.report.finish();
    ended.and(finished)
}

/// Returns the failure for a file with values only.
fn no_datagrams(name: &str) -> CommandFailure {
    CommandFailure::Data(format!(
        "{name} is an MCAP file, which has values and no datagrams\n  = help: `ua-space replay --dry-run {name}` shows its topics; `ua-space record` writes datagrams as .pcapng"
    ))
}

/// Runs `ua-space encode`.
pub(crate) fn encode(arguments: &Encode) -> Result<(), CommandFailure> {
    let name = input::name(&arguments.file);
    let context = context(&arguments.known)?;
    let text = match arguments.file.as_str() {
        "-" => io::read_to_string(io::stdin().lock().take(json_file::LARGEST))
            .map_err(|error| CommandFailure::reading(name, &error))?,
        path => json_file::read(Path::new(path))?,
    };
    let datagrams: Vec<shape::DatagramJson> =
        json_file::one_or_many(&text).map_err(|error| json_file::explain(name, &error))?;
    if datagrams.is_empty() {
        return Err(CommandFailure::Data(format!("{name}: holds no datagram")));
    }
    let many = datagrams.len() > 1;
    let mut out = io::stdout().lock();
    for (datagram, number) in datagrams.iter().zip(1..) {
        let bytes = encode::write(datagram, &context).map_err(|wrong| {
            let number = if many {
                format!(" datagram {number}:")
            } else {
                String::new()
            };
            CommandFailure::Data(format!("{name}:{number} {wrong}"))
        })?;
        if arguments.raw {
            out.write_all(&bytes)?
        } else {
            writeln!(out, "{}", hex::text(&bytes))?
        }
    }
    out.flush()?;
    Ok(())
}

fn context(known: &DecoderArguments) -> Result<DecodeContext, CommandFailure> {
    let keys = known.keys.as_deref().map(|path| KeyFile::read(path, warn));
    let metadata = known.metadata.as_deref();
    let metadata = metadata.map(|path| MetaDataFile::read(path, known.raw_reading));
    Ok(DecodeContext {
        keys: keys.transpose()?,
        metadata: metadata.transpose()?.unwrap_or_default(),
        raw_reading: known.raw_reading,
    })
}

/// The state of `decode` while it reads a file.
struct Session<'a> {
    name: &'a str,
    port: Option<u16>,
    context: DecodeContext,
    chunks: ChunkReassembler,
    report: StyledOutput,
    counters: Counters,
}

/// The counts that are reported at the end.
#[derive(Debug, Default)]
struct Counters {
    /// Secured messages that are shown encrypted because keys are missing.
    sealed: usize,
    /// Datagrams of other ports that are not NetworkMessages.
    foreign: usize,
    /// IP datagrams with missing fragments.
    incomplete: usize,
    /// Packets with an unsupported link layer, and its number.
    unknown_links: usize,
    unknown_link: u16,
    udp: usize,
    packets: usize,
}

impl Session<'_> {
    fn run(&mut self, input: InputFile) -> Result<(), CommandFailure> {
        match input {
            InputFile::Datagram(datagram) => {
                let reading = self.context.read(&datagram, None);
                self.show(self.name, &reading)
            }
            InputFile::Lines(datagrams) => {
                for (line, datagram) in datagrams {
                    let reading = self.context.read(&datagram, Some(&mut self.chunks));
                    self.show(&format!("{}: line {line}", self.name), &reading)?;
                }
                Ok(())
            }
            InputFile::Capture(capture) => self.capture(capture),
            InputFile::Mcap(_) => Err(no_datagrams(self.name)),
        }
    }

    fn show(&mut self, name: &str, reading: &DecodedDatagram) -> Result<(), CommandFailure> {
        if reading.shape.sealed.is_some() && reading.refused.is_none() {
            self.counters.sealed += 1;
        }
        self.report.show(name, reading)?;
        match &reading.whole {
            Some(whole) => self.show(&format!("{name}: put together from chunks"), whole),
            None => Ok(()),
        }
    }

    fn capture(&mut self, mut capture: CaptureReader<impl Read>) -> Result<(), CommandFailure> {
        let mut fragments = Fragments::default();
        loop {
            let packet = capture.next_packet();
            self.counters.incomplete = fragments.incomplete();
            let Some(packet) = packet.map_err(|error| input::failure(self.name, error))? else {
                return Ok(());
            };
            self.counters.packets += 1;
            match packet::udp(packet.link_type, &packet.data, &mut fragments) {
                PacketContent::Udp(udp) => {
                    self.counters.udp += 1;
                    self.datagram(packet.time, udp)?;
                }
                PacketContent::UnknownLink => {
                    self.counters.unknown_links += 1;
                    self.counters.unknown_link = packet.link_type;
                }
                PacketContent::Fragment | PacketContent::Other => {}
            }
        }
    }

    fn datagram(&mut self, time: Option<i128>, udp: UdpPacket<'_>) -> Result<(), CommandFailure> {
        let is_of = |port| [udp.source.port(), udp.destination.port()].contains(&port);
        if self.port.is_some_and(|port| !is_of(port)) {
            return Ok(());
        }
        if let Some(time) = time {
            self.chunks.at(time);
        }
        let mut reading = self.context.read(&udp.payload, Some(&mut self.chunks));
        if self.port.is_none() && !is_of(UADP_PORT) && !reading.is_plausible() {
            self.counters.foreign += 1;
            return Ok(());
        }
        let whole = reading.whole.as_mut().map(|whole| &mut whole.shape);
        for shape in [Some(&mut reading.shape), whole].into_iter().flatten() {
            shape.time = time.map(iso_time::of_unix_nanos);
            shape.source = Some(udp.source.to_string());
            shape.destination = Some(udp.destination.to_string());
        }
        if reading.shape.uadp_version.is_none() {
            reading.shape.datagram_hex = Some(hex::text(&udp.payload));
        }
        let cut = match udp.missing {
            0 => Cow::Borrowed(""),
            missing => format!(" ({missing} bytes were not captured)").into(),
        };
        let (name, packet) = (self.name, self.counters.packets);
        let (source, destination) = (udp.source, udp.destination);
        let name = format!("{name}: packet {packet}, {source} to {destination}{cut}");
        self.show(&name, &reading)
    }

    /// Reports the counts that the output does not show.
    fn tell(&self) {
        let Counters {
            sealed,
            foreign,
            incomplete,
            unknown_links,
            unknown_link,
            udp,
            packets,
        } = self.counters;
        let told = [
            (sealed, "secured, and shown as they are without --keys"),
            (
                foreign,
                "datagrams of other ports than 4840 are no NetworkMessages; --port shows why",
            ),
            (incomplete, "IP datagrams lack fragments"),
        ];
        for (count, what) in told.iter().filter(|(count, _)| *count != 0) {
            warn(&format!("{}: {count} {what}", self.name));
        }
        if unknown_links != 0 {
            warn(&format!(
                "{}: {unknown_links} packets of LINKTYPE {unknown_link}, which is not read",
                self.name
            ));
        }
        if self.chunks.is_any_incomplete() {
            warn(&format!(
                "{}: not every message has all its chunks",
                self.name
            ));
        }
        if packets != 0 && self.report.shown() == 0 {
            warn(&format!(
                "{}: nothing to show in {packets} packets, {udp} of them UDP",
                self.name
            ));
        }
    }
}

/// The default UDP port of UADP (OPC 10000-14, 7.3.2).
const UADP_PORT: u16 = 4840;
