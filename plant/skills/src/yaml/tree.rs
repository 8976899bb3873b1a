//! Parses YAML text into a tree of nodes with locations.

use documents::SourceSpan as Place;
use granit_parser::{Event, Parser, ScalarStyle, ScanError, Span};

use super::findings::{YamlFinding, YamlFindingCode};

/// A value of the document.
#[derive(Debug, Clone, PartialEq)]
pub struct DocumentNode {
    /// Its location.
    pub place: Place,
    /// Its content.
    pub kind: DocumentKind,
}

impl DocumentNode {
    /// Returns whether two nodes have the same content, regardless of their locations and of the
    /// order of keys.
    #[must_use]
    pub fn has_same_content(&self, other: &Self) -> bool {
        match (&self.kind, &other.kind) {
            (DocumentKind::Null, DocumentKind::Null) => true,
            (DocumentKind::Scalar(one), DocumentKind::Scalar(other)) => one == other,
            (DocumentKind::List(ones), DocumentKind::List(others)) => {
                let mut pairs = ones.iter().zip(others);
                ones.len() == others.len() && pairs.all(|(one, other)| one.has_same_content(other))
            }
            (DocumentKind::Map(ones), DocumentKind::Map(others)) => {
                let has = |(key, value): &(Self, Self)| {
                    others.iter().any(|(other, with)| {
                        key.has_same_content(other) && value.has_same_content(with)
                    })
                };
                ones.len() == others.len() && ones.iter().all(has)
            }
            (
                DocumentKind::Null
                | DocumentKind::Scalar(_)
                | DocumentKind::List(_)
                | DocumentKind::Map(_),
                _,
            ) => false,
        }
    }

    /// Returns the value of a key; `None` without the key, and for other nodes than maps.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&Self> {
        let DocumentKind::Map(pairs) = &self.kind else {
            return None;
        };
        let found = pairs.iter().find(|(name, _)| name.text() == Some(key));
        found.map(|(_, value)| value)
    }

    /// Returns the text of a scalar.
    #[must_use]
    pub fn text(&self) -> Option<&str> {
        if let DocumentKind::Scalar(text) = &self.kind {
            return Some(text);
        }
        None
    }
}

/// The content of a node.
#[derive(Debug, Clone, PartialEq)]
pub enum DocumentKind {
    /// An empty value, `~` or `null`.
    Null,
    /// A scalar, as written.
    Scalar(String),
    /// A list.
    List(Vec<DocumentNode>),
    /// Keys and values in the order of the text, with repeated keys.
    Map(Vec<(DocumentNode, DocumentNode)>),
}

impl DocumentKind {
    /// Returns the name with its article.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Null => "nothing",
            Self::Scalar(_) => "a single value",
            Self::List(_) => "a list",
            Self::Map(_) => "a map",
        }
    }
}

/// Parses a text as a single document.
///
/// # Errors
/// The first location that cannot be parsed; the text after it is not checked.
pub fn parse(text: &str) -> Result<DocumentNode, YamlFinding> {
    if text.len() > MAX_BYTES {
        let message = format!(
            "the document has {} bytes; at most {MAX_BYTES} are read",
            text.len()
        );
        return Err(YamlFinding::error(
            YamlFindingCode::TooLarge,
            Place::START,
            message,
        ));
    }
    let options = granit_parser::options! {
        emit_comments: false,
        emit_unresolved_aliases: true,
        flow_nesting_limit: MAX_DEPTH,
        block_nesting_limit: MAX_DEPTH
    };
    let mut builder = Builder::default();
    for event in Parser::new_from_str_with_options(text, options) {
        let (event, marks) = event.map_err(|error| syntax(text, &error))?;
        let place = Place::of(text, marks);
        if event.tag().is_some() {
            return Err(not_read(
                place,
                "a tag",
                "leave it out; the key says what its value is",
            ));
        }
        builder.event(event, place)?;
    }
    Ok(builder.root.unwrap_or(DocumentNode {
        place: Place::START,
        kind: DocumentKind::Null,
    }))
}

#[derive(Default)]
struct Builder {
    open: Vec<Open>,
    root: Option<DocumentNode>,
    documents: usize,
    nodes: usize,
}

/// A list or map that is not complete.
struct Open {
    place: Place,
    map: bool,
    children: Vec<DocumentNode>,
}

