//! Variables: node, topic, name, type.

use std::collections::{HashMap, HashSet};
use std::num::NonZeroU16;
use std::ops::RangeInclusive;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use messages::{ArrayRank, Leaf};

use super::bindings::VariableBindings;
use super::nodes::{CheckedNamespaces, NAMESPACE_ZERO, Spaces, checked_name, node_id, space};
use super::servers::Servers;
use super::services::DocumentCalls;
use super::site::BoundVariable;
use super::types::{self, MessageTypes, ValueType};
use super::{alarm, confirm, loss, meaning, permissions, quality, remote, required};
use crate::code::Code;
use crate::document::{PublishEntry, Queue, UaFieldEntry, VariableEntry};
use crate::findings::MappingFindings;
use crate::mapping::{
    Binding, Lasting, Meaning, Overflow, Publish, ServiceBinding, ServiceRole, UaField, Variable,
};
use crate::node_id::{Identifier, NodeIdText};
use crate::permission::Permissions;
use crate::read::{Located, given, short};
use crate::topic::{SpaceId, TopicId};
use crate::tree::TextSpan;

/// Maximum number of variables of one document.
const MAX_VARIABLES: usize = 100_000;

/// Parts of an entry that could be read; the entry is a map.
struct Draft<'d> {
    entry: &'d VariableEntry,
    place: TextSpan,
    node: Option<(NodeIdText, TextSpan)>,
    origin: Option<SpaceId>,
    alias: Option<NonZeroU16>,
}

impl Draft<'_> {
    fn namespace(&self) -> Option<NonZeroU16> {
        let (node, _) = self.node.as_ref()?;
        Some(NonZeroU16::new(node.namespace).unwrap_or(NAMESPACE_ZERO))
    }

    fn topic(&self) -> Option<TopicId> {
        let (node, _) = self.node.as_ref()?;
        let identifier = node.writer_id().or(self.alias)?;
        Some(TopicId {
            space: self.origin?,
            namespace: self.namespace()?,
            identifier,
        })
    }
}

pub(super) fn check(
    entries: &[Located<VariableEntry>],
    (spaces, namespaces, servers): (&Spaces, &CheckedNamespaces, &Servers),
    types: &mut MessageTypes,
    findings: &mut MappingFindings,
) -> Vec<Variable> {
    if let Some(first) = entries.get(MAX_VARIABLES) {
        let message = format!(
            "{} variables; at most {MAX_VARIABLES} are read",
            entries.len()
        );
        findings.error(Code::TooLarge, first.place, message);
        return Vec::new();
    }
    let drafts: Vec<Draft<'_>> = entries
        .iter()
        .filter_map(|at| {
            Some(draft(
                at.value.as_ref()?,
                at.place,
                spaces,
                namespaces,
                findings,
            ))
        })
        .collect();
    aliases(&drafts, findings);
    unique(&drafts, findings);
    let calls = DocumentCalls::of(drafts.iter().filter_map(|draft| {
        let (node, _) = draft.node.as_ref()?;
        Some((node, draft.topic(), draft.entry.ros.as_ref()?))
    }));
    let mut bindings = VariableBindings::new(spaces, calls, types);
    let variables = drafts
        .iter()
        .filter_map(|draft| variable(draft, servers, &mut bindings, findings));
    let mut variables: Vec<Variable> = variables.collect();
    let entries = drafts
        .iter()
        .filter_map(|draft| Some((draft.topic()?, draft.entry)));
    confirm::check(entries.clone(), &mut variables, findings);
    alarm::check(entries.clone(), &mut variables, findings);
    loss::check(entries, &mut variables, bindings.types(), findings);
    // The list lives as long as the mapping.
    variables.shrink_to_fit();
    bindings.conflicts(findings);
    variables
}

fn draft<'d>(
    entry: &'d VariableEntry,
    place: TextSpan,
    spaces: &Spaces,
    namespaces: &CheckedNamespaces,
    findings: &mut MappingFindings,
) -> Draft<'d> {
    let node = required(&entry.node, "node", &title(entry), place, findings);
    let node = node.and_then(|(text, place)| node_id(text, place, namespaces, findings));
    let origin = required(&entry.origin, "origin", &title(entry), place, findings)
        .and_then(|(number, place)| space(*number, place, "origin", spaces, findings));
    let alias = given(&entry.alias).and_then(|(number, place)| {
        if *number == 0 {
            findings
                .error(Code::Alias, place, "0 is not an alias")
                .label("1 to 65535");
        }
        NonZeroU16::new(*number)
    });
    Draft {
        entry,
        place,
        node,
        origin,
        alias,
    }
}

