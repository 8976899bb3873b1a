//! Plug and produce: components are plugged in, discovered, started from ROS, run by the MES, lost
//! and replaced.
//!
//! Reading order:
//!
//! - `fact`: observable facts
//! - `story`: the expected facts, and the actions that follow
//! - `pages` and `watchers`: the observers
//! - `ros1_node` and `ros2_node`: the robots that listen
//! - `files`: the input files of the programs
//! - `report`: the report

mod describe;
mod fact;
mod files;
mod pages;
mod report;
pub(crate) mod ros1_node;
pub(crate) mod ros2_node;
mod skill_messages;
mod story;
mod watchers;

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use serde::Deserialize;
use serde_json::{Map, Value};
use tokio::sync::mpsc;
use tokio::time::{Instant, interval, sleep_until, timeout};

use self::describe::describe;
pub(crate) use self::fact::NodeEvent;
use self::fact::{CanRunAnswer, Fact, PlugComponent};
use self::files::{ModuleManifest, PROCESS};
use self::pages::{Dated, StatusPageKind};
use self::story::{Act, ActStart, PlugStory};
use self::watchers::Watchers;
use crate::clock::{millis, wall_nanos};
use crate::event::{ChildEvent, MasterEvent};
use crate::line::DOMAIN;
use crate::pace::Speed;
use crate::stage::{
    ChildReport, DemoFailure, EventPrinter, EventSource, Interrupt, LOOPBACK, ProgramStart,
    RunningPrograms, Stage, address, command, exit_code, find, free_port, must_be_free,
    open_when_served, status_of,
};

/// The options of the scenario.
#[derive(Clone, Debug)]
pub(crate) struct PlugOptions {
    pub(crate) speed: Speed,
    /// Whether the page is opened in a browser.
    pub(crate) open: bool,
    pub(crate) json: bool,
    /// The manifest of a module; `None` for the manifest of the example plant.
    pub(crate) manifest: Option<PathBuf>,
}

/// Plays the scenario and prints it. Returns the exit code.
pub(crate) async fn play(plan: PlugOptions) -> u8 {
    let mut show = Show {
        timeline: EventPrinter::open(plan.json),
        story: PlugStory::new(),
        began_at: wall_nanos(),
    };
    let manifest = ModuleManifest::read(plan.manifest.as_deref())
        .map_err(DemoFailure::io("cannot read the manifest"));
    let (name, outcome) = match manifest {
        Ok(manifest) => {
            let outcome = perform(&plan, &manifest, &mut show).await;
            (manifest.name, outcome)
        }
        Err(failure) => (String::new(), Err(failure)),
    };
    let failure = outcome.as_ref().err();
    let report = report::PlugReport::of(
        &show.story,
        plan.speed,
        &name,
        failure.map(ToString::to_string),
    );
    let printed = conclude(&mut show, &report, failure, plan.json);
    exit_code(&outcome, &printed)
}

fn conclude(
    show: &mut Show,
    report: &report::PlugReport,
    failure: Option<&DemoFailure>,
    json: bool,
) -> std::io::Result<()> {
    show.print(None)?;
    let table = (show.story.act() > Act::Cell).then(|| report.table());
    let failure = failure.map(ToString::to_string);
    show.timeline
        .conclude(table.as_deref(), failure.as_deref(), (report, json))
}

/// The story and its timeline.
struct Show {
    timeline: EventPrinter,
    story: PlugStory,
    began_at: i64,
}

impl Show {
    fn takes(&mut self, at_ns: i64, fact: &Fact) {
        for (who, what) in describe(&self.story, fact) {
            self.timeline.note(at_ns, who, what);
        }
        self.story.observe(at_ns, fact);
    }

    /// Prints the lines that are due at a time, or all lines.
    fn print(&mut self, now_ns: Option<i64>) -> std::io::Result<()> {
        let began_at = self.began_at;
        let seconds = |at_ns: i64| Some(millis(at_ns - began_at) / 1e3);
        match now_ns {
            Some(now_ns) => self.timeline.print_before(now_ns, &seconds),
            None => self.timeline.print_all(&seconds),
        }
    }
}

