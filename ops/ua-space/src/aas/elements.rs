//! Elements of submodels (IDTA-01001).

use std::collections::BTreeSet;

use serde_json::{Value, json};

/// The short names of elements with one parent, which are distinct.
#[derive(Debug, Default)]
pub(super) struct ShortNames(BTreeSet<String>);

impl ShortNames {
    /// Returns a short name for an element: letters, digits and underscores.
    pub(super) fn of(&mut self, name: &str) -> String {
        let plain: String = name
            .chars()
            .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
            .take(LONGEST)
            .collect();
        let mut plain = plain.trim_matches('_').to_owned();
        if plain.len() < 2 || !plain.starts_with(|c: char| c.is_ascii_alphabetic()) {
            plain = format!("Element_{plain}").trim_matches('_').to_owned();
        }
        let mut known = plain.clone();
        for number in 2.. {
            if self.0.insert(known.to_ascii_lowercase()) {
                break;
            }
            known = format!("{plain}_{number}");
        }
        known
    }
}

/// Returns a reference by its keys.
pub(super) fn reference(kind: &str, keys: &[(&str, &str)]) -> Value {
    let keys = keys
        .iter()
        .map(|(kind, value)| json!({ "type": kind, "value": value }));
    json!({ "type": kind, "keys": keys.collect::<Vec<_>>() })
}

/// Adds a semantic identifier to an element.
pub(super) fn meaning(mut element: Value, semantic_id: &str) -> Value {
    if let Some(element) = element.as_object_mut() {
        let id = reference("ExternalReference", &[("GlobalReference", semantic_id)]);
        element.insert("semanticId".to_owned(), id);
    }
    element
}

/// Returns a property with a value of an XSD type.
pub(super) fn property(id_short: &str, kind: &str, value: &str) -> Value {
    json!({
        "modelType": "Property", "idShort": id_short, "valueType": format!("xs:{kind}"),
        "value": value,
    })
}

/// Returns a text in English.
pub(super) fn text(id_short: &str, value: &str) -> Value {
    let value: String = value.chars().take(LONGEST_TEXT).collect();
    json!({
        "modelType": "MultiLanguageProperty", "idShort": id_short,
        "value": [{ "language": "en", "text": value }],
    })
}

/// Returns a collection, which is not empty.
pub(super) fn collection(id_short: &str, elements: Vec<Value>) -> Value {
    json!({ "modelType": "SubmodelElementCollection", "idShort": id_short, "value": elements })
}

/// Returns a submodel.
pub(super) fn submodel(
    (asset, id_short): (&str, &str),
    semantic_id: &str,
    elements: Vec<Value>,
) -> Value {
    let submodel = json!({
        "modelType": "Submodel", "id": format!("{asset}/submodel/{id_short}"), "idShort": id_short,
        "kind": "Instance", "submodelElements": elements,
    });
    meaning(submodel, semantic_id)
}

/// Longest short name before a number is appended.
const LONGEST: usize = 100;
/// Longest text in the metamodel.
const LONGEST_TEXT: usize = 1023;
