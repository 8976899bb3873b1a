//! Fuses: an arm inserts a fuse into a fuse box, with a limited force. The first try hits the box
//! beside the slot; the process of the MES backs off and tries again. Then the arm is replaced by
//! an arm of another make, and the same process runs on it.

mod report;

use serde_json::Value as Json;

use self::report::{FuseInsertion, FusesReport};
use crate::pace::Speed;
use crate::stage::{
    DemoFailure, EventSource, MES_WHO, MesStory, Show, StepRun, StopReason, perform,
};

/// The options of the scenario.
#[derive(Clone, Debug)]
pub(crate) struct FusesOptions {
    pub(crate) speed: Speed,
    pub(crate) json: bool,
}

/// The YAML of a component of the example plant.
struct FusesComponent {
    name: &'static str,
    yaml: &'static str,
}

const UR5: FusesComponent = FusesComponent {
    name: "ur5",
    yaml: include_str!("../../examples/plant/ur5.yaml"),
};
/// The arm of another make.
const OTHER: FusesComponent = FusesComponent {
    name: "fuse-arm",
    yaml: include_str!("../../examples/plant/fuse-arm.yaml"),
};
const GRIPPER: FusesComponent = FusesComponent {
    name: "robotiq-2f85",
    yaml: include_str!("../../examples/plant/robotiq-2f85.yaml"),
};
/// The ports of the components, RTDE, the secondary interface and the gripper.
const PORTS: [u16; 5] = [24_840, 10_254, 30_004, 30_002, 1502];
const PROCESS: &str = "urn:example:process:insert-fuse";
const PROCESSES: &str = include_str!("../../examples/plant/fuses.ttl");
const CAPABILITIES: &str = include_str!("../../examples/plant/capabilities.ttl");
const MES: &str = "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
                   endpoint: opc.tcp://127.0.0.1:0\nsecurity: [None]\n\
                   knowledge: [capabilities.ttl, fuses.ttl]\n";
/// The height of the fuse box, m.
const BOX: &str = "0.25";
/// The slot: x, y and radius, m.
const SLOT: &str = "0.453,-0.15,0.0015";
/// The height of the flange at the end of an insertion, m.
const SEAT: f64 = 0.23;
/// A fuse at most this far from its seat is inserted, m.
const NEAR: f64 = 0.001;

/// Plays the scenario and prints it. Returns the exit code.
pub(crate) async fn play(plan: FusesOptions) -> u8 {
    let mut show = Show::open(plan.json);
    let mut report = FusesReport {
        speed: plan.speed.factor(),
        insertions: Vec::new(),
    };
    let title = "Fuses: an arm inserts a fuse with a limited force, then an arm of another make";
    let outcome = perform(
        (title, &PORTS, plan.speed),
        (&plan, &mut show, &mut report),
        async |story| story.play().await,
        |report| format!("{} fuses were inserted", report.insertions.len()),
    )
    .await;
    show.conclude(&outcome, &report, &report.table())
}

type Story<'a> = MesStory<'a, FusesOptions, FusesReport>;

impl Story<'_> {
    async fn play(&mut self) -> Result<(), StopReason> {
        self.start_all()?;
        self.insert(&UR5).await?;
        self.cell.unplug(UR5.name, self.show)?;
        self.cell.mes.planned(PROCESS, false).await?;
        let text = "the process has no arm".to_owned();
        self.show.note(MES_WHO, text)?;
        self.cell.plug_in(OTHER.name, self.show)?;
        self.insert(&OTHER).await?;
        let text = "both arms have inserted a fuse by the same process".to_owned();
        self.show.note(EventSource::DEMO, text)?;
        Ok(())
    }

    fn start_all(&mut self) -> Result<(), DemoFailure> {
        let files = [
            ("mes.yaml", MES),
            ("capabilities.ttl", CAPABILITIES),
            ("fuses.ttl", PROCESSES),
        ];
        for (name, text) in files {
            self.cell.write(name, text)?;
        }
        let speed = self.plan.speed.factor().to_string();
        for part in [&UR5, &OTHER, &GRIPPER] {
            let scaled = format!("{{simulated: {{time_scale: {speed}, ");
            let text = part.yaml.replace("{simulated: {", &scaled);
            self.cell.write(&format!("{}.yaml", part.name), &text)?;
        }
        self.cell.start_mes("mes.yaml")?;
        let world = ["universal-robot", "--surface", BOX, "--hole", SLOT];
        let arguments = [&world[..], &["--speed", &speed]].concat();
        self.cell.simulate("simulated-robot", &arguments)?;
        let arguments = ["robotiq-2f85", "--object", "0.005", "--speed", &speed];
        self.cell.simulate("simulated-fingers", &arguments)?;
        self.cell.plug_in(UR5.name, self.show)?;
        self.cell.plug_in(GRIPPER.name, self.show)
    }

    /// Runs the process with the arm that is plugged in, and checks where the fuse is.
    async fn insert(&mut self, arm: &FusesComponent) -> Result<(), StopReason> {
        let ms = self.cell.mes.planned(PROCESS, true).await?;
        let text = format!("each step of the process has a skill after {ms:.0} ms");
        self.show.note(MES_WHO, text)?;
        let number = self.cell.mes.start(PROCESS).await?;
        let names = [arm.name, GRIPPER.name];
        let mut steps = Vec::new();
        let followed = self
            .cell
            .mes
            .follow(number, self.show, &names, &mut steps)
            .await;
        let insertion = insertion(arm.name, steps);
        let checked = followed.and_then(|()| checked(&insertion).map_err(StopReason::Broken));
        self.report.insertions.push(insertion);
        checked
    }
}

