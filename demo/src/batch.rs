//! Batch: a recipe of BatchML doses, stirs and reacts with three simulated process modules (PEAs).
//!
//! Each module is simulated from its manifest. A component makes skills of its services, and
//! `ua-mes` runs the recipe as a process: the reactor is heated while the liquid is dosed and
//! stirred.

mod report;

use std::fs;
use std::path::PathBuf;
use std::process::{Output, Stdio};
use std::time::Duration;

use serde::Deserialize;
use tokio::time::{Instant, sleep, timeout};

use self::report::{Report, StepRun};
use crate::clock::{millis, wall_nanos};
use crate::pace::Speed;
use crate::stage::{
    Failure, Interrupt, LOOPBACK, Program, Programs, Stage, Stop, Timeline, Who, command, fetch,
    find, free_port, must_be_free, unexpected,
};

/// The options of the scenario.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    pub(crate) speed: Speed,
    pub(crate) json: bool,
}

/// A process module: its names, the files of the example plant, and its port.
struct Module {
    name: &'static str,
    pea: &'static str,
    manifest: &'static str,
    yaml: &'static str,
    port: u16,
}

const MODULES: [Module; 3] = [
    Module {
        name: "dosing",
        pea: "dosing-pea",
        manifest: include_str!("../../examples/plant/dosing.aml"),
        yaml: include_str!("../../examples/plant/dosing.yaml"),
        port: 4855,
    },
    Module {
        name: "mixing",
        pea: "mixing-pea",
        manifest: include_str!("../../examples/plant/mixing.aml"),
        yaml: include_str!("../../examples/plant/mixing.yaml"),
        port: 4856,
    },
    Module {
        name: "reacting",
        pea: "reacting-pea",
        manifest: include_str!("../../examples/plant/reacting.aml"),
        yaml: include_str!("../../examples/plant/reacting.yaml"),
        port: 4857,
    },
];
const RECIPE: &str = include_str!("../../examples/plant/batch.xml");
/// The process of the recipe.
const PROCESS: &str = "urn:ua-bridge:recipe:StirredAndReacted";
const MES: &str = "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
                   endpoint: opc.tcp://127.0.0.1:0\nsecurity: [None]\nrecipes: [batch.xml]\n";

/// Plays the scenario and prints it. Returns the exit code.
pub(crate) async fn play(plan: Plan) -> u8 {
    let mut show = Show {
        timeline: Timeline::open(plan.json),
        report: Report {
            speed: plan.speed.factor(),
            ..Report::default()
        },
        began_at: wall_nanos(),
    };
    let outcome = perform(&plan, &mut show).await;
    show.report.finished = outcome.is_ok();
    show.report.failure = outcome.as_ref().err().map(ToString::to_string);
    let printed = show.conclude(plan.json);
    match (outcome, printed) {
        (Err(failure), _) => failure.exit_code(),
        // Standard output is closed, for example by `| head`.
        (Ok(()), Err(_)) => 74,
        (Ok(()), Ok(())) => 0,
    }
}

/// The printed output.
struct Show {
    timeline: Timeline,
    report: Report,
    began_at: i64,
}

impl Show {
    fn note(&mut self, who: Who, what: String) -> Result<(), Failure> {
        self.timeline.note(wall_nanos(), who, what);
        let began_at = self.began_at;
        let seconds = |at_ns: i64| Some(millis(at_ns - began_at) / 1e3);
        let printed = self.timeline.print_all(&seconds);
        printed.map_err(Failure::io("cannot print"))
    }

    fn conclude(&mut self, json: bool) -> std::io::Result<()> {
        self.timeline.print_text(&self.report.table())?;
        if let Some(failure) = &self.report.failure {
            self.timeline.print_text(&format!("error: {failure}\n"))?;
        }
        if json {
            use std::io::Write as _;
            let mut out = std::io::stdout().lock();
            serde_json::to_writer(&mut out, &self.report)?;
            out.write_all(b"\n")?;
            out.flush()?;
        }
        Ok(())
    }
}

async fn perform(plan: &Plan, show: &mut Show) -> Result<(), Failure> {
    let (_, [lds, component, mes, tool]) = find(["ua-lds", "ua-component", "ua-mes", "ua-space"])?;
    let mut interrupt = Interrupt::listen()?;
    must_be_free(LDS_PORT, "discovery server")?;
    for module in &MODULES {
        must_be_free(module.port, "process module")?;
    }
    let (programs, mut reports) =
        Programs::prepare().map_err(Failure::io("cannot make a directory for the logs"))?;
    let mut story = Story {
        plan,
        binaries: Binaries {
            lds,
            component,
            mes,
            tool,
        },
        programs,
        questions: free_port()?,
        show,
    };
    let played = tokio::select! {
        played = story.play() => played,
        (name, status) = unexpected(&mut reports) => Err(Stop::Ended(name, status)),
        () = interrupt.come() => Err(Stop::Interrupted),
    };
    reports.close();
    let outcome = played.map_err(|stop| story.failure(stop));
    story.programs.conclude(outcome).await
}

