//! ROS bindings: topic, type and field of each binding, and conflicts between bindings.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use messages::{DefinitionError, Dialect, Leaf, MessageType, Selection, TextKind, TypeName};

use super::nodes::{Spaces, space};
use super::required;
use super::selection::{self, SelectionKeys};
use super::services::{self, BindingKind, CheckedService, DocumentCalls, ServiceContext};
use super::several;
use super::shaping::ValueDirection;
use super::site::{BindingSite, BoundVariable, compare, ros, ros_name};
use super::types::{self, MessageTypes, ValueType, dialect, told};
use crate::code::Code;
use crate::document::{self, BindingEntry};
use crate::findings::MappingFindings;
use crate::mapping::Binding;
use crate::read::{Located, short};
use crate::topic::{SpaceId, TopicId};
use crate::tree::TextSpan;

pub(super) struct Bound {
    pub(super) bindings: Vec<Binding>,
    /// `None` if the type of no binding is known.
    pub(super) fields: Option<Vec<Leaf>>,
    pub(super) service: Option<CheckedService>,
}

/// A binding, with the parts that are known.
struct ReadBinding {
    binding: Binding,
    place: TextSpan,
    fields: Option<Vec<Leaf>>,
}

/// Use of one ROS topic of one space by a variable.
struct Use {
    place: TextSpan,
    reads: bool,
    message_type: TypeName,
}

pub(super) struct VariableBindings<'c> {
    spaces: &'c Spaces,
    types: &'c mut MessageTypes,
    calls: DocumentCalls,
    uses: HashMap<(SpaceId, String), Vec<Use>>,
    /// Topics in the order of the document, so that findings have this order too.
    order: Vec<(SpaceId, String)>,
}

impl<'c> VariableBindings<'c> {
    pub(super) fn new(
        spaces: &'c Spaces,
        calls: DocumentCalls,
        types: &'c mut MessageTypes,
    ) -> Self {
        Self {
            spaces,
            calls,
            types,
            uses: HashMap::new(),
            order: Vec::new(),
        }
    }

    /// Returns the types that bindings name.
    pub(super) const fn types(&mut self) -> &mut MessageTypes {
        self.types
    }

    pub(super) fn check(
        &mut self,
        entries: Option<&Located<document::Bindings>>,
        subject: &BoundVariable,
        findings: &mut MappingFindings,
    ) -> Bound {
        let mut found: Vec<ReadBinding> = Vec::new();
        let mut service: Option<CheckedService> = None;
        let mut spaces: HashMap<SpaceId, TextSpan> = HashMap::new();
        let entries = entries
            .and_then(|at| at.value.as_ref())
            .map_or(&[][..], |bindings| &bindings.0);
        for at in entries {
            let Some(entry) = &at.value else { continue };
            let (space, place) = self.space(entry, at.place, subject, findings);
            if let Some(space) = space
                && let Some(first) = spaces.insert(space, place)
            {
                let line = findings.line(first, place);
                let message = format!("the variable is bound twice in space {space}");
                let note = findings
                    .error(Code::BindingTwice, place, message)
                    .label(format!("first at {line}"));
                note.help(
                    "a variable has one topic per space: add a second variable for the other topic",
                );
                continue;
            }
            let site = BindingSite {
                place: at.place,
                space,
                subject,
            };
            findings.of_part(space);
            match services::kind(entry, at.place, findings) {
                Some(BindingKind::Topic) => found.extend(self.binding(entry, &site, findings)),
                Some(kind) => {
                    let mut known = ServiceContext {
                        types: self.types,
                        calls: &self.calls,
                    };
                    let checked = services::check(kind, entry, &site, &mut known, findings);
                    service = checked.or(service);
                }
                None => {}
            }
        }
        differences(&found, findings);
        findings.of_part(None);
        for one in &found {
            self.note_use(one, subject);
        }
        // The binding in the variable's origin decides its fields.
        let own = found
            .iter()
            .filter(|one| Some(one.binding.space) == subject.origin);
        let topics = own.chain(&found).find_map(|one| one.fields.clone());
        let services = service.as_ref().and_then(|service| service.fields.clone());
        if let (Some(topics), Some(services), Some(service)) = (&topics, &services, &service) {
            let spaces = found.iter().map(|one| one.binding.space);
            findings.of_part(spaces.chain([service.binding.space]));
            service.compare(topics, services, findings);
            findings.of_part(None);
        }
        let fields = match &service {
            Some(service) if Some(service.binding.space) == subject.origin => services.or(topics),
            Some(_) | None => topics.or(services),
        };
        let mut bindings: Vec<Binding> = found.into_iter().map(|one| one.binding).collect();
        // The list lives as long as the mapping.
        bindings.shrink_to_fit();
        Bound {
            bindings,
            fields,
            service,
        }
    }

