//! Tool change: a robot takes its fingers and moves a part to another place. Then it changes to the
//! vacuum gripper, moves the part back, and puts the tool away. A gripper is killed during a move
//! and plugged in again.
//!
//! All programs are the released programs; the devices are simulated behind the protocols of their
//! vendors.
//!
//! Reading order:
//!
//! - this module: the events of the scenario
//! - `cell`: the components
//! - `report`: the report

mod cell;
mod report;

use std::path::PathBuf;
use std::time::Duration;

use plant_opcua::client::SecurityChoice;
use serde_json::Value as Json;
use skills::{
    ClientOptions, ParameterType, RunOutcome, RunnableSkill as _, SkillClient, SkillFault,
    SkillHandle, SkillValue,
};
use tokio::time::{Instant, sleep, timeout};

use self::cell::{CHANGER, DEVICE_PORTS, FINGERS, HANDLING, PARTS, ToolsComponent, VACUUM};
use self::report::{ToolsReport, ToolsRun};
use crate::pace::Speed;
use crate::stage::{
    DemoFailure, EventSource, LOOPBACK, RunningPrograms, Show, Stage, StopReason, address, fetch,
    find, free_port, must_be_free, open_when_served, watched,
};

/// The options of the scenario.
#[derive(Clone, Debug)]
pub(crate) struct ToolsOptions {
    pub(crate) speed: Speed,
    /// Whether the page is opened in a browser.
    pub(crate) open: bool,
    pub(crate) json: bool,
    /// Whether each tool is in the other tool's dock.
    pub(crate) swapped: bool,
}

/// Plays the scenario and prints it. Returns the exit code.
pub(crate) async fn play(plan: ToolsOptions) -> u8 {
    let mut show = Show::open(plan.json);
    let mut report = ToolsReport {
        speed: plan.speed.factor(),
        swapped: plan.swapped,
        ..ToolsReport::default()
    };
    let outcome = perform(&plan, &mut show, &mut report).await;
    show.conclude(&outcome, &report, &report.table())
}

async fn perform(
    plan: &ToolsOptions,
    show: &mut Show,
    report: &mut ToolsReport,
) -> Result<(), DemoFailure> {
    let (_, [lds, component, tool]) = find(["ua-lds", "ua-component", "ua-space"])?;
    must_be_free(LDS_PORT, "discovery server")?;
    let ports = PARTS.iter().filter_map(|part| part.port);
    for port in ports.chain(DEVICE_PORTS) {
        must_be_free(port, "component or simulator")?;
    }
    let (programs, mut reports) = RunningPrograms::prepare()
        .map_err(DemoFailure::io("cannot make a directory for the logs"))?;
    let mut story = Story {
        plan,
        lds,
        component,
        tool,
        programs,
        page: free_port()?,
        browser: free_port()?,
        show,
        report,
    };
    let played = watched(story.play(), &mut reports).await;
    let outcome = played.map_err(|stop| story.failure(stop));
    story.programs.conclude(outcome).await
}

struct Story<'a> {
    plan: &'a ToolsOptions,
    lds: PathBuf,
    component: PathBuf,
    tool: PathBuf,
    programs: RunningPrograms,
    /// The port of the status page of the discovery server.
    page: u16,
    /// The port of the page of the cell.
    browser: u16,
    show: &'a mut Show,
    report: &'a mut ToolsReport,
}

