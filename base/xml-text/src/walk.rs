//! Reads the elements of a document one after the other.
//!
//! Documents are not trusted: a document type is refused, so no entity is ever expanded, and the
//! depth of elements is bounded. The visitor bounds their number.

use std::convert::Infallible;
use std::ops::ControlFlow;

use quick_xml::XmlVersion;
use quick_xml::escape::resolve_predefined_entity;
use quick_xml::events::{BytesStart, Event};
use quick_xml::reader::Reader;

/// Receives the elements of a document, see [`walk`].
pub trait XmlVisitor {
    /// The reason for which the visitor refuses an element.
    type Fault;

    /// Handles the start of an element.
    ///
    /// # Errors
    /// The visitor refuses the element.
    fn open(&mut self, element: &XmlElement<'_>) -> Result<(), Self::Fault>;

    /// Handles text of the element that is open. An element may have several texts.
    fn text(&mut self, text: &str);

    /// Handles the end of the element that was opened last. `Break` ends the reading.
    ///
    /// # Errors
    /// The visitor refuses the element.
    fn close(&mut self) -> Result<ControlFlow<()>, Self::Fault>;
}

/// The start of an element.
#[derive(Debug)]
pub struct XmlElement<'a> {
    start: &'a BytesStart<'a>,
    line: usize,
}

/// An attribute is malformed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("in <{element}>: {reason}")]
pub struct XmlAttributeFault {
    /// The local name of the element.
    pub element: String,
    /// The reason.
    pub reason: String,
}

/// The reason for which a document is not read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum XmlFault<F = Infallible> {
    /// The document is malformed.
    #[error("this is not XML: {0}")]
    Malformed(String),
    /// An entity is not predefined.
    #[error("XML has no entity &{0};")]
    Entity(String),
    /// The document has a document type, which may define entities.
    #[error("document types are not read; remove the <!DOCTYPE ..>")]
    DocumentType,
    /// Elements are nested too deeply.
    #[error("elements are nested deeper than {0}")]
    TooDeep(usize),
    /// The end of the document is missing.
    #[error("the file ends in the middle")]
    Cut,
    /// The visitor refused an element.
    #[error("{0}")]
    Refused(F),
}

/// A fault of a document, with its line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LocatedXmlFault<F = Infallible> {
    /// The line, from 1.
    pub line: usize,
    /// The fault.
    pub fault: XmlFault<F>,
}

impl XmlElement<'_> {
    /// Returns the name without its prefix.
    #[must_use]
    pub fn name(&self) -> &str {
        self.start.local_name().into_inner()
    }

    /// Returns the name with its prefix, such as `uml:Model`.
    #[must_use]
    pub fn qualified_name(&self) -> &str {
        self.start.name().into_inner()
    }

    /// Returns the line of its start, from 1.
    #[must_use]
    pub const fn line(&self) -> usize {
        self.line
    }

    /// Returns the value of an attribute, if the element has it.
    ///
    /// # Errors
    /// An attribute is malformed.
    pub fn attribute(&self, name: &str) -> Result<Option<String>, XmlAttributeFault> {
        let fault = |reason| self.fault(reason);
        let found = self.start.try_get_attribute(name);
        let Some(attribute) = found.map_err(|error| fault(error.to_string()))? else {
            return Ok(None);
        };
        match attribute.normalized_value(XmlVersion::Implicit1_0) {
            Ok(value) => Ok(Some(value.into_owned())),
            Err(error) => Err(fault(error.to_string())),
        }
    }

    /// Returns the names, with their prefixes, and the values of all attributes. The time grows
    /// with the square of their number, see [`has_more_attributes`](crate::has_more_attributes).
    ///
    /// # Errors
    /// An attribute is malformed.
    pub fn attributes(&self) -> Result<Vec<(String, String)>, XmlAttributeFault> {
        let mut all = Vec::new();
        for attribute in self.start.attributes() {
            let attribute = attribute.map_err(|error| self.fault(error.to_string()))?;
            let value = attribute.normalized_value(XmlVersion::Implicit1_0);
            let value = value.map_err(|error| self.fault(error.to_string()))?;
            all.push((attribute.key.into_inner().to_owned(), value.into_owned()));
        }
        Ok(all)
    }

    fn fault(&self, reason: String) -> XmlAttributeFault {
        XmlAttributeFault {
            element: self.name().to_owned(),
            reason,
        }
    }
}

