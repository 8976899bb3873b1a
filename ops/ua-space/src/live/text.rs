//! Terminal output: tables, and texts from the network without control characters.

use std::borrow::Cow;
use std::io::{self, IsTerminal as _, Write};

use serde::Serialize;

use crate::exit::CommandFailure;

/// A table that fits the terminal. Columns have the necessary width; if the table is too wide, the
/// cells of its widest columns are shortened.
#[derive(Clone)]
pub(crate) struct TextTable {
    head: Vec<String>,
    rows: Vec<Vec<String>>,
    /// The columns that give way first, in this order.
    yielding: Vec<usize>,
    /// The columns that are left out first if the table is too wide, in this order.
    spare: Vec<usize>,
}

impl TextTable {
    pub(crate) fn new(head: impl IntoIterator<Item = String>) -> Self {
        Self {
            head: head.into_iter().map(|name| harmless(&name)).collect(),
            rows: Vec::new(),
            yielding: Vec::new(),
            spare: Vec::new(),
        }
    }

    /// Sets the columns that are left out, in their order, while the table is too wide: columns
    /// that follow from others, or that matter least.
    pub(crate) fn leaving_out(mut self, columns: impl Into<Vec<usize>>) -> Self {
        self.spare = columns.into();
        self
    }

    /// Sets the columns that are shortened before all other columns, in their order.
    pub(crate) fn yielding(mut self, columns: impl Into<Vec<usize>>) -> Self {
        self.yielding = columns.into();
        self
    }

