//! `ua-space top`: shows the topics of a group live, like `top` shows processes.
//!
//! Reading order: this module (the loop and the keys), `rows` (figures, order and filter), `screen`
//! (the picture).

mod rows;
mod screen;

use std::io::{self, IsTerminal as _, Write as _};
use std::time::Duration;

use crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::text::{TextTable, is_coloured};
use super::{Go, ListenEnd, Live, in_group, until};
use crate::arguments::Top;
use crate::cell::{StatusPage, pages_of_this_host};
use crate::exit::CommandFailure;
pub(crate) use rows::Sort;
use rows::{Figures, TopView};

/// Runs `ua-space top`.
pub(crate) fn top(arguments: &Top) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        live.want_all();
        live.want_calls(super::prober::FIRST_ASKED);
        let mut view = TopView::new(arguments.sort, arguments.filter.clone().unwrap_or_default());
        if !io::stdout().is_terminal() || !io::stdin().is_terminal() {
            return once(&mut live, arguments, &mut view).await;
        }
        let mut terminal = ratatui::try_init()
            .map_err(|error| CommandFailure::Io(format!("cannot use the terminal: {error}")))?;
        let ended = watch(&mut live, &mut terminal, (arguments, &mut view)).await;
        ratatui::restore();
        ended
    })
}

/// Prints a table after some time, for a pipe.
async fn once(live: &mut Live, arguments: &Top, view: &mut TopView) -> Result<(), CommandFailure> {
    let mut figures = Figures::default();
    let seconds = arguments.seconds.unwrap_or(ONCE);
    let start = live.start_utc();
    let end = until(live.now(), Some(seconds));
    let mut each = |news: super::book::DatagramContent<'_>, now| {
        figures.take(&news, (start, now));
        Go::On
    };
    live.listen(end, &mut each).await?;
    let pages = pages_of_this_host().await;
    let now = live.now();
    figures.tick(now);
    let rows = view.rows(&figures, (live, now), &pages);
    let mut table = TextTable::new(screen::HEAD.map(str::to_owned))
        .yielding([7, 1])
        .leaving_out([7]);
    for row in &rows {
        table.row(row.cells());
    }
    let mut out = io::stdout().lock();
    table.write(&mut out, is_coloured())?;
    writeln!(out, "{}", rows::summary(&rows))?;
    live.tell_dropped();
    Ok(())
}

async fn watch(
    live: &mut Live,
    terminal: &mut ratatui::DefaultTerminal,
    (arguments, view): (&Top, &mut TopView),
) -> Result<(), CommandFailure> {
    let mut figures = Figures::default();
    let end = until(live.now(), arguments.seconds);
    let start = live.start_utc();
    let mut pages: Vec<StatusPage> = Vec::new();
    let mut asked = None;
    let mut asking: Option<tokio::task::JoinHandle<Vec<StatusPage>>> = None;
    let mut ticked = Duration::ZERO;
    loop {
        let next = (live.now() + STEP).min(end);
        let mut each = |news: super::book::DatagramContent<'_>, now| {
            figures.take(&news, (start, now));
            Go::On
        };
        let ended = live.listen(next, &mut each).await?;
        let now = live.now();
        let is_changed = keys(view)?;
        if view.is_over || ended == ListenEnd::Interrupted || now >= end {
            return Ok(());
        }
        if asked.is_none_or(|asked| now >= asked + PAGES) {
            asked = Some(now);
            // A program that hangs must not stop the keys and the group.
            if asking.is_none() {
                asking = Some(tokio::spawn(pages_of_this_host()));
            }
        }
        if let Some(done) = asking.take_if(|asking| asking.is_finished()) {
            pages = done.await.unwrap_or_default();
        }
        let is_due = now >= ticked + TICK || ticked.is_zero();
        if is_due {
            ticked = now;
            figures.tick(now);
        }
        if is_due || is_changed {
            let rows = view.rows(&figures, (live, now), &pages);
            let group = live.group().to_string();
            terminal
                .draw(|frame| screen::draw(frame, (view, &rows), &group))
                .map_err(|error| CommandFailure::Io(format!("cannot draw: {error}")))?;
        }
    }
}

/// Handles the keys that wait. Returns true if the picture changes.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "other events change nothing"
)]
fn keys(view: &mut TopView) -> Result<bool, CommandFailure> {
    let fault = |error: io::Error| CommandFailure::Io(format!("cannot read keys: {error}"));
    let mut is_changed = false;
    while event::poll(Duration::ZERO).map_err(fault)? {
        match event::read().map_err(fault)? {
            Event::Key(key) if key.kind != KeyEventKind::Release => {
                press(view, key);
                is_changed = true;
            }
            Event::Resize(..) => is_changed = true,
            _ => {}
        }
        if view.is_over {
            break;
        }
    }
    Ok(is_changed)
}

#[expect(clippy::wildcard_enum_match_arm, reason = "other keys do nothing")]
fn press(view: &mut TopView, key: KeyEvent) {
    if key.modifiers.contains(KeyModifiers::CONTROL) && key.code == KeyCode::Char('c') {
        view.is_over = true;
        return;
    }
    if view.is_typing {
        match key.code {
            KeyCode::Enter => view.is_typing = false,
            KeyCode::Esc => {
                view.is_typing = false;
                view.filter.clear();
            }
            KeyCode::Backspace => drop(view.filter.pop()),
            KeyCode::Char(c) if view.filter.chars().count() < LONGEST_FILTER => {
                view.filter.push(c);
            }
            _ => {}
        }
        view.first = 0;
        return;
    }
    match key.code {
        KeyCode::Char('q') | KeyCode::Esc => view.is_over = true,
        KeyCode::Char('s') | KeyCode::Right => view.sort = view.sort.next(),
        KeyCode::Left => view.sort = view.sort.previous(),
        KeyCode::Char('r') => view.is_reversed = !view.is_reversed,
        KeyCode::Char('/') => view.is_typing = true,
        KeyCode::Down | KeyCode::Char('j') => view.first = view.first.saturating_add(1),
        KeyCode::Up | KeyCode::Char('k') => view.first = view.first.saturating_sub(1),
        KeyCode::PageDown => view.first = view.first.saturating_add(PAGE),
        KeyCode::PageUp => view.first = view.first.saturating_sub(PAGE),
        KeyCode::Home => view.first = 0,
        _ => {}
    }
}

/// The time after which keys are handled.
const STEP: Duration = Duration::from_millis(100);
/// The interval of the picture.
const TICK: Duration = Duration::from_secs(1);
/// The interval at which the programs of this host are asked for their status.
const PAGES: Duration = Duration::from_secs(2);
/// The time before a table for a pipe, in seconds.
const ONCE: f64 = 3.0;
const PAGE: usize = 10;
const LONGEST_FILTER: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_sort_filter_and_end() {
        let mut view = TopView::new(Sort::Topic, String::new());
        let type_in =
            |view: &mut TopView, code| press(view, KeyEvent::new(code, KeyModifiers::NONE));
        type_in(&mut view, KeyCode::Char('s'));
        assert_eq!(view.sort, Sort::Topic.next());
        type_in(&mut view, KeyCode::Char('/'));
        for c in "qs".chars() {
            type_in(&mut view, KeyCode::Char(c));
        }
        assert_eq!((view.filter.as_str(), view.is_over), ("qs", false));
        type_in(&mut view, KeyCode::Enter);
        type_in(&mut view, KeyCode::Char('q'));
        assert!(view.is_over);
        let mut view = TopView::new(Sort::Topic, String::new());
        press(
            &mut view,
            KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL),
        );
        assert!(view.is_over);
    }
}
