//! Reads the elements with metadata from the textual notation of SysML v2 (OMG formal/26-03-02,
//! 8.2.2).
//!
//! Only what carries metadata is interpreted: packages, definitions, usages, their types and
//! multiplicities, and metadata usages (`@X {..}`, `metadata X about y {..}`, `#X attribute ..`).
//! Other statements are skipped by their `;` or braces.

mod words;

use std::collections::HashMap;
use std::iter::Peekable;
use std::str::Chars;

use words::{KINDS, PREFIXES, SKIPPED, TEXTUAL};

use super::{Applied, DEEPEST, Element, ElementKind, Finding, MOST_ELEMENTS, Tag, shown};

/// Returns the elements with metadata, and the findings.
///
/// # Errors
/// The fault that makes the rest of the file unreadable.
pub(super) fn elements(text: &str) -> Result<(Vec<Element>, Vec<Finding>), Finding> {
    let mut parser = Parser::default();
    let mut lexer = Lexer {
        rest: text.chars().peekable(),
        line: 1,
    };
    while let Some(token) = lexer.next()? {
        parser.token(token)?;
    }
    parser.end()
}

#[derive(Clone, Debug, PartialEq)]
struct Token {
    what: Lexeme,
    line: usize,
}

#[derive(Clone, Debug, PartialEq)]
enum Lexeme {
    /// A name or keyword; a quoted name is never a keyword.
    Word {
        text: String,
        is_quoted: bool,
    },
    Text(String),
    Number(String),
    Symbol(&'static str),
    /// A comment `/* */`, which is an element of the model.
    Comment,
}

impl Token {
    fn is(&self, symbol: &str) -> bool {
        matches!(self.what, Lexeme::Symbol(own) if own == symbol)
    }

    fn keyword(&self) -> Option<&str> {
        match &self.what {
            Lexeme::Word {
                text,
                is_quoted: false,
            } => Some(text),
            Lexeme::Word { .. }
            | Lexeme::Text(_)
            | Lexeme::Number(_)
            | Lexeme::Symbol(_)
            | Lexeme::Comment => None,
        }
    }

    fn word(&self) -> Option<&str> {
        match &self.what {
            Lexeme::Word { text, .. } => Some(text),
            Lexeme::Text(_) | Lexeme::Number(_) | Lexeme::Symbol(_) | Lexeme::Comment => None,
        }
    }
}

struct Lexer<'t> {
    rest: Peekable<Chars<'t>>,
    line: usize,
}

impl Lexer<'_> {
    fn next(&mut self) -> Result<Option<Token>, Finding> {
        loop {
            let line = self.line;
            let Some(c) = self.take() else {
                return Ok(None);
            };
            let what = match c {
                c if c.is_whitespace() => continue,
                '/' if self.takes('/') => {
                    if self.takes('*') {
                        self.comment(line)?;
                        continue;
                    } else {
                        self.while_true(|c| c != '\n');
                        continue;
                    }
                }
                '/' if self.takes('*') => {
                    self.comment(line)?;
                    Lexeme::Comment
                }
                '"' => Lexeme::Text(self.quoted('"', line)?),
                '\'' => Lexeme::Word {
                    text: self.quoted('\'', line)?,
                    is_quoted: true,
                },
                c if c.is_alphabetic() || c == '_' => {
                    let rest = self.while_true(|c| c.is_alphanumeric() || c == '_');
                    Lexeme::Word {
                        text: format!("{c}{rest}"),
                        is_quoted: false,
                    }
                }
                c if c.is_ascii_digit() => {
                    let mut text = c.to_string();
                    text.push_str(&self.while_true(|c| c.is_ascii_alphanumeric()));
                    Lexeme::Number(text)
                }
                ':' => Lexeme::Symbol(match (self.takes(':'), self.takes('>')) {
                    (true, true) => "::>",
                    (true, false) => "::",
                    (false, true) if self.takes('>') => ":>>",
                    (false, true) => ":>",
                    (false, false) if self.takes('=') => ":=",
                    (false, false) => ":",
                }),
                c => match SYMBOLS.into_iter().find(|symbol| symbol.starts_with(c)) {
                    Some(symbol) => Lexeme::Symbol(symbol),
                    None => {
                        let c = shown(&c.to_string());
                        return Err(Finding::new(line, format!("unexpected `{c}`")));
                    }
                },
            };
            return Ok(Some(Token { what, line }));
        }
    }

    fn take(&mut self) -> Option<char> {
        let c = self.rest.next();
        if c == Some('\n') {
            self.line = self.line.saturating_add(1);
        }
        c
    }

    fn takes(&mut self, wanted: char) -> bool {
        self.rest.next_if_eq(&wanted).is_some()
    }

    fn while_true(&mut self, is_inside: impl Fn(char) -> bool) -> String {
        let mut text = String::new();
        while let Some(c) = self.rest.next_if(|c| is_inside(*c)) {
            text.push(c);
        }
        text
    }

    fn comment(&mut self, line: usize) -> Result<(), Finding> {
        while let Some(c) = self.take() {
            if c == '*' && self.takes('/') {
                return Ok(());
            }
        }
        Err(Finding::new(line, "the comment has no end `*/`"))
    }

    fn quoted(&mut self, quote: char, line: usize) -> Result<String, Finding> {
        let mut text = String::new();
        while let Some(c) = self.take() {
            match c {
                c if c == quote => return Ok(text),
                '\n' => break,
                '\\' => match self.take() {
                    Some('n') => text.push('\n'),
                    Some('t') => text.push('\t'),
                    Some(c) => text.push(c),
                    None => break,
                },
                c => text.push(c),
            }
        }
        Err(Finding::new(line, format!("the text has no end {quote}")))
    }
}

