//! The JSON Schema of the document, for editors.

use schemars::transform::{Transform, transform_subschemas};
use schemars::{Schema, json_schema};
use serde_json::{Map, Value};

use crate::document::Document;

/// The JSON Schema of the document, for editors: shapes and ranges, without what only checking across keys finds.
#[must_use]
pub fn schema() -> String {
    let mut schema = schemars::schema_for!(Document);
    let words = words(&schema);
    Variables { words }.transform(&mut schema);
    if let Some(Value::Object(defs)) = schema.get_mut("$defs") {
        let variable = json_schema!({
            "description": "An environment variable stands here, as ${CELL_TTL} or ${CELL_TTL:-1}.",
            "type": "string",
            "pattern": VARIABLE
        });
        defs.insert(NAME.to_owned(), variable.to_value());
    }
    // Every key is a string, which is all that could fail.
    let mut text = serde_json::to_string_pretty(&schema).unwrap_or_default();
    text.push('\n');
    text
}

/// A `${NAME}` with no `$` before it, anywhere in a text.
const VARIABLE: &str = r"(^|[^$])\$\{[A-Za-z_][A-Za-z0-9_]*(:-[^}]*)?\}";
const NAME: &str = "EnvironmentVariable";

/// The definitions that a single value may be: one of a few words, perhaps.
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

/// Lets the environment variable stand wherever a single value does.
struct Variables {
    /// References to definitions that a single value may be.
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
    /// The schema of a value.
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

    /// Whether it is of single values, and not of all texts.
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
        match types.contains(&"string") {
            true => limits_texts(schema),
            false => types.iter().any(|one| numbers.contains(one)),
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
