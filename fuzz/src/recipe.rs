//! Fuzzes recipes of BatchML and BPMN with arbitrary bytes.

/// Reads the contents of a source, which are no recipe, have a process, or have findings with lines
/// of the file.
pub fn recipe(input: &[u8]) {
    match ua_mes::read_recipe(input) {
        Ok(processes) => assert_ne!(processes, Some(0)),
        Err(lines) => {
            assert!(lines.len() <= MOST_FINDINGS, "{}", lines.len());
            // The text may be in an envelope, in which a line end has two characters.
            let last = input.len() + 1;
            assert!(
                lines.iter().all(|line| (1..=last).contains(line)),
                "{lines:?}"
            );
        }
    }
}

/// The limit of findings, and a finding with the number of the others.
const MOST_FINDINGS: usize = 201;
