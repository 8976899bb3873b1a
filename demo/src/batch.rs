//! Batch: a recipe of BatchML doses, stirs and reacts with three simulated process modules (PEAs).
//!
//! Each module is simulated from its manifest. A component makes skills of its services, and
//! `ua-mes` runs the recipe as a process: the reactor is heated while the liquid is dosed and
//! stirred.

mod report;

use self::report::BatchReport;
use crate::pace::Speed;
use crate::stage::{
    DemoFailure, EventSource, LOOPBACK, MES_WHO, MesStory, Show, StopReason, perform,
};

/// The options of the scenario.
#[derive(Clone, Debug)]
pub(crate) struct BatchOptions {
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
pub(crate) async fn play(plan: BatchOptions) -> u8 {
    let mut show = Show::open(plan.json);
    let mut report = BatchReport {
        speed: plan.speed.factor(),
        ..BatchReport::default()
    };
    let ports = MODULES.each_ref().map(|module| module.port);
    let title = "Batch: three simulated process modules, and a recipe of BatchML";
    let outcome = perform(
        (title, &ports, plan.speed),
        (&plan, &mut show, &mut report),
        async |story| story.play().await,
        |report| format!("{} steps had begun", report.steps.len()),
    )
    .await;
    show.conclude(&outcome, &report, &report.table())
}

type Story<'a> = MesStory<'a, BatchOptions, BatchReport>;

impl Story<'_> {
    async fn play(&mut self) -> Result<(), StopReason> {
        self.start_all()?;
        let ms = self.cell.mes.planned(PROCESS, true).await?;
        self.report.planned_ms = Some(ms);
        let text = format!("each step of the recipe has a skill after {ms:.0} ms");
        self.show.note(MES_WHO, text)?;
        let number = self.cell.mes.start(PROCESS).await?;
        let names = MODULES.each_ref().map(|module| module.name);
        let followed = self
            .cell
            .mes
            .follow(number, self.show, &names, &mut self.report.steps);
        followed.await?;
        if !self.report.overlap() {
            let why = "the reactor was not heated while the liquid was dosed or stirred";
            return Err(StopReason::Broken(why.to_owned()));
        }
        let text = "the batch is done; the reactor was heated meanwhile".to_owned();
        self.show.note(EventSource::DEMO, text)?;
        Ok(())
    }

    fn start_all(&mut self) -> Result<(), DemoFailure> {
        self.cell.write("mes.yaml", MES)?;
        self.cell.write("batch.xml", RECIPE)?;
        self.cell.start_mes("mes.yaml")?;
        let seconds = |seconds: f64| (seconds / self.plan.speed.factor()).to_string();
        let (acting, executing) = (seconds(0.5), seconds(3.0));
        for module in &MODULES {
            let manifest = format!("{}.aml", module.name);
            self.cell.write(&manifest, module.manifest)?;
            self.cell
                .write(&format!("{}.yaml", module.name), module.yaml)?;
            let listen = format!("opc.tcp://{LOOPBACK}:{}", module.port);
            let times = ["--acting", &acting, "--executing", &executing];
            let arguments = [&["--listen", &listen][..], &times].concat();
            self.cell
                .simulate_module(module.pea, &manifest, &arguments)?;
            self.cell.plug_in(module.name, self.show)?;
        }
        Ok(())
    }
}

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
