//! Mutated conversations of a client that no correct client would send. Other clients are served
//! throughout.
//!
//! The corpus in `fuzz/corpus/opcua` has a frame of asyncua for each service. `UA_FUZZ_CONNECTIONS`
//! and `UA_FUZZ_SEED` set the number of connections and their seed.

use std::io::{self, Read as _, Write as _};
use std::net::{Shutdown, TcpStream};
use std::path::Path;
use std::{env, fs};

use serde_json::json;
use system_tests::{Cell, Peer, SERVER_ENDPOINT, UadpSocket, peak, resident};

use super::{
    DataSetHeader, MAPPING, SOON, TEMPERATURE, TEMPERATURE_NODE, key_frame, serving, shows, watch,
};

#[test]
fn malformed_chunks_of_many_clients_neither_stop_nor_swell_the_server() {
    let setting =
        |name: &str, otherwise: u64| env::var(name).map_or(otherwise, |text| text.parse().unwrap());
    let connections = setting("UA_FUZZ_CONNECTIONS", 1500);
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // The sessions of closed connections last a minute.
    let mapping = format!("{MAPPING}  limits: {{sessions: 10000}}\n");
    let mut server = serving(&cell, &mapping);
    let group = UadpSocket::join();
    let mut other = watch(&cell, TEMPERATURE_NODE);
    other.wait_for_json("the other client has subscribed", SOON, |line| {
        line.get("status").map(drop)
    });
    let mut turn = 0_u16;
    let mut goes_on = || {
        turn += 1;
        let value = f64::from(turn);
        group.send(&key_frame(
            TEMPERATURE,
            turn,
            value,
            DataSetHeader::default(),
        ));
        shows(&mut other, "Good", &json!(value));
    };
    goes_on();
    let before = resident(server.id());
    let mut stranger = Stranger::new(setting("UA_FUZZ_SEED", 1));
    let step = (connections / 15).max(1);
    let (mut opened, mut entered) = (0, 0);
    for number in 0..connections {
        match stranger.visit(number % 8) {
            Reached::Session => entered += 1,
            Reached::Channel => opened += 1,
            Reached::Nothing => {}
        }
        if number % step == step - 1 {
            goes_on();
        }
    }
    assert!(server.runs());
    println!(
        "{connections} connections, {opened} with a channel, {entered} with a session: {} kB, {} kB at the most, {} kB before",
        resident(server.id()) >> 10,
        peak(server.id()) >> 10,
        before >> 10
    );
    assert!(opened > connections / 5, "{opened} channels");
    assert!(entered > connections / 5, "{entered} sessions");
    let panics: Vec<String> = server.lines();
    let panics = panics.iter().filter(|line| line.contains("panicked"));
    let panics: Vec<&String> = panics.collect();
    assert!(panics.is_empty(), "{panics:?}");
    let grown = peak(server.id()).saturating_sub(before);
    assert!(grown < MOST_GROWTH, "{grown} bytes more than before");
}

/// The progress of a conversation.
enum Reached {
    Nothing,
    Channel,
    Session,
}

/// A client that sends mutated messages. The same seed sends the same messages.
pub(super) struct Stranger {
    hello: Vec<u8>,
    open: Vec<u8>,
    create: Vec<u8>,
    activate: Vec<u8>,
    requests: Vec<Vec<u8>>,
    random: u64,
}

/// A channel that the server has opened.
pub(super) struct OpenedChannel {
    id: [u8; 4],
    token: [u8; 4],
    sequence: u32,
    /// The AuthenticationToken of the session, if there is a session.
    session: Option<Vec<u8>>,
}