impl Story<'_> {
    async fn play(&mut self) -> Result<(), StopReason> {
        let text = format!(
            "Tool change: a robot, two grippers and a tool changer; speed {}{}.\nTimes are seconds since the beginning; the page \
             of the cell is at {}, the logs are in {}.\n\n",
            self.plan.speed.factor(),
            if self.plan.swapped {
                ", the tools in each other's docks"
            } else {
                ""
            },
            address(self.browser),
            self.programs.directory().display()
        );
        self.show.text(&text)?;
        self.start_all().await?;
        let began = Instant::now();
        for part in &PARTS {
            self.found(part, began).await?;
        }
        self.report.found_ms = Some(elapsed(began));
        self.count_robots().await?;

        self.change(FINGERS).await?;
        self.handle((PICK, PLACE)).await?;
        self.change(VACUUM).await?;
        self.lose_and_plug_in().await?;
        self.handle((PLACE, PICK)).await?;
        let detached = self
            .run((CHANGER, "DetachTool"), "no tool", Vec::new())
            .await?;
        must(&detached)?;
        self.show
            .note(EventSource::DEMO, "all of it happened".to_owned())?;
        Ok(())
    }

    async fn start_all(&mut self) -> Result<(), StopReason> {
        let directory = self.programs.directory().to_owned();
        cell::write(&directory, self.plan.speed, self.plan.swapped)
            .and_then(|()| cell::trust_each_other(&directory))
            .map_err(DemoFailure::io("cannot write the files of the programs"))?;
        let endpoint = format!("opc.tcp://{LOOPBACK}:{LDS_PORT}");
        let metrics = format!("{LOOPBACK}:{}", self.page);
        let store = cell::store(&directory, cell::LDS).display().to_string();
        let secured = ["--pki", &store, "--secured-only"];
        let arguments = ["--endpoint", &endpoint, "--metrics", &metrics];
        let arguments = [&arguments[..], &secured].concat();
        self.programs
            .launch(cell::LDS, self.lds.clone(), &arguments, Stage::Bridges)?;
        let metrics = format!("{LOOPBACK}:{}", self.browser);
        let arguments = ["page", "--interface", LOOPBACK, "--metrics", &metrics];
        self.programs
            .launch("page", self.tool.clone(), &arguments, Stage::Bridges)?;
        open_when_served(self.browser, self.plan.open);
        for (name, arguments) in cell::simulators(self.plan.speed) {
            let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
            self.programs
                .launch(name, self.component.clone(), &arguments, Stage::Master)?;
        }
        let began = Instant::now();
        while !cell::trust_discovery(&directory)
            .map_err(DemoFailure::io("cannot trust the discovery server"))?
        {
            if began.elapsed() > FOUND {
                let why = format!("ua-lds has no certificate within {FOUND:?}");
                return Err(StopReason::Broken(why));
            }
            sleep(POLL).await;
        }
        for part in &PARTS {
            self.plug_in(part.name)?;
        }
        Ok(())
    }

    fn plug_in(&mut self, name: &'static str) -> Result<(), DemoFailure> {
        let directory = self.programs.directory();
        let yaml = directory.join(format!("{name}.yaml")).display().to_string();
        let store = cell::store(directory, name).display().to_string();
        let arguments = [&yaml, "--interface", LOOPBACK, "--pki", &store];
        let component = self.component.clone();
        self.programs
            .launch(name, component, &arguments, Stage::Components)?;
        self.show
            .note(EventSource(name, "36"), "is plugged in".to_owned())
    }

    /// Waits until a component is registered, and its skills are available if its port is known.
    async fn found(&mut self, part: &ToolsComponent, began: Instant) -> Result<(), StopReason> {
        loop {
            let page: Json = fetch(self.page).await.unwrap_or_default();
            let servers = page.get("servers").and_then(Json::as_array);
            let known = servers
                .into_iter()
                .flatten()
                .any(|server| server.get("uri").and_then(Json::as_str) == Some(part.uri));
            let answers = match part.port {
                Some(port) if known => self.skills(port).await.is_some_and(|skills| skills > 0),
                Some(_) | None => known,
            };
            if answers {
                let text = format!("is found after {:.0} ms", elapsed(began));
                self.show.note(EventSource(part.name, "36"), text)?;
                return Ok(());
            }
            if began.elapsed() > FOUND {
                return Err(StopReason::Broken(format!(
                    "{} is not found within {FOUND:?}",
                    part.name
                )));
            }
            sleep(POLL).await;
        }
    }

    async fn skills(&self, port: u16) -> Option<usize> {
        let client = self.connect(port).await.ok()?;
        let skills = client.skills().await.ok().map(|skills| skills.len());
        client.close().await;
        skills
    }

    /// Counts the robots in the cell. The scenario uses one of two.
    async fn count_robots(&mut self) -> Result<(), StopReason> {
        let page: Json = fetch(self.page).await.map_err(|error| {
            StopReason::Broken(format!("cannot list the servers of ua-lds: {error}"))
        })?;
        let servers = page.get("servers").and_then(Json::as_array);
        let robots = ["urn:example:ur5", "urn:example:robot"];
        self.report.robots = servers
            .into_iter()
            .flatten()
            .filter_map(|server| server.get("uri")?.as_str())
            .filter(|uri| robots.contains(uri))
            .count();
        Ok(())
    }

    async fn change(&mut self, tool: &'static str) -> Result<(), StopReason> {
        let uri = PARTS
            .iter()
            .find(|part| part.name == tool)
            .map_or("", |part| part.uri);
        let dock = cell::dock(tool, self.plan.swapped);
        let parameters = vec![
            ("ToolPosition".to_owned(), dock.into()),
            ("ToolAppUri".to_owned(), uri.into()),
        ];
        let run = self.run((CHANGER, "ChangeTool"), tool, parameters).await?;
        must(&run)
    }

    /// Moves the part with the attached tool.
    async fn handle(&mut self, way: ([f64; 6], [f64; 6])) -> Result<(), StopReason> {
        let run = self
            .run((HANDLING, PLACE_SKILL), "a part", places(way))
            .await?;
        must(&run)
    }

    /// Kills the vacuum gripper while the robot carries the part, and starts it again.
    async fn lose_and_plug_in(&mut self) -> Result<(), StopReason> {
        let client = self.connect_to(HANDLING).await?;
        let handle = handle_of(&client, PLACE_SKILL).await?;
        let began = Instant::now();
        let mut steps = Steps::default();
        let mut killed = None;
        let running = handle.run(places((PLACE, PICK)), WITHIN);
        tokio::pin!(running);
        let outcome = loop {
            tokio::select! {
                outcome = &mut running => break outcome,
                () = sleep(LOOK) => {}
            }
            steps.look(&handle).await;
            if killed.is_none() && steps.0.iter().any(|step| step == "MovePickApproachAfter") {
                self.programs.kill(VACUUM);
                killed = Some(Instant::now());
                self.show.note(
                    EventSource(VACUUM, "31"),
                    "is killed while the robot carries the part".to_owned(),
                )?;
            }
        };
        client.close().await;
        let outcome =
            outcome.map_err(|fault| StopReason::Broken(format!("{PLACE_SKILL}: {fault}")))?;
        let run = self.ran((HANDLING, PLACE_SKILL), "a part", (outcome, steps.0, began))?;
        let Some(killed) = killed else {
            return Err(StopReason::Broken(
                "the run was over before the gripper was killed".to_owned(),
            ));
        };
        self.report.told_lost_ms = Some(elapsed(killed));
        if run.succeeded
            || !run.message.contains("is lost")
            || !run.message.contains("has retreated")
        {
            let told = run.message;
            return Err(StopReason::Broken(format!(
                "the run does not say that the gripper was lost: {told}"
            )));
        }
        self.plug_in(VACUUM)?;
        let again = Instant::now();
        let part = PARTS.iter().find(|part| part.name == VACUUM);
        if let Some(part) = part {
            self.found(part, again).await?;
        }
        self.report.found_again_ms = Some(elapsed(again));
        Ok(())
    }

    async fn run(
        &mut self,
        (component, skill): (&'static str, &'static str),
        what: &str,
        parameters: Vec<(String, SkillValue)>,
    ) -> Result<ToolsRun, StopReason> {
        let client = self.connect_to(component).await?;
        let handle = handle_of(&client, skill).await?;
        let text = format!("{skill} begins: {what}");
        self.show.note(EventSource(component, "36"), text)?;
        let began = Instant::now();
        let mut steps = Steps::default();
        let running = handle.run(parameters, WITHIN);
        tokio::pin!(running);
        let outcome = loop {
            tokio::select! {
                outcome = &mut running => break outcome,
                () = sleep(LOOK) => {}
            }
            steps.look(&handle).await;
        };
        client.close().await;
        let outcome =
            outcome.map_err(|fault| StopReason::Broken(format!("{component}.{skill}: {fault}")))?;
        self.ran((component, skill), what, (outcome, steps.0, began))
    }

    fn ran(
        &mut self,
        (component, skill): (&'static str, &'static str),
        what: &str,
        (outcome, steps, began): (RunOutcome, Vec<String>, Instant),
    ) -> Result<ToolsRun, StopReason> {
        let run = ToolsRun {
            skill: format!("{component}.{skill}"),
            what: what.to_owned(),
            succeeded: outcome.succeeded,
            message: outcome.message,
            lasted_ms: elapsed(began),
            steps,
        };
        let ended = if run.succeeded {
            "is done"
        } else {
            &run.message
        };
        self.show
            .note(EventSource(component, "36"), format!("{skill}: {ended}"))?;
        self.report.runs.push(run.clone());
        Ok(run)
    }

    /// Connects by the certificate of the demo; all channels of the cell are secured.
    async fn connect(&self, port: u16) -> Result<SkillClient, SkillFault> {
        let options = ClientOptions {
            application_uri: cell::DEMO_URI.to_owned(),
            application_name: cell::DEMO.to_owned(),
            pki: Some(cell::store(self.programs.directory(), cell::DEMO)),
            security: SecurityChoice::Basic256Sha256,
            ..ClientOptions::default()
        };
        SkillClient::connect(&format!("opc.tcp://{LOOPBACK}:{port}"), &options).await
    }

    async fn connect_to(&self, component: &'static str) -> Result<SkillClient, StopReason> {
        let part = PARTS.iter().find(|part| part.name == component);
        let port = part.and_then(|part| part.port).unwrap_or_default();
        let connected = self.connect(port).await;
        connected.map_err(|fault| StopReason::Broken(format!("{component}: {fault}")))
    }

    fn failure(&self, stop: StopReason) -> DemoFailure {
        stop.failure(&self.programs, || {
            format!("{} runs were over", self.report.runs.len())
        })
    }
}