/// Single-character symbols.
const SYMBOLS: [&str; 26] = [
    "{", "}", "[", "]", "(", ")", ";", ",", ".", "=", "<", ">", "#", "@", "*", "+", "-", "/", "~",
    "!", "?", "|", "&", "^", "%", "$",
];

#[derive(Default)]
struct Parser {
    nodes: Vec<SysmlNode>,
    /// The first child of each name of an element.
    children: HashMap<(Option<usize>, String), usize>,
    open: Vec<OpenBody>,
    /// The tokens of the statement read so far.
    statement: Vec<Token>,
    metadata: Vec<Metadata>,
    findings: Vec<Finding>,
}

/// An open brace, with its line.
struct OpenBody {
    what: Body,
    line: usize,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Body {
    Node(usize),
    Metadata(usize),
    Skipped,
}

/// An element of the model.
struct SysmlNode {
    keyword: String,
    is_definition: bool,
    name: String,
    parent: Option<usize>,
    line: usize,
    type_name: Option<String>,
    is_array: bool,
}

/// A metadata usage.
struct Metadata {
    applied: Applied,
    /// The element around it.
    owner: Option<usize>,
    /// The names of the annotated elements; empty for the element around it.
    about: Vec<Vec<String>>,
}

impl Parser {
    fn token(&mut self, token: Token) -> Result<(), Finding> {
        match token.what {
            Lexeme::Symbol(";") => {
                let statement = std::mem::take(&mut self.statement);
                self.begin(&statement)?;
            }
            Lexeme::Symbol("{") => {
                let statement = std::mem::take(&mut self.statement);
                let what = self.begin(&statement)?;
                if self.open.len() >= DEEPEST {
                    return Err(Finding::new(
                        token.line,
                        format!("elements are nested deeper than {DEEPEST}"),
                    ));
                }
                let line = token.line;
                self.open.push(OpenBody { what, line });
            }
            Lexeme::Symbol("}") => {
                // A calculation ends with an expression without `;`.
                let statement = std::mem::take(&mut self.statement);
                if let Some(Body::Metadata(_)) = self.body()
                    && let Some(first) = statement.first()
                {
                    let line = first.line;
                    self.findings.push(Finding::new(
                        line,
                        "a `;` is missing at the end of the value",
                    ));
                }
                if self.open.pop().is_none() {
                    return Err(Finding::new(token.line, "this `}` has no `{`"));
                }
            }
            Lexeme::Comment => {
                let first = self.statement.first().and_then(Token::keyword);
                if first.is_some_and(|first| TEXTUAL.contains(&first)) {
                    self.statement.clear();
                }
            }
            Lexeme::Word { .. } | Lexeme::Text(_) | Lexeme::Number(_) | Lexeme::Symbol(_) => {
                self.statement.push(token);
            }
        }
        if self.statement.len() > LONGEST {
            let line = self.statement.first().map_or(1, |first| first.line);
            return Err(Finding::new(
                line,
                format!("the statement has more than {LONGEST} words; a `;` may be missing"),
            ));
        }
        Ok(())
    }

