//! Reads a UML model with stereotypes from XMI, as Papyrus writes it into `.uml` files (XMI 2.5.1).
//!
//! Stereotypes are elements beside the model, such as `<UaBridge:Ros1Topic base_Property="_id"/>`.
//! Their values are attributes or child elements. A value that equals its default is not written.

use std::collections::HashMap;
use std::ops::ControlFlow;

use xml_text::{XmlAttributeFault, XmlElement, XmlVisitor, walk};

use super::{Applied, DEEPEST, Element, ElementKind, Finding, MOST_ELEMENTS, Tag, shown};

/// Returns the elements with stereotypes, and the findings.
///
/// # Errors
/// The fault that makes the rest of the file unreadable.
pub(super) fn elements(xml: &str) -> Result<(Vec<Element>, Vec<Finding>), Finding> {
    if xml_text::has_more_attributes(xml, MOST_ATTRIBUTES) {
        return Err(Finding::new(
            1,
            format!("an element has more than {MOST_ATTRIBUTES} attributes"),
        ));
    }
    let mut document = Document::default();
    let walked = walk(xml, DEEPEST, &mut document);
    walked.map_err(|located| Finding::new(located.line, located.fault.to_string()))?;
    if document.nodes.is_empty() {
        return Err(Finding::new(1, "there is no `uml:Model` in the file"));
    }
    Ok(document.elements())
}

/// The reason why a file of XMI is not read further.
#[derive(Debug, thiserror::Error)]
enum XmiFault {
    #[error(transparent)]
    Attribute(#[from] XmlAttributeFault),
    #[error(
        "this is a <{}>, no model; Papyrus keeps the model in the file that ends in `.uml`",
        shown(element)
    )]
    NoModel { element: String },
    #[error("more than {MOST_ELEMENTS} elements are not read")]
    Elements,
    #[error("more than {MOST_ELEMENTS} stereotypes are not read")]
    Stereotypes,
}

#[derive(Default)]
struct Document {
    path: Vec<OpenElement>,
    text: String,
    nodes: Vec<XmiNode>,
    ids: HashMap<String, usize>,
    applications: Vec<Application>,
}

/// An open XML element.
enum OpenElement {
    /// The element around the model and its stereotypes.
    Xmi,
    Node(usize),
    Application(usize),
    /// A value of a stereotype: the application, the name and the line.
    Tag(usize, String, usize),
    Other,
}

/// An element of the model.
#[derive(Default)]
struct XmiNode {
    /// The name of the XML element.
    tag: String,
    /// The UML class, such as `Property`.
    class: String,
    name: String,
    parent: Option<usize>,
    line: usize,
    /// The id of the type.
    type_id: Option<String>,
    /// The name of a type in another file.
    type_name: Option<String>,
    is_array: bool,
}

#[derive(Default)]
struct Application {
    applied: Applied,
    /// The ids of the element, by its UML classes.
    bases: Vec<String>,
    /// The address of an element in another file.
    elsewhere: Option<String>,
}

impl XmlVisitor for Document {
    type Fault = XmiFault;

    fn open(&mut self, element: &XmlElement<'_>) -> Result<(), XmiFault> {
        let local = element.name().to_owned();
        let line = element.line();
        let is_uml = element.qualified_name().starts_with("uml:");
        self.text.clear();
        let attributes = element.attributes()?;
        let open = match self.path.last() {
            None if local == "XMI" => OpenElement::Xmi,
            None | Some(OpenElement::Xmi) if is_uml => self.node(local, attributes, line)?,
            None => return Err(XmiFault::NoModel { element: local }),
            Some(OpenElement::Xmi) => self.application(local, attributes, line)?,
            Some(OpenElement::Application(at)) => self.tag(*at, local, &attributes, line),
            Some(OpenElement::Node(_) | OpenElement::Other) => {
                self.inside(local, attributes, line)?
            }
            Some(OpenElement::Tag(..)) => OpenElement::Other,
        };
        self.path.push(open);
        Ok(())
    }

    fn text(&mut self, text: &str) {
        self.text.push_str(text);
    }

