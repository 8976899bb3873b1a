//! A cell with a MES that runs processes: discovery server, MES, components and simulated devices.

use std::fs;
use std::path::PathBuf;

use tokio::sync::mpsc;

use super::mes::Mes;
use super::{
    ChildReport, DemoFailure, EventSource, LOOPBACK, RunningPrograms, Show, Stage, StopReason,
    find, free_port, must_be_free, watched,
};
use crate::pace::Speed;

/// The programs of a cell with a MES that runs processes.
pub(crate) struct MesCell {
    pub(crate) programs: RunningPrograms,
    pub(crate) mes: Mes,
    binaries: Binaries,
    /// The port at which the MES answers.
    questions: u16,
}

/// A scenario in a cell with a MES, with its options and its report.
pub(crate) struct MesStory<'a, P, R> {
    pub(crate) plan: &'a P,
    pub(crate) cell: MesCell,
    pub(crate) show: &'a mut Show,
    pub(crate) report: &'a mut R,
}

/// Plays a scenario with programs at these ports, and ends the programs. `standing` describes its
/// progress after an interruption.
pub(crate) async fn perform<P, R>(
    (title, ports, speed): (&str, &[u16], Speed),
    (plan, show, report): (&P, &mut Show, &mut R),
    play: impl AsyncFnOnce(&mut MesStory<'_, P, R>) -> Result<(), StopReason>,
    standing: impl FnOnce(&R) -> String,
) -> Result<(), DemoFailure> {
    let (cell, mut reports) = MesCell::prepare(ports, show, title, speed)?;
    let mut story = MesStory {
        plan,
        cell,
        show,
        report,
    };
    let played = watched(play(&mut story), &mut reports).await;
    let outcome =
        played.map_err(|stop| stop.failure(&story.cell.programs, || standing(story.report)));
    story.cell.programs.conclude(outcome).await
}

struct Binaries {
    lds: PathBuf,
    component: PathBuf,
    mes: PathBuf,
    tool: PathBuf,
}

impl MesCell {
    /// Checks that the programs exist and that their ports are free. Returns the cell, and the
    /// receiver of the reports.
    fn prepare(
        ports: &[u16],
        show: &mut Show,
        title: &str,
        speed: Speed,
    ) -> Result<(Self, mpsc::Receiver<ChildReport>), DemoFailure> {
        let (_, [lds, component, mes, tool]) =
            find(["ua-lds", "ua-component", "ua-mes", "ua-space"])?;
        must_be_free(LDS_PORT, "discovery server")?;
        for port in ports {
            must_be_free(*port, "component or simulator")?;
        }
        let prepared = RunningPrograms::prepare();
        let (programs, reports) =
            prepared.map_err(DemoFailure::io("cannot make a directory for the logs"))?;
        show.text(&format!(
            "{title}; speed {}.\nTimes are seconds since the beginning; the logs are in {}.\n\n",
            speed.factor(),
            programs.directory().display()
        ))?;
        let questions = free_port()?;
        let cell = Self {
            programs,
            mes: Mes::new(tool.clone(), questions),
            binaries: Binaries {
                lds,
                component,
                mes,
                tool,
            },
            questions,
        };
        Ok((cell, reports))
    }

    /// Writes an input file of a program.
    pub(crate) fn write(&self, name: &str, text: &str) -> Result<(), DemoFailure> {
        let written = fs::write(self.programs.directory().join(name), text);
        written.map_err(DemoFailure::io("cannot write the files of the programs"))
    }

    /// Starts the discovery server, and the MES of a file.
    pub(crate) fn start_mes(&mut self, file: &str) -> Result<(), DemoFailure> {
        let endpoint = format!("opc.tcp://{LOOPBACK}:{LDS_PORT}");
        let lds = self.binaries.lds.clone();
        let arguments = ["--endpoint", &endpoint];
        self.programs
            .launch("ua-lds", lds, &arguments, Stage::Bridges)?;
        let sparql = format!("{LOOPBACK}:{}", self.questions);
        let yaml = self.path(file);
        let arguments = [&yaml, "--interface", LOOPBACK, "--sparql", &sparql];
        let mes = self.binaries.mes.clone();
        self.programs
            .launch("ua-mes", mes, &arguments, Stage::Bridges)
    }

    /// Starts a simulated device of `ua-component`.
    pub(crate) fn simulate(
        &mut self,
        name: &'static str,
        arguments: &[&str],
    ) -> Result<(), DemoFailure> {
        let arguments = [&["simulate"], arguments].concat();
        let component = self.binaries.component.clone();
        self.programs
            .launch(name, component, &arguments, Stage::Master)
    }

    /// Starts a simulated process module of `ua-space`.
    pub(crate) fn simulate_module(
        &mut self,
        name: &'static str,
        manifest: &str,
        arguments: &[&str],
    ) -> Result<(), DemoFailure> {
        let manifest = self.path(manifest);
        let arguments = [&["pea", &manifest], arguments].concat();
        let tool = self.binaries.tool.clone();
        self.programs.launch(name, tool, &arguments, Stage::Master)
    }

    /// Starts the component of a file `NAME.yaml`.
    pub(crate) fn plug_in(
        &mut self,
        name: &'static str,
        show: &mut Show,
    ) -> Result<(), DemoFailure> {
        let yaml = self.path(&format!("{name}.yaml"));
        let arguments = [&yaml, "--interface", LOOPBACK];
        let component = self.binaries.component.clone();
        self.programs
            .launch(name, component, &arguments, Stage::Components)?;
        show.note(EventSource(name, "36"), "is plugged in".to_owned())
    }

    /// Kills a component, as in a power failure.
    pub(crate) fn unplug(&self, name: &'static str, show: &mut Show) -> Result<(), DemoFailure> {
        self.programs.kill(name);
        show.note(EventSource(name, "31"), "is unplugged".to_owned())
    }

    fn path(&self, file: &str) -> String {
        let path = self.programs.directory().join(file);
        path.display().to_string()
    }
}

const LDS_PORT: u16 = 4840;
