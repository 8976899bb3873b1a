//! OPC UA value types and ROS message types.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock};

use messages::{
    ActionCalls, ArrayRank, DefinitionError, Dialect, Leaf, Library, MessageType, Noted,
    ServiceType, TextKind, TypeName, TypeRegistry,
};
use uadp::BuiltinType;

use super::{TypeOrigin, TypeUse};
use crate::code::Code;
use crate::findings::MappingFindings;
use crate::read::{list, short};
use crate::surroundings::OpenTypeFiles;
use crate::topic::SpaceId;
use crate::tree::TextSpan;
use documents::nearest;

/// Builtin type, and `true` for an array.
pub(super) type ValueType = (BuiltinType, bool);

/// Reads `Double` or `Double[]`.
pub(super) fn parse_value_type(text: &str) -> Option<ValueType> {
    let (name, array) = text
        .strip_suffix("[]")
        .map_or((text, false), |name| (name, true));
    Some((BuiltinType::from_name(name)?, array))
}

pub(super) fn print((builtin, array): ValueType) -> String {
    format!("{}{}", builtin.name(), if array { "[]" } else { "" })
}

pub(super) fn value_type(leaf: &Leaf) -> ValueType {
    (leaf.builtin, matches!(leaf.rank, ArrayRank::Array { .. }))
}

/// Returns the builtin type that an unknown name may mean: a misspelt name, or the word of another
/// language.
pub(super) fn suggest_value_type(text: &str) -> Option<&'static str> {
    const ELSEWHERE: [(&str, &str); 20] = [
        ("bool", "Boolean"),
        ("int8", "SByte"),
        ("uint8", "Byte"),
        ("char", "Byte"),
        ("short", "Int16"),
        ("ushort", "UInt16"),
        ("int", "Int32"),
        ("integer", "Int32"),
        ("uint", "UInt32"),
        ("long", "Int64"),
        ("ulong", "UInt64"),
        ("float32", "Float"),
        ("real", "Float"),
        ("float64", "Double"),
        ("lreal", "Double"),
        ("str", "String"),
        ("text", "String"),
        ("time", "DateTime"),
        ("bytes", "ByteString"),
        ("uuid", "Guid"),
    ];
    let name = text.split('[').next().unwrap_or(text);
    let elsewhere = ELSEWHERE
        .iter()
        .find(|(other, _)| other.eq_ignore_ascii_case(name));
    let known = (1..=25)
        .filter_map(BuiltinType::from_id)
        .map(BuiltinType::name);
    elsewhere
        .map(|(_, name)| *name)
        .or_else(|| nearest(name, known))
}

pub(super) const fn dialect(space: SpaceId) -> Dialect {
    if space.is_ros2() {
        Dialect::Ros2
    } else {
        Dialect::Ros1
    }
}

