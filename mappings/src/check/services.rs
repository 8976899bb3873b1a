//! Service bindings: the service, its request, and the part of the response that is a value.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use messages::{
    Dialect, Leaf, Literal, MessagePlan, MessageType, PlanError, Selected, Selection, ServiceType,
    TextKind, TypeName, Wire,
};
use uadp::BuiltinType;

use super::quantity::duration;
use super::selection::{self, SelectionKeys};
use super::several;
use super::shaping::ValueDirection;
use super::site::{BindingSite, compare, ros_name};
use super::types::{self, MessageTypes, ValueType, told};
use crate::code::Code;
use crate::document::{self, BindingEntry, Request};
use crate::findings::MappingFindings;
use crate::mapping::{ServiceBinding, ServiceRole, Trigger};
use crate::node_id::NodeIdText;
use crate::read::{Located, OptionalKey, given, short};
use crate::topic::{SpaceId, TopicId};
use crate::tree::TextSpan;
use documents::nearest;

const TIMEOUT: Duration = Duration::from_secs(5);
const EVERY: Duration = Duration::from_secs(1);

/// Kind of a binding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BindingKind {
    Topic,
    Call,
    Answer,
    Poll,
}

impl BindingKind {
    const fn key(self) -> &'static str {
        match self {
            Self::Topic => "topic",
            Self::Call => "call",
            Self::Answer => "answer",
            Self::Poll => "poll",
        }
    }
}

/// A service binding, with the parts that are known.
pub(super) struct CheckedService {
    pub(super) binding: ServiceBinding,
    /// `None` if the type of the service is not known or no value crosses.
    pub(super) fields: Option<Vec<Leaf>>,
    place: TextSpan,
    /// The literal of `when`.
    when: Option<(String, TextSpan)>,
}

impl CheckedService {
    /// Notes values of the variable's topics that differ in type from the values of the service.
    pub(super) fn compare(&self, topics: &[Leaf], own: &[Leaf], findings: &mut MappingFindings) {
        let shape =
            |fields: &[Leaf]| -> Vec<ValueType> { fields.iter().map(types::value_type).collect() };
        if shape(topics) == shape(own) {
            return;
        }
        let told = |fields: &[Leaf]| match fields {
            [one] => types::print(types::value_type(one)),
            several => format!("{} fields", several.len()),
        };
        let message = format!(
            "the value is {} in the topic it is bound to, but {} in the service",
            told(topics),
            told(own)
        );
        findings
            .error(Code::BindingsDiffer, self.place, message)
            .help("bind fields of one type on both sides");
    }

    /// Returns the binding with the trigger of its call, which depends on the type of the value.
    pub(super) fn settled(
        mut self,
        value_type: Option<ValueType>,
        findings: &mut MappingFindings,
    ) -> ServiceBinding {
        if let ServiceRole::Call {
            request: Selection::Template { fields, .. },
            when,
            ..
        } = &mut self.binding.role
            && fields.is_empty()
        {
            *when = match (self.when, value_type) {
                (Some((text, place)), value_type) => {
                    if let Some(value_type) = value_type {
                        findings.of_part([self.binding.space]);
                        check_when(&text, value_type, (self.binding.space, place), findings);
                        findings.of_part(None);
                    }
                    Trigger::Equals(text)
                }
                (None, Some((BuiltinType::Boolean, false))) => Trigger::Equals("true".to_owned()),
                (None, _) => Trigger::Any,
            };
        }
        self.binding
    }
}

/// Checks `when`. The value is compared with the text as the std_msgs type of the variable's
/// `type`, so the text has to be a value of this type.
fn check_when(
    text: &str,
    value_type: ValueType,
    (space, place): (SpaceId, TextSpan),
    findings: &mut MappingFindings,
) {
    let dialect = types::dialect(space);
    let registry = MessageTypes::registry(dialect);
    let carrier = registry.standard_type(value_type.0, value_type.1);
    let carrier = carrier.and_then(|name| registry.get(&name).ok());
    let data = ("data".to_owned(), Literal::One(text.to_owned()));
    let template = Selection::Template {
        fields: Vec::new(),
        rest: BTreeMap::from([data]),
    };
    let fits = |carrier| MessagePlan::compile(&carrier, &template, wire(dialect)).is_ok();
    if !carrier.is_some_and(fits) {
        let told = types::print(value_type);
        let message = format!("`{}` is not a value of type {told}", short(text));
        findings
            .error(Code::When, place, message)
            .help("use a Boolean, number or text of the type of the variable");
    }
}

/// Calls of a document, by the node of their variable.
pub(super) struct DocumentCalls(HashMap<NodeIdText, Call>);

struct Call {
    /// `None` if a part of the variable is faulty.
    topic: Option<TopicId>,
    service_type: Option<TypeName>,
}

