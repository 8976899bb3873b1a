//! A trust list as a file that clients open, read and write (OPC 10000-12, 7.8.2; OPC 10000-20,
//! 4.2).
//!
//! The content is a TrustListDataType in the binary encoding, as it is when the file is opened.
//! Written content takes effect with CloseAndUpdate.

use std::io::Cursor;

use opcua::sync::Mutex;
use opcua::types::{
    BinaryDecodable as _, BinaryEncodable as _, ContextOwned, StatusCode, TrustListDataType,
    Variant,
};

use crate::file::{FileAnswer, FileMethod, Handles, READ, WRITE_ANEW};
use crate::server::MethodRequest;

/// The parts of a trust list, as bits (TrustListMasks of OPC 10000-12, 7.8.2.8).
pub mod masks {
    /// Trusted certificates.
    pub const TRUSTED_CERTIFICATES: u32 = 1;
    /// Revocation lists of trusted authorities.
    pub const TRUSTED_CRLS: u32 = 2;
    /// Issuer certificates, which are not trusted themselves.
    pub const ISSUER_CERTIFICATES: u32 = 4;
    /// Revocation lists of issuers.
    pub const ISSUER_CRLS: u32 = 8;
    /// All parts.
    pub const ALL: u32 = 15;
}

/// The trust list behind a file.
pub trait TrustList: Send + Sync + 'static {
    /// Returns the parts selected by [`masks`].
    fn list(&self, masks: u32) -> TrustListDataType;

    /// Replaces the given parts. Returns whether the change requires ApplyChanges.
    ///
    /// # Errors
    /// Returns an error if the list is invalid or cannot be written.
    fn replace(&self, list: TrustListDataType) -> Result<bool, StatusCode>;
}

/// A trust list file and its open handles.
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

impl TrustFile {
    /// Creates the file of a trust list. `is_writable` states whether clients may write it.
    pub fn new(list: impl TrustList, is_writable: bool) -> Self {
        Self {
            list: Box::new(list),
            is_writable,
            open: Mutex::default(),
        }
    }

    /// Returns the number of open handles.
    #[must_use]
    pub fn open_count(&self) -> usize {
        self.open.lock().len()
    }

    /// Closes the handles of an ended session.
    pub fn close_session(&self, session: u32) {
        self.open.lock().close_session(session);
    }

    /// Executes a method. The caller of this function has checked the permissions.
    ///
    /// # Errors
    /// Returns the refusal of the method.
    pub fn call(&self, method: FileMethod, request: &MethodRequest) -> FileAnswer {
        match (method, request.arguments.as_slice()) {
            (FileMethod::Open, [Variant::Byte(mode)]) => self.open(request, *mode),
            (FileMethod::OpenWithMasks, [Variant::UInt32(masks)]) => {
                self.open_with(request, *masks)
            }
            (FileMethod::CloseAndUpdate, [Variant::UInt32(handle)]) => {
                self.update(request.caller.session, *handle)
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
            ) => self.open.lock().call(method, request),
        }
    }

    fn open(&self, request: &MethodRequest, mode: u8) -> FileAnswer {
        match mode {
            READ => self.open_with(request, masks::ALL),
            WRITE_ANEW if self.is_writable => self.open.lock().add(request, Vec::new(), true),
            WRITE_ANEW => Err(StatusCode::BadNotWritable.into()),
            // A list is read or replaced as a whole; other modes are invalid (OPC 10000-12,
            // 7.8.2.2).
            _ => Err(StatusCode::BadInvalidArgument.into()),
        }
    }

    fn open_with(&self, request: &MethodRequest, masks: u32) -> FileAnswer {
        if masks & !masks::ALL != 0 {
            return Err(StatusCode::BadInvalidArgument.into());
        }
        let list = self.list.list(masks);
        let content = list.encode_to_vec(&ContextOwned::default().context());
        self.open.lock().add(request, content, false)
    }

    fn update(&self, session: u32, number: u32) -> FileAnswer {
        let written = self.open.lock().written(session, number)?;
        let mut from = Cursor::new(&written);
        let list = TrustListDataType::decode(&mut from, &ContextOwned::default().context());
        let list = list.map_err(|_| StatusCode::BadInvalidArgument)?;
        let later = self.list.replace(list)?;
        Ok(vec![Variant::Boolean(later)])
    }
}

#[cfg(test)]
mod tests {
    use opcua::types::ByteString;

    use super::*;
    use crate::file::LARGEST;
    use crate::file::tests::request;

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

    fn call(
        file: &TrustFile,
        session: u32,
        method: FileMethod,
        arguments: &[Variant],
    ) -> FileAnswer {
        file.call(method, &request(session, arguments))
    }

    fn handle(opened: FileAnswer) -> Variant {
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