/// Returns a field, or the fields of a message inside of the message; `None` if the type lacks the
/// path, which is noted.
pub(super) fn field(
    message_type: &MessageType,
    path: &str,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Vec<Leaf>> {
    if let Some(leaf) = message_type.leaf(path) {
        return Some(vec![leaf.clone()]);
    }
    let inside: Vec<Leaf> = message_type
        .leaves()
        .iter()
        .filter(|leaf| leaf.is_inside(path))
        .cloned()
        .collect();
    if !inside.is_empty() {
        return Some(inside);
    }
    let paths: Vec<&str> = message_type
        .leaves()
        .iter()
        .map(|leaf| leaf.path.as_str())
        .collect();
    let name = message_type.name();
    let message = format!("`{name}` has no field `{}`", short(path));
    let note = findings.error(Code::UnknownField, place, message);
    let near = nearest(path, paths.iter().copied()).map(|near| format!("did you mean `{near}`? "));
    note.help(format!(
        "{}its fields are {}",
        near.unwrap_or_default(),
        told(&paths)
    ));
    None
}

/// Maximum number of fields that a help lists.
const TOLD: usize = 12;

/// Lists the paths of fields.
pub(super) fn told(paths: &[&str]) -> String {
    match paths.split_at_checked(TOLD) {
        Some((first, rest)) if !rest.is_empty() => {
            format!("{} and {} more", list(first), rest.len())
        }
        Some(_) | None if paths.is_empty() => "none".to_owned(),
        Some(_) | None => list(paths),
    }
}

type Answer = Result<Arc<MessageType>, Box<DefinitionError>>;

/// Message types that are built in or in files.
pub(super) struct MessageTypes {
    files: Box<dyn OpenTypeFiles>,
    /// Libraries of ROS 1 and of ROS 2, created with the first query.
    libraries: [Option<Library>; 2],
    asked: HashMap<(Dialect, TypeName), Answer>,
    services: HashMap<(Dialect, TypeName), Option<Arc<ServiceType>>>,
    actions: HashMap<(Dialect, TypeName), Option<Arc<ActionCalls>>>,
    used: Vec<TypeUse>,
}

static ROS1: LazyLock<TypeRegistry> = LazyLock::new(|| TypeRegistry::bundle(Dialect::Ros1));
static ROS2: LazyLock<TypeRegistry> = LazyLock::new(|| TypeRegistry::bundle(Dialect::Ros2));

impl MessageTypes {
    pub(super) fn new(files: Box<dyn OpenTypeFiles>) -> Self {
        Self {
            files,
            libraries: [None, None],
            asked: HashMap::new(),
            services: HashMap::new(),
            actions: HashMap::new(),
            used: Vec::new(),
        }
    }

    /// Returns the built-in definitions.
    pub(super) fn registry(dialect: Dialect) -> &'static TypeRegistry {
        match dialect {
            Dialect::Ros1 => &ROS1,
            Dialect::Ros2 => &ROS2,
        }
    }

    fn library(
        &mut self,
        dialect: Dialect,
    ) -> (&mut Library, &mut Box<dyn OpenTypeFiles>, &mut Vec<TypeUse>) {
        let [ros1, ros2] = &mut self.libraries;
        let library = match dialect {
            Dialect::Ros1 => ros1,
            Dialect::Ros2 => ros2,
        };
        let library = library.get_or_insert_with(|| Library::new(Self::registry(dialect).clone()));
        (library, &mut self.files, &mut self.used)
    }

    /// Returns a known service type; notes faults of its file.
    pub(super) fn service(
        &mut self,
        (dialect, place): (Dialect, TextSpan),
        name: &TypeName,
        findings: &mut MappingFindings,
    ) -> Option<Arc<ServiceType>> {
        if let Some(known) = self.services.get(&(dialect, name.clone())) {
            return known.clone();
        }
        let (library, files, used) = self.library(dialect);
        let found = library.service(name, files.as_mut()).ok();
        used.push(TypeUse {
            dialect,
            kind: TextKind::Service,
            name: name.clone(),
            source: origin(library, TextKind::Service, name, found.is_some()),
        });
        note(library.take_noted(), place, findings);
        self.services.insert((dialect, name.clone()), found.clone());
        found
    }

    /// Returns a known action type as calls and values; notes faults of its files.
    pub(super) fn action(
        &mut self,
        (dialect, place): (Dialect, TextSpan),
        name: &TypeName,
        findings: &mut MappingFindings,
    ) -> Option<Arc<ActionCalls>> {
        if let Some(known) = self.actions.get(&(dialect, name.clone())) {
            return known.clone();
        }
        let (library, files, used) = self.library(dialect);
        let found = library.action_calls(name, files.as_mut());
        let found = found.ok().map(Arc::new);
        used.push(TypeUse {
            dialect,
            kind: TextKind::Action,
            name: name.clone(),
            source: origin(library, TextKind::Action, name, found.is_some()),
        });
        note(library.take_noted(), place, findings);
        self.actions.insert((dialect, name.clone()), found.clone());
        found
    }

    /// Returns a message type; notes faults of its files.
    pub(super) fn get(
        &mut self,
        (dialect, place): (Dialect, TextSpan),
        name: &TypeName,
        findings: &mut MappingFindings,
    ) -> Answer {
        if let Some(known) = self.asked.get(&(dialect, name.clone())) {
            return known.clone();
        }
        let (library, files, used) = self.library(dialect);
        let found = library.message(name, files.as_mut()).map_err(Box::new);
        used.push(TypeUse {
            dialect,
            kind: TextKind::Message,
            name: name.clone(),
            source: origin(library, TextKind::Message, name, found.is_ok()),
        });
        note(library.take_noted(), place, findings);
        self.asked.insert((dialect, name.clone()), found.clone());
        found
    }

    /// Returns the known name that an unknown name may mean.
    pub(super) fn suggest(
        &mut self,
        dialect: Dialect,
        kind: TextKind,
        name: &TypeName,
    ) -> Option<TypeName> {
        let (library, files, _) = self.library(dialect);
        library.suggest(kind, name, files.as_mut())
    }

    /// Returns `; looked in a, b`, or an empty text if there are only built-in types.
    pub(super) fn looked(&self, dialect: Dialect) -> String {
        let places = self.files.places(dialect);
        if places.is_empty() {
            return String::new();
        }
        let places: Vec<&str> = places.iter().map(String::as_str).collect();
        format!("; looked in {}", told(&places))
    }

    /// Returns the types that were queried.
    pub(super) fn used(self) -> Vec<TypeUse> {
        self.used
    }
}

