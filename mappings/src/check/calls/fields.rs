//! Whether requests, responses and feedback can be made of each other.

use std::collections::BTreeMap;
use std::sync::Arc;

use messages::{Leaf, Literal, MessageType, Plan, Rank, Selection};
use uadp::BuiltinType;

use super::bindings::{Definition, Found};
use crate::call::{Assigned, Assignment, CallKind, FieldMap};
use crate::check::{services, types};
use crate::code::Code;
use crate::findings::Findings;
use crate::read::short;
use crate::tree::Place;

/// Notes where a field of the request that is executed, or of the response where it is asked for, is made of nothing, and
/// what is wrong with the maps as far as the types are known.
pub(super) fn compare(executes: Option<&Found>, asks: &Found, findings: &mut Findings) {
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
        Part {
            key: request,
            map: maps.request.as_ref(),
            target: executes.zip(there.map(Definition::request)),
            source: Some((asks, here.map(Definition::request))),
            asked: true,
        },
        Part {
            key: response,
            map: maps.response.as_ref(),
            target: Some(asks).zip(here.map(Definition::response)),
            source: executes.map(|one| (one, there.map(Definition::response))),
            asked: false,
        },
        Part {
            key: feedback,
            map: maps.feedback.as_ref(),
            target: Some(asks).zip(here.and_then(Definition::feedback)),
            source: executes.map(|one| (one, there.and_then(Definition::feedback))),
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
            "say what it is made of: `{key}: {{a: {{field: b}}, c: 1}}`"
        ));
    }
}

impl Definition {
    /// What is asked with: the request of a service or goal.
    fn request(&self) -> &Arc<MessageType> {
        match self {
            Self::Service(service) => service.request(),
            Self::Action(action) => action.goal().request(),
        }
    }

    /// What comes back: the response of a service, or that with the result.
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

/// Two messages, one of which is made of the other.
struct Part<'p> {
    /// Of its map, and what paths of an action have in front of those of the mapping.
    key: (&'static str, &'static str),
    map: Option<&'p (FieldMap, Place)>,
    /// `None` where its type is not known.
    target: Option<(&'p Found, &'p Arc<MessageType>)>,
    source: Option<(&'p Found, Option<&'p Arc<MessageType>>)>,
    /// It goes from who asks to who executes.
    asked: bool,
}

impl Part<'_> {
    /// What is wrong with it, for people.
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
        // Who answers may say more than is wanted.
        let whole = map.is_empty() || message.leaves().is_empty();
        let fault = fault.or_else(|| {
            let lost = self.asked && whole;
            lost.then(|| self.lost(message, given)).flatten()
        })?;
        let source = &source.target.type_name;
        Some(format!(
            "the {key} of `{name}` cannot be made of that of `{source}`: {fault}"
        ))
    }

    /// Why a field cannot have the constant it is made of.
    fn constant(
        &self,
        map: &FieldMap,
        leaf: &Leaf,
        (of, message): (&Found, &Arc<MessageType>),
    ) -> Option<String> {
        let literal = match map.source(&leaf.path)? {
            Assigned::Constant(literal) => literal,
            Assigned::Field(_) => return None,
        };
        let told = self.told(&leaf.path);
        // What goes out is made of fields, which know no names of constants.
        if self.asked {
            let fits = is_value(leaf, &literal);
            let kind = types::print(types::value_type(leaf));
            return (!fits).then(|| format!("`{told}` is {kind}, and its constant is none"));
        }
        let one = Selection::Template {
            fields: Vec::new(),
            rest: BTreeMap::from([(leaf.path.clone(), literal)]),
        };
        let wire = services::wire(types::dialect(of.space));
        let fault = Plan::compile(message, &one, wire).err()?;
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
            None => Some(format!("`{told}` ({wanted}) is made of nothing")),
            Some(source) if types::value_type(source) != types::value_type(leaf) => Some(format!(
                "`{told}` is {wanted}, and `{}` {}",
                self.told(&path),
                types::print(types::value_type(source))
            )),
            Some(_) => None,
        }
    }

    /// Which field of who asks nothing is made of, where nothing says that it is left out.
    fn lost(&self, message: &MessageType, given: &MessageType) -> Option<String> {
        let lost = given.leaves().iter().find(|source| {
            let mut targets = message.leaves().iter();
            !targets.any(|target| target.path.eq_ignore_ascii_case(&source.path))
        })?;
        Some(format!("nothing is made of `{}`", self.told(&lost.path)))
    }

    /// A path as the mapping has it.
    fn told<'f>(&self, path: &'f str) -> &'f str {
        path.strip_prefix(self.key.1).unwrap_or(path)
    }
}

/// Whether that is a field, or a message with fields in it.
fn has_target(message: &MessageType, target: &str) -> bool {
    let mut leaves = message.leaves().iter();
    leaves.any(|leaf| {
        let (head, rest) = leaf.path.split_at_checked(target.len()).unwrap_or_default();
        head.eq_ignore_ascii_case(target) && (rest.is_empty() || rest.starts_with('.'))
    })
}

/// Whether the constant is a value of a field in a request.
fn is_value(leaf: &Leaf, literal: &Literal) -> bool {
    let fits = |text: &String| is_scalar(leaf.builtin, text);
    match (literal, leaf.rank) {
        (Literal::One(text), Rank::Scalar) => fits(text),
        (Literal::List(texts), Rank::Scalar) => {
            leaf.builtin == BuiltinType::ByteString
                && texts.iter().all(|text| text.parse::<u8>().is_ok())
        }
        (Literal::List(texts), Rank::Array { fixed }) => {
            fixed.is_none_or(|fixed| usize::try_from(fixed) == Ok(texts.len()))
                && texts.iter().all(fits)
        }
        (Literal::One(_), Rank::Array { .. }) => false,
    }
}

fn is_scalar(builtin: BuiltinType, text: &str) -> bool {
    match builtin {
        BuiltinType::Boolean => text.parse::<bool>().is_ok(),
        BuiltinType::SByte => text.parse::<i8>().is_ok(),
        BuiltinType::Byte => text.parse::<u8>().is_ok(),
        BuiltinType::Int16 => text.parse::<i16>().is_ok(),
        BuiltinType::UInt16 => text.parse::<u16>().is_ok(),
        BuiltinType::Int32 => text.parse::<i32>().is_ok(),
        BuiltinType::UInt32 => text.parse::<u32>().is_ok(),
        BuiltinType::Int64 => text.parse::<i64>().is_ok(),
        BuiltinType::UInt64 => text.parse::<u64>().is_ok(),
        BuiltinType::Float => text.parse::<f32>().is_ok(),
        BuiltinType::Double => text.parse::<f64>().is_ok(),
        BuiltinType::String => true,
        // No time is always the same but that of nothing.
        BuiltinType::DateTime => text == "0",
        BuiltinType::Guid
        | BuiltinType::ByteString
        | BuiltinType::XmlElement
        | BuiltinType::NodeId
        | BuiltinType::ExpandedNodeId
        | BuiltinType::StatusCode
        | BuiltinType::QualifiedName
        | BuiltinType::LocalizedText
        | BuiltinType::ExtensionObject
        | BuiltinType::DataValue
        | BuiltinType::Variant
        | BuiltinType::DiagnosticInfo => false,
    }
}
