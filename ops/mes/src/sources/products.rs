//! STEP files as sources.

use std::time::Duration;

use knowledge::{KnowledgeSource, SourceLifetime};
use step_files::StepProducts;
use tokio::time::Instant;

use super::MesSources;

impl MesSources {
    /// Adds the products of a STEP file. Products without proven extents have findings.
    pub(super) fn products(
        &self,
        source: &KnowledgeSource,
        read: &StepProducts,
        lasting: SourceLifetime,
    ) -> Result<(), String> {
        let triples = knowledge::products::triples(read, &source.name);
        self.put(source, &triples, lasting)?;
        for found in &read.findings {
            self.found(source, found.to_string(), false);
        }
        Ok(())
    }
}

/// Reads the products of a STEP file without adding them. Returns the findings.
///
/// # Errors
/// The reason why the file cannot be read.
pub(super) fn examined(contents: &[u8]) -> Result<Vec<String>, String> {
    let read = read(contents)?;
    Ok(read.findings.iter().map(ToString::to_string).collect())
}

/// Reads a file. The products that are left after [`READING`] have findings.
///
/// # Errors
/// The reason why the file cannot be read. A fault of the reader leaves all other sources as they
/// are.
pub(super) fn read(contents: &[u8]) -> Result<StepProducts, String> {
    read_within(contents, READING)
}

fn read_within(contents: &[u8], within: Duration) -> Result<StepProducts, String> {
    let began = Instant::now();
    let read = std::panic::catch_unwind(|| {
        StepProducts::read_until(contents, &|| began.elapsed() >= within)
    });
    let read = read.map_err(|_panic| {
        "the file cannot be read because of a fault of this program; report it with the file"
            .to_owned()
    })?;
    read.map_err(|fault| fault.to_string())
}

/// Time limit of the reading of a file.
const READING: Duration = Duration::from_secs(20);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_is_not_read_in_time_is_refused_with_its_line() {
        let step = include_bytes!("../../../../examples/plant/cover.step");
        let late = read_within(step, Duration::ZERO).unwrap_err();
        assert!(
            late.starts_with("line ") && late.contains("the time to read the file was over"),
            "{late}"
        );
        assert!(read(step).is_ok_and(|read| read.findings.is_empty()));
    }
}
