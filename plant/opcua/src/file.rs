//! Files that clients open, read and write with Methods (OPC 10000-20, 4.2).
//!
//! [`Handles`] contains the open handles of a file. Each read handle has a copy of the content at
//! the time of its opening. The owner of the file provides the content, and applies the written
//! content.

use std::collections::BTreeMap;
use std::time::Duration;

use opcua::types::{ByteString, StatusCode, Variant};
use tokio::time::Instant;

use crate::server::{MethodRefusal, MethodRequest, SessionPresence};

/// A method of a file object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileMethod {
    /// Opens the file for reading, or for writing from its beginning.
    Open,
    /// Opens selected parts of the file for reading.
    OpenWithMasks,
    /// Reads from the position of the handle.
    Read,
    /// Writes at the position of the handle.
    Write,
    /// Closes the handle and discards the written content.
    Close,
    /// Closes the handle and applies the written content.
    CloseAndUpdate,
    /// Returns the position of the handle.
    GetPosition,
    /// Sets the position of the handle.
    SetPosition,
}

/// The open handles of a file.
#[derive(Default)]
pub struct Handles {
    last: u32,
    all: BTreeMap<u32, Handle>,
}

struct Handle {
    session: u32,
    presence: SessionPresence,
    content: Vec<u8>,
    position: usize,
    is_writing: bool,
    /// When the handle was used last.
    used: Instant,
}

/// The result of a method of a file.
pub type FileAnswer = Result<Vec<Variant>, MethodRefusal>;

impl Handles {
    /// Returns the number of open handles.
    #[must_use]
    pub fn len(&self) -> usize {
        self.all.len()
    }

    /// Returns whether the file is not open.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Closes the handles of ended sessions and handles that timed out: an idle client would block
    /// writers.
    pub fn tidy(&mut self) {
        let lasts =
            |handle: &Handle| handle.presence.lasts() && handle.used.elapsed() < LONGEST_UNUSED;
        self.all.retain(|_, handle| lasts(handle));
    }

    /// Closes the handles of an ended session.
    pub fn close_session(&mut self, session: u32) {
        self.all.retain(|_, handle| handle.session != session);
    }

    /// Opens a handle for the session of a request, for reading the content or for writing after
    /// it. Returns the number of the handle.
    ///
    /// # Errors
    /// `BadInvalidState` if the file is open for writing, or, for a writer, if the file is open at
    /// all; `BadTooManyOperations` if there are too many handles.
    pub fn add(
        &mut self,
        request: &MethodRequest,
        content: Vec<u8>,
        is_writing: bool,
    ) -> FileAnswer {
        self.tidy();
        let is_read = self.all.values().all(|handle| !handle.is_writing);
        if !is_read || (is_writing && !self.all.is_empty()) {
            return Err(StatusCode::BadInvalidState.into());
        }
        let session = request.caller.session;
        let own = self.all.values().filter(|one| one.session == session);
        if self.all.len() >= MOST_OPEN || own.count() >= MOST_OF_SESSION {
            return Err(StatusCode::BadTooManyOperations.into());
        }
        self.last = self.last.wrapping_add(1).max(1);
        let number = self.last;
        let handle = Handle {
            session,
            presence: request.presence.clone(),
            content,
            position: 0,
            is_writing,
            used: Instant::now(),
        };
        self.all.insert(number, handle);
        Ok(vec![Variant::UInt32(number)])
    }

