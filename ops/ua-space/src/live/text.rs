//! How things look in a terminal: tables, and texts of strangers made harmless.

use std::io::{self, IsTerminal as _, Write};

/// A table whose columns are as wide as they have to be; the last one is as long as it is.
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

    /// Adds a row; what cannot be printed in it is shown by its number.
    pub(crate) fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.rows
            .push(cells.into_iter().map(|cell| harmless(&cell)).collect());
    }

    /// Writes it; the head in bold where `bold` says so.
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

/// Whether stdout is a terminal that colours are wanted in.
pub(crate) fn is_coloured() -> bool {
    io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|set| set.is_empty())
}

/// A text of anybody without what a terminal would obey: control characters, and those that turn the direction.
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

/// A time that people can compare: `340 ms`, `2.5 s`, `3 min`.
pub(crate) fn age(of: std::time::Duration) -> String {
    match of.as_secs() {
        0 => format!("{} ms", of.as_millis()),
        1..=119 => format!("{:.1} s", of.as_secs_f64()),
        seconds => format!("{} min", seconds / 60),
    }
}

/// As `12.5 us`, `3.40 ms`, `2.00 s`.
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
