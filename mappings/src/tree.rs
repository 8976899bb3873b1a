//! YAML text -> a tree of nodes with their positions. The meaning of the nodes is not checked here.
//!
//! Anchors and aliases are read: an alias shares the node that it names and is never copied, so a
//! document of nested aliases needs no more memory than its text. The pairs of a merge key (`<<`)
//! are shared likewise, and counted. `${NAME}` in a scalar is the value of an environment variable.
//! Tags are refused.

use std::borrow::Cow;
use std::cell::Cell;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::rc::Rc;

use documents::SourceSpan;
use granit_parser::{Event, Parser, ScalarStyle, ScanError, Span as Marks};

use crate::code::Code;
use crate::{secret, variables};

/// Largest text, in bytes.
pub(crate) const MAX_BYTES: usize = 32 << 20;
/// Maximum number of bytes of the values of environment variables, summed over every reference.
pub(crate) const MAX_EXPANDED: usize = 4 << 20;
/// Maximum number of nodes of a text, including the nodes from merge keys.
const MAX_NODES: usize = 2_500_000;
/// Deepest nesting, including aliases.
const MAX_DEPTH: usize = 24;
/// Number of bytes of a key from a merge key that count as one more node.
const LONG_KEY: usize = 64;

/// Position in the text, within one line; lines and characters are counted from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct TextSpan {
    /// Number of the file, in reading order; 0 is the document itself.
    pub(crate) file: u16,
    pub(crate) line: usize,
    pub(crate) column: usize,
    pub(crate) len: usize,
}

impl TextSpan {
    /// Beginning of the text.
    pub(crate) const START: Self = Self {
        file: 0,
        line: 1,
        column: 1,
        len: 1,
    };
}

/// Node of the tree. Scalars without variables are borrowed from the text.
#[derive(Debug)]
pub(crate) struct YamlNode<'t> {
    pub(crate) place: TextSpan,
    pub(crate) kind: YamlKind<'t>,
    depth: usize,
}

/// Keys and values of a map.
type Pairs<'t> = Vec<(Rc<YamlNode<'t>>, Rc<YamlNode<'t>>)>;

#[derive(Debug)]
pub(crate) enum YamlKind<'t> {
    /// No value, `~` or `null`.
    Null,
    Scalar(Cow<'t, str>),
    List(Vec<Rc<YamlNode<'t>>>),
    /// Pairs in the order of the text, repeated keys included.
    Map(Pairs<'t>),
}

impl YamlKind<'_> {
    /// Returns the name with its article.
    pub(crate) const fn name(&self) -> &'static str {
        match self {
            Self::Null => "nothing",
            Self::Scalar(_) => "a single value",
            Self::List(_) => "a list",
            Self::Map(_) => "a map",
        }
    }
}

/// Reason that a text makes no tree.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct YamlFault {
    pub(crate) code: Code,
    pub(crate) place: TextSpan,
    pub(crate) message: String,
    pub(crate) help: Option<&'static str>,
}

/// Tree of a text.
pub(crate) struct YamlTree<'t> {
    /// Root; null if the text contains only comments.
    pub(crate) root: Rc<YamlNode<'t>>,
    /// Faults of references to variables; their texts stay as written.
    pub(crate) faults: Vec<YamlFault>,
    /// Values of variables, and the references in the text.
    pub(crate) values: BTreeMap<String, String>,
    /// Number of bytes of the values of variables, summed over every reference.
    pub(crate) expanded: usize,
    /// Positions of values with a password that the text contains in clear.
    pub(crate) secrets: Vec<TextSpan>,
}

/// Reads the text of a file; all positions have the number `file`. `variable` looks up the
/// environment.
pub(crate) fn parse<'t>(
    text: &'t str,
    file: u16,
    variable: &dyn Fn(&str) -> Option<String>,
) -> Result<YamlTree<'t>, YamlFault> {
    read(text, variable, file).map_err(|fault| YamlFault {
        place: TextSpan {
            file,
            ..fault.place
        },
        ..fault
    })
}

