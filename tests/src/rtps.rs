//! Mutated RTPS datagrams, made from real datagrams.

use std::{fs, net::UdpSocket, path::Path};

/// The GUID prefix of the participant that the corpus was sent to, as stored in the files.
const RECEIVER: &[u8; 12] = b"\x01\x12the-bridge";

/// Mutates real datagrams of all kinds. The same seed makes the same datagrams.
pub struct Mutator {
    corpus: Vec<Vec<u8>>,
    random: u64,
}

impl Mutator {
    /// Creates datagrams for the participant with this GUID prefix.
    ///
    /// # Panics
    /// Panics if the corpus in `fuzz/corpus/rtps` cannot be read.
    #[must_use]
    pub fn new(receiver: [u8; 12], seed: u64) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus/rtps");
        let mut paths: Vec<_> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        paths.sort();
        let corpus = paths
            .iter()
            .map(|path| addressed(fs::read(path).unwrap(), receiver))
            .collect();
        Self {
            corpus,
            random: seed | 1,
        }
    }

    /// Returns the original datagrams.
    #[must_use]
    pub fn corpus(&self) -> &[Vec<u8>] {
        &self.corpus
    }

    /// Returns the next datagram.
    #[must_use]
    pub fn datagram(&mut self) -> Vec<u8> {
        let chosen = self.below(self.corpus.len());
        let mut datagram = self.corpus[chosen].clone();
        for _ in 0..self.below(4) {
            self.change(&mut datagram);
        }
        datagram.truncate(60_000);
        datagram
    }

    fn change(&mut self, datagram: &mut Vec<u8>) {
        if datagram.len() <= HEADER {
            datagram.resize(HEADER + 8, 0);
        }
        let end = datagram.len();
        match self.below(11) {
            0 => datagram[self.below(end)] ^= 1 << self.below(8),
            1 => datagram[self.below(end)] = self.next() as u8,
            2 => self.put_number(datagram),
            3 => self.put_length(datagram),
            4 => datagram.truncate(self.below(end)),
            5 => self.splice(datagram),
            6 => self.repeat(datagram),
            7 => self.put_entity(datagram),
            // Another participant of the same vendor, chosen from 64 to limit the number of
            // participants.
            8 => datagram[19] = self.below(64) as u8,
            9 => self.turn_endianness(datagram),
            _ => {
                let from = HEADER + self.below(end - HEADER);
                let random = self.next().to_le_bytes();
                let rest = datagram[from..].iter_mut().zip(random);
                rest.for_each(|(byte, random)| *byte = random);
            }
        }
    }

    /// Writes an integer that breaks arithmetic at a position of integers.
    fn put_number(&mut self, datagram: &mut [u8]) {
        const NUMBERS: [u32; 10] = [
            0,
            1,
            2,
            255,
            0x7fff_ffff,
            0x8000_0000,
            0x8000_0001,
            0xffff_fffe,
            0xffff_ffff,
            0x0001_0000,
        ];
        let number = NUMBERS[self.below(NUMBERS.len())];
        let bytes = if self.below(4) == 0 {
            number.to_be_bytes()
        } else {
            number.to_le_bytes()
        };
        put(datagram, self.below(datagram.len()) & !3, &bytes);
    }

    /// Writes a length of a submessage or of a parameter.
    fn put_length(&mut self, datagram: &mut [u8]) {
        const LENGTHS: [u16; 9] = [0, 1, 3, 4, 8, 0x7fff, 0x8000, 0xfffc, 0xffff];
        let length = LENGTHS[self.below(LENGTHS.len())];
        let headers = submessages(datagram);
        let at = if headers.is_empty() || self.below(2) == 0 {
            self.below(datagram.len()) & !3
        } else {
            headers[self.below(headers.len())]
        };
        put(datagram, at + 2, &length.to_le_bytes());
    }

    fn splice(&mut self, datagram: &mut Vec<u8>) {
        let chosen = self.below(self.corpus.len());
        let at = submessages(datagram);
        if !at.is_empty() && self.below(2) == 0 {
            datagram.truncate(at[self.below(at.len())]);
        }
        let other = &self.corpus[chosen];
        datagram.extend_from_slice(other.get(HEADER..).unwrap_or_default());
    }

    fn repeat(&mut self, datagram: &mut Vec<u8>) {
        let from = self.below(datagram.len());
        let to = from + self.below(datagram.len() - from);
        for _ in 0..=self.below(3) {
            datagram.extend_from_within(from..to);
        }
    }

    /// Writes the id of a builtin endpoint at a position of EntityIds.
    fn put_entity(&mut self, datagram: &mut [u8]) {
        const ENTITIES: [[u8; 4]; 8] = [
            [0, 1, 0, 0xc2],
            [0, 1, 0, 0xc7],
            [0, 0, 3, 0xc2],
            [0, 0, 4, 0xc2],
            [0, 2, 0, 0xc2],
            [0, 0, 0, 0],
            [0, 0, 1, 0xc1],
            [0, 0, 0x11, 0x03],
        ];
        let entity = ENTITIES[self.below(ENTITIES.len())];
        let headers = submessages(datagram);
        if !headers.is_empty() {
            let header = headers[self.below(headers.len())];
            put(datagram, header + 4 + 4 * self.below(4), &entity);
        }
    }

    fn turn_endianness(&mut self, datagram: &mut [u8]) {
        let headers = submessages(datagram);
        if !headers.is_empty()
            && let Some(flags) = datagram.get_mut(headers[self.below(headers.len())] + 1)
        {
            *flags ^= 1 << self.below(4);
        }
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end.max(1) as u64) as usize
    }

    fn next(&mut self) -> u64 {
        // xorshift64*
        self.random ^= self.random >> 12;
        self.random ^= self.random << 25;
        self.random ^= self.random >> 27;
        self.random.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }
}

