//! Reads the packets of a capture file in order: pcap in all its variants (draft-ietf-opsawg-pcap)
//! and pcapng (draft-ietf-opsawg-pcapng). `write` writes pcapng.

mod write;

pub(crate) use write::{LinkLayer, PcapNg};

use std::io::{self, Read};

/// Reads the packets of a capture.
#[derive(Debug)]
pub(crate) struct CaptureReader<R> {
    reader: R,
    format: Format,
    /// Number of bytes read so far.
    at: u64,
}

/// The captured part of a packet.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Packet {
    /// Nanoseconds since 1970-01-01 UTC; `None` if the capture has no timestamp for the packet.
    pub(crate) time: Option<i128>,
    /// The LINKTYPE number, which defines the first header of the data.
    pub(crate) link_type: u16,
    pub(crate) data: Vec<u8>,
    /// Number of bytes of the packet on the wire that were not captured.
    pub(crate) missing: usize,
}

#[derive(Debug, thiserror::Error)]
pub(crate) enum CaptureError {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error("the capture ends inside of what starts at byte {0}")]
    CutOff(u64),
    #[error("at byte {at}: {what}")]
    Broken { at: u64, what: &'static str },
}

#[derive(Debug)]
enum Format {
    Pcap {
        big_endian: bool,
        nanoseconds: bool,
        link_type: u16,
    },
    PcapNg {
        big_endian: bool,
        interfaces: Vec<Interface>,
    },
}

#[derive(Debug, Clone, Copy)]
struct Interface {
    link_type: u16,
    snap_length: u32,
    clock: Clock,
}

/// The resolution and offset of the timestamps of an interface.
#[derive(Debug, Clone, Copy)]
struct Clock {
    /// `if_tsresol`: the exponent, to base 2 if the highest bit is set, otherwise to base 10.
    resolution: u8,
    /// `if_tsoffset`, in seconds.
    offset: i64,
}

/// Returns true if these are the first bytes of a capture file.
pub(crate) fn is_capture(start: [u8; 4]) -> bool {
    let pcap = [start, reversed(start)]
        .iter()
        .any(|magic| [MICROSECONDS, NANOSECONDS].contains(magic));
    pcap || start == SECTION_HEADER
}

impl<R: Read> CaptureReader<R> {
    /// Reads the header of a file that starts with `magic`; `reader` returns the bytes after
    /// `magic`.
    pub(crate) fn new(magic: [u8; 4], reader: R) -> Result<Self, CaptureError> {
        let mut capture = Self {
            reader,
            format: Format::PcapNg {
                big_endian: false,
                interfaces: Vec::new(),
            },
            at: 4,
        };
        if magic == SECTION_HEADER {
            let length = capture.exact::<4>(0)?;
            capture.section_header(0, length)?;
            return Ok(capture);
        }
        let big_endian = [MICROSECONDS, NANOSECONDS].contains(&magic);
        let header = capture.exact::<20>(0)?;
        // The upper half holds the length of the frame check sequence that follows the packet.
        let [a, b, c, d] = tail(&header);
        let link_type = if big_endian {
            u16::from_be_bytes([c, d])
        } else {
            u16::from_le_bytes([a, b])
        };
        capture.format = Format::Pcap {
            big_endian,
            nanoseconds: [NANOSECONDS, reversed(NANOSECONDS)].contains(&magic),
            link_type,
        };
        Ok(capture)
    }

    /// Returns the next packet, or `None` at the end of the file.
    pub(crate) fn next_packet(&mut self) -> Result<Option<Packet>, CaptureError> {
        match self.format {
            Format::Pcap {
                big_endian,
                nanoseconds,
                link_type,
            } => self.record(big_endian, nanoseconds, link_type),
            Format::PcapNg { .. } => self.block(),
        }
    }

    /// Reads a record of a pcap file.
    fn record(
        &mut self,
        big_endian: bool,
        nanoseconds: bool,
        link_type: u16,
    ) -> Result<Option<Packet>, CaptureError> {
        let start = self.at;
        let Some(header) = self.exact_or_end::<16>()? else {
            return Ok(None);
        };
        let [seconds, fraction, captured, original] = words(&header, big_endian);
        let data = self.bytes(start, captured)?;
        let nanos = i128::from(fraction) * if nanoseconds { 1 } else { 1000 };
        Ok(Some(Packet {
            time: Some(i128::from(seconds) * NANOS_PER_SECOND + nanos),
            link_type,
            missing: missing(original, &data),
            data,
        }))
    }

