//! The assembly line with skills. An arm of ROS 1, a conveyor and a mobile robot of ROS 2 are
//! components. A composite finds their skills by type and brings covers to the worker. The conveyor
//! is killed while a cover is on its way to it.
//!
//! All programs except the machines are the released programs.
//!
//! Reading order:
//!
//! - this module: the programs and the events of the scenario
//! - `line`: the composite
//! - `world`: the check of the result

pub(crate) mod arm_node;
pub(crate) mod base_node;
pub(crate) mod belt_node;
mod cell;
mod fact;
mod line;
mod report;
mod world;

use std::cell::{Cell, RefCell};
use std::path::PathBuf;
use std::process::ExitStatus;
use std::sync::Arc;
use std::time::Duration;

use serde::Deserialize;
use skills::{ClientOptions, Detector, ParameterType, RunnableSkill, SkillClient};
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, interval, sleep, timeout};

use self::cell::{CONVEYOR, MAPPING, PARTS};
pub(crate) use self::fact::MachineEvent;
use self::line::{ProgressReporter, SkilledLine};
use self::report::{SkilledReport, SkilledRun};
use self::world::CoverLocations;
use crate::clock::{millis, wall_nanos};
use crate::event::{ChildEvent, MasterEvent};
use crate::line::DOMAIN;
use crate::pace::Speed;
use crate::stage::{
    ChildReport as Told, DemoFailure, EventPrinter, EventSource, Interrupt, LOOPBACK, ProgramStart,
    RobotHops, RunningPrograms, Stage, StopReason, address, exit_code, fetch, find, free_port,
    must_be_free, open_when_served, status_of,
};

/// The options of the scenario.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SkilledOptions {
    pub(crate) covers: u32,
    pub(crate) speed: Speed,
    /// Whether the page is opened in a browser.
    pub(crate) open: bool,
    pub(crate) json: bool,
}

/// Plays the scenario and prints it. Returns the exit code.
pub(crate) async fn play(plan: SkilledOptions) -> u8 {
    let show = Show {
        timeline: RefCell::new(EventPrinter::open(plan.json)),
        report: RefCell::new(SkilledReport {
            speed: plan.speed.factor(),
            covers: plan.covers,
            ..SkilledReport::default()
        }),
        began_at: wall_nanos(),
        under_way: Cell::new(UnderWay::now()),
    };
    let outcome = perform(plan, &show).await;
    {
        let mut report = show.report.borrow_mut();
        report.finished = outcome.is_ok();
        report.failure = outcome.as_ref().err().map(ToString::to_string);
    }
    exit_code(&outcome, &show.conclude(plan.json))
}

/// The printed output.
struct Show {
    timeline: RefCell<EventPrinter>,
    report: RefCell<SkilledReport>,
    began_at: i64,
    /// The current or last run.
    under_way: Cell<UnderWay>,
}

/// A run of a skill, as observed by its caller and by the observers of the machines.
#[derive(Clone, Copy)]
struct UnderWay {
    /// Time of the request.
    since: Instant,
    /// Time of the request in nanoseconds since 1970.
    since_ns: i64,
    /// Milliseconds from the request to the first action of a machine.
    acted_ms: Option<f64>,
}

impl UnderWay {
    fn now() -> Self {
        Self {
            since: Instant::now(),
            since_ns: wall_nanos(),
            acted_ms: None,
        }
    }
}

impl Show {
    fn note(&self, who: EventSource, what: String) {
        self.note_at(wall_nanos(), who, what);
    }

    fn note_at(&self, at_ns: i64, who: EventSource, what: String) {
        let mut timeline = self.timeline.borrow_mut();
        timeline.note(at_ns, who, what);
        let began_at = self.began_at;
        let seconds = |at_ns: i64| Some(millis(at_ns - began_at) / 1e3);
        if let Err(error) = timeline.print_all(&seconds) {
            // The exit code reports it at the end.
            tracing::debug!(%error, "cannot print an event: its reader has closed");
        }
    }

    fn conclude(&self, json: bool) -> std::io::Result<()> {
        let (mut timeline, report) = (self.timeline.borrow_mut(), self.report.borrow());
        let table = report.table();
        timeline.conclude(Some(&table), report.failure.as_deref(), (&*report, json))
    }
}

