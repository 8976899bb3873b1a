//! ROS message definitions at run time, and conversion of ROS messages to and from OPC UA fields.
//!
//! A [`TypeRegistry`] holds `.msg` texts of one [`Dialect`] and creates [`MessageType`]s from them:
//! the flattened list of [`Leaf`]s, and for ROS 1 the md5 and the full definition text that a
//! publisher announces. A [`MessagePlan`] is compiled once per message type, [`Selection`] and
//! [`Wire`]. It reads the bytes of a message into a [`FieldSink`], or takes the fields of a
//! [`FieldSupplier`] and writes the bytes. Neither direction builds a tree of values.
//!
//! ```
//! use messages::{Dialect, MessagePlan, TypeRegistry, Selection, Wire};
//!
//! let mut registry = TypeRegistry::bundle(Dialect::Ros1);
//! registry.add(&"line/Cover".parse()?, "Header header\ngeometry_msgs/Point position\nuint8 colour")?;
//! let cover = registry.get(&"line/Cover".parse()?)?;
//! let paths: Vec<&str> = cover.leaves().iter().map(|leaf| leaf.path.as_str()).collect();
//! assert_eq!(paths, ["header.stamp", "header.frame_id", "position.x", "position.y", "position.z", "colour"]);
//! let plan = MessagePlan::compile(&cover, &Selection::Field("position.x".to_owned()),
//! Wire::Ros1)?; assert_eq!(plan.leaves().len(), 1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Definitions
//! A parser of this crate reads both dialects. Definition texts come from peers, and published
//! parsers panic on hostile texts (an array length of twenty digits) or support one dialect only.
//!
//! # Services and actions
//! A `.srv` text defines two messages, `package/NameRequest` and `package/NameResponse`. An
//! `.action` text of ROS 1 defines seven messages, as in genaction, and a text of ROS 2 the
//! messages of [`ActionMessages`]. They are messages like any other, except that the messages of a
//! service are found only through the service.
//!
//! # Values
//! | ROS | field |
//! |---|---|
//! | `bool` | Boolean (any byte but 0 is true) |
//! | `int8`, ROS 1 `byte` | SByte |
//! | `uint8`, `char`, ROS 2 `byte` | Byte |
//! | `int16` .. `uint64` | Int16 .. UInt64 |
//! | `float32`, `float64` | Float, Double |
//! | `string`, `wstring` | String |
//! | ROS 1 `time`, `builtin_interfaces/Time` | DateTime, rounded down to 100 ns; see [`time_to_date_time`] |
//! | ROS 1 `duration`, `builtin_interfaces/Duration` | Double, milliseconds; see [`duration_to_millis`] |
//! | array of `uint8`, `char` or ROS 2 `byte` | ByteString, a scalar |
//! | array of anything else that is not a message | array of the above |
//! | message | its fields, named `outer.inner` |
//! | array of messages | array of structures, one field; see [`FieldSink::structures`] |
//!
//! `seq` of a ROS 1 `std_msgs/Header` is not a field: it is skipped when read and 0 when written. A
//! ROS 2 topic of the type `builtin_interfaces/Time` or `Duration` itself has a single field named
//! `data`.
//!
//! # Bytes
//! ROS 1 is packed little endian. CDR is plain XCDR version 1 (DDS-RTPS 10.2, DDS-XTypes 7.4.1).
//! Alignment counts from the byte after the 4 byte encapsulation header, a string's length includes
//! its NUL, and an empty message is one byte. A `wstring` is a count of UTF-16 units, each written
//! as 4 bytes, as in `rmw_cyclonedds` and `rmw_fastrtps`.

mod action_calls;
mod bundle;
mod convert;
mod definition;
mod description;
mod error;
mod fields;
mod idl;
mod library;
mod message;
mod name;
mod plan;
mod registry;
mod resolve;
mod service;
mod structure;
mod type_hash;

pub use action_calls::{ActionCalls, reason_of};
pub use convert::{date_time_to_time, duration_to_millis, millis_to_duration, time_to_date_time};
pub use definition::Constant;
pub use description::{DescribedField, DescribedType};
pub use error::{
    DefinitionError, MessageFault, PlanError, ReadError, SourceError, TypeNameError, ValueFault,
    WriteError, WriteFault,
};
pub use fields::{FieldSink, FieldSupplier, NoFields};
pub use library::{
    DefinitionText, DefinitionTexts, Language, Library, NoTexts, Noted, TextKind, check_text,
};
pub use message::{ArrayRank, Leaf, MessageType, standard_type};
pub use name::{Dialect, TypeName};
pub use plan::{
    ArrayPart, Conversion, Literal, MessagePlan, Selected, Selection, Wire, constant, is_lossless,
};
pub use registry::{PeerDefinitions, TypeRegistry};
pub use service::{ActionMessages, ActionType, ServiceType};
pub use structure::{MemberKind, MessageStructure, StructureMember};
pub use type_hash::{ActionTypeHashes, NoTypeHash, ServiceTypeHashes, TypeHash};
