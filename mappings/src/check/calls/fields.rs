//! Checks that requests, responses and feedback can be made of each other.

use std::collections::BTreeMap;
use std::sync::Arc;

use messages::{ArrayRank, Leaf, Literal, MessagePlan, MessageType, Selection};
use uadp::BuiltinType;

use super::bindings::{CallDefinition, FoundBinding};
use crate::call::{Assigned, Assignment, CallKind, FieldMap};
use crate::check::{services, types};
use crate::code::Code;
use crate::findings::MappingFindings;
use crate::read::short;
use crate::tree::TextSpan;

/// Notes each field without a source, in the request of the executor and in the response of the
/// offered service. Notes faults of the maps as far as the types are known.
pub(super) fn compare(
    executes: Option<&FoundBinding>,
    asks: &FoundBinding,
    findings: &mut MappingFindings,
) {
    let there = executes.and_then(|one| one.definition.as_ref());
    let here = asks.definition.as_ref();
    let [request, response, feedback] = match asks.kind {
        CallKind::Service => [("request", ""), ("response", ""), ("", "")],
        CallKind::Action => [
            ("goal", "goal."),
            ("result", "result."),
            ("feedback", "feedback."),
        ],
    };
    let maps = &asks.maps;
    let parts = [
        MessagePair {
            key: request,
            map: maps.request.as_ref(),
            target: executes.zip(there.map(CallDefinition::request)),
            source: Some((asks, here.map(CallDefinition::request))),
            asked: true,
        },
        MessagePair {
            key: response,
            map: maps.response.as_ref(),
            target: Some(asks).zip(here.map(CallDefinition::response)),
            source: executes.map(|one| (one, there.map(CallDefinition::response))),
            asked: false,
        },
        MessagePair {
            key: feedback,
            map: maps.feedback.as_ref(),
            target: Some(asks).zip(here.and_then(CallDefinition::feedback)),
            source: executes.map(|one| (one, there.and_then(CallDefinition::feedback))),
            asked: false,
        },
    ];
    for part in parts {
        let Some(message) = part.fault() else {
            continue;
        };
        let place = part.map.map_or(asks.place, |(_, place)| *place);
        let (key, _) = part.key;
        findings.error(Code::CallMap, place, message).help(format!(
            "list the sources of the fields: `{key}: {{a: {{field: b}}, c: 1}}`"
        ));
    }
}

impl CallDefinition {
    /// Returns the request of a service, or of an action's goal.
    fn request(&self) -> &Arc<MessageType> {
        match self {
            Self::Service(service) => service.request(),
            Self::Action(action) => action.goal().request(),
        }
    }

    /// Returns the response of a service, or the response with an action's result.
    fn response(&self) -> &Arc<MessageType> {
        match self {
            Self::Service(service) => service.response(),
            Self::Action(action) => action.result().response(),
        }
    }

    fn feedback(&self) -> Option<&Arc<MessageType>> {
        match self {
            Self::Service(_) => None,
            Self::Action(action) => Some(action.feedback()),
        }
    }
}

/// Two messages: a target that is made of a source.
struct MessagePair<'p> {
    /// Key of the map in the document, and the prefix of an action's paths that the document leaves
    /// out.
    key: (&'static str, &'static str),
    map: Option<&'p (FieldMap, TextSpan)>,
    /// `None` if the type of the target is not known.
    target: Option<(&'p FoundBinding, &'p Arc<MessageType>)>,
    source: Option<(&'p FoundBinding, Option<&'p Arc<MessageType>>)>,
    /// The message goes from the caller to the executor.
    asked: bool,
}

