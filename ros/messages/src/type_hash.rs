//! Type hashes of ROS 2: the SHA-256 of a type's description in JSON (REP-2016, "Type Version
//! Hash"; the description is `type_description_interfaces/msg/TypeDescription`).
//!
//! The description contains only names and types of fields, without constants, defaults and
//! comments. It includes the descriptions of all needed types, in the order of their names.

use std::collections::BTreeMap;
use std::fmt::{self, Write as _};
use std::str::FromStr;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use crate::definition::{
    Arity, FieldDefinition, FieldType, MessageDefinition, Number, Primitive, StringType,
};
use crate::resolve::hex;
use crate::{DefinitionError, DescribedField, DescribedType, Dialect, TypeName, TypeRegistry};

/// The hash of a ROS 2 type, as announced by nodes since Iron. Prints as `RIHS01_` and 64 hex
/// digits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TypeHash([u8; 32]);

impl TypeHash {
    /// Returns the SHA-256 itself.
    pub fn as_bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl fmt::Display for TypeHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "RIHS01_{}", hex(&self.0))
    }
}

impl FromStr for TypeHash {
    type Err = NoTypeHash;

    fn from_str(text: &str) -> Result<Self, NoTypeHash> {
        let digits = text.strip_prefix("RIHS01_").ok_or(NoTypeHash)?;
        let mut hash = [0; 32];
        if digits.len() != 64 || !digits.bytes().all(|digit| digit.is_ascii_hexdigit()) {
            return Err(NoTypeHash);
        }
        for (at, byte) in hash.iter_mut().enumerate() {
            let pair = digits.get(at * 2..at * 2 + 2).ok_or(NoTypeHash)?;
            *byte = u8::from_str_radix(pair, 16).map_err(|_| NoTypeHash)?;
        }
        Ok(Self(hash))
    }
}

/// Error for a text that is not a type hash of the supported version.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected `RIHS01_` and 64 hexadecimal digits")]
pub struct NoTypeHash;

/// Returns the description of a message and of the types it needs.
pub(crate) fn describe(
    registry: &TypeRegistry,
    name: &TypeName,
) -> Result<Vec<DescribedType>, DefinitionError> {
    registry.get(name)?;
    let mut types = Described::new(registry);
    types.message(name)?;
    Ok(types.with_needed(&name.ros2()))
}

/// Returns the description of a service and of the types it needs.
pub(crate) fn describe_service(
    registry: &TypeRegistry,
    name: &TypeName,
) -> Result<Vec<DescribedType>, DefinitionError> {
    let (types, full) = Described::of_service(registry, name)?;
    Ok(types.with_needed(&full))
}

/// Returns the description of an added ROS 2 action and of the types it needs.
pub(crate) fn describe_action(
    registry: &TypeRegistry,
    name: &TypeName,
) -> Result<Vec<DescribedType>, DefinitionError> {
    let (types, full) = Described::of_added_action(registry, name)?;
    Ok(types.with_needed(&full))
}

/// The hashes of a service and its parts, with ROS 2 names such as `std_srvs/srv/SetBool_Request`.
///
/// The endpoints of a service announce the hashes of `_Request` and `_Response`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceTypeHashes {
    /// Hash of the service.
    pub service: TypeHash,
    /// Hash of `_Request`.
    pub request: TypeHash,
    /// Hash of `_Response`.
    pub response: TypeHash,
    /// Hash of `_Event`, the message of service introspection.
    pub event: TypeHash,
}

/// The hashes of an action and its parts, with names such as
/// `nav2_msgs/action/NavigateToPose_Goal`.
///
/// The endpoints of an action announce the hashes of the two services' requests and responses, and
/// of the feedback message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActionTypeHashes {
    /// Hash of the action.
    pub action: TypeHash,
    /// Hash of `_Goal`, the first part of the text.
    pub goal: TypeHash,
    /// Hash of `_Result`, the second part.
    pub result: TypeHash,
    /// Hash of `_Feedback`, the third part.
    pub feedback: TypeHash,
    /// Hashes of `_SendGoal`.
    pub send_goal: ServiceTypeHashes,
    /// Hashes of `_GetResult`.
    pub get_result: ServiceTypeHashes,
    /// Hash of `_FeedbackMessage`.
    pub feedback_message: TypeHash,
}

