use uadp::BuiltinType;

use crate::{TypeHash, TypeName};

/// Error for a text that is not a message type name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is not a message type name: expected `package/Name` or `package/msg/Name`")]
pub struct TypeNameError {
    text: String,
}

impl TypeNameError {
    /// Creates the error. Only about the first 255 bytes of `text` are kept.
    pub(crate) fn new(text: &str) -> Self {
        Self {
            text: text.chars().take(255).collect(),
        }
    }
}

/// Error while creating a message type from the available definitions.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DefinitionError {
    /// No definition of that name; [`TypeRegistry::suggest`](crate::TypeRegistry::suggest) returns
    /// a similar name.
    #[error("no definition of `{name}`{}", needed_by.as_ref().map(|by| format!(", which `{by}` uses")).unwrap_or_default())]
    Unknown {
        /// The missing type.
        name: TypeName,
        /// The type with a field of the missing type; `None` if the missing type was requested
        /// itself.
        needed_by: Option<TypeName>,
    },
    /// The type contains itself.
    #[error("`{name}` contains itself")]
    Cyclic {
        /// The type that occurs inside itself.
        name: TypeName,
    },
    /// Messages nested deeper than 32.
    #[error("`{name}` nests messages deeper than 32")]
    TooDeep {
        /// The first type that is too deep.
        name: TypeName,
    },
    /// More than 4096 fields when flattened, or fixed arrays of more than 64 MiB.
    #[error("`{name}` is too big: {what}")]
    TooBig {
        /// The type that exceeds the limit.
        name: TypeName,
        /// The limit.
        what: &'static str,
    },
    /// A description of the type does not match the announced hash.
    #[error("the description of `{name}` has the type hash {found}, but {expected} was announced")]
    OtherHash {
        /// The type.
        name: TypeName,
        /// Hash of the description.
        found: TypeHash,
        /// Announced hash.
        expected: TypeHash,
    },
    /// A line of the text does not follow the dialect.
    #[error("`{name}` line {line}: {reason}: `{text}`")]
    Syntax {
        /// The type being defined.
        name: TypeName,
        /// Line, from 1.
        line: usize,
        /// Description of the error.
        reason: &'static str,
        /// The line, cut at 200 characters.
        text: String,
    },
}

/// Error while compiling a plan.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// The type has no field of the selected name.
    #[error("`{name}` has no field `{path}`; it has {}", if known.is_empty() { "none".to_owned() } else { known.join(", ") })]
    UnknownField {
        /// The message type.
        name: TypeName,
        /// The requested path.
        path: String,
        /// The available paths, in message order.
        known: Vec<String>,
    },
    /// A constant that is not a value of its field.
    #[error("field `{path}` of `{name}`: `{text}` is not {expected}")]
    Constant {
        /// The message type.
        name: TypeName,
        /// The path of the field.
        path: String,
        /// The text, cut at 64 characters with `...` appended.
        text: String,
        /// The expected value, with its article.
        expected: String,
    },
    /// A constant with an invalid length for its field, or with content that cannot be written.
    #[error("field `{path}` of `{name}`: {fault}")]
    ConstantFault {
        /// The message type.
        name: TypeName,
        /// The path of the field.
        path: String,
        /// Description of the error.
        fault: WriteFault,
    },
    /// A constant for a field that takes the value.
    #[error("field `{path}` of `{name}` takes the value, so it cannot be a constant")]
    ConstantOfField {
        /// The message type.
        name: TypeName,
        /// The path of the field.
        path: String,
    },
    /// A part that the field does not have, or a conversion that does not match its type.
    #[error("field `{path}` of `{name}` {what}")]
    Shape {
        /// The message type.
        name: TypeName,
        /// The path of the field.
        path: String,
        /// The reason, as the rest of a sentence about the field.
        what: &'static str,
    },
    /// ROS 1 bytes of a ROS 2 type, or CDR of a ROS 1 type.
    #[error("`{name}` is a type of the other ROS version, so its bytes cannot be used here")]
    Wire {
        /// The message type.
        name: TypeName,
    },
}

/// Error in the bytes of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MessageFault {
    /// The payload ends inside the field, or a length exceeds the payload.
    #[error("the message ends too early")]
    Truncated,
    /// The text is not UTF-8 (or not UTF-16 for a `wstring`).
    #[error("the text is not valid Unicode")]
    Text,
    /// A CDR string without its terminating NUL.
    #[error("the string does not end at its announced length")]
    Terminator,
    /// More elements or characters than the bound of the type.
    #[error("{found} elements exceed the bound of {bound}")]
    Bound {
        /// The bound of the type.
        bound: u32,
        /// The number in the payload.
        found: u32,
    },
    /// More elements without bytes, such as `std_msgs/Empty` on ROS 1, than are accepted in one
    /// message.
    #[error("{0} more elements without bytes exceed the limit")]
    WithoutBytes(usize),
    /// Bytes after the last field of a ROS 1 message.
    #[error("{0} bytes left over")]
    TrailingBytes(usize),
    /// A CDR representation identifier other than CDR_BE (0) and CDR_LE (1).
    #[error("CDR representation {0:#06x} is not supported")]
    Encapsulation(u16),
}

