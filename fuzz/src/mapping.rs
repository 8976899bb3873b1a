//! Fuzzes mappings with arbitrary text.

use mappings::{Mapping, Severity};

/// Parses a mapping. A document either can run or has an error, and every finding has a position in
/// the text.
pub fn mapping(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else {
        return;
    };
    let checked = Mapping::from_yaml(text, "fuzz.yaml");
    let errors = checked
        .findings
        .iter()
        .filter(|found| found.severity == Severity::Error);
    assert_eq!(checked.mapping.is_none(), errors.count() > 0);
    assert!(checked.findings.len() <= 256, "findings are bounded");
    // YAML also breaks lines at a single carriage return.
    let lines = 1 + text.matches(['\n', '\r']).count();
    for found in &checked.findings {
        assert!(found.at.line >= 1 && found.at.line <= lines, "{found:?}");
    }
    let told = checked.render(text);
    assert_eq!(told.is_empty(), checked.findings.is_empty());
    if let Some(mapping) = checked.mapping {
        for variable in mapping.variables() {
            assert_eq!(
                mapping.variable(variable.topic).map(|found| &found.name),
                Some(&variable.name)
            );
        }
    }
}
