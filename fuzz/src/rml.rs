//! Fuzzes RML mappings and the XML files that they map with arbitrary text.

use rml::{Files, MappingFileFault, RmlMapping};

/// Reads a mapping, and runs it with the file that follows it after a line of three dashes.
pub fn rml(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else {
        return;
    };
    let (mapping, file) = text.split_once("\n---\n").unwrap_or((text, "<a/>"));
    let Ok(mapping) = RmlMapping::read(mapping) else {
        return;
    };
    let Ok(output) = mapping.run(&mut Every(file.as_bytes())) else {
        return;
    };
    let mut quads = Vec::new();
    let written = output.write_nquads(&mut quads);
    assert!(written.is_ok(), "{written:?}");
    let lines = quads.split(|byte| *byte == b'\n').count();
    assert_eq!(lines, output.quads.len() + 1);
}

/// A file that has every name.
struct Every<'f>(&'f [u8]);

impl Files for Every<'_> {
    fn read(&mut self, _name: &str) -> Result<Vec<u8>, MappingFileFault> {
        Ok(self.0.to_vec())
    }
}
