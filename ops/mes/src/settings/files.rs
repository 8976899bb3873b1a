//! The files that the YAML names.

use std::collections::BTreeMap;
use std::path::PathBuf;

use skills::yaml::{DocumentKind, DocumentNode, YamlFindingCode};
use skills::{read_endpoint, read_name};

use super::Reading;
use crate::nodeset_url::NodeSetUrl;
use crate::recipe::Names;

/// A file, with its name in the YAML.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Source {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
}

/// The origin of NodeSets that others require.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum NodeSetOrigin {
    Folder(Source),
    Url(NodeSetUrl),
}

/// An RML mapping of XML files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RmlSource {
    /// The mapping.
    pub(crate) mapping: Source,
    /// The file in the place of the only file that the mapping names.
    pub(crate) file: Option<Source>,
}

/// A recipe of BatchML or BPMN.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RecipeSource {
    pub(crate) source: Source,
    /// Names of the file, with the names that they stand for.
    pub(crate) names: Names,
}

/// The manifest of a module.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Manifest {
    pub(crate) source: Source,
    /// The IRI of the module.
    pub(crate) iri: String,
    /// Classes of capabilities by the name of a service, or of `service/procedure`.
    pub(crate) capabilities: BTreeMap<String, Vec<String>>,
    /// The connection to the module, for the states of its services.
    pub(crate) connect: Connect,
}

/// The connection to a module.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Connect {
    No,
    /// At the endpoint of the manifest.
    Yes,
    /// At this endpoint.
    At(String),
}

impl Reading<'_, '_> {
    pub(super) fn files(&mut self, node: &DocumentNode) -> Vec<Source> {
        self.each(node, |reading, node| {
            let name = reading.reader.text(node, "the path of a file")?;
            Some(reading.source(name, name))
        })
    }

    pub(super) fn folder(&mut self, node: &DocumentNode) -> Option<Source> {
        let name = self.reader.text(node, "the path of a folder")?;
        Some(self.source(name, name))
    }

    /// Reads the origin of NodeSets: a URL if the text has a scheme, or else a folder.
    pub(super) fn nodeset_origin(&mut self, node: &DocumentNode) -> Option<NodeSetOrigin> {
        let text = self.reader.text(node, "the path of a folder, or a URL")?;
        if !text.contains("://") {
            return Some(NodeSetOrigin::Folder(self.source(text, text)));
        }
        match text.parse::<NodeSetUrl>() {
            Ok(url) => Some(NodeSetOrigin::Url(url)),
            Err(error) => {
                let message = format!("no NodeSets can be fetched from there: {error}");
                self.reader
                    .refuse(node, YamlFindingCode::WrongValue, message)
            }
        }
    }

    fn source(&self, name: &str, path: &str) -> Source {
        Source {
            name: name.to_owned(),
            path: self.folder.join(path),
        }
    }

    /// Checks that no two files of the graph have one name.
    pub(super) fn files_once(&mut self, root: &DocumentNode, files: &[Source], rml: &[RmlSource]) {
        let names = files.iter().map(|file| &*file.name);
        let names = names.chain(rml.iter().map(|rml| &*rml.mapping.name));
        self.once(root, names, "file");
    }

    /// Reads a mapping: its path, or a map.
    pub(super) fn rml(&mut self, node: &DocumentNode) -> Option<RmlSource> {
        if !matches!(node.kind, DocumentKind::Map(_)) {
            let path = self.reader.text(node, "the path of a mapping, or a map")?;
            return Some(RmlSource {
                mapping: self.source(path, path),
                file: None,
            });
        }
        let [mapping, file, name] = self.reader.map(node, ["mapping", "file", "name"])?;
        let mapping = self.reader.needed(mapping, "mapping", node.place)?;
        let mapping = self.reader.text(mapping, "the path of a mapping")?;
        let file = match file {
            Some(node) => Some(self.reader.text(node, "the path of a file")?),
            None => None,
        };
        let name = match name {
            Some(node) => self.reader.text(node, "a name")?,
            None => file.unwrap_or(mapping),
        };
        Some(RmlSource {
            mapping: self.source(name, mapping),
            file: file.map(|file| self.source(file, file)),
        })
    }

    /// Reads a recipe: its path, or a map.
    pub(super) fn recipe(&mut self, node: &DocumentNode) -> Option<RecipeSource> {
        if !matches!(node.kind, DocumentKind::Map(_)) {
            let path = self.reader.text(node, "the path of a recipe, or a map")?;
            return Some(RecipeSource {
                source: self.source(path, path),
                names: Names::new(),
            });
        }
        let [file, names] = self.reader.map(node, ["file", "names"])?;
        let file = self.reader.needed(file, "file", node.place)?;
        let file = self.reader.text(file, "the path of a recipe")?;
        let mut given = Names::new();
        if let Some(node) = names {
            let DocumentKind::Map(pairs) = &node.kind else {
                self.reader
                    .wrong(node, "a map from names of the recipe to names here");
                return None;
            };
            for (name, stands_for) in pairs {
                let name = self.reader.text(name, "a name of the recipe");
                let stands_for = self.reader.text(
                    stands_for,
                    "a capability, a type of skills, a parameter or a unit",
                );
                if let (Some(name), Some(stands_for)) = (name, stands_for) {
                    given.insert(name.to_owned(), stands_for.to_owned());
                }
            }
        }
        Some(RecipeSource {
            source: self.source(file, file),
            names: given,
        })
    }

    pub(super) fn manifest(&mut self, node: &DocumentNode) -> Option<Manifest> {
        let keys = ["name", "file", "iri", "capabilities", "connect"];
        let [name, file, iri, capabilities, connect] = self.reader.map(node, keys)?;
        let connect = match connect {
            None => Connect::No,
            Some(node) => match self.reader.text(node, "true, false or an endpoint")? {
                "false" => Connect::No,
                "true" => Connect::Yes,
                _ => Connect::At(read_endpoint(node, self.reader)?),
            },
        };
        let file = self
            .reader
            .needed(file, "file", node.place)
            .and_then(|node| self.reader.text(node, "the path of a file"));
        let name = match name {
            Some(node) => read_name(node, self.reader),
            None => file.map(str::to_owned),
        };
        let iri = match iri {
            Some(node) => self.iri(node, YamlFindingCode::Uri),
            None => name
                .as_deref()
                .map(|name| format!("urn:ua-bridge:mtp:{}", mtp::escaped(name))),
        };
        let mut told = BTreeMap::new();
        if let Some(node) = capabilities {
            let DocumentKind::Map(pairs) = &node.kind else {
                self.reader.wrong(
                    node,
                    "a map from the name of a service to IRIs of capabilities",
                );
                return None;
            };
            for (service, classes) in pairs {
                let Some(service) = self.reader.text(service, "the name of a service") else {
                    continue;
                };
                let classes = self.each(classes, |reading, node| {
                    reading.iri(node, YamlFindingCode::Capability)
                });
                told.insert(service.to_owned(), classes);
            }
        }
        Some(Manifest {
            source: self.source(&name?, file?),
            iri: iri?,
            capabilities: told,
            connect,
        })
    }
}