impl Stranger {
    pub(super) fn new(seed: u64) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus/opcua");
        let mut paths: Vec<_> = fs::read_dir(&folder)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        paths.sort();
        let named = |name: &str| fs::read(folder.join(name)).unwrap();
        let requests = paths.iter().map(|path| fs::read(path).unwrap());
        Self {
            hello: named("hello"),
            open: named("open"),
            create: named("create_session"),
            activate: named("activate_session"),
            requests: requests
                .filter(|frame| matches!(&frame[..3], b"MSG" | b"CLO"))
                .collect(),
            random: seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1,
        }
    }

    /// Makes a connection, which ends when the server has closed it.
    fn visit(&mut self, kind: u64) -> Reached {
        let mut stream = TcpStream::connect(SERVER_ENDPOINT.trim_start_matches("opc.tcp://"))
            .expect("the server listens");
        stream.set_read_timeout(Some(SOON)).unwrap();
        stream.set_write_timeout(Some(SOON)).unwrap();
        let mut reached = Reached::Nothing;
        let said = self.say(&mut stream, kind, &mut reached);
        // The server closes the connection at the first error.
        drop(said);
        drop(stream.shutdown(Shutdown::Write));
        let mut heard = Vec::new();
        if let Err(error) = stream.read_to_end(&mut heard) {
            let gone = [io::ErrorKind::ConnectionReset, io::ErrorKind::BrokenPipe];
            assert!(gone.contains(&error.kind()), "it is not closed: {error}");
        }
        assert!(heard.len() < MOST_HEARD, "{} bytes", heard.len());
        reached
    }

    fn say(&mut self, stream: &mut TcpStream, kind: u64, reached: &mut Reached) -> io::Result<()> {
        if kind == 0 {
            let chosen = self.below(self.requests.len() + 2);
            let mut frame = match chosen {
                0 => self.hello.clone(),
                1 => self.open.clone(),
                _ => self.requests[chosen - 2].clone(),
            };
            self.change(&mut frame, 0);
            return stream.write_all(&frame);
        }
        stream.write_all(&self.hello)?;
        answer(stream)?;
        if kind == 1 {
            let mut frame = self.open.clone();
            self.change(&mut frame, 8);
            self.set_size(&mut frame);
            return stream.write_all(&frame);
        }
        let mut channel = self.open_channel(stream)?;
        *reached = Reached::Channel;
        if kind > 4 {
            self.create_session(stream, &mut channel)?;
            self.activate_session(stream, &mut channel)?;
            *reached = Reached::Session;
        }
        for _ in 0..REQUESTS {
            let chosen = self.below(self.requests.len());
            let mut frame = channel.addressed(&self.requests[chosen].clone());
            let from = if self.below(8) == 0 { 0 } else { BODY };
            for _ in 0..self.below(4) {
                self.change(&mut frame, from);
            }
            self.set_size(&mut frame);
            if self.below(8) == 0 {
                frame = self.split(&frame, &mut channel);
            }
            stream.write_all(&frame)?;
        }
        Ok(())
    }

    /// Opens a channel, after a HELLO.
    fn open_channel(&self, stream: &mut TcpStream) -> io::Result<OpenedChannel> {
        stream.write_all(&self.open)?;
        Ok(OpenedChannel::opened(&answer(stream)?))
    }

    /// Connects, and opens a channel without security.
    pub(super) fn connected(&self) -> io::Result<(TcpStream, OpenedChannel)> {
        let mut stream = TcpStream::connect(SERVER_ENDPOINT.trim_start_matches("opc.tcp://"))?;
        stream.set_read_timeout(Some(SOON))?;
        stream.set_write_timeout(Some(SOON))?;
        stream.write_all(&self.hello)?;
        answer(&mut stream)?;
        let channel = self.open_channel(&mut stream)?;
        Ok((stream, channel))
    }

    /// Creates a session on a channel.
    pub(super) fn create_session(
        &self,
        stream: &mut TcpStream,
        channel: &mut OpenedChannel,
    ) -> io::Result<()> {
        let create = channel.addressed(&self.create);
        stream.write_all(&create)?;
        channel.session = Some(token(&answer(stream)?)?);
        Ok(())
    }

    /// Activates the session of a channel. Returns the response.
    pub(super) fn activate_session(
        &self,
        stream: &mut TcpStream,
        channel: &mut OpenedChannel,
    ) -> io::Result<Vec<u8>> {
        let activate = channel.addressed(&self.activate);
        stream.write_all(&activate)?;
        answer(stream)
    }

    /// Mutates a frame at or after position `from`.
    fn change(&mut self, frame: &mut Vec<u8>, from: usize) {
        const NUMBERS: [u32; 9] = [
            0,
            1,
            2,
            0xFFFF,
            0x0010_0000,
            0x7FFF_FFFF,
            0x8000_0000,
            0xFFFF_FFFE,
            u32::MAX,
        ];
        if frame.len() <= from {
            return;
        }
        let at = from + self.below(frame.len() - from);
        match self.below(7) {
            0 => frame[at] ^= 1 << self.below(8),
            1 => frame[at] = self.byte(),
            2 => {
                let number = NUMBERS[self.below(NUMBERS.len())].to_le_bytes();
                for (byte, to) in frame[at..].iter_mut().zip(number) {
                    *byte = to;
                }
            }
            3 => frame.truncate(at),
            4 => {
                let piece = frame[at..].to_vec();
                let again = 1 + self.below(3);
                for _ in 0..again {
                    frame.extend_from_slice(&piece);
                }
            }
            // Variants, DiagnosticInfos and ExtensionObjects nest.
            5 => {
                let nested = [[24, 1, 0, 0, 0].as_slice(), &[0x40], &[1, 0x99, 0, 1]];
                let piece = nested[self.below(nested.len())].repeat(1 + self.below(500));
                drop(frame.splice(at..at, piece));
            }
            _ => {
                let chosen = self.below(self.requests.len());
                let other = self.requests[chosen].clone();
                let begin = self.below(other.len());
                drop(frame.splice(at.., other[begin..].iter().copied()));
            }
        }
    }

    /// Sets the size of the frame, which is right most times.
    fn set_size(&mut self, frame: &mut [u8]) {
        let Ok(size) = u32::try_from(frame.len()) else {
            return;
        };
        let size = if self.below(16) == 0 {
            size.wrapping_add(1 << self.below(32))
        } else {
            size
        };
        if let Some(place) = frame.get_mut(4..8) {
            place.copy_from_slice(&size.to_le_bytes());
        }
    }

    /// Splits a message into two chunks or more. The last chunk may be missing or aborted.
    fn split(&mut self, frame: &[u8], channel: &mut OpenedChannel) -> Vec<u8> {
        let Some((header, body)) = frame.split_at_checked(BODY) else {
            return frame.to_vec();
        };
        let pieces: Vec<&[u8]> = body.chunks(1 + self.below(body.len().max(1))).collect();
        let mut all = Vec::new();
        for (number, piece) in pieces.iter().enumerate() {
            let mut chunk = [header, piece].concat();
            chunk[3] = match (number + 1 == pieces.len(), self.below(8)) {
                (_, 0) => b'A',
                (true, 1) | (false, _) => b'C',
                (true, _) => b'F',
            };
            if number > 0 {
                channel.sequence += 1;
            }
            chunk[16..20].copy_from_slice(&channel.sequence.to_le_bytes());
            let size = u32::try_from(chunk.len()).unwrap();
            chunk[4..8].copy_from_slice(&size.to_le_bytes());
            all.extend(chunk);
        }
        all
    }

    fn byte(&mut self) -> u8 {
        u8::try_from(self.below(256)).unwrap()
    }

    fn below(&mut self, end: usize) -> usize {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        let end = u64::try_from(end.max(1)).unwrap();
        usize::try_from(self.random.wrapping_mul(0x2545_F491_4F6C_DD1D) % end).unwrap()
    }
}