impl TypeRegistry {
    /// Returns the type hash of a message. Definitions are treated as ROS 2 definitions; the hash
    /// has no meaning for a registry of ROS 1.
    ///
    /// # Errors
    /// As [`TypeRegistry::get`].
    pub fn type_hash(&self, name: &TypeName) -> Result<TypeHash, DefinitionError> {
        // Checks for types that contain themselves, which the code below assumes to be absent.
        self.get(name)?;
        let mut types = Described::new(self);
        types.message(name)?;
        Ok(types.hash(&name.ros2()))
    }

    /// Returns the type hashes of a service and of the messages that rosidl derives from it.
    ///
    /// # Errors
    /// As [`TypeRegistry::service`].
    pub fn service_type_hashes(
        &self,
        name: &TypeName,
    ) -> Result<ServiceTypeHashes, DefinitionError> {
        let (types, full) = Described::of_service(self, name)?;
        Ok(types.service_hashes(&full))
    }

    /// Returns the type hashes of an action, given by its goal, result and feedback, and of the
    /// messages and services that rosidl derives from it (design.ros2.org, "Actions").
    ///
    /// # Errors
    /// As [`TypeRegistry::get`], and [`DefinitionError::Syntax`] for a text without exactly three
    /// parts.
    pub fn action_type_hashes(
        &self,
        name: &TypeName,
        text: &str,
    ) -> Result<ActionTypeHashes, DefinitionError> {
        let parts = crate::service::action_parts(self.dialect(), name, text)?;
        let (types, full) = Described::of_action(self, name, &parts)?;
        Ok(types.action_hashes(&full))
    }

    /// Returns the type hashes of an added ROS 2 action, as
    /// [`action_type_hashes`](Self::action_type_hashes).
    ///
    /// # Errors
    /// As [`TypeRegistry::get`], for its messages.
    pub fn added_action_type_hashes(
        &self,
        name: &TypeName,
    ) -> Result<ActionTypeHashes, DefinitionError> {
        let (types, full) = Described::of_added_action(self, name)?;
        Ok(types.action_hashes(&full))
    }
}

/// Types by their ROS 2 names.
struct Described<'r> {
    registry: &'r TypeRegistry,
    types: BTreeMap<String, Vec<FieldDescription>>,
}

/// `type_description_interfaces/msg/Field` without its default.
struct FieldDescription {
    name: String,
    type_id: u8,
    capacity: u32,
    string_capacity: u32,
    /// Empty unless the field is a message.
    nested: String,
}

impl<'r> Described<'r> {
    fn new(registry: &'r TypeRegistry) -> Self {
        Self {
            registry,
            types: BTreeMap::new(),
        }
    }

    /// Returns a service with all types it needs, and its ROS 2 name.
    fn of_service(
        registry: &'r TypeRegistry,
        name: &TypeName,
    ) -> Result<(Self, String), DefinitionError> {
        registry.service(name)?;
        let mut types = Self::new(registry);
        let full = format!("{}/srv/{}", name.package(), name.name());
        if let Some([request, response]) = registry.service_definitions(name) {
            types.definition(&format!("{full}_Request"), request)?;
            types.definition(&format!("{full}_Response"), response)?;
        }
        types.service(&full);
        Ok((types, full))
    }

    /// Returns an action of these three parts with all types it needs, and its ROS 2 name.
    fn of_action(
        registry: &'r TypeRegistry,
        name: &TypeName,
        parts: &[Arc<MessageDefinition>; 3],
    ) -> Result<(Self, String), DefinitionError> {
        let full = format!("{}/action/{}", name.package(), name.name());
        let mut types = Self::new(registry);
        for (suffix, part) in ACTION_PARTS.into_iter().zip(parts) {
            for needed in part.needs() {
                registry.get(needed)?;
            }
            types.definition(&format!("{full}_{suffix}"), part)?;
        }
        types.action(&full);
        Ok((types, full))
    }

