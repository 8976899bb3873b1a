//! The fields of the configuration of a component in its YAML.

use std::sync::Arc;

use serde_json::Value as Json;

use super::texts::read_name;
use super::values::{
    LONGEST_ABOUT, LONGEST_UNIT, check_range, read_line, read_range, read_shape_name,
};
use super::{SkillSetup, ValueSetup};
use crate::configuration::{Configurable, FieldEffect, FieldError};
use crate::parameters::shortened;
use crate::value::{Builtin, SkillValue, ValueShape};
use crate::values::ValueFacts;
use crate::yaml::{DocumentKind, DocumentNode, YamlFindingCode, YamlReader, whole};

/// Reads the list `configurable`.
pub(super) fn read_configurable(
    node: &DocumentNode,
    known: (&[SkillSetup], &[ValueSetup]),
    reader: &mut YamlReader<'_>,
) -> Vec<Configurable> {
    let mut fields: Vec<Configurable> = Vec::new();
    let nodes = reader.list(node);
    if nodes.len() > MOST_FIELDS {
        let message = format!("a component has at most {MOST_FIELDS} configurable fields");
        reader
            .findings()
            .error(YamlFindingCode::TooMany, node.place, message);
    }
    for node in nodes.iter().take(MOST_FIELDS) {
        let Some(field) = read_field(node, known, reader) else {
            continue;
        };
        if fields
            .iter()
            .any(|known| known.facts.name.eq_ignore_ascii_case(&field.facts.name))
        {
            let message = format!("there is a field `{}` already", field.facts.name);
            reader
                .findings()
                .error(YamlFindingCode::NameTwice, node.place, message);
        }
        fields.push(field);
    }
    fields
}

/// The keys of a field.
pub(super) const KEYS: [&str; 10] = [
    "name", "about", "type", "unit", "range", "default", "limits", "sets", "period", "skills",
];

fn read_field(
    node: &DocumentNode,
    known: (&[SkillSetup], &[ValueSetup]),
    reader: &mut YamlReader<'_>,
) -> Option<Configurable> {
    let [
        name,
        about,
        of_type,
        unit,
        range,
        default,
        limits,
        sets,
        period,
        skills,
    ] = reader.map(node, KEYS)?;
    let name = reader
        .needed(name, "name", node.place)
        .and_then(|node| read_name(node, reader));
    let about = about.map(|node| read_line(node, LONGEST_ABOUT, reader));
    let unit = unit.map(|node| read_line(node, LONGEST_UNIT, reader));
    let range = range.map(|node| read_range(node, reader));
    let shape = of_type.map(|node| read_shape_name(node, reader));
    let effect = read_effect(node, [limits, sets, period], known.1, reader);
    let skills = read_skill_names(skills, known.0, reader);
    let effect = effect?;
    let (shape, unit, range) = match &effect {
        // Milliseconds, in the range of the periods in the YAML.
        FieldEffect::Period(_) => (
            Some(DOUBLE),
            Some("ms".to_owned()),
            whole(range)?.or(Some((10.0, 3_600_000.0))),
        ),
        FieldEffect::Limits(_) | FieldEffect::Sets(_) | FieldEffect::Data => {
            (whole(shape)?, whole(unit)?, whole(range)?)
        }
    };
    let facts = ValueFacts {
        name: name?,
        shape: shape.unwrap_or(DOUBLE),
        unit,
        range,
        about: whole(about)?.unwrap_or_default(),
    };
    check_range(&facts, node.place, reader);
    let is_number = !matches!(facts.shape.builtin, Builtin::Boolean | Builtin::String);
    if matches!(effect, FieldEffect::Limits(_)) && (!is_number || facts.shape.array) {
        let message = "a limit is a number".to_owned();
        return reader.refuse(node, YamlFindingCode::WrongValue, message);
    }
    let mut field = Configurable {
        facts: Arc::new(facts),
        default: None,
        effect,
        skills: skills?,
        place: node.place,
    };
    if let Some(node) = default {
        field.default = Some(read_default(node, &field, reader)?);
    }
    Some(field)
}