fn read<'t>(
    text: &'t str,
    variable: &dyn Fn(&str) -> Option<String>,
    file: u16,
) -> Result<YamlTree<'t>, YamlFault> {
    if text.len() > MAX_BYTES {
        let message = format!(
            "the document has {} bytes; at most {MAX_BYTES} are read",
            text.len()
        );
        return Err(too_large(TextSpan::START, message));
    }
    let options = granit_parser::options! {
        emit_comments: false,
        emit_unresolved_aliases: true,
        flow_nesting_limit: MAX_DEPTH,
        block_nesting_limit: MAX_DEPTH
    };
    let mut builder = Builder {
        open: Vec::new(),
        anchors: HashMap::new(),
        root: None,
        documents: 0,
        nodes: 0,
        faults: Vec::new(),
        values: BTreeMap::new(),
        expanded: 0,
        secrets: Vec::new(),
        variable,
    };
    for event in Parser::new_from_str_with_options(text, options) {
        let (event, marks) = event.map_err(|error| syntax(text, &error))?;
        if let Some(tag) = event.tag() {
            let place = place(text, marks.tag_span().unwrap_or(marks));
            let message = format!("the tag `{}` is not supported", tag.original());
            return Err(fault(
                place,
                message,
                Some("remove the tag; the key determines the type of its value"),
            ));
        }
        let place = TextSpan {
            file,
            ..place(text, marks)
        };
        builder.event(event, place)?;
    }
    let root = builder.root.unwrap_or_else(|| {
        Rc::new(YamlNode {
            place: TextSpan {
                file,
                ..TextSpan::START
            },
            kind: YamlKind::Null,
            depth: 0,
        })
    });
    Ok(YamlTree {
        root,
        faults: builder.faults,
        values: builder.values,
        expanded: builder.expanded,
        secrets: builder.secrets,
    })
}

struct Builder<'v, 't> {
    open: Vec<Open<'t>>,
    anchors: HashMap<usize, Rc<YamlNode<'t>>>,
    root: Option<Rc<YamlNode<'t>>>,
    documents: usize,
    nodes: usize,
    faults: Vec<YamlFault>,
    values: BTreeMap<String, String>,
    expanded: usize,
    secrets: Vec<TextSpan>,
    variable: &'v dyn Fn(&str) -> Option<String>,
}

/// A list or map that has not been read to its end yet.
struct Open<'t> {
    anchor: usize,
    place: TextSpan,
    map: bool,
    children: Vec<Rc<YamlNode<'t>>>,
}

