//! Values of variables (OPC 10000-6, 5.3). A single scalar is a literal or a node; an array or a
//! structure is JSON.

use roxmltree::Node;
use serde_json::{Map, Value};

use super::facts::OntologyValue;
use super::{Reading, children};

impl Reading {
    /// Reads a value; `None` with a finding if it nests too deep.
    pub(super) fn value(&mut self, value: Node<'_, '_>) -> Option<OntologyValue> {
        let kind = value.tag_name().name();
        let text = match kind {
            "LocalizedText" => {
                return Some(OntologyValue::Localized {
                    text: part(value, "Text").to_owned(),
                    locale: part(value, "Locale").trim().to_owned(),
                });
            }
            "NodeId" | "ExpandedNodeId" => {
                let written = part(value, "Identifier").trim();
                let node = self.name(written).map(OntologyValue::Node);
                return Some(node.unwrap_or_else(|| OntologyValue::Text(written.to_owned())));
            }
            "Guid" => part(value, "String"),
            _ => value.text().unwrap_or_default(),
        };
        if let Some(scalar) = OntologyValue::scalar(kind, text) {
            return Some(scalar);
        }
        let json = json(value, 0);
        if json.is_none() {
            self.find(value, format!("the value nests more than {MAX_DEPTH} deep"));
        }
        json.map(OntologyValue::Json)
    }
}

fn part<'a>(value: Node<'a, '_>, name: &'a str) -> &'a str {
    let found = children(value, name).next();
    found.and_then(|part| part.text()).unwrap_or_default()
}

/// Returns an array or structure as JSON; `None` if it nests too deep.
pub(super) fn json(value: Node<'_, '_>, depth: usize) -> Option<Value> {
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
            "Float" | "Double" => plain.parse::<f64>().ok().map(number),
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

/// Returns a number as JSON, which has no NaN and no infinity: they are the lexical forms of XML
/// Schema.
fn number(value: f64) -> Value {
    if value.is_finite() {
        return Value::from(value);
    }
    Value::from(match value {
        f64::INFINITY => "INF",
        f64::NEG_INFINITY => "-INF",
        _ => "NaN",
    })
}

const MAX_DEPTH: usize = 64;
