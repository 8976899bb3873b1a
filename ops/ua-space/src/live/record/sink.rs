//! Writes a recording to its file, on a thread, so that a slow disk does not stop the receiver.

use std::fs::{File, OpenOptions};
use std::io::{self, Write as _};
use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

use crate::exit::CommandFailure;

/// A file that is written in whole parts. A file that cannot be written on ends with its last whole
/// part.
#[derive(Debug)]
pub(super) struct RecordingFile {
    name: String,
    /// Taken at the end, so that the thread ends.
    queue: Option<SyncSender<Vec<u8>>>,
    thread: Option<JoinHandle<Result<(), Unwritten>>>,
    /// The bytes in all parts so far.
    length: u64,
}

/// The error of the file, and the number of its whole bytes.
#[derive(Debug)]
struct Unwritten {
    error: io::Error,
    whole: u64,
}

impl RecordingFile {
    /// Creates the file.
    ///
    /// # Errors
    /// [`CommandFailure::Io`], also if the file exists.
    pub(super) fn create(path: &Path) -> Result<Self, CommandFailure> {
        let name = path.display().to_string();
        let file = OpenOptions::new().write(true).create_new(true).open(path);
        let file = file.map_err(|error| {
            CommandFailure::Io(if error.kind() == io::ErrorKind::AlreadyExists {
                format!("{name} exists; give the recording another name")
            } else {
                format!("cannot create {name}: {error}")
            })
        })?;
        let (queue, parts) = sync_channel(MOST_PARTS);
        let thread = std::thread::Builder::new()
            .name("recording".to_owned())
            .spawn(move || write(file, &parts))
            .map_err(|error| CommandFailure::Io(format!("cannot start a thread: {error}")))?;
        Ok(Self {
            name,
            queue: Some(queue),
            thread: Some(thread),
            length: 0,
        })
    }

    /// Returns the offset of the next part in the file.
    pub(super) const fn length(&self) -> u64 {
        self.length
    }

    /// Hands a part over to the disk, unless too many parts wait. Returns whether the part was
    /// taken, and then empties it.
    ///
    /// # Errors
    /// [`CommandFailure::Io`] if the file cannot be written.
    pub(super) fn offer(&mut self, part: &mut Vec<u8>) -> Result<bool, CommandFailure> {
        if part.is_empty() {
            return Ok(true);
        }
        let length = u64::try_from(part.len()).unwrap_or_default();
        let Some(queue) = &self.queue else {
            return Err(self.failed());
        };
        match queue.try_send(std::mem::take(part)) {
            Ok(()) => {
                self.length += length;
                Ok(true)
            }
            Err(TrySendError::Full(back)) => {
                *part = back;
                Ok(false)
            }
            Err(TrySendError::Disconnected(_)) => Err(self.failed()),
        }
    }

    /// Writes the last part, and waits for the disk. Returns the length of the file.
    ///
    /// # Errors
    /// [`CommandFailure::Io`] if the file cannot be written.
    pub(super) fn finish(mut self, part: Vec<u8>) -> Result<u64, CommandFailure> {
        self.length += u64::try_from(part.len()).unwrap_or_default();
        let is_sent = self
            .queue
            .take()
            .is_some_and(|queue| queue.send(part).is_ok());
        match (is_sent, self.end()) {
            (true, None) => Ok(self.length),
            (_, failure) => Err(failure.unwrap_or_else(|| self.failed())),
        }
    }

    /// Ends the thread and returns its failure.
    fn failed(&mut self) -> CommandFailure {
        self.queue = None;
        self.end()
            .unwrap_or_else(|| CommandFailure::Io(format!("cannot write {}", self.name)))
    }

    fn end(&mut self) -> Option<CommandFailure> {
        let Ok(ended) = self.thread.take()?.join() else {
            return Some(CommandFailure::Io(format!(
                "cannot write {}: its thread ended",
                self.name
            )));
        };
        let Unwritten { error, whole } = ended.err()?;
        let name = &self.name;
        Some(CommandFailure::Io(format!(
            "cannot write {name}: {error}; its first {whole} bytes are written, up to a whole message"
        )))
    }
}

/// Writes the parts until the sender ends.
fn write(mut file: File, parts: &Receiver<Vec<u8>>) -> Result<(), Unwritten> {
    let mut whole = 0;
    for part in parts {
        if let Err(error) = file.write_all(&part) {
            // Without this the file ends within a part; readers then report a damaged file.
            let _shorter = file.set_len(whole);
            return Err(Unwritten { error, whole });
        }
        whole += u64::try_from(part.len()).unwrap_or_default();
    }
    file.sync_all().map_err(|error| Unwritten { error, whole })
}

/// Maximum number of parts that wait for the disk.
const MOST_PARTS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_that_cannot_take_more_is_reported_with_its_file() {
        // The kernel answers every write to this device as a full disk does.
        let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let (queue, parts) = sync_channel(1);
        queue.send(vec![1]).unwrap();
        drop(queue);
        let unwritten = write(full, &parts).unwrap_err();
        assert_eq!(unwritten.error.kind(), io::ErrorKind::StorageFull);
        assert_eq!(unwritten.whole, 0);
    }

    #[test]
    fn a_recording_replaces_no_file() {
        let existing = std::env::current_exe().unwrap();
        let failure = RecordingFile::create(&existing).unwrap_err();
        assert!(failure.to_string().contains("exists"), "{failure}");
    }
}