impl MessagePair<'_> {
    /// Returns the fault of this pair of messages, for users.
    fn fault(&self) -> Option<String> {
        let (target, message) = self.target?;
        let (key, name) = (self.key.0, &target.target.type_name);
        let none = FieldMap::default();
        let map = self.map.map_or(&none, |(map, _)| map);
        let strange = map.0.iter().find(|one| !has_target(message, &one.target));
        if let Some(Assignment { target, .. }) = strange {
            let field = short(self.told(target));
            return Some(format!("the {key} of `{name}` has no field `{field}`"));
        }
        let mut leaves = message.leaves().iter();
        let constant = leaves.find_map(|leaf| self.constant(map, leaf, (target, message)));
        if let Some(why) = constant {
            return Some(format!("in the {key} of `{name}`, {why}"));
        }
        let (source, given) = self.source?;
        let given = given?;
        let mut leaves = message.leaves().iter();
        let fault = leaves.find_map(|leaf| self.made(map, leaf, given));
        // An executor may return more fields than the caller wants.
        let whole = map.is_empty() || message.leaves().is_empty();
        let fault = fault.or_else(|| {
            let lost = self.asked && whole;
            lost.then(|| self.lost(message, given)).flatten()
        })?;
        let source = &source.target.type_name;
        Some(format!(
            "cannot make the {key} of `{name}` from the {key} of `{source}`: {fault}"
        ))
    }

    /// Returns why the constant does not fit the field.
    fn constant(
        &self,
        map: &FieldMap,
        leaf: &Leaf,
        (of, message): (&FoundBinding, &Arc<MessageType>),
    ) -> Option<String> {
        let literal = match map.source(&leaf.path)? {
            Assigned::Constant(literal) => literal,
            Assigned::Field(_) => return None,
        };
        let told = self.told(&leaf.path);
        // The request of the executor is made of fields, which know no names of constants.
        if self.asked {
            let fits = is_value(leaf, &literal);
            let kind = types::print(types::value_type(leaf));
            return (!fits).then(|| format!("`{told}` is {kind}, but its constant is not"));
        }
        let one = Selection::Template {
            fields: Vec::new(),
            rest: BTreeMap::from([(leaf.path.clone(), literal)]),
        };
        let wire = services::wire(types::dialect(of.space));
        let fault = MessagePlan::compile(message, &one, wire).err()?;
        Some(fault.to_string())
    }

    fn made(&self, map: &FieldMap, leaf: &Leaf, given: &MessageType) -> Option<String> {
        let path = match map.source(&leaf.path) {
            Some(Assigned::Constant(_)) => return None,
            Some(Assigned::Field(path)) => path,
            None => leaf.path.clone(),
        };
        let (told, wanted) = (self.told(&leaf.path), types::print(types::value_type(leaf)));
        let mut sources = given.leaves().iter();
        let source = sources.find(|source| source.path.eq_ignore_ascii_case(&path));
        match source {
            None => Some(format!("`{told}` ({wanted}) has no source")),
            Some(source) if types::value_type(source) != types::value_type(leaf) => Some(format!(
                "`{told}` is {wanted}, but `{}` {}",
                self.told(&path),
                types::print(types::value_type(source))
            )),
            Some(_) => None,
        }
    }

    /// Returns the fault if a field of the caller is used nowhere and no map leaves it out.
    fn lost(&self, message: &MessageType, given: &MessageType) -> Option<String> {
        let lost = given.leaves().iter().find(|source| {
            let mut targets = message.leaves().iter();
            !targets.any(|target| target.path.eq_ignore_ascii_case(&source.path))
        })?;
        Some(format!("`{}` is not used", self.told(&lost.path)))
    }

    /// Returns a path as the mapping writes it.
    fn told<'f>(&self, path: &'f str) -> &'f str {
        path.strip_prefix(self.key.1).unwrap_or(path)
    }
}

/// Returns `true` if the target is a field, or a message with fields in it.
fn has_target(message: &MessageType, target: &str) -> bool {
    let mut leaves = message.leaves().iter();
    leaves.any(|leaf| {
        let (head, rest) = leaf.path.split_at_checked(target.len()).unwrap_or_default();
        head.eq_ignore_ascii_case(target) && (rest.is_empty() || rest.starts_with('.'))
    })
}

/// Returns `true` if the constant is a value of a field in a request.
fn is_value(leaf: &Leaf, literal: &Literal) -> bool {
    let fits = |text: &String| messages::constant(leaf.builtin, text).is_some();
    match (literal, leaf.rank) {
        (Literal::One(text), ArrayRank::Scalar) => fits(text),
        (Literal::List(texts), ArrayRank::Scalar) => {
            leaf.builtin == BuiltinType::ByteString
                && texts.iter().all(|text| text.parse::<u8>().is_ok())
        }
        (Literal::List(texts), ArrayRank::Array { fixed }) => {
            fixed.is_none_or(|fixed| usize::try_from(fixed) == Ok(texts.len()))
                && texts.iter().all(fits)
        }
        (Literal::One(_), ArrayRank::Array { .. }) => false,
    }
}
