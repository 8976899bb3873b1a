//! `ua-space owl`: NodeSets as OWL ontologies.

use std::io::{self, Write as _};

use knowledge::owl::Ontology;

use crate::arguments::Owl;
use crate::exit::CommandFailure;
use crate::input::{name, read};
use crate::live::harmless;
use crate::report;

/// Runs `ua-space owl`.
pub(crate) fn owl(arguments: &Owl) -> Result<(), CommandFailure> {
    let mut all = Vec::new();
    for file in &arguments.files {
        let wrong = |what: &dyn std::fmt::Display| {
            CommandFailure::Data(harmless(&format!("{}: {what}", name(file))))
        };
        let bytes = read(file)?;
        let text = xml_text::decode(&bytes).map_err(|fault| wrong(&fault))?;
        let ontology = Ontology::read(&text).map_err(|fault| wrong(&fault))?;
        for found in &ontology.findings {
            report::warn(&harmless(&format!("{}: {found}", name(file))));
        }
        all.push(ontology);
    }
    let mut out = io::BufWriter::new(io::stdout().lock());
    for ontology in all {
        ontology.write_turtle(&mut out)?;
    }
    out.flush()?;
    Ok(())
}
