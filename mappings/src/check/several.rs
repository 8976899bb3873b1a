//! Several fields of a message, and messages that are structures.

use std::collections::HashSet;
use std::sync::Arc;

use messages::{ArrayRank, Leaf, MessageType, Selected, Selection};
use uadp::BuiltinType;

use super::shaping::{self, ValueDirection};
use super::types;
use crate::code::Code;
use crate::document::FieldList;
use crate::findings::MappingFindings;
use crate::mapping::Binding;
use crate::read::{Located, given, short};
use crate::tree::TextSpan;

/// Returns the fields of a binding; `None` for a faulty entry, which is noted.
pub(super) fn fields(
    at: &Located<FieldList>,
    message_type: Option<&MessageType>,
    way: ValueDirection,
    findings: &mut MappingFindings,
) -> Option<Selection> {
    let list = at.value.as_ref()?;
    if list.0.is_empty() {
        findings
            .error(Code::Fields, at.place, "`fields` is empty")
            .help("remove it for the whole message");
        return None;
    }
    if list.0.len() > MOST_FIELDS {
        let message = format!("`fields` has {} fields", list.0.len());
        findings
            .error(Code::Fields, at.place, message)
            .help(format!("a variable has at most {MOST_FIELDS} fields"));
        return None;
    }
    let mut all: Vec<Selected> = Vec::new();
    let mut known = HashSet::new();
    for at in &list.0 {
        let entry = at.value.as_ref()?;
        let Some((text, place)) = given(&entry.field) else {
            findings
                .error(
                    Code::MissingKey,
                    at.place,
                    "an entry of `fields` has no `field`",
                )
                .help("write it such as {field: linear.x, scale: 1000}");
            return None;
        };
        let field = shaping::part(text, place, findings)?;
        let shaping = shaping::shaping(entry.into(), findings)?;
        // The variable has several values, so there is no single type to convert them to.
        let way = ValueDirection {
            declared: None,
            alone: false,
            ..way
        };
        let one = shaping.select(field, message_type, (place, way), findings)?;
        let one = selected(one)?.pop()?;
        if !known.insert((one.field.clone(), one.part.clone())) {
            let message = format!("`{}` is listed twice", short(text));
            findings.error(Code::Fields, place, message);
            return None;
        }
        all.push(one);
    }
    Some(Selection::Fields(all))
}

/// Returns the fields of a selection that names them; `None` for other selections.
pub(super) fn selected(selection: Selection) -> Option<Vec<Selected>> {
    match selection {
        Selection::Field(field) => Some(vec![Selected::whole(&field)]),
        Selection::Value {
            field,
            part,
            conversion,
        } => Some(vec![Selected {
            field,
            part,
            conversion,
        }]),
        Selection::Fields(selected) => Some(selected),
        Selection::Whole
        | Selection::Structure(_)
        | Selection::Template { .. }
        | Selection::Bytes => None,
    }
}

/// Returns the values of several fields; `None` if the type lacks one of them, which is noted.
pub(super) fn leaves(
    message_type: &Arc<MessageType>,
    selected: &[Selected],
    (place, way): (TextSpan, ValueDirection),
    findings: &mut MappingFindings,
) -> Option<Vec<Leaf>> {
    let mut all = Vec::new();
    let mut places = Vec::new();
    for one in selected {
        let selection = if one.is_plain() {
            Selection::Field(one.field.clone())
        } else {
            Selection::Value {
                field: one.field.clone(),
                part: one.part.clone(),
                conversion: one.conversion,
            }
        };
        all.extend(shaping::leaves(message_type, &selection, place, findings)?);
        let inside = |leaf: &Leaf| leaf.path == one.field || leaf.is_inside(&one.field);
        let at = message_type
            .leaves()
            .iter()
            .enumerate()
            .filter(|(_, leaf)| inside(leaf))
            .map(|(at, _)| at);
        places.extend(at);
    }
    if !way.reads && !places.is_sorted_by(|a, b| a < b) {
        let message = format!(
            "the fields are not in the order of `{}`",
            message_type.name()
        );
        let paths: Vec<&str> = message_type
            .leaves()
            .iter()
            .map(|leaf| leaf.path.as_str())
            .filter(|path| {
                let under = |one: &Selected| {
                    path.strip_prefix(one.field.as_str())
                        .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
                };
                selected.iter().any(under)
            })
            .collect();
        let help = format!("the order here is {}", types::told(&paths));
        findings.error(Code::FieldOrder, place, message).help(help);
        return None;
    }
    Some(all)
}

/// Returns the one value of a structure; `None` if the path is not a message, which is noted.
pub(super) fn structure(
    message_type: &MessageType,
    path: &str,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Vec<Leaf>> {
    if message_type.message_at(path).is_some() {
        return Some(vec![Leaf {
            path: path.to_owned(),
            builtin: BuiltinType::ExtensionObject,
            rank: ArrayRank::Scalar,
        }]);
    }
    types::field(message_type, path, place, findings)?;
    let message = format!(
        "`{}` is not a message, so it cannot be a structure",
        short(path)
    );
    findings
        .error(Code::StructureOf, place, message)
        .help("remove `field` for the whole message, or remove `as: structure`");
    None
}

/// Notes structures of different types on both sides.
pub(super) fn compare(a: &Binding, b: &Binding, place: TextSpan, findings: &mut MappingFindings) {
    if let (Selection::Structure(None), Selection::Structure(None)) = (&a.selection, &b.selection)
        && a.message_type != b.message_type
    {
        let message = format!(
            "a structure of `{}` in space {} is not a `{}` in space {}",
            a.message_type, a.space, b.message_type, b.space
        );
        findings
            .error(Code::StructureOf, place, message)
            .help("bind the same type on both sides, or remove `as: structure`");
    }
}

/// Largest number of fields for which a DataSet with a component for each is reasonable.
const MOST_FIELDS: usize = 1_000;