    fn body(&self) -> Option<Body> {
        self.open.last().map(|open| open.what)
    }

    /// Returns the element of the innermost brace that belongs to an element.
    fn owner(&self) -> Option<usize> {
        self.open.iter().rev().find_map(|open| match open.what {
            Body::Node(at) => Some(at),
            Body::Metadata(_) | Body::Skipped => None,
        })
    }

    /// Interprets a statement up to its `;` or `{`. Returns the meaning of its braces.
    fn begin(&mut self, statement: &[Token]) -> Result<Body, Finding> {
        if self.metadata.len() >= MOST_ELEMENTS || self.findings.len() >= MOST_ELEMENTS {
            let line = statement.first().map_or(1, |first| first.line);
            return Err(Finding::new(
                line,
                format!("more than {MOST_ELEMENTS} metadata usages or findings are not read"),
            ));
        }
        match self.body() {
            Some(Body::Metadata(at)) => {
                self.value(at, statement);
                return Ok(Body::Skipped);
            }
            Some(Body::Skipped) => return Ok(Body::Skipped),
            Some(Body::Node(_)) | None => {}
        }
        let statement = without_prefixes(statement);
        let Some(first) = statement.first() else {
            return Ok(Body::Skipped);
        };
        let second = statement.get(1).and_then(Token::keyword);
        if first.is("@") || (first.keyword() == Some("metadata") && second != Some("def")) {
            let rest = statement.get(1..).unwrap_or_default();
            return Ok(self.metadata(first.line, rest));
        }
        match first.keyword() {
            Some("metadata") => Ok(Body::Skipped),
            Some(word) if SKIPPED.contains(&word) => Ok(Body::Skipped),
            _ => self.node(statement),
        }
    }

    /// Adds a metadata usage: `X`, `name : X`, each with `about` and names.
    fn metadata(&mut self, line: usize, statement: &[Token]) -> Body {
        let about_at = statement
            .iter()
            .position(|token| token.keyword() == Some("about"));
        let (head, about) = statement.split_at(about_at.unwrap_or(statement.len()));
        let after = head
            .iter()
            .position(|token| token.is(":") || token.keyword() == Some("by"));
        let head = after.map_or(head, |at| head.get(at + 1..).unwrap_or_default());
        let Some(stereotype) = qualified(head).and_then(|(mut path, _)| path.pop()) else {
            let what = "the name of the metadata is missing after `@`";
            self.findings.push(Finding::new(line, what));
            return Body::Skipped;
        };
        let about = about.get(1..).unwrap_or_default();
        let names = about.split(|token| token.is(","));
        let about = names.filter_map(|name| Some(qualified(name)?.0)).collect();
        self.metadata.push(Metadata {
            applied: Applied {
                stereotype,
                line,
                tags: Vec::new(),
            },
            owner: self.owner(),
            about,
        });
        Body::Metadata(self.metadata.len().saturating_sub(1))
    }

    /// Adds a value of metadata: `name = VALUE`, also as `:>> name = VALUE`.
    fn value(&mut self, at: usize, statement: &[Token]) {
        let statement = without_prefixes(statement);
        let is_lead = |token: &&Token| {
            token.is(":>>")
                || token.is("@")
                || token.keyword().is_some_and(|word| {
                    ["attribute", "ref", "redefines", "item", "feature"].contains(&word)
                })
        };
        let lead = statement.iter().take_while(is_lead).count();
        let Some((name, rest)) = statement.get(lead..).and_then(<[Token]>::split_first) else {
            return;
        };
        let equals = rest
            .iter()
            .position(|token| token.is("=") || token.is(":="));
        let (Some(word), Some(equals)) = (name.word(), equals) else {
            let what = "a value of metadata is like `topic = \"/conveyor/running\";`";
            self.findings.push(Finding::new(name.line, what));
            return;
        };
        let Some(value) = literal(rest.get(equals + 1..).unwrap_or_default()) else {
            let word = shown(word);
            self.findings.push(Finding::new(
                name.line,
                format!("the value of `{word}` is an expression; write a text, a number, or true or false"),
            ));
            return;
        };
        let tag = Tag {
            name: word.to_owned(),
            value,
            line: name.line,
        };
        if let Some(metadata) = self.metadata.get_mut(at) {
            metadata.applied.tags.push(tag);
        }
    }