    fn of_added_action(
        registry: &'r TypeRegistry,
        name: &TypeName,
    ) -> Result<(Self, String), DefinitionError> {
        let part = |suffix| {
            let part = crate::service::derived(name, suffix)?;
            let found = registry.definition(&part).cloned();
            found.ok_or(DefinitionError::Unknown {
                name: part,
                needed_by: None,
            })
        };
        let [goal, result, feedback] = ACTION_PARTS.map(part);
        Self::of_action(registry, name, &[goal?, result?, feedback?])
    }

    /// Returns a type, followed by the types it needs in the order of the names.
    fn with_needed(&self, full: &str) -> Vec<DescribedType> {
        let mut needed = BTreeMap::new();
        self.needs(full, &mut needed);
        needed.remove(full);
        let all = std::iter::once(full).chain(needed.into_keys());
        let described = all.map(|name| DescribedType {
            name: name.to_owned(),
            fields: self.fields(name),
        });
        described.collect()
    }

    fn message(&mut self, name: &TypeName) -> Result<(), DefinitionError> {
        match self.registry.definition(name) {
            Some(definition) => self.definition(&name.ros2(), definition),
            None => Err(DefinitionError::Unknown {
                name: name.clone(),
                needed_by: None,
            }),
        }
    }

    /// Describes a message and the types it needs. The depth is bounded, as the message was
    /// resolved before.
    fn definition(
        &mut self,
        full: &str,
        definition: &Arc<MessageDefinition>,
    ) -> Result<(), DefinitionError> {
        if self.types.contains_key(full) {
            return Ok(());
        }
        let dialect = self.registry.dialect();
        let fields = definition.fields.iter();
        let mut fields: Vec<FieldDescription> = fields
            .map(|field| FieldDescription::of(field, dialect))
            .collect();
        if fields.is_empty() {
            // The member that rosidl adds to an empty message, because C has no empty struct.
            fields.push(FieldDescription::new(
                "structure_needs_at_least_one_member",
                Number::UInt8.type_id(),
            ));
        }
        self.types.insert(full.to_owned(), fields);
        for needed in definition.needs() {
            self.message(needed)?;
        }
        Ok(())
    }

    /// Describes the service of that name. Its request and response have to be described already.
    fn service(&mut self, full: &str) {
        let part = |suffix: &str| format!("{full}_{suffix}");
        let (request, response, event) = (part("Request"), part("Response"), part("Event"));
        self.known();
        self.types.insert(
            event.clone(),
            vec![
                FieldDescription::nested("info", "service_msgs/msg/ServiceEventInfo"),
                FieldDescription::at_most_one("request", &request),
                FieldDescription::at_most_one("response", &response),
            ],
        );
        self.types.insert(
            full.to_owned(),
            vec![
                FieldDescription::nested("request_message", &request),
                FieldDescription::nested("response_message", &response),
                FieldDescription::nested("event_message", &event),
            ],
        );
    }

    /// Describes the action of that name. Its goal, result and feedback have to be described
    /// already.
    fn action(&mut self, full: &str) {
        let part = |suffix: &str| format!("{full}_{suffix}");
        self.known();
        let goal_id = || FieldDescription::nested("goal_id", UUID);
        let stamp = FieldDescription::nested("stamp", TIME);
        let accepted = FieldDescription::new("accepted", Number::Bool.type_id());
        let status = FieldDescription::new("status", Number::Int8.type_id());
        let nested = |name, suffix| FieldDescription::nested(name, &part(suffix));
        let messages = [
            ("SendGoal_Request", vec![goal_id(), nested("goal", "Goal")]),
            ("SendGoal_Response", vec![accepted, stamp]),
            ("GetResult_Request", vec![goal_id()]),
            (
                "GetResult_Response",
                vec![status, nested("result", "Result")],
            ),
            (
                "FeedbackMessage",
                vec![goal_id(), nested("feedback", "Feedback")],
            ),
        ];
        for (suffix, fields) in messages {
            self.types.insert(part(suffix), fields);
        }
        self.service(&part("SendGoal"));
        self.service(&part("GetResult"));
        let action = vec![
            nested("goal", "Goal"),
            nested("result", "Result"),
            nested("feedback", "Feedback"),
            nested("send_goal_service", "SendGoal"),
            nested("get_result_service", "GetResult"),
            nested("feedback_message", "FeedbackMessage"),
        ];
        self.types.insert(full.to_owned(), action);
    }

