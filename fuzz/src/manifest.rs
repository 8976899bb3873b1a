//! Fuzzes manifests of process modules, and containers with manifests, with arbitrary bytes.

use mtp::{ManifestError, Module};

/// Parses a file, which is a manifest or gives an error with a line of the file.
pub fn manifest(input: &[u8]) {
    match Module::from_bytes(input) {
        Ok(module) => {
            let triples = module.triples("urn:example:fuzz", &Default::default());
            assert!(!triples.is_empty());
            for picture in &module.pictures {
                let drawing = picture.svg(&module.assemblies);
                assert!(drawing.ends_with("</svg>\n"), "{drawing}");
            }
        }
        Err(ManifestError::Xml { line, .. }) if !input.starts_with(b"PK") => {
            assert!((1..=input.len() + 1).contains(&line), "{line}");
        }
        Err(_) => {}
    }
}
