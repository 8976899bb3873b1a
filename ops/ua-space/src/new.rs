//! `ua-space new`: writes a commented starting file.

use std::fs::OpenOptions;
use std::io::{self, Write as _};

use crate::arguments::{CellTemplate, DriverTemplate, NewCellArguments};
use crate::exit::CommandFailure;
use crate::report::warn;

/// Runs `ua-space new`. An existing file stays unchanged.
pub(crate) fn new(arguments: &NewCellArguments) -> Result<(), CommandFailure> {
    let (template, driver) = (arguments.template, arguments.driver);
    if template != CellTemplate::Component && driver != DriverTemplate::Simulated {
        return Err(CommandFailure::Usage(
            "only a component has a driver: ua-space new component --driver ...".to_owned(),
        ));
    }
    let text = text(template, driver);
    let Some(path) = &arguments.output else {
        io::stdout().lock().write_all(text.as_bytes())?;
        return Ok(());
    };
    let mut open = OpenOptions::new();
    let file = open.write(true).create_new(true).open(path);
    let name = path.display();
    let mut file = file.map_err(|error| match error.kind() == io::ErrorKind::AlreadyExists {
        true => CommandFailure::Io(format!(
            "{name} exists already\n  = help: name another file with --output"
        )),
        false => CommandFailure::Io(format!("cannot write {name}: {error}")),
    })?;
    file.write_all(text.as_bytes())
        .map_err(|error| CommandFailure::Io(format!("cannot write {name}: {error}")))?;
    let next = match arguments.template {
        CellTemplate::Component => format!("ua-component --check {name}"),
        CellTemplate::Mes => format!("ua-mes --check {name}"),
        CellTemplate::Mapping => format!("ua-space check {name}"),
        CellTemplate::Sysml => format!("ua-space init --model {name}"),
        CellTemplate::Profile => {
            "apply it to a model in Papyrus, and then ua-space init --model MODEL.uml".to_owned()
        }
    };
    warn(&format!("{name} is written; next: {next}"));
    Ok(())
}

const fn text(template: CellTemplate, driver: DriverTemplate) -> &'static str {
    match (template, driver) {
        (CellTemplate::Component, DriverTemplate::Simulated) => include_str!("new/component.yaml"),
        (CellTemplate::Component, DriverTemplate::Ros) => include_str!("new/component-ros.yaml"),
        (CellTemplate::Component, DriverTemplate::Exec) => include_str!("new/component-exec.yaml"),
        (CellTemplate::Component, DriverTemplate::Http) => include_str!("new/component-http.yaml"),
        (CellTemplate::Component, DriverTemplate::Moveit) => {
            include_str!("new/component-moveit.yaml")
        }
        (CellTemplate::Mes, _) => include_str!("new/mes.yaml"),
        (CellTemplate::Mapping, _) => include_str!("new/mapping.yaml"),
        (CellTemplate::Sysml, _) => include_str!("new/ua-bridge.sysml"),
        (CellTemplate::Profile, _) => include_str!("new/ua-bridge.profile.uml"),
    }
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum as _;

    use super::*;

    #[test]
    fn the_starting_mapping_runs_without_findings() {
        let checked = mappings::Mapping::from_yaml(
            text(CellTemplate::Mapping, DriverTemplate::Simulated),
            "mapping.yaml",
        );
        assert!(checked.mapping.is_some(), "{:?}", checked.findings);
        assert!(checked.findings.is_empty(), "{:?}", checked.findings);
    }

    #[test]
    fn starting_files_explain_each_key() {
        let component = DriverTemplate::value_variants().iter();
        let component = component.map(|driver| (CellTemplate::Component, *driver));
        let others = [CellTemplate::Mes, CellTemplate::Mapping];
        let others = others.map(|template| (template, DriverTemplate::Simulated));
        for (template, driver) in component.chain(others) {
            let lines: Vec<&str> = text(template, driver).lines().collect();
            let comments = lines
                .iter()
                .filter(|line| line.trim_start().starts_with('#'));
            assert!(
                comments.count() * 3 > lines.len(),
                "{template:?} {driver:?}"
            );
            assert!(lines.iter().all(|line| line.len() <= 100), "{driver:?}");
        }
    }
}