    /// Adds an element: `#X part def Name : Type [*] ..`.
    fn node(&mut self, statement: &[Token]) -> Result<Body, Finding> {
        let Some(first) = statement.first() else {
            return Ok(Body::Skipped);
        };
        if self.nodes.len() >= MOST_ELEMENTS {
            return Err(Finding::new(
                first.line,
                format!("more than {MOST_ELEMENTS} elements are not read"),
            ));
        }
        let at = self.nodes.len();
        let parent = self.owner();
        let mut node = SysmlNode {
            keyword: String::new(),
            is_definition: false,
            name: String::new(),
            parent,
            line: first.line,
            type_name: None,
            is_array: false,
        };
        let mut rest = statement;
        while let Some((token, behind)) = rest.split_first() {
            if token.is("#") {
                let Some((mut path, count)) = qualified(behind) else {
                    break;
                };
                self.metadata.push(Metadata {
                    applied: Applied {
                        stereotype: path.pop().unwrap_or_default(),
                        line: token.line,
                        tags: Vec::new(),
                    },
                    owner: Some(at),
                    about: Vec::new(),
                });
                rest = behind.get(count..).unwrap_or_default();
                continue;
            }
            match token.keyword() {
                Some("def") => node.is_definition = true,
                Some(word) if KINDS.contains(&word) => word.clone_into(&mut node.keyword),
                Some(word) if PREFIXES.contains(&word) => {}
                _ => break,
            }
            rest = behind;
        }
        // A short name in angle brackets.
        if rest.first().is_some_and(|token| token.is("<")) {
            let end = rest.iter().position(|token| token.is(">"));
            rest = end.and_then(|end| rest.get(end + 1..)).unwrap_or_default();
        }
        let redefined = |token: &Token| {
            token.is(":>>") || token.is(":>") || token.keyword() == Some("redefines")
        };
        if let Some((token, behind)) = rest.split_first() {
            if redefined(token) {
                // A usage without a name has that of the redefined usage.
                let path = qualified(behind);
                node.name = path
                    .and_then(|(mut path, _)| path.pop())
                    .unwrap_or_default();
            } else if let Some(word) = token.word() {
                word.clone_into(&mut node.name);
                rest = behind;
            }
        }
        (node.type_name, node.is_array) = typing(rest);
        if !node.name.is_empty() {
            let key = (parent, node.name.clone());
            self.children.entry(key).or_insert(at);
        }
        self.nodes.push(node);
        Ok(Body::Node(at))
    }

    fn end(mut self) -> Result<(Vec<Element>, Vec<Finding>), Finding> {
        if let Some(open) = self.open.last() {
            return Err(Finding::new(open.line, "this `{` has no `}`"));
        }
        if let Some(first) = self.statement.first() {
            return Err(Finding::new(
                first.line,
                "the file ends in a statement; a `;` is missing",
            ));
        }
        let mut applied: HashMap<usize, Vec<Applied>> = HashMap::new();
        let mut copied: usize = 0;
        for metadata in std::mem::take(&mut self.metadata) {
            let mut targets: Vec<usize> = Vec::new();
            for path in &metadata.about {
                match self.resolve(metadata.owner, path) {
                    Some(at) => targets.push(at),
                    None => self.findings.push(Finding::new(
                        metadata.applied.line,
                        format!(
                            "`{}` is not declared here; name an element of this file",
                            shown(&path.join("::"))
                        ),
                    )),
                }
            }
            if metadata.about.is_empty() {
                targets.extend(metadata.owner);
            }
            let copy = metadata.applied.size().saturating_mul(targets.len());
            copied = copied.saturating_add(copy);
            if copied > MOST_COPIED {
                return Err(Finding::new(
                    metadata.applied.line,
                    "the values of the metadata are too large for all elements after `about`",
                ));
            }
            for at in targets {
                let all = applied.entry(at).or_default();
                all.push(metadata.applied.clone());
            }
        }
        let mut marked: Vec<(usize, Vec<Applied>)> = applied.into_iter().collect();
        marked.sort_by_key(|(at, _)| *at);
        let elements = marked.into_iter();
        let elements = elements.filter_map(|(at, applied)| self.element(at, applied));
        Ok((elements.collect(), self.findings))
    }

    /// Returns the element of a name, searched from the inside out.
    fn resolve(&self, owner: Option<usize>, path: &[String]) -> Option<usize> {
        let mut scope = owner;
        loop {
            let mut found = scope;
            let is_found = !path.is_empty()
                && path.iter().all(|name| {
                    let child = self.children.get(&(found, name.clone()));
                    found = child.copied();
                    child.is_some()
                });
            if is_found {
                return found;
            }
            scope = self.nodes.get(scope?)?.parent;
        }
    }

