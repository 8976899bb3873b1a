//! OPC UA value types and ROS message types.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock};

use messages::{
    DefinitionError, Dialect, Leaf, MessageType, Rank, Registry, ServiceType, TypeName,
};
use uadp::BuiltinType;

use crate::nearest::nearest;
use crate::topic::SpaceId;

/// Builtin type and whether it is an array.
pub(super) type ValueType = (BuiltinType, bool);

/// `Double`, `Double[]`
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
    (leaf.builtin, matches!(leaf.rank, Rank::Array { .. }))
}

/// What may be meant by a name that is no builtin type: a misspelt one, or a word of another language.
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

type Answer = Result<Arc<MessageType>, Box<DefinitionError>>;

/// The message types that are built in.
pub(super) struct Types {
    asked: HashMap<(Dialect, TypeName), Answer>,
    services: HashMap<(Dialect, TypeName), Option<Arc<ServiceType>>>,
}

static ROS1: LazyLock<Registry> = LazyLock::new(|| Registry::bundle(Dialect::Ros1));
static ROS2: LazyLock<Registry> = LazyLock::new(|| Registry::bundle(Dialect::Ros2));

impl Types {
    pub(super) fn new() -> Self {
        Self {
            asked: HashMap::new(),
            services: HashMap::new(),
        }
    }

    pub(super) fn registry(dialect: Dialect) -> &'static Registry {
        match dialect {
            Dialect::Ros1 => &ROS1,
            Dialect::Ros2 => &ROS2,
        }
    }

    /// A service that is built in.
    pub(super) fn service(
        &mut self,
        dialect: Dialect,
        name: &TypeName,
    ) -> Option<Arc<ServiceType>> {
        let known = self.services.entry((dialect, name.clone()));
        known
            .or_insert_with(|| Self::registry(dialect).service(name).ok())
            .clone()
    }

    pub(super) fn get(&mut self, dialect: Dialect, name: &TypeName) -> &Answer {
        self.asked
            .entry((dialect, name.clone()))
            .or_insert_with(|| Self::registry(dialect).get(name).map_err(Box::new))
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
