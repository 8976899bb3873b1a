//! Reads manifests of process modules (MTP).

use std::fs;
use std::io::Read as _;
use std::path::Path;

use mtp::Module;

use crate::exit::CommandFailure;
use crate::input;

/// Reads a manifest, with the documents beside it that it refers to.
pub(crate) fn read(file: &str) -> Result<Module, CommandFailure> {
    let bytes = input::read(file)?;
    let beside = Path::new(file).parent().unwrap_or_else(|| Path::new(""));
    let mut fetch = |name: &str| {
        let mut bytes = Vec::new();
        let file = fs::File::open(beside.join(name)).ok()?;
        file.take(LARGEST).read_to_end(&mut bytes).ok()?;
        Some(bytes)
    };
    Module::from_files(&bytes, &mut fetch)
        .map_err(|error| CommandFailure::Data(format!("{}: {error}", input::name(file))))
}

/// Maximum size of another document in bytes.
const LARGEST: u64 = 64 << 20;

/// Returns the module of a column, for tests.
#[cfg(test)]
pub(crate) fn column() -> Module {
    let file = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../tests/data/mtp/column.aml"
    );
    Module::read(&fs::read_to_string(file).unwrap()).unwrap()
}
