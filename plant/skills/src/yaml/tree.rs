//! Parses YAML text into a tree of nodes with locations.

use documents::SourceSpan as Place;
use granit_parser::{Event, Parser, ScalarStyle, ScanError, Span};

use super::findings::{Code, Finding};

/// A value of the document.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    /// Its location.
    pub place: Place,
    /// Its content.
    pub kind: Kind,
}

impl Node {
    /// Returns whether two nodes have the same content, regardless of their locations and of the
    /// order of keys.
    #[must_use]
    pub fn has_same_content(&self, other: &Self) -> bool {
        match (&self.kind, &other.kind) {
            (Kind::Null, Kind::Null) => true,
            (Kind::Scalar(one), Kind::Scalar(other)) => one == other,
            (Kind::List(ones), Kind::List(others)) => {
                let mut pairs = ones.iter().zip(others);
                ones.len() == others.len() && pairs.all(|(one, other)| one.has_same_content(other))
            }
            (Kind::Map(ones), Kind::Map(others)) => {
                let has = |(key, value): &(Self, Self)| {
                    others.iter().any(|(other, with)| {
                        key.has_same_content(other) && value.has_same_content(with)
                    })
                };
                ones.len() == others.len() && ones.iter().all(has)
            }
            (Kind::Null | Kind::Scalar(_) | Kind::List(_) | Kind::Map(_), _) => false,
        }
    }

    /// Returns the value of a key; `None` without the key, and for other nodes than maps.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&Self> {
        let Kind::Map(pairs) = &self.kind else {
            return None;
        };
        let found = pairs.iter().find(|(name, _)| name.text() == Some(key));
        found.map(|(_, value)| value)
    }

    /// Returns the text of a scalar.
    #[must_use]
    pub fn text(&self) -> Option<&str> {
        if let Kind::Scalar(text) = &self.kind {
            return Some(text);
        }
        None
    }
}

/// The content of a node.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// An empty value, `~` or `null`.
    Null,
    /// A scalar, as written.
    Scalar(String),
    /// A list.
    List(Vec<Node>),
    /// Keys and values in the order of the text, with repeated keys.
    Map(Vec<(Node, Node)>),
}

impl Kind {
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
pub fn parse(text: &str) -> Result<Node, Finding> {
    if text.len() > MAX_BYTES {
        let message = format!(
            "the document has {} bytes; at most {MAX_BYTES} are read",
            text.len()
        );
        return Err(Finding::error(Code::TooLarge, Place::START, message));
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
    Ok(builder.root.unwrap_or(Node {
        place: Place::START,
        kind: Kind::Null,
    }))
}

#[derive(Default)]
struct Builder {
    open: Vec<Open>,
    root: Option<Node>,
    documents: usize,
    nodes: usize,
}

/// A list or map that is not complete.
struct Open {
    place: Place,
    map: bool,
    children: Vec<Node>,
}

impl Builder {
    fn event(&mut self, event: Event<'_>, place: Place) -> Result<(), Finding> {
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
                    Kind::Null
                } else {
                    Kind::Scalar(text.into_owned())
                };
                self.put(Node { place, kind })
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

    fn begin(&mut self, place: Place, map: bool) -> Result<(), Finding> {
        if self.open.len() >= MAX_DEPTH {
            let message = format!("values nest deeper than {MAX_DEPTH} levels");
            return Err(Finding::error(Code::TooLarge, place, message));
        }
        self.open.push(Open {
            place,
            map,
            children: Vec::new(),
        });
        Ok(())
    }

    fn put(&mut self, node: Node) -> Result<(), Finding> {
        self.nodes += 1;
        if self.nodes > MAX_NODES {
            let message = format!("more than {MAX_NODES} values");
            return Err(Finding::error(Code::TooLarge, node.place, message));
        }
        match self.open.last_mut() {
            Some(open) => open.children.push(node),
            None => self.root = Some(node),
        }
        Ok(())
    }
}

impl Open {
    fn into_node(self) -> Node {
        let Self {
            place,
            map,
            children,
        } = self;
        if !map {
            return Node {
                place,
                kind: Kind::List(children),
            };
        }
        let mut pairs = Vec::with_capacity(children.len() / 2);
        let mut children = children.into_iter();
        while let (Some(key), Some(value)) = (children.next(), children.next()) {
            pairs.push((key, value));
        }
        Node {
            place,
            kind: Kind::Map(pairs),
        }
    }
}

fn not_read(place: Place, what: &str, help: &str) -> Finding {
    Finding::error(Code::Syntax, place, format!("{what} is not read here")).with_help(help)
}

fn syntax(text: &str, error: &ScanError) -> Finding {
    let place = Place::of(text, Span::empty(*error.marker()));
    let line = text.lines().nth(place.line - 1).unwrap_or_default();
    let help = if line.trim_start_matches(' ').starts_with('\t') {
        "YAML is indented with spaces, never with tabs"
    } else {
        "nothing after this place has been checked"
    };
    Finding::error(Code::Syntax, place, error.info()).with_help(help)
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
