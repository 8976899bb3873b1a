//! The parameters of a recipe, from its formula and from its recipe elements.

use std::collections::BTreeMap;

use knowledge::units;
use roxmltree::Node;
use serde_json::Value;

use crate::process::{GivenParameter, ResultOf};
use crate::recipe::values::{self, WrittenValue};
use crate::recipe::{Reading, child, children, text_of};

/// The parameters of a formula by their IDs.
pub(super) struct Formula<'d>(BTreeMap<&'d str, Node<'d, 'd>>);

/// The parameters of a recipe element.
#[derive(Default)]
pub(super) struct RecipeParameters {
    pub(super) given: Vec<GivenParameter>,
    /// The parameters that are results of steps.
    pub(super) results: Vec<StepReference>,
}

/// A parameter with the result of a step.
pub(super) struct StepReference {
    /// The place among the parameters of the element.
    pub(super) parameter: usize,
    /// The ID of the other step.
    pub(super) step: String,
    /// The offset in the text.
    pub(super) at: usize,
}

impl<'d> Formula<'d> {
    /// Returns the formula of a recipe; empty if it has none.
    pub(super) fn of(recipe: Node<'d, 'd>) -> Self {
        let parameters = child(recipe, "Formula").into_iter();
        let parameters = parameters.flat_map(|formula| children(formula, "Parameter"));
        Self(parameters.map(|node| (text_of(node, "ID"), node)).collect())
    }

    /// Reads the parameters of a recipe element.
    pub(super) fn parameters(
        &self,
        element: Node<'d, 'd>,
        reading: &mut Reading<'d>,
    ) -> RecipeParameters {
        let mut read = RecipeParameters::default();
        for parameter in children(element, "Parameter") {
            let id = text_of(parameter, "ID");
            if text_of(parameter, "ParameterType") == "ProcessOutput" {
                reading.note(
                    parameter,
                    format!("the output `{id}` is left out: skills return their results"),
                );
                continue;
            }
            let whole = match child(parameter, "Value") {
                Some(_) => parameter,
                None => self.0.get(id).copied().unwrap_or(parameter),
            };
            let formula = (whole != parameter).then_some(whole);
            for at in [Some(parameter), formula].into_iter().flatten() {
                reading.only(
                    at,
                    &[
                        "ID",
                        "Description",
                        "ParameterType",
                        "ParameterSubType",
                        "Value",
                        "Scaled",
                    ],
                );
            }
            if text_of(whole, "Scaled") == "Yes" {
                let what =
                    format!("`{id}` is not scaled: the recipe runs with the size of its formula");
                reading.note(whole, what);
            }
            let name = reading.named(id).to_owned();
            let Some((given, of)) = self.value(whole, &name, reading) else {
                continue;
            };
            if read.given.iter().any(|known| known.name == name) {
                reading.error(parameter, format!("the parameter `{name}` is given twice"));
                continue;
            }
            read.results.extend(of.map(|step| StepReference {
                parameter: read.given.len(),
                step,
                at: whole.range().start,
            }));
            read.given.push(given);
        }
        read
    }

    /// Reads the value of a parameter, and the ID of the step whose result it is.
    fn value(
        &self,
        parameter: Node<'d, 'd>,
        name: &str,
        reading: &mut Reading<'d>,
    ) -> Option<(GivenParameter, Option<String>)> {
        let mut parameter = parameter;
        for _ in 0..MOST_REFERENCES {
            let mut values = children(parameter, "Value");
            let (Some(value), None) = (values.next(), values.next()) else {
                reading.error(parameter, format!("`{name}` has no value, or several"));
                return None;
            };
            reading.only(
                value,
                &[
                    "ValueString",
                    "DataInterpretation",
                    "DataType",
                    "UnitOfMeasure",
                ],
            );
            let texts: Vec<&str> = children(value, "ValueString")
                .map(|node| node.text().unwrap_or_default().trim())
                .collect();
            let text = texts.first().copied().unwrap_or_default();
            match text_of(value, "DataInterpretation") {
                "" | "Constant" => {
                    let read = constant(&texts, text_of(value, "DataType"));
                    let read = read.or_else(|| {
                        let kind = text_of(value, "DataType");
                        reading.error(
                            value,
                            format!("the value `{text}` of `{name}` is not of the type `{kind}`"),
                        );
                        None
                    })?;
                    let unit = reading.named(text_of(value, "UnitOfMeasure")).to_owned();
                    if !unit.is_empty() && !units::is_known(&unit) {
                        reading.note(value, format!("the unit `{unit}` of `{name}` is not known"));
                    }
                    let unit = (!unit.is_empty()).then_some(unit);
                    return Some((values::given(name, read, unit), None));
                }
                "Reference" => {
                    if let Some(other) = self.0.get(text) {
                        parameter = *other;
                        continue;
                    }
                    if let WrittenValue::Result(step, result) = values::value(&format!("={text}")) {
                        let mut given = values::given(name, Value::Null, None);
                        given.result = Some(ResultOf {
                            step: usize::MAX,
                            name: result,
                        });
                        return Some((given, Some(step)));
                    }
                    let what = format!(
                        "`{name}` refers to `{text}`, which is neither a parameter of the formula nor a result as step.Result"
                    );
                    reading.error(value, what);
                    return None;
                }
                other => {
                    let what = format!(
                        "the DataInterpretation `{other}` of `{name}` is not supported; give a Constant or a Reference"
                    );
                    reading.error(value, what);
                    return None;
                }
            }
        }
        reading.error(parameter, format!("the references of `{name}` do not end"));
        None
    }
}

/// Reads a constant of a type; several texts are a list.
fn constant(texts: &[&str], kind: &str) -> Option<Value> {
    let one = |text: &str| -> Option<Value> {
        let kind = kind.rsplit_once(':').map_or(kind, |(_, kind)| kind);
        match kind.to_ascii_lowercase().as_str() {
            "boolean" | "bool" => match text {
                "true" | "True" | "1" => Some(Value::Bool(true)),
                "false" | "False" | "0" => Some(Value::Bool(false)),
                _ => None,
            },
            "string" | "text" | "identifier" => Some(Value::String(text.to_owned())),
            "" | "other" => match values::value(text) {
                WrittenValue::Value { value, unit: None } => Some(value),
                WrittenValue::Value { .. } | WrittenValue::Result(..) => {
                    Some(Value::String(text.to_owned()))
                }
            },
            _ => {
                let value: Value = serde_json::from_str(text).ok()?;
                value.is_number().then_some(value)
            }
        }
    };
    match texts {
        [] => None,
        [text] => one(text),
        texts => texts.iter().map(|text| one(text)).collect(),
    }
}

/// Maximum number of references from a value to its constant.
const MOST_REFERENCES: usize = 16;