async fn perform(
    plan: &PlugOptions,
    manifest: &ModuleManifest,
    show: &mut Show,
) -> Result<(), DemoFailure> {
    let (demo, [lds, server, component, mes, bridge_ros1, bridge_ros2, tool]) = find([
        "ua-lds",
        "ua-server",
        "ua-component",
        "ua-mes",
        "bridge-ros1",
        "bridge-ros2",
        "ua-space",
    ])?;
    let binaries = Binaries {
        demo,
        lds,
        server,
        component,
        mes,
        bridge_ros1,
        bridge_ros2,
        tool,
    };
    let interrupt = Interrupt::listen()?;
    must_be_free(LDS_PORT, "discovery server")?;
    must_be_free(SERVER_PORT, "OPC UA server")?;
    let (programs, reports) = RunningPrograms::prepare()
        .map_err(DemoFailure::io("cannot make a directory for the logs"))?;
    let (watchers, facts) = Watchers::new();
    let mut director = Director {
        plan,
        manifest,
        binaries,
        programs,
        reports,
        watchers,
        facts,
        interrupt,
        questions: 0,
        show,
    };
    let outcome = director.direct().await;
    // No reports are read after this point, and no process may block on sending them.
    director.reports.close();
    director.facts.close();
    director.programs.conclude(outcome).await
}

/// The programs that are started.
struct Binaries {
    demo: PathBuf,
    lds: PathBuf,
    server: PathBuf,
    component: PathBuf,
    mes: PathBuf,
    bridge_ros1: PathBuf,
    bridge_ros2: PathBuf,
    tool: PathBuf,
}

/// The state of a run of the scenario.
struct Director<'a> {
    plan: &'a PlugOptions,
    manifest: &'a ModuleManifest,
    binaries: Binaries,
    programs: RunningPrograms,
    reports: mpsc::Receiver<ChildReport>,
    watchers: Watchers,
    facts: mpsc::Receiver<Dated>,
    interrupt: Interrupt,
    /// The port of the SPARQL endpoint of the MES.
    questions: u16,
    show: &'a mut Show,
}