impl OpenedChannel {
    /// Returns the channel of an answer to an OpenSecureChannel request (OPC 10000-6, 6.7.2; OPC
    /// 10000-4, 5.6.2).
    fn opened(answer: &[u8]) -> Self {
        let policy = "http://opcfoundation.org/UA/SecurityPolicy#None".len();
        // The header of the chunk without certificates, the SequenceHeader, the type, the
        // ResponseHeader, the ProtocolVersion.
        let at = 12 + 4 + policy + 4 + 4 + 8 + 4 + 24 + 4;
        Self {
            id: answer[at..at + 4].try_into().unwrap(),
            token: answer[at + 4..at + 8].try_into().unwrap(),
            sequence: 1,
            session: None,
        }
    }

    /// Returns a recorded request as the next request of this channel and its session.
    pub(super) fn addressed(&mut self, frame: &[u8]) -> Vec<u8> {
        self.sequence += 1;
        let mut frame = frame.to_vec();
        frame[8..12].copy_from_slice(&self.id);
        frame[12..16].copy_from_slice(&self.token);
        frame[16..20].copy_from_slice(&self.sequence.to_le_bytes());
        frame[20..24].copy_from_slice(&self.sequence.to_le_bytes());
        let recorded = BODY + 4;
        if let Some(token) = &self.session
            && frame[recorded..].starts_with(TOKEN)
        {
            frame[recorded..recorded + token.len()].copy_from_slice(token);
        }
        frame
    }
}

/// Returns the AuthenticationToken of an answer to a CreateSession request.
fn token(answer: &[u8]) -> io::Result<Vec<u8>> {
    let at = answer
        .windows(TOKEN.len())
        .skip(BODY + 28)
        .position(|bytes| bytes == TOKEN)
        // The maximum number of sessions exists.
        .ok_or(io::ErrorKind::ConnectionRefused)?;
    let begin = BODY + 28 + at;
    Ok(answer[begin..begin + TOKEN.len() + 32].to_vec())
}

/// Returns the next frame of the server.
pub(super) fn answer(stream: &mut TcpStream) -> io::Result<Vec<u8>> {
    let mut frame = vec![0; 8];
    stream.read_exact(&mut frame)?;
    let size = u32::from_le_bytes(frame[4..8].try_into().unwrap());
    assert!((8..=65_536).contains(&size), "a frame of {size} bytes");
    frame.resize(usize::try_from(size).unwrap(), 0);
    stream.read_exact(&mut frame[8..])?;
    Ok(frame)
}

/// The position of the body of a chunk without security.
pub(super) const BODY: usize = 24;
/// The head of a token of this server: an opaque NodeId of namespace 0 with 32 bytes.
const TOKEN: &[u8] = &[5, 0, 0, 32, 0, 0, 0];
/// Requests per connection, if the server does not close it before.
const REQUESTS: usize = 20;
/// The maximum number of bytes that a connection may receive.
const MOST_HEARD: usize = 8 << 20;
const MOST_GROWTH: u64 = 128 << 20;