impl Builder {
    fn event(&mut self, event: Event<'_>, place: Place) -> Result<(), YamlFinding> {
        match event {
            Event::DocumentStart(..) => {
                self.documents += 1;
                if self.documents > 1 {
                    return Err(not_read(
                        place,
                        "a second document",
                        "one file is one document: remove the `---`",
                    ));
                }
                Ok(())
            }
            Event::Scalar(text, style, ..) => {
                let null = style == ScalarStyle::Plain
                    && matches!(&*text, "" | "~" | "null" | "Null" | "NULL");
                let kind = if null {
                    DocumentKind::Null
                } else {
                    DocumentKind::Scalar(text.into_owned())
                };
                self.put(DocumentNode { place, kind })
            }
            Event::SequenceStart(..) => self.begin(place, false),
            Event::MappingStart(..) => self.begin(place, true),
            Event::SequenceEnd | Event::MappingEnd => match self.open.pop() {
                Some(open) => self.put(open.into_node()),
                None => Ok(()),
            },
            Event::StreamStart | Event::StreamEnd | Event::DocumentEnd => Ok(()),
            Event::Alias(_) | Event::UnresolvedAlias(_) | Event::Anchor(..) => Err(not_read(
                place,
                "an alias",
                "a text that begins with * or & stands in quotes",
            )),
            // The enumeration is non-exhaustive: an unknown node would be missing from the tree.
            other => Err(not_read(
                place,
                &format!("{other:?}"),
                "write it as a plain value",
            )),
        }
    }

    fn begin(&mut self, place: Place, map: bool) -> Result<(), YamlFinding> {
        if self.open.len() >= MAX_DEPTH {
            let message = format!("values nest deeper than {MAX_DEPTH} levels");
            return Err(YamlFinding::error(
                YamlFindingCode::TooLarge,
                place,
                message,
            ));
        }
        self.open.push(Open {
            place,
            map,
            children: Vec::new(),
        });
        Ok(())
    }

    fn put(&mut self, node: DocumentNode) -> Result<(), YamlFinding> {
        self.nodes += 1;
        if self.nodes > MAX_NODES {
            let message = format!("more than {MAX_NODES} values");
            return Err(YamlFinding::error(
                YamlFindingCode::TooLarge,
                node.place,
                message,
            ));
        }
        match self.open.last_mut() {
            Some(open) => open.children.push(node),
            None => self.root = Some(node),
        }
        Ok(())
    }
}

impl Open {
    fn into_node(self) -> DocumentNode {
        let Self {
            place,
            map,
            children,
        } = self;
        if !map {
            return DocumentNode {
                place,
                kind: DocumentKind::List(children),
            };
        }
        let mut pairs = Vec::with_capacity(children.len() / 2);
        let mut children = children.into_iter();
        while let (Some(key), Some(value)) = (children.next(), children.next()) {
            pairs.push((key, value));
        }
        DocumentNode {
            place,
            kind: DocumentKind::Map(pairs),
        }
    }
}

fn not_read(place: Place, what: &str, help: &str) -> YamlFinding {
    YamlFinding::error(
        YamlFindingCode::Syntax,
        place,
        format!("{what} is not read here"),
    )
    .with_help(help)
}

fn syntax(text: &str, error: &ScanError) -> YamlFinding {
    let place = Place::of(text, Span::empty(*error.marker()));
    let line = text.lines().nth(place.line - 1).unwrap_or_default();
    let help = if line.trim_start_matches(' ').starts_with('\t') {
        "YAML is indented with spaces, never with tabs"
    } else {
        "nothing after this place has been checked"
    };
    YamlFinding::error(YamlFindingCode::Syntax, place, error.info()).with_help(help)
}

/// Maximum size of a text, in bytes.
const MAX_BYTES: usize = 1 << 20;
/// Maximum number of values of a text.
const MAX_NODES: usize = 20_000;
/// Maximum nesting depth.
const MAX_DEPTH: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_that_nest_too_deep_are_refused() {
        for deep in [
            format!("x: {}", "[".repeat(100_000)),
            format!("x: {}1{}", "{a: ".repeat(20_000), "}".repeat(20_000)),
            (0..1_000).map(|at| " ".repeat(at) + "a:\n").collect(),
            "- ".repeat(10_000),
        ] {
            assert!(parse(&deep).is_err());
        }
        let fits = format!("{}{}", "[".repeat(MAX_DEPTH), "]".repeat(MAX_DEPTH));
        assert!(parse(&fits).is_ok());
    }
}
