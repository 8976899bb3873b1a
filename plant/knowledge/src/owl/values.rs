//! Values of variables (OPC 10000-6, 5.3). A single scalar is a literal or a node; an array or a
//! structure is JSON.

use oxigraph::model::{NamedNode, Term};
use roxmltree::Node;
use serde_json::{Map, Value};

use super::{Reading, children, typed};
use crate::vocabulary as v;

impl Reading {
    pub(super) fn value(&mut self, subject: &NamedNode, value: Node<'_, '_>) {
        let kind = value.tag_name().name();
        let text = value.text().unwrap_or_default().trim();
        let datatype = match kind {
            "Boolean" => "boolean",
            "SByte" | "Byte" | "Int16" | "UInt16" | "Int32" | "UInt32" | "Int64" | "UInt64" => {
                "integer"
            }
            "Float" | "Double" => "double",
            "String" => {
                self.text(subject, v::VALUE, value.text().unwrap_or_default());
                return;
            }
            "DateTime" => "dateTime",
            "ByteString" => "base64Binary",
            "LocalizedText" => {
                let locale = part(value, "Locale");
                self.localized(subject, v::VALUE, (part(value, "Text"), locale.trim()));
                return;
            }
            "NodeId" | "ExpandedNodeId" => {
                let written = part(value, "Identifier").trim();
                let name = self.name(written);
                let node = name.and_then(|name| NamedNode::new(name.iri()).ok());
                match node {
                    Some(node) => self.say(subject, v::VALUE, Term::from(node)),
                    None => self.text(subject, v::VALUE, written),
                }
                return;
            }
            "Guid" => {
                self.text(subject, v::VALUE, part(value, "String").trim());
                return;
            }
            _ => {
                match json(value, 0) {
                    Some(json) => self.text(subject, v::VALUE_JSON, &json.to_string()),
                    None => self.find(value, format!("the value nests more than {MAX_DEPTH} deep")),
                }
                return;
            }
        };
        self.say(subject, v::VALUE, typed(text, datatype));
    }
}

fn part<'a>(value: Node<'a, '_>, name: &'a str) -> &'a str {
    let found = children(value, name).next();
    found.and_then(|part| part.text()).unwrap_or_default()
}

/// Returns an array or structure as JSON; `None` if it nests too deep.
fn json(value: Node<'_, '_>, depth: usize) -> Option<Value> {
    if depth > MAX_DEPTH {
        return None;
    }
    let kind = value.tag_name().name();
    let elements = || value.children().filter(Node::is_element);
    if kind.starts_with("ListOf") {
        let all: Option<Vec<Value>> = elements().map(|one| json(one, depth + 1)).collect();
        return all.map(Value::Array);
    }
    if kind == "ExtensionObject" {
        let body = children(value, "Body").flat_map(|body| body.children());
        let body = body.into_iter().find(Node::is_element);
        return match body {
            Some(body) => json(body, depth + 1),
            None => Some(Value::Null),
        };
    }
    if elements().next().is_none() {
        let text = value.text().unwrap_or_default();
        let plain = text.trim();
        let number = match kind {
            "Boolean" => plain.parse().ok().map(Value::Bool),
            "SByte" | "Byte" | "Int16" | "UInt16" | "Int32" | "UInt32" | "Int64" => {
                plain.parse::<i64>().ok().map(Value::from)
            }
            "UInt64" => plain.parse::<u64>().ok().map(Value::from),
            "Float" | "Double" => plain.parse::<f64>().ok().map(Value::from),
            _ => None,
        };
        return Some(number.unwrap_or_else(|| Value::from(text)));
    }
    let mut members: Map<String, Value> = Map::new();
    for member in elements() {
        let inner = json(member, depth + 1)?;
        let name = member.tag_name().name().to_owned();
        // A member that is repeated is an array.
        match members.get_mut(&name) {
            None => drop(members.insert(name, inner)),
            Some(Value::Array(all)) => all.push(inner),
            Some(one) => *one = Value::Array(vec![one.take(), inner]),
        }
    }
    Some(Value::Object(members))
}

const MAX_DEPTH: usize = 64;
