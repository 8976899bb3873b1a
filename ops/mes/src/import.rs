//! Imports files into the graph: capabilities, types, modules and processes.

use std::collections::{BTreeMap, BTreeSet};

use bridge_node::{Failure, FailureKind};
use knowledge::{Knowledge, Source, SourceKind, nodeset, vocabulary as v};
use mtp::{Module, Object, Triple};
use skills::TypeName;
use tracing::{info, warn};

use crate::settings::{self, Settings};

/// Imports all files that the YAML names.
///
/// # Errors
/// The first file that cannot be read, with its name.
pub(crate) fn all(knowledge: &Knowledge, settings: &Settings, at: u64) -> Result<(), Failure> {
    let mut types = BTreeMap::new();
    let ours = skills::model::nodeset();
    put_node_set(knowledge, "the NodeSet of skills", &ours, (at, &mut types))?;
    for file in &settings.nodesets {
        let bytes = read(file)?;
        let text = xml_text::decode(&bytes).map_err(|fault| refused(&file.name, &fault))?;
        put_node_set(knowledge, &file.name, &text, (at, &mut types))?;
    }
    for file in &settings.knowledge {
        let source = Source::new(SourceKind::File, &file.name);
        let text = String::from_utf8(read(file)?);
        let text = text.map_err(|error| {
            let at = error.utf8_error().valid_up_to();
            refused(
                &file.name,
                &format!("it is not UTF-8 from byte {at} on; save it as UTF-8"),
            )
        })?;
        knowledge
            .replace_turtle(&source, &text, at)
            .map_err(|fault| refused(&file.name, &fault))?;
    }
    for manifest in &settings.manifests {
        let name = &manifest.source.name;
        let module =
            Module::from_bytes(&read(&manifest.source)?).map_err(|fault| refused(name, &fault))?;
        for finding in &module.findings {
            warn!(manifest = name, "{}: {}", finding.about, finding.what);
        }
        let triples = module.triples(&manifest.iri, &manifest.capabilities);
        knowledge
            .replace(&Source::new(SourceKind::Mtp, name), &triples, at)
            .map_err(|fault| refused(name, &fault))?;
        info!(
            manifest = name,
            module = module.name,
            services = module.services.len(),
            "a module is in the graph"
        );
    }
    for process in &settings.processes {
        let triples = process.triples(&|name: &TypeName| {
            types
                .get(&(name.namespace.clone(), name.name.clone()))
                .cloned()
        });
        knowledge
            .replace(
                &Source::new(SourceKind::Process, &process.iri),
                &triples,
                at,
            )
            .map_err(|fault| refused(&process.iri, &fault))?;
    }
    Ok(())
}

/// The IRIs of types by namespace and BrowseName.
type Types = BTreeMap<(String, String), String>;

fn put_node_set(
    knowledge: &Knowledge,
    name: &str,
    text: &str,
    (at, types): (u64, &mut Types),
) -> Result<(), Failure> {
    let read = nodeset::read(text).map_err(|fault| refused(name, &fault))?;
    let said = |triple: &Triple, predicate: &str| {
        if let Object::Text(text) = &triple.object
            && triple.predicate == predicate
        {
            return Some(text.clone());
        }
        None
    };
    let namespaces: BTreeMap<&str, String> = read
        .triples
        .iter()
        .filter_map(|triple| Some((triple.subject.as_str(), said(triple, v::NODE_NAMESPACE)?)))
        .collect();
    let classes: BTreeSet<&str> = read
        .triples
        .iter()
        .filter(|triple| {
            triple.predicate == v::RDF_TYPE
                && triple.object == Object::Iri(v::RDFS_CLASS.to_owned())
        })
        .map(|triple| triple.subject.as_str())
        .collect();
    for triple in read
        .triples
        .iter()
        .filter(|triple| classes.contains(triple.subject.as_str()))
    {
        if let (Some(name), Some(namespace)) = (
            said(triple, v::BROWSE_NAME),
            namespaces.get(triple.subject.as_str()),
        ) {
            types.insert((namespace.clone(), name), triple.subject.clone());
        }
    }
    knowledge
        .replace(
            &Source::new(SourceKind::NodeSet, &read.namespace),
            &read.triples,
            at,
        )
        .map_err(|fault| refused(name, &fault))
}

fn read(file: &settings::Source) -> Result<Vec<u8>, Failure> {
    let path = file.path.display();
    bridge_node::read_bounded(&file.path, LARGEST)
        .map_err(|error| Failure::new(FailureKind::Io, format!("cannot read {path}: {error}")))
}

fn refused(name: &str, fault: &dyn std::fmt::Display) -> Failure {
    Failure::new(FailureKind::Configuration, format!("{name}: {fault}"))
}

/// Maximum size of a file in bytes.
const LARGEST: u64 = 64 << 20;
