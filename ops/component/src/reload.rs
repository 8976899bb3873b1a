//! The YAML file of the component, which is read again while the program runs.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use bridge_node::ConfigurationFile;
use skills::server::ServeFault;
use skills::yaml::Findings;
use skills::{Component, Lds};
use tracing::error;

use crate::port::built_and_stopped;

/// Reads a component from the text of its YAML; paths in the text are relative to a folder.
pub type ReadComponent = fn(&str, &Path) -> Result<Component, Findings>;

/// Settings of the command line that replace settings of the YAML.
#[derive(Debug, Clone, Default)]
pub struct Overrides {
    /// The endpoint.
    pub endpoint: Option<String>,
    /// The discovery server.
    pub lds: Option<Lds>,
}

/// A version of the YAML file.
#[derive(Debug)]
pub struct Version {
    /// The component.
    pub component: Component,
    /// The text of the file.
    pub text: String,
}

impl Version {
    fn read(
        text: String,
        (path, read): (&Path, ReadComponent),
        overrides: &Overrides,
    ) -> Result<Self, (String, Findings)> {
        let folder = path.parent().unwrap_or_else(|| Path::new(""));
        let mut component = match read(&text, folder) {
            Ok(component) => component,
            Err(findings) => return Err((text, findings)),
        };
        if let Some(endpoint) = &overrides.endpoint {
            component.endpoint.clone_from(endpoint);
        }
        if let Some(lds) = &overrides.lds {
            component.lds = lds.clone();
        }
        Ok(Self { component, text })
    }
}

/// The YAML file with the version at the start of the program and the latest version without
/// findings.
#[derive(Debug)]
pub struct ComponentFile {
    path: PathBuf,
    read: ReadComponent,
    overrides: Overrides,
    started: Arc<Version>,
    latest: Mutex<Arc<Version>>,
}

impl ComponentFile {
    /// Creates the file with its text at the start of the program.
    ///
    /// # Errors
    /// The findings in the text, with the text.
    pub fn new(
        path: PathBuf,
        text: String,
        read: ReadComponent,
        overrides: Overrides,
    ) -> Result<Self, (String, Findings)> {
        let started = Arc::new(Version::read(text, (&path, read), &overrides)?);
        Ok(Self {
            path,
            read,
            overrides,
            latest: Mutex::new(Arc::clone(&started)),
            started,
        })
    }

    /// Returns the version at the start of the program.
    #[must_use]
    pub fn started(&self) -> &Arc<Version> {
        &self.started
    }

    /// Returns the latest version without findings.
    #[must_use]
    pub fn latest(&self) -> Arc<Version> {
        Arc::clone(&self.latest.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Returns whether the file on disk has the text of the latest version without findings. Reads
    /// the file.
    #[must_use]
    pub fn is_saved(&self) -> bool {
        bridge_node::read_text_file(&self.path).is_ok_and(|text| text == self.latest().text)
    }

    /// Logs the findings, and returns the reason why the file is refused.
    fn refuse(&self, findings: Findings) -> String {
        let file = self.path.display();
        let count = findings.len();
        for finding in findings.sorted() {
            let place = finding.place;
            let help = finding.help.as_ref().map(tracing::field::display);
            error!(
                help,
                "{file}:{}:{}: {}: {}", place.line, place.column, finding.code, finding.message
            );
        }
        let s = if count == 1 { "" } else { "s" };
        format!("{file} cannot run ({count} error{s})")
    }
}

impl ConfigurationFile for ComponentFile {
    fn path(&self) -> &Path {
        &self.path
    }

    fn text(&self) -> &str {
        &self.started.text
    }

    fn take(&self, text: String) -> Result<Vec<String>, String> {
        let version = Version::read(text, (&self.path, self.read), &self.overrides);
        let version = version.map_err(|(_, findings)| self.refuse(findings))?;
        let cannot =
            |why: &dyn std::fmt::Display| format!("{} cannot run: {why}", self.path.display());
        match built_and_stopped(&version.component) {
            Ok(Ok(())) => {}
            Ok(Err(ServeFault::Findings(findings))) => return Err(self.refuse(findings)),
            Ok(Err(fault)) => return Err(cannot(&fault)),
            Err(failure) => return Err(cannot(&failure)),
        }
        let mut latest = self.latest.lock().unwrap_or_else(PoisonError::into_inner);
        let changes = Component::changes(&latest.text, &version.text);
        *latest = Arc::new(version);
        Ok(changes.iter().map(ToString::to_string).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const YAML: &str = "component: x\napplication_uri: urn:x\nnamespace: 1\nskills:\n  - {name: Grasp, type: GraspSkillType, driver: simulated}\n";

    fn file(yaml: &str) -> ComponentFile {
        let overrides = Overrides {
            endpoint: Some("opc.tcp://127.0.0.1:0".to_owned()),
            lds: Some(Lds::Nowhere),
        };
        let path = PathBuf::from("x.yaml");
        ComponentFile::new(path, yaml.to_owned(), Component::from_yaml, overrides).unwrap()
    }

    #[test]
    fn a_version_with_findings_or_a_driver_that_does_not_fit_keeps_the_latest() {
        let file = file(YAML);
        for (wrong, why) in [
            (YAML.replace("simulated", "simulate"), "(1 error)"),
            // Only the types show this fault.
            (
                YAML.replace("Grasp,", "A,")
                    .replace("GraspSkillType", "MoveSkillType"),
                "(1 error)",
            ),
            (
                YAML.replace("GraspSkillType", "GrapsSkillType"),
                "(1 error)",
            ),
        ] {
            let told = file.take(wrong).unwrap_err();
            assert!(told.ends_with(why), "{told}");
            assert_eq!(file.latest().text, YAML);
        }
        let longer = YAML.replace("driver: simulated", "driver: simulated, timeout: 3 s");
        let changes = file.take(longer.clone()).unwrap();
        assert_eq!(
            changes,
            ["skills.Grasp.timeout: added, from the next run on"]
        );
        assert_eq!(file.latest().text, longer);
        assert_eq!(file.started().text, YAML);
        assert_eq!(file.take(longer).unwrap(), Vec::<String>::new());
    }
}
