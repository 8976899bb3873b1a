//! The cell of the line: its mapping and its components, from the examples for integrators.

use std::fs;
use std::io;
use std::path::Path;

/// A component: its name, its ApplicationUri and its YAML.
pub(super) struct Part {
    pub(super) name: &'static str,
    pub(super) uri: &'static str,
    yaml: &'static str,
}

pub(super) const CONVEYOR: &str = "line-conveyor";

/// The components of the line.
pub(super) const PARTS: [Part; 4] = [
    Part {
        name: "line-arm",
        uri: "urn:example:line-arm",
        yaml: include_str!("../../../examples/plant/line-arm.yaml"),
    },
    Part {
        name: "line-handling",
        uri: "urn:example:line-handling",
        yaml: include_str!("../../../examples/plant/line-handling.yaml"),
    },
    Part {
        name: CONVEYOR,
        uri: "urn:example:line-conveyor",
        yaml: include_str!("../../../examples/plant/line-conveyor.yaml"),
    },
    Part {
        name: "line-base",
        uri: "urn:example:line-base",
        yaml: include_str!("../../../examples/plant/line-base.yaml"),
    },
];

/// The file name of the mapping.
pub(super) const MAPPING: &str = "line-by-skills.yaml";
const MAPPING_TEXT: &str = include_str!("../../../mappings/line-by-skills.yaml");

/// Writes the input files of the programs into a directory.
///
/// # Errors
/// A file cannot be written.
pub(super) fn write(directory: &Path) -> io::Result<()> {
    for part in &PARTS {
        fs::write(directory.join(format!("{}.yaml", part.name)), part.yaml)?;
    }
    fs::write(directory.join(MAPPING), MAPPING_TEXT)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_examples_are_those_of_the_story() {
        for part in &PARTS {
            for line in [
                format!("component: {}", part.name),
                format!("application_uri: {}", part.uri),
            ] {
                assert!(
                    part.yaml.lines().any(|known| known == line),
                    "{}: {line}",
                    part.name
                );
            }
        }
    }

    #[test]
    fn what_the_components_ask_for_is_in_the_mapping() {
        let checked = mappings::Mapping::from_yaml(MAPPING_TEXT, MAPPING);
        let mapping = checked.mapping.expect("the shipped mapping is in order");
        let known: Vec<String> = mapping
            .calls()
            .iter()
            .map(|call| call.topic.to_string())
            .collect();
        let mut asked = 0;
        for line in PARTS.iter().flat_map(|part| part.yaml.lines()) {
            if let Some((_, name)) = line.split_once("name: ua_") {
                let end = name.find([',', '}', ' ']).unwrap_or(name.len());
                let name = format!("ua_{}", &name[..end]);
                assert!(known.contains(&name), "{name} of {known:?}");
                asked += 1;
            }
        }
        assert_eq!(asked, 6);
    }
}