    /// Reads the blocks of a pcapng file up to the next block with a packet.
    fn block(&mut self) -> Result<Option<Packet>, CaptureError> {
        loop {
            let start = self.at;
            let Some(kind) = self.exact_or_end::<4>()? else {
                return Ok(None);
            };
            let length = self.exact::<4>(start)?;
            if kind == SECTION_HEADER {
                self.section_header(start, length)?;
                continue;
            }
            let Format::PcapNg { big_endian, .. } = self.format else {
                return Ok(None);
            };
            let length = word(length, big_endian);
            let inner = length.checked_sub(12).filter(|_| length.is_multiple_of(4));
            let inner = inner.ok_or(CaptureError::Broken {
                at: start,
                what: "a block of an impossible length",
            })?;
            let body = self.bytes(start, inner)?;
            self.exact::<4>(start)?;
            let packet = match word(kind, big_endian) {
                INTERFACE_DESCRIPTION => self.interface(&body, big_endian),
                ENHANCED_PACKET => self.enhanced_packet(&body, big_endian),
                SIMPLE_PACKET => self.simple_packet(&body, big_endian),
                _ => Ok(None),
            };
            let broken = |what| CaptureError::Broken { at: start, what };
            if let Some(packet) = packet.map_err(broken)? {
                return Ok(Some(packet));
            }
        }
    }

    /// Reads a Section Header Block. Each section has its own byte order and interfaces.
    fn section_header(&mut self, start: u64, length: [u8; 4]) -> Result<(), CaptureError> {
        let byte_order = self.exact::<4>(start)?;
        let big_endian = byte_order == BYTE_ORDER;
        if !big_endian && byte_order != reversed(BYTE_ORDER) {
            return Err(CaptureError::Broken {
                at: start,
                what: "a section without byte order",
            });
        }
        let inner = word(length, big_endian).checked_sub(16);
        let inner = inner.ok_or(CaptureError::Broken {
            at: start,
            what: "a section header of an impossible length",
        })?;
        self.bytes(start, inner)?;
        self.exact::<4>(start)?;
        self.format = Format::PcapNg {
            big_endian,
            interfaces: Vec::new(),
        };
        Ok(())
    }

