//! Logging to stderr as text lines or JSON objects, and forwarding of warnings and errors to the
//! sinks of the program.

mod limit;

use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, IsTerminal, Write};
use std::sync::{Arc, PoisonError, RwLock, Weak};

use log_limit::{LogRecord, LogSink};
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id};
use tracing::{Event, Level, Span, Subscriber, error_span};
use tracing_subscriber::filter::{FilterExt as _, LevelFilter};
use tracing_subscriber::layer::{Context, SubscriberExt as _};
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer};

use self::limit::{PerCallsite, take_suppressed};
use crate::clock::fault_of_host;

/// The format of the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    /// Lines for people; in colour on a terminal.
    Text,
    /// One JSON object a line.
    Json,
}

/// The argument with the format of the log, for the arguments of a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::Args)]
#[group(skip)]
pub struct LogArguments {
    /// The format of the log
    #[arg(
        id = "log",
        long = "log",
        value_name = "FORMAT",
        env = "UA_LOG_FORMAT",
        default_value = "text"
    )]
    pub format: LogFormat,
}

/// Starts logging. `UA_LOG` sets levels, such as `debug` or `info,bridge_core=trace`. `quiet` holds
/// directives that suppress noisy messages of a library.
pub fn start(format: LogFormat, quiet: &str) {
    let levels = std::env::var("UA_LOG").unwrap_or_else(|_| "info".to_owned());
    let filter = EnvFilter::builder().parse_lossy(format!("{quiet},{levels}"));
    let filter = filter.and(PerCallsite::counted());
    let colour = io::stderr().is_terminal();
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(move || OneLine {
            to: io::stderr(),
            colour,
        })
        .with_ansi(colour);
    // Each layer has its own filter: a sink may need messages that are suppressed on stderr.
    let lines = match format {
        LogFormat::Text => lines.with_target(false).with_filter(filter).boxed(),
        LogFormat::Json => lines.json().flatten_event(true).with_filter(filter).boxed(),
    };
    // A second start, as in tests, keeps the first subscriber.
    let started = tracing_subscriber::registry()
        .with(lines)
        .with(Warnings.with_filter(LevelFilter::WARN.and(PerCallsite::default())))
        .try_init();
    if let Err(error) = started {
        tracing::debug!(%error, "logging was already started");
    }
    if let Some(fault) = fault_of_host() {
        tracing::warn!("{fault}");
    }
}

/// Writes each event as one line, even if its texts contain line breaks. Names, reasons and errors
/// come from peers, and a line break in them could forge a log line.
#[derive(Debug)]
struct OneLine<W> {
    to: W,
    /// Whether events are coloured by escape sequences. Control characters in texts are escaped
    /// before.
    colour: bool,
}

impl<W: Write> Write for OneLine<W> {
    /// Writes a whole event, as `tracing-subscriber` passes it.
    fn write(&mut self, event: &[u8]) -> io::Result<usize> {
        let line = event.strip_suffix(b"\n").unwrap_or(event);
        let line = String::from_utf8_lossy(line);
        let line = escaped(&line, |c| self.colour && c == '\x1b');
        let line = with_suppressed(&line, take_suppressed());
        self.to.write_all(format!("{line}\n").as_bytes())?;
        Ok(event.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

/// Adds the number of suppressed messages to a line, as a field of the JSON object or of the text
/// line.
fn with_suppressed(line: &str, suppressed: u64) -> Cow<'_, str> {
    match (suppressed, line.strip_suffix('}')) {
        (0, _) => Cow::Borrowed(line),
        (count, Some(object)) if line.starts_with('{') => {
            Cow::Owned(format!("{object},\"suppressed_here\":{count}}}"))
        }
        (count, _) => Cow::Owned(format!("{line} suppressed_here={count}")),
    }
}

/// Escapes control characters, line breaks and marks of text direction, except for control
/// characters that `stay` accepts.
fn escaped(text: &str, stay: impl Fn(char) -> bool) -> Cow<'_, str> {
    let breaks = |c: char| match c {
        '\u{2028}' | '\u{2029}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => true,
        c => c.is_control() && !stay(c),
    };
    if !text.contains(breaks) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        if breaks(c) {
            out.extend(c.escape_default());
        } else {
            out.push(c);
        }
    }
    Cow::Owned(out)
}