struct Binaries {
    lds: PathBuf,
    component: PathBuf,
    mes: PathBuf,
    tool: PathBuf,
}

struct Story<'a> {
    plan: &'a Plan,
    binaries: Binaries,
    programs: Programs,
    /// The port at which the MES answers.
    questions: u16,
    show: &'a mut Show,
}

impl Story<'_> {
    async fn play(&mut self) -> Result<(), Stop> {
        let text = format!(
            "Batch: three simulated process modules, and a recipe of BatchML; speed {}.\nTimes are \
             seconds since the beginning; the logs are in {}.\n\n",
            self.plan.speed.factor(),
            self.programs.directory().display()
        );
        let printed = self.show.timeline.print_text(&text);
        printed.map_err(Failure::io("cannot print"))?;
        self.start_all()?;
        self.plan_is_complete().await?;
        let number = self.start_recipe().await?;
        self.follow(number).await?;
        let overlap = self.show.report.overlap();
        if !overlap {
            let why = "the reactor was not heated while the liquid was dosed or stirred";
            return Err(Stop::Broken(why.to_owned()));
        }
        let text = "the batch is done; the reactor was heated meanwhile".to_owned();
        self.show.note(Who::DEMO, text)?;
        Ok(())
    }

    fn start_all(&mut self) -> Result<(), Stop> {
        let directory = self.programs.directory().to_owned();
        let write = |name: &str, text: &str| fs::write(directory.join(name), text);
        let mut written = write("mes.yaml", MES).and_then(|()| write("batch.xml", RECIPE));
        for module in &MODULES {
            written = written
                .and_then(|()| write(&format!("{}.aml", module.name), module.manifest))
                .and_then(|()| write(&format!("{}.yaml", module.name), module.yaml));
        }
        written.map_err(Failure::io("cannot write the files of the programs"))?;
        let path = |name: String| directory.join(name).display().to_string();
        let endpoint = format!("opc.tcp://{LOOPBACK}:{LDS_PORT}");
        let lds = self.binaries.lds.clone();
        self.start(("ua-lds", lds), &["--endpoint", &endpoint], Stage::Bridges)?;
        let sparql = format!("{LOOPBACK}:{}", self.questions);
        let mes = self.binaries.mes.clone();
        let yaml = path("mes.yaml".to_owned());
        let arguments = [&yaml, "--interface", LOOPBACK, "--sparql", &sparql];
        self.start(("ua-mes", mes), &arguments, Stage::Bridges)?;
        let seconds = |seconds: f64| (seconds / self.plan.speed.factor()).to_string();
        let (acting, executing) = (seconds(0.5), seconds(3.0));
        for module in &MODULES {
            let manifest = path(format!("{}.aml", module.name));
            let listen = format!("opc.tcp://{LOOPBACK}:{}", module.port);
            let arguments = ["pea", &manifest, "--listen", &listen];
            let times = ["--acting", &acting, "--executing", &executing];
            let tool = self.binaries.tool.clone();
            let arguments = [&arguments[..], &times].concat();
            self.start((module.pea, tool), &arguments, Stage::Master)?;
            let yaml = path(format!("{}.yaml", module.name));
            let component = self.binaries.component.clone();
            let arguments = [yaml.as_str(), "--interface", LOOPBACK];
            self.start((module.name, component), &arguments, Stage::Components)?;
            self.show
                .note(Who(module.name, "36"), "is plugged in".to_owned())?;
        }
        Ok(())
    }

    fn start(
        &mut self,
        (name, path): (&'static str, PathBuf),
        arguments: &[&str],
        stage: Stage,
    ) -> Result<(), Failure> {
        self.programs.start(Program {
            name,
            path,
            arguments: arguments.iter().map(|&text| text.to_owned()).collect(),
            environment: Vec::new(),
            tells: false,
            hears: false,
            stage,
        })?;
        Ok(())
    }

    /// Runs `ua-space` to its end.
    async fn tool(&self, arguments: &[&str]) -> Result<Output, Stop> {
        let url = format!("http://{LOOPBACK}:{}", self.questions);
        let run = command(&self.binaries.tool)
            .args(arguments)
            .args(["--url", &url, "--json"])
            .stdin(Stdio::null())
            .output();
        let ran = timeout(TOOL_LIMIT, run).await;
        let ran = ran.map_err(|_late| Stop::Broken("`ua-space` does not end".to_owned()))?;
        ran.map_err(|error| Stop::Broken(format!("cannot run `ua-space`: {error}")))
    }

    /// Waits until each step of the recipe has a skill.
    async fn plan_is_complete(&mut self) -> Result<(), Stop> {
        let began = Instant::now();
        loop {
            let planned = self.tool(&["plan", PROCESS]).await?;
            if planned.status.success() {
                let ms = began.elapsed().as_secs_f64() * 1e3;
                self.show.report.planned_ms = Some(ms);
                let text = format!("each step of the recipe has a skill after {ms:.0} ms");
                self.show.note(MES_WHO, text)?;
                return Ok(());
            }
            if began.elapsed() > FOUND {
                let why = String::from_utf8_lossy(&planned.stdout).into_owned();
                return Err(Stop::Broken(format!(
                    "the recipe has no complete plan within {FOUND:?}: {why}"
                )));
            }
            sleep(POLL).await;
        }
    }

    /// Starts a job. Returns the number of its run.
    async fn start_recipe(&mut self) -> Result<u64, Stop> {
        let url = format!("http://{LOOPBACK}:{}", self.questions);
        let run = command(&self.binaries.tool)
            .args(["job", "start", PROCESS, "--url", &url])
            .stdin(Stdio::null())
            .output();
        let ran = timeout(TOOL_LIMIT, run).await;
        let ran = ran.map_err(|_late| Stop::Broken("`ua-space job` does not end".to_owned()))?;
        let ran = ran.map_err(|error| Stop::Broken(format!("cannot run `ua-space`: {error}")))?;
        let said = String::from_utf8_lossy(&ran.stdout).into_owned();
        let number = said
            .strip_prefix("job ")
            .and_then(|rest| rest.split_once(':'));
        let number = number.and_then(|(number, _)| number.parse().ok());
        number.ok_or_else(|| {
            let why = String::from_utf8_lossy(&ran.stderr).into_owned();
            Stop::Broken(format!("the recipe is not started: {said}{why}"))
        })
    }

    /// Prints the steps until the run has ended.
    async fn follow(&mut self, number: u64) -> Result<(), Stop> {
        let end = format!("-{number}");
        let began = Instant::now();
        loop {
            let page: Page = fetch(self.questions)
                .await
                .map_err(|error| Stop::Broken(format!("ua-mes does not answer: {error}")))?;
            let run = page.runs.into_iter().find(|run| run.run.ends_with(&end));
            if let Some(run) = run {
                let steps: Vec<StepRun> = run.plans.into_iter().flat_map(|plan| plan.ran).collect();
                self.tell(&steps)?;
                self.show.report.steps = steps;
                match run.outcome.as_str() {
                    "running" => {}
                    "done" => return Ok(()),
                    other => {
                        let why = run.reason.unwrap_or_default();
                        return Err(Stop::Broken(format!("the recipe is {other}: {why}")));
                    }
                }
            }
            if began.elapsed() > RUN_LIMIT {
                return Err(Stop::Broken(format!(
                    "the recipe does not end within {RUN_LIMIT:?}"
                )));
            }
            sleep(POLL).await;
        }
    }

    /// Prints the steps that have begun or ended.
    fn tell(&mut self, steps: &[StepRun]) -> Result<(), Failure> {
        for (number, step) in steps.iter().enumerate() {
            let known = self.show.report.steps.get(number).cloned();
            let who = MODULES.iter().map(|module| module.name);
            let who = who.into_iter().find(|name| step.component.contains(name));
            let who = Who(who.unwrap_or("module"), "36");
            if known.is_none() {
                let parameters = serde_json::Value::from(step.parameters.clone());
                let text = format!("begins to {} with {parameters}", step.step);
                self.show.note(who, text)?;
            }
            let was_running = known.is_none_or(|known| known.outcome == "running");
            if was_running && step.outcome != "running" {
                let text = format!("ends to {}: {}", step.step, step.outcome);
                self.show.note(who, text)?;
            }
        }
        Ok(())
    }

    fn failure(&self, stop: Stop) -> Failure {
        stop.failure(&self.programs, || {
            format!("{} steps had begun", self.show.report.steps.len())
        })
    }
}