impl ProgressReporter for Show {
    fn begins(&self, skill: &str, what: &str) {
        self.under_way.set(UnderWay::now());
        self.note(LINE, format!("{skill} begins: {what}"));
    }

    fn ended(&self, skill: &str, what: &str, message: &str) {
        let UnderWay {
            since, acted_ms, ..
        } = self.under_way.get();
        let run = SkilledRun {
            skill: skill.to_owned(),
            what: what.to_owned(),
            message: message.to_owned(),
            acted_ms,
            lasted_ms: elapsed(since),
        };
        self.report.borrow_mut().runs.push(run);
        if !message.is_empty() {
            self.note(LINE, message.to_owned());
        }
    }

    fn turns(&self, why: &str) {
        self.note(LINE, why.to_owned());
    }
}

async fn perform(plan: SkilledOptions, show: &Show) -> Result<(), DemoFailure> {
    let (demo, [lds, component, bridge_ros1, bridge_ros2, tool]) = find([
        "ua-lds",
        "ua-component",
        "bridge-ros1",
        "bridge-ros2",
        "ua-space",
    ])?;
    let mut interrupt = Interrupt::listen()?;
    must_be_free(LDS_PORT, "discovery server")?;
    let (programs, reports) = RunningPrograms::prepare()
        .map_err(DemoFailure::io("cannot make a directory for the logs"))?;
    let transport = plan.speed.real(TRANSPORT_SECONDS);
    let (seen, world) = watch::channel(CoverLocations::new(plan.covers, transport));
    let mut story = Story {
        plan,
        binaries: Binaries {
            demo,
            lds,
            component,
            bridge_ros1,
            bridge_ros2,
            tool,
        },
        programs,
        page: free_port()?,
        browser: free_port()?,
        bridges: [free_port()?, free_port()?],
        transport,
        world,
        show,
    };
    let mut watcher = Watcher {
        reports,
        seen,
        master: watch::Sender::new(None),
        killed: watch::Sender::new(None),
        show,
    };
    let (master, killed) = (watcher.master.subscribe(), watcher.killed.subscribe());
    let played = tokio::select! {
        played = story.play(master, killed) => played,
        (name, status) = watcher.watch() => Err(StopReason::Ended(name, status)),
        () = interrupt.come() => Err(StopReason::Interrupted),
    };
    watcher.reports.close();
    let outcome = played.map_err(|stop| story.failure(stop));
    if outcome.is_ok() {
        let (hops, missing) = RobotHops::ask(story.bridges).await;
        show.report.borrow_mut().hops = hops;
        for why in missing {
            show.note(EventSource::DEMO, why);
        }
    }
    {
        let world = story.world.borrow();
        let mut report = show.report.borrow_mut();
        report.by_conveyor = world.by_conveyor();
        report.by_turtlebot = world.by_turtlebot();
        report.taken_back = world.taken_back();
    }
    story.programs.conclude(outcome).await
}

/// Receives the events of the machines and updates the world.
struct Watcher<'a> {
    reports: mpsc::Receiver<Told>,
    seen: watch::Sender<CoverLocations>,
    /// The URI of the ROS master.
    master: watch::Sender<Option<String>>,
    /// Time at which the conveyor was killed, in nanoseconds since 1970.
    killed: watch::Sender<Option<i64>>,
    show: &'a Show,
}

impl Watcher<'_> {
    /// Processes reports until a program ends unexpectedly.
    async fn watch(&mut self) -> (&'static str, ExitStatus) {
        let mut passes = interval(PASS);
        loop {
            tokio::select! {
                report = self.reports.recv() => match report {
                    Some(Told::Ended { name, status }) => return (name, status),
                    Some(Told::Told(stamped)) => self.heard(&stamped.event, stamped.at_ns),
                    Some(Told::Garbled { name, line }) => {
                        self.show.note(EventSource::DEMO, format!("{name} printed a line that is no event: {line}"));
                    }
                    Some(Told::Killed { name, at_ns }) if name == BELT_NODE => {
                        self.see(MachineEvent::Belt { runs: false }, at_ns);
                        self.killed.send_replace(Some(at_ns));
                    }
                    Some(Told::Killed { .. }) => {}
                    // The programs hold a sender, so the channel does not close before them.
                    None => return std::future::pending().await,
                },
                _ = passes.tick() => self.seen.send_modify(|world| world.pass(wall_nanos())),
            }
        }
    }

    fn heard(&self, event: &ChildEvent, at_ns: i64) {
        match event {
            ChildEvent::Master(MasterEvent::Listening { uri }) => {
                self.master.send_replace(Some(uri.clone()));
            }
            ChildEvent::Machine(event) => self.see(*event, at_ns),
            ChildEvent::Niryo(_)
            | ChildEvent::Turtlebot(_)
            | ChildEvent::Supervisor(_)
            | ChildEvent::Node(_) => {}
        }
    }

    fn see(&self, event: MachineEvent, at_ns: i64) {
        let mut run = self.show.under_way.get();
        if at_ns >= run.since_ns {
            run.acted_ms
                .get_or_insert_with(|| millis(at_ns - run.since_ns));
            self.show.under_way.set(run);
        }
        self.seen.send_modify(|world| world.see(event, at_ns));
        let (who, what) = describe(event);
        self.show.note_at(at_ns, who, what);
    }
}