/// Registers `sink` for every warning and error of our own crates while it is alive. Messages of
/// other programs of the process than `program` are excluded. So are messages of libraries, because
/// a sink that uses a library would receive messages about its own work.
pub fn hear_log(program: &'static str, sink: &Arc<impl LogSink>) {
    let sink: Arc<dyn LogSink> = Arc::clone(sink) as _;
    let mut sinks = SINKS.write().unwrap_or_else(PoisonError::into_inner);
    sinks.retain(|listed| listed.sink.strong_count() > 0);
    sinks.push(ListedSink {
        program,
        sink: Arc::downgrade(&sink),
    });
}

/// A registered sink.
struct ListedSink {
    program: &'static str,
    sink: Weak<dyn LogSink>,
}

static SINKS: RwLock<Vec<ListedSink>> = RwLock::new(Vec::new());

/// Returns the span of a program that shares its process with others. Events within the span
/// belong to the program.
#[must_use]
pub fn program_span(program: &'static str) -> Span {
    // The level of the least filter, so that each message has its program.
    error_span!(PROGRAM, name = program)
}

/// The name of the spans of programs.
const PROGRAM: &str = "program";

/// The program of a span.
struct ProgramName(String);

impl Visit for ProgramName {
    fn record_str(&mut self, field: &Field, value: &str) {
        if field.name() == "name" {
            value.clone_into(&mut self.0);
        }
    }

    fn record_debug(&mut self, _: &Field, _: &dyn std::fmt::Debug) {}
}

/// The layer that forwards warnings and errors to the sinks.
#[derive(Debug)]
struct Warnings;

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Warnings {
    fn on_new_span(&self, attributes: &Attributes<'_>, id: &Id, context: Context<'_, S>) {
        if attributes.metadata().name() == PROGRAM
            && let Some(span) = context.span(id)
        {
            let mut name = ProgramName(String::new());
            attributes.record(&mut name);
            span.extensions_mut().insert(name);
        }
    }

    fn on_event(&self, event: &Event<'_>, context: Context<'_, S>) {
        let metadata = event.metadata();
        let ours = OURS.iter().any(|ours| metadata.target().starts_with(ours));
        if *metadata.level() > Level::WARN || !ours {
            return;
        }
        let mut spans = context.event_scope(event).into_iter().flatten();
        let program =
            spans.find_map(|span| Some(span.extensions().get::<ProgramName>()?.0.clone()));
        let sinks: Vec<Arc<dyn LogSink>> = SINKS
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .iter()
            .filter(|listed| program.as_ref().is_none_or(|name| listed.program == name))
            .filter_map(|listed| listed.sink.upgrade())
            .collect();
        if sinks.is_empty() {
            return;
        }
        let mut text = Text::default();
        event.record(&mut text);
        let message = escaped(&format!("{}{}", text.message, text.fields), |_| false).into_owned();
        for sink in sinks {
            sink.hear(LogRecord {
                level: *metadata.level(),
                message: message.clone(),
                file: metadata.file(),
                module: metadata.module_path(),
                line: metadata.line(),
            });
        }
    }
}

#[derive(Default)]
struct Text {
    message: String,
    fields: String,
}

impl Visit for Text {
    fn record_str(&mut self, field: &Field, value: &str) {
        match field.name() {
            "message" => self.message.push_str(value),
            // Writing to a String cannot fail.
            name => write!(self.fields, " {name}={value}").unwrap_or_default(),
        }
    }

    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        match field.name() {
            "message" => write!(self.message, "{value:?}").unwrap_or_default(),
            name => write!(self.fields, " {name}={value:?}").unwrap_or_default(),
        }
    }
}