    fn space(
        &self,
        entry: &BindingEntry,
        owner: TextSpan,
        subject: &BoundVariable,
        findings: &mut MappingFindings,
    ) -> (Option<SpaceId>, TextSpan) {
        let Some(at) = &entry.space else {
            if subject.origin == Some(SpaceId::UA) {
                let note = findings.error(Code::MissingKey, owner, "the binding has no `space`");
                note.help("the value comes from the OPC UA side, which has no ROS topics: give the `space` \
                           of the topic");
                return (None, owner);
            }
            return (subject.origin, owner);
        };
        let number = at.value;
        let space =
            number.and_then(|number| space(number, at.place, "space", self.spaces, findings));
        if space == Some(SpaceId::UA) {
            let note = findings.error(
                Code::OpcUaBinding,
                at.place,
                "space 0 is the OPC UA side and has no ROS topics",
            );
            note.help("remove the binding: the server shows every variable under its node");
            return (None, at.place);
        }
        (space, at.place)
    }

    /// Returns `None` if a part of the binding is faulty. Without a space, only parts that need
    /// none are checked.
    fn binding(
        &mut self,
        entry: &BindingEntry,
        site: &BindingSite<'_>,
        findings: &mut MappingFindings,
    ) -> Option<ReadBinding> {
        let topic = required(&entry.topic, "topic", "the binding", site.place, findings);
        let topic = topic.and_then(|(text, place)| topic_name(text, place, site, findings));
        let named = self.type_name(entry, site, findings);
        let (name, place) = named?;
        let space = site.space?;
        let message_type = self.message_type(&name, place, site, findings);
        let chosen = SelectionKeys::from(entry);
        let place = chosen.place().unwrap_or(place);
        let way = ValueDirection {
            // If no origin is known, that is the finding.
            reads: site.subject.origin.is_none_or(|origin| origin == space),
            declared: site.subject.declared,
            alone: true,
        };
        let selection = chosen.selection(message_type.as_deref(), (place, way), findings)?;
        let fields = match message_type {
            Some(known) => Some(selection::leaves(
                &known,
                &selection,
                (place, way),
                findings,
            )?),
            None => (selection == Selection::Bytes).then(|| vec![Leaf::bytes()]),
        };
        if let Some(fields) = &fields {
            compare(fields, &name, site.subject, place, findings);
        }
        let (ros_topic, place) = topic?;
        let binding = Binding {
            space,
            ros_topic,
            message_type: name,
            selection,
        };
        Some(ReadBinding {
            binding,
            place,
            fields,
        })
    }

