//! Constants of requests, and other leaves of nested maps, by their paths.

use messages::Literal;

use crate::read::{FromNode, NodeReader, inline_schema};
use crate::tree::{TextSpan, YamlKind, YamlNode};

/// The leaves of nested maps.
pub(super) struct LeafForm<T> {
    /// The expected map and the expected leaf, in words.
    pub(super) map: &'static str,
    pub(super) leaf: &'static str,
    /// Makes a leaf of a constant.
    pub(super) constant: fn(Literal) -> T,
    /// Makes a leaf of a map that is one.
    pub(super) of_map: fn(&YamlNode<'_>) -> Option<T>,
}

impl<T> LeafForm<T> {
    /// Returns the path, the position and the value of each leaf. Returns `None` for faulty leaves,
    /// which are noted.
    pub(super) fn read(
        &self,
        node: &YamlNode<'_>,
        reader: &mut NodeReader<'_>,
    ) -> Option<Vec<(String, TextSpan, T)>> {
        let mut found = Vec::new();
        self.add(node, "", reader, &mut found)?;
        Some(found)
    }

    /// Adds the leaves below a path. Maps nest no deeper than documents do.
    fn add(
        &self,
        node: &YamlNode<'_>,
        prefix: &str,
        reader: &mut NodeReader<'_>,
        found: &mut Vec<(String, TextSpan, T)>,
    ) -> Option<()> {
        let mut sound = Some(());
        for pair in reader.pairs(node, self.map)? {
            let path = format!("{prefix}{}", pair.key);
            let leaf = match &pair.value.kind {
                YamlKind::Map(_) => match (self.of_map)(pair.value) {
                    Some(leaf) => Some(leaf),
                    None => {
                        let inner = self.add(pair.value, &format!("{path}."), reader, found);
                        sound = sound.and(inner);
                        continue;
                    }
                },
                YamlKind::Scalar(text) => {
                    Some((self.constant)(Literal::One(text.clone().into_owned())))
                }
                YamlKind::List(items) => {
                    let texts = items
                        .iter()
                        .map(|item| reader.text(item, "a single value").map(str::to_owned));
                    let texts: Option<Vec<String>> = texts.collect();
                    texts.map(|texts| (self.constant)(Literal::List(texts)))
                }
                YamlKind::Null => {
                    reader.wrong(pair.value, self.leaf);
                    None
                }
            };
            match leaf {
                Some(leaf) => found.push((path, pair.place, leaf)),
                None => sound = None,
            }
        }
        sound
    }
}

/// Constants of a request: path of the field, its position, and the value.
#[derive(Clone, Debug)]
pub(crate) struct Request(pub(crate) Vec<(String, TextSpan, Literal)>);

impl FromNode for Request {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let form = LeafForm {
            map: "a map of field and value",
            leaf: "a value, a list or a map",
            constant: |literal| literal,
            of_map: |_| None,
        };
        form.read(node, reader).map(Self)
    }
}

inline_schema!(Request, _generator => schemars::json_schema!({ "type": "object" }));

/// Returns whether a node is this text.
pub(super) fn is_scalar(node: &YamlNode<'_>, wanted: &str) -> bool {
    matches!(&node.kind, YamlKind::Scalar(text) if text == wanted)
}
