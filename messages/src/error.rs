use uadp::BuiltinType;

use crate::{TypeHash, TypeName};

/// A text that is no message type name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is no message type name: `package/Name` or `package/msg/Name` expected")]
pub struct NameError {
    text: String,
}

impl NameError {
    /// Only the first 255 bytes or so of `text` are kept.
    pub(crate) fn new(text: &str) -> Self {
        Self {
            text: text.chars().take(255).collect(),
        }
    }
}

/// A message type cannot be made of the definitions at hand.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DefinitionError {
    /// No definition of that name; [`Registry::suggest`](crate::Registry::suggest) has what may be meant.
    #[error("no definition of `{name}`{}", needed_by.as_ref().map(|by| format!(", which `{by}` needs")).unwrap_or_default())]
    Unknown {
        /// The missing type.
        name: TypeName,
        /// The type with a field of it; none when it was asked for itself.
        needed_by: Option<TypeName>,
    },
    /// The type contains itself.
    #[error("`{name}` contains itself")]
    Cyclic {
        /// The type that is met again inside itself.
        name: TypeName,
    },
    /// Messages nested deeper than 32.
    #[error("`{name}` nests messages deeper than 32")]
    TooDeep {
        /// The first type too deep.
        name: TypeName,
    },
    /// More than 4096 fields when flattened, or fixed arrays of more than 64 MiB.
    #[error("`{name}` is too big: {what}")]
    TooBig {
        /// The type that passes the limit.
        name: TypeName,
        /// The limit.
        what: &'static str,
    },
    /// A description of the type is not the one of the hash that was announced.
    #[error("`{name}` is described with the type hash {found}, and {expected} was announced")]
    OtherHash {
        /// The type.
        name: TypeName,
        /// By the description.
        found: TypeHash,
        /// As announced.
        expected: TypeHash,
    },
    /// A line of the text does not follow the dialect.
    #[error("`{name}` line {line}: {reason}: `{text}`")]
    Syntax {
        /// The type being defined.
        name: TypeName,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        reason: &'static str,
        /// The line, cut at 200 characters.
        text: String,
    },
}

/// A plan cannot be compiled.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// The selected field is none of the type's.
    #[error("`{name}` has no field `{path}`; it has {}", if known.is_empty() { "none".to_owned() } else { known.join(", ") })]
    UnknownField {
        /// The message type.
        name: TypeName,
        /// The path asked for.
        path: String,
        /// The paths there are, in message order.
        known: Vec<String>,
    },
    /// A constant that is no value of its field.
    #[error("field `{path}` of `{name}`: `{text}` is not {expected}")]
    Constant {
        /// The message type.
        name: TypeName,
        /// The path of the field.
        path: String,
        /// The text, cut at 64 characters, with `...` behind.
        text: String,
        /// What may stand there, with its article.
        expected: String,
    },
    /// A constant of a length its field cannot have, or with something in it that cannot be written.
    #[error("field `{path}` of `{name}`: {fault}")]
    ConstantFault {
        /// The message type.
        name: TypeName,
        /// The path of the field.
        path: String,
        /// What is wrong with it.
        fault: WriteFault,
    },
    /// A constant for the field that takes the value.
    #[error("field `{path}` of `{name}` takes the value and cannot be a constant too")]
    ConstantOfField {
        /// The message type.
        name: TypeName,
        /// The path of the field.
        path: String,
    },
    /// A part the field has not, or a conversion that is none of its type.
    #[error("field `{path}` of `{name}` {what}")]
    Shape {
        /// The message type.
        name: TypeName,
        /// The path of the field.
        path: String,
        /// Why not, as the rest of a sentence about the field.
        what: &'static str,
    },
    /// ROS 1 bytes of a ROS 2 type, or CDR of a ROS 1 type.
    #[error("`{name}` is a type of the other ROS: its bytes do not travel on this wire")]
    Wire {
        /// The message type.
        name: TypeName,
    },
}