/// Returns the report of a run of the process.
fn insertion(arm: &'static str, steps: Vec<StepRun>) -> FuseInsertion {
    let tries = steps.iter().filter(|step| step.step.starts_with("insert"));
    let blocked = |step: &&StepRun| step.results.get("ForceExceeded") == Some(&Json::Bool(true));
    let (count, resisted) = (tries.clone().count(), tries.clone().filter(blocked).count());
    let last = tries
        .clone()
        .next_back()
        .and_then(|step| step.results.get("Position"));
    let height = last.and_then(|position| position.get(2)?.as_f64());
    let first = steps.iter().map(|step| step.started_ms).min();
    let last = steps.iter().filter_map(|step| step.ended_ms).max();
    FuseInsertion {
        arm,
        tries: count,
        resisted,
        from_seat_mm: height.map(|height| (height - SEAT) * 1e3),
        released: steps.iter().any(|step| step.step == "release"),
        lasted_ms: first
            .zip(last)
            .map(|(first, last)| last.saturating_sub(first)),
        steps,
    }
}

/// Checks that the fuse is in its seat after a second try, and was released there by this arm.
fn checked(insertion: &FuseInsertion) -> Result<(), String> {
    let FuseInsertion {
        arm,
        tries,
        resisted,
        from_seat_mm,
        released,
        ..
    } = insertion;
    let is_seated = from_seat_mm.is_some_and(|mm| mm.abs() <= NEAR * 1e3);
    if (*tries, *resisted, *released, is_seated) != (2, 1, true, true) {
        return Err(format!(
            "{arm}: {tries} tries, {resisted} with resistance, released: {released}, \
             distance of the fuse from its seat: {from_seat_mm:?} mm"
        ));
    }
    let moved = insertion
        .steps
        .iter()
        .filter(|step| step.step.starts_with("insert"));
    match moved.into_iter().find(|step| !step.component.contains(arm)) {
        Some(other) => Err(format!("{} has moved, not {arm}", other.component)),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn tried(step: &str, blocked: bool, height: f64) -> StepRun {
        let results = json!({"ForceExceeded": blocked, "Position": [0.45, -0.15, height, 0, 0, 0]});
        StepRun {
            step: step.to_owned(),
            component: "urn:example:ur5".to_owned(),
            results: results.as_object().unwrap().clone(),
            ..StepRun::default()
        }
    }

    #[test]
    fn a_fuse_is_inserted_if_it_is_in_its_seat_and_released_after_a_second_try() {
        let released = StepRun {
            step: "release".to_owned(),
            ..StepRun::default()
        };
        let first = tried("insert", true, 0.248);
        let again = tried("insert again", false, 0.2302);
        let of = |steps: &[&StepRun]| {
            let steps = steps.iter().map(|step| (*step).clone()).collect();
            checked(&insertion("ur5", steps))
        };
        assert_eq!(of(&[&first, &again, &released]), Ok(()));
        assert!(of(&[&first, &again]).is_err(), "it is still held");
        let short = tried("insert again", false, 0.24);
        assert!(of(&[&first, &short, &released]).is_err());
        let blocked = tried("insert again", true, 0.2302);
        assert!(of(&[&first, &blocked, &released]).is_err());
        assert!(of(&[&again, &released]).is_err(), "there was no retry");
    }

    #[test]
    fn both_arms_have_the_box_and_the_slot_of_the_story() {
        let slot = SLOT.replace(',', ", ");
        let world = format!("contact: {BOX}, hole: [{slot}]");
        assert_eq!(OTHER.yaml.matches(&world).count(), 3, "{world}");
        for (part, port) in [(&UR5, 24_840), (&GRIPPER, 10_254)] {
            let line = format!("endpoint: opc.tcp://127.0.0.1:{port}");
            assert!(part.yaml.lines().any(|known| known == line), "{line}");
        }
        let seat = format!(", -0.15, {SEAT}, 0, 0, 0]");
        assert_eq!(PROCESSES.matches(&seat).count(), 2, "{seat}");
    }
}
