//! A process with two tools: the MES runs a process of the graph, which takes fingers, moves a
//! part, takes a vacuum cup and moves a cover. In the first run the vacuum gripper is unplugged
//! while the robot approaches the cover, so that the process is planned anew when it is back. A
//! second robot is in the cell; it does not move.
//!
//! Reading order:
//!
//! - this module: the events of the scenario
//! - `report`: the report, and whether each grip was done by the right gripper

mod report;

use std::time::Duration;

use tokio::time::{Instant, sleep};

use self::report::{ProcessReport, ReportedRun};
use crate::pace::Speed;
use crate::stage::{
    DemoFailure, EventSource, JobRun, MES_WHO, MesStory, Show, StopReason, perform, swapped_tools,
};

/// The options of the scenario.
#[derive(Clone, Debug)]
pub(crate) struct ProcessOptions {
    pub(crate) speed: Speed,
    pub(crate) json: bool,
    /// The number of runs.
    pub(crate) runs: u32,
    /// Whether each tool is in the other tool's dock.
    pub(crate) swapped: bool,
}

/// The components of the example plant: names and YAML. The last is a second robot.
const PARTS: [(&str, &str); 5] = [
    ("ur5", include_str!("../../examples/plant/ur5.yaml")),
    (
        FINGERS,
        include_str!("../../examples/plant/robotiq-2f85.yaml"),
    ),
    (
        VACUUM,
        include_str!("../../examples/plant/schmalz-ecbpi.yaml"),
    ),
    (
        CHANGER,
        include_str!("../../examples/plant/tool-changer.yaml"),
    ),
    ("robot", include_str!("../../examples/plant/robot.yaml")),
];
const FINGERS: &str = "robotiq-2f85";
const VACUUM: &str = "schmalz-ecbpi";
const CHANGER: &str = "tool-changer";
/// The ports of the components, RTDE, the secondary interface, the gripper, the IO-Link master and
/// the converter.
const PORTS: [u16; 9] = [
    24_840, 10_254, 10_255, 14_840, 30_004, 30_002, 1502, 8090, 1503,
];
/// The tools in their docks, as arguments of the simulator.
const DOCKED: [&str; 2] = ["1@0.3,0.35,0.2,0,0,0", "2@-0.3,0.35,0.2,0,0,0"];
const PROCESS: &str = "urn:example:process:tool-change";
const PROCESSES: &str = include_str!("../../examples/plant/tool-change.ttl");
const CAPABILITIES: &str = include_str!("../../examples/plant/capabilities.ttl");
const MES: &str = "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
                   endpoint: opc.tcp://127.0.0.1:0\nsecurity: [None]\n\
                   knowledge: [capabilities.ttl, tool-change.ttl]\n";
/// The step during which the vacuum gripper is unplugged: it is attached, and grips later.
const UNPLUGGED_AT: &str = "over the cover";

/// Plays the scenario and prints it. Returns the exit code.
pub(crate) async fn play(plan: ProcessOptions) -> u8 {
    let mut show = Show::open(plan.json);
    let mut report = ProcessReport {
        speed: plan.speed.factor(),
        swapped: plan.swapped,
        ..ProcessReport::default()
    };
    let title = "Process: a part and a cover are moved with two tools, by a process of the graph";
    let outcome = perform(
        (title, &PORTS, plan.speed),
        (&plan, &mut show, &mut report),
        async |story| story.play().await,
        |report| format!("{} runs were over", report.runs.len()),
    )
    .await;
    show.conclude(&outcome, &report, &report.table())
}

type Story<'a> = MesStory<'a, ProcessOptions, ProcessReport>;