    fn action_hashes(&self, full: &str) -> ActionTypeHashes {
        let of = |suffix: &str| self.hash(&format!("{full}_{suffix}"));
        ActionTypeHashes {
            action: self.hash(full),
            goal: of("Goal"),
            result: of("Result"),
            feedback: of("Feedback"),
            send_goal: self.service_hashes(&format!("{full}_SendGoal")),
            get_result: self.service_hashes(&format!("{full}_GetResult")),
            feedback_message: of("FeedbackMessage"),
        }
    }

    /// Describes the messages that all services and actions use, regardless of the registry.
    fn known(&mut self) {
        let field = |name: &str, number: Number| FieldDescription::new(name, number.type_id());
        let fixed = |name: &str| FieldDescription {
            type_id: Number::UInt8.type_id() + ARRAY,
            capacity: 16,
            ..field(name, Number::UInt8)
        };
        let known = [
            (
                TIME,
                vec![
                    field("sec", Number::Int32),
                    field("nanosec", Number::UInt32),
                ],
            ),
            (UUID, vec![fixed("uuid")]),
            (
                "service_msgs/msg/ServiceEventInfo",
                vec![
                    field("event_type", Number::UInt8),
                    FieldDescription::nested("stamp", TIME),
                    // A `char[16]`, which rosidl treats as `uint8[16]`.
                    fixed("client_gid"),
                    field("sequence_number", Number::Int64),
                ],
            ),
        ];
        for (name, fields) in known {
            self.types.insert(name.to_owned(), fields);
        }
    }

    fn service_hashes(&self, full: &str) -> ServiceTypeHashes {
        let of = |suffix: &str| self.hash(&format!("{full}_{suffix}"));
        ServiceTypeHashes {
            service: self.hash(full),
            request: of("Request"),
            response: of("Response"),
            event: of("Event"),
        }
    }

    fn hash(&self, full: &str) -> TypeHash {
        TypeHash(Sha256::digest(self.json(full)).into())
    }

    /// Returns the description as Python's `json.dumps` writes it. All names are identifiers and
    /// need no escapes.
    fn json(&self, full: &str) -> String {
        let mut needed = BTreeMap::new();
        self.needs(full, &mut needed);
        needed.remove(full);
        let mut text = String::from("{\"type_description\": ");
        self.write_type(&mut text, full);
        text.push_str(", \"referenced_type_descriptions\": [");
        for (at, name) in needed.keys().enumerate() {
            if at > 0 {
                text.push_str(", ");
            }
            self.write_type(&mut text, name);
        }
        text.push_str("]}");
        text
    }

    fn needs<'s>(&'s self, full: &'s str, found: &mut BTreeMap<&'s str, ()>) {
        if found.insert(full, ()).is_some() {
            return;
        }
        for field in self.types.get(full).into_iter().flatten() {
            if !field.nested.is_empty() {
                self.needs(&field.nested, found);
            }
        }
    }

    fn fields(&self, full: &str) -> Vec<DescribedField> {
        let fields = self.types.get(full).into_iter().flatten();
        let described = fields.map(|field| DescribedField {
            name: field.name.clone(),
            type_id: field.type_id,
            capacity: field.capacity.into(),
            string_capacity: field.string_capacity.into(),
            nested: field.nested.clone(),
        });
        described.collect()
    }

    fn write_type(&self, text: &mut String, full: &str) {
        // Writing to a String cannot fail.
        write!(text, "{{\"type_name\": \"{full}\", \"fields\": [").unwrap_or_default();
        for (at, field) in self.types.get(full).into_iter().flatten().enumerate() {
            if at > 0 {
                text.push_str(", ");
            }
            let FieldDescription {
                name,
                type_id,
                capacity,
                string_capacity,
                nested,
            } = field;
            write!(
                text,
                "{{\"name\": \"{name}\", \"type\": {{\"type_id\": {type_id}, \"capacity\": {capacity}, \
                 \"string_capacity\": {string_capacity}, \"nested_type_name\": \"{nested}\"}}}}"
            )
            .unwrap_or_default();
        }
        text.push_str("]}");
    }
}

