//! `ua-space mtp run`: runs a procedure of a process module once, with the driver of its skill.
//!
//! The program does not end before the end of the procedure is known: Ctrl-C withdraws a Start that
//! had no effect, and stops a procedure that runs.

use std::collections::BTreeMap;
use std::io::{self, Write as _};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use devices::module::{HandshakeTiming, ModuleSettings, ProcessModule};
use program::ProgramMethod;
use serde::Serialize;
use serde_json::Value as Json;
use skills::{
    Builtin, RefusalCode, RunOutcome, Skill, SkillEvent, SkillObserver, SkillOwner, SkillParameter,
    SkillSnapshot, SkillValue,
};
use tokio::sync::mpsc;

use crate::arguments::MtpRun;
use crate::exit::CommandFailure;
use crate::interrupt::SignalGuard;
use crate::live::{harmless, json};
use crate::report::say;
use crate::survey::look;

/// Runs `ua-space mtp run`.
pub(crate) fn run(arguments: &MtpRun) -> Result<(), CommandFailure> {
    let module = crate::manifest::read(&arguments.file)?;
    let device = ProcessModule::new(ModuleSettings {
        module,
        endpoint: arguments.endpoint.clone(),
        capabilities: BTreeMap::new(),
        configuration: arguments.configuration,
        timing: HandshakeTiming::default(),
    });
    look(async {
        let interrupt = SignalGuard::catch()?;
        let (steps, mut told) = Steps::new();
        let skill = device.start(
            &arguments.service,
            arguments.procedure.as_deref(),
            vec![Box::new(steps)],
        );
        let skill = skill.map_err(|fault| CommandFailure::Usage(fault.0))?;
        let parameters = parameters(&skill.facts().parameters, &arguments.parameters)?;
        let outcome = follow(arguments, &skill, parameters, (&mut told, interrupt)).await?;
        skill.close().await;
        outcome
    })
}

/// Runs the skill to its end. Returns the failure of the command by the outcome.
async fn follow(
    arguments: &MtpRun,
    skill: &Skill,
    parameters: Vec<(String, SkillValue)>,
    (told, mut interrupt): (&mut PrintedSteps, SignalGuard),
) -> Result<Result<(), CommandFailure>, CommandFailure> {
    let within = arguments.run_timeout;
    let within = within.and_then(|within| Duration::try_from_secs_f64(within).ok());
    let started = skill.execute(BY, parameters, within).await;
    let run = started.map_err(|refusal| {
        let is_of_parameters = matches!(
            refusal.code,
            RefusalCode::InvalidArgument
                | RefusalCode::ArgumentsMissing
                | RefusalCode::TypeMismatch
        );
        match is_of_parameters {
            true => CommandFailure::Usage(refusal.text + &takes(&skill.facts().parameters)),
            false => CommandFailure::Failed(refusal.text),
        }
    })?;
    let mut watch = skill.watch();
    let mut is_interrupted = false;
    // An output that is closed does not end the command before the procedure.
    let mut printed = Ok(());
    let outcome = loop {
        let is_over = |shown: &Arc<SkillSnapshot>| {
            let outcome = shown.outcome.as_ref();
            outcome.is_some_and(|outcome| outcome.run == run)
        };
        tokio::select! {
            biased;
            Some(step) = told.steps.recv() => {
                printed = printed.and_then(|()| print(arguments.json, &step));
            }
            ended = watch.wait_for(is_over) => {
                let shown = ended.map_err(|_| CommandFailure::Failed("the skill ended".to_owned()))?;
                break shown.outcome.clone();
            }
            () = interrupt.received() => {
                is_interrupted = true;
                let skill = skill.clone();
                // A refused Halt finds the run at its end.
                drop(tokio::spawn(async move { skill.call(BY, ProgramMethod::Halt).await }));
                let text = "stopping; the command ends when the end of the procedure is known";
                printed = printed.and_then(|()| say(text));
            }
        }
    };
    while let Ok(step) = told.steps.try_recv() {
        printed = printed.and_then(|()| print(arguments.json, &step));
    }
    printed?;
    let lost = told.lost.load(Ordering::Relaxed);
    if lost > 0 {
        say(&format!("{lost} steps are not shown"))?;
    }
    let outcome =
        outcome.ok_or_else(|| CommandFailure::Failed("the run left no outcome".to_owned()))?;
    print(arguments.json, &RunLine::End(MtpRunEnd::of(&outcome)))?;
    let message = harmless(&outcome.message);
    Ok(match (outcome.succeeded, outcome.unknown) {
        (true, _) => Ok(()),
        (false, true) => Err(CommandFailure::Unavailable(format!(
            "the end is unknown, and the module may still work: {message}"
        ))),
        (false, false) if is_interrupted => {
            say(&message)?;
            Err(CommandFailure::Interrupted)
        }
        (false, false) => Err(CommandFailure::Failed(message)),
    })
}

/// Reads the parameters by their declarations.
fn parameters(
    declared: &[SkillParameter],
    words: &[String],
) -> Result<Vec<(String, SkillValue)>, CommandFailure> {
    let mut given: Vec<(String, SkillValue)> = Vec::new();
    for word in words {
        let wrong =
            |why: &str| CommandFailure::Usage(format!("`{word}`: {why}{}", takes(declared)));
        let (name, text) = word
            .split_once('=')
            .ok_or_else(|| wrong("a parameter is NAME=VALUE"))?;
        let mut known = declared.iter();
        let parameter = known
            .find(|parameter| parameter.name == name)
            .ok_or_else(|| wrong("there is no such parameter"))?;
        if given.iter().any(|(known, _)| known == name) {
            return Err(wrong("it is given twice"));
        }
        let json = match parameter.shape.builtin == Builtin::String {
            true => Json::from(text),
            false => serde_json::from_str(text).map_err(|_| wrong("the value is not readable"))?,
        };
        let value = parameter
            .shape
            .read_json(&json)
            .map_err(|error| wrong(&error.to_string()))?;
        given.push((name.to_owned(), value));
    }
    Ok(given)
}

