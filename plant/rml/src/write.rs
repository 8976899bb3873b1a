//! Writes the statements of a run as text.

use std::io;

use oxttl::{NQuadsSerializer, TriGSerializer, TurtleSerializer};

use crate::run::RunOutput;

impl RunOutput {
    /// Writes TriG with the prefixes of the mapping. It is Turtle unless the mapping has graphs.
    ///
    /// # Errors
    /// The error of the output.
    pub fn write_trig(&self, out: impl io::Write) -> io::Result<()> {
        let mut serializer = TriGSerializer::new();
        for (prefix, iri) in &self.prefixes {
            // A prefix that is no IRI is left out; its terms are written in full.
            if let Ok(with) = serializer.clone().with_prefix(prefix, iri) {
                serializer = with;
            }
        }
        let mut writer = serializer.for_writer(out);
        for quad in &self.quads {
            writer.serialize_quad(quad)?;
        }
        writer.finish().map(drop)
    }

    /// Writes N-Quads.
    ///
    /// # Errors
    /// The error of the output.
    pub fn write_nquads(&self, out: impl io::Write) -> io::Result<()> {
        let mut writer = NQuadsSerializer::new().for_writer(out);
        for quad in &self.quads {
            writer.serialize_quad(quad)?;
        }
        drop(writer.finish());
        Ok(())
    }

    /// Returns all statements as Turtle, without their graphs.
    ///
    /// # Errors
    /// The error of the output.
    pub fn turtle(&self) -> io::Result<Vec<u8>> {
        let mut writer = TurtleSerializer::new().for_writer(Vec::new());
        for quad in &self.quads {
            writer.serialize_triple(oxrdf::TripleRef::new(
                quad.subject.as_ref(),
                quad.predicate.as_ref(),
                quad.object.as_ref(),
            ))?;
        }
        writer.finish()
    }

    /// Returns whether statements are in named graphs.
    #[must_use]
    pub fn has_graphs(&self) -> bool {
        self.quads
            .iter()
            .any(|quad| !quad.graph_name.is_default_graph())
    }
}