impl FieldDescription {
    fn new(name: &str, type_id: u8) -> Self {
        Self {
            name: name.to_owned(),
            type_id,
            capacity: 0,
            string_capacity: 0,
            nested: String::new(),
        }
    }

    fn nested(name: &str, type_name: &str) -> Self {
        Self {
            nested: type_name.to_owned(),
            ..Self::new(name, NESTED)
        }
    }

    fn at_most_one(name: &str, type_name: &str) -> Self {
        Self {
            capacity: 1,
            nested: type_name.to_owned(),
            ..Self::new(name, NESTED + BOUNDED_SEQUENCE)
        }
    }

    fn of(field: &FieldDefinition, dialect: Dialect) -> Self {
        let mut found = match &field.kind {
            FieldType::Message(name) => Self::nested(&field.name, &name.ros2()),
            // The parser treats it as `uint8`, which has the same values and bytes.
            FieldType::Primitive(_) if base(&field.written) == "byte" => {
                Self::new(&field.name, BYTE)
            }
            FieldType::Primitive(_)
                if dialect == Dialect::Ros2 && base(&field.written) == "char" =>
            {
                Self::new(&field.name, CHAR)
            }
            FieldType::Primitive(Primitive::Number(number)) => {
                Self::new(&field.name, number.type_id())
            }
            FieldType::Primitive(Primitive::Text(text)) => Self::text(&field.name, *text),
            // `time` and `duration` of ROS 1.
            FieldType::Primitive(Primitive::Clock(_)) => Self::nested(&field.name, TIME),
        };
        let (more, capacity) = match field.arity {
            Arity::One => (0, 0),
            Arity::Fixed(length) => (ARRAY, length),
            Arity::Sequence { bound: Some(bound) } => (BOUNDED_SEQUENCE, bound),
            Arity::Sequence { bound: None } => (UNBOUNDED_SEQUENCE, 0),
        };
        found.type_id += more;
        found.capacity = capacity;
        found
    }

    fn text(name: &str, text: StringType) -> Self {
        let bounded = text.bound != u32::MAX;
        let type_id = match (text.wide, bounded) {
            (false, false) => STRING,
            (true, false) => WSTRING,
            (false, true) => BOUNDED_STRING,
            (true, true) => BOUNDED_WSTRING,
        };
        Self {
            string_capacity: if bounded { text.bound } else { 0 },
            ..Self::new(name, type_id)
        }
    }
}

impl Number {
    /// Returns the constant of `type_description_interfaces/msg/FieldType`.
    const fn type_id(self) -> u8 {
        match self {
            Self::Int8 => 2,
            Self::UInt8 => 3,
            Self::Int16 => 4,
            Self::UInt16 => 5,
            Self::Int32 => 6,
            Self::UInt32 => 7,
            Self::Int64 => 8,
            Self::UInt64 => 9,
            Self::Float32 => 10,
            Self::Float64 => 11,
            Self::Bool => 15,
        }
    }
}

/// Returns a type as written, without the length of an array.
fn base(written: &str) -> &str {
    written.split('[').next().unwrap_or(written)
}

/// The parts of an action, in the order of its text.
const ACTION_PARTS: [&str; 3] = ["Goal", "Result", "Feedback"];
const TIME: &str = "builtin_interfaces/msg/Time";
const UUID: &str = "unique_identifier_msgs/msg/UUID";
// Constants of `type_description_interfaces/msg/FieldType`. The arrays of a type have the number of
// the type plus one of the last three constants.
pub(crate) const NESTED: u8 = 1;
/// The `char` of IDL.
pub(crate) const CHAR: u8 = 13;
pub(crate) const BYTE: u8 = 16;
pub(crate) const STRING: u8 = 17;
pub(crate) const WSTRING: u8 = 18;
pub(crate) const BOUNDED_STRING: u8 = 21;
pub(crate) const BOUNDED_WSTRING: u8 = 22;
pub(crate) const ARRAY: u8 = 48;
pub(crate) const BOUNDED_SEQUENCE: u8 = 96;
pub(crate) const UNBOUNDED_SEQUENCE: u8 = 144;