/// Returns whether a datagram claims more than RustDDS 0.15.1 can bear. After such a datagram,
/// RustDDS stops reading for long, or forever:
///
/// - a HEARTBEAT or GAP of more than a hundred thousand samples, which RustDDS visits one by one
///   (`rtps_writer_proxy.rs`, `missing_seqnums` and `irrelevant_changes_range`);
/// - a DATA_FRAG of a sample of more than 64 MB, for which RustDDS fills as much memory at the
///   first fragment (`fragment_assembler.rs`, `AssemblyBuffer::new`).
#[must_use]
pub fn claims_too_much(datagram: &[u8]) -> bool {
    const SAMPLES: i64 = 100_000;
    const SAMPLE: u32 = 64 << 20;
    submessages(datagram).into_iter().any(|at| {
        let little_endian = datagram[at + 1] & 1 == 1;
        // Both submessages have two EntityIds, then two sequence numbers.
        let number = |from: usize| {
            let bytes: [u8; 8] = datagram.get(from..from + 8)?.try_into().ok()?;
            Some(sequence_number(bytes, little_endian))
        };
        let span = || Some(number(at + 20)?.saturating_sub(number(at + 12)?));
        let size = || {
            let bytes: [u8; 4] = datagram.get(at + 32..at + 36)?.try_into().ok()?;
            Some(if little_endian {
                u32::from_le_bytes(bytes)
            } else {
                u32::from_be_bytes(bytes)
            })
        };
        match datagram[at] {
            0x07 | 0x08 => span().is_some_and(|span| span > SAMPLES),
            0x16 => size().is_some_and(|size| size > SAMPLE),
            _ => false,
        }
    })
}

/// The length of the header of a message (RTPS 2.5, 9.4.4).
const HEADER: usize = 20;

/// Returns the positions of the submessages.
fn submessages(datagram: &[u8]) -> Vec<usize> {
    let mut all = Vec::new();
    let mut at = HEADER;
    while let Some(&[kind, flags, low, high]) = datagram.get(at..at + 4) {
        all.push(at);
        let length = if flags & 1 == 1 {
            u16::from_le_bytes([low, high])
        } else {
            u16::from_be_bytes([low, high])
        };
        // Zero means the rest of the message, except for PAD and INFO_TS (RTPS 2.5, 9.4.5.1.3).
        if length == 0 && !matches!(kind, 0x01 | 0x09) {
            break;
        }
        at += 4 + usize::from(length);
    }
    all
}

