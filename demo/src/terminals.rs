//! Terminals: a robot takes a gripper with its tool changer, places terminal blocks beside each
//! other onto a rail, and puts the gripper away. The steps are a process of the MES; each block is
//! placed by the composite skill of another component.

mod report;
mod tip;

use self::report::{BlockVisit, TerminalsReport};
use self::tip::Tip;
use crate::pace::Speed;
use crate::stage::{DemoFailure, EventSource, MES_WHO, MesStory, Show, StopReason, perform};

/// The options of the scenario.
#[derive(Clone, Debug)]
pub(crate) struct TerminalsOptions {
    pub(crate) speed: Speed,
    pub(crate) json: bool,
}

/// The components of the example plant: names and YAML.
const PARTS: [(&str, &str); 4] = [
    ("ur5", include_str!("../../examples/plant/ur5.yaml")),
    (
        "robotiq-2f85",
        include_str!("../../examples/plant/robotiq-2f85.yaml"),
    ),
    (
        "tool-changer",
        include_str!("../../examples/plant/tool-changer.yaml"),
    ),
    (
        "handling",
        include_str!("../../examples/plant/handling.yaml"),
    ),
];
/// The ports of the components, RTDE, the secondary interface, the gripper and the converter.
const PORTS: [u16; 8] = [24_840, 10_254, 14_840, 12_346, 30_004, 30_002, 1502, 1503];
const PROCESS: &str = "urn:example:process:terminals";
const MES: &str = include_str!("../../examples/plant/terminals.yaml");
const CAPABILITIES: &str = include_str!("../../examples/plant/capabilities.ttl");
/// The tool in its dock, as an argument of its simulator.
const DOCKED: &str = "1@0.3,0.35,0.2,0,0,0";
/// Where each block is, and its place on the rail, m.
const BLOCKS: [[[f64; 3]; 2]; 3] = [
    [[0.4, -0.2, 0.1], [0.2, -0.45, 0.1]],
    [[0.42, -0.2, 0.1], [0.2062, -0.45, 0.1]],
    [[0.44, -0.2, 0.1], [0.2124, -0.45, 0.1]],
];
/// The fingers come at least this near to each block and place, mm.
const NEAR_MM: f64 = 0.1;

/// Plays the scenario and prints it. Returns the exit code.
pub(crate) async fn play(plan: TerminalsOptions) -> u8 {
    let mut show = Show::open(plan.json);
    let mut report = TerminalsReport {
        speed: plan.speed.factor(),
        ..TerminalsReport::default()
    };
    let title = "Terminals: a robot, a tool changer and a gripper place terminal blocks on a rail";
    let outcome = perform(
        (title, &PORTS, plan.speed),
        (&plan, &mut show, &mut report),
        async |story| story.play().await,
        |report| format!("{} steps had begun", report.steps.len()),
    )
    .await;
    show.conclude(&outcome, &report, &report.table())
}

type Story<'a> = MesStory<'a, TerminalsOptions, TerminalsReport>;

impl Story<'_> {
    async fn play(&mut self) -> Result<(), StopReason> {
        self.start_all()?;
        let ms = self.cell.mes.planned(PROCESS, true).await?;
        let text = format!("each step of the process has a skill after {ms:.0} ms");
        self.show.note(MES_WHO, text)?;
        let tip = Tip::follow(BLOCKS.into_iter().flatten().collect()).await;
        let tip = tip.map_err(|why| StopReason::Broken(format!("the simulated robot: {why}")))?;
        let number = self.cell.mes.start(PROCESS).await?;
        let names = PARTS.map(|(name, _)| name);
        let followed = self
            .cell
            .mes
            .follow(number, self.show, &names, &mut self.report.steps)
            .await;
        self.report.visits = visits(&tip.nearest_mm());
        followed?;
        let far = self.report.visits.iter().find(|visit| visit.is_far());
        if let Some(far) = far {
            return Err(StopReason::Broken(format!("the fingers were not at {far}")));
        }
        let text = "three terminal blocks are on the rail".to_owned();
        self.show.note(EventSource::DEMO, text)?;
        Ok(())
    }

    fn start_all(&mut self) -> Result<(), DemoFailure> {
        self.cell.write("mes.yaml", MES)?;
        self.cell.write("capabilities.ttl", CAPABILITIES)?;
        for (name, text) in PARTS {
            self.cell.write(&format!("{name}.yaml"), text)?;
        }
        self.cell.start_mes("mes.yaml")?;
        let speed = self.plan.speed.factor().to_string();
        let speed = ["--speed", speed.as_str()];
        let robot = [&["universal-robot"], &speed[..]].concat();
        self.cell.simulate("simulated-robot", &robot)?;
        let fingers = ["robotiq-2f85", "--object", "0.0062"];
        let fingers = [&fingers[..], &speed].concat();
        self.cell.simulate("simulated-fingers", &fingers)?;
        let changer = ["kelvin-tool-changer", "--tool", DOCKED];
        self.cell.simulate("simulated-changer", &changer)?;
        for (name, _) in PARTS {
            self.cell.plug_in(name, self.show)?;
        }
        Ok(())
    }
}

/// Returns the visits of the fingers, by the smallest distances from the blocks and their places.
fn visits(nearest_mm: &[f64]) -> Vec<BlockVisit> {
    let pairs = nearest_mm.chunks(2).zip(1..);
    let visits = pairs.flat_map(|(pair, block)| {
        let names = ["its magazine", "the rail"];
        pair.iter().zip(names).map(move |(mm, at)| BlockVisit {
            block,
            at,
            nearest_mm: *mm,
        })
    });
    visits.collect()
}

impl BlockVisit {
    fn is_far(&self) -> bool {
        self.nearest_mm > NEAR_MM
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_examples_are_those_of_the_story() {
        let of = |name: &str| PARTS.iter().find(|(known, _)| *known == name).unwrap().1;
        for ([block, place], number) in BLOCKS.iter().zip(1..) {
            let [x, y, z] = block;
            let known = format!("terminal-{number}: {{pose: [{x}, {y}, {z}, 0, 0, 0], box: ");
            assert!(of("handling").contains(&known), "{known}");
            let [x, y, z] = place;
            let step =
                format!("{{ObjectId: terminal-{number}, PlacePosition: [{x}, {y}, {z}, 0, 0, 0]}}");
            assert!(MES.contains(&step), "{step}");
        }
        let docked = DOCKED.replace("1@", "").replace(',', ", ");
        assert!(of("tool-changer").contains(&format!("dock: [{docked}]")));
        assert!(MES.contains(&format!("ToolPosition: [{docked}]")));
        let ports = [24_840, 10_254, 14_840, 12_346];
        for ((_, yaml), port) in PARTS.iter().zip(ports) {
            let line = format!("endpoint: opc.tcp://127.0.0.1:{port}");
            assert!(yaml.lines().any(|known| known == line), "{line}");
        }
    }

    #[test]
    fn fingers_that_stay_away_from_a_place_have_not_placed_a_block() {
        let visits = visits(&[0.0, 0.02, 0.0, 4.0]);
        let far: Vec<String> = visits
            .iter()
            .filter(|visit| visit.is_far())
            .map(ToString::to_string)
            .collect();
        assert_eq!(far, ["the rail with block 2: 4.00 mm from it"]);
    }
}
