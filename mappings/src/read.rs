//! Tree -> values. Every fault is noted, and the rest is read.

use std::borrow::Cow;
use std::collections::HashMap;
use std::rc::Rc;

use schemars::{JsonSchema, Schema, SchemaGenerator};

use crate::code::Code;
pub(crate) use crate::findings::short;
use crate::findings::{MappingFindings, Note};
use crate::tree::{TextSpan, YamlKind, YamlNode};
use documents::nearest;

/// Maximum number of nodes that are read: aliases may lead to one node many times.
const MAX_READ: usize = 4_000_000;

/// Number of keys of a map up to which duplicates are found without a table.
const FEW: usize = 16;

/// A value and its position in the text.
#[derive(Clone, Debug)]
pub(crate) struct Located<T> {
    pub(crate) place: TextSpan,
    /// `None` for a faulty value; the fault has been noted.
    pub(crate) value: Option<T>,
}

/// Value of a key that may be left out.
pub(crate) type OptionalKey<T> = Option<Located<T>>;

/// Returns the value of a key, if it is given and sound.
pub(crate) fn given<T>(field: &OptionalKey<T>) -> Option<(&T, TextSpan)> {
    let field = field.as_ref()?;
    Some((field.value.as_ref()?, field.place))
}

impl<T: JsonSchema> JsonSchema for Located<T> {
    fn inline_schema() -> bool {
        T::inline_schema()
    }

    fn schema_name() -> Cow<'static, str> {
        T::schema_name()
    }

    fn schema_id() -> Cow<'static, str> {
        T::schema_id()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        T::json_schema(generator)
    }
}

/// A value that can be read from a node.
pub(crate) trait FromNode: Sized {
    /// Returns `None` for a faulty node, which is noted.
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self>;
}

pub(crate) struct NodeReader<'f> {
    pub(crate) findings: &'f mut MappingFindings,
    read: usize,
}

impl<'f> NodeReader<'f> {
    pub(crate) const fn new(findings: &'f mut MappingFindings) -> Self {
        Self { findings, read: 0 }
    }

    pub(crate) fn at<T: FromNode>(&mut self, node: &YamlNode<'_>) -> Located<T> {
        self.read += 1;
        let value = if self.read <= MAX_READ {
            T::read(node, self)
        } else {
            if self.read == MAX_READ + 1 {
                let message = format!("aliases lead to more than {MAX_READ} values");
                self.findings.error(Code::TooLarge, node.place, message);
            }
            None
        };
        Located {
            place: node.place,
            value,
        }
    }

    /// Notes that `wanted` (with its article) is expected instead of the node.
    pub(crate) fn wrong(&mut self, node: &YamlNode<'_>, wanted: &str) {
        let message = format!("expected {wanted}, found {}", node.kind.name());
        self.findings.error(Code::WrongValue, node.place, message);
    }

    pub(crate) fn text<'n>(&mut self, node: &'n YamlNode<'n>, wanted: &str) -> Option<&'n str> {
        if let YamlKind::Scalar(text) = &node.kind {
            return Some(text);
        }
        self.wrong(node, wanted);
        None
    }

