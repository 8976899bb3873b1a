//! Descriptions of ROS 2 types, as sent by nodes since Iron
//! (`type_description_interfaces/msg/TypeDescription`).

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::definition::{DefinitionLine, MessageDefinition};
use crate::resolve::TypeResolver;
use crate::type_hash::{
    ARRAY, BOUNDED_SEQUENCE, BOUNDED_STRING, BOUNDED_WSTRING, BYTE, CHAR, NESTED, STRING,
    UNBOUNDED_SEQUENCE, WSTRING,
};
use crate::{DefinitionError, Dialect, MessageType, TypeHash, TypeName, TypeRegistry};

/// A type without the types it needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DescribedType {
    /// Name, such as `sensor_msgs/msg/JointState`.
    pub name: String,
    /// Fields in order.
    pub fields: Vec<DescribedField>,
}

/// A field of a [`DescribedType`], without its default.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DescribedField {
    /// Name of the field.
    pub name: String,
    /// A constant of `type_description_interfaces/msg/FieldType`.
    pub type_id: u8,
    /// Length of an array, or bound of a sequence.
    pub capacity: u64,
    /// Bound of a string.
    pub string_capacity: u64,
    /// Name of the message type, as [`DescribedType::name`].
    pub nested: String,
}

impl DescribedType {
    /// Selects the type `name` and the types it needs from a description: the type itself first,
    /// then the others in the order of their names. Missing types are omitted.
    #[must_use]
    pub fn needed<'t>(name: &TypeName, types: &'t [Self]) -> Vec<&'t Self> {
        let mut told: BTreeMap<TypeName, &'t Self> = types
            .iter()
            .filter_map(|one| Some((one.name.parse::<TypeName>().ok()?, one)))
            .collect();
        let mut needed = BTreeMap::new();
        let Some(first) = told.remove(name) else {
            return Vec::new();
        };
        let mut open = vec![first];
        while let Some(one) = open.pop() {
            let nested = one.fields.iter().filter(|field| !field.nested.is_empty());
            for inner in nested.filter_map(|field| field.nested.parse::<TypeName>().ok()) {
                if let Some(found) = told.remove(&inner) {
                    needed.insert(inner, found);
                    open.push(found);
                }
            }
        }
        std::iter::once(first).chain(needed.into_values()).collect()
    }
}

impl TypeRegistry {
    /// Adds the type `name` from a description, with all types it needs. The type hash decides
    /// whether it is the announced type: the registry stores the definitions of new names only if
    /// the hash is `expected`. Types that are not needed are ignored.
    ///
    /// # Errors
    /// [`DefinitionError`], also for more than 512 types or 4096 fields in all. A hash that is not
    /// `expected` is [`DefinitionError::OtherHash`]; then nothing is stored.
    pub fn add_described(
        &mut self,
        name: &TypeName,
        types: &[DescribedType],
        expected: TypeHash,
    ) -> Result<Arc<MessageType>, DefinitionError> {
        let fields = types.iter().map(|one| one.fields.len());
        let fields = fields.fold(0, usize::saturating_add);
        if types.len() > MOST_TYPES || fields > MOST_FIELDS {
            return Err(DefinitionError::Syntax {
                name: name.clone(),
                line: 1,
                reason: "the description exceeds the limit of types or fields",
                text: format!("{} types with {fields} fields", types.len()),
            });
        }
        let mut described = Self::empty(Dialect::Ros2);
        for one in DescribedType::needed(name, types) {
            let made = definition(name, one)?;
            described
                .definitions
                .insert(made.name.clone(), Arc::new(made));
        }
        let found = described.type_hash(name)?;
        if found != expected {
            return Err(DefinitionError::OtherHash {
                name: name.clone(),
                found,
                expected,
            });
        }
        let none = BTreeMap::new();
        let message_type = TypeResolver::new(Dialect::Ros2, &[&described.definitions, &none])
            .message_type(name, None)?;
        for (name, definition) in described.definitions {
            self.definitions.entry(name).or_insert(definition);
        }
        Ok(Arc::new(message_type))
    }