impl DocumentCalls {
    pub(super) fn of<'d>(
        variables: impl Iterator<
            Item = (
                &'d NodeIdText,
                Option<TopicId>,
                &'d Located<document::Bindings>,
            ),
        >,
    ) -> Self {
        let calls = variables.filter_map(|(node, topic, bindings)| {
            let bindings = bindings.value.as_ref().map_or(&[][..], |all| &all.0);
            let mut entries = bindings.iter().filter_map(|at| at.value.as_ref());
            let entry = entries.find(|entry| entry.call.is_some())?;
            let named = given(&entry.r#type);
            let service_type = named.and_then(|(text, _)| type_name(text));
            Some((
                node.clone(),
                Call {
                    topic,
                    service_type,
                },
            ))
        });
        Self(calls.collect())
    }
}

/// Context that bindings are checked against.
pub(super) struct ServiceContext<'k> {
    pub(super) types: &'k mut MessageTypes,
    pub(super) calls: &'k DocumentCalls,
}

/// Reads a type name. `package/srv/Name` is another spelling of `package/Name`.
pub(super) fn type_name(text: &str) -> Option<TypeName> {
    text.replacen("/srv/", "/", 1).parse().ok()
}

/// Returns `None` if the binding is not exactly one of the kinds, which is noted. Keys of other
/// kinds are noted too.
pub(super) fn kind(
    entry: &BindingEntry,
    owner: TextSpan,
    findings: &mut MappingFindings,
) -> Option<BindingKind> {
    let keys = [
        (BindingKind::Topic, &entry.topic),
        (BindingKind::Call, &entry.call),
        (BindingKind::Answer, &entry.answer),
        (BindingKind::Poll, &entry.poll),
    ];
    let mut said = keys
        .iter()
        .filter_map(|(kind, key)| Some((*kind, key.as_ref()?.place)));
    let Some((kind, _)) = said.next() else {
        findings
            .error(Code::MissingKey, owner, "the binding has no `topic`")
            .help("add a topic, or a service under `call`, `answer` or `poll`");
        return None;
    };
    if let Some((other, place)) = said.next() {
        let (kind, other) = (kind.key(), other.key());
        let message = format!("a binding has `{kind}` or `{other}`, not both");
        findings.error(Code::BindingKind, place, message).help(
            "a variable has one binding per space: add a second variable for the other binding",
        );
        return None;
    }
    let place = |at: &OptionalKey<String>| at.as_ref().map(|at| at.place);
    let (call, poll) = (kind == BindingKind::Call, kind == BindingKind::Poll);
    let topic = kind == BindingKind::Topic;
    let request = entry.request.as_ref().map(|at| at.place);
    let r#as = entry.r#as.as_ref().map(|at| at.place);
    let strange = [
        ("type", place(&entry.r#type), kind == BindingKind::Answer),
        ("as", r#as, !topic),
        ("request", request, !call && !poll),
        ("when", place(&entry.when), !call),
        ("timeout", place(&entry.timeout), !call && !poll),
        ("every", place(&entry.every), !poll),
    ];
    let mut sound = Some(kind);
    for (key, place, refused) in strange {
        if let (Some(place), true) = (place, refused) {
            let message = format!("`{key}` cannot be combined with `{}`", kind.key());
            findings.error(Code::BindingKind, place, message);
            sound = None;
        }
    }
    sound
}

/// Returns `None` for a faulty binding.
pub(super) fn check(
    kind: BindingKind,
    entry: &BindingEntry,
    site: &BindingSite<'_>,
    known: &mut ServiceContext<'_>,
    findings: &mut MappingFindings,
) -> Option<CheckedService> {
    let space = space_of(kind, site, findings);
    let checked = match kind {
        BindingKind::Answer => answer(entry, site, known, findings),
        BindingKind::Topic | BindingKind::Call | BindingKind::Poll => {
            asked(kind, entry, site, known.types, findings)
        }
    };
    let (role, fields, when) = checked?;
    Some(CheckedService {
        binding: ServiceBinding {
            space: space?,
            role,
        },
        fields,
        place: site.place,
        when,
    })
}

type Checked = (ServiceRole, Option<Vec<Leaf>>, Option<(String, TextSpan)>);

/// Returns the space of the service, if a service can be bound there.
fn space_of(
    kind: BindingKind,
    site: &BindingSite<'_>,
    findings: &mut MappingFindings,
) -> Option<SpaceId> {
    let (space, origin) = (site.space?, site.subject.origin);
    let (message, help) = if kind == BindingKind::Call && origin == Some(space) {
        (
            format!(
                "the value comes from space {space}, so it cannot call a service of this space"
            ),
            "`call` requires a value of another space; use `poll` for a value that the service returns",
        )
    } else if kind != BindingKind::Call && origin.is_some_and(|origin| origin != space) {
        (
            format!("the response of a service of space {space} is a value of this space"),
            "set `origin` to the space of the service",
        )
    } else {
        return Some(space);
    };
    findings
        .error(Code::ServiceSpace, site.place, message)
        .help(help);
    None
}

fn answer(
    entry: &BindingEntry,
    site: &BindingSite<'_>,
    known: &mut ServiceContext<'_>,
    findings: &mut MappingFindings,
) -> Option<Checked> {
    let (text, place) = given(&entry.answer)?;
    let Ok(node) = text.parse::<NodeIdText>() else {
        let message = format!("`{}` is not a node id", short(text));
        findings
            .error(Code::NodeId, place, message)
            .help("give the node of the variable with the `call`, such as ns=2;i=20");
        return None;
    };
    let Some(call) = known.calls.0.get(&node) else {
        let message = format!("no variable with a `call` has the node `{}`", short(text));
        findings
            .error(Code::Answer, place, message)
            .help("give the node of the variable with the values that call the service");
        return None;
    };
    let service = call.service_type.as_ref().and_then(|name| {
        known
            .types
            .service((site.dialect(), site.place), name, findings)
    });
    let response = service.as_ref().map(|service| service.response());
    let (selection, fields) = response_field(entry, response, place, site, findings)?;
    let of = call.topic?;
    Some((ServiceRole::Answer { of, selection }, fields, None))
}

/// Checks a call or a poll.
fn asked(
    kind: BindingKind,
    entry: &BindingEntry,
    site: &BindingSite<'_>,
    types: &mut MessageTypes,
    findings: &mut MappingFindings,
) -> Option<Checked> {
    let name = if kind == BindingKind::Call {
        &entry.call
    } else {
        &entry.poll
    };
    let service = given(name).and_then(|(text, place)| {
        ros_name(text, place, (site.dialect(), "service"), findings)?;
        Some(text.clone())
    });
    let timeout = duration(&entry.timeout, findings).unwrap_or(TIMEOUT);
    let every = duration(&entry.every, findings).unwrap_or(EVERY);
    let (service_type, place) = service_type(entry, kind, site.place, findings)?;
    let dialect = site.dialect();
    let known = built_in(&service_type, (dialect, place), types, findings);
    let request_type = known.as_ref().map(|service| service.request());
    if kind == BindingKind::Call {
        let chosen = SelectionKeys::from(entry);
        let way = ValueDirection {
            reads: false,
            declared: site.subject.declared,
            alone: true,
        };
        let (mut taken, mut fields) = (Vec::new(), None);
        if chosen.names_fields() {
            let at = (chosen.place().unwrap_or(place), way);
            let known = request_type.map(|request| &**request);
            taken = several::selected(chosen.selection(known, at, findings)?)?;
            if let Some(request) = request_type {
                let found = several::leaves(request, &taken, at, findings)?;
                compare(&found, request.name(), site.subject, at.0, findings);
                fields = Some(found);
            }
            if let Some(at) = &entry.when {
                let message = "`when` cannot be combined with `field`: each value is sent";
                findings
                    .error(Code::When, at.place, message)
                    .help("remove `field` to send the same request each time");
            }
        } else {
            chosen.converts_nothing(findings)?;
        }
        let when = given(&entry.when).map(|(text, place)| (text.clone(), place));
        let request = template(entry, taken, (dialect, request_type), findings)?;
        let role = ServiceRole::Call {
            service: service?,
            service_type,
            request,
            when: Trigger::Any,
            timeout,
        };
        return Some((role, fields, when));
    }
    let request = template(entry, Vec::new(), (dialect, request_type), findings);
    let response = known.as_ref().map(|service| service.response());
    let (selection, fields) = response_field(entry, response, place, site, findings)?;
    let role = ServiceRole::Poll {
        service: service?,
        service_type,
        request: request?,
        selection,
        every,
        timeout,
    };
    Some((role, fields, None))
}

fn service_type(
    entry: &BindingEntry,
    kind: BindingKind,
    owner: TextSpan,
    findings: &mut MappingFindings,
) -> Option<(TypeName, TextSpan)> {
    let Some(at) = &entry.r#type else {
        let message = format!("the binding has a `{}` and no `type`", kind.key());
        findings
            .error(Code::MissingKey, owner, message)
            .help("give the type of the service, such as std_srvs/SetBool");
        return None;
    };
    let text = at.value.as_ref()?;
    let name = type_name(text);
    if name.is_none() {
        let message = format!("`{}` is not a service type name", short(text));
        findings
            .error(Code::MessageTypeName, at.place, message)
            .help("give package and name, such as std_srvs/SetBool");
    }
    Some((name?, at.place))
}

/// Returns the service type; `None` for an unknown type, which is noted.
pub(super) fn built_in(
    name: &TypeName,
    (dialect, place): (Dialect, TextSpan),
    types: &mut MessageTypes,
    findings: &mut MappingFindings,
) -> Option<Arc<ServiceType>> {
    let known = types.service((dialect, place), name, findings);
    if known.is_none() {
        let looked = types.looked(dialect);
        let built_in = if looked.is_empty() {
            " is built in"
        } else {
            ""
        };
        let message = format!("no definition of the service type `{name}`{built_in}");
        let note = findings.warning(Code::UnknownServiceType, place, message);
        note.help_with(|| {
            let folders = match dialect {
                Dialect::Ros1 => "ROS_PACKAGE_PATH",
                Dialect::Ros2 => "a prefix in AMENT_PREFIX_PATH",
            };
            let why = format!(
                "add a package with its .srv file to `type_paths` or below {folders} before the bridge \
                 starts; fields are checked then{looked}"
            );
            match types.suggest(dialect, TextKind::Service, name) {
                Some(near) => format!("did you mean `{near}`? If not: {why}"),
                None => why,
            }
        });
    }
    known
}

pub(super) const fn wire(dialect: Dialect) -> Wire {
    match dialect {
        Dialect::Ros1 => Wire::Ros1,
        Dialect::Ros2 => Wire::Cdr,
    }
}

/// Returns the part of the response that is the value, and its fields if the type is known.
fn response_field(
    entry: &BindingEntry,
    response: Option<&Arc<MessageType>>,
    place: TextSpan,
    site: &BindingSite<'_>,
    findings: &mut MappingFindings,
) -> Option<(Selection, Option<Vec<Leaf>>)> {
    let chosen = SelectionKeys::from(entry);
    let way = ValueDirection {
        reads: true,
        declared: site.subject.declared,
        alone: true,
    };
    let at = (chosen.place().unwrap_or(place), way);
    let Some(response) = response else {
        let selection = chosen.selection(None, at, findings)?;
        return Some((selection, None));
    };
    if response.leaves().is_empty() {
        let message = format!("`{}` has no field, so it has no value", response.name());
        findings.error(Code::UnknownField, at.0, message);
        return None;
    }
    let selection = chosen.selection(Some(&**response), at, findings)?;
    let fields = selection::leaves(response, &selection, at, findings)?;
    compare(&fields, response.name(), site.subject, at.0, findings);
    Some((selection, Some(fields)))
}

/// Returns `true` if `path` is the field `field`, or a field of the message `field`.
fn takes(field: &str, path: &str) -> bool {
    path.strip_prefix(field)
        .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

/// Returns the request with its constants, each checked if its type is known.
fn template(
    entry: &BindingEntry,
    fields: Vec<Selected>,
    (dialect, request): (Dialect, Option<&Arc<MessageType>>),
    findings: &mut MappingFindings,
) -> Option<Selection> {
    let constants = match &entry.request {
        None => &[][..],
        Some(at) => at.value.as_ref().map(|Request(all)| all.as_slice())?,
    };
    let mut rest = BTreeMap::new();
    let mut sound = true;
    for (path, place, literal) in constants {
        let fault = if rest.insert(path.clone(), literal.clone()).is_some() {
            Some((format!("field `{}` is given twice", short(path)), None))
        } else if fields.iter().any(|one| takes(&one.field, path)) {
            let message = format!("field `{}` already takes the value", short(path));
            Some((message, Some("remove it from `request`".to_owned())))
        } else {
            request.and_then(|request| {
                let one = Selection::Template {
                    fields: Vec::new(),
                    rest: BTreeMap::from([(path.clone(), literal.clone())]),
                };
                let error = MessagePlan::compile(request, &one, wire(dialect)).err()?;
                Some(told_fault(path, error))
            })
        };
        if let Some((message, help)) = fault {
            sound = false;
            let note = findings.error(Code::RequestConstant, *place, message);
            if let Some(help) = help {
                note.help(help);
            }
        }
    }
    sound.then_some(Selection::Template { fields, rest })
}

/// Returns message and help.
fn told_fault(path: &str, error: PlanError) -> (String, Option<String>) {
    match error {
        PlanError::UnknownField { name, known, .. } => {
            let known: Vec<&str> = known.iter().map(String::as_str).collect();
            let near = nearest(path, known.iter().copied());
            let near = near.map(|near| format!("did you mean `{near}`? "));
            let help = format!(
                "{}its fields are {}",
                near.unwrap_or_default(),
                told(&known)
            );
            let message = format!("`{name}` has no field `{}`", short(path));
            (message, Some(help))
        }
        PlanError::Wire { .. }
        | PlanError::Shape { .. }
        | PlanError::Constant { .. }
        | PlanError::ConstantFault { .. }
        | PlanError::ConstantOfField { .. } => (error.to_string(), None),
    }
}
