//! NodeIds and QualifiedNames in the forms of OPC 10000-6, 5.4 and Annex H, converted to those of
//! `json-values`.
//!
//! The programs have no table of namespaces. A namespace or server that has only a URI is therefore
//! kept as the standard asks of such a decoder: the whole text becomes a String identifier, or the
//! name of a QualifiedName, in namespace 0 (5.4.2.10, 5.4.2.11, 5.4.2.14).

use json_values::node_ids::OwnedNodeId;
use serde_json::{Map, Value, json};
use uadp::{NodeId, NodeIdValue};

/// Returns a NodeId, or with `expanded` an ExpandedNodeId. A value of another shape is returned
/// unchanged.
pub(super) fn node_id(json: &Value, expanded: bool) -> Value {
    let text = match json.as_object() {
        Some(whole) => from_object(whole),
        None => json.as_str().map(str::to_owned),
    };
    let converted = text.map(|text| from_text(&text, expanded));
    converted.map_or_else(|| json.clone(), Value::from)
}

fn from_text(text: &str, expanded: bool) -> String {
    if let Some(behind) = text.strip_prefix(STANDARD)
        && OwnedNodeId::parse(behind).is_some()
    {
        return behind.to_owned();
    }
    let is_read = OwnedNodeId::parse(text).is_some_and(|id| expanded || id.node_id().is_some());
    let has_uri = ["nsu=", "svr=", "svu="]
        .iter()
        .any(|start| text.starts_with(start));
    if has_uri && !is_read {
        format!("s={text}")
    } else {
        text.to_owned()
    }
}

/// Returns the text of a NodeId of version 1.04, which is an object.
fn from_object(whole: &Map<String, Value>) -> Option<String> {
    let id = whole.get("Id")?;
    let kind = whole.get("IdType").map_or(Some(0), Value::as_u64)?;
    let letter = match kind {
        0 => 'i',
        1 => 's',
        2 => 'g',
        3 => 'b',
        _ => return None,
    };
    let id = match (kind, id.as_str()) {
        (0, None) => id.as_u64()?.to_string(),
        (_, text) => text?.to_owned(),
    };
    let namespace = prefix(whole.get("Namespace"), "ns", "nsu")?;
    let server = prefix(whole.get("ServerUri"), "svr", "svu")?;
    Some(format!("{server}{namespace}{letter}={id}"))
}

/// Returns the part of a text before the identifier, from an index or a URI.
fn prefix(value: Option<&Value>, index: &str, uri: &str) -> Option<String> {
    Some(match value {
        None | Some(Value::Null) => String::new(),
        Some(Value::String(text)) => format!("{uri}={};", escaped(text)),
        Some(other) => format!("{index}={};", other.as_u64()?),
    })
}

/// Returns a QualifiedName. A value of another shape is returned unchanged.
pub(super) fn qualified_name(json: &Value) -> Value {
    if let Some(text) = json.as_str() {
        return match text.strip_prefix(STANDARD) {
            Some(behind) => json!({ "Name": behind }),
            None if text.starts_with("nsu=") => json!({ "Name": text }),
            None => json.clone(),
        };
    }
    let Some((whole, namespace)) = json
        .as_object()
        .and_then(|whole| Some((whole, whole.get("Uri")?)))
    else {
        return json.clone();
    };
    if let Some(uri) = namespace.as_str() {
        let name = whole.get("Name").and_then(Value::as_str);
        let text = format!("nsu={};{}", escaped(uri), name.unwrap_or_default());
        return qualified_name(&text.into());
    }
    let mut indexed = whole.clone();
    indexed.insert("NamespaceIndex".to_owned(), namespace.clone());
    indexed.remove("Uri");
    indexed.into()
}

/// Returns the number of a DataType of namespace 0, in one of the forms of a NodeId.
pub(super) fn standard_type(json: &Value) -> Option<u32> {
    let text = node_id(json, false);
    standard_number(OwnedNodeId::parse(text.as_str()?)?.node_id()?)
}