    /// Executes a method of an open handle: Read, Write, Close, GetPosition or SetPosition.
    ///
    /// # Errors
    /// Returns the refusal of the method; `BadInvalidArgument` for the other methods.
    pub fn call(&mut self, method: FileMethod, request: &MethodRequest) -> FileAnswer {
        let session = request.caller.session;
        match (method, request.arguments.as_slice()) {
            (FileMethod::Read, [Variant::UInt32(handle), Variant::Int32(length)]) => {
                self.of(session, *handle)?.read(*length)
            }
            (FileMethod::Write, [Variant::UInt32(handle), Variant::ByteString(data)]) => {
                self.of(session, *handle)?.write(data)
            }
            (FileMethod::Close, [Variant::UInt32(handle)]) => {
                self.take(session, *handle).map(|_| Vec::new())
            }
            (FileMethod::GetPosition, [Variant::UInt32(handle)]) => {
                let position = self.of(session, *handle)?.position;
                let position = u64::try_from(position).unwrap_or(u64::MAX);
                Ok(vec![Variant::UInt64(position)])
            }
            (FileMethod::SetPosition, [Variant::UInt32(handle), Variant::UInt64(position)]) => {
                let handle = self.of(session, *handle)?;
                let wanted = usize::try_from(*position).unwrap_or(usize::MAX);
                handle.position = wanted.min(handle.content.len());
                Ok(Vec::new())
            }
            (
                FileMethod::Open
                | FileMethod::OpenWithMasks
                | FileMethod::Read
                | FileMethod::Write
                | FileMethod::Close
                | FileMethod::CloseAndUpdate
                | FileMethod::GetPosition
                | FileMethod::SetPosition,
                _,
            ) => Err(StatusCode::BadInvalidArgument.into()),
        }
    }

    /// Closes a handle of a session, and returns the written content.
    ///
    /// # Errors
    /// `BadInvalidArgument` if the session has no handle with this number; `BadInvalidState` if the
    /// handle was opened for reading.
    pub fn written(&mut self, session: u32, number: u32) -> Result<Vec<u8>, MethodRefusal> {
        let handle = self.take(session, number)?;
        match handle.is_writing {
            true => Ok(handle.content),
            false => Err(StatusCode::BadInvalidState.into()),
        }
    }

    fn of(&mut self, session: u32, number: u32) -> Result<&mut Handle, MethodRefusal> {
        self.tidy();
        match self.all.get_mut(&number) {
            Some(handle) if handle.session == session => {
                handle.used = Instant::now();
                Ok(handle)
            }
            // A handle belongs to the session that opened it (OPC 10000-20, 4.2.2).
            Some(_) | None => Err(StatusCode::BadInvalidArgument.into()),
        }
    }

    fn take(&mut self, session: u32, number: u32) -> Result<Handle, MethodRefusal> {
        self.of(session, number)?;
        let taken = self.all.remove(&number);
        taken.ok_or_else(|| StatusCode::BadInvalidArgument.into())
    }
}

impl Handle {
    fn read(&mut self, length: i32) -> FileAnswer {
        if self.is_writing {
            return Err(StatusCode::BadInvalidState.into());
        }
        let length = usize::try_from(length).map_err(|_| StatusCode::BadInvalidArgument)?;
        let rest = self.content.get(self.position..).unwrap_or_default();
        let read: Vec<u8> = rest.iter().take(length.min(MOST_READ)).copied().collect();
        self.position += read.len();
        Ok(vec![Variant::ByteString(ByteString::from(read))])
    }

    fn write(&mut self, data: &ByteString) -> FileAnswer {
        let data = data.value.as_deref().unwrap_or_default();
        if !self.is_writing {
            return Err(StatusCode::BadInvalidState.into());
        }
        // Writing after SetPosition overwrites existing content.
        let end = self.position.saturating_add(data.len());
        if end > LARGEST {
            return Err(StatusCode::BadRequestTooLarge.into());
        }
        self.content.resize(self.content.len().max(end), 0);
        if let Some(there) = self.content.get_mut(self.position..end) {
            there.copy_from_slice(data);
        }
        self.position = end;
        Ok(Vec::new())
    }
}

/// Largest size of a written file in bytes.
pub const LARGEST: usize = 1 << 20;
/// Timeout of an unused handle.
pub const LONGEST_UNUSED: Duration = Duration::from_secs(60);
/// The open mode for reading, a bit mask (OPC 10000-20, 4.2.2).
pub const READ: u8 = 1;
/// The open mode for writing with EraseExisting.
pub const WRITE_ANEW: u8 = 6;
const MOST_OPEN: usize = 20;
const MOST_OF_SESSION: usize = 5;
/// Maximum number of bytes of a Read response.
const MOST_READ: usize = 1 << 20;

