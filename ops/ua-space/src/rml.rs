//! `ua-space rml`: runs a mapping of XML files to RDF.

use std::io;
use std::path::Path;

use rml::{Folder, MappingFault, RmlMapping, RunOutput};

use crate::arguments::{RdfFormat, Rml};
use crate::exit::CommandFailure;
use crate::input::read;
use crate::live::harmless;
use crate::report;

/// Runs `ua-space rml`.
pub(crate) fn rml(arguments: &Rml) -> Result<(), CommandFailure> {
    let (mapping, mut folder) = open(&arguments.mapping)?;
    for given in &arguments.files {
        // A path may contain `=`, so that the whole counts as a path unless the name is known.
        let (name, path) = match given.split_once('=') {
            Some((name, path)) if mapping.files().contains(name) => (name, path),
            _ => (only_file(&mapping, &arguments.mapping)?, given.as_str()),
        };
        folder = folder.with(name, read(path)?);
    }
    let output = run(&arguments.mapping, &mapping, folder)?;
    let mut out = io::BufWriter::new(io::stdout().lock());
    match arguments.format {
        RdfFormat::Turtle => output.write_trig(&mut out)?,
        RdfFormat::Nquads => output.write_nquads(&mut out)?,
    }
    io::Write::flush(&mut out)?;
    Ok(())
}

/// Returns the statements of a mapping as Turtle, with `contents` as its only file.
pub(crate) fn turtle(path: &str, contents: Vec<u8>) -> Result<Vec<u8>, CommandFailure> {
    let (mapping, folder) = open(path)?;
    let name = only_file(&mapping, path)?.to_owned();
    let output = run(path, &mapping, folder.with(&name, contents))?;
    if output.has_graphs() {
        report::warn("a source is one graph; the graphs of the mapping are merged in it");
    }
    Ok(output.turtle()?)
}

fn open(path: &str) -> Result<(RmlMapping, Folder), CommandFailure> {
    let text = String::from_utf8(read(path)?)
        .map_err(|_| CommandFailure::Data(format!("{path}: it is not UTF-8; save it as UTF-8")))?;
    let mapping = RmlMapping::read(&text).map_err(|fault| failure(path, &fault))?;
    for found in mapping.findings() {
        report::warn(&harmless(&format!("{path}: {found}")));
    }
    Ok((mapping, Folder::of(Path::new(path))))
}

fn run(path: &str, mapping: &RmlMapping, mut folder: Folder) -> Result<RunOutput, CommandFailure> {
    let output = mapping.run(&mut folder);
    let output = output.map_err(|fault| failure(path, &fault))?;
    for found in &output.findings {
        report::warn(&harmless(&format!("{path}: {found}")));
    }
    Ok(output)
}

fn failure(path: &str, fault: &MappingFault) -> CommandFailure {
    CommandFailure::Data(harmless(&format!("{path}: {fault}")))
}

/// Returns the only file that a mapping names.
fn only_file<'m>(mapping: &'m RmlMapping, path: &str) -> Result<&'m str, CommandFailure> {
    let files: Vec<&str> = mapping.files().into_iter().collect();
    match files.as_slice() {
        [only] => Ok(only),
        several => Err(CommandFailure::Usage(format!(
            "{path} reads several files ({}); give them to `ua-space rml` as NAME=FILE",
            several.join(", ")
        ))),
    }
}
