//! `ua-space`: shows, checks and calls the contents of a running space.

mod aas;
mod acl;
mod actions;
mod arguments;
mod ask;
mod capture;
mod cell;
mod check;
mod completion;
mod configure;
mod decode;
mod discover;
mod discovery;
mod encode;
mod environment;
mod exit;
mod explain;
mod fault;
mod goal;
mod hex;
mod http;
mod init;
mod input;
mod interrupt;
mod job;
mod json_file;
mod keys;
mod layout;
mod live;
mod make_keys;
mod manifest;
mod messages;
mod metadata;
mod mtp_alarms;
mod mtp_connect;
mod mtp_files;
mod mtp_picture;
mod mtp_run;
mod new;
mod owl;
mod packet;
mod page;
mod pea;
mod plan;
mod process;
mod products;
mod raw_data;
mod recorded;
mod report;
mod rml;
mod selector;
mod session;
mod shape;
mod source;
mod survey;

use json_values::{self as values, iso_time, node_ids, status};
use std::ffi::OsString;
use std::io::{self, IsTerminal as _, Write as _};
use std::process::ExitCode;

use clap::Parser as _;
use clap::error::ErrorKind;

use arguments::{ToolArguments, Verb};
use exit::CommandFailure;

/// Reads a SysML model: XMI, or the textual notation of SysML v2. Returns the number of its values
/// and calls. For tests with changed files.
///
/// # Errors
/// The lines of the findings, from 1.
#[doc(hidden)]
pub fn read_model(content: &str) -> Result<usize, Vec<usize>> {
    survey::model::counted(content)
}

/// Prints the help, the version or the error of a command line.
fn show_usage(usage: &clap::Error) -> ExitCode {
    // A closed stdout or stderr cannot be reported.
    let is_help = usage.kind() == ErrorKind::DisplayHelp;
    let _printed = if is_help && io::stdout().is_terminal() {
        let text = live::help_within_width(&usage.to_string());
        io::stdout().write_all(text.as_bytes())
    } else {
        usage.print()
    };
    let asked = [ErrorKind::DisplayHelp, ErrorKind::DisplayVersion];
    match asked.contains(&usage.kind()) {
        true => ExitCode::SUCCESS,
        false => ExitCode::from(exit::USAGE),
    }
}

/// Runs `ua-space` from its command line to its end. `arguments` begin with the name of the
/// program.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    let given = arguments.clone();
    let arguments = match ToolArguments::try_parse_from(arguments) {
        Ok(arguments) => arguments,
        Err(usage) => return show_usage(&usage),
    };
    let ended = match &arguments.verb {
        Verb::Check(arguments) => check::check(arguments),
        Verb::Init(arguments) => init::init(arguments),
        Verb::Explain(arguments) => explain::explain(arguments),
        Verb::Schema => explain::schema(),
        Verb::Keys(arguments) => make_keys::make_keys(arguments),
        Verb::Acl(arguments) => acl::acl(arguments),
        Verb::Decode(arguments) => session::decode(arguments),
        Verb::Encode(arguments) => session::encode(arguments),
        Verb::Discover(arguments) => discover::discover(arguments),
        Verb::List(arguments) => live::list(arguments),
        Verb::Info(arguments) => live::info(arguments),
        Verb::Echo(arguments) => live::echo(arguments),
        Verb::Hz(arguments) => live::hz(arguments),
        Verb::Bw(arguments) => live::bandwidth(arguments),
        Verb::Top(arguments) => live::top(arguments),
        Verb::Types(arguments) => live::types(arguments),
        Verb::Status(arguments) => cell::status(arguments),
        Verb::Doctor(arguments) => cell::doctor(arguments),
        Verb::New(arguments) => new::new(arguments),
        Verb::Skills(arguments) => live::skills(arguments),
        Verb::Call(arguments) => live::call(arguments),
        Verb::Trace(arguments) => live::trace(arguments),
        Verb::Tap(arguments) => cell::tap(arguments),
        Verb::Record(arguments) => live::record(arguments),
        Verb::Replay(arguments) => live::replay(arguments),
        Verb::Live(arguments) => live::serve(arguments),
        Verb::Write(arguments) => match live::write(arguments) {
            Ok(code) => return code,
            Err(failure) => Err(failure),
        },
        Verb::Page(_) => return page::page(given),
        Verb::Ask(arguments) => ask::ask(arguments),
        Verb::Plan(arguments) => plan::plan(arguments),
        Verb::Source(arguments) => source::source(arguments),
        Verb::Goal(arguments) => goal::goal(arguments),
        Verb::Process(arguments) => process::process(arguments),
        Verb::Job(arguments) => job::job(arguments),
        Verb::Configure(arguments) => configure::configure(arguments),
        Verb::Rml(arguments) => rml::rml(arguments),
        Verb::Products(arguments) => products::products(arguments),
        Verb::Owl(arguments) => owl::owl(arguments),
        Verb::Mtp(arguments) => mtp_files::mtp(arguments),
        Verb::Aas(arguments) => aas::aas(arguments),
        Verb::Pea(arguments) => pea::pea(arguments),
        Verb::Completion(arguments) => completion::script(arguments.shell),
        Verb::Complete(arguments) => completion::complete(&arguments.words),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            if let CommandFailure::Data(what)
            | CommandFailure::Io(what)
            | CommandFailure::Usage(what)
            | CommandFailure::Unavailable(what)
            | CommandFailure::Failed(what)
            | CommandFailure::Unconfigured(what) = &failure
            {
                report::warn(what);
            }
            (&failure).into()
        }
    }
}
