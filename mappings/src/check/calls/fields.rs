//! Whether requests, responses and feedback can be made of each other.

use messages::{Leaf, MessageType};

use super::bindings::{Definition, Found};
use crate::call::{Assigned, Assignment, FieldMap};
use crate::check::types;
use crate::code::Code;
use crate::findings::Findings;
use crate::read::short;
use crate::tree::Place;

/// Notes where a field of the request that is executed, or of the response where it is asked for, is made of nothing.
pub(super) fn compare(executes: &Found, asks: &Found, findings: &mut Findings) {
    let (there, here) = (&executes.target.type_name, &asks.target.type_name);
    let (Some(executed), Some(asked)) = (&executes.definition, &asks.definition) else {
        return;
    };
    let maps = &asks.maps;
    let parts: &[Part<'_>] = match (executed, asked) {
        (Definition::Service(executed), Definition::Service(asked)) => &[
            Part {
                key: "request",
                within: "",
                map: maps.request.as_ref(),
                target: executed.request(),
                source: asked.request(),
                asked: true,
            },
            Part {
                key: "response",
                within: "",
                map: maps.response.as_ref(),
                target: asked.response(),
                source: executed.response(),
                asked: false,
            },
        ],
        (Definition::Action(executed), Definition::Action(asked)) => &[
            Part {
                key: "goal",
                within: "goal.",
                map: maps.request.as_ref(),
                target: executed.goal().request(),
                source: asked.goal().request(),
                asked: true,
            },
            Part {
                key: "result",
                within: "result.",
                map: maps.response.as_ref(),
                target: asked.result().response(),
                source: executed.result().response(),
                asked: false,
            },
            Part {
                key: "feedback",
                within: "feedback.",
                map: maps.feedback.as_ref(),
                target: asked.feedback(),
                source: executed.feedback(),
                asked: false,
            },
        ],
        // That one is of another kind is noted.
        (Definition::Service(_), Definition::Action(_))
        | (Definition::Action(_), Definition::Service(_)) => &[],
    };
    for part in parts {
        let Some(fault) = part.fault() else { continue };
        let (target, source) = if part.asked {
            (there, here)
        } else {
            (here, there)
        };
        let Part { key, map, .. } = part;
        let place = map.map_or(asks.place, |(_, place)| *place);
        let message =
            format!("the {key} of `{target}` cannot be made of that of `{source}`: {fault}");
        findings.error(Code::CallMap, place, message).help(format!(
            "say what it is made of: `{key}: {{a: {{field: b}}, c: 1}}`"
        ));
    }
}

/// Two messages, one of which is made of the other.
struct Part<'p> {
    key: &'static str,
    /// What paths of an action have in front of those of the mapping.
    within: &'static str,
    map: Option<&'p (FieldMap, Place)>,
    target: &'p MessageType,
    source: &'p MessageType,
    /// It goes from who asks to who executes.
    asked: bool,
}

impl Part<'_> {
    /// Which field is made of nothing, or of one of another type, or which of who asks is lost.
    fn fault(&self) -> Option<String> {
        let none = FieldMap::default();
        let map = self.map.map_or(&none, |(map, _)| map);
        let strange = map.0.iter().find(|one| !self.has_target(&one.target));
        if let Some(Assignment { target, .. }) = strange {
            return Some(format!("there is no field `{}`", short(self.told(target))));
        }
        let mut leaves = self.target.leaves().iter();
        let fault = leaves.find_map(|leaf| self.made(map, leaf));
        // Who answers may say more than is wanted.
        let whole = map.is_empty() || self.target.leaves().is_empty();
        fault.or_else(|| (self.asked && whole).then(|| self.lost()).flatten())
    }

    /// Whether that is a field, or a message with fields in it.
    fn has_target(&self, target: &str) -> bool {
        let mut leaves = self.target.leaves().iter();
        leaves.any(|leaf| {
            let (head, rest) = leaf.path.split_at_checked(target.len()).unwrap_or_default();
            head.eq_ignore_ascii_case(target) && (rest.is_empty() || rest.starts_with('.'))
        })
    }

    fn made(&self, map: &FieldMap, leaf: &Leaf) -> Option<String> {
        let path = match map.source(&leaf.path) {
            Some(Assigned::Constant(_)) => return None,
            Some(Assigned::Field(path)) => path,
            None => leaf.path.clone(),
        };
        let (told, wanted) = (self.told(&leaf.path), types::print(types::value_type(leaf)));
        let mut sources = self.source.leaves().iter();
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
    fn lost(&self) -> Option<String> {
        let lost = self.source.leaves().iter().find(|source| {
            let mut targets = self.target.leaves().iter();
            !targets.any(|target| target.path.eq_ignore_ascii_case(&source.path))
        })?;
        Some(format!("nothing is made of `{}`", self.told(&lost.path)))
    }

    /// A path as the mapping has it.
    fn told<'f>(&self, path: &'f str) -> &'f str {
        path.strip_prefix(self.within).unwrap_or(path)
    }
}