fn describe(event: MachineEvent) -> (EventSource, String) {
    match event {
        MachineEvent::Grasps { .. } => (ARM, "closes its gripper".to_owned()),
        MachineEvent::Releases { .. } => (ARM, "opens its gripper".to_owned()),
        MachineEvent::Belt { runs: true } => (BELT, "runs".to_owned()),
        MachineEvent::Belt { runs: false } => (BELT, "stands still".to_owned()),
        MachineEvent::Leaves => (BASE, "sets out".to_owned()),
        MachineEvent::Arrives { at: [x, y] } => (BASE, format!("stands at {x}, {y}")),
    }
}

/// The programs that are started.
struct Binaries {
    demo: PathBuf,
    lds: PathBuf,
    component: PathBuf,
    bridge_ros1: PathBuf,
    bridge_ros2: PathBuf,
    tool: PathBuf,
}

struct Story<'a> {
    plan: SkilledOptions,
    binaries: Binaries,
    programs: RunningPrograms,
    /// The port of the status page of the discovery server.
    page: u16,
    /// The port of the page of the cell.
    browser: u16,
    /// The ports of the status pages of the ROS 1 bridge and of the ROS 2 bridge.
    bridges: [u16; 2],
    transport: Duration,
    world: watch::Receiver<CoverLocations>,
    show: &'a Show,
}

/// The used part of the status page of the discovery server.
#[derive(Debug, Default, Deserialize)]
struct Page {
    servers: Vec<Registered>,
}

#[derive(Debug, Deserialize)]
struct Registered {
    uri: String,
    urls: Vec<String>,
}

/// The skills of the line, and the sessions that run them.
struct LineSessions {
    line: SkilledLine,
    sessions: Vec<SkillClient>,
}