fn read_effect(
    node: &DocumentNode,
    effects: [Option<&DocumentNode>; 3],
    values: &[ValueSetup],
    reader: &mut YamlReader<'_>,
) -> Option<FieldEffect> {
    let mut parameter = |node: &DocumentNode| {
        reader
            .text(node, "the name of a parameter")
            .map(str::to_owned)
    };
    match effects {
        [None, None, None] => Some(FieldEffect::Data),
        [Some(node), None, None] => parameter(node).map(FieldEffect::Limits),
        [None, Some(node), None] => parameter(node).map(FieldEffect::Sets),
        [None, None, Some(node)] => {
            let text = reader.text(node, "the name of a value, or `all`")?;
            if text == "all" {
                return Some(FieldEffect::Period(None));
            }
            if values.iter().any(|value| value.facts.name == text) {
                return Some(FieldEffect::Period(Some(text.to_owned())));
            }
            let message = format!("the component has no value `{}`", shortened(text));
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
        _ => {
            let message = "a field has one effect: `limits`, `sets` or `period`".to_owned();
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
    }
}

fn read_skill_names(
    node: Option<&DocumentNode>,
    known: &[SkillSetup],
    reader: &mut YamlReader<'_>,
) -> Option<Vec<String>> {
    let Some(node) = node else {
        return Some(Vec::new());
    };
    let mut names = Vec::new();
    for node in reader.list(node) {
        let text = reader.text(node, "the name of a skill")?;
        if !known.iter().any(|skill| skill.name == text) {
            let message = format!("the component has no skill `{}`", shortened(text));
            return reader.refuse(node, YamlFindingCode::WrongValue, message);
        }
        names.push(text.to_owned());
    }
    Some(names)
}

fn read_default(
    node: &DocumentNode,
    field: &Configurable,
    reader: &mut YamlReader<'_>,
) -> Option<SkillValue> {
    let shape = field.facts.shape;
    let scalar = |node: &DocumentNode, reader: &mut YamlReader<'_>| {
        let text = reader.text(node, "a value")?;
        let is_text = shape.builtin == Builtin::String;
        let number = serde_json::from_str(text).ok().filter(|_| !is_text);
        Some(number.unwrap_or_else(|| Json::from(text)))
    };
    let json = match &node.kind {
        DocumentKind::List(nodes) => {
            let all: Option<Vec<Json>> = nodes.iter().map(|node| scalar(node, reader)).collect();
            Json::from(all?)
        }
        DocumentKind::Null | DocumentKind::Scalar(_) | DocumentKind::Map(_) => {
            scalar(node, reader)?
        }
    };
    let read = shape.read_json(&json).map_err(FieldError::from);
    match read.and_then(|value| field.take(value)) {
        Ok(value) => Some(value),
        Err(why) => reader.refuse(node, YamlFindingCode::WrongValue, why.to_string()),
    }
}

/// The default type.
const DOUBLE: ValueShape = ValueShape::scalar(Builtin::Double);
const MOST_FIELDS: usize = 100;

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::component::Component;

    fn read(fields: &str) -> Result<Vec<Configurable>, String> {
        let document = format!(
            "component: x\napplication_uri: urn:x\nnamespace: 1\nskills:\n  - {{name: Grasp, type: GraspSkillType, driver: simulated}}\nvalues:\n  - {{name: Runs, runs: all}}\nconfigurable:\n{fields}"
        );
        Component::from_yaml(&document, Path::new(""))
            .map(|component| component.configurable)
            .map_err(|findings| findings.render("x.yaml", &document))
    }

    #[test]
    fn limits_defaults_periods_and_product_data_are_read() {
        let fields = read(
            "  - {name: ForceLimit, limits: Force, unit: N, range: [5, 50], default: 40, skills: [Grasp]}\n  \
             - {name: Usual, sets: Force}\n  - {name: Period, period: Runs}\n  - {name: Product, type: String, default: \"7\"}\n",
        )
        .unwrap();
        let effects: Vec<&FieldEffect> = fields.iter().map(|field| &field.effect).collect();
        let force = "Force".to_owned();
        let expected = [
            &FieldEffect::Limits(force.clone()),
            &FieldEffect::Sets(force),
            &FieldEffect::Period(Some("Runs".to_owned())),
            &FieldEffect::Data,
        ];
        assert_eq!(effects, expected);
        assert_eq!(fields[0].default, Some(40.0.into()));
        assert_eq!(fields[3].default, Some("7".into()));
        assert_eq!(fields[2].facts.unit.as_deref(), Some("ms"));
    }

    #[test]
    fn wrong_fields_are_findings_with_their_lines() {
        for (field, expected) in [
            ("{limits: Force}", "`name` is missing"),
            ("{name: A, limits: Force, sets: Force}", "one effect"),
            (
                "{name: A, limits: Force, type: String}",
                "a limit is a number",
            ),
            (
                "{name: A, limits: Force, range: [1, 2], default: 3}",
                "expected 1 to 2, found 3",
            ),
            (
                "{name: A, sets: Force, default: strong}",
                "expected Double, found \"strong\"",
            ),
            ("{name: A, period: Walks}", "no value `Walks`"),
            ("{name: A, sets: Force, skills: [Grap]}", "no skill `Grap`"),
        ] {
            let told = read(&format!("  - {field}\n")).unwrap_err();
            assert!(
                told.contains(expected) && told.contains("x.yaml:9:"),
                "{field}: {told}"
            );
        }
    }
}