/// Returns the number of a numeric NodeId of namespace 0.
pub(super) const fn standard_number(node_id: NodeId<'_>) -> Option<u32> {
    match node_id {
        NodeId {
            namespace: 0,
            identifier: NodeIdValue::Numeric(number),
        } => Some(number),
        _ => None,
    }
}

fn escaped(uri: &str) -> String {
    uri.replace('%', "%25").replace(';', "%3B")
}

/// The namespace of OPC UA, which has the index 0 everywhere.
const STANDARD: &str = "nsu=http://opcfoundation.org/UA/;";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn node_ids_of_both_versions_are_read() {
        for (form, plain, expanded) in [
            (json!("i=2258"), "i=2258", "i=2258"),
            (json!({"Id": 2258}), "i=2258", "i=2258"),
            (json!("ns=9;i=3"), "ns=9;i=3", "ns=9;i=3"),
            (json!({"Id": 3, "Namespace": 9}), "ns=9;i=3", "ns=9;i=3"),
            (
                json!({"Id": "x", "IdType": 1, "Namespace": 1}),
                "ns=1;s=x",
                "ns=1;s=x",
            ),
            (json!({"Id": "AQL/", "IdType": 3}), "b=AQL/", "b=AQL/"),
            (
                json!("nsu=http://opcfoundation.org/UA/;i=85"),
                "i=85",
                "i=85",
            ),
            // The table of namespaces is unknown: the whole text is kept.
            (
                json!("nsu=urn:judge;s=x"),
                "s=nsu=urn:judge;s=x",
                "nsu=urn:judge;s=x",
            ),
            (
                json!({"Id": 3, "Namespace": "urn:a;b%c"}),
                "s=nsu=urn:a%3Bb%25c;i=3",
                "nsu=urn:a%3Bb%25c;i=3",
            ),
            // A `%` that is not escaped cannot be read as a URI.
            (
                json!("nsu=urn:b%c;i=3"),
                "s=nsu=urn:b%c;i=3",
                "s=nsu=urn:b%c;i=3",
            ),
            (
                json!("svu=urn:other;i=7"),
                "s=svu=urn:other;i=7",
                "s=svu=urn:other;i=7",
            ),
            (
                json!({"Id": 7, "Namespace": 1, "ServerUri": 3}),
                "s=svr=3;ns=1;i=7",
                "svr=3;ns=1;i=7",
            ),
        ] {
            assert_eq!(node_id(&form, false), plain, "{form}");
            assert_eq!(node_id(&form, true), expanded, "{form}");
            let read = OwnedNodeId::parse(plain).unwrap();
            assert!(read.node_id().is_some(), "{form}");
            assert!(OwnedNodeId::parse(expanded).is_some(), "{form}");
        }
        for form in [
            json!(3),
            json!({"IdType": 1, "Id": 3}),
            json!({"IdType": 4, "Id": 3}),
        ] {
            assert_eq!(node_id(&form, true), form);
        }
    }

    #[test]
    fn qualified_names_of_both_versions_are_read() {
        for (form, wanted) in [
            (json!("3:n"), json!("3:n")),
            (
                json!("nsu=http://opcfoundation.org/UA/;3:n"),
                json!({"Name": "3:n"}),
            ),
            (json!("nsu=urn:judge;n"), json!({"Name": "nsu=urn:judge;n"})),
            (json!({"Name": "n"}), json!({"Name": "n"})),
            (
                json!({"Name": "n", "Uri": 2}),
                json!({"Name": "n", "NamespaceIndex": 2}),
            ),
            (
                json!({"Name": "n", "Uri": "urn:a;b"}),
                json!({"Name": "nsu=urn:a%3Bb;n"}),
            ),
        ] {
            assert_eq!(qualified_name(&form), wanted, "{form}");
        }
    }
}
