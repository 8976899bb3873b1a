//! Encoded results of queries, with limits of their size.

use std::cell::Cell;
use std::io::{self, Write};
use std::rc::Rc;

use crate::query::QueryLimits;

/// Encoded result of a query.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WrittenResult {
    /// The media type of the format.
    pub media: &'static str,
    /// The result in this format.
    pub bytes: Vec<u8>,
    /// Number of rows or statements; 1 for ASK.
    pub rows: usize,
    /// Whether there are further rows.
    pub is_truncated: bool,
}

/// The size after which a result ends. Its last row may exceed the number of bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ResultCut {
    pub(crate) rows: usize,
    pub(crate) bytes: usize,
}

/// A writer with a limit of bytes.
#[derive(Debug)]
pub(crate) struct Bounded {
    pub(crate) bytes: Vec<u8>,
    most: usize,
    /// The number of written bytes, for the source of the rows.
    length: Rc<Cell<usize>>,
}

impl Bounded {
    pub(crate) fn new(most: usize) -> Self {
        Self {
            bytes: Vec::new(),
            most,
            length: Rc::default(),
        }
    }
}

impl Write for Bounded {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.bytes.len().saturating_add(bytes.len()) > self.most {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        self.bytes.extend_from_slice(bytes);
        self.length.set(self.bytes.len());
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The size of a result while it is written.
#[derive(Debug)]
pub(crate) struct ResultSize {
    rows: usize,
    most: usize,
    cut: Option<ResultCut>,
    length: Rc<Cell<usize>>,
    is_truncated: bool,
}

impl ResultSize {
    pub(crate) fn new(limits: QueryLimits, cut: Option<ResultCut>, to: &Bounded) -> Self {
        Self {
            rows: 0,
            most: limits.rows,
            cut,
            length: Rc::clone(&to.length),
            is_truncated: false,
        }
    }

    /// Counts another row. Returns whether the result has it; `None` if the result is too large.
    pub(crate) fn takes_another(&mut self) -> Option<bool> {
        let is_over = |cut: ResultCut| self.rows >= cut.rows || self.length.get() >= cut.bytes;
        if self.cut.is_some_and(is_over) {
            self.is_truncated = true;
            return Some(false);
        }
        if self.rows >= self.most {
            return None;
        }
        self.rows += 1;
        Some(true)
    }

    pub(crate) fn written(self, media: &'static str, bytes: Vec<u8>) -> WrittenResult {
        WrittenResult {
            media,
            bytes,
            rows: self.rows,
            is_truncated: self.is_truncated,
        }
    }
}