    /// Returns the pairs of a map with texts as keys, each key once.
    pub(crate) fn pairs<'n>(
        &mut self,
        node: &'n YamlNode<'n>,
        wanted: &str,
    ) -> Option<Vec<KeyPair<'n>>> {
        self.pairs_of(node, || wanted.to_owned())
    }

    /// Returns pairs as [`pairs`](Self::pairs) does; `wanted` is created only for a fault.
    fn pairs_of<'n>(
        &mut self,
        node: &'n YamlNode<'n>,
        wanted: impl FnOnce() -> String,
    ) -> Option<Vec<KeyPair<'n>>> {
        let YamlKind::Map(pairs) = &node.kind else {
            self.wrong(node, &wanted());
            return None;
        };
        let mut found: Vec<KeyPair<'n>> = Vec::with_capacity(pairs.len());
        // A map with few keys is searched faster than a table.
        let mut first: HashMap<&str, TextSpan> = HashMap::new();
        for (key, value) in pairs {
            let YamlKind::Scalar(text) = &key.kind else {
                let message = format!("expected a key, found {}", key.kind.name());
                self.findings.error(Code::WrongValue, key.place, message);
                continue;
            };
            let before = if pairs.len() <= FEW {
                let known = found.iter().find(|pair| pair.key == text);
                known.map(|pair| pair.place)
            } else {
                first.insert(text, key.place)
            };
            if let Some(before) = before {
                let message = format!("the key `{}` is repeated", short(text));
                let line = self.findings.line(before, key.place);
                self.findings
                    .error(Code::DuplicateKey, key.place, message)
                    .label(format!("first at {line}"));
                if pairs.len() > FEW {
                    first.insert(text, before);
                }
                continue;
            }
            found.push(KeyPair {
                key: text,
                place: key.place,
                value,
            });
        }
        Some(found)
    }

    /// Returns the values of a map in the order of `keys`. Unknown keys are noted. A misspelt key
    /// is then read as the key that it resembles, so that no missing key is reported.
    pub(crate) fn keys<'n, const N: usize>(
        &mut self,
        node: &'n YamlNode<'n>,
        keys: [&'static str; N],
    ) -> Option<[Option<&'n YamlNode<'n>>; N]> {
        let mut values = [None; N];
        let wanted = || format!("a map with {}", list(&keys));
        let mut misspelt = Vec::new();
        for KeyPair { key, place, value } in self.pairs_of(node, wanted)? {
            if let Some((_, slot)) = keys
                .iter()
                .zip(&mut values)
                .find(|(known, _)| **known == key)
            {
                *slot = Some(&**value);
                continue;
            }
            let message = format!("unknown key `{}`", short(key));
            let note = self.findings.error(Code::UnknownKey, place, message);
            let near = nearest(key, keys);
            note.help_with(|| match near {
                Some(near) => format!("did you mean `{near}`? The keys here are {}", list(&keys)),
                None => format!("the keys here are {}", list(&keys)),
            });
            misspelt.extend(near.map(|near| (near, &**value)));
        }
        for (near, value) in misspelt {
            let mut slots = keys.iter().zip(&mut values);
            if let Some((_, slot @ None)) = slots.find(|(known, _)| **known == near) {
                *slot = Some(value);
            }
        }
        Some(values)
    }

    /// Reads a list, or its only entry: the node itself if `is_one`.
    pub(crate) fn one_or_list<T: FromNode>(
        &mut self,
        node: &YamlNode<'_>,
        is_one: bool,
        wanted: &str,
    ) -> Option<Vec<Located<T>>> {
        if is_one {
            return Some(vec![self.at(node)]);
        }
        if matches!(node.kind, YamlKind::List(_)) {
            return Vec::read(node, self);
        }
        self.wrong(node, wanted);
        None
    }

    /// Returns the value of a key; a key without a value counts as left out.
    pub(crate) fn field<T: FromNode>(&mut self, node: Option<&YamlNode<'_>>) -> OptionalKey<T> {
        let node = node.filter(|node| !matches!(node.kind, YamlKind::Null))?;
        Some(self.at(node))
    }
}

pub(crate) struct KeyPair<'n> {
    pub(crate) key: &'n str,
    pub(crate) place: TextSpan,
    pub(crate) value: &'n Rc<YamlNode<'n>>,
}

/// Returns `a`, `b`, `c` in backticks.
pub(crate) fn list(names: &[impl AsRef<str>]) -> String {
    let names: Vec<String> = names
        .iter()
        .map(|name| format!("`{}`", name.as_ref()))
        .collect();
    names.join(", ")
}

impl FromNode for String {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        reader.text(node, "a text").map(str::to_owned)
    }
}

impl FromNode for u16 {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let text = reader.text(node, "a number")?;
        let number = text
            .parse()
            .ok()
            .filter(|_| text.bytes().all(|b| b.is_ascii_digit()) && !is_octal(text));
        if number.is_none() {
            let message = format!("expected a number from 0 to 65535, found `{}`", short(text));
            let note = reader.findings.error(Code::WrongValue, node.place, message);
            help_octal(note, text);
        }
        number
    }
}

impl FromNode for f64 {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let text = reader.text(node, "a number")?;
        // `inf` and `nan` are numbers in Rust, and in YAML with a dot before them.
        let number = text
            .parse()
            .ok()
            .filter(|_| text.contains(|c: char| c.is_ascii_digit()) && !is_octal(text));
        if number.is_none() {
            let message = format!("expected a number such as 0.001, found `{}`", short(text));
            let note = reader.findings.error(Code::WrongValue, node.place, message);
            help_octal(note, text);
        }
        number
    }
}