    /// Returns the description of a message type: itself first, then the types it needs in the
    /// order of the names.
    ///
    /// # Errors
    /// As [`TypeRegistry::get`].
    pub fn describe(&self, name: &TypeName) -> Result<Vec<DescribedType>, DefinitionError> {
        crate::type_hash::describe(self, name)
    }

    /// Returns the description of a service, `package/srv/Name`; request, response and event are
    /// among the types it needs.
    ///
    /// # Errors
    /// As [`TypeRegistry::service`].
    pub fn describe_service(&self, name: &TypeName) -> Result<Vec<DescribedType>, DefinitionError> {
        crate::type_hash::describe_service(self, name)
    }

    /// Returns the description of an added ROS 2 action: itself first, then the types it needs.
    ///
    /// # Errors
    /// As [`TypeRegistry::get`], for its messages.
    pub fn describe_action(&self, name: &TypeName) -> Result<Vec<DescribedType>, DefinitionError> {
        crate::type_hash::describe_action(self, name)
    }
}

fn definition(
    of: &TypeName,
    described: &DescribedType,
) -> Result<MessageDefinition, DefinitionError> {
    let refused = |reason: &'static str, text: &str| DefinitionError::Syntax {
        name: of.clone(),
        line: 1,
        reason,
        text: text.chars().take(200).collect(),
    };
    let name: TypeName = described.name.parse().map_err(|_| {
        refused(
            "the name of a described type is not a message name",
            &described.name,
        )
    })?;
    let mut lines = Vec::new();
    for (number, field) in described.fields.iter().enumerate() {
        let Some(written) = written(field) else {
            return Err(refused(
                "a described field has a type that messages do not support",
                &field.name,
            ));
        };
        lines.push(DefinitionLine {
            number: number + 1,
            written,
            name: field.name.clone(),
            value: None,
        });
    }
    if let [only] = lines.as_slice()
        && only.name == "structure_needs_at_least_one_member"
    {
        lines.clear();
    }
    MessageDefinition::of_lines(Dialect::Ros2, &name, Vec::new(), lines)
}

/// Returns the type in the notation of `.msg` files.
fn written(field: &DescribedField) -> Option<String> {
    let DescribedField {
        type_id,
        capacity,
        string_capacity,
        nested,
        ..
    } = field;
    let (base, arity) = match *type_id {
        id if id > UNBOUNDED_SEQUENCE => (id - UNBOUNDED_SEQUENCE, "[]".to_owned()),
        id if id > BOUNDED_SEQUENCE => (id - BOUNDED_SEQUENCE, format!("[<={capacity}]")),
        id if id > ARRAY => (id - ARRAY, format!("[{capacity}]")),
        id => (id, String::new()),
    };
    let base = match base {
        NESTED => {
            let name: TypeName = nested.parse().ok()?;
            name.to_string()
        }
        2 => "int8".to_owned(),
        3 => "uint8".to_owned(),
        4 => "int16".to_owned(),
        5 => "uint16".to_owned(),
        6 => "int32".to_owned(),
        7 => "uint32".to_owned(),
        8 => "int64".to_owned(),
        9 => "uint64".to_owned(),
        10 => "float32".to_owned(),
        11 => "float64".to_owned(),
        15 => "bool".to_owned(),
        CHAR => "char".to_owned(),
        BYTE => "byte".to_owned(),
        STRING => "string".to_owned(),
        WSTRING => "wstring".to_owned(),
        BOUNDED_STRING => format!("string<={string_capacity}"),
        BOUNDED_WSTRING => format!("wstring<={string_capacity}"),
        _ => return None,
    };
    Some(base + &arity)
}