impl<'t> Builder<'_, 't> {
    fn event(&mut self, event: Event<'t>, place: TextSpan) -> Result<(), YamlFault> {
        match event {
            Event::DocumentStart(..) => {
                self.documents += 1;
                if self.documents > 1 {
                    let help = Some("a file contains one document: remove the `---`");
                    return Err(fault(
                        place,
                        "a second document begins here".to_owned(),
                        help,
                    ));
                }
                Ok(())
            }
            Event::Scalar(text, style, anchor, _) => {
                if secret::is_written(&text) {
                    self.secrets.push(place);
                }
                let text = if self.is_key() {
                    self.key(text, place)
                } else {
                    self.look_for_bare_variable(&text, style, place);
                    self.expand(text, place)?
                };
                let null = style == ScalarStyle::Plain
                    && matches!(&*text, "" | "~" | "null" | "Null" | "NULL");
                let kind = if null {
                    YamlKind::Null
                } else {
                    YamlKind::Scalar(text)
                };
                self.close(anchor, place, kind, 0)
            }
            Event::SequenceStart(_, anchor, _) => {
                self.open.push(Open {
                    anchor,
                    place,
                    map: false,
                    children: Vec::new(),
                });
                Ok(())
            }
            Event::MappingStart(_, anchor, _) => {
                self.open.push(Open {
                    anchor,
                    place,
                    map: true,
                    children: Vec::new(),
                });
                Ok(())
            }
            Event::SequenceEnd | Event::MappingEnd => match self.open.pop() {
                Some(open) => self.end(open),
                None => Ok(()),
            },
            Event::Alias(id) => match self.anchors.get(&id) {
                Some(node) => self.place(Rc::clone(node), place),
                None => Err(fault(
                    place,
                    "the alias lies within the node it names".to_owned(),
                    None,
                )),
            },
            Event::UnresolvedAlias(name) => {
                let message = format!("no `&{name}` before this alias");
                Err(fault(
                    place,
                    message,
                    Some("put a text that begins with * into quotes: \"*\""),
                ))
            }
            Event::StreamStart | Event::StreamEnd | Event::DocumentEnd | Event::Anchor(..) => {
                Ok(())
            }
            // The enumeration is open: a node of an unknown kind would be missing from the tree.
            other => Err(fault(place, format!("{other:?} is not supported"), None)),
        }
    }

    fn end(&mut self, open: Open<'t>) -> Result<(), YamlFault> {
        let depth = open
            .children
            .iter()
            .map(|child| child.depth + 1)
            .max()
            .unwrap_or(1);
        let kind = if open.map {
            let mut pairs = Vec::with_capacity(open.children.len() / 2);
            let mut children = open.children.into_iter();
            while let (Some(key), Some(value)) = (children.next(), children.next()) {
                pairs.push((key, value));
            }
            YamlKind::Map(self.merge(pairs)?)
        } else {
            YamlKind::List(open.children)
        };
        self.close(open.anchor, open.place, kind, depth)
    }

    /// Returns `true` if the next node is a key.
    fn is_key(&self) -> bool {
        let open = self.open.last();
        open.is_some_and(|open| open.map && open.children.len().is_multiple_of(2))
    }

    /// Returns a key as it is written; notes a variable in it.
    fn key(&mut self, text: Cow<'t, str>, place: TextSpan) -> Cow<'t, str> {
        if text.contains("${") {
            self.faults.push(YamlFault {
                code: Code::EnvironmentVariable,
                place,
                message: "a key contains an environment variable".to_owned(),
                help: Some("use environment variables in values only; write the key without one"),
            });
        }
        text
    }

    /// Notes an unquoted value that is a variable in shell syntax, such as `$NAME` or `$(NAME)`.
    fn look_for_bare_variable(&mut self, text: &str, style: ScalarStyle, place: TextSpan) {
        let Some(behind) = text
            .strip_prefix('$')
            .filter(|_| style == ScalarStyle::Plain)
        else {
            return;
        };
        let inside = behind
            .strip_prefix('(')
            .and_then(|name| name.strip_suffix(')'));
        let name = inside.unwrap_or(behind);
        if variables::is_name(name) {
            self.faults.push(YamlFault {
                code: Code::EnvironmentVariable,
                place,
                message: format!("`{text}` is read as a text here, not as an environment variable"),
                help: Some("write a variable as ${NAME}; put the text itself into quotes"),
            });
        }
    }

    /// Returns a scalar with the values of its variables.
    fn expand(&mut self, text: Cow<'t, str>, place: TextSpan) -> Result<Cow<'t, str>, YamlFault> {
        // Most scalars contain no variable, and a search by bytes is faster.
        if !text.as_bytes().contains(&b'$') || !text.contains("${") {
            return Ok(text);
        }
        let taken = Cell::new(0_usize);
        let variable = |name: &str| {
            let value = (self.variable)(name)?;
            taken.set(taken.get().saturating_add(value.len()));
            Some(value)
        };
        let expanded = variables::expand(&text, &variable);
        self.expanded = self.expanded.saturating_add(taken.get());
        if self.expanded > MAX_EXPANDED {
            return Err(too_expanded(place));
        }
        Ok(match expanded {
            Ok((expanded, values)) => {
                for (value, written) in values {
                    self.values.entry(value).or_insert(written);
                }
                Cow::Owned(expanded)
            }
            Err((message, help)) => {
                self.faults.push(YamlFault {
                    code: Code::EnvironmentVariable,
                    place,
                    message,
                    help: Some(help),
                });
                text
            }
        })
    }

    /// Returns the pairs of a map with the pairs of its merge keys. If several maps have a key, the
    /// map itself takes precedence, then the first merged map.
    fn merge(&mut self, pairs: Pairs<'t>) -> Result<Pairs<'t>, YamlFault> {
        let is_merge = |(key, _): &(Rc<YamlNode<'_>>, Rc<YamlNode<'_>>)| matches!(&key.kind, YamlKind::Scalar(text) if text == "<<");
        if !pairs.iter().any(is_merge) {
            return Ok(pairs);
        }
        let (merges, mut own): (Pairs<'t>, Pairs<'t>) = pairs.into_iter().partition(is_merge);
        let mut known: HashSet<String> = own.iter().filter_map(|(key, _)| name(key)).collect();
        for (merge, value) in &merges {
            let maps = match &value.kind {
                YamlKind::List(maps) => maps.as_slice(),
                YamlKind::Map(_) | YamlKind::Scalar(_) | YamlKind::Null => {
                    std::slice::from_ref(value)
                }
            };
            for map in maps {
                self.count(1, merge.place)?;
                let YamlKind::Map(brought) = &map.kind else {
                    self.faults.push(YamlFault {
                        code: Code::MergeKey,
                        place: map.place,
                        message: format!("`<<` takes the keys of a map, found {}", map.kind.name()),
                        help: Some(
                            "<<: *name, or <<: [*one, *other], of maps with &name and so on",
                        ),
                    });
                    continue;
                };
                for (key, value) in brought {
                    let YamlKind::Scalar(text) = &key.kind else {
                        self.count(1, merge.place)?;
                        continue;
                    };
                    // Keys that exist already are counted too, because searching for them takes the
                    // time.
                    self.count(1 + text.len() / LONG_KEY, merge.place)?;
                    if !known.contains(&**text) {
                        known.insert(text.clone().into_owned());
                        own.push((Rc::clone(key), Rc::clone(value)));
                    }
                }
            }
        }
        Ok(own)
    }

    /// Counts more nodes, up to the maximum.
    fn count(&mut self, nodes: usize, place: TextSpan) -> Result<(), YamlFault> {
        self.nodes = self.nodes.saturating_add(nodes);
        if self.nodes > MAX_NODES {
            return Err(too_large(place, format!("more than {MAX_NODES} values")));
        }
        Ok(())
    }

    fn close(
        &mut self,
        anchor: usize,
        place: TextSpan,
        kind: YamlKind<'t>,
        depth: usize,
    ) -> Result<(), YamlFault> {
        let node = Rc::new(YamlNode { place, kind, depth });
        if anchor != 0 {
            self.anchors.insert(anchor, Rc::clone(&node));
        }
        self.place(node, place)
    }

    /// Adds a finished node to its list or map, or makes it the root.
    fn place(&mut self, node: Rc<YamlNode<'t>>, place: TextSpan) -> Result<(), YamlFault> {
        self.count(1, place)?;
        if self.open.len() + node.depth > MAX_DEPTH {
            let message = format!("values nest deeper than {MAX_DEPTH} levels");
            return Err(too_large(place, message));
        }
        match self.open.last_mut() {
            Some(open) => open.children.push(node),
            None => self.root = Some(node),
        }
        Ok(())
    }
}

/// Returns the fault of values of variables that are too long together.
pub(crate) fn too_expanded(place: TextSpan) -> YamlFault {
    let message =
        format!("the values of its environment variables have more than {MAX_EXPANDED} bytes");
    too_large(place, message)
}

fn too_large(place: TextSpan, message: String) -> YamlFault {
    YamlFault {
        code: Code::TooLarge,
        place,
        message,
        help: None,
    }
}

fn name(key: &YamlNode<'_>) -> Option<String> {
    match &key.kind {
        YamlKind::Scalar(text) => Some(text.clone().into_owned()),
        YamlKind::Null | YamlKind::List(_) | YamlKind::Map(_) => None,
    }
}

fn fault(place: TextSpan, message: String, help: Option<&'static str>) -> YamlFault {
    YamlFault {
        code: Code::Syntax,
        place,
        message,
        help,
    }
}

fn syntax(text: &str, error: &ScanError) -> YamlFault {
    let place = place(text, Marks::empty(*error.marker()));
    let before = place.line.saturating_sub(LINES_BEFORE);
    let lines: Vec<(usize, &str)> = (1..)
        .zip(text.lines())
        .skip(before)
        .take(place.line - before + 1)
        .collect();
    let indented = |line: &str| {
        let indent = line.len() - line.trim_start_matches([' ', '\t']).len();
        line.get(..indent)?.find('\t')
    };
    let tab = lines
        .iter()
        .rev()
        .find_map(|(number, line)| Some((*number, indented(line)?)));
    if let Some((line, column)) = tab {
        let help = Some("YAML is indented with spaces, never with tabs");
        if line == place.line {
            return fault(place, error.info(), help);
        }
        let at = TextSpan {
            line,
            column: column + 1,
            len: 1,
            ..place
        };
        return fault(at, "a tab indents this line".to_owned(), help);
    }
    let is_variable = lines
        .iter()
        .any(|(number, line)| *number == place.line && line.contains("${"));
    let help = if is_variable {
        "put a text with ${NAME} between braces or brackets into quotes: \"${NAME}\""
    } else {
        "the document after this position was not checked"
    };
    fault(place, error.info(), Some(help))
}

/// Number of lines before a syntax error that are searched for its cause.
const LINES_BEFORE: usize = 3;

/// Returns the position of the first line of a marked range.
fn place(text: &str, marks: Marks) -> TextSpan {
    let SourceSpan { line, column, len } = SourceSpan::of(text, marks);
    TextSpan {
        file: 0,
        line,
        column,
        len,
    }
}

#[cfg(test)]
mod tests;
