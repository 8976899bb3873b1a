//! Writes the output of `decode`: JSON to stdout, faults to stderr.

use std::io::{self, BufWriter, StdoutLock, Write as _};

use crate::decode::DecodedDatagram;
use crate::exit::CommandFailure;
use crate::{hex, layout};

/// The output and its style.
pub(crate) struct StyledOutput {
    out: BufWriter<StdoutLock<'static>>,
    style: Style,
    shown: usize,
    faulty: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Style {
    /// One object, for people.
    Single,
    /// One object per line.
    Lines,
    /// One array of all objects.
    Array,
}

impl StyledOutput {
    pub(crate) fn new(style: Style) -> Self {
        Self {
            out: BufWriter::new(io::stdout().lock()),
            style,
            shown: 0,
            faulty: 0,
        }
    }

    /// Shows a datagram and reports its faults; `name` identifies the datagram.
    pub(crate) fn show(
        &mut self,
        name: &str,
        reading: &DecodedDatagram,
    ) -> Result<(), CommandFailure> {
        if !reading.faults.is_empty() || reading.refused.is_some() {
            self.faulty += 1;
        }
        for fault in &reading.faults {
            let around = hex::around(&reading.bytes, fault.offset);
            warn(&format!("{name}: {fault}\n{}", around.trim_end()));
        }
        for what in reading.refused.iter().chain(&reading.notes) {
            warn(&format!("{name}: {what}"));
        }
        let unread = reading.shape.uadp_version.is_none();
        if unread && self.style == Style::Single {
            return Ok(());
        }
        let json = crate::live::text::json(&reading.shape)?;
        let before = match (self.style, self.shown) {
            (Style::Array, 0) => "[\n",
            (Style::Array, _) => ",\n",
            (Style::Single | Style::Lines, _) => "",
        };
        self.out.write_all(before.as_bytes())?;
        match self.style {
            Style::Single => writeln!(self.out, "{}", layout::lines(&json))?,
            Style::Lines => writeln!(self.out, "{json}")?,
            Style::Array => self.out.write_all(json.as_bytes())?,
        }
        self.shown += 1;
        Ok(())
    }

    /// Returns the number of shown datagrams.
    pub(crate) const fn shown(&self) -> usize {
        self.shown
    }

    /// Ends the output; fails if a datagram was malformed.
    pub(crate) fn finish(mut self) -> Result<(), CommandFailure> {
        if self.style == Style::Array {
            let end = if self.shown == 0 { "[]\n" } else { "\n]\n" };
            self.out.write_all(end.as_bytes())?;
        }
        self.out.flush()?;
        match self.faulty {
            0 => Ok(()),
            _ => Err(CommandFailure::Told),
        }
    }
}

/// Writes a line to stdout.
pub(crate) fn say(text: &str) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    writeln!(out, "{}", crate::live::text::harmless(text))?;
    out.flush()?;
    Ok(())
}

/// Writes a message to stderr.
pub(crate) fn warn(what: &str) {
    // A closed stderr cannot be reported.
    let _written = writeln!(io::stderr(), "{what}");
}