/// Reads a document, and calls the visitor for each element and text. Elements may nest `deepest`
/// deep. A document without elements is no fault.
///
/// # Errors
/// The first fault of the document, or of the visitor.
pub fn walk<V: XmlVisitor>(
    document: &str,
    deepest: usize,
    visitor: &mut V,
) -> Result<(), LocatedXmlFault<V::Fault>> {
    let document = document.trim_start_matches('\u{feff}');
    let mut reader = Reader::from_str(document);
    reader.config_mut().expand_empty_elements = true;
    let mut lines = AscendingLines::new(document);
    let mut depth = 0_usize;
    loop {
        let start = reader.buffer_position();
        let event = reader.read_event();
        let located = |fault: XmlFault<V::Fault>| LocatedXmlFault {
            line: AscendingLines::new(document).at(reader.buffer_position()),
            fault,
        };
        match event.map_err(|error| located(XmlFault::Malformed(error.to_string())))? {
            Event::Start(element) => {
                if depth >= deepest {
                    return Err(located(XmlFault::TooDeep(deepest)));
                }
                depth += 1;
                let element = XmlElement {
                    start: &element,
                    line: lines.at(start),
                };
                let opened = visitor.open(&element);
                opened.map_err(|fault| located(XmlFault::Refused(fault)))?;
            }
            Event::End(_) => {
                depth = depth.saturating_sub(1);
                let closed = visitor.close();
                let closed = closed.map_err(|fault| located(XmlFault::Refused(fault)))?;
                if closed.is_break() {
                    return Ok(());
                }
            }
            Event::Text(text) => visitor.text(&text.xml10_content()),
            Event::CData(text) => visitor.text(&text.xml10_content()),
            Event::GeneralRef(reference) => {
                let character = reference.resolve_char_ref().ok().flatten();
                let name = reference.xml10_content();
                match (character, resolve_predefined_entity(&name)) {
                    (Some(character), _) => visitor.text(character.encode_utf8(&mut [0; 4])),
                    (None, Some(text)) => visitor.text(text),
                    (None, None) => return Err(located(XmlFault::Entity(name.into_owned()))),
                }
            }
            Event::DocType(_) => return Err(located(XmlFault::DocumentType)),
            Event::Eof if depth == 0 => return Ok(()),
            Event::Eof => return Err(located(XmlFault::Cut)),
            // An empty element is reported as its start and its end.
            Event::Empty(_) | Event::Comment(_) | Event::Decl(_) | Event::PI(_) => {}
        }
    }
}

/// Counts the lines of ascending offsets, each byte once.
struct AscendingLines<'d> {
    rest: &'d [u8],
    offset: u64,
    line: usize,
}

impl<'d> AscendingLines<'d> {
    const fn new(document: &'d str) -> Self {
        Self {
            rest: document.as_bytes(),
            offset: 0,
            line: 1,
        }
    }

    /// Returns the line of a byte offset, from 1.
    fn at(&mut self, offset: u64) -> usize {
        let passed = usize::try_from(offset.saturating_sub(self.offset)).unwrap_or(usize::MAX);
        let passed = self.rest.split_at_checked(passed);
        let (before, rest) = passed.unwrap_or((self.rest, &[]));
        self.line += before.iter().filter(|byte| **byte == b'\n').count();
        self.rest = rest;
        self.offset = offset;
        self.line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Records the calls as text, and refuses elements with the name `no`.
    #[derive(Default)]
    struct Recorder(String);

    impl XmlVisitor for Recorder {
        type Fault = String;

        fn open(&mut self, element: &XmlElement<'_>) -> Result<(), String> {
            if element.name() == "no" {
                return Err("no".to_owned());
            }
            let name = element
                .attribute("name")
                .map_err(|fault| fault.to_string())?;
            let name = name.unwrap_or_default();
            self.0 += &format!("<{}{name}@{}>", element.name(), element.line());
            Ok(())
        }

        fn text(&mut self, text: &str) {
            self.0 += text.trim();
        }

        fn close(&mut self) -> Result<ControlFlow<()>, String> {
            self.0 += "</>";
            Ok(match self.0.ends_with("<end@1></>") {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            })
        }
    }

    fn walked(document: &str) -> Result<String, LocatedXmlFault<String>> {
        let mut recorder = Recorder::default();
        walk(document, 4, &mut recorder).map(|()| recorder.0)
    }

    #[test]
    fn elements_texts_and_predefined_entities_are_read_in_order_with_their_lines() {
        let document = "\u{feff}<?xml version='1.0'?>\n<a:b name='&lt;'>1&amp;2<!-- c -->\n\
                        <c/><![CDATA[<d>]]>&#x33;</a:b>";
        assert_eq!(walked(document).unwrap(), "<b<@2>1&2<c@3></><d>3</>");
        assert_eq!(walked("").unwrap(), "");
        let early = "<a><end></end>";
        assert_eq!(
            walked(early).unwrap(),
            "<a@1><end@1></>",
            "its rest is not read"
        );
    }

    #[test]
    fn faults_have_the_line_and_the_reason() {
        for (document, line, expected) in [
            ("<a>\n<b>", 2, XmlFault::Cut),
            ("<a>\n&b;</a>", 2, XmlFault::Entity("b".to_owned())),
            (
                "<!DOCTYPE a [<!ENTITY b 'c'>]><a/>",
                1,
                XmlFault::DocumentType,
            ),
            ("<a><a><a>\n<a><a>", 2, XmlFault::TooDeep(4)),
            ("<a>\n\n<no/></a>", 3, XmlFault::Refused("no".to_owned())),
        ] {
            let fault = expected;
            assert_eq!(
                walked(document),
                Err(LocatedXmlFault { line, fault }),
                "{document}"
            );
        }
        let fault = walked("<a>\n</b>").unwrap_err();
        assert!(matches!(fault.fault, XmlFault::Malformed(_)), "{fault:?}");
        let fault = walked("<a name='1' x>").unwrap_err();
        assert_eq!(fault.line, 1);
    }
}