    /// Adds a row; unprintable characters are escaped.
    pub(crate) fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.rows
            .push(cells.into_iter().map(|cell| harmless(&cell)).collect());
    }

    /// Removes the columns that have no content in any row.
    pub(crate) fn without_empty_columns(self) -> Self {
        let is_empty = |cell: Option<&String>| {
            cell.is_none_or(|cell| cell.is_empty() || cell == "-" || cell == "?")
        };
        let kept: Vec<bool> = (0..self.head.len())
            .map(|at| at == 0 || !self.rows.iter().all(|row| is_empty(row.get(at))))
            .collect();
        self.with_columns(&kept)
    }

    /// Returns the table with the columns for which `kept` is true.
    fn with_columns(&self, kept: &[bool]) -> Self {
        let keep = |cells: &[String]| -> Vec<String> {
            let cells = cells.iter().zip(kept);
            cells
                .filter(|(_, kept)| **kept)
                .map(|(cell, _)| cell.clone())
                .collect()
        };
        let moved = |at: &usize| {
            let is_kept = kept.get(*at).copied().unwrap_or(false);
            let before = kept.iter().take(*at).filter(|kept| **kept).count();
            is_kept.then_some(before)
        };
        Self {
            head: keep(&self.head),
            rows: self.rows.iter().map(|row| keep(row)).collect(),
            yielding: self.yielding.iter().filter_map(moved).collect(),
            spare: self.spare.iter().filter_map(moved).collect(),
        }
    }

    /// Returns the table without as many of the spare columns as are too wide for `limit`.
    fn fitted(&self, limit: usize) -> Cow<'_, Self> {
        let mut table = Cow::Borrowed(self);
        while let Some(spare) = table.spare.first().copied()
            && table.wanted_width() > limit
        {
            let kept: Vec<bool> = (0..table.head.len()).map(|at| at != spare).collect();
            table = Cow::Owned(table.with_columns(&kept));
        }
        table
    }

    /// Returns the width of the table if only the longest texts of its first yielding column are
    /// shortened.
    fn wanted_width(&self) -> usize {
        let mut widths = self.natural_widths();
        if let Some(width) = self.yielding.first().and_then(|at| widths.get_mut(*at)) {
            *width = (*width).min(LONG);
        }
        widths.iter().sum::<usize>() + GAP * widths.len().saturating_sub(1)
    }

    /// Returns `None` if the table fits `limit` and no cell is shortened. Otherwise returns the
    /// width that the other columns leave to the first yielding column.
    pub(super) fn yielding_room(&self, limit: usize) -> Option<usize> {
        let table = self.fitted(limit);
        let widths = table.natural_widths();
        let all = widths.iter().sum::<usize>() + GAP * widths.len().saturating_sub(1);
        let first = table.yielding.first().and_then(|at| widths.get(*at));
        let others = all - first.copied().unwrap_or_default();
        (all > limit).then(|| limit.saturating_sub(others))
    }

    /// Returns the widths of the columns if no cell is shortened.
    fn natural_widths(&self) -> Vec<usize> {
        let mut widths: Vec<usize> = self.head.iter().map(|text| text.chars().count()).collect();
        for row in &self.rows {
            for (width, cell) in widths.iter_mut().zip(row) {
                *width = (*width).max(cell.chars().count());
            }
        }
        widths
    }

    /// Writes the table in the width of the terminal; with `bold`, the head is bold.
    pub(crate) fn write(&self, out: &mut impl Write, bold: bool) -> io::Result<()> {
        self.write_within(width(), out, bold)
    }

    pub(super) fn write_within(
        &self,
        limit: usize,
        out: &mut impl Write,
        bold: bool,
    ) -> io::Result<()> {
        self.fitted(limit).write_columns(limit, out, bold)
    }

    fn write_columns(&self, limit: usize, out: &mut impl Write, bold: bool) -> io::Result<()> {
        let widths = self.widths(limit);
        let line = |cells: &mut dyn Iterator<Item = &str>| {
            let mut line = String::new();
            for (cell, width) in cells.zip(&widths) {
                let cell = shortened(cell, *width);
                line.push_str(&cell);
                let rest = width.saturating_sub(cell.chars().count());
                line.extend(std::iter::repeat_n(' ', rest + GAP));
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

    /// Returns the widths of the columns. Columns keep their heads if possible.
    fn widths(&self, limit: usize) -> Vec<usize> {
        let heads: Vec<usize> = self.head.iter().map(|text| text.chars().count()).collect();
        let mut widths = self.natural_widths();
        let gaps = GAP * widths.len().saturating_sub(1);
        let mut excess = (widths.iter().sum::<usize>() + gaps).saturating_sub(limit);
        for at in &self.yielding {
            let least = heads.get(*at).copied().unwrap_or_default().max(LEAST);
            if let Some(width) = widths.get_mut(*at) {
                let cut = excess.min(width.saturating_sub(least));
                *width -= cut;
                excess -= cut;
            }
        }
        while excess > 0 {
            let widest = widths.iter_mut().max();
            let Some(widest) = widest.filter(|width| **width > LEAST) else {
                break;
            };
            *widest -= 1;
            excess -= 1;
        }
        widths
    }
}

/// Returns a text of at most `width` characters. A type or ROS topic keeps its last part, if that
/// fits. A name loses its middle, because names often differ at their ends only; a text with spaces
/// loses its end.
pub(crate) fn shortened(text: &str, width: usize) -> String {
    let length = text.chars().count();
    if length <= width {
        return text.to_owned();
    }
    if let Some((_, last)) = text.rsplit_once('/')
        && !last.is_empty()
        && !text.contains([' ', ':'])
        && last.chars().count() + 2 <= width
    {
        return format!("…/{last}");
    }
    let Some(room) = width.checked_sub(1) else {
        return String::new();
    };
    let tail = match text.contains(' ') {
        true => 0,
        false => room * 3 / 5,
    };
    let head = text.chars().take(room - tail);
    let tail = text.chars().skip(length - tail);
    head.chain(['…']).chain(tail).collect()
}

/// Returns lines of at most the width of the terminal: `head`, and the words of the text. The
/// further lines are indented like the text. A word is never broken.
pub(crate) fn wrapped(head: &str, text: &str) -> String {
    wrapped_within(width(), head, text)
}

fn wrapped_within(limit: usize, head: &str, text: &str) -> String {
    let indent = head.chars().count();
    let mut lines = String::new();
    let mut line = head.to_owned();
    let mut is_first = true;
    for word in text.split(' ') {
        let length = line.chars().count() + word.chars().count() + usize::from(!is_first);
        if !is_first && length > limit {
            lines.push_str(line.trim_end());
            lines.push('\n');
            line = " ".repeat(indent);
            is_first = true;
        }
        if !is_first {
            line.push(' ');
        }
        line.push_str(word);
        is_first = false;
    }
    lines.push_str(line.trim_end());
    lines.push('\n');
    lines
}

/// Returns the help of a command within the width of the terminal, which would break it within
/// words. The further lines of a text are indented like its first.
pub(crate) fn help_within_width(help: &str) -> String {
    help_within(width(), help)
}

fn help_within(limit: usize, help: &str) -> String {
    let lines = help.lines().map(|line| {
        let indent = line.len() - line.trim_start().len();
        let (blank, rest) = line.split_at(indent);
        // In a list the text follows the name and at least two spaces.
        let gap = rest.find("  ").unwrap_or_default();
        let (name, rest) = rest.split_at(gap);
        let text = rest.trim_start();
        let (spaces, _) = rest.split_at(rest.len() - text.len());
        wrapped_within(limit, &format!("{blank}{name}{spaces}"), text)
    });
    lines.collect()
}

/// Returns the width for output: of `COLUMNS`, of the terminal, or 80 columns.
pub(crate) fn width() -> usize {
    let set = std::env::var("COLUMNS").ok();
    let set = set.and_then(|columns| columns.parse::<usize>().ok());
    let terminal = || {
        let size = io::stdout().is_terminal().then(crossterm::terminal::size);
        size.and_then(Result::ok).map(|(columns, _)| columns.into())
    };
    let columns = set.or_else(terminal).filter(|columns| *columns > 0);
    columns.unwrap_or(80).max(NARROWEST)
}

/// The number of spaces between columns.
const GAP: usize = 2;
/// The number of characters that a shortened cell keeps.
const LEAST: usize = 8;
/// The width of a yielding column that is worth another column.
const LONG: usize = 24;
/// The width below which output is not fitted.
const NARROWEST: usize = 40;

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

/// Returns JSON without characters that control a terminal.
pub(crate) fn json(shown: &impl Serialize) -> Result<String, CommandFailure> {
    let text =
        serde_json::to_string(shown).map_err(|error| CommandFailure::Data(error.to_string()))?;
    Ok(mappings::harmless_json(&text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_help_is_wrapped_between_words_and_keeps_its_columns() {
        let help = "Show the values of a topic\n\nCommands:\n  hz    Measure the rate of it\n\n      --json\n          Print a JSON object per value\n";
        let wanted = "Show the values of a\ntopic\n\nCommands:\n  hz    Measure the\n        rate of it\n\n      --json\n          Print a\n          JSON\n          object per\n          value\n";
        assert_eq!(help_within(20, help), wanted);
    }

    #[test]
    fn columns_line_up_and_nothing_of_a_stranger_reaches_the_terminal() {
        let mut table = TextTable::new(["TOPIC", "NAME"].map(str::to_owned));
        table.row(["ua_1_2_10".to_owned(), "a\x1b[2Jb\n\u{202e}c".to_owned()]);
        table.row(["ua_1_2_1".to_owned(), "ü".to_owned()]);
        let mut out = Vec::new();
        table.write_within(80, &mut out, false).unwrap();
        let wanted = "TOPIC      NAME\nua_1_2_10  a\\u{1b}[2Jb\\u{a}\\u{202e}c\nua_1_2_1   ü\n";
        assert_eq!(String::from_utf8(out).unwrap(), wanted);
    }

    #[test]
    fn a_wide_table_is_fitted_by_shortening_the_cells_that_matter_least() {
        let head = ["TOPIC", "NAME", "EMPTY", "TYPE"].map(str::to_owned);
        let mut table = TextTable::new(head).yielding([3, 1]);
        let cells = [
            "ua_0_7_101",
            "parallel-gripper.Grasp.State",
            "-",
            "(Force: Double, Name: String) -> (success: Boolean)",
        ];
        table.row(cells.map(str::to_owned));
        let table = table.without_empty_columns();
        let shown = |limit| {
            let mut out = Vec::new();
            table.write_within(limit, &mut out, false).unwrap();
            String::from_utf8(out).unwrap()
        };
        let wide = "TOPIC       NAME                          TYPE\n\
                    ua_0_7_101  parallel-gripper.Grasp.State  (Force: Double, Name: String) -> (success: Boolean)\n";
        assert_eq!(shown(200), wide);
        let fitted = "TOPIC       NAME                          TYPE\n\
                      ua_0_7_101  parallel-gripper.Grasp.State  (Force: Double, Name: String) -> (suc…\n";
        assert_eq!(shown(80), fitted);
        let narrow = shown(41);
        assert!(
            narrow.contains("ua_0_7_101  paral") && narrow.contains(".State  "),
            "{narrow}"
        );
        for limit in [41, 60, 80, 100] {
            assert!(
                shown(limit)
                    .lines()
                    .all(|line| line.chars().count() <= limit)
            );
        }
    }

    #[test]
    fn columns_that_follow_from_others_are_left_out_of_a_table_that_is_too_wide() {
        let head = ["TOPIC", "NAME", "ORIGIN", "TYPE"].map(str::to_owned);
        let mut table = TextTable::new(head).yielding([3, 1]).leaving_out([2, 0]);
        let cells = [
            "ua_1_2_10",
            "Arm.JointStates",
            "ROS 1",
            "sensor_msgs/JointState",
        ];
        table.row(cells.map(str::to_owned));
        let shown = |limit| {
            let mut out = Vec::new();
            table.write_within(limit, &mut out, false).unwrap();
            String::from_utf8(out).unwrap()
        };
        assert_eq!(
            shown(80),
            "TOPIC      NAME             ORIGIN  TYPE\n\
             ua_1_2_10  Arm.JointStates  ROS 1   sensor_msgs/JointState\n"
        );
        assert_eq!(
            shown(55),
            "TOPIC      NAME             TYPE\n\
             ua_1_2_10  Arm.JointStates  sensor_msgs/JointState\n"
        );
        assert_eq!(
            shown(30),
            "NAME             TYPE\nArm.JointStates  …/JointState\n"
        );
    }

    #[test]
    fn a_text_is_wrapped_between_words_and_indented() {
        let wrapped = wrapped_within(24, "about:  ", "the force of the gripper in N");
        assert_eq!(wrapped, "about:  the force of the\n        gripper in N\n");
        let long = wrapped_within(10, "a: ", "unbreakable_word b");
        assert_eq!(long, "a: unbreakable_word\n   b\n");
    }

    #[test]
    fn a_pipe_gets_no_colour_and_a_terminal_a_bold_head() {
        let mut out = Vec::new();
        TextTable::new(["A".to_owned()])
            .write(&mut out, true)
            .unwrap();
        assert_eq!(out, b"\x1b[1mA\x1b[0m\n");
    }
}
