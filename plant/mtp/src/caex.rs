//! CAEX (IEC 62424): the tree of elements in the file, without their meaning.

use std::ops::ControlFlow;

use thiserror::Error;
use xml_text::{XmlAttributeFault, XmlElement, XmlVisitor, walk};

/// Error of reading a manifest.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ManifestError {
    /// The file exceeds the limit.
    #[error("the file has {length} bytes, more than the {most} that are read")]
    TooLarge {
        /// Size of the file.
        length: usize,
        /// The limit.
        most: usize,
    },
    /// The file is not XML, or incomplete.
    #[error("line {line}: {what}")]
    Xml {
        /// Line, from 1.
        line: usize,
        /// Description of the error.
        what: String,
    },
    /// The encoding of the text is not supported, or the text does not match it.
    #[error(transparent)]
    Encoding(#[from] xml_text::EncodingError),
    /// The file is a ZIP container without a readable manifest.
    #[error("the container cannot be used: {0}")]
    Container(String),
    /// The file is XML of another format.
    #[error(
        "there is no element with the role MTPSUCLib/ModuleTypePackage: this is no manifest of an MTP"
    )]
    NoModule,
}

/// An InternalElement, an ExternalInterface or an InstanceHierarchy.
#[derive(Debug, Default)]
pub(crate) struct CaexElement {
    pub(crate) name: String,
    pub(crate) id: String,
    /// RefBaseSystemUnitPath, or RefBaseClassPath of an interface.
    pub(crate) path: String,
    /// The line of its start, from 1.
    pub(crate) line: usize,
    pub(crate) is_interface: bool,
    pub(crate) attributes: Vec<Attribute>,
    pub(crate) children: Vec<Self>,
    /// The InternalLinks of the element.
    pub(crate) links: Vec<CaexLink>,
}

/// An InternalLink, which joins two interfaces.
#[derive(Debug, Default)]
pub(crate) struct CaexLink {
    /// RefPartnerSideA and RefPartnerSideB: the ID of an interface, or that of its element with the
    /// name of the interface behind a colon (CAEX 2.15).
    pub(crate) sides: [String; 2],
    /// The line of its start, from 1.
    pub(crate) line: usize,
}

/// An Attribute of an element. Nested attributes, which are translations, are omitted.
#[derive(Debug, Default)]
pub(crate) struct Attribute {
    pub(crate) name: String,
    pub(crate) data_type: String,
    pub(crate) unit: String,
    pub(crate) value: String,
    pub(crate) id: String,
    /// Whether its value is the ID of an element, by its type.
    pub(crate) is_link: bool,
}

impl CaexElement {
    /// Reads a file.
    pub(crate) fn read(file: &str) -> Result<Self, ManifestError> {
        if file.len() > MAX_FILE {
            return Err(ManifestError::TooLarge {
                length: file.len(),
                most: MAX_FILE,
            });
        }
        let mut building = Building::default();
        let walked = walk(file, MAX_DEPTH, &mut building);
        walked.map_err(|located| ManifestError::Xml {
            line: located.line,
            what: located.fault.to_string(),
        })?;
        building.root.ok_or_else(|| ManifestError::Xml {
            line: file.matches('\n').count() + 1,
            what: "there is no CAEX element in the file".to_owned(),
        })
    }

    /// Returns the element and all elements below it, parents before children.
    pub(crate) fn all(&self) -> impl Iterator<Item = &Self> {
        let mut waiting = vec![self];
        std::iter::from_fn(move || {
            let next = waiting.pop()?;
            waiting.extend(next.children.iter().rev());
            Some(next)
        })
    }

    /// Returns the last part of its path, such as `Procedure` of
    /// `MTPServiceSUCLib/Service/Procedure`.
    pub(crate) fn kind(&self) -> &str {
        self.path.rsplit('/').next().unwrap_or_default()
    }

    /// Returns the value of the first existing attribute with one of these names.
    pub(crate) fn value(&self, names: &[&str]) -> Option<&str> {
        names
            .iter()
            .find_map(|name| {
                self.attributes
                    .iter()
                    .find(|attribute| attribute.name == *name)
            })
            .map(|attribute| attribute.value.trim())
            .filter(|value| !value.is_empty())
    }
}

/// The open elements while the file is read.
#[derive(Debug, Default)]
struct Building {
    open: Vec<CaexPart>,
    /// The number of open libraries. Their elements are templates and no part of the module.
    libraries: usize,
    elements: usize,
    root: Option<CaexElement>,
}

#[derive(Debug)]
enum CaexPart {
    Element(CaexElement),
    Attribute(Attribute),
    Value,
    Library,
    Other,
}