/// Returns the name that findings use for a variable that lacks keys.
fn title(entry: &VariableEntry) -> String {
    match given(&entry.name).or_else(|| given(&entry.node)) {
        Some((text, _)) => format!("the variable `{}`", short(text)),
        None => "the variable".to_owned(),
    }
}

fn aliases(drafts: &[Draft<'_>], findings: &mut MappingFindings) {
    let used: HashSet<TopicId> = drafts.iter().filter_map(Draft::topic).collect();
    // The numbers that have not been proposed yet.
    let mut next: HashMap<(SpaceId, NonZeroU16), RangeInclusive<u16>> = HashMap::new();
    for draft in drafts {
        let Some((node, place)) = &draft.node else {
            continue;
        };
        if let Some(own) = node.writer_id() {
            if let Some((alias, place)) = given(&draft.entry.alias) {
                let message = format!("node `{node}` does not need an alias");
                let note = findings.error(Code::Alias, place, message);
                note.label(format!("{alias} would stand for {own}"))
                    .help("remove `alias`: the topic has the number of the node");
            }
            continue;
        }
        if draft.entry.alias.is_some() {
            continue;
        }
        let message = format!("node `{}` needs an alias", short(&node.to_string()));
        let note = findings
            .error(Code::AliasNeeded, *place, message)
            .label(why_alias(node));
        let free = draft
            .origin
            .zip(draft.namespace())
            .and_then(|(space, namespace)| {
                let next = next.entry((space, namespace)).or_insert(1..=u16::MAX);
                let topics = next.filter_map(NonZeroU16::new);
                let mut topics = topics.map(|identifier| TopicId {
                    space,
                    namespace,
                    identifier,
                });
                topics.find(|topic| !used.contains(topic))
            });
        note.help(match free {
            Some(topic) => {
                let alias = topic.identifier;
                format!("add `alias: {alias}`, which is free; the topic is then `{topic}`")
            }
            None => "add `alias:` and a number from 1 to 65535".to_owned(),
        });
    }
}

/// Returns why the identifier of a node cannot be the identifier of a topic.
fn why_alias(node: &NodeIdText) -> &'static str {
    match node.identifier {
        Identifier::Numeric(_) if node.namespace == 0 => "a node of namespace 0",
        Identifier::Numeric(0) => "0 is not the identifier of a topic",
        Identifier::Numeric(_) => "topics have numbers up to 65535",
        Identifier::String(_) => "topics have numbers, but this is a text",
        Identifier::Guid(_) => "topics have numbers, but this is a Guid",
        Identifier::Opaque(_) => "topics have numbers, but these are opaque bytes",
    }
}