fn origin(library: &Library, kind: TextKind, name: &TypeName, known: bool) -> TypeOrigin {
    match library.file(kind, name) {
        Some(file) if known => TypeOrigin::File(file.to_string()),
        None if known => TypeOrigin::BuiltIn,
        Some(_) | None => TypeOrigin::Unknown,
    }
}

fn note(noted: Vec<Noted>, place: TextSpan, findings: &mut MappingFindings) {
    for one in noted {
        match one {
            Noted::Read { .. } => {}
            Noted::Refused { file, error, .. } => {
                findings
                    .warning(Code::DefinitionFile, place, format!("{file}: {error}"))
                    .help("this file is ignored; the built-in definition of this name is used, if there is one");
            }
            Noted::Differs {
                name,
                file,
                only_file,
                only_built_in,
            } => {
                let sides = [
                    ("only in the file", only_file),
                    ("only built in", only_built_in),
                ];
                let sides: Vec<String> = sides
                    .iter()
                    .filter(|(_, lines)| !lines.is_empty())
                    .map(|(side, lines)| {
                        let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
                        format!("{side}: {}", told(&lines))
                    })
                    .collect();
                let sides = if sides.is_empty() {
                    "its fields are in another order".to_owned()
                } else {
                    sides.join("; ")
                };
                let message =
                    format!("`{name}` of {file} differs from the built-in definition: {sides}");
                findings
                    .warning(Code::DefinitionsDiffer, place, message)
                    .help(
                        "the file is used; check that the peers are built with the same definition",
                    );
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_type_is_a_builtin_type_or_an_array_of_it() {
        for text in ["Boolean", "Double[]", "ByteString", "LocalizedText[]"] {
            assert_eq!(print(parse_value_type(text).unwrap()), text);
        }
        for text in [
            "",
            "[]",
            "boolean",
            "Double[][]",
            "Double[3]",
            "Double []",
            "std_msgs/Bool",
        ] {
            assert_eq!(parse_value_type(text), None, "{text}");
        }
    }

    #[test]
    fn words_of_other_languages_are_understood_in_the_help() {
        assert_eq!(suggest_value_type("bool"), Some("Boolean"));
        assert_eq!(suggest_value_type("float64[]"), Some("Double"));
        assert_eq!(suggest_value_type("uint32"), Some("UInt32"));
        assert_eq!(suggest_value_type("Boolaen"), Some("Boolean"));
        assert_eq!(suggest_value_type("colour"), None);
    }
}
