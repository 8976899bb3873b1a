//! A trust list as a file that clients open, read and write (OPC 10000-12, 7.8.2; OPC 10000-20, 4.2).
//!
//! Its content is a TrustListDataType in the binary encoding, as it is when the file is opened; what is written counts when it is
//! closed by CloseAndUpdate.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::time::Duration;

use opcua::sync::Mutex;
use opcua::types::{
    BinaryDecodable as _, BinaryEncodable as _, ByteString, ContextOwned, StatusCode,
    TrustListDataType, Variant,
};
use tokio::time::Instant;

use crate::server::{MethodRequest, Refusal};

/// Which lists are meant, as bits (TrustListMasks of OPC 10000-12, 7.8.2.8).
pub mod masks {
    /// Certificates that are trusted.
    pub const TRUSTED_CERTIFICATES: u32 = 1;
    /// Revocation lists of those.
    pub const TRUSTED_CRLS: u32 = 2;
    /// Certificates of authorities that are not trusted themselves.
    pub const ISSUER_CERTIFICATES: u32 = 4;
    /// Revocation lists of those.
    pub const ISSUER_CRLS: u32 = 8;
    /// All of them.
    pub const ALL: u32 = 15;
}

/// What is behind the file.
pub trait TrustList: Send + Sync + 'static {
    /// The lists of these [`masks`].
    fn list(&self, masks: u32) -> TrustListDataType;

    /// Puts the lists that are given in the place of those there. Says whether that counts only after ApplyChanges.
    ///
    /// # Errors
    /// The lists cannot be written, or are none.
    fn replace(&self, list: TrustListDataType) -> Result<bool, StatusCode>;
}

/// A method of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileMethod {
    /// Opens it to be read, or to be written from its beginning.
    Open,
    /// Opens some of its lists to be read.
    OpenWithMasks,
    /// Reads on.
    Read,
    /// Writes on.
    Write,
    /// Closes it; what was written is forgotten.
    Close,
    /// Closes it, and what was written counts.
    CloseAndUpdate,
    /// Says where it is read on.
    GetPosition,
    /// Has it read on from elsewhere.
    SetPosition,
}

/// The file, with those that have it open.
pub struct TrustFile {
    list: Box<dyn TrustList>,
    is_writable: bool,
    open: Mutex<Handles>,
}

impl std::fmt::Debug for TrustFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TrustFile").finish_non_exhaustive()
    }
}

#[derive(Default)]
struct Handles {
    last: u32,
    all: BTreeMap<u32, Handle>,
}

struct Handle {
    session: u32,
    content: Vec<u8>,
    position: usize,
    is_writing: bool,
    /// When it was used last.
    used: Instant,
}

type Answer = Result<Vec<Variant>, Refusal>;

impl TrustFile {
    /// The file of a list, which clients may write or not.
    pub fn new(list: impl TrustList, is_writable: bool) -> Self {
        Self {
            list: Box::new(list),
            is_writable,
            open: Mutex::default(),
        }
    }

    /// How many have it open.
    #[must_use]
    pub fn open_count(&self) -> usize {
        self.open.lock().all.len()
    }

    /// A session is gone, and what it had open is closed.
    pub fn close_session(&self, session: u32) {
        self.open
            .lock()
            .all
            .retain(|_, handle| handle.session != session);
    }