/// Limit of types, which exceeds the need of any message.
const MOST_TYPES: usize = 512;
/// Limit of fields over all types.
const MOST_FIELDS: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_message_of_the_bundle_is_described_such_that_its_hash_is_the_same() {
        let registry = TypeRegistry::bundle(Dialect::Ros2);
        for name in registry.names() {
            let hash = registry.type_hash(name).unwrap();
            let described = registry.describe(name).unwrap();
            let mut empty = TypeRegistry::empty(Dialect::Ros2);
            let again = empty.add_described(name, &described, hash).unwrap();
            assert_eq!(
                again.leaves(),
                registry.get(name).unwrap().leaves(),
                "{name}"
            );
            assert_eq!(empty.type_hash(name).unwrap(), hash, "{name}");
        }
    }

    #[test]
    fn a_description_of_another_hash_is_not_believed() {
        let mut registry = TypeRegistry::bundle(Dialect::Ros2);
        let name: TypeName = "robot_msgs/Arm".parse().unwrap();
        let bool_hash = registry
            .type_hash(&"std_msgs/Bool".parse().unwrap())
            .unwrap();
        let field = DescribedField {
            name: "on".to_owned(),
            type_id: 15,
            capacity: 0,
            string_capacity: 0,
            nested: String::new(),
        };
        let mut described = DescribedType {
            name: "robot_msgs/msg/Arm".to_owned(),
            fields: vec![field],
        };
        let refused = registry.add_described(&name, &[described.clone()], bool_hash);
        assert!(matches!(refused, Err(DefinitionError::OtherHash { .. })));
        assert!(registry.get(&name).is_err());
        for bad in [0, 12, 14, 19, 49 + 11, 255] {
            described.fields[0].type_id = bad;
            assert!(
                registry
                    .add_described(&name, &[described.clone()], bool_hash)
                    .is_err()
            );
        }
        described.fields[0].type_id = NESTED;
        described.fields[0].nested = "robot_msgs/msg/Arm".to_owned();
        let cyclic = registry.add_described(&name, &[described], bool_hash);
        assert!(matches!(cyclic, Err(DefinitionError::Cyclic { .. })));
    }

    #[test]
    fn nothing_is_kept_that_the_type_does_not_need_and_no_more_is_read_than_a_message_has() {
        let registry = TypeRegistry::bundle(Dialect::Ros2);
        let [twist, stray, other]: [TypeName; 3] =
            ["geometry_msgs/Twist", "robot_msgs/Stray", "std_msgs/Bool"]
                .map(|name| name.parse().unwrap());
        let hash = registry.type_hash(&twist).unwrap();
        let mut described = registry.describe(&twist).unwrap();
        let alone = described.clone();
        described.extend(registry.describe(&other).unwrap());
        described.push(DescribedType {
            name: "robot_msgs/msg/Stray".to_owned(),
            fields: Vec::new(),
        });
        let needed = DescribedType::needed(&twist, &described);
        assert!(needed.into_iter().eq(&alone));
        let mut empty = TypeRegistry::empty(Dialect::Ros2);
        empty.add_described(&twist, &described, hash).unwrap();
        for name in [&stray, &other] {
            assert!(empty.get(name).is_err(), "{name}");
        }
        assert!(empty.get(&"geometry_msgs/Vector3".parse().unwrap()).is_ok());

        let field = alone[0].fields[0].clone();
        let many_fields = DescribedType {
            name: "robot_msgs/msg/Stray".to_owned(),
            fields: vec![field; MOST_FIELDS],
        };
        let many_types = vec![described.pop().unwrap(); MOST_TYPES];
        for too_many in [vec![many_fields], many_types] {
            let all = [alone.clone(), too_many].concat();
            let refused = TypeRegistry::empty(Dialect::Ros2).add_described(&twist, &all, hash);
            assert!(matches!(refused, Err(DefinitionError::Syntax { .. })));
        }
    }

    #[test]
    fn a_hash_is_read_back_from_its_text() {
        let registry = TypeRegistry::bundle(Dialect::Ros2);
        let hash = registry
            .type_hash(&"std_msgs/Bool".parse().unwrap())
            .unwrap();
        assert_eq!(hash.to_string().parse(), Ok(hash));
        for text in ["", "RIHS01_", "RIHS02_00", "RIHS01_zz"] {
            assert!(text.parse::<TypeHash>().is_err(), "{text}");
        }
    }
}