/// Decodes a sequence number. The high half comes first in either endianness (RTPS 2.5, 9.3.2).
fn sequence_number([a, b, c, d, e, f, g, h]: [u8; 8], little_endian: bool) -> i64 {
    let (high, low) = if little_endian {
        (
            i32::from_le_bytes([a, b, c, d]),
            u32::from_le_bytes([e, f, g, h]),
        )
    } else {
        (
            i32::from_be_bytes([a, b, c, d]),
            u32::from_be_bytes([e, f, g, h]),
        )
    };
    (i64::from(high) << 32) + i64::from(low)
}

fn put(datagram: &mut [u8], at: usize, bytes: &[u8]) {
    if let Some(place) = datagram.get_mut(at..at + bytes.len()) {
        place.copy_from_slice(bytes);
    }
}

fn addressed(mut datagram: Vec<u8>, receiver: [u8; 12]) -> Vec<u8> {
    let places: Vec<usize> = datagram
        .windows(RECEIVER.len())
        .enumerate()
        .filter_map(|(at, bytes)| (bytes == RECEIVER).then_some(at))
        .collect();
    for at in places {
        put(&mut datagram, at, &receiver);
    }
    datagram
}

/// Returns the GUID prefix of a participant's announcement to the multicast group of the domain.
///
/// # Panics
/// Panics if the group cannot be read.
#[must_use]
pub fn announced(group: &UdpSocket) -> Option<[u8; 12]> {
    let mut datagram = [0; 2048];
    let length = group.recv(&mut datagram).unwrap();
    let prefix = datagram[..length].get(8..HEADER)?;
    (datagram.starts_with(b"RTPS")).then(|| prefix.try_into().unwrap())
}

/// Returns the bytes that wait in the UDP sockets bound to these ports in this thread's network,
/// and the number of datagrams dropped because of full buffers.
///
/// # Panics
/// Panics if `/proc/thread-self/net/udp` cannot be read.
#[must_use]
pub fn queued(ports: &[u16]) -> (u64, u64) {
    let table = fs::read_to_string("/proc/thread-self/net/udp").unwrap();
    let mut sums = (0, 0);
    for line in table.lines().skip(1) {
        let columns: Vec<&str> = line.split_whitespace().collect();
        let port = columns[1].rsplit(':').next().unwrap();
        if ports.contains(&u16::from_str_radix(port, 16).unwrap()) {
            let (_, queue) = columns[4].split_once(':').unwrap();
            sums.0 += u64::from_str_radix(queue, 16).unwrap();
            sums.1 += columns[12].parse::<u64>().unwrap();
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_heartbeat_up_to_the_last_number_there_is_claims_too_much() {
        let mut datagram = vec![0; HEADER];
        datagram.extend([0x07, 1, 28, 0]);
        datagram.extend([0; 8]);
        datagram.extend([0, 0, 0, 0, 1, 0, 0, 0]);
        datagram.extend([0, 0, 0, 0, 9, 0, 0, 0]);
        datagram.extend([1, 0, 0, 0]);
        assert!(!claims_too_much(&datagram));
        datagram[HEADER + 20 + 3] = 0x7f;
        assert!(claims_too_much(&datagram));
    }

    #[test]
    fn the_same_seed_makes_the_same_datagrams_and_they_are_of_all_kinds() {
        let of = |seed| {
            let mut mutator = Mutator::new([7; 12], seed);
            (0..2000).map(|_| mutator.datagram()).collect::<Vec<_>>()
        };
        assert_eq!(of(3), of(3));
        let mut kinds: Vec<u8> = Mutator::new([7; 12], 1)
            .corpus()
            .iter()
            .flat_map(|datagram| submessages(datagram).into_iter().map(|at| datagram[at]))
            .collect();
        kinds.sort_unstable();
        kinds.dedup();
        for kind in [
            0x06, 0x07, 0x08, 0x09, 0x0c, 0x0d, 0x0e, 0x0f, 0x12, 0x13, 0x15, 0x16,
        ] {
            assert!(kinds.contains(&kind), "{kind:#04x} is in none of the files");
        }
    }
}