/// What is wrong with the bytes of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// The payload ends inside the field, or a length says more than there is.
    #[error("the message ends too early")]
    Truncated,
    /// The text is not UTF-8 (or, of a `wstring`, not UTF-16).
    #[error("the text is not valid Unicode")]
    Text,
    /// A CDR string without its terminating NUL.
    #[error("the string is not terminated where its length says")]
    Terminator,
    /// More elements or characters than the type's bound.
    #[error("{found} elements, the bound is {bound}")]
    Bound {
        /// What the type allows.
        bound: u32,
        /// What the payload has.
        found: u32,
    },
    /// More elements that take no bytes, such as `std_msgs/Empty` on ROS 1, than are believed of one message.
    #[error("{0} more elements without bytes are too many")]
    WithoutBytes(usize),
    /// Bytes after the last field of a ROS 1 message.
    #[error("{0} bytes left over")]
    TrailingBytes(usize),
    /// A CDR representation identifier other than CDR_BE (0) and CDR_LE (1).
    #[error("CDR representation {0:#06x} is not supported")]
    Encapsulation(u16),
}

/// A message is sound, and what is wanted of it is not there or cannot become what it should.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ValueFault {
    /// The array is too short for the element.
    #[error("element {at} is not there: the array has {found}")]
    Absent {
        /// The element, from 0.
        at: usize,
        /// How many there are.
        found: usize,
    },
    /// No element has that name.
    #[error("no element is named `{0}`")]
    NoName(String),
    /// The type it is to become cannot hold the value.
    #[error("{value} does not fit {}", to.name())]
    OutOfRange {
        /// The value, scaled.
        value: String,
        /// What it should become.
        to: BuiltinType,
    },
    /// The value is no number.
    #[error("a value that is no number cannot become one")]
    NoNumber,
}

/// [`Plan::read`](crate::Plan::read) stopped.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ReadError<E> {
    /// The payload is not a message of the type.
    #[error("{}{fault} (byte {at})", in_field(field))]
    Malformed {
        /// Path of the field, empty outside of any field.
        field: String,
        /// Offset in the payload.
        at: usize,
        /// What is wrong there.
        fault: Fault,
    },
    /// What is wanted of a field cannot be had.
    #[error("{}{fault}", in_field(field))]
    Value {
        /// Path of the field.
        field: String,
        /// Why not.
        fault: ValueFault,
    },
    /// The sink refused a value.
    #[error("the field `{field}` cannot be taken")]
    Sink {
        /// Path of the field.
        field: String,
        /// The sink's reason.
        source: E,
    },
}

/// A [`Source`](crate::Source) has not what is asked for.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SourceError {
    /// No field is left.
    #[error("the field is missing")]
    Missing,
    /// The field has another type; `None` stands for a null value.
    #[error("{} expected, found {}", shape(Some(*expected), *expected_array), shape(*found, *found_array))]
    Type {
        /// The builtin type asked for.
        expected: BuiltinType,
        /// Whether an array was asked for.
        expected_array: bool,
        /// The builtin type there is.
        found: Option<BuiltinType>,
        /// Whether it is an array.
        found_array: bool,
    },
    /// Fields after the last one asked for.
    #[error("{0} fields too many")]
    LeftOver(usize),
    /// The field's own bytes are wrong.
    #[error("{0}")]
    Malformed(String),
    /// The value cannot become what the field of the message holds.
    #[error(transparent)]
    Value(ValueFault),
}

/// What is wrong with a value to be written.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WriteFault {
    /// The source has it not.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// An array of another length than the type's fixed one.
    #[error("{found} elements, the type has {expected}")]
    Length {
        /// The fixed length.
        expected: u32,
        /// Elements in the value.
        found: usize,
    },
    /// More elements or characters than the type's bound or than 32 bits count.
    #[error("{found} elements, the bound is {bound}")]
    Bound {
        /// What the type allows.
        bound: u32,
        /// What the value has.
        found: usize,
    },
    /// More elements without a value, messages that are empty, than are believed of one message.
    #[error("{0} more elements without a value are too many")]
    WithoutValue(usize),
    /// Part of an array: what stands in the rest of it, nobody says.
    #[error("a part of an array is read and cannot be written")]
    Part,
    /// Several fields that do not follow each other as in the message, or of which one is in another.
    #[error("fields in another order than that of the message are read and cannot be written")]
    Order,
    /// A text with a NUL, which CDR cannot carry.
    #[error("a NUL inside a text")]
    Nul,
    /// A duration of more than 2^31 seconds, or no number.
    #[error("the duration does not fit a ROS duration")]
    Duration,
}

/// [`Plan::write`](crate::Plan::write) stopped; nothing was appended.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}{fault}", in_field(field))]
pub struct WriteError {
    /// Path of the field, empty outside of any field.
    pub field: String,
    /// What is wrong with it.
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