    fn type_name(
        &self,
        entry: &BindingEntry,
        site: &BindingSite<'_>,
        findings: &mut MappingFindings,
    ) -> Option<(TypeName, TextSpan)> {
        if let Some(at) = &entry.r#type {
            let text = at.value.as_ref()?;
            let name = text.parse().ok();
            if name.is_none() {
                let message = format!("`{}` is not a message type name", short(text));
                findings
                    .error(Code::MessageTypeName, at.place, message)
                    .help("give package and name, such as std_msgs/Bool");
            }
            return Some((name?, at.place));
        }
        let Some((builtin, array)) = site.subject.declared else {
            if !site.subject.type_faulty {
                let note =
                    findings.error(Code::MissingKey, site.place, "the binding has no `type`");
                note.help("give the ROS message type, such as std_msgs/Bool; or give the variable a `type`");
            }
            return None;
        };
        let name = MessageTypes::registry(dialect(site.space?)).standard_type(builtin, array);
        if name.is_none() {
            let message = format!(
                "the binding has no `type`, and no type of std_msgs holds {}",
                types::print((builtin, array))
            );
            findings
                .error(Code::MissingKey, site.place, message)
                .help("give the ROS message type, and the field if the type has several");
        }
        Some((name?, site.place))
    }

    /// Returns `None` for an unknown type, which is noted.
    fn message_type(
        &mut self,
        name: &TypeName,
        place: TextSpan,
        site: &BindingSite<'_>,
        findings: &mut MappingFindings,
    ) -> Option<Arc<MessageType>> {
        let space = site.space?;
        let dialect = dialect(space);
        let error = match self.types.get((dialect, place), name, findings) {
            Ok(message_type) => return Some(message_type),
            Err(error) => error,
        };
        let looked = self.types.looked(dialect);
        let built_in = if looked.is_empty() {
            " is built in"
        } else {
            ""
        };
        let message = match &*error {
            DefinitionError::Unknown {
                needed_by: None, ..
            } => {
                format!("no definition of `{name}`{built_in} for {}", ros(dialect))
            }
            DefinitionError::Unknown { .. }
            | DefinitionError::Cyclic { .. }
            | DefinitionError::TooDeep { .. }
            | DefinitionError::TooBig { .. }
            | DefinitionError::OtherHash { .. }
            | DefinitionError::Syntax { .. } => error.to_string(),
        };
        // The publisher of a topic that is read can provide the definition. If the origin is not
        // known, the topic may be one that is read.
        let read = site.subject.origin.is_none_or(|origin| origin == space);
        let (note, why) = if read {
            let why = match dialect {
                Dialect::Ros1 => {
                    "the connection header of the publisher contains the definition; the field is checked then"
                }
                Dialect::Ros2 => {
                    "the node of the publisher may describe the type (ROS 2 Iron and later), and the field \
                     is checked then; to be sure, add a package with its .msg file to `type_paths` or \
                     AMENT_PREFIX_PATH"
                }
            };
            (
                findings.warning(Code::UnknownMessageType, place, message),
                why,
            )
        } else {
            let why = match dialect {
                Dialect::Ros1 => {
                    "a type that is written to ROS 1 needs a definition: add a folder with its .msg file to \
                     `type_paths`"
                }
                Dialect::Ros2 => {
                    "a type that is written to ROS 2 needs a definition: add a folder with its .msg file to \
                     `type_paths`"
                }
            };
            (
                findings.error(Code::UnknownMessageType, place, message),
                why,
            )
        };
        let types = &mut *self.types;
        // The unknown type may be a field's type, inside of the type of the binding.
        let unknown = match &*error {
            DefinitionError::Unknown { name, .. } => name,
            DefinitionError::Cyclic { .. }
            | DefinitionError::TooDeep { .. }
            | DefinitionError::TooBig { .. }
            | DefinitionError::OtherHash { .. }
            | DefinitionError::Syntax { .. } => name,
        };
        note.help_with(
            || match types.suggest(dialect, TextKind::Message, unknown) {
                Some(near) => format!("did you mean `{near}`? If not: {why}{looked}"),
                None => format!("{why}{looked}"),
            },
        );
        None
    }

    fn note_use(&mut self, found: &ReadBinding, subject: &BoundVariable) {
        let Some(origin) = subject.origin else { return };
        let Binding {
            space,
            ros_topic,
            message_type,
            ..
        } = &found.binding;
        let one = Use {
            place: found.place,
            reads: *space == origin,
            message_type: message_type.clone(),
        };
        match self.uses.entry((*space, ros_topic.clone())) {
            Entry::Occupied(uses) => uses.into_mut().push(one),
            Entry::Vacant(slot) => {
                self.order.push(slot.key().clone());
                slot.insert(vec![one]);
            }
        }
    }

    /// Notes conflicts between variables that share a topic.
    pub(super) fn conflicts(&self, findings: &mut MappingFindings) {
        for key in &self.order {
            let uses = self.uses.get(key).map_or(&[][..], Vec::as_slice);
            let Some((first, others)) = uses.split_first() else {
                continue;
            };
            let (space, topic) = key;
            for other in others {
                conflict(
                    first,
                    other,
                    &format!("`{topic}` of space {space}"),
                    findings,
                );
            }
        }
    }
}