impl Director<'_> {
    async fn direct(&mut self) -> Result<(), DemoFailure> {
        self.introduce()?;
        let begin_by = Instant::now() + limit(Act::Cell);
        self.start_own("ros-master", &["master"], &[], Stage::Master)?;
        let master = self.master_uri(begin_by).await?;
        self.start_cell(&master)?;
        loop {
            self.watch().await?;
            let order = self.show.story.advance();
            if order == ActStart::End {
                return Ok(());
            }
            self.obey(order).await?;
        }
    }

    fn introduce(&mut self) -> Result<(), DemoFailure> {
        let text = format!(
            "Plug and produce: a robot and a gripper are plugged into a cell that knows nothing of \
             them; speed {}.\nTimes are seconds since the beginning; the module is {}, the logs \
             are in {}.\n\n",
            self.plan.speed.factor(),
            self.manifest.name,
            self.programs.directory().display()
        );
        self.show
            .timeline
            .print_text(&text)
            .map_err(DemoFailure::io("cannot print"))
    }

    async fn master_uri(&mut self, by: Instant) -> Result<String, DemoFailure> {
        loop {
            match self.next(by).await? {
                Next::Told(ChildEvent::Master(MasterEvent::Listening { uri })) => return Ok(uri),
                Next::Told(_) | Next::Seen => {}
                Next::Late => {
                    let lacks = vec!["the ROS master does not listen".to_owned()];
                    return Err(self.missed(Act::Cell, lacks));
                }
            }
        }
    }

    /// Starts all programs that run before the first component.
    fn start_cell(&mut self, master: &str) -> Result<(), DemoFailure> {
        let directory = self.programs.directory().to_owned();
        files::write(&directory, self.plan.speed, self.manifest)
            .map_err(DemoFailure::io("cannot write the files of the programs"))?;
        self.questions = free_port()?;
        let path = |name: &str| directory.join(name).display().to_string();

        let port = free_port()?;
        let metrics = format!("{LOOPBACK}:{port}");
        let endpoint = format!("opc.tcp://{LOOPBACK}:{LDS_PORT}");
        let binary = self.binaries.lds.clone();
        let arguments = ["--endpoint", &endpoint, "--metrics", &metrics];
        self.start("ua-lds", binary, &arguments, &[])?;
        self.watchers.page("ua-lds", StatusPageKind::Lds, port);

        let port = free_port()?;
        let metrics = format!("{LOOPBACK}:{port}");
        let endpoint = format!("opc.tcp://{LOOPBACK}:{SERVER_PORT}");
        let pki = path("server-pki");
        let binary = self.binaries.server.clone();
        let arguments = ["--interface", LOOPBACK, "--metrics", &metrics];
        let own = ["--endpoint", &endpoint, "--pki", &pki, "--announce"];
        let bridges = [free_port()?, free_port()?];
        let status = status_of(&[bridges[0], bridges[1], self.questions]);
        let status: Vec<&str> = status.iter().map(String::as_str).collect();
        let arguments = [&arguments[..], &own, &status].concat();
        self.start("ua-server", binary, &arguments, &[])?;
        self.tell_page(port)?;
        self.watchers
            .page("ua-server", StatusPageKind::Server, port);

        let binary = self.binaries.mes.clone();
        let yaml = files::of_mes(&directory).display().to_string();
        let sparql = format!("{LOOPBACK}:{}", self.questions);
        let arguments = [&yaml, "--interface", LOOPBACK, "--sparql", &sparql];
        self.start("ua-mes", binary, &arguments, &[])?;
        self.watchers
            .page("ua-mes", StatusPageKind::Mes, self.questions);

        let ros1 = [("ROS_MASTER_URI", master), ("ROS_HOSTNAME", LOOPBACK)];
        let domain = DOMAIN.to_string();
        let ros2 = [("ROS_LOCALHOST_ONLY", "1"), ("ROS_DOMAIN_ID", &domain)];
        for (name, port, binary, environment) in [
            (
                "bridge-ros1",
                bridges[0],
                self.binaries.bridge_ros1.clone(),
                ros1,
            ),
            (
                "bridge-ros2",
                bridges[1],
                self.binaries.bridge_ros2.clone(),
                ros2,
            ),
        ] {
            let metrics = format!("{LOOPBACK}:{port}");
            let arguments = ["--interface", LOOPBACK, "--metrics", &metrics];
            self.start(name, binary, &arguments, &environment)?;
            self.watchers.page(name, StatusPageKind::Bridge, port);
        }
        self.start_own("ros1-node", &["ros1-node"], &ros1, Stage::Robots)?;
        self.start_own("ros2-node", &["ros2-node"], &ros2, Stage::Robots)?;
        self.watchers
            .group()
            .map_err(DemoFailure::io("cannot listen in the PubSub group"))?;
        self.watchers.graph(master.to_owned());
        Ok(())
    }

    /// Prints the address of the page, and opens it if wanted.
    fn tell_page(&mut self, port: u16) -> Result<(), DemoFailure> {
        let text = format!("The page of the cell is at {}\n\n", address(port));
        let printed = self.show.timeline.print_text(&text);
        open_when_served(port, self.plan.open);
        printed.map_err(DemoFailure::io("cannot print"))
    }

    async fn obey(&mut self, order: ActStart) -> Result<(), DemoFailure> {
        match order {
            ActStart::Plug(part) => self.plug(part),
            ActStart::Grasp(ros) => self
                .programs
                .tell(ros.node(), "grasp")
                .await
                .map_err(DemoFailure::io("a node cannot be told what to do")),
            ActStart::Run(number) => {
                let tool = self.binaries.tool.clone();
                let facts = self.watchers.facts();
                self.watchers.spawn(async move {
                    let (succeeded, why) = call(&tool).await;
                    let ended = Fact::CallEnded {
                        run: number,
                        succeeded,
                        why,
                    };
                    // If the receiver is closed, the scenario has ended.
                    facts.send((wall_nanos(), ended)).await.ok();
                });
                Ok(())
            }
            ActStart::Kill(part) => {
                self.programs.kill(part.name());
                Ok(())
            }
            ActStart::Ask => {
                let tool = self.binaries.tool.clone();
                let url = format!("http://{LOOPBACK}:{}", self.questions);
                let asked = timeout(TOOL_LIMIT, ask(&tool, &url)).await;
                let asked = asked.unwrap_or_else(|_| Err("it does not end".to_owned()));
                match asked {
                    Ok(asked) => self.show.takes(wall_nanos(), &Fact::Asked(asked)),
                    Err(why) => return Err(self.broken(format!("`ua-space ask` failed: {why}"))),
                }
                Ok(())
            }
            ActStart::End => Ok(()),
        }
    }

    fn plug(&mut self, part: PlugComponent) -> Result<(), DemoFailure> {
        let yaml = files::of_part(self.programs.directory(), part);
        let arguments = [&*yaml.display().to_string(), "--interface", LOOPBACK];
        let component = (part.name(), self.binaries.component.clone());
        let program = ProgramStart::new(component, &arguments, &[], Stage::Components);
        let started = self.programs.start(program)?;
        self.show.takes(started, &Fact::Started(part));
        Ok(())
    }

    fn start(
        &mut self,
        name: &'static str,
        path: PathBuf,
        arguments: &[&str],
        environment: &[(&'static str, &str)],
    ) -> Result<(), DemoFailure> {
        let program = ProgramStart::new((name, path), arguments, environment, Stage::Bridges);
        self.programs.start(program).map(drop)
    }

    fn start_own(
        &mut self,
        name: &'static str,
        arguments: &[&str],
        environment: &[(&'static str, &str)],
        stage: Stage,
    ) -> Result<(), DemoFailure> {
        let demo = (name, self.binaries.demo.clone());
        let program = ProgramStart {
            tells: true,
            hears: stage == Stage::Robots,
            ..ProgramStart::new(demo, arguments, environment, stage)
        };
        self.programs.start(program).map(drop)
    }

    /// Processes facts until the act is over.
    async fn watch(&mut self) -> Result<(), DemoFailure> {
        let act = self.show.story.act();
        let by = Instant::now() + limit(act);
        loop {
            let lacks = self.show.story.missing().map_err(|why| self.broken(why))?;
            if lacks.is_empty() {
                return Ok(());
            }
            if let Next::Late = self.next(by).await? {
                return Err(self.missed(act, lacks));
            }
        }
    }

    /// Returns the next event. Prints due lines meanwhile.
    async fn next(&mut self, by: Instant) -> Result<Next, DemoFailure> {
        let mut print = interval(PRINT_EVERY);
        loop {
            tokio::select! {
                report = self.reports.recv() => match report {
                    Some(ChildReport::Told(told)) => {
                        if let ChildEvent::Node(event) = &told.event {
                            self.show.takes(told.at_ns, &Fact::Node(event.clone()));
                        }
                        return Ok(Next::Told(told.event));
                    }
                    Some(ChildReport::Garbled { name, line }) => {
                        self.note(format!("{name} printed a line that is no event: {line}"));
                    }
                    Some(ChildReport::Killed { name, at_ns }) => {
                        if let Some(part) = PlugComponent::of_name(name) {
                            self.show.takes(at_ns, &Fact::Killed(part));
                            return Ok(Next::Seen);
                        }
                    }
                    Some(ChildReport::Ended { name, status }) => {
                        let last_lines = self.programs.last_lines(name);
                        let logs = self.programs.directory().to_owned();
                        return Err(DemoFailure::ChildEnded { name, status, last_lines, logs });
                    }
                    // The programs hold a sender, so the channel does not close before them.
                    None => return Ok(Next::Late),
                },
                Some((at_ns, fact)) = self.facts.recv() => {
                    self.show.takes(at_ns, &fact);
                    return Ok(Next::Seen);
                }
                () = sleep_until(by) => return Ok(Next::Late),
                () = self.interrupt.come() => {
                    let standing = self.show.story.missing().map_or_else(|why| why, |lacks| lacks.join("; "));
                    return Err(DemoFailure::Interrupted { standing });
                }
                _ = print.tick() => {
                    self.show
                        .print(Some(wall_nanos()))
                        .map_err(DemoFailure::io("cannot print"))?;
                }
            }
        }
    }

    fn note(&mut self, what: String) {
        self.show
            .timeline
            .note(wall_nanos(), EventSource::DEMO, what);
    }

    fn missed(&self, act: Act, lacks: Vec<String>) -> DemoFailure {
        DemoFailure::Missed {
            seconds: limit(act).as_secs(),
            lacks,
            logs: self.programs.directory().to_owned(),
        }
    }

    fn broken(&self, why: String) -> DemoFailure {
        DemoFailure::Broken {
            why,
            logs: self.programs.directory().to_owned(),
        }
    }
}

/// The next event.
enum Next {
    /// An event of a process of the demo.
    Told(ChildEvent),
    /// A fact was observed, and the story has processed it.
    Seen,
    /// The time limit has passed.
    Late,
}

/// Calls the MES to run the process, and waits for its end. Returns whether it succeeded, and the
/// reason if not.
async fn call(tool: &Path) -> (bool, String) {
    let process = format!("ProcessIri={PROCESS}");
    let limit = RUN_LIMIT.as_secs().to_string();
    let call = |arguments: &[&str]| {
        command(tool)
            .arg("call")
            .args(arguments)
            .args(["--interface", LOOPBACK, "--json"])
            .stdin(Stdio::null())
            .output()
    };
    // The skill is Halted at first. If it is not, the Reset is refused, and Start reports any other
    // error.
    drop(call(&["mes.ExecuteProcess.Reset"]).await);
    let start = ["mes.ExecuteProcess", &process, "--run-timeout", &limit];
    match call(&start).await {
        Ok(output) if output.status.success() => (true, String::new()),
        Ok(output) => (false, said(&output)),
        Err(error) => (false, error.to_string()),
    }
}

/// Queries which skills and services can run.
async fn ask(tool: &Path, url: &str) -> Result<CanRunAnswer, String> {
    let output = command(tool)
        .args(["ask", "what-can-run", "--url", url, "--json"])
        .stdin(Stdio::null())
        .output()
        .await
        .map_err(|error| error.to_string())?;
    if !output.status.success() {
        return Err(said(&output));
    }
    let answer: Answer = serde_json::from_slice(&output.stdout)
        .map_err(|error| format!("its answer is not understood: {error}"))?;
    Ok(answer.count())
}

/// Returns the last line of the output of a program.
fn said(output: &std::process::Output) -> String {
    let all = [&output.stdout[..], &output.stderr].concat();
    let text = String::from_utf8_lossy(&all);
    let last = text.lines().rev().find(|line| !line.trim().is_empty());
    last.map_or_else(|| output.status.to_string(), str::to_owned)
}

/// The output of `ua-space ask what-can-run --json`.
#[derive(Debug, Deserialize)]
struct Answer {
    rows: Vec<Map<String, Value>>,
}

impl Answer {
    /// Counts skills and services, and lists incomplete rows: without capability, parameters or
    /// endpoint.
    fn count(&self) -> CanRunAnswer {
        let text = |row: &Map<String, Value>, column: &str| {
            let value = row.get(column).and_then(Value::as_str);
            value.unwrap_or_default().to_owned()
        };
        let of_kind = |kind: &str| {
            self.rows
                .iter()
                .filter(|row| text(row, "kind") == kind)
                .count()
        };
        let lacks = |row: &&Map<String, Value>| {
            // The MES provides processes, which are listed elsewhere.
            if text(row, "component") == MES {
                return false;
            }
            let list = |column: &str| row.get(column).and_then(Value::as_array);
            let has_capability = list("capabilities").is_some_and(|list| !list.is_empty());
            !has_capability || list("parameters").is_none() || text(row, "endpoint").is_empty()
        };
        CanRunAnswer {
            skills: of_kind("skill"),
            services: of_kind("service"),
            incomplete: self
                .rows
                .iter()
                .filter(lacks)
                .map(|row| format!("{} {}", text(row, "component"), text(row, "name")))
                .collect(),
        }
    }
}

/// Returns the ROS name of a topic of space 0.
fn topic(namespace: u16, id: u16) -> String {
    format!("/ua_0_{namespace}_{id}")
}

/// Returns the time limit of an act. The awaited events do not speed up with the scenario.
const fn limit(act: Act) -> Duration {
    match act {
        Act::Cell => Duration::from_secs(60),
        Act::FirstRun | Act::SecondRun | Act::Vacuum => RUN_LIMIT,
        Act::Robot
        | Act::Gripper
        | Act::GraspFromRos2
        | Act::GraspFromRos1
        | Act::Loss
        | Act::Question
        | Act::End => Duration::from_secs(30),
    }
}

/// The component name of the MES.
const MES: &str = "mes";
const LDS_PORT: u16 = 4840;
const SERVER_PORT: u16 = 4841;
/// Identifiers of a component's first skill: its state, its result, and its calls Start and Reset.
const STATE: u16 = 101;
const RESULT: u16 = 104;
const START: u16 = 105;
const RESET: u16 = 109;
const CALL_LIMIT: Duration = Duration::from_secs(10);
const TOOL_LIMIT: Duration = Duration::from_secs(15);
const RUN_LIMIT: Duration = Duration::from_secs(120);
const PRINT_EVERY: Duration = Duration::from_millis(50);

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn an_answer_is_counted_by_kind_and_what_is_incomplete_is_named() {
        let row = |kind: &str, name: &str, capabilities: &[&str], endpoint: Option<&str>| {
            let component = if name == "ExecuteProcess" { MES } else { "c" };
            json!({"kind": kind, "component": component, "name": name, "capabilities": capabilities,
                "parameters": [], "endpoint": endpoint})
        };
        let answer = json!({"question": "what-can-run", "columns": [], "rows": [
            row("skill", "Grasp", &["urn:grasp"], Some("opc.tcp://127.0.0.1:1")),
            row("skill", "Release", &[], Some("opc.tcp://127.0.0.1:1")),
            row("skill", "ExecuteProcess", &[], Some("opc.tcp://127.0.0.1:2")),
            row("service", "Dose", &["urn:dose"], None),
        ]});
        let answer: Answer = serde_json::from_value(answer).unwrap();
        let expected = CanRunAnswer {
            skills: 3,
            services: 1,
            incomplete: vec!["c Release".to_owned(), "c Dose".to_owned()],
        };
        assert_eq!(answer.count(), expected);
    }
}