impl CaexPart {
    fn element(&mut self) -> Option<&mut CaexElement> {
        match self {
            Self::Element(element) => Some(element),
            Self::Attribute(_) | Self::Value | Self::Library | Self::Other => None,
        }
    }
}

/// Reason for which an element cannot be read.
#[derive(Debug, Error)]
enum ElementFault {
    #[error("there are more than {0} elements")]
    Number(usize),
    #[error("its {name} has more than {LONGEST} bytes")]
    Long { name: &'static str },
    #[error(transparent)]
    Attribute(#[from] XmlAttributeFault),
}

impl XmlVisitor for Building {
    type Fault = ElementFault;

    fn open(&mut self, element: &XmlElement<'_>) -> Result<(), ElementFault> {
        self.elements += 1;
        if self.elements > MAX_ELEMENTS {
            return Err(ElementFault::Number(MAX_ELEMENTS));
        }
        let text = |name: &'static str| -> Result<String, ElementFault> {
            let value = element.attribute(name)?.unwrap_or_default();
            match value.len() > LONGEST {
                true => Err(ElementFault::Long { name }),
                false => Ok(value),
            }
        };
        let tag = element.name();
        let part = match tag {
            "InterfaceClassLib" | "RoleClassLib" | "SystemUnitClassLib" | "AttributeTypeLib" => {
                self.libraries += 1;
                CaexPart::Library
            }
            _ if self.libraries > 0 => CaexPart::Other,
            "InternalLink" => {
                let link = CaexLink {
                    sides: [text("RefPartnerSideA")?, text("RefPartnerSideB")?],
                    line: element.line(),
                };
                let parent = self.open.iter_mut().rev().find_map(CaexPart::element);
                if let Some(parent) = parent {
                    parent.links.push(link);
                }
                CaexPart::Other
            }
            "CAEXFile" | "InstanceHierarchy" | "InternalElement" | "ExternalInterface" => {
                let mut path = text("RefBaseSystemUnitPath")?;
                if path.is_empty() {
                    path = text("RefBaseClassPath")?;
                }
                CaexPart::Element(CaexElement {
                    name: text("Name")?,
                    id: text("ID")?,
                    path,
                    line: element.line(),
                    is_interface: tag == "ExternalInterface",
                    ..CaexElement::default()
                })
            }
            "Attribute" if matches!(self.open.last(), Some(CaexPart::Element(_))) => {
                let data_type = text("AttributeDataType")?;
                let link_type = text("RefAttributeType")?;
                CaexPart::Attribute(Attribute {
                    name: text("Name")?,
                    unit: text("Unit")?,
                    value: String::new(),
                    id: text("ID")?,
                    is_link: data_type.ends_with(":IDREF") || link_type.ends_with(ID_LINK),
                    data_type,
                })
            }
            "Value" if matches!(self.open.last(), Some(CaexPart::Attribute(_))) => CaexPart::Value,
            _ => CaexPart::Other,
        };
        self.open.push(part);
        Ok(())
    }

    fn text(&mut self, text: &str) {
        if let [.., CaexPart::Attribute(attribute), CaexPart::Value] = &mut *self.open {
            attribute.value.push_str(text);
        }
    }

    fn close(&mut self) -> Result<ControlFlow<()>, ElementFault> {
        if let Some(part) = self.open.pop() {
            if matches!(part, CaexPart::Library) {
                self.libraries -= 1;
            }
            self.add(part);
        }
        Ok(ControlFlow::Continue(()))
    }
}

impl Building {
    /// Adds a complete part to the element around it.
    fn add(&mut self, part: CaexPart) {
        let parent = self.open.iter_mut().rev().find_map(CaexPart::element);
        match (part, parent) {
            (CaexPart::Element(element), Some(parent)) => parent.children.push(element),
            (CaexPart::Element(element), None) => self.root = Some(element),
            (CaexPart::Attribute(attribute), Some(parent)) => parent.attributes.push(attribute),
            (CaexPart::Attribute(_), None)
            | (CaexPart::Value | CaexPart::Library | CaexPart::Other, _) => {}
        }
    }
}

/// The type of attributes of CAEX 3.0 that have the ID of an element as their value.
const ID_LINK: &str = "/IDLinkAttributeType";
/// The largest of the available manifests has 0.8 MB.
pub(crate) const MAX_FILE: usize = 64 << 20;
const MAX_DEPTH: usize = 64;
const MAX_ELEMENTS: usize = 1 << 20;
/// Limit of the bytes of a name, an ID or a path, which findings and statements repeat for the
/// elements below.
const LONGEST: usize = 4096;
