//! `ua-space new`: writes a commented starting file.

use std::fs::OpenOptions;
use std::io::{self, Write as _};

use crate::arguments::{DriverTemplate, New, Template};
use crate::exit::Failure;
use crate::report::warn;

/// Runs `ua-space new`. An existing file stays unchanged.
pub(crate) fn new(arguments: &New) -> Result<(), Failure> {
    let (template, driver) = (arguments.template, arguments.driver);
    if template != Template::Component && driver != DriverTemplate::Simulated {
        return Err(Failure::Usage(
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
        true => Failure::Io(format!(
            "{name} exists already\n  = help: name another file with --output"
        )),
        false => Failure::Io(format!("cannot write {name}: {error}")),
    })?;
    file.write_all(text.as_bytes())
        .map_err(|error| Failure::Io(format!("cannot write {name}: {error}")))?;
    let next = match arguments.template {
        Template::Component => format!("ua-component --check {name}"),
        Template::Mes => format!("ua-mes --check {name}"),
        Template::Mapping => format!("ua-space check {name}"),
        Template::Sysml => format!("ua-space init --model {name}"),
        Template::Profile => {
            "apply it to a model in Papyrus, and then ua-space init --model MODEL.uml".to_owned()
        }
    };
    warn(&format!("{name} is written; next: {next}"));
    Ok(())
}

const fn text(template: Template, driver: DriverTemplate) -> &'static str {
    match (template, driver) {
        (Template::Component, DriverTemplate::Simulated) => include_str!("new/component.yaml"),
        (Template::Component, DriverTemplate::Ros) => include_str!("new/component-ros.yaml"),
        (Template::Component, DriverTemplate::Exec) => include_str!("new/component-exec.yaml"),
        (Template::Component, DriverTemplate::Http) => include_str!("new/component-http.yaml"),
        (Template::Component, DriverTemplate::Moveit) => {
            include_str!("new/component-moveit.yaml")
        }
        (Template::Mes, _) => include_str!("new/mes.yaml"),
        (Template::Mapping, _) => include_str!("new/mapping.yaml"),
        (Template::Sysml, _) => include_str!("new/ua-bridge.sysml"),
        (Template::Profile, _) => include_str!("new/ua-bridge.profile.uml"),
    }
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum as _;

    use super::*;

    #[test]
    fn the_starting_mapping_runs_without_findings() {
        let checked = mappings::Mapping::from_yaml(
            text(Template::Mapping, DriverTemplate::Simulated),
            "mapping.yaml",
        );
        assert!(checked.mapping.is_some(), "{:?}", checked.findings);
        assert!(checked.findings.is_empty(), "{:?}", checked.findings);
    }

    #[test]
    fn starting_files_explain_each_key() {
        let component = DriverTemplate::value_variants().iter();
        let component = component.map(|driver| (Template::Component, *driver));
        let others = [Template::Mes, Template::Mapping];
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