    fn interface(&mut self, body: &[u8], big_endian: bool) -> Result<Option<Packet>, &'static str> {
        let (head, options) = body
            .split_first_chunk::<8>()
            .ok_or("an Interface Description Block that is too short")?;
        let [a, b, _, _, snap_length @ ..] = *head;
        let link_type = if big_endian {
            u16::from_be_bytes([a, b])
        } else {
            u16::from_le_bytes([a, b])
        };
        let Format::PcapNg { interfaces, .. } = &mut self.format else {
            return Ok(None);
        };
        if interfaces.len() == MAX_INTERFACES {
            return Err("more interfaces than any capture has");
        }
        interfaces.push(Interface {
            link_type,
            snap_length: word(snap_length, big_endian),
            clock: Clock::read(options, big_endian),
        });
        Ok(None)
    }

    fn enhanced_packet(
        &self,
        body: &[u8],
        big_endian: bool,
    ) -> Result<Option<Packet>, &'static str> {
        const SHORT: &str = "an Enhanced Packet Block that is too short";
        let (head, rest) = body.split_first_chunk::<20>().ok_or(SHORT)?;
        let [interface, high, low, captured, original] = words(head, big_endian);
        let interface = self.interface_at(interface)?;
        let captured = usize::try_from(captured).map_err(|_| SHORT)?;
        let data = rest.get(..captured).ok_or(SHORT)?.to_vec();
        let count = u64::from(high) << 32 | u64::from(low);
        Ok(Some(Packet {
            time: Some(interface.clock.nanos(count)),
            link_type: interface.link_type,
            missing: missing(original, &data),
            data,
        }))
    }

    fn simple_packet(&self, body: &[u8], big_endian: bool) -> Result<Option<Packet>, &'static str> {
        let (original, rest) = body
            .split_first_chunk::<4>()
            .ok_or("a Simple Packet Block that is too short")?;
        let interface = self.interface_at(0)?;
        let original = word(*original, big_endian);
        let captured = match interface.snap_length {
            0 => original,
            snap_length => original.min(snap_length),
        };
        let captured = usize::try_from(captured).unwrap_or(usize::MAX);
        let data = rest.get(..captured).unwrap_or(rest).to_vec();
        Ok(Some(Packet {
            time: None,
            link_type: interface.link_type,
            missing: missing(original, &data),
            data,
        }))
    }

    fn interface_at(&self, index: u32) -> Result<Interface, &'static str> {
        let Format::PcapNg { interfaces, .. } = &self.format else {
            return Err("a packet without section");
        };
        usize::try_from(index)
            .ok()
            .and_then(|index| interfaces.get(index).copied())
            .ok_or("a packet of an interface that was not described")
    }

    /// Reads the bytes of a packet or block that started at `start`.
    fn bytes(&mut self, start: u64, length: u32) -> Result<Vec<u8>, CaptureError> {
        if length > MAX_LENGTH {
            return Err(CaptureError::Broken {
                at: start,
                what: "a packet or block longer than any is",
            });
        }
        let mut data = Vec::new();
        let read = self
            .reader
            .by_ref()
            .take(length.into())
            .read_to_end(&mut data)?;
        self.at += u64::try_from(read).unwrap_or_default();
        match u32::try_from(read) {
            Ok(read) if read == length => Ok(data),
            _ => Err(CaptureError::CutOff(start)),
        }
    }

    fn exact<const N: usize>(&mut self, start: u64) -> Result<[u8; N], CaptureError> {
        match self.exact_or_end() {
            Ok(Some(bytes)) => Ok(bytes),
            Ok(None) | Err(CaptureError::CutOff(_)) => Err(CaptureError::CutOff(start)),
            Err(error) => Err(error),
        }
    }

    /// Reads `N` bytes. Returns `None` at the end of the file, and an error if the file ends within
    /// the bytes.
    fn exact_or_end<const N: usize>(&mut self) -> Result<Option<[u8; N]>, CaptureError> {
        let start = self.at;
        let mut bytes = [0; N];
        let mut place = bytes.as_mut_slice();
        while !place.is_empty() {
            match self.reader.read(place) {
                Ok(0) if place.len() == N => return Ok(None),
                Ok(0) => return Err(CaptureError::CutOff(start)),
                Ok(read) => {
                    self.at += u64::try_from(read).unwrap_or_default();
                    place = place.get_mut(read..).unwrap_or_default();
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(Some(bytes))
    }
}

impl Clock {
    const MICROSECONDS: Self = Self {
        resolution: 6,
        offset: 0,
    };

    /// Reads the clock from the options of an interface.
    fn read(mut options: &[u8], big_endian: bool) -> Self {
        let mut clock = Self::MICROSECONDS;
        let half = |bytes: [u8; 2]| {
            if big_endian {
                u16::from_be_bytes(bytes)
            } else {
                u16::from_le_bytes(bytes)
            }
        };
        while let Some((&[a, b, c, d], rest)) = options.split_first_chunk() {
            let length = usize::from(half([c, d]));
            let value = rest.get(..length).unwrap_or_default();
            match (half([a, b]), value) {
                (END_OF_OPTIONS, _) => break,
                (TIME_RESOLUTION, [resolution, ..]) => clock.resolution = *resolution,
                (TIME_OFFSET, value) => {
                    if let Some(offset) = value.first_chunk() {
                        clock.offset = if big_endian {
                            i64::from_be_bytes(*offset)
                        } else {
                            i64::from_le_bytes(*offset)
                        };
                    }
                }
                _ => {}
            }
            options = rest.get(length.next_multiple_of(4)..).unwrap_or_default();
        }
        clock
    }

    /// Converts a timestamp to nanoseconds since 1970-01-01 UTC.
    fn nanos(self, count: u64) -> i128 {
        let exponent = u32::from(self.resolution & 0x7F);
        let base: i128 = if self.resolution & 0x80 != 0 { 2 } else { 10 };
        // If the power overflows, the unit is too small for any count to reach a nanosecond.
        let nanos = base
            .checked_pow(exponent)
            .map_or(0, |units| i128::from(count) * NANOS_PER_SECOND / units);
        nanos + i128::from(self.offset) * NANOS_PER_SECOND
    }
}

fn missing(original: u32, data: &[u8]) -> usize {
    usize::try_from(original)
        .unwrap_or_default()
        .saturating_sub(data.len())
}

fn word(bytes: [u8; 4], big_endian: bool) -> u32 {
    if big_endian {
        u32::from_be_bytes(bytes)
    } else {
        u32::from_le_bytes(bytes)
    }
}

/// Returns the first `N` 32-bit words of a header.
fn words<const N: usize>(bytes: &[u8], big_endian: bool) -> [u32; N] {
    let (chunks, _) = bytes.as_chunks();
    let mut chunks = chunks.iter();
    [(); N].map(|()| chunks.next().map_or(0, |chunk| word(*chunk, big_endian)))
}

fn tail(bytes: &[u8]) -> [u8; 4] {
    bytes.last_chunk().copied().unwrap_or_default()
}

const fn reversed([a, b, c, d]: [u8; 4]) -> [u8; 4] {
    [d, c, b, a]
}

/// The first bytes of a pcap file written by a big-endian machine.
const MICROSECONDS: [u8; 4] = [0xA1, 0xB2, 0xC3, 0xD4];
const NANOSECONDS: [u8; 4] = [0xA1, 0xB2, 0x3C, 0x4D];
/// The type of a pcapng Section Header Block, which is the same in both byte orders.
const SECTION_HEADER: [u8; 4] = [0x0A, 0x0D, 0x0D, 0x0A];
/// The byte-order magic of a section written by a big-endian machine.
const BYTE_ORDER: [u8; 4] = [0x1A, 0x2B, 0x3C, 0x4D];
const INTERFACE_DESCRIPTION: u32 = 1;
const INTERFACE_STATISTICS: u32 = 5;
const SIMPLE_PACKET: u32 = 3;
const ENHANCED_PACKET: u32 = 6;
const END_OF_OPTIONS: u16 = 0;
const TIME_RESOLUTION: u16 = 9;
const TIME_OFFSET: u16 = 14;
const NANOS_PER_SECOND: i128 = 1_000_000_000;
/// Maximum length of a packet or block, in bytes; a capture with a greater length is damaged.
const MAX_LENGTH: u32 = 16 << 20;
const MAX_INTERFACES: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    fn open(bytes: &[u8]) -> Result<CaptureReader<&[u8]>, CaptureError> {
        let (magic, rest) = bytes.split_first_chunk().unwrap();
        assert!(is_capture(*magic));
        CaptureReader::new(*magic, rest)
    }

    /// Returns a pcap file with one packet, written by a machine of either byte order.
    fn pcap(magic: [u8; 4], fraction: u32, big_endian: bool) -> Vec<u8> {
        let order = |number: u32| {
            if big_endian {
                number.to_be_bytes()
            } else {
                number.to_le_bytes()
            }
        };
        let mut file = magic.to_vec();
        file.extend(order(if big_endian { 0x0002_0004 } else { 0x0004_0002 }));
        for number in [0, 0, 65_535, 101, 1_700_000_000, fraction, 3, 7] {
            file.extend(order(number));
        }
        file.extend([1, 2, 3]);
        file
    }

    #[test]
    fn all_four_kinds_of_pcap_are_read() {
        let packet = |nanos: i128| Packet {
            time: Some(1_700_000_000_000_000_000 + nanos),
            link_type: 101,
            data: vec![1, 2, 3],
            missing: 4,
        };
        for (magic, big_endian) in [
            (MICROSECONDS, true),
            (reversed(MICROSECONDS), false),
            (NANOSECONDS, true),
            (reversed(NANOSECONDS), false),
        ] {
            let file = pcap(magic, 500, big_endian);
            let mut capture = open(&file).unwrap();
            let counts_nanos = [NANOSECONDS, reversed(NANOSECONDS)].contains(&magic);
            let nanos = if counts_nanos { 500 } else { 500_000 };
            assert_eq!(capture.next_packet().unwrap(), Some(packet(nanos)));
            assert_eq!(capture.next_packet().unwrap(), None);
        }
    }

    #[test]
    fn a_capture_that_ends_inside_of_a_packet_says_where_that_starts() {
        let file = pcap(reversed(MICROSECONDS), 0, false);
        for cut in [1, 3, 4, 18] {
            let mut capture = open(&file[..file.len() - cut]).unwrap();
            let error = capture.next_packet().unwrap_err();
            assert!(matches!(error, CaptureError::CutOff(24)), "{error}");
        }
        assert!(matches!(open(&file[..20]), Err(CaptureError::CutOff(0))));
    }

    #[test]
    fn a_length_that_cannot_be_is_refused_unread() {
        let mut file = pcap(reversed(MICROSECONDS), 0, false);
        file[24 + 8..24 + 12].fill(0xFF);
        let error = open(&file).unwrap().next_packet().unwrap_err();
        assert!(
            matches!(error, CaptureError::Broken { at: 24, .. }),
            "{error}"
        );
    }

    #[test]
    fn time_is_counted_as_the_interface_says() {
        let count = 1_700_000_000_u64 << 20;
        for (resolution, offset, count, nanos) in [
            (6, 0, 1_000_001, 1_000_001_000),
            (9, 0, 1_000_000_001, 1_000_000_001),
            (9, -1, 1_000_000_001, 1),
            (3, 2, 5, 2_005_000_000),
            (0x80 | 20, 0, count, 1_700_000_000_000_000_000),
            (12, 0, 1_000_000_002_000, 1_000_000_002),
            (0x7F, 0, 5, 0),
        ] {
            let clock = Clock { resolution, offset };
            assert_eq!(clock.nanos(count), nanos, "{clock:?}");
        }
    }
}
