//! Terminal output: tables, and texts from the network without control characters.

use std::io::{self, IsTerminal as _, Write};

/// A table with columns of the necessary width; the last column is not padded.
pub(crate) struct Table {
    head: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    pub(crate) fn new(head: impl IntoIterator<Item = String>) -> Self {
        Self {
            head: head.into_iter().map(|name| harmless(&name)).collect(),
            rows: Vec::new(),
        }
    }

    /// Adds a row; unprintable characters are escaped.
    pub(crate) fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.rows
            .push(cells.into_iter().map(|cell| harmless(&cell)).collect());
    }

    /// Writes the table; with `bold`, the head is bold.
    pub(crate) fn write(&self, out: &mut impl Write, bold: bool) -> io::Result<()> {
        let mut widths: Vec<usize> = self.head.iter().map(|text| text.chars().count()).collect();
        for row in &self.rows {
            for (width, cell) in widths.iter_mut().zip(row) {
                *width = (*width).max(cell.chars().count());
            }
        }
        let line = |cells: &mut dyn Iterator<Item = &str>| {
            let mut line = String::new();
            for (cell, width) in cells.zip(&widths) {
                line.push_str(cell);
                let rest = width.saturating_sub(cell.chars().count());
                line.extend(std::iter::repeat_n(' ', rest + 2));
            }
            line.trim_end().to_owned()
        };
        let head = line(&mut self.head.iter().map(String::as_str));
        match bold {
            true => writeln!(out, "\x1b[1m{head}\x1b[0m")?,
            false => writeln!(out, "{head}")?,
        }
        for row in &self.rows {
            writeln!(out, "{}", line(&mut row.iter().map(String::as_str)))?;
        }
        Ok(())
    }
}

/// Returns true if stdout is a terminal and colours are not disabled.
pub(crate) fn is_coloured() -> bool {
    io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|set| set.is_empty())
}

/// Escapes the characters of an untrusted text that control a terminal: control characters, and
/// characters that change the text direction.
pub(crate) fn harmless(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for c in text.chars() {
        match mappings::is_obeyed(c) {
            true => shown.extend(c.escape_unicode()),
            false => shown.push(c),
        }
    }
    shown
}

/// Formats a duration for people: `340 ms`, `2.5 s`, `3 min`.
pub(crate) fn age(of: std::time::Duration) -> String {
    match of.as_secs() {
        0 => format!("{} ms", of.as_millis()),
        1..=119 => format!("{:.1} s", of.as_secs_f64()),
        seconds => format!("{} min", seconds / 60),
    }
}

/// Formats microseconds as `12.5 us`, `3.40 ms`, `2.00 s`.
pub(crate) fn micros(us: f64) -> String {
    if us < 1000.0 {
        format!("{us:.1} us")
    } else if us < 1_000_000.0 {
        format!("{:.2} ms", us / 1000.0)
    } else {
        format!("{:.2} s", us / 1_000_000.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_line_up_and_nothing_of_a_stranger_reaches_the_terminal() {
        let mut table = Table::new(["TOPIC", "NAME"].map(str::to_owned));
        table.row(["ua_1_2_10".to_owned(), "a\x1b[2Jb\n\u{202e}c".to_owned()]);
        table.row(["ua_1_2_1".to_owned(), "ü".to_owned()]);
        let mut out = Vec::new();
        table.write(&mut out, false).unwrap();
        let wanted = "TOPIC      NAME\nua_1_2_10  a\\u{1b}[2Jb\\u{a}\\u{202e}c\nua_1_2_1   ü\n";
        assert_eq!(String::from_utf8(out).unwrap(), wanted);
    }

    #[test]
    fn a_pipe_gets_no_colour_and_a_terminal_a_bold_head() {
        let mut out = Vec::new();
        Table::new(["A".to_owned()]).write(&mut out, true).unwrap();
        assert_eq!(out, b"\x1b[1mA\x1b[0m\n");
    }
}
