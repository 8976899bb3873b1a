//! Any bytes as a manifest of a process module, or as a container of one.

use mtp::{ManifestError, Module};

/// A file is a manifest or has an error that names a line of it.
pub fn manifest(input: &[u8]) {
    match Module::from_bytes(input) {
        Ok(module) => {
            let triples = module.triples("urn:example:fuzz", &Default::default());
            assert!(!triples.is_empty());
        }
        Err(ManifestError::Xml { line, .. }) if !input.starts_with(b"PK") => {
            assert!((1..=input.len() + 1).contains(&line), "{line}");
        }
        Err(_) => {}
    }
}
