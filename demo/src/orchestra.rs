//! The line by topics: starts the programs of the cell, watches their events, and stops them.

mod describe;
mod report;
mod story;

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::{Instant, interval, sleep_until};

use self::describe::describe;
use self::story::LineStory;
use crate::clock::wall_nanos;
use crate::event::{ChildEvent, MasterEvent};
use crate::line::{DOMAIN, ENDPOINT};
use crate::pace::{Speed, overdue_after};
use crate::stage::{
    ChildReport, DemoFailure, EventPrinter, EventSource, Interrupt, LOOPBACK, ProgramStart,
    RobotHops, RunningPrograms, Stage, address, exit_code, find, free_port, must_be_free,
    open_when_served, status_of,
};

/// The options of the scenario.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OrchestraOptions {
    pub(crate) covers: u32,
    pub(crate) speed: Speed,
    /// In seconds of the scenario.
    pub(crate) conveyor_off_at: f64,
    /// Whether the page is opened in a browser.
    pub(crate) open: bool,
    pub(crate) json: bool,
}

/// Plays the scenario and prints it. Returns the exit code.
pub(crate) async fn play(plan: OrchestraOptions) -> u8 {
    let mut timeline = EventPrinter::open(plan.json);
    let mut story = LineStory::new(plan.covers, plan.speed);
    let mut hops = RobotHops::default();
    let outcome = perform(plan, &mut timeline, &mut story, &mut hops).await;
    let printed = conclude(plan, &mut timeline, (&story, hops), outcome.as_ref().err());
    exit_code(&outcome, &printed)
}

fn conclude(
    plan: OrchestraOptions,
    timeline: &mut EventPrinter,
    (story, hops): (&LineStory, RobotHops),
    failure: Option<&DemoFailure>,
) -> std::io::Result<()> {
    timeline.print_all(&|at| story.seconds(at))?;
    let report = report::OrchestraReport::of(story, hops);
    let table = (story.delivered() > 0).then(|| report.table(story));
    let failure = failure.map(ToString::to_string);
    timeline.conclude(table.as_deref(), failure.as_deref(), (&report, plan.json))
}

async fn perform(
    plan: OrchestraOptions,
    timeline: &mut EventPrinter,
    story: &mut LineStory,
    hops: &mut RobotHops,
) -> Result<(), DemoFailure> {
    let (demo, [bridge_ros1, bridge_ros2, server]) =
        find(["bridge-ros1", "bridge-ros2", "ua-server"])?;
    let binaries = Binaries {
        demo,
        bridge_ros1,
        bridge_ros2,
        server,
    };
    let interrupt = Interrupt::listen()?;
    must_be_free(4840, "OPC UA server")?;
    let (programs, reports) = RunningPrograms::prepare()
        .map_err(DemoFailure::io("cannot make a directory for the logs"))?;
    let mut stage = Director {
        plan,
        binaries,
        programs,
        ports: [free_port()?, free_port()?, free_port()?],
        reports,
        interrupt,
        timeline,
        story,
    };
    let outcome = stage.direct(hops).await;
    // No reports are read after this point, and no process may block on sending them.
    stage.reports.close();
    stage.programs.conclude(outcome).await
}

/// The programs that are started.
struct Binaries {
    demo: PathBuf,
    bridge_ros1: PathBuf,
    bridge_ros2: PathBuf,
    server: PathBuf,
}

/// The state of a run of the scenario.
struct Director<'a> {
    plan: OrchestraOptions,
    binaries: Binaries,
    programs: RunningPrograms,
    /// The ports of the status pages of the bridges and of the server.
    ports: [u16; 3],
    reports: mpsc::Receiver<ChildReport>,
    interrupt: Interrupt,
    timeline: &'a mut EventPrinter,
    story: &'a mut LineStory,
}