/// Error for a valid message in which the selected value is missing or cannot be converted.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ValueFault {
    /// The array is too short for the element.
    #[error("element {at} does not exist: the array has {found} elements")]
    Absent {
        /// The element, from 0.
        at: usize,
        /// The number of elements.
        found: usize,
    },
    /// No element has that name.
    #[error("no element has the name `{0}`")]
    NoName(String),
    /// The target type cannot hold the value.
    #[error("{value} does not fit {}", to.name())]
    OutOfRange {
        /// The value, scaled.
        value: String,
        /// The target type.
        to: BuiltinType,
    },
    /// The value is not a number.
    #[error("NaN cannot become an integer")]
    NoNumber,
}

/// Error of [`MessagePlan::read`](crate::MessagePlan::read).
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ReadError<E> {
    /// The payload is not a message of the type.
    #[error("{}{fault} (byte {at})", in_field(field))]
    Malformed {
        /// Path of the field, empty outside of any field.
        field: String,
        /// Offset in the payload.
        at: usize,
        /// Description of the error.
        fault: MessageFault,
    },
    /// The selected value of a field is not available.
    #[error("{}{fault}", in_field(field))]
    Value {
        /// Path of the field.
        field: String,
        /// The reason.
        fault: ValueFault,
    },
    /// The sink refused a value.
    #[error("cannot use the field `{field}`")]
    Sink {
        /// Path of the field.
        field: String,
        /// The sink's reason.
        source: E,
    },
}

/// Error of a [`FieldSupplier`](crate::FieldSupplier) without the requested value.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SourceError {
    /// No field is left.
    #[error("the field is missing")]
    Missing,
    /// The field has another type; `None` stands for a null value.
    #[error("{} expected, found {}", shape(Some(*expected), *expected_array), shape(*found, *found_array))]
    Type {
        /// The requested builtin type.
        expected: BuiltinType,
        /// Whether an array was requested.
        expected_array: bool,
        /// The actual builtin type.
        found: Option<BuiltinType>,
        /// Whether the actual value is an array.
        found_array: bool,
    },
    /// Fields after the last requested field.
    #[error("{0} fields too many")]
    LeftOver(usize),
    /// The field's own bytes are invalid.
    #[error("{0}")]
    Malformed(String),
    /// The value cannot be converted to the type of the message field.
    #[error(transparent)]
    Value(ValueFault),
}

/// Error in a value to be written.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WriteFault {
    /// The source does not have the value.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// An array with another length than the fixed length of the type.
    #[error("{found} elements, but the type has {expected}")]
    Length {
        /// The fixed length.
        expected: u32,
        /// Elements in the value.
        found: usize,
    },
    /// More elements or characters than the bound of the type or than 32 bits count.
    #[error("{found} elements exceed the bound of {bound}")]
    Bound {
        /// The bound of the type.
        bound: u32,
        /// The number in the value.
        found: usize,
    },
    /// More elements without a value (empty messages) than are accepted in one message.
    #[error("{0} more elements without a value exceed the limit")]
    WithoutValue(usize),
    /// Part of an array: the rest of the array is unknown.
    #[error("a part of an array can only be read")]
    Part,
    /// Several fields in another order than in the message, or of which one contains another.
    #[error("fields in another order than in the message can only be read")]
    Order,
    /// A text with a NUL, which CDR cannot carry.
    #[error("a NUL inside a text")]
    Nul,
    /// A duration of more than 2^31 seconds, or not a number.
    #[error("the duration does not fit a ROS duration")]
    Duration,
}

/// Error of [`MessagePlan::write`](crate::MessagePlan::write); nothing was appended.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}{fault}", in_field(field))]
pub struct WriteError {
    /// Path of the field, empty outside of any field.
    pub field: String,
    /// Description of the error.
    #[source]
    pub fault: WriteFault,
}

fn in_field(field: &str) -> String {
    if field.is_empty() {
        String::new()
    } else {
        format!("field `{field}`: ")
    }
}

fn shape(builtin: Option<BuiltinType>, array: bool) -> String {
    format!(
        "{}{}",
        builtin.map_or("null", BuiltinType::name),
        if array { "[]" } else { "" }
    )
}