/// The observed steps of a run.
#[derive(Default)]
struct Steps(Vec<String>);

impl Steps {
    /// Reads the current step of the run. A failed read is ignored.
    async fn look(&mut self, handle: &SkillHandle) {
        if let Ok(Ok(state)) = timeout(LOOKS, handle.state()).await
            && !state.step.is_empty()
            && self.0.last() != Some(&state.step)
        {
            self.0.push(state.step);
        }
    }
}

async fn handle_of(client: &SkillClient, skill: &str) -> Result<SkillHandle, StopReason> {
    let of = ParameterType::own("SkillType");
    let found = client.skills_of(&of).await;
    let found =
        found.map_err(|fault| StopReason::Broken(format!("{}: {fault}", client.endpoint())))?;
    let skill = found
        .iter()
        .find(|found| found.name == skill)
        .ok_or_else(|| StopReason::Broken(format!("{} has no {skill}", client.endpoint())))?;
    Ok(client.handle(skill))
}

fn places((pick, place): ([f64; 6], [f64; 6])) -> Vec<(String, SkillValue)> {
    vec![
        ("PickPosition".to_owned(), pick.into()),
        ("PlacePosition".to_owned(), place.into()),
    ]
}

fn must(run: &ToolsRun) -> Result<(), StopReason> {
    match run.succeeded {
        true => Ok(()),
        false => Err(StopReason::Broken(format!(
            "{} failed: {}",
            run.skill, run.message
        ))),
    }
}

fn elapsed(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

const LDS_PORT: u16 = 4840;
const PLACE_SKILL: &str = "Place";
const PICK: [f64; 6] = [0.4, -0.2, 0.1, 0.0, 0.0, 0.0];
const PLACE: [f64; 6] = [0.2, -0.45, 0.1, 0.0, 0.0, 0.0];
const FOUND: Duration = Duration::from_secs(30);
const WITHIN: Duration = Duration::from_secs(180);
const POLL: Duration = Duration::from_millis(50);
const LOOK: Duration = Duration::from_millis(20);
const LOOKS: Duration = Duration::from_millis(500);