impl Director<'_> {
    async fn direct(&mut self, hops: &mut RobotHops) -> Result<(), DemoFailure> {
        let begin_by = Instant::now() + BEGIN_WITHIN;
        self.introduce()?;
        self.start_own("ros-master", &["master"], &[], Stage::Master)?;
        let master_uri = self.master_uri(begin_by).await?;
        let [ros1_port, ros2_port, page] = self.ports;
        self.start_cell(&master_uri)?;
        open_when_served(page, self.plan.open);

        self.watch(begin_by, |story| story.began()).await?;
        let overdue = overdue_after(self.plan.covers, self.plan.conveyor_off_at);
        let finish_by = Instant::now() + self.plan.speed.real(overdue) + SPARE;
        self.watch(finish_by, LineStory::finished).await?;
        // The last counts may still be on their way to the server. The covers have arrived in any
        // case.
        match self.watch(Instant::now() + SPARE, LineStory::settled).await {
            Ok(()) | Err(DemoFailure::Stuck { .. }) => {}
            Err(failure) => return Err(failure),
        }
        let (measured, missing) = RobotHops::ask([ros1_port, ros2_port]).await;
        *hops = measured;
        missing.into_iter().for_each(|why| self.note(why));
        Ok(())
    }

    fn introduce(&mut self) -> Result<(), DemoFailure> {
        let OrchestraOptions {
            covers,
            speed,
            conveyor_off_at,
            ..
        } = self.plan;
        let text = format!(
            "The fault-tolerant product assembly line: {covers} covers, conveyor off at second \
             {conveyor_off_at}, speed {}.\nTimes are seconds of the story; the OPC UA server is \
             at {ENDPOINT}, the page of the cell at {}, the logs in {}.\n\n",
            speed.factor(),
            address(self.ports[2]),
            self.programs.directory().display()
        );
        self.timeline
            .print_text(&text)
            .map_err(DemoFailure::io("cannot print"))
    }

    async fn master_uri(&mut self, by: Instant) -> Result<String, DemoFailure> {
        while let Some(report) = self.next_report(by).await? {
            if let ChildEvent::Master(MasterEvent::Listening { uri }) = report {
                return Ok(uri);
            }
        }
        Err(self.not_begun())
    }

    /// Starts all programs except the master.
    fn start_cell(&mut self, master_uri: &str) -> Result<(), DemoFailure> {
        let mapping = self.programs.directory().join("assembly-line.yaml");
        fs::write(&mapping, MAPPING).map_err(DemoFailure::io("cannot write the mapping"))?;
        let mapping = mapping.display().to_string();
        let pki = |of: &str| self.programs.directory().join(of).display().to_string();
        let (server_pki, client_pki) = (pki("server-pki"), pki("supervisor-pki"));
        let [ros1_port, ros2_port, page] = self.ports;
        let domain = DOMAIN.to_string();
        let ros1 = [
            ("ROS_MASTER_URI", master_uri),
            ("ROS_HOSTNAME", "127.0.0.1"),
        ];
        let ros2 = [("ROS_LOCALHOST_ONLY", "1"), ("ROS_DOMAIN_ID", &domain)];

        let server = self.binaries.server.clone();
        let arguments = [&mapping, "--interface", LOOPBACK, "--endpoint", ENDPOINT];
        let metrics = format!("127.0.0.1:{page}");
        let own = ["--pki", &server_pki, "--metrics", &metrics];
        let status = status_of(&[ros1_port, ros2_port]);
        let status: Vec<&str> = status.iter().map(String::as_str).collect();
        let arguments = [&arguments[..], &own, &status].concat();
        self.start("ua-server", server, &arguments, &[])?;
        let path = self.binaries.bridge_ros1.clone();
        let metrics = format!("127.0.0.1:{ros1_port}");
        let arguments = [&mapping, "--interface", LOOPBACK, "--metrics", &metrics];
        self.start("bridge-ros1", path, &arguments, &ros1)?;
        let path = self.binaries.bridge_ros2.clone();
        let metrics = format!("127.0.0.1:{ros2_port}");
        let arguments = [&mapping, "--interface", LOOPBACK, "--metrics", &metrics];
        self.start("bridge-ros2", path, &arguments, &ros2)?;

        let speed = self.plan.speed.factor().to_string();
        let covers = self.plan.covers.to_string();
        let off_at = self.plan.conveyor_off_at.to_string();
        let arguments = ["niryo", "--covers", &covers, "--speed", &speed];
        self.start_own("niryo-ned", &arguments, &ros1, Stage::Robots)?;
        let arguments = ["turtlebot", "--speed", &speed];
        self.start_own("turtlebot3", &arguments, &ros2, Stage::Robots)?;
        let arguments = [
            "supervisor",
            "--conveyor-off-at",
            &off_at,
            "--speed",
            &speed,
        ];
        let arguments = [&arguments[..], &["--pki", &client_pki]].concat();
        self.start_own("supervisor", &arguments, &[], Stage::Robots)
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
        name: &'static str,
        path: PathBuf,
        arguments: &[&str],
        environment: &[(&'static str, &str)],
    ) -> Result<(), DemoFailure> {
        let program = ProgramStart::new((name, path), arguments, environment, Stage::Bridges);
        self.programs.start(program).map(drop)
    }

    /// Processes events until the condition is met.
    async fn watch(
        &mut self,
        by: Instant,
        there: impl Fn(&LineStory) -> bool,
    ) -> Result<(), DemoFailure> {
        while !there(self.story) {
            if self.next_report(by).await?.is_none() {
                return Err(if self.story.began() {
                    self.stuck()
                } else {
                    self.not_begun()
                });
            }
        }
        Ok(())
    }

    /// Returns the next event, or `None` after the time limit. Prints due lines meanwhile.
    async fn next_report(&mut self, by: Instant) -> Result<Option<ChildEvent>, DemoFailure> {
        let mut print = interval(PRINT_EVERY);
        loop {
            tokio::select! {
                report = self.reports.recv() => match report {
                    Some(ChildReport::Told(stamped)) => {
                        self.story.observe(&stamped);
                        if let Some((who, what)) = describe(&stamped.event) {
                            self.timeline.note(stamped.at_ns, who, what);
                        }
                        return Ok(Some(stamped.event));
                    }
                    Some(ChildReport::Garbled { name, line }) => {
                        self.note(format!("{name} printed a line that is no event: {line}"));
                    }
                    Some(ChildReport::Ended { name, status }) => {
                        let last_lines = self.programs.last_lines(name);
                        let logs = self.programs.directory().to_owned();
                        return Err(DemoFailure::ChildEnded { name, status, last_lines, logs });
                    }
                    // No program of this scenario is killed.
                    Some(ChildReport::Killed { .. }) => {}
                    // The programs hold a sender, so the channel does not close before them.
                    None => return Ok(None),
                },
                () = sleep_until(by) => return Ok(None),
                () = self.interrupt.come() => {
                    return Err(DemoFailure::Interrupted { standing: self.story.standing() });
                }
                _ = print.tick() => {
                    self.timeline
                        .print_before(wall_nanos(), &|at| self.story.seconds(at))
                        .map_err(DemoFailure::io("cannot print"))?;
                }
            }
        }
    }

    fn note(&mut self, what: String) {
        self.timeline.note(wall_nanos(), EventSource::DEMO, what);
    }

    fn not_begun(&self) -> DemoFailure {
        DemoFailure::NotBegun {
            seconds: BEGIN_WITHIN.as_secs(),
            standing: self.story.standing(),
            logs: self.programs.directory().to_owned(),
        }
    }

    fn stuck(&self) -> DemoFailure {
        DemoFailure::Stuck {
            standing: self.story.standing(),
            logs: self.programs.directory().to_owned(),
        }
    }
}

const MAPPING: &str = include_str!("../../mappings/assembly-line.yaml");
/// Time limit for the programs to connect to each other.
const BEGIN_WITHIN: Duration = Duration::from_secs(60);
/// Time for processes that do not speed up with the scenario.
const SPARE: Duration = Duration::from_secs(10);
const PRINT_EVERY: Duration = Duration::from_millis(50);