impl FromNode for bool {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match reader.text(node, "true or false")? {
            "true" => Some(true),
            "false" => Some(false),
            other => {
                let message = format!("expected true or false, found `{}`", short(other));
                reader.findings.error(Code::WrongValue, node.place, message);
                None
            }
        }
    }
}

impl<T: FromNode> FromNode for Vec<Located<T>> {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let YamlKind::List(items) = &node.kind else {
            reader.wrong(node, "a list (each entry begins with `- `)");
            return None;
        };
        Some(items.iter().map(|item| reader.at(item)).collect())
    }
}

/// Returns `true` for a number with leading zeros, which YAML 1.1 reads as octal and YAML 1.2 as
/// decimal.
pub(crate) fn is_octal(text: &str) -> bool {
    let digits = text.trim_start_matches(['-', '+']);
    let mut bytes = digits.bytes();
    bytes.next() == Some(b'0') && bytes.next().is_some_and(|b| b.is_ascii_digit())
}

/// Adds a help with the plain spelling of a number with leading zeros.
pub(crate) fn help_octal(note: Note<'_>, text: &str) {
    if is_octal(text) {
        let plain = text.trim_start_matches('0');
        let plain = if plain.is_empty() { "0" } else { plain };
        note.help(format!(
            "leading zeros make a number octal in YAML 1.1: write `{}`",
            short(plain)
        ));
    }
}

/// Returns the name of a field that may be a keyword of Rust too.
pub(crate) const fn plain(name: &'static str) -> &'static str {
    match name.as_bytes() {
        [b'r', b'#', plain @ ..] => match std::str::from_utf8(plain) {
            Ok(plain) => plain,
            Err(_) => name,
        },
        _ => name,
    }
}

/// A map of known keys, each of which may be left out; the names of the fields are the keys.
macro_rules! document {
    ($($(#[$meta:meta])* struct $name:ident { $($(#[$field_meta:meta])* $field:ident: $type:ty,)* })*) => {$(
        #[derive(Clone, Debug, Default, schemars::JsonSchema)]
        $(#[$meta])*
        #[schemars(deny_unknown_fields)]
        pub(crate) struct $name { $($(#[$field_meta])* pub(crate) $field: $crate::read::OptionalKey<$type>,)* }

        impl $crate::read::FromNode for $name {
            fn read(node: &$crate::tree::YamlNode<'_>, reader: &mut $crate::read::NodeReader<'_>) -> Option<Self> {
                const KEYS: [&str; [$(stringify!($field)),*].len()] =
                    [$($crate::read::plain(stringify!($field))),*];
                let [$($field),*] = reader.keys(node, KEYS)?;
                Some(Self { $($field: reader.field($field),)* })
            }
        }
    )*};
}

/// An enumeration of keywords.
macro_rules! choice {
    ($($(#[$meta:meta])* enum $name:ident { $($(#[$variant_meta:meta])* $variant:ident = $word:literal,)* })*) => {$(
        #[derive(Clone, Copy, Debug, PartialEq, Eq, schemars::JsonSchema)]
        $(#[$meta])*
        pub(crate) enum $name { $($(#[$variant_meta])* #[schemars(rename = $word)] $variant,)* }

        impl $crate::read::FromNode for $name {
            fn read(node: &$crate::tree::YamlNode<'_>, reader: &mut $crate::read::NodeReader<'_>) -> Option<Self> {
                let words = [$($word),*];
                let wanted = format!("one of {}", $crate::read::list(&words));
                let text = reader.text(node, &wanted)?;
                $(if text == $word { return Some(Self::$variant); })*
                let message = format!("expected {wanted}, found `{}`", $crate::read::short(text));
                let note = reader.findings.error($crate::Code::WrongValue, node.place, message);
                if let Some(near) = documents::nearest(text, words) {
                    note.help(format!("did you mean `{near}`?"));
                }
                None
            }
        }
    )*};
}

/// The schema of a type, written where the type is used.
macro_rules! inline_schema {
    ($name:ident, $generator:ident => $schema:expr) => {
        impl schemars::JsonSchema for $name {
            fn inline_schema() -> bool {
                true
            }

            fn schema_name() -> std::borrow::Cow<'static, str> {
                stringify!($name).into()
            }

            fn json_schema($generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
                $schema
            }
        }
    };
}

pub(crate) use {choice, document, inline_schema};