/// Returns the declarations for a message.
fn takes(declared: &[SkillParameter]) -> String {
    let each = declared.iter().map(|parameter| {
        let unit = parameter.unit.as_deref().unwrap_or_default();
        let range = parameter
            .range
            .map_or_else(String::new, |(low, high)| format!(" from {low} to {high}"));
        let kind = parameter.shape;
        format!("\n  {}: {kind}{range} {unit}", harmless(&parameter.name))
            .trim_end()
            .to_owned()
    });
    let all: String = each.collect();
    match all.is_empty() {
        true => "\nthe procedure takes no parameters".to_owned(),
        false => format!("\nthe parameters are{all}"),
    }
}

/// A line of the output.
#[derive(Debug, Serialize)]
#[serde(rename_all = "lowercase")]
enum RunLine {
    /// A step of the handshake, or a state of the service.
    Step(String),
    End(MtpRunEnd),
}

/// The end of the run.
#[derive(Debug, Serialize)]
struct MtpRunEnd {
    succeeded: bool,
    unknown: bool,
    message: String,
    results: BTreeMap<String, Json>,
}

impl MtpRunEnd {
    fn of(outcome: &RunOutcome) -> Self {
        let results = outcome.results.iter();
        Self {
            succeeded: outcome.succeeded,
            unknown: outcome.unknown,
            message: outcome.message.clone(),
            results: results
                .map(|(name, value)| (name.clone(), value.to_json()))
                .collect(),
        }
    }
}

fn print(is_json: bool, line: &RunLine) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    match (is_json, line) {
        (true, line) => writeln!(out, "{}", json(line)?)?,
        (false, RunLine::Step(step)) => writeln!(out, "{}", harmless(step))?,
        (false, RunLine::End(end)) => {
            for (name, value) in &end.results {
                writeln!(out, "{}: {value}", harmless(name))?;
            }
        }
    }
    out.flush()?;
    Ok(())
}

/// Passes the steps of the run on.
struct Steps {
    steps: mpsc::Sender<RunLine>,
    lost: Arc<AtomicUsize>,
}

/// The steps that are to be printed.
struct PrintedSteps {
    steps: mpsc::Receiver<RunLine>,
    /// Number of steps that did not fit.
    lost: Arc<AtomicUsize>,
}

impl Steps {
    fn new() -> (Self, PrintedSteps) {
        let (steps, waiting) = mpsc::channel(MOST_STEPS);
        let lost = Arc::new(AtomicUsize::new(0));
        let waiting = PrintedSteps {
            steps: waiting,
            lost: Arc::clone(&lost),
        };
        (Self { steps, lost }, waiting)
    }
}

impl SkillObserver for Steps {
    fn told(&self, what: SkillEvent<'_>, shown: &SkillSnapshot) {
        let line = match what {
            SkillEvent::Step => RunLine::Step(shown.step.clone()),
            SkillEvent::Pending(why) => RunLine::Step(why.to_owned()),
            SkillEvent::Parameters(_)
            | SkillEvent::Transition(_)
            | SkillEvent::Progress
            | SkillEvent::Outcome(_)
            | SkillEvent::Called => return,
        };
        if self.steps.try_send(line).is_err() {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

const BY: SkillOwner = SkillOwner::Local("ua-space mtp run");
/// Maximum number of steps that wait for the output.
const MOST_STEPS: usize = 1024;

#[cfg(test)]
mod tests {
    use skills::ValueShape;

    use super::*;

    fn declared() -> Vec<SkillParameter> {
        let of = |name: &str, builtin, range| SkillParameter {
            name: name.to_owned(),
            shape: ValueShape::scalar(builtin),
            length: None,
            default: None,
            unit: Some("l".to_owned()),
            range,
            about: String::new(),
        };
        vec![
            of("Volume", Builtin::Double, Some((0.0, 5.0))),
            of("Label", Builtin::String, None),
        ]
    }

    fn read(words: &[&str]) -> Result<Vec<(String, SkillValue)>, String> {
        let words: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
        parameters(&declared(), &words).map_err(|failure| failure.to_string())
    }

    #[test]
    fn parameters_have_the_types_of_the_manifest() {
        let expected = vec![
            ("Volume".to_owned(), SkillValue::Double(2.0)),
            ("Label".to_owned(), SkillValue::String("7".to_owned())),
        ];
        assert_eq!(read(&["Volume=2", "Label=7"]), Ok(expected));
        for (word, why) in [
            ("Volume", "NAME=VALUE"),
            ("Speed=1", "no such parameter"),
            ("Volume=fast", "not readable"),
            ("Volume=true", "Double"),
        ] {
            let told = read(&[word]).unwrap_err();
            assert!(told.contains(why), "{told}");
            assert!(told.contains("Volume: Double from 0 to 5 l"), "{told}");
        }
        let twice = read(&["Volume=1", "Volume=2"]).unwrap_err();
        assert!(twice.contains("twice"), "{twice}");
    }
}