/// Prefixes of the crates with forwarded warnings.
const OURS: [&str; 6] = [
    "bridge_",
    "ros2_node",
    "service",
    "tcpros",
    "transport",
    "uadp",
];

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    #[derive(Default)]
    struct Heard(Mutex<Vec<String>>);

    impl LogSink for Heard {
        fn hear(&self, record: LogRecord) {
            self.0
                .lock()
                .unwrap()
                .push(format!("{} {}", record.level, record.message));
        }
    }

    /// Returns the output of a program that logs as `start` sets it up, without colours.
    fn written(log: impl FnOnce()) -> String {
        #[derive(Clone, Default)]
        struct Written(Arc<Mutex<Vec<u8>>>);
        impl Write for Written {
            fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
                self.0.lock().unwrap().extend_from_slice(bytes);
                Ok(bytes.len())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let written = Written::default();
        let to = written.clone();
        let lines = tracing_subscriber::fmt::layer()
            .with_writer(move || OneLine {
                to: to.clone(),
                colour: false,
            })
            .with_ansi(false)
            .with_filter(PerCallsite::counted());
        tracing::subscriber::with_default(tracing_subscriber::registry().with(lines), log);
        let bytes = written.0.lock().unwrap().clone();
        String::from_utf8(bytes).unwrap()
    }

    #[test]
    fn a_peer_cannot_write_a_line_of_its_own() {
        let reason = "gone\n2026-01-01T00:00:00Z  INFO all is well\r\u{2028}\u{1b}[2J\u{202e}";
        let as_message = || tracing::error!("told to shut down: {reason}");
        let as_field = || tracing::warn!(%reason, "told to shut down");
        let lines = written(as_message) + &written(as_field);
        assert_eq!(lines.lines().count(), 2, "{lines}");
        assert!(lines.contains(r"gone\n2026"), "{lines}");
        let harmful = |c: char| (c.is_control() && c != '\n') || c == '\u{2028}' || c == '\u{202e}';
        assert!(!lines.contains(harmful), "{lines:?}");
    }

    #[test]
    fn a_flood_of_one_message_is_limited_and_counted() {
        let lines = written(|| {
            for number in 0..10_000 {
                tracing::warn!(number, "unmapped name");
            }
            tracing::warn!("another message");
        });
        let most = usize::try_from(limit::MOST).unwrap();
        assert_eq!(lines.lines().count(), most + 1, "{lines}");
        assert!(lines.ends_with("another message\n"), "{lines}");
        let line = with_suppressed("{\"a\":1}", 7);
        assert_eq!(line, "{\"a\":1,\"suppressed_here\":7}");
    }

    #[test]
    fn colours_stay() {
        let red = "\u{1b}[31mERROR\u{1b}[0m";
        assert_eq!(escaped(red, |c| c == '\x1b'), red);
        assert_eq!(escaped(red, |_| false), r"\u{1b}[31mERROR\u{1b}[0m");
    }

    #[test]
    fn a_sink_hears_the_warnings_of_the_program_with_their_fields() {
        let heard = Arc::new(Heard::default());
        hear_log("bridge-ros2", &heard);
        let subscriber = tracing_subscriber::registry().with(Warnings);
        let ours = || tracing::warn!(topic = "rt/a", size = 7, "too large");
        let ordinary = || tracing::info!("ordinary");
        let foreign = || tracing::error!(target: "rustdds::network", "of a library");
        let forged = || tracing::warn!(reason = %"a\nb", "forged\nline");
        let of_other = || program_span("bridge-ros1").in_scope(ours);
        let of_own = || program_span("bridge-ros2").in_scope(|| tracing::warn!("own"));
        let all: [&dyn Fn(); 6] = [&ours, &ordinary, &foreign, &of_other, &forged, &of_own];
        tracing::subscriber::with_default(subscriber, || all.iter().for_each(|log| log()));
        assert_eq!(
            *heard.0.lock().unwrap(),
            [
                "WARN too large topic=rt/a size=7",
                r"WARN forged\nline reason=a\nb",
                "WARN own",
            ]
        );
    }
}