fn conflict(first: &Use, other: &Use, topic: &str, findings: &mut MappingFindings) {
    let label = format!("first at {}", findings.line(first.place, other.place));
    if first.reads != other.reads {
        let message = format!("{topic} is read for one variable and written for another");
        let note = findings
            .error(Code::ReadAndWritten, other.place, message)
            .label(label);
        note.help(
            "written values would be read again as values of the other variable: use two topics",
        );
    } else if !other.reads {
        let message = format!("two variables are written to {topic}");
        let note = findings
            .error(Code::WrittenTwice, other.place, message)
            .label(label);
        note.help("a topic can show one value: give each variable its own topic");
    } else if first.message_type != other.message_type {
        let (a, b) = (&first.message_type, &other.message_type);
        let message = format!("{topic} cannot be both {a} and {b}");
        findings
            .error(Code::TopicTypesDiffer, other.place, message)
            .label(label);
    }
}

fn topic_name(
    text: &str,
    place: TextSpan,
    site: &BindingSite<'_>,
    findings: &mut MappingFindings,
) -> Option<(String, TextSpan)> {
    let dialect = site.dialect();
    ros_name(text, place, (dialect, "topic"), findings)?;
    if let Some(other) = text
        .strip_prefix('/')
        .and_then(|name| name.parse::<TopicId>().ok())
        && let Some(topic) = site.subject.topic
        && topic != other
    {
        let message = format!(
            "`{text}` is the name of another value of the space; the name of this value is `/{topic}`"
        );
        findings
            .error(Code::SpaceName, place, message)
            .help(format!(
                "use `/{topic}`, or a name that does not begin with ua_"
            ));
        return None;
    }
    Some((text.to_owned(), place))
}

/// Returns `true` if both bindings bind raw messages and the types or dialects differ, so that the
/// bytes differ.
fn differ_as_bytes(a: &Binding, b: &Binding) -> bool {
    let bytes = a.selection == Selection::Bytes && b.selection == Selection::Bytes;
    bytes && (dialect(a.space) != dialect(b.space) || a.message_type != b.message_type)
}