    fn close(&mut self) -> Result<ControlFlow<()>, XmiFault> {
        let text = self.text.trim().to_owned();
        self.text.clear();
        if let Some(OpenElement::Tag(at, name, line)) = self.path.pop()
            && let Some(application) = self.applications.get_mut(at)
        {
            let value = text;
            application.applied.tags.push(Tag { name, value, line });
        }
        Ok(ControlFlow::Continue(()))
    }
}

impl Document {
    /// Returns the nearest element of the model around the open XML element.
    fn owner(&self) -> Option<usize> {
        self.path.iter().rev().find_map(|open| match open {
            OpenElement::Node(at) => Some(*at),
            OpenElement::Xmi
            | OpenElement::Application(_)
            | OpenElement::Tag(..)
            | OpenElement::Other => None,
        })
    }

    fn inside(
        &mut self,
        local: String,
        attributes: Vec<(String, String)>,
        line: usize,
    ) -> Result<OpenElement, XmiFault> {
        let owner = self.owner();
        let is_direct = matches!(self.path.last(), Some(OpenElement::Node(_)));
        if let Some(owner) = owner
            .and_then(|at| self.nodes.get_mut(at))
            .filter(|_| is_direct)
        {
            match local.as_str() {
                "type" => {
                    let href = value(&attributes, "href");
                    owner.type_name = href.and_then(last_word);
                    if let Some(id) = value(&attributes, "xmi:idref") {
                        owner.type_id = Some(id.to_owned());
                    }
                    return Ok(OpenElement::Other);
                }
                "upperValue" => {
                    let upper = value(&attributes, "value").unwrap_or("0");
                    owner.is_array = !matches!(upper, "0" | "1");
                    return Ok(OpenElement::Other);
                }
                _ => {}
            }
        }
        match value(&attributes, "xmi:id") {
            Some(_) if local != "eAnnotations" => self.node(local, attributes, line),
            Some(_) | None => Ok(OpenElement::Other),
        }
    }

    fn node(
        &mut self,
        tag: String,
        attributes: Vec<(String, String)>,
        line: usize,
    ) -> Result<OpenElement, XmiFault> {
        if self.nodes.len() >= MOST_ELEMENTS {
            return Err(XmiFault::Elements);
        }
        let at = self.nodes.len();
        let mut node = XmiNode {
            class: tag.clone(),
            tag,
            parent: self.owner(),
            line,
            ..XmiNode::default()
        };
        for (key, value) in attributes {
            match key.as_str() {
                "xmi:id" => _ = self.ids.insert(value, at),
                "xmi:type" => {
                    let class = value.rsplit(':').next().unwrap_or_default();
                    node.class = class.to_owned();
                }
                "name" => node.name = value,
                "type" => node.type_id = Some(value),
                _ => {}
            }
        }
        self.nodes.push(node);
        Ok(OpenElement::Node(at))
    }

    fn application(
        &mut self,
        stereotype: String,
        attributes: Vec<(String, String)>,
        line: usize,
    ) -> Result<OpenElement, XmiFault> {
        if self.applications.len() >= MOST_ELEMENTS {
            return Err(XmiFault::Stereotypes);
        }
        let mut application = Application {
            applied: Applied {
                stereotype,
                line,
                tags: Vec::new(),
            },
            ..Application::default()
        };
        for (name, value) in attributes {
            if name.starts_with("base_") {
                application.bases.push(value);
            } else if !name.contains(':') && name != "xmlns" {
                application.applied.tags.push(Tag { name, value, line });
            }
        }
        self.applications.push(application);
        Ok(OpenElement::Application(
            self.applications.len().saturating_sub(1),
        ))
    }

    fn tag(
        &mut self,
        at: usize,
        name: String,
        attributes: &[(String, String)],
        line: usize,
    ) -> OpenElement {
        if !name.starts_with("base_") {
            return match value(attributes, "xsi:nil") {
                Some("true") => OpenElement::Other,
                Some(_) | None => OpenElement::Tag(at, name, line),
            };
        }
        if let Some(application) = self.applications.get_mut(at) {
            let base = value(attributes, "xmi:idref").map(str::to_owned);
            application.bases.extend(base);
            if let Some(href) = value(attributes, "href") {
                application.elsewhere = Some(href.to_owned());
            }
        }
        OpenElement::Other
    }

