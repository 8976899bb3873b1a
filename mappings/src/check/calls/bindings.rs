//! The services and actions under `ros` of a call.

use std::sync::Arc;

use messages::{ActionCalls, Dialect, ServiceType, TypeName};

use super::Checker;
use crate::call::{Assigned, Assignment, CallKind, CallTarget, FieldMap};
use crate::check::nodes::space;
use crate::check::required;
use crate::check::services;
use crate::check::site::ros_name;
use crate::check::types::{MessageTypes, dialect};
use crate::code::Code;
use crate::document::{CallBindingEntry, CallEntry, FieldMapEntry};
use crate::findings::MappingFindings;
use crate::read::{OptionalKey, given, short};
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// A service or action under `ros`, with the parts that are known.
pub(super) struct FoundBinding {
    pub(super) space: SpaceId,
    pub(super) place: TextSpan,
    pub(super) kind: CallKind,
    pub(super) target: CallTarget,
    /// `None` if the type is not known.
    pub(super) definition: Option<CallDefinition>,
    pub(super) maps: Maps,
}

/// Definition of a service or action type.
#[derive(Clone)]
pub(super) enum CallDefinition {
    Service(Arc<ServiceType>),
    Action(Arc<ActionCalls>),
}

/// The maps of a binding, each with its position.
#[derive(Default)]
pub(super) struct Maps {
    /// Map of the request, or of the goal.
    pub(super) request: Option<(FieldMap, TextSpan)>,
    /// Map of the response, or of the result.
    pub(super) response: Option<(FieldMap, TextSpan)>,
    pub(super) feedback: Option<(FieldMap, TextSpan)>,
}

impl Maps {
    /// Returns the position of the first map.
    pub(super) fn place(&self) -> Option<TextSpan> {
        let maps = [&self.request, &self.response, &self.feedback];
        maps.into_iter().flatten().map(|(_, place)| *place).next()
    }
}

/// Returns the kind of a call by its bindings; `None` if they are faulty, or of both kinds, which
/// is noted.
pub(super) fn kind_of(
    found: Option<&[FoundBinding]>,
    entry: &CallEntry,
    findings: &mut MappingFindings,
) -> Option<CallKind> {
    let found = found?;
    let kind = match (found.first(), &entry.opcua) {
        (_, Some(_)) | (None, _) => CallKind::Service,
        (Some(first), None) => first.kind,
    };
    let Some(other) = found.iter().find(|one| one.kind != kind) else {
        return Some(kind);
    };
    let message = match entry.opcua {
        Some(_) => "a Method is requested by a service, because it returns at once".to_owned(),
        None => "the call has a service and an action".to_owned(),
    };
    findings
        .error(Code::CallBinding, other.place, message)
        .help("use only services, or only actions, under `ros` of a call");
    None
}

impl Checker<'_> {
    /// Returns the bindings of a call; `None` if a binding is faulty.
    pub(super) fn bindings(
        &mut self,
        entry: &CallEntry,
        origin: Option<SpaceId>,
        findings: &mut MappingFindings,
    ) -> Option<Vec<FoundBinding>> {
        let entries = entry.ros.as_ref().and_then(|at| at.value.as_ref());
        let entries = entries.map_or(&[][..], |bindings| &bindings.0);
        let mut all: Option<Vec<FoundBinding>> = Some(Vec::new());
        for at in entries {
            let found = at.value.as_ref().and_then(|binding| {
                let found = self.binding(binding, at.place, origin, findings)?;
                let others = all.as_deref().unwrap_or_default();
                if others.iter().any(|other| other.space == found.space) {
                    let kind = found.kind.word();
                    let message = format!("the call has two {kind}s in space {}", found.space);
                    findings
                        .error(Code::CallExecutor, at.place, message)
                        .help("remove one of them");
                    return None;
                }
                Some(found)
            });
            match (found, &mut all) {
                (Some(found), Some(all)) => all.push(found),
                _ => all = None,
            }
        }
        // A fault of the whole entry makes all bindings faulty.
        entry
            .ros
            .as_ref()
            .is_none_or(|at| at.value.is_some())
            .then_some(())?;
        all
    }

    fn binding(
        &mut self,
        entry: &CallBindingEntry,
        place: TextSpan,
        origin: Option<SpaceId>,
        findings: &mut MappingFindings,
    ) -> Option<FoundBinding> {
        let space = self.space_of(entry, place, origin, findings)?;
        let dialect = dialect(space);
        let kind = kind(entry, place, findings)?;
        let (name, at) = name(entry, kind, dialect, findings)?;
        let named = required(&entry.r#type, "type", "the binding", place, findings);
        let (type_name, type_place) =
            named.and_then(|(text, place)| type_name(text, kind, place, findings))?;
        findings.of_part([space]);
        let at_type = (dialect, type_place);
        let definition = match kind {
            CallKind::Service => {
                let known = services::built_in(&type_name, at_type, self.types, findings);
                known.map(CallDefinition::Service)
            }
            CallKind::Action => {
                action(&type_name, at_type, self.types, findings).map(CallDefinition::Action)
            }
        };
        findings.of_part(None);
        let key = (space, kind, name.clone());
        if let Some(first) = self.targets.insert(key, at) {
            let line = findings.line(first, at);
            let message = format!("`{name}` is the {} of two calls", kind.word());
            findings
                .error(Code::CallTwice, at, message)
                .label(format!("first at {line}"));
            return None;
        }
        let maps = match kind {
            CallKind::Service => Maps {
                request: field_map(&entry.request, ""),
                response: field_map(&entry.response, ""),
                feedback: None,
            },
            CallKind::Action => Maps {
                request: field_map(&entry.goal, "goal."),
                response: field_map(&entry.result, "result."),
                feedback: field_map(&entry.feedback, "feedback."),
            },
        };
        Some(FoundBinding {
            space,
            place,
            kind,
            target: CallTarget { name, type_name },
            definition,
            maps,
        })
    }

    fn space_of(
        &self,
        entry: &CallBindingEntry,
        place: TextSpan,
        origin: Option<SpaceId>,
        findings: &mut MappingFindings,
    ) -> Option<SpaceId> {
        let (id, at) = match &entry.space {
            Some(at) => {
                let id = space(at.value?, at.place, "space", self.known.spaces, findings)?;
                (id, at.place)
            }
            None => (origin?, place),
        };
        if id == SpaceId::UA {
            let message = "space 0 is the OPC UA side, which has no ROS services";
            findings
                .error(Code::OpcUaBinding, at, message)
                .help("give the `space` of the service");
            return None;
        }
        Some(id)
    }
}

