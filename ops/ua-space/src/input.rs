//! Reads files: whole, or their datagrams (one datagram, several lines, or a recording).

use std::fs::File;
use std::io::{self, BufReader, Read};

use crate::capture::{CaptureError, CaptureReader, is_capture};
use crate::exit::CommandFailure;
use crate::hex;

/// A file with its detected format.
pub(crate) enum InputFile {
    /// One datagram, as hexadecimal text or as bytes.
    Datagram(Vec<u8>),
    /// One datagram per line, each with its line number.
    Lines(Vec<(usize, Vec<u8>)>),
    Capture(CaptureReader<Box<dyn Read>>),
    /// An MCAP file, after its first four bytes.
    Mcap(Box<dyn Read>),
}

/// A file whose format is known by its first bytes, or any other file.
enum DetectedFile {
    Recording(InputFile),
    /// The first bytes, and the rest.
    Other(Vec<u8>, Box<dyn Read>),
}

/// Opens a capture or an MCAP file, `-` for stdin; `None` if it is another file.
pub(crate) fn open_recording(file: &str) -> Result<Option<InputFile>, CommandFailure> {
    match detect(file)? {
        DetectedFile::Recording(recording) => Ok(Some(recording)),
        DetectedFile::Other(..) => Ok(None),
    }
}

fn detect(file: &str) -> Result<DetectedFile, CommandFailure> {
    let reading = |error: io::Error| CommandFailure::reading(name(file), &error);
    let mut reader: Box<dyn Read> = match file {
        "-" => Box::new(io::stdin().lock()),
        path => Box::new(BufReader::new(File::open(path).map_err(reading)?)),
    };
    let mut start = Vec::new();
    reader
        .by_ref()
        .take(4)
        .read_to_end(&mut start)
        .map_err(reading)?;
    if start.first_chunk().copied().is_some_and(is_mcap) {
        return Ok(DetectedFile::Recording(InputFile::Mcap(reader)));
    }
    if let Some(magic) = start
        .first_chunk()
        .copied()
        .filter(|magic| is_capture(*magic))
    {
        let capture = CaptureReader::new(magic, reader).map_err(|error| failure(file, error))?;
        return Ok(DetectedFile::Recording(InputFile::Capture(capture)));
    }
    Ok(DetectedFile::Other(start, reader))
}

/// Opens a file, `-` for stdin. With `lines`, every line of hexadecimal text is a datagram.
pub(crate) fn open(file: &str, lines: bool) -> Result<InputFile, CommandFailure> {
    let reading = |error: io::Error| CommandFailure::reading(name(file), &error);
    let (mut bytes, reader) = match detect(file)? {
        DetectedFile::Recording(recording) => return Ok(recording),
        DetectedFile::Other(start, reader) => (start, reader),
    };
    reader
        .take(MAX_BYTES)
        .read_to_end(&mut bytes)
        .map_err(reading)?;
    let wrong = |what: String| CommandFailure::Data(format!("{}: {what}", name(file)));
    match text(&bytes) {
        _ if bytes.iter().all(u8::is_ascii_whitespace) => Err(wrong("empty".to_owned())),
        None if lines => Err(wrong("no text, so --lines has no lines".to_owned())),
        None => Ok(InputFile::Datagram(bytes)),
        Some(text) if text.trim_start().starts_with(['{', '[']) => {
            let hint = "this is JSON; `ua-space encode` makes datagrams of it";
            Err(wrong(hint.to_owned()))
        }
        Some(text) if lines => read_lines(text).map_err(|error| wrong(error.to_string())),
        Some(text) => match hex::parse(text) {
            Ok(bytes) if bytes.is_empty() => Err(wrong("no hexadecimal digits".to_owned())),
            Ok(bytes) => Ok(InputFile::Datagram(bytes)),
            Err(error) => Err(wrong(error.to_string())),
        },
    }
}

/// Reads a whole file, `-` for stdin. The rest of a very large file is left out.
pub(crate) fn read(file: &str) -> Result<Vec<u8>, CommandFailure> {
    let mut bytes = Vec::new();
    let read = match file {
        "-" => io::stdin().lock().take(LARGEST).read_to_end(&mut bytes),
        path => File::open(path).and_then(|file| file.take(LARGEST).read_to_end(&mut bytes)),
    };
    read.map_err(|error| CommandFailure::reading(name(file), &error))?;
    Ok(bytes)
}

/// Returns the name of the file for messages.
pub(crate) fn name(file: &str) -> &str {
    match file {
        "-" => "stdin",
        path => path,
    }
}

/// Returns the failure for an error of a capture.
pub(crate) fn failure(file: &str, error: CaptureError) -> CommandFailure {
    match error {
        CaptureError::Io(error) => CommandFailure::reading(name(file), &error),
        error @ (CaptureError::CutOff(_) | CaptureError::Broken { .. }) => {
            CommandFailure::Data(format!("{}: {error}", name(file)))
        }
    }
}

/// Returns the bytes as text, unless they contain control characters. A datagram always contains
/// some, because its counts and lengths are small numbers.
fn text(bytes: &[u8]) -> Option<&str> {
    let control = |byte: &u8| byte.is_ascii_control() && !byte.is_ascii_whitespace();
    if bytes.iter().any(control) {
        None
    } else {
        str::from_utf8(bytes).ok()
    }
}

fn read_lines(text: &str) -> Result<InputFile, hex::HexError> {
    let mut datagrams = Vec::new();
    for (line, number) in text.lines().zip(1..) {
        let mut datagram = Vec::new();
        hex::parse_line(line, number, &mut datagram)?;
        if !datagram.is_empty() {
            datagrams.push((number, datagram));
        }
    }
    Ok(InputFile::Lines(datagrams))
}

/// Maximum size of a datagram file with its comments, in bytes.
const MAX_BYTES: u64 = 1 << 30;
/// Maximum size of any other file, in bytes.
const LARGEST: u64 = 256 << 20;

/// Returns true if these are the first bytes of an MCAP file.
const fn is_mcap(start: [u8; 4]) -> bool {
    matches!(start, [0x89, b'M', b'C', b'A'])
}
