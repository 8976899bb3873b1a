//! The JSON Schema of the document, for editors.

use schemars::transform::{Transform, transform_subschemas};
use schemars::{Schema, json_schema};
use serde_json::{Map, Value};

use crate::document::Document;

/// Returns the JSON Schema of the document, for editors: structure and ranges, without checks
/// across keys.
#[must_use]
pub fn schema() -> String {
    let mut schema = schemars::schema_for!(Document);
    let words = words(&schema);
    Variables { words }.transform(&mut schema);
    if let Some(Value::Object(defs)) = schema.get_mut("$defs") {
        let variable = json_schema!({
            "description": "An environment variable, such as ${CELL_TTL} or ${CELL_TTL:-1}.",
            "type": "string",
            "pattern": VARIABLE
        });
        defs.insert(NAME.to_owned(), variable.to_value());
    }
    // Serialization fails only for keys that are not strings, and every key is a string.
    let mut text = serde_json::to_string_pretty(&schema).unwrap_or_default();
    text.push('\n');
    text
}

/// Pattern of a `${NAME}` without a `$` before it, anywhere in a text.
const VARIABLE: &str = r"(^|[^$])\$\{[A-Za-z_][A-Za-z0-9_]*(:-[^}]*)?\}";
const NAME: &str = "EnvironmentVariable";

/// Returns references to the definitions that allow a single value, such as a keyword.
fn words(schema: &Schema) -> Vec<String> {
    let defs = schema.get("$defs").and_then(Value::as_object);
    let is_word = |schema: &Value| schema["type"] == "string";
    let of_words = |schema: &Value| {
        let choices = ["oneOf", "anyOf"]
            .into_iter()
            .find_map(|key| schema.get(key));
        let choices = choices.and_then(Value::as_array);
        is_word(schema) || choices.is_some_and(|choices| choices.iter().any(is_word))
    };
    let named = defs.into_iter().flatten();
    let named = named.filter(|(_, schema)| of_words(schema));
    named.map(|(name, _)| format!("#/$defs/{name}")).collect()
}

/// Allows an environment variable wherever a single value is allowed.
struct Variables {
    /// References to definitions that allow a single value.
    words: Vec<String>,
}

impl Transform for Variables {
    fn transform(&mut self, schema: &mut Schema) {
        transform_subschemas(self, schema);
        let Some(schema) = schema.as_object_mut() else {
            return;
        };
        for key in ["properties", "patternProperties"] {
            if let Some(Value::Object(values)) = schema.get_mut(key) {
                values.values_mut().for_each(|value| self.open(value));
            }
        }
        for key in ["items", "additionalProperties"] {
            if let Some(value) = schema.get_mut(key) {
                self.open(value);
            }
        }
    }
}

impl Variables {
    /// Adds the environment variable to the schema of a value.
    fn open(&self, value: &mut Value) {
        let Value::Object(schema) = value else { return };
        if let Some(Value::Array(choices)) = schema.get_mut("anyOf") {
            if choices.iter().any(|choice| self.is_limited(choice)) {
                choices.push(variable());
            }
        } else if self.is_limited(&Value::Object(schema.clone())) {
            let description = schema.remove("description");
            let limited = std::mem::take(schema);
            let description = description.map(|text| ("description".to_owned(), text));
            schema.extend(description);
            let choices = vec![Value::Object(limited), variable()];
            schema.insert("anyOf".to_owned(), Value::Array(choices));
        }
    }

    /// Returns `true` for a schema of single values that does not allow every text.
    fn is_limited(&self, schema: &Value) -> bool {
        let Value::Object(schema) = schema else {
            return false;
        };
        if let Some(Value::String(reference)) = schema.get("$ref") {
            return self.words.contains(reference);
        }
        let types: Vec<&str> = match schema.get("type") {
            Some(Value::String(one)) => vec![one],
            Some(Value::Array(several)) => several.iter().filter_map(Value::as_str).collect(),
            Some(_) | None => Vec::new(),
        };
        let numbers = ["integer", "number", "boolean"];
        if types.contains(&"string") {
            limits_texts(schema)
        } else {
            types.iter().any(|one| numbers.contains(one))
        }
    }
}

fn limits_texts(schema: &Map<String, Value>) -> bool {
    ["pattern", "const", "enum"]
        .iter()
        .any(|key| schema.contains_key(*key))
}

fn variable() -> Value {
    json_schema!({ "$ref": format!("#/$defs/{NAME}") }).to_value()
}