/// Notes bindings with fields that cannot stand for each other.
fn differences(found: &[ReadBinding], findings: &mut MappingFindings) {
    let mut known = found
        .iter()
        .filter_map(|one| Some((one, one.fields.as_ref()?)));
    let Some((first, fields)) = known.next() else {
        return;
    };
    let shape =
        |fields: &[Leaf]| -> Vec<ValueType> { fields.iter().map(types::value_type).collect() };
    for (other, others) in known {
        findings.of_part([first.binding.space, other.binding.space]);
        let line = findings.line(first.place, other.place);
        if differ_as_bytes(&first.binding, &other.binding) {
            let (a, b) = (&first.binding, &other.binding);
            let message = format!(
                "the bytes of `{}` in space {} are not a `{}` in space {}",
                a.message_type, a.space, b.message_type, b.space
            );
            let note = findings.error(Code::BindingsDiffer, other.place, message);
            note.label(format!("differs from {line}"))
                .help("bytes are not converted: both topics must have the same type and the same ROS version");
        }
        if shape(fields) == shape(others) {
            versions((first, fields), (other, others), findings);
            several::compare(&first.binding, &other.binding, other.place, findings);
            continue;
        }
        let told = |fields: &[Leaf]| match fields {
            [one] => types::print(types::value_type(one)),
            several => format!("{} fields", several.len()),
        };
        let (a, b) = (&first.binding, &other.binding);
        let message = match (fields.as_slice(), others.as_slice()) {
            (a_fields, b_fields) if a_fields.len() == b_fields.len() && a_fields.len() > 1 => {
                format!(
                    "the fields of `{}` and `{}` have different types",
                    b.message_type, a.message_type
                )
            }
            _ => format!(
                "the value is {} in space {}, but {} in space {}",
                told(fields),
                a.space,
                told(others),
                b.space
            ),
        };
        let note = findings.error(Code::BindingsDiffer, other.place, message);
        let several = fields.len() > 1 || others.len() > 1;
        let sides = several.then(|| sides((first, fields), (other, others)));
        let help = match sides.flatten() {
            Some(sides) => format!("{sides}; bind fields of one type on both sides"),
            None => "bind fields of one type on both sides".to_owned(),
        };
        note.label(format!("differs from {line}")).help(help);
    }
}

/// A whole message with its fields, which are matched by position.
type Side<'f> = (&'f ReadBinding, &'f [Leaf]);

/// Notes fields of the same types with names that do not match.
fn versions(first: Side<'_>, other: Side<'_>, findings: &mut MappingFindings) {
    let whole =
        |(found, fields): Side<'_>| found.binding.selection == Selection::Whole && fields.len() > 1;
    if !whole(first) || !whole(other) {
        return;
    }
    let Some(sides) = sides(first, other) else {
        return;
    };
    let (a, b) = (&first.0.binding, &other.0.binding);
    let message = format!(
        "`{}` in space {} and `{}` in space {} have fields of different names at the same positions",
        a.message_type, a.space, b.message_type, b.space
    );
    findings
        .warning(Code::VersionsDiffer, other.0.place, message)
        .label(format!("differs from line {}", first.0.place.line))
        .help(format!(
            "{sides}; fields are matched by position: bind single fields if this is not intended"
        ));
}

/// Returns the fields that only one side has, by name; `None` if there are none. ROS 2 names are in
/// lower case with underscores, while ROS 1 allows names such as `D`.
fn sides((first, a): Side<'_>, (other, b): Side<'_>) -> Option<String> {
    let plain = |leaf: &Leaf| leaf.path.to_ascii_lowercase().replace('_', "");
    let only = |found: &ReadBinding, these: &[Leaf], those: &[Leaf]| {
        let those: HashSet<String> = those.iter().map(plain).collect();
        let only = these.iter().filter(|leaf| !those.contains(&plain(leaf)));
        let only: Vec<&str> = only.map(|leaf| leaf.path.as_str()).collect();
        let side = || format!("only in space {}: {}", found.binding.space, told(&only));
        (!only.is_empty()).then(side)
    };
    let names: HashMap<String, &Leaf> = b.iter().map(|leaf| (plain(leaf), leaf)).collect();
    let typed = a.iter().filter_map(|leaf| {
        let (one, two) = (leaf, *names.get(&plain(leaf))?);
        let (one, two) = (types::value_type(one), types::value_type(two));
        (one != two).then(|| {
            let (one, two) = (types::print(one), types::print(two));
            format!("{} ({one}, {two})", leaf.path)
        })
    });
    let typed: Vec<String> = typed.collect();
    let typed: Vec<&str> = typed.iter().map(String::as_str).collect();
    let typed = (!typed.is_empty()).then(|| format!("with different types: {}", told(&typed)));
    let parts = [only(first, a, b), only(other, b, a), typed];
    let parts: Vec<String> = parts.into_iter().flatten().collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}