    /// Carries out a method. Who may is looked at before.
    ///
    /// # Errors
    /// Why it is refused.
    pub fn call(&self, method: FileMethod, request: &MethodRequest) -> Answer {
        let session = request.caller.session;
        match (method, request.arguments.as_slice()) {
            (FileMethod::Open, [Variant::Byte(mode)]) => self.open(session, *mode),
            (FileMethod::OpenWithMasks, [Variant::UInt32(masks)]) => {
                self.open_with(session, *masks)
            }
            (FileMethod::Read, [Variant::UInt32(handle), Variant::Int32(length)]) => {
                self.with(session, *handle, |one| one.read(*length))
            }
            (FileMethod::Write, [Variant::UInt32(handle), Variant::ByteString(data)]) => {
                self.with(session, *handle, |one| one.write(data))
            }
            (FileMethod::Close, [Variant::UInt32(handle)]) => {
                self.take(session, *handle).map(|_| Vec::new())
            }
            (FileMethod::CloseAndUpdate, [Variant::UInt32(handle)]) => {
                self.update(session, *handle)
            }
            (FileMethod::GetPosition, [Variant::UInt32(handle)]) => {
                self.with(session, *handle, |one| {
                    let position = u64::try_from(one.position).unwrap_or(u64::MAX);
                    Ok(vec![Variant::UInt64(position)])
                })
            }
            (FileMethod::SetPosition, [Variant::UInt32(handle), Variant::UInt64(position)]) => self
                .with(session, *handle, |one| {
                    let wanted = usize::try_from(*position).unwrap_or(usize::MAX);
                    one.position = wanted.min(one.content.len());
                    Ok(Vec::new())
                }),
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

    fn open(&self, session: u32, mode: u8) -> Answer {
        match mode {
            READ => self.open_with(session, masks::ALL),
            WRITE_ANEW if self.is_writable => self.add(session, Vec::new(), true),
            WRITE_ANEW => Err(StatusCode::BadNotWritable.into()),
            // A list is read, or put in the place of another: nothing between (OPC 10000-12, 7.8.2.2).
            _ => Err(StatusCode::BadInvalidArgument.into()),
        }
    }

    fn open_with(&self, session: u32, masks: u32) -> Answer {
        if masks & !masks::ALL != 0 {
            return Err(StatusCode::BadInvalidArgument.into());
        }
        let list = self.list.list(masks);
        let content = list.encode_to_vec(&ContextOwned::default().context());
        self.add(session, content, false)
    }

    fn add(&self, session: u32, content: Vec<u8>, is_writing: bool) -> Answer {
        let mut open = self.open.lock();
        open.forget();
        let is_read = open.all.values().all(|handle| !handle.is_writing);
        if !is_read || (is_writing && !open.all.is_empty()) {
            return Err(StatusCode::BadInvalidState.into());
        }
        if open.all.len() >= MOST_OPEN {
            return Err(StatusCode::BadTooManyOperations.into());
        }
        open.last = open.last.wrapping_add(1).max(1);
        let number = open.last;
        let handle = Handle {
            session,
            content,
            position: 0,
            is_writing,
            used: Instant::now(),
        };
        open.all.insert(number, handle);
        Ok(vec![Variant::UInt32(number)])
    }

    fn with(&self, session: u32, number: u32, what: impl FnOnce(&mut Handle) -> Answer) -> Answer {
        let mut open = self.open.lock();
        open.forget();
        match open.all.get_mut(&number) {
            Some(handle) if handle.session == session => {
                handle.used = Instant::now();
                what(handle)
            }
            // Handles are of the session that opened (OPC 10000-20, 4.2.2).
            Some(_) | None => Err(StatusCode::BadInvalidArgument.into()),
        }
    }

    fn take(&self, session: u32, number: u32) -> Result<Handle, Refusal> {
        let mut open = self.open.lock();
        open.forget();
        let is_own = open
            .all
            .get(&number)
            .is_some_and(|one| one.session == session);
        let taken = is_own.then(|| open.all.remove(&number)).flatten();
        taken.ok_or_else(|| StatusCode::BadInvalidArgument.into())
    }

    fn update(&self, session: u32, number: u32) -> Answer {
        let handle = self.take(session, number)?;
        if !handle.is_writing {
            return Err(StatusCode::BadInvalidState.into());
        }
        let mut from = Cursor::new(&handle.content);
        let list = TrustListDataType::decode(&mut from, &ContextOwned::default().context());
        let list = list.map_err(|_| StatusCode::BadInvalidArgument)?;
        let later = self.list.replace(list)?;
        Ok(vec![Variant::Boolean(later)])
    }
}

impl Handles {
    /// Closes those that nobody has used for long: a client that is gone would keep others from writing.
    fn forget(&mut self) {
        self.all
            .retain(|_, handle| handle.used.elapsed() < LONGEST_UNUSED);
    }
}

impl Handle {
    fn read(&mut self, length: i32) -> Answer {
        if self.is_writing {
            return Err(StatusCode::BadInvalidState.into());
        }
        let length = usize::try_from(length).map_err(|_| StatusCode::BadInvalidArgument)?;
        let rest = self.content.get(self.position..).unwrap_or_default();
        let read: Vec<u8> = rest.iter().take(length.min(MOST_READ)).copied().collect();
        self.position += read.len();
        Ok(vec![Variant::ByteString(ByteString::from(read))])
    }

    fn write(&mut self, data: &ByteString) -> Answer {
        let data = data.value.as_deref().unwrap_or_default();
        if !self.is_writing {
            return Err(StatusCode::BadInvalidState.into());
        }
        // Whoever goes back writes over what is there.
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

/// Bytes that a list that is written may have.
pub const LARGEST: usize = 1 << 20;
/// A file that is not used for that long is closed (ActivityTimeout, OPC 10000-12, 7.8.2.1).
pub const LONGEST_UNUSED: Duration = Duration::from_secs(60);
/// Bits of the modes that a file is opened in (OPC 10000-20, 4.2.2).
const READ: u8 = 1;
/// To write, with what is there erased.
const WRITE_ANEW: u8 = 6;
const MOST_OPEN: usize = 20;
/// Bytes of an answer.
const MOST_READ: usize = 32 << 10;

#[cfg(test)]
mod tests {
    use opcua::types::NodeId;

    use super::*;
    use crate::server::Caller;

    struct List(Mutex<TrustListDataType>);

    impl TrustList for List {
        fn list(&self, masks: u32) -> TrustListDataType {
            TrustListDataType {
                specified_lists: masks,
                ..self.0.lock().clone()
            }
        }

        fn replace(&self, list: TrustListDataType) -> Result<bool, StatusCode> {
            *self.0.lock() = list;
            Ok(true)
        }
    }

    fn file(is_writable: bool) -> TrustFile {
        let list = TrustListDataType {
            trusted_certificates: Some(vec![ByteString::from(vec![7; 40_000])]),
            ..TrustListDataType::default()
        };
        TrustFile::new(List(Mutex::new(list)), is_writable)
    }

    fn call(file: &TrustFile, session: u32, method: FileMethod, arguments: &[Variant]) -> Answer {
        let caller = Caller {
            session,
            user: "anonymous".to_owned(),
            application_uri: String::new(),
            proven: false,
            encrypted: true,
        };
        let request = MethodRequest {
            caller,
            object: NodeId::null(),
            method: NodeId::null(),
            name: String::new(),
            arguments: arguments.to_vec(),
        };
        file.call(method, &request)
    }

    fn handle(opened: Answer) -> Variant {
        opened.unwrap().remove(0)
    }

    fn read_all(file: &TrustFile, handle: &Variant) -> Vec<u8> {
        let mut all = Vec::new();
        loop {
            let wanted = [handle.clone(), Variant::Int32(100_000)];
            let read = call(file, 1, FileMethod::Read, &wanted).unwrap().remove(0);
            let Variant::ByteString(read) = read else {
                panic!("{read:?}")
            };
            let read = read.value.unwrap_or_default();
            if read.is_empty() {
                return all;
            }
            all.extend(read);
        }
    }

    #[test]
    fn what_is_read_in_parts_is_the_list() {
        let file = file(false);
        let opened = handle(call(
            &file,
            1,
            FileMethod::OpenWithMasks,
            &[Variant::UInt32(1)],
        ));
        let content = read_all(&file, &opened);
        let context = ContextOwned::default();
        let list =
            TrustListDataType::decode(&mut Cursor::new(content), &context.context()).unwrap();
        assert_eq!(list.specified_lists, masks::TRUSTED_CERTIFICATES);
        assert_eq!(list.trusted_certificates.unwrap()[0].len(), 40_000);
        let other = call(
            &file,
            2,
            FileMethod::Read,
            &[opened.clone(), Variant::Int32(1)],
        );
        assert_eq!(other, Err(StatusCode::BadInvalidArgument.into()));
        file.close_session(1);
        assert_eq!(file.open_count(), 0);
        let late = call(&file, 1, FileMethod::Close, &[opened]);
        assert_eq!(late, Err(StatusCode::BadInvalidArgument.into()));
    }

    #[test]
    fn what_is_written_counts_when_it_is_closed_so() {
        let file = file(true);
        let opened = handle(call(&file, 1, FileMethod::Open, &[Variant::Byte(6)]));
        let second = call(&file, 2, FileMethod::Open, &[Variant::Byte(1)]);
        assert_eq!(second, Err(StatusCode::BadInvalidState.into()));
        let list = TrustListDataType {
            specified_lists: masks::ALL,
            issuer_crls: Some(vec![ByteString::from(vec![1, 2, 3])]),
            ..TrustListDataType::default()
        };
        let content = list.encode_to_vec(&ContextOwned::default().context());
        let (first, rest) = content.split_at(5);
        for part in [first, rest] {
            let data = Variant::ByteString(ByteString::from(part.to_vec()));
            call(&file, 1, FileMethod::Write, &[opened.clone(), data]).unwrap();
        }
        let updated = call(&file, 1, FileMethod::CloseAndUpdate, &[opened]);
        assert_eq!(updated, Ok(vec![Variant::Boolean(true)]));
        assert_eq!(file.list.list(masks::ALL), list);
    }

    #[test]
    fn one_that_a_client_left_open_keeps_nobody_from_writing_for_long() {
        let file = file(true);
        let left = handle(call(&file, 1, FileMethod::Open, &[Variant::Byte(1)]));
        let refused = call(&file, 2, FileMethod::Open, &[Variant::Byte(6)]);
        assert_eq!(refused, Err(StatusCode::BadInvalidState.into()));
        for handle in file.open.lock().all.values_mut() {
            handle.used = handle.used.checked_sub(LONGEST_UNUSED).unwrap();
        }
        call(&file, 2, FileMethod::Open, &[Variant::Byte(6)]).unwrap();
        let late = call(&file, 1, FileMethod::Close, &[left]);
        assert_eq!(late, Err(StatusCode::BadInvalidArgument.into()));
    }

    #[test]
    fn one_that_may_not_be_written_and_one_too_large_are_refused() {
        let refused = call(&file(false), 1, FileMethod::Open, &[Variant::Byte(6)]);
        assert_eq!(refused, Err(StatusCode::BadNotWritable.into()));
        let file = file(true);
        let opened = handle(call(&file, 1, FileMethod::Open, &[Variant::Byte(6)]));
        let data = Variant::ByteString(ByteString::from(vec![0; LARGEST + 1]));
        let refused = call(&file, 1, FileMethod::Write, &[opened, data]);
        assert_eq!(refused, Err(StatusCode::BadRequestTooLarge.into()));
    }
}
