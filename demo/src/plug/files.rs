//! The YAML files of the scenario: the examples for integrators, with the speed of the scenario.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::fact::PlugComponent;
use crate::pace::Speed;

/// The manifest of a module.
#[derive(Clone, Debug)]
pub(crate) struct ModuleManifest {
    /// The name as printed.
    pub(crate) name: String,
    pub(crate) text: Vec<u8>,
}

impl ModuleManifest {
    /// Reads the manifest from a file, or returns the manifest of the example plant.
    ///
    /// # Errors
    /// The file cannot be read.
    pub(crate) fn read(file: Option<&Path>) -> io::Result<Self> {
        match file {
            None => Ok(Self {
                name: "examples/plant/dosing.aml".to_owned(),
                text: DOSING.into(),
            }),
            Some(file) => Ok(Self {
                name: file.display().to_string(),
                text: fs::read(file)?,
            }),
        }
    }
}

/// Writes the input files of the programs into a directory.
///
/// # Errors
/// A file cannot be written.
pub(crate) fn write(directory: &Path, speed: Speed, manifest: &ModuleManifest) -> io::Result<()> {
    for part in PlugComponent::ALL {
        fs::write(of_part(directory, part), scaled(yaml(part), speed))?;
    }
    fs::write(directory.join("vacuum-gripper.xml"), VACUUM_NODESET)?;
    fs::write(directory.join("capabilities.ttl"), CAPABILITIES)?;
    fs::write(directory.join("module.aml"), &manifest.text)?;
    fs::write(of_mes(directory), with_manifest(MES))
}

/// Returns the path of the YAML of a component.
pub(crate) fn of_part(directory: &Path, part: PlugComponent) -> PathBuf {
    directory.join(format!("{}.yaml", part.name()))
}

/// Returns the path of the YAML of the MES.
pub(crate) fn of_mes(directory: &Path) -> PathBuf {
    directory.join("mes.yaml")
}

const fn yaml(part: PlugComponent) -> &'static str {
    match part {
        PlugComponent::Robot => include_str!("../../../examples/plant/robot.yaml"),
        PlugComponent::Gripper => include_str!("../../../examples/plant/parallel-gripper.yaml"),
        PlugComponent::Vacuum => include_str!("../../../examples/plant/vacuum-gripper.yaml"),
    }
}

/// Sets the speed of simulated drivers.
fn scaled(yaml: &str, speed: Speed) -> String {
    let scale = format!("{SIMULATED}time_scale: {}, ", speed.factor());
    yaml.replace(SIMULATED, &scale)
}

/// Adds the module of the scenario to the manifests of the MES.
fn with_manifest(mes: &str) -> String {
    let module = "manifests:\n  - {name: module, file: module.aml}\n";
    match mes.split_once("processes:\n") {
        Some((before, after)) => format!("{before}{module}processes:\n{after}"),
        None => format!("{mes}{module}"),
    }
}

const SIMULATED: &str = "{simulated: {";
const VACUUM_NODESET: &str = include_str!("../../../examples/plant/vacuum-gripper.xml");
const CAPABILITIES: &str = include_str!("../../../examples/plant/capabilities.ttl");
const MES: &str = include_str!("../../../examples/plant/mes.yaml");
const DOSING: &str = include_str!("../../../examples/plant/dosing.aml");
/// The process that the MES runs.
pub(crate) const PROCESS: &str = "urn:example:process:move-part";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_examples_are_those_of_the_story() {
        for part in PlugComponent::ALL {
            let text = yaml(part);
            for line in [
                format!("component: {}", part.name()),
                format!("application_uri: {}", part.uri()),
                format!("namespace: {}", part.namespace()),
            ] {
                assert!(text.lines().any(|known| known == line), "{part:?}: {line}");
            }
            let scaled = scaled(text, Speed::new(4.0).unwrap());
            let drivers = text.matches("driver:").count();
            assert_eq!(
                scaled.matches("time_scale: 4, ").count(),
                drivers,
                "{part:?}"
            );
        }
        assert!(MES.contains(&format!("process: {PROCESS}\n")));
        assert_eq!(MES.lines().filter(|line| *line == "processes:").count(), 1);
    }
}
