//! Shows a recording on the page.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{Failure, FailureKind};
use supervisor::Page;
use tokio::task::spawn_blocking;
use uadp::{FieldEncoding, MessageKind, NetworkMessage, NetworkMessageType, Timestamp};

use crate::exit;
use crate::live::book::{Book, DatagramContent, ReceivedSample};
use crate::recorded::{RecordedDatagram, RecordingReader};
use crate::report::warn;

/// Shows the recording on the page. The file is read beside the page.
///
/// # Errors
/// The file cannot be read, or is no capture.
pub(super) fn show(file: &Path, page: Arc<Page>) -> Result<(), Failure> {
    // A file that cannot be read ends the program at its start.
    RecordingReader::open(file)
        .map_err(|error| Failure::new(FailureKind::Io, error.to_string()))?;
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    page.show_recording(&name);
    let file = PathBuf::from(file);
    drop(spawn_blocking(move || {
        if let Err(error) = read(&file, &page) {
            warn(&format!("the recording is shown up to here: {error}"));
        }
    }));
    Ok(())
}

/// Reads the descriptions first, so that all values have their names.
fn read(file: &Path, page: &Page) -> Result<(), exit::CommandFailure> {
    let mut first = None;
    let mut recorded = RecordingReader::open(file)?;
    while let Some(datagram) = recorded.next()? {
        let begin = *first.get_or_insert(datagram.time);
        let is_announcement = NetworkMessage::decode(&datagram.bytes)
            .is_ok_and(|message| message.message_type() == NetworkMessageType::Announcement);
        if is_announcement {
            page.recorded_datagram(&datagram.bytes, datagram.from, time(&datagram, begin));
        }
    }
    let mut book = Book::new();
    let mut recorded = RecordingReader::open(file)?;
    while let (Some(datagram), Some(begin)) = (recorded.next()?, first) {
        let Ok(message) = NetworkMessage::decode(&datagram.bytes) else {
            continue;
        };
        let at = time(&datagram, begin);
        if message.is_action() {
            page.recorded_datagram(&datagram.bytes, datagram.from, at);
            continue;
        }
        book.handle((&message, datagram.from), at.0, &mut |news| {
            if let DatagramContent::Sample(sample) = news {
                value(page, &sample, at);
            }
        });
    }
    Ok(())
}

/// Shows a value in Variant encoding; values in other encodings are left out.
fn value(page: &Page, sample: &ReceivedSample<'_>, at: (Duration, Timestamp)) {
    let message = &sample.message;
    let is_value = matches!(message.kind, MessageKind::KeyFrame | MessageKind::Event);
    if !is_value || message.encoding() != FieldEncoding::Variant || !message.is_valid() {
        return;
    }
    let header = message.header();
    let value = supervisor::Recorded {
        topic: sample.topic,
        block: message.payload(),
        source: sample.taken().map(Timestamp::from_unix_nanos),
        status: header.status.unwrap_or_default(),
    };
    page.recorded_value(&value, at);
}

/// Returns the time since the first datagram, and the time of the day.
fn time(datagram: &RecordedDatagram, begin: i128) -> (Duration, Timestamp) {
    let since = u64::try_from(datagram.time - begin).unwrap_or_default();
    let utc = Timestamp::from_unix_nanos(datagram.time);
    (Duration::from_nanos(since), utc)
}
