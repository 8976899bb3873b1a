//! STEP files as sources.

use knowledge::{KnowledgeSource, SourceLifetime};
use step_files::StepProducts;

use super::MesSources;

impl MesSources {
    /// Adds the products of a STEP file. Products without proven extents have findings.
    pub(super) fn products(
        &self,
        source: &KnowledgeSource,
        bytes: &[u8],
        lasting: SourceLifetime,
    ) -> Result<(), String> {
        let read = read(bytes)?;
        let triples = knowledge::products::triples(&read, &source.name);
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

/// Reads a file. A fault of the reader leaves all other sources as they are.
fn read(contents: &[u8]) -> Result<StepProducts, String> {
    let read = std::panic::catch_unwind(|| StepProducts::read(contents));
    let read = read.map_err(|_panic| {
        "the file cannot be read because of a fault of this program; report it with the file"
            .to_owned()
    })?;
    read.map_err(|fault| fault.to_string())
}