impl Story<'_> {
    async fn play(
        &mut self,
        master: watch::Receiver<Option<String>>,
        killed: watch::Receiver<Option<i64>>,
    ) -> Result<(), StopReason> {
        self.introduce()?;
        self.start_all(master).await?;
        let began = Instant::now();
        let LineSessions { line, sessions } = self.find(began).await?;
        self.show.report.borrow_mut().found_ms = Some(elapsed(began));
        let text = format!("all skills are found after {:.0} ms", elapsed(began));
        self.show.note(LINE, text);

        let covers = self.plan.covers;
        let conveyor = Arc::clone(&line.conveyor);
        let (show, world) = (self.show, self.world.clone());
        let beside = async {
            tokio::join!(
                strike(&self.programs, world, covers, show),
                learn(&*conveyor, killed, show)
            );
            std::future::pending().await
        };
        let done = tokio::select! {
            done = line.run(covers, show) => done,
            done = beside => done,
        };
        for session in sessions {
            session.close().await;
        }
        done.map_err(StopReason::Broken)?;
        let mut world = self.world.clone();
        let arrived = world.wait_for(|world| world.delivered() == covers);
        match timeout(SPARE, arrived).await {
            Ok(Ok(_)) => {}
            Ok(Err(_)) | Err(_) => {
                let standing = self.world.borrow().standing();
                return Err(StopReason::Broken(format!(
                    "the line is done, and {standing}"
                )));
            }
        }
        show.note(EventSource::DEMO, "all covers have arrived".to_owned());
        Ok(())
    }

    fn introduce(&self) -> Result<(), DemoFailure> {
        let text = format!(
            "The fault-tolerant product assembly line: {} covers, a conveyor that dies, speed {}.\nTimes are seconds since the beginning; the \
             page of the cell is at {}, the logs are in {}.\n\n",
            self.plan.covers,
            self.plan.speed.factor(),
            address(self.browser),
            self.programs.directory().display()
        );
        let printed = self.show.timeline.borrow_mut().print_text(&text);
        printed.map_err(DemoFailure::io("cannot print"))
    }

    async fn start_all(
        &mut self,
        mut master: watch::Receiver<Option<String>>,
    ) -> Result<(), StopReason> {
        let directory = self.programs.directory().to_owned();
        cell::write(&directory)
            .map_err(DemoFailure::io("cannot write the files of the programs"))?;
        self.start_own("ros-master", &["master"], &[], Stage::Master)?;
        let listens = timeout(SPARE, master.wait_for(Option::is_some)).await;
        let master = match listens {
            Ok(Ok(uri)) => uri.clone().unwrap_or_default(),
            Ok(Err(_)) | Err(_) => {
                return Err(StopReason::Broken(
                    "the ROS master does not listen".to_owned(),
                ));
            }
        };
        let domain = DOMAIN.to_string();
        let ros1 = [("ROS_MASTER_URI", &*master), ("ROS_HOSTNAME", LOOPBACK)];
        let ros2 = [("ROS_LOCALHOST_ONLY", "1"), ("ROS_DOMAIN_ID", &*domain)];
        let mapping = directory.join(MAPPING).display().to_string();
        let [of_ros1, of_ros2] = self.bridges;
        for (name, path, environment, page) in [
            (
                "bridge-ros1",
                self.binaries.bridge_ros1.clone(),
                &ros1,
                of_ros1,
            ),
            (
                "bridge-ros2",
                self.binaries.bridge_ros2.clone(),
                &ros2,
                of_ros2,
            ),
        ] {
            let metrics = format!("{LOOPBACK}:{page}");
            let arguments = [&mapping, "--interface", LOOPBACK, "--metrics", &metrics];
            self.start((name, path), &arguments, environment, Stage::Bridges)?;
        }
        let endpoint = format!("opc.tcp://{LOOPBACK}:{LDS_PORT}");
        let metrics = format!("{LOOPBACK}:{}", self.page);
        let arguments = ["--endpoint", &endpoint, "--metrics", &metrics];
        let lds = self.binaries.lds.clone();
        self.start(("ua-lds", lds), &arguments, &[], Stage::Bridges)?;

        let metrics = format!("{LOOPBACK}:{}", self.browser);
        let arguments = [
            "page",
            &mapping,
            "--interface",
            LOOPBACK,
            "--metrics",
            &metrics,
        ];
        let status = status_of(&self.bridges);
        let status: Vec<&str> = status.iter().map(String::as_str).collect();
        let arguments = [&arguments[..], &status].concat();
        let tool = self.binaries.tool.clone();
        self.start(("page", tool), &arguments, &[], Stage::Bridges)?;
        open_when_served(self.browser, self.plan.open);

        let speed = self.plan.speed.factor().to_string();
        let speed = ["--speed", &speed];
        let arguments = [&["line-arm"], &speed[..]].concat();
        self.start_own("niryo-ned", &arguments, &ros1, Stage::Robots)?;
        self.start_own(BELT_NODE, &["line-belt"], &ros1, Stage::Robots)?;
        let arguments = [&["line-base"], &speed[..]].concat();
        self.start_own("turtlebot3", &arguments, &ros2, Stage::Robots)?;
        for part in &PARTS {
            let yaml = directory.join(format!("{}.yaml", part.name));
            let arguments = [&*yaml.display().to_string(), "--interface", LOOPBACK];
            let component = self.binaries.component.clone();
            self.start((part.name, component), &arguments, &[], Stage::Components)?;
        }
        Ok(())
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
            ..ProgramStart::new(demo, arguments, environment, stage)
        };
        self.programs.start(program).map(drop)
    }

    fn start(
        &mut self,
        program: (&'static str, PathBuf),
        arguments: &[&str],
        environment: &[(&'static str, &str)],
        stage: Stage,
    ) -> Result<(), DemoFailure> {
        let program = ProgramStart::new(program, arguments, environment, stage);
        self.programs.start(program).map(drop)
    }

    /// Finds the skills of the line by their types, in any component.
    async fn find(&self, began: Instant) -> Result<LineSessions, StopReason> {
        let detector = Detector::new(ClientOptions {
            application_name: "assembly line".to_owned(),
            ..ClientOptions::default()
        });
        let mut line = None;
        let told = self.tell_of_servers(&detector);
        let found = async {
            let mut sessions = Vec::new();
            let mut skills: Vec<Arc<dyn RunnableSkill>> = Vec::new();
            for of in [
                "PickAndPlaceSkillType",
                "RunConveyorSkillType",
                "NavigateToSkillType",
            ] {
                let of = ParameterType::own(of);
                let one = detector.one(&of, FOUND, |_| true).await?;
                let (session, handle) = detector.open(&one).await?;
                sessions.push(session);
                skills.push(Arc::new(handle));
            }
            Ok::<_, skills::SkillFault>((sessions, skills))
        };
        let (sessions, skills) = tokio::select! {
            found = found => found.map_err(|fault| {
                StopReason::Broken(format!("the line is not complete after {:.0} ms: {fault}", elapsed(began)))
            })?,
            () = told => return Err(StopReason::Broken("the demo looks no longer".to_owned())),
        };
        if let Ok([pick_and_place, conveyor, base]) = <[_; 3]>::try_from(skills) {
            line = Some(SkilledLine {
                pick_and_place,
                conveyor,
                base,
                transport: self.transport,
                within: WITHIN,
            });
        }
        let line =
            line.ok_or_else(|| StopReason::Broken("there are not three skills".to_owned()))?;
        Ok(LineSessions { line, sessions })
    }

    /// Reports the registered servers to a detector until the future is dropped.
    async fn tell_of_servers(&self, detector: &Detector) {
        let mut known: Vec<String> = Vec::new();
        loop {
            let page: Page = fetch(self.page).await.unwrap_or_default();
            for server in page.servers {
                if let Some(url) = server.urls.first()
                    && PARTS.iter().any(|part| part.uri == server.uri)
                    && !known.contains(&server.uri)
                {
                    detector.seen(&server.uri, url);
                    known.push(server.uri);
                }
            }
            sleep(POLL).await;
        }
    }

    fn failure(&self, stop: StopReason) -> DemoFailure {
        stop.failure(&self.programs, || self.world.borrow().standing())
    }
}

/// Kills the machine and the component of the conveyor while the arm carries the third cover to it,
/// or the last cover if there are fewer.
async fn strike(
    programs: &RunningPrograms,
    mut world: watch::Receiver<CoverLocations>,
    covers: u32,
    show: &Show,
) {
    let left = covers.saturating_sub(STRIKES_AT);
    let carried = world.wait_for(|world| world.is_held() && world.in_storage() <= left);
    if carried.await.is_ok() {
        show.note(
            BELT,
            "dies: its machine and its component are killed".to_owned(),
        );
        programs.kill(BELT_NODE);
        programs.kill(CONVEYOR);
    }
}

/// Records the time until the line detects the loss of the conveyor.
async fn learn(
    conveyor: &dyn RunnableSkill,
    mut killed: watch::Receiver<Option<i64>>,
    show: &Show,
) {
    let why = conveyor.lost().await;
    let now = wall_nanos();
    show.note(LINE, format!("the conveyor is lost: {why}"));
    if let Ok(at) = killed.wait_for(Option::is_some).await
        && let Some(at) = *at
    {
        show.report.borrow_mut().told_lost_ms = Some(millis(now - at).max(0.0));
    }
}

fn elapsed(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

const LINE: EventSource = EventSource("line", "35");
const ARM: EventSource = EventSource("Niryo Ned", "33");
const BELT: EventSource = EventSource("conveyor", "31");
const BASE: EventSource = EventSource("TurtleBot3", "36");
/// The machine of the conveyor.
const BELT_NODE: &str = "conveyor";
const LDS_PORT: u16 = 4840;
/// Number of the cover that is carried when the conveyor is killed.
const STRIKES_AT: u32 = 3;
/// Time that the conveyor takes to move a cover from its start to its end.
const TRANSPORT_SECONDS: f64 = 3.0;
const FOUND: Duration = Duration::from_secs(60);
const WITHIN: Duration = Duration::from_secs(120);
/// Time for processes that do not speed up with the scenario.
const SPARE: Duration = Duration::from_secs(10);
const POLL: Duration = Duration::from_millis(20);
const PASS: Duration = Duration::from_millis(20);