impl Story<'_> {
    async fn play(&mut self) -> Result<(), StopReason> {
        self.start_all()?;
        self.report.components = self.found().await?;
        let ms = self.cell.mes.planned(PROCESS, true).await?;
        let text = format!("each step of the process has a skill after {ms:.0} ms");
        self.show.note(MES_WHO, text)?;
        for number in 1..=self.plan.runs {
            let run = self.run(number == 1).await?;
            self.report.add(run);
            let fault = self.report.runs.last().and_then(ReportedRun::fault);
            if let Some(fault) = fault {
                return Err(StopReason::Broken(fault));
            }
        }
        let text = format!(
            "{} grips by the right gripper, of {}",
            self.report.right, self.report.grips
        );
        self.show.note(EventSource::DEMO, text)?;
        Ok(())
    }

    fn start_all(&mut self) -> Result<(), DemoFailure> {
        let files = [
            ("mes.yaml", MES),
            ("capabilities.ttl", CAPABILITIES),
            ("tool-change.ttl", PROCESSES),
        ];
        for (name, text) in files {
            self.cell.write(name, text)?;
        }
        let speed = self.plan.speed.factor().to_string();
        for (name, text) in PARTS {
            let scaled = format!("{{simulated: {{time_scale: {speed}, ");
            let mut text = text.replace("{simulated: {", &scaled);
            if name == CHANGER && self.plan.swapped {
                text = swapped_tools(&text);
            }
            self.cell.write(&format!("{name}.yaml"), &text)?;
        }
        self.cell.start_mes("mes.yaml")?;
        let speed = ["--speed", speed.as_str()];
        let [first, second] = DOCKED;
        for (name, arguments) in [
            (
                "simulated-robot",
                [&["universal-robot"], &speed[..]].concat(),
            ),
            (
                "simulated-fingers",
                [&["robotiq-2f85"], &speed[..]].concat(),
            ),
            (
                "simulated-vacuum",
                [&["schmalz-ecbpi"], &speed[..]].concat(),
            ),
            (
                "simulated-changer",
                vec!["kelvin-tool-changer", "--tool", first, "--tool", second],
            ),
        ] {
            self.cell.simulate(name, &arguments)?;
        }
        for (name, _) in PARTS {
            self.cell.plug_in(name, self.show)?;
        }
        Ok(())
    }

    /// Waits until all components are in the graph. Returns their number.
    async fn found(&mut self) -> Result<usize, StopReason> {
        let began = Instant::now();
        loop {
            // The MES does not answer before it has started; its end stops the story.
            let found = self.cell.mes.components().await.unwrap_or_default();
            let is_there = |(name, _): &(&str, &str)| found.iter().any(|known| known == name);
            let count = PARTS.iter().filter(|part| is_there(part)).count();
            if count == PARTS.len() {
                let text = format!("{count} components are in the graph, two robots among them");
                self.show.note(MES_WHO, text)?;
                return Ok(count);
            }
            if began.elapsed() > FOUND {
                let found = found.join(", ");
                let why = format!("after {FOUND:?} the graph has only {found}");
                return Err(StopReason::Broken(why));
            }
            sleep(POLL).await;
        }
    }

    /// Runs the process once. `is_unplugged` unplugs the vacuum gripper, and plugs it in again when
    /// the process waits for it.
    async fn run(&mut self, is_unplugged: bool) -> Result<ReportedRun, StopReason> {
        let number = self.cell.mes.start(PROCESS).await?;
        let names = PARTS.map(|(name, _)| name);
        let began = Instant::now();
        let mut shown = Vec::new();
        let (mut is_away, mut was_away, mut waited_for) = (false, !is_unplugged, None);
        loop {
            let run = self.cell.mes.run(number).await?.unwrap_or_default();
            run.show_news(&mut shown, self.show, &names)?;
            if !was_away && run.began(UNPLUGGED_AT) {
                self.cell.unplug(VACUUM, self.show)?;
                (is_away, was_away) = (true, true);
            }
            if let Some(what) = run.waits_for.clone().filter(|_| is_away) {
                let text = format!("the process waits: {what}");
                self.show.note(MES_WHO, text)?;
                waited_for = Some(what);
                self.cell.plug_in(VACUUM, self.show)?;
                is_away = false;
            }
            if !run.is_running() {
                return Ok(reported(&run, waited_for, began));
            }
            if began.elapsed() > RUN_LIMIT {
                let why = format!("the process does not end within {RUN_LIMIT:?}");
                return Err(StopReason::Broken(why));
            }
            sleep(POLL).await;
        }
    }
}

fn reported(run: &JobRun, waited_for: Option<String>, began: Instant) -> ReportedRun {
    ReportedRun {
        outcome: run.outcome.clone(),
        reason: run.reason.clone(),
        plans: run.plans(),
        waited_for,
        lasted_ms: began.elapsed().as_secs_f64() * 1e3,
        steps: run.steps(),
    }
}

const FOUND: Duration = Duration::from_secs(60);
const RUN_LIMIT: Duration = Duration::from_secs(240);
const POLL: Duration = Duration::from_millis(50);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_process_names_neither_robots_nor_docks() {
        for name in ["ur5", "robot\"", "ToolPosition", "dock:"] {
            assert!(!PROCESSES.contains(name), "{name}");
        }
        assert!(PROCESSES.contains(&format!("rdfs:label \"{UNPLUGGED_AT}\"")));
        let docks = DOCKED.map(|docked| docked.split_once('@').unwrap().1.replace(',', ", "));
        let changer = PARTS.iter().find(|(name, _)| *name == CHANGER).unwrap().1;
        for dock in docks {
            assert!(changer.contains(&format!("dock: [{dock}]")), "{dock}");
        }
        let ports = [24_840, 10_254, 10_255, 14_840];
        for ((_, yaml), port) in PARTS.iter().zip(ports) {
            let line = format!("endpoint: opc.tcp://127.0.0.1:{port}");
            assert!(yaml.lines().any(|known| known == line), "{line}");
        }
    }
}