#[cfg(test)]
pub(crate) mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use opcua::types::NodeId;

    use super::*;
    use crate::server::SessionCaller;

    /// Returns a call of an active session.
    pub(crate) fn request(session: u32, arguments: &[Variant]) -> MethodRequest {
        request_while(session, arguments, || true)
    }

    fn request_while(
        session: u32,
        arguments: &[Variant],
        lasts: impl Fn() -> bool + Send + Sync + 'static,
    ) -> MethodRequest {
        MethodRequest {
            caller: SessionCaller {
                session,
                user: "anonymous".to_owned(),
                application_uri: String::new(),
                proven: false,
                encrypted: true,
                certificate: None,
            },
            presence: SessionPresence::while_(lasts),
            object: NodeId::null(),
            method: NodeId::null(),
            name: String::new(),
            arguments: arguments.to_vec(),
        }
    }

    fn refused(status: StatusCode) -> FileAnswer {
        Err(status.into())
    }

    #[test]
    fn one_that_a_client_left_open_keeps_nobody_from_writing_for_long() {
        let mut handles = Handles::default();
        let left = handles.add(&request(1, &[]), vec![1], false).unwrap();
        let writes = handles.add(&request(2, &[]), Vec::new(), true);
        assert_eq!(writes, refused(StatusCode::BadInvalidState));
        for handle in handles.all.values_mut() {
            handle.used = handle.used.checked_sub(LONGEST_UNUSED).unwrap();
        }
        handles.add(&request(2, &[]), Vec::new(), true).unwrap();
        let late = handles.call(FileMethod::Close, &request(1, &left));
        assert_eq!(late, refused(StatusCode::BadInvalidArgument));
    }

    #[test]
    fn those_of_a_session_that_is_gone_are_closed() {
        let mut handles = Handles::default();
        let there = Arc::new(AtomicBool::new(true));
        let seen = Arc::clone(&there);
        let of_one = request_while(1, &[], move || seen.load(Ordering::Relaxed));
        handles.add(&of_one, vec![1], false).unwrap();
        handles.add(&request(2, &[]), vec![1], false).unwrap();
        handles.tidy();
        assert_eq!(handles.len(), 2);
        there.store(false, Ordering::Relaxed);
        handles.tidy();
        assert_eq!(handles.len(), 1);
    }

    #[test]
    fn a_session_leaves_room_for_others_and_closing_gives_back() {
        let mut handles = Handles::default();
        let mut opened = Vec::new();
        for _ in 0..MOST_OF_SESSION {
            opened = handles.add(&request(1, &[]), vec![1], false).unwrap();
        }
        let more = handles.add(&request(1, &[]), vec![1], false);
        assert_eq!(more, refused(StatusCode::BadTooManyOperations));
        handles.add(&request(2, &[]), vec![1], false).unwrap();
        handles
            .call(FileMethod::Close, &request(1, &opened))
            .unwrap();
        handles.add(&request(1, &[]), vec![1], false).unwrap();
        let all = (3..).take(MOST_OPEN).map(|session| {
            let added = handles.add(&request(session, &[]), vec![1], false);
            added.is_ok()
        });
        let all: Vec<bool> = all.collect();
        assert_eq!(
            all.iter().filter(|is_open| **is_open).count() + 6,
            MOST_OPEN
        );
    }

    #[test]
    fn it_is_read_on_from_where_it_was_and_from_elsewhere() {
        let mut handles = Handles::default();
        let number = handles.add(&request(1, &[]), vec![1, 2, 3, 4], false);
        let number = number.unwrap().remove(0);
        let mut call = |method, more: &[Variant]| {
            let arguments = [std::slice::from_ref(&number), more].concat();
            handles.call(method, &request(1, &arguments)).unwrap()
        };
        let bytes = |bytes: &[u8]| vec![Variant::ByteString(ByteString::from(bytes.to_vec()))];
        assert_eq!(
            call(FileMethod::Read, &[Variant::Int32(3)]),
            bytes(&[1, 2, 3])
        );
        let position = call(FileMethod::GetPosition, &[]);
        assert_eq!(position, [Variant::UInt64(3)]);
        call(FileMethod::SetPosition, &[Variant::UInt64(1)]);
        assert_eq!(
            call(FileMethod::Read, &[Variant::Int32(9)]),
            bytes(&[2, 3, 4])
        );
        call(FileMethod::SetPosition, &[Variant::UInt64(u64::MAX)]);
        assert_eq!(call(FileMethod::Read, &[Variant::Int32(9)]), bytes(&[]));
    }
}