    fn element(&self, at: usize, applied: Vec<Applied>) -> Option<Element> {
        let node = self.nodes.get(at)?;
        let mut owners = Vec::new();
        let mut above = node.parent;
        // Each parent precedes its children, so the chain ends.
        while let Some(owner) = above.and_then(|at| self.nodes.get(at)) {
            if !owner.name.is_empty() && owner.keyword != "package" {
                owners.push(owner.name.clone());
            }
            above = owner.parent;
        }
        owners.reverse();
        let kind = match node.keyword.as_str() {
            "package" => ElementKind::Other,
            _ if node.is_definition => ElementKind::Other,
            "action" | "calc" | "perform" => ElementKind::Operation,
            _ => ElementKind::Property,
        };
        Some(Element {
            owners,
            name: node.name.clone(),
            kind,
            type_name: node.type_name.clone(),
            is_array: node.is_array,
            line: node.line,
            applied,
        })
    }
}

/// Returns the statement without visibility.
fn without_prefixes(statement: &[Token]) -> &[Token] {
    let is_prefix = |token: &&Token| {
        let word = token.keyword();
        word.is_some_and(|word| ["public", "private", "protected"].contains(&word))
    };
    let count = statement.iter().take_while(is_prefix).count();
    statement.get(count..).unwrap_or_default()
}

/// Returns the segments of a name such as `A::b` or `a.b` at the start of the tokens, and the
/// number of its tokens.
fn qualified(tokens: &[Token]) -> Option<(Vec<String>, usize)> {
    let mut path = vec![tokens.first()?.word()?.to_owned()];
    let mut count = 1;
    while let [separator, name, ..] = tokens.get(count..)?
        && (separator.is("::") || separator.is("."))
        && let Some(name) = name.word()
    {
        path.push(name.to_owned());
        count += 2;
    }
    Some((path, count))
}

/// Returns the last segment of the name of the type behind the name of an element, and whether the
/// element has several values.
fn typing(rest: &[Token]) -> (Option<String>, bool) {
    let value_at = rest
        .iter()
        .position(|token| token.is("=") || token.is(":="));
    let declared = rest
        .get(..value_at.unwrap_or(rest.len()))
        .unwrap_or_default();
    let is_typing = |token: &Token| token.is(":") || token.keyword() == Some("by");
    let colon = declared.iter().position(is_typing);
    let typed = colon
        .and_then(|at| declared.get(at + 1..))
        .unwrap_or_default();
    // A port has the conjugated type after `~`.
    let typed = match typed.split_first() {
        Some((token, behind)) if token.is("~") => behind,
        _ => typed,
    };
    let type_name = qualified(typed).and_then(|(mut path, _)| path.pop());
    (type_name, is_array(declared))
}

/// Returns true if the multiplicity allows several values.
fn is_array(declared: &[Token]) -> bool {
    let start = declared.iter().position(|token| token.is("["));
    let inside = start
        .and_then(|at| declared.get(at + 1..))
        .unwrap_or_default();
    let end = inside.iter().position(|token| token.is("]"));
    let upper = end.and_then(|end| inside.get(end.checked_sub(1)?));
    match upper.map(|token| &token.what) {
        Some(Lexeme::Number(number)) => !["0", "1"].contains(&number.as_str()),
        Some(_) => true,
        None => false,
    }
}

/// Returns the text of a literal; `None` for an expression.
fn literal(tokens: &[Token]) -> Option<String> {
    match tokens {
        [token] => match &token.what {
            Lexeme::Text(text) | Lexeme::Number(text) => Some(text.clone()),
            Lexeme::Word { text, .. } => Some(text.clone()),
            Lexeme::Symbol(_) | Lexeme::Comment => None,
        },
        [minus, number] if minus.is("-") => match &number.what {
            Lexeme::Number(text) => Some(format!("-{text}")),
            Lexeme::Word { .. } | Lexeme::Text(_) | Lexeme::Symbol(_) | Lexeme::Comment => None,
        },
        _ => None,
    }
}

/// Maximum number of tokens of a statement.
const LONGEST: usize = 10_000;
/// Maximum memory of all metadata, of which each annotated element has a copy, in bytes.
const MOST_COPIED: usize = 1 << 30;