fn unique(drafts: &[Draft<'_>], findings: &mut MappingFindings) {
    let mut nodes: HashMap<&NodeIdText, TextSpan> = HashMap::new();
    let mut topics: HashMap<TopicId, TextSpan> = HashMap::new();
    let mut names: HashMap<(u16, &str), TextSpan> = HashMap::new();
    for draft in drafts {
        let Some((node, place)) = &draft.node else {
            continue;
        };
        let text = node.to_string();
        if let Some((name, place)) = given(&draft.entry.name)
            && let Some(first) = names.insert((node.namespace, name), place)
        {
            let message = format!(
                "two variables of namespace {} are named `{}`",
                node.namespace,
                short(name)
            );
            let line = findings.line(first, place);
            let note = findings.warning(Code::NameTwice, place, message);
            note.label(format!("first at {line}"));
        }
        // Two variables of one node and one origin also share a topic: one finding is enough.
        if let Some(first) = nodes.insert(node, *place) {
            let line = findings.line(first, *place);
            let note = findings.error(
                Code::NodeTwice,
                *place,
                format!("node `{}` has two variables", short(&text)),
            );
            note.label(format!("first at {line}"))
                .help("a node has one origin: give one of the variables another node");
        } else if let Some(topic) = draft.topic()
            && let Some(first) = topics.insert(topic, *place)
        {
            let line = findings.line(first, *place);
            let place = draft
                .entry
                .alias
                .as_ref()
                .map_or(*place, |alias| alias.place);
            let note = findings.error(
                Code::TopicTwice,
                place,
                format!("`{topic}` is mapped twice"),
            );
            note.label(format!("first at {line}"))
                .help("give one of the two another alias");
        }
    }
}

/// Returns the reaction of a full queue, and how long a value is kept. Commands are events.
fn queue(entry: &VariableEntry, is_command: bool) -> Option<(Overflow, Lasting)> {
    let given = match given(&entry.queue) {
        Some((Queue::DropOldest(size), _)) => Overflow::DropOldest(NonZeroU16::new(*size)?),
        Some((Queue::KeepLatest, _)) => Overflow::KeepLatest,
        None if is_command => {
            return Some((Overflow::DropOldest(NonZeroU16::MIN), Lasting::Event));
        }
        None => return Some((Overflow::KeepLatest, Lasting::AsSource)),
    };
    Some((given, Lasting::from(given)))
}

fn variable(
    draft: &Draft<'_>,
    servers: &Servers,
    bindings: &mut VariableBindings<'_>,
    findings: &mut MappingFindings,
) -> Option<Variable> {
    let entry = draft.entry;
    let name = required(&entry.name, "name", &title(entry), draft.place, findings);
    let name = name.and_then(|(name, place)| checked_name(name, place, findings));
    let declared =
        given(&entry.r#type).and_then(|(text, place)| declared_type(text, place, findings));
    let subject = BoundVariable {
        topic: draft.topic(),
        origin: draft.origin,
        declared,
        type_faulty: entry.r#type.is_some() && declared.is_none(),
    };
    let bound = bindings.check(entry.ros.as_ref(), &subject, findings);
    let fields = bound
        .fields
        .unwrap_or_else(|| declared.map(only_field).into_iter().collect());
    let value_type = match fields.as_slice() {
        [one] => Some(declared.unwrap_or_else(|| types::value_type(one))),
        _ => declared,
    };
    let publish = publish(entry, (value_type, &fields), findings);
    let several = fields.len() > 1;
    let meaning = meaning::check(entry, (value_type, several), findings);
    let permissions = permissions::of_variable(&entry.permissions, draft.origin, findings);
    let ages = quality::check(entry, draft.origin, publish.as_ref(), findings);
    let service = bound
        .service
        .map(|service| Box::new(service.settled(value_type, findings)));
    let calls = service
        .as_ref()
        .is_some_and(|service| matches!(service.role, ServiceRole::Call { .. }));
    let is_command = calls || draft.origin == Some(SpaceId::UA);
    let (overflow, lasting) = queue(entry, is_command)?;
    let ua_field = ua_field(
        draft,
        &bound.bindings,
        (service.as_deref(), fields.len()),
        findings,
    );
    let is_origin = |space: SpaceId| draft.origin == Some(space);
    let subject = remote::RemoteVariable {
        origin: draft.origin,
        node: draft.node.as_ref().map(|(node, _)| node),
        single: !several,
        value_type,
        produced: service
            .as_ref()
            .is_some_and(|service| is_origin(service.space)),
    };
    let remote = remote::check(entry, &subject, servers, findings);
    let (node, _) = draft.node.clone()?;
    let topic = draft.topic()?;
    let (from, to) = remote?;
    Some(Variable {
        topic,
        node,
        name: name?,
        value_type,
        fields,
        ua_field: ua_field?,
        bindings: bound.bindings,
        service,
        overflow,
        lasting,
        publish: publish?,
        meaning: shared(meaning?, &NO_MEANING),
        permissions: shared(permissions?, &DEFAULT_ROLES),
        ages: ages?,
        alarm: None,
        reports_alarms: false,
        history: given(&entry.history).map(|(count, _)| *count),
        loss: None,
        confirm: None,
        confirmed_within: None,
        from,
        to,
    })
}

/// Returns the field that is the value in the DataSet of a publisher that is not a bridge. `None`
/// for a fault, which is noted.
fn ua_field(
    draft: &Draft<'_>,
    bindings: &[Binding],
    (service, fields): (Option<&ServiceBinding>, usize),
    findings: &mut MappingFindings,
) -> Option<Option<UaField>> {
    let Some(at) = &draft.entry.ua_field else {
        return Some(None);
    };
    let UaFieldEntry(field) = at.value.as_ref()?;
    let is_origin = |space: SpaceId| draft.origin == Some(space);
    let produced = bindings.iter().any(|binding| is_origin(binding.space))
        || service.is_some_and(|service| is_origin(service.space));
    let fault = if fields > 1 {
        Some((
            format!("`ua_field` selects one field, but this variable has {fields}"),
            "bind one `field` of the message, or remove `ua_field`",
        ))
    } else if produced {
        Some((
            "the value comes from a bridge, which sends no other fields with it".to_owned(),
            "remove `ua_field`; it is for publishers other than bridges",
        ))
    } else {
        None
    };
    if let Some((message, help)) = fault {
        findings.error(Code::UaField, at.place, message).help(help);
        return None;
    }
    Some(Some(field.clone()))
}

/// Returns `None` for a faulty entry, which is noted.
fn publish(
    entry: &VariableEntry,
    (value_type, fields): (Option<ValueType>, &[Leaf]),
    findings: &mut MappingFindings,
) -> Option<Publish> {
    let mut on_change = matches!(given(&entry.publish), Some((PublishEntry::OnChange, _)));
    let (mut deadband, mut sound) = (0.0, Some(()));
    if let Some((width, place)) = given(&entry.deadband) {
        (deadband, on_change) = (*width, true);
        let fault = if *width <= 0.0 || !width.is_finite() {
            Some((
                format!("a deadband of {width}"),
                "give a number above 0, in the unit of the value",
            ))
        } else if value_type.is_some_and(|(builtin, _)| !builtin.is_number()) {
            let told = value_type.map(types::print).unwrap_or_default();
            Some((
                format!("a deadband requires numbers, but this is {told}"),
                "use `publish: on_change`, which works with all values",
            ))
        } else if fields.len() > 1 && !fields.iter().any(|leaf| leaf.builtin.is_number()) {
            Some((
                "a deadband requires numbers, but no field is a number".to_owned(),
                "use `publish: on_change`, which works with all values",
            ))
        } else if matches!(given(&entry.publish), Some((PublishEntry::Always, _))) {
            Some((
                "a deadband suppresses values, but `publish: always` sends every value".to_owned(),
                "remove one of them",
            ))
        } else {
            None
        };
        if let Some((message, help)) = fault {
            findings.error(Code::Publish, place, message).help(help);
            sound = None;
        }
    }
    let mut period = Duration::ZERO;
    if let Some((text, place)) = given(&entry.at_most) {
        match rate(text) {
            Some(found) => period = found,
            None => {
                let message = format!("`{}` is not a rate", short(text));
                findings
                    .error(Code::Publish, place, message)
                    .help("give 0.001 Hz to 1000 Hz, such as 10 Hz");
                sound = None;
            }
        }
    }
    sound.map(|()| Publish::new(on_change, deadband, period))
}

/// Reads a rate such as `10 Hz` and returns its period.
fn rate(text: &str) -> Option<Duration> {
    let number = text.strip_suffix("Hz")?.trim_end();
    let rate: f64 = number.parse().ok()?;
    (0.001..=1000.0)
        .contains(&rate)
        .then(|| Duration::from_secs_f64(1.0 / rate))
}

/// Returns the field of the std_msgs type of a value.
fn only_field((builtin, array): ValueType) -> Leaf {
    let rank = if array {
        ArrayRank::Array { fixed: None }
    } else {
        ArrayRank::Scalar
    };
    Leaf {
        path: "data".to_owned(),
        builtin,
        rank,
    }
}

fn declared_type(text: &str, place: TextSpan, findings: &mut MappingFindings) -> Option<ValueType> {
    let declared = types::parse_value_type(text);
    if declared.is_none() {
        let message = format!("`{}` is not an OPC UA builtin type", short(text));
        let note = findings.error(Code::ValueType, place, message);
        let ros = text
            .contains('/')
            .then(|| "move a ROS type to the binding under `ros`".to_owned());
        let brackets = if text.contains('[') { "[]" } else { "" };
        let near = types::suggest_value_type(text);
        let near = near.map(|near| format!("did you mean `{near}{brackets}`?"));
        note.help(
            ros.or(near).unwrap_or_else(|| {
                "use a type such as Boolean, Int32, Double[] or String".to_owned()
            }),
        );
    }
    declared
}

/// Returns the value in an `Arc`. Variables with the default share one allocation.
fn shared<T: PartialEq>(value: T, default: &LazyLock<Arc<T>>) -> Arc<T> {
    match value == ***default {
        true => Arc::clone(default),
        false => Arc::new(value),
    }
}

static NO_MEANING: LazyLock<Arc<Meaning>> = LazyLock::new(Arc::default);
static DEFAULT_ROLES: LazyLock<Arc<Permissions>> = LazyLock::new(Arc::default);
