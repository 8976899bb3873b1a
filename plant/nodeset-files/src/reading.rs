//! The elements of a NodeSet2 file, collected into a document.

use std::ops::ControlFlow;

use xml_text::{XmlAttributeFault, XmlElement, XmlVisitor};

use super::{
    MAX_NODES, MAX_REQUIRED, ModelVersion, NodeSetDocument, NodeSetElementFault, NodeSetFileNode,
    NodeSetFileReference, NodeSetModel,
};

/// The part of a file that is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ReadingExtent {
    Whole,
    /// All until the end of the models.
    Models,
}

/// The document as far as it was read.
#[derive(Debug)]
pub(crate) struct NodeSetReading {
    extent: ReadingExtent,
    document: NodeSetDocument,
    /// The names of the open elements.
    open: Vec<String>,
    /// Whether the root element was read.
    has_root: bool,
    text: String,
    /// Whether the first model is open.
    is_first_model: bool,
    alias: String,
    reference: NodeSetFileReference,
}

impl NodeSetReading {
    pub(crate) fn new(extent: ReadingExtent) -> Self {
        Self {
            extent,
            document: NodeSetDocument::default(),
            open: Vec::new(),
            has_root: false,
            text: String::new(),
            is_first_model: false,
            alias: String::new(),
            reference: NodeSetFileReference::default(),
        }
    }

    /// Returns the document; `None` if the file has no elements.
    pub(crate) fn finish(self) -> Option<NodeSetDocument> {
        self.has_root.then_some(self.document)
    }

    fn node(&mut self, class: &str, element: &XmlElement<'_>) -> Result<(), NodeSetElementFault> {
        if self.document.nodes.len() >= MAX_NODES {
            return Err(NodeSetElementFault::Nodes(MAX_NODES));
        }
        self.document.nodes.push(NodeSetFileNode {
            line: element.line(),
            class: class.to_owned(),
            id: text(element, "NodeId")?,
            browse_name: text(element, "BrowseName")?,
            parent: element.attribute("ParentNodeId")?,
            data_type: element.attribute("DataType")?,
            value_rank: element.attribute("ValueRank")?,
            is_abstract: text(element, "IsAbstract")? == "true",
            ..NodeSetFileNode::default()
        });
        Ok(())
    }

    /// Adds a model. The first model of a file describes the file.
    fn model(&mut self, element: &XmlElement<'_>) -> Result<(), NodeSetElementFault> {
        self.is_first_model = self.document.model.is_none();
        if self.is_first_model {
            self.document.model = Some(NodeSetModel {
                namespace: text(element, "ModelUri")?,
                version: version(element)?,
                required: Vec::new(),
            });
        }
        Ok(())
    }

    fn required(&mut self, element: &XmlElement<'_>) -> Result<(), NodeSetElementFault> {
        let namespace = text(element, "ModelUri")?;
        let is_read = self.is_first_model && !namespace.is_empty();
        let Some(model) = self.document.model.as_mut().filter(|_| is_read) else {
            return Ok(());
        };
        if model.required.len() >= MAX_REQUIRED {
            return Err(NodeSetElementFault::Required(MAX_REQUIRED));
        }
        model.required.push((namespace, version(element)?));
        Ok(())
    }
}

impl XmlVisitor for NodeSetReading {
    type Fault = NodeSetElementFault;

    fn open(&mut self, element: &XmlElement<'_>) -> Result<(), NodeSetElementFault> {
        let name = element.name();
        match (self.open.len(), name) {
            (0, "UANodeSet") => self.has_root = true,
            (0, other) => return Err(NodeSetElementFault::Root(other.chars().take(64).collect())),
            (1, node) if node.starts_with("UA") => {
                self.node(node.trim_start_matches("UA"), element)?;
            }
            (2, "Model") => self.model(element)?,
            (3, "RequiredModel") => self.required(element)?,
            (2, "Alias") => self.alias = text(element, "Alias")?,
            (3, "Reference") => {
                self.reference = NodeSetFileReference {
                    reference_type: text(element, "ReferenceType")?,
                    is_forward: text(element, "IsForward")? != "false",
                    target: String::new(),
                };
            }
            _ => {}
        }
        self.text.clear();
        self.open.push(name.to_owned());
        Ok(())
    }

    fn text(&mut self, text: &str) {
        self.text.push_str(text);
    }

    fn close(&mut self) -> Result<ControlFlow<()>, NodeSetElementFault> {
        let path: Vec<&str> = self.open.iter().map(String::as_str).collect();
        let text = self.text.trim();
        let mut flow = ControlFlow::Continue(());
        match path.as_slice() {
            [_, "NamespaceUris", "Uri"] => self.document.namespaces.push(text.to_owned()),
            [_, "Aliases", "Alias"] => {
                let alias = std::mem::take(&mut self.alias);
                self.document.aliases.insert(alias, text.to_owned());
            }
            [_, "Models"] if self.extent == ReadingExtent::Models => {
                flow = ControlFlow::Break(());
            }
            [_, node, rest @ ..] if node.starts_with("UA") => {
                if let Some(node) = self.document.nodes.last_mut() {
                    match rest {
                        ["References", "Reference"] => {
                            let mut reference = std::mem::take(&mut self.reference);
                            text.clone_into(&mut reference.target);
                            node.references.push(reference);
                        }
                        ["DisplayName"] if node.display_name.is_empty() => {
                            text.clone_into(&mut node.display_name);
                        }
                        ["Description"] if node.description.is_empty() => {
                            text.clone_into(&mut node.description);
                        }
                        ["Value", "ExtensionObject", "Body", part @ ..] => {
                            value_part(node, part, text);
                        }
                        _ => {}
                    }
                }
            }
            _ => {}
        }
        self.text.clear();
        self.open.pop();
        Ok(flow)
    }
}

/// Reads a part of a structure that is the value of a node, by its path.
fn value_part(node: &mut NodeSetFileNode, path: &[&str], text: &str) {
    match path {
        ["Range", bound] => {
            let range = node.range.get_or_insert_default();
            match *bound {
                "Low" => text.clone_into(&mut range.low),
                "High" => text.clone_into(&mut range.high),
                _ => {}
            }
        }
        ["EUInformation", part @ ..] => {
            let unit = node.unit.get_or_insert_default();
            match part {
                ["NamespaceUri"] => text.clone_into(&mut unit.namespace),
                ["UnitId"] => text.clone_into(&mut unit.id),
                ["DisplayName", "Text"] => text.clone_into(&mut unit.symbol),
                _ => {}
            }
        }
        _ => {}
    }
}

fn text(element: &XmlElement<'_>, name: &str) -> Result<String, XmlAttributeFault> {
    Ok(element.attribute(name)?.unwrap_or_default())
}

fn version(element: &XmlElement<'_>) -> Result<ModelVersion, XmlAttributeFault> {
    Ok(ModelVersion {
        version: text(element, "Version")?,
        publication_date: text(element, "PublicationDate")?,
    })
}