/// The status page of the MES.
#[derive(Debug, Deserialize)]
struct Page {
    runs: Vec<Run>,
}

#[derive(Debug, Deserialize)]
struct Run {
    run: String,
    outcome: String,
    reason: Option<String>,
    plans: Vec<Planned>,
}

#[derive(Debug, Deserialize)]
struct Planned {
    ran: Vec<StepRun>,
}

const MES_WHO: Who = Who("ua-mes", "35");
const LDS_PORT: u16 = 4840;
const POLL: Duration = Duration::from_millis(100);
const TOOL_LIMIT: Duration = Duration::from_secs(20);
/// Time limit until all skills are found.
const FOUND: Duration = Duration::from_secs(60);
const RUN_LIMIT: Duration = Duration::from_secs(120);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_examples_are_those_of_the_story() {
        for module in &MODULES {
            let lines = [
                format!("component: {}", module.name),
                format!("    manifest: {}.aml", module.name),
            ];
            for line in lines {
                assert!(module.yaml.lines().any(|known| known == line), "{line}");
            }
            let endpoint = format!("opc.tcp://127.0.0.1:{}<", module.port);
            assert!(module.manifest.contains(&endpoint), "{endpoint}");
            let equipment = format!("<ActualEquipmentID>{}<", module.name);
            assert!(RECIPE.contains(&equipment), "{equipment}");
        }
        let id = PROCESS.rsplit_once(':').unwrap().1;
        assert!(RECIPE.contains(&format!("<ID>{id}</ID>")));
    }
}
