//! The picture of `ua-space top`.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Modifier, Style};
use ratatui::text::Line;
use ratatui::widgets::{Paragraph, Row as Cells, Table};

use super::super::text::{harmless, shortened};
use super::rows::{TopRow, TopView, summary};

pub(super) const HEAD: [&str; 8] = [
    "TOPIC", "NAME", "RATE/S", "LAST", "DELAY", "DROPPED", "QUALITY", "TYPE",
];

/// Draws the rows from the first visible row, a title and the keys.
pub(super) fn draw(frame: &mut Frame<'_>, (view, rows): (&TopView, &[TopRow]), group: &str) {
    let areas = Layout::vertical([
        Constraint::Length(1),
        Constraint::Min(2),
        Constraint::Length(1),
    ]);
    let [title, body, keys] = areas.areas(frame.area());
    let text = format!("ua-space top  {group}  {}", summary(rows));
    frame.render_widget(Line::from(text).style(bold()), title);
    frame.render_widget(table(view, rows, body.width.into()), body);
    frame.render_widget(Paragraph::new(help(view)), keys);
}

fn bold() -> Style {
    Style::new().add_modifier(Modifier::BOLD)
}

fn help(view: &TopView) -> String {
    let filter = harmless(&view.filter);
    if view.is_typing {
        return format!("filter: {filter}_  (Enter keeps it, Esc removes it)");
    }
    let reversed = if view.is_reversed { ", reversed" } else { "" };
    let filter = match filter.as_str() {
        "" => String::new(),
        filter => format!(", filter {filter}"),
    };
    let order = format!("sorted by {}{reversed}{filter}", view.sort.word());
    format!("q quit  s sort  r reverse  / filter  arrows scroll   {order}")
}

fn table(view: &TopView, rows: &[TopRow], width: usize) -> Table<'static> {
    let visible: Vec<[String; 8]> = rows.iter().skip(view.first).map(TopRow::cells).collect();
    let widths = widths(&visible, width);
    let lines = visible.iter().zip(rows.iter().skip(view.first));
    let lines = lines.map(|(cells, row)| {
        let cells = cells.iter().zip(widths);
        let cells = cells.map(|(cell, width)| shortened(cell, width));
        let line = Cells::new(cells);
        match row.quality.as_str() {
            "Good" | "" | "secured" => line,
            // A value of doubtful quality stands out without colour as well.
            _ => line.style(Style::new().add_modifier(Modifier::REVERSED)),
        }
    });
    let lines: Vec<Cells<'static>> = lines.collect();
    let constraints =
        widths.map(|width| Constraint::Length(u16::try_from(width).unwrap_or(u16::MAX)));
    Table::new(lines, constraints)
        .header(Cells::new(HEAD).style(bold()))
        .column_spacing(1)
}

/// Returns the widths of the columns. The figures keep their width; the name, the type, the reason
/// of drops and the quality share the rest.
fn widths(rows: &[[String; 8]], width: usize) -> [usize; 8] {
    let mut widths = HEAD.map(str::len);
    for row in rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = (*width).max(cell.chars().count());
        }
    }
    let used: usize = widths.iter().sum::<usize>() + HEAD.len() - 1;
    let mut excess = used.saturating_sub(width);
    for (at, least) in [(7, 4), (6, 7), (5, 7), (1, 8), (0, 5)] {
        if let Some(width) = widths.get_mut(at) {
            let cut = excess.min(width.saturating_sub(least));
            *width -= cut;
            excess -= cut;
        }
    }
    widths
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::time::Duration;

    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    use super::super::rows::Sort;
    use super::*;

    fn lines(width: u16, view: &TopView) -> Vec<String> {
        let row = |topic: &str, name: &str, quality: &str| TopRow {
            topic: topic.to_owned(),
            name: name.to_owned(),
            rate: Some(49.98),
            age: Some(Duration::from_millis(20)),
            delay_us: Some(312.0),
            drops: BTreeMap::from([("queue_full".to_owned(), 12)]),
            quality: quality.to_owned(),
            type_name: "sensor_msgs/JointState".to_owned(),
        };
        let rows = [
            row("ua_1_2_10", "Arm.JointStates", "Good"),
            row(
                "ua_0_7_101",
                "parallel-gripper.Grasp.State",
                "UncertainLastUsableValue",
            ),
        ];
        let mut terminal = Terminal::new(TestBackend::new(width, 6)).unwrap();
        terminal
            .draw(|frame| draw(frame, (view, &rows), "239.192.0.40:4840"))
            .unwrap();
        let text = terminal.backend().to_string();
        text.lines()
            .map(|line| line.trim_matches('"').trim_end().to_owned())
            .collect()
    }

    #[test]
    fn the_picture_fits_80_columns_and_uses_200() {
        let view = TopView::new(Sort::Rate, String::new());
        let narrow = lines(80, &view);
        assert_eq!(
            narrow[0],
            "ua-space top  239.192.0.40:4840  2 topics, 100.0 values/s, 24 dropped"
        );
        for (line, part) in [
            (2, "JointStates"),
            (2, "50.0"),
            (2, "312.0 us"),
            (3, ".State"),
        ] {
            assert!(narrow[line].contains(part), "{part} in {narrow:?}");
        }
        assert!(narrow[5].starts_with("q quit  s sort"), "{narrow:?}");
        let wide = lines(200, &view);
        for part in [
            "parallel-gripper.Grasp.State",
            "24 ",
            "UncertainLastUsableValue",
            "sensor_msgs/JointState",
        ] {
            assert!(
                wide.iter().any(|line| line.contains(part)),
                "{part} in {wide:?}"
            );
        }
    }

    #[test]
    fn the_last_line_shows_the_filter_while_it_is_typed() {
        let mut view = TopView::new(Sort::Topic, "arm".to_owned());
        view.is_typing = true;
        assert!(lines(80, &view)[5].starts_with("filter: arm_"));
    }
}