    /// Returns the elements with stereotypes in the order of the file, and the stereotypes without
    /// an element.
    fn elements(mut self) -> (Vec<Element>, Vec<Finding>) {
        let mut findings = Vec::new();
        let mut applied: HashMap<usize, Vec<Applied>> = HashMap::new();
        for application in std::mem::take(&mut self.applications) {
            let stereotype = application.applied.stereotype.as_str();
            let mut bases = application.bases.iter();
            match bases.find_map(|id| self.ids.get(id)) {
                Some(at) => applied.entry(*at).or_default().push(application.applied),
                // Metadata of other profiles and tools needs no element.
                None if !is_ours(stereotype) => {}
                None => {
                    let line = application.applied.line;
                    let what = match (&application.elsewhere, application.bases.first()) {
                        (Some(href), _) => format!(
                            "the element of {stereotype} is in another file, `{}`; give that file",
                            shown(href)
                        ),
                        (None, Some(id)) => format!(
                            "the element `{}` of {stereotype} is not in the model",
                            shown(id)
                        ),
                        (None, None) => format!("{stereotype} has no element"),
                    };
                    findings.push(Finding::new(line, what));
                }
            }
        }
        let mut marked: Vec<(usize, Vec<Applied>)> = applied.into_iter().collect();
        marked.sort_by_key(|(at, _)| *at);
        let elements = marked.into_iter();
        let elements = elements.filter_map(|(at, applied)| self.element(at, applied));
        (elements.collect(), findings)
    }

    fn element(&self, at: usize, applied: Vec<Applied>) -> Option<Element> {
        let node = self.nodes.get(at)?;
        let mut owners = Vec::new();
        let mut above = node.parent;
        // Each parent precedes its children, so the chain ends.
        while let Some(owner) = above.and_then(|at| self.nodes.get(at)) {
            let is_package = ["Model", "Package", "Profile"].contains(&owner.class.as_str());
            if !owner.name.is_empty() && !is_package {
                owners.push(owner.name.clone());
            }
            above = owner.parent;
        }
        owners.reverse();
        let of_id = node.type_id.as_ref().and_then(|id| self.ids.get(id));
        let of_id = of_id.and_then(|at| self.nodes.get(*at));
        let kind = match node.class.as_str() {
            "Property" | "Port" | "ExtensionEnd" => ElementKind::Property,
            "Operation" | "Reception" | "Activity" => ElementKind::Operation,
            _ if node.tag == "ownedAttribute" => ElementKind::Property,
            _ if node.tag == "ownedOperation" => ElementKind::Operation,
            _ => ElementKind::Other,
        };
        Some(Element {
            owners,
            name: node.name.clone(),
            kind,
            type_name: of_id
                .map(|node| node.name.clone())
                .or_else(|| node.type_name.clone()),
            is_array: node.is_array,
            line: node.line,
            applied,
        })
    }
}

fn value<'a>(attributes: &'a [(String, String)], key: &str) -> Option<&'a str> {
    let found = attributes.iter().find(|(name, _)| name == key);
    found.map(|(_, value)| value.as_str())
}

/// Returns the name of a type in a library: `..UMLPrimitiveTypes.library.uml#Boolean` is
/// `Boolean`.
fn last_word(href: &str) -> Option<String> {
    let (_, fragment) = href.rsplit_once('#')?;
    let word = fragment.rsplit(['_', '.', '/', '-']).next()?;
    (!word.is_empty()).then(|| word.to_owned())
}

fn is_ours(stereotype: &str) -> bool {
    stereotype.starts_with("Ros1") || stereotype.starts_with("Ros2") || stereotype.starts_with("Ua")
}

/// Maximum number of attributes of an XML element.
const MOST_ATTRIBUTES: usize = 1000;