/// Returns `None` if the binding is not exactly one of the kinds, or has keys of the other kind.
/// Both are noted.
fn kind(
    entry: &CallBindingEntry,
    owner: TextSpan,
    findings: &mut MappingFindings,
) -> Option<CallKind> {
    let place = |at: &OptionalKey<FieldMapEntry>| at.as_ref().map(|at| at.place);
    let maps = [
        (CallKind::Service, "request", place(&entry.request)),
        (CallKind::Service, "response", place(&entry.response)),
        (CallKind::Action, "goal", place(&entry.goal)),
        (CallKind::Action, "feedback", place(&entry.feedback)),
        (CallKind::Action, "result", place(&entry.result)),
    ];
    let kind = match (&entry.service, &entry.action) {
        (Some(_), None) => CallKind::Service,
        (None, Some(_)) => CallKind::Action,
        (Some(_), Some(action)) => {
            let message = "a binding has `service` or `action`, not both";
            findings
                .error(Code::CallBinding, action.place, message)
                .help("add a separate call for each");
            return None;
        }
        (None, None) => {
            findings
                .error(Code::MissingKey, owner, "the binding has no `service`")
                .help("give the name of a service, or of an action under `action`");
            return None;
        }
    };
    let mut sound = Some(kind);
    for (of, key, place) in maps {
        if let Some(place) = place
            && of != kind
        {
            let known = match kind {
                CallKind::Service => "`request` and `response` do",
                CallKind::Action => "`goal`, `feedback` and `result` do",
            };
            let message = format!("`{key}` cannot be combined with `{}`", kind.word());
            findings
                .error(Code::CallBinding, place, message)
                .help(known);
            sound = None;
        }
    }
    sound
}

fn name(
    entry: &CallBindingEntry,
    kind: CallKind,
    dialect: Dialect,
    findings: &mut MappingFindings,
) -> Option<(String, TextSpan)> {
    let named = match kind {
        CallKind::Service => &entry.service,
        CallKind::Action => &entry.action,
    };
    let (text, place) = given(named)?;
    ros_name(text, place, (dialect, kind.word()), findings)?;
    Some((text.clone(), place))
}

/// Reads a type name. `package/srv/Name` and `package/action/Name` are other spellings of
/// `package/Name`.
fn type_name(
    text: &str,
    kind: CallKind,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<(TypeName, TextSpan)> {
    let (name, example) = match kind {
        CallKind::Service => (services::type_name(text), "std_srvs/SetBool"),
        CallKind::Action => (
            text.replacen("/action/", "/", 1).parse().ok(),
            "nav2_msgs/NavigateToPose",
        ),
    };
    if name.is_none() {
        let message = format!("`{}` is not a {} type name", short(text), kind.word());
        findings
            .error(Code::MessageTypeName, place, message)
            .help(format!("give package and name, such as {example}"));
    }
    Some((name?, place))
}

/// Returns `None` for an unknown action type, which is noted.
fn action(
    name: &TypeName,
    (dialect, place): (Dialect, TextSpan),
    types: &mut MessageTypes,
    findings: &mut MappingFindings,
) -> Option<Arc<ActionCalls>> {
    let known = types.action((dialect, place), name, findings);
    if known.is_none() {
        let looked = types.looked(dialect);
        let built_in = if looked.is_empty() {
            " is built in"
        } else {
            ""
        };
        let message = format!("no definition of the action type `{name}`{built_in}");
        let folders = match dialect {
            Dialect::Ros1 => "ROS_PACKAGE_PATH",
            Dialect::Ros2 => "a prefix in AMENT_PREFIX_PATH",
        };
        findings
            .warning(Code::UnknownActionType, place, message)
            .help(format!(
                "add a package with its .action file to `type_paths` or below {folders} before the bridge \
                 starts; fields are checked then{looked}"
            ));
    }
    known
}

/// Reads a field map. `within` is the message of the call that contains the fields.
fn field_map(entry: &OptionalKey<FieldMapEntry>, within: &str) -> Option<(FieldMap, TextSpan)> {
    let (entry, place) = given(entry)?;
    let assigned = entry.0.iter().map(|(target, _, value)| Assignment {
        target: format!("{within}{target}"),
        value: match value {
            Assigned::Field(path) => Assigned::Field(format!("{within}{path}")),
            Assigned::Constant(literal) => Assigned::Constant(literal.clone()),
        },
    });
    Some((FieldMap(assigned.collect()), place))
}
