//! Bindings in the document: the ROS topics and services of a value, and the fields that it has
//! there. Patterns of topics.

use super::patterns::DURATION;
use super::request::Request;
use crate::read::{FromNode, Located, NodeReader, choice, document, inline_schema};
use crate::tree::{YamlKind, YamlNode};

document! {
    /// ROS topics that become values when they appear.
    struct PatternEntry {
        /// The topics, such as /robot*/joint_states: `*` matches one or more characters of a part
        /// between slashes, a part `**` matches any number of parts.
        #[schemars(required, regex(pattern = r"^/.*\*"))]
        topics: String,
        /// Excluded topics or patterns, such as [/robot9/**].
        exclude: Vec<Located<String>>,
        /// The ROS space of the topics.
        #[schemars(required, range(min = 1, max = 1))]
        origin: u16,
        /// The OPC UA node of each topic, such as ns=2;i=10{1}: {1} is the text that the first
        /// wildcard matches, {2} the second. A topic without a number from 1 to 65535 is ignored
        /// with a log message.
        #[schemars(required, regex(pattern = r"^ns=[0-9]+;[isgb]="))]
        node: String,
        /// Name of the node, such as Robot{1}Joints.
        #[schemars(required, length(min = 1))]
        name: String,
        /// Replaces the identifier in topic names if the node id is not a number, such as 10{1}.
        alias: String,
        /// Message type, such as sensor_msgs/JointState: topics of another type are ignored.
        /// Default: any type.
        r#type: String,
        /// The field of the value, or a part of it, as in a binding. Default: the whole message, a
        /// field per leaf.
        field: String,
        /// Several fields of the message instead of `field`, as in a binding.
        fields: FieldList,
        /// As in a binding.
        scale: f64,
        /// As in a binding.
        offset: f64,
        /// As in a binding.
        invert: bool,
        /// As in a binding.
        out_of_range: OutOfRangeEntry,
        /// Form of the messages: `fields` (the default) as OPC UA values, `bytes` unchanged, one
        /// ByteString each, `structure` as one OPC UA structure each, as in a binding.
        r#as: AsEntry,
    }

    /// A ROS topic or service of a value: exactly one of `topic`, `call`, `answer` and `poll`.
    struct BindingEntry {
        /// Space of the topic or service. Default: the origin of the value.
        #[schemars(range(min = 1, max = 232))]
        space: u16,
        /// Absolute topic name, such as /conveyor/running.
        #[schemars(regex(pattern = "^/"))]
        topic: String,
        /// Absolute name of a ROS 1 service that is called with each value from another space:
        /// `field` of the request takes the value, or `fields` its fields. Without them the request
        /// is fixed, and `when` selects the values that call.
        #[schemars(regex(pattern = "^/"))]
        call: String,
        /// Node of the variable with a `call`, such as ns=2;i=20: the value is the response of this
        /// service: a field of it, several fields or all.
        #[schemars(regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        answer: String,
        /// Absolute name of a ROS 1 service that is called with `request` in the period `every`:
        /// the value is its response: a field of it, several fields or all.
        #[schemars(regex(pattern = "^/"))]
        poll: String,
        /// Message type, such as std_msgs/Bool. Default: the std_msgs type for the `type` of the
        /// variable. With `call` and `poll` the service type, such as std_srvs/SetBool, which is
        /// required.
        r#type: String,
        /// The field of the value, such as data or pose.position.x. Default: the whole message, a
        /// field per leaf. A part of an array can be read: an element such as position[2], an
        /// element by the text at its position in another array of the message, such as
        /// position[name=joint_3], several elements such as ranges[0:90].
        field: String,
        /// Several fields of the message instead of `field`, in this order, such as [linear.x,
        /// angular.z]; a converted field such as {field: linear.x, scale: 1000}. For a written
        /// message they are in the order of the message, and all other fields are zero or empty.
        fields: FieldList,
        /// Factor: the value in OPC UA is the value of the field times `scale` plus `offset`; the
        /// inverse is written to ROS.
        scale: f64,
        /// Added to the value of the field for OPC UA, after `scale`; subtracted again for ROS.
        offset: f64,
        /// The value in OPC UA is true if the field is false.
        invert: bool,
        /// Numbers that do not fit the target type: `refuse` (the default) drops and counts them,
        /// `clamp` replaces them by the nearest possible number. Required if this can happen;
        /// integers are rounded to the nearest.
        out_of_range: OutOfRangeEntry,
        /// With `call` and `poll`: fixed fields of the request, such as {id: 12, pose: {x: 1.5}} or
        /// {pose.x: 1.5}; the name of a constant of the request gives its value. All other fields
        /// are zero or empty.
        request: Request,
        /// With `call` and without `field` and `fields`: the value that calls the service. Default:
        /// true for a Boolean, every value for other types.
        #[schemars(extend("type" = ["string", "boolean", "number", "null"]))]
        when: String,
        /// With `call` and `poll`: time limit of the service; default 5s.
        #[schemars(regex(pattern = DURATION))]
        timeout: String,
        /// With `poll`: period of the calls; default 1s.
        #[schemars(regex(pattern = DURATION))]
        every: String,
        /// Form of the message: `fields` (the default) as OPC UA values; `bytes` unchanged, one
        /// ByteString, for large or deeply nested messages such as images, which a reader can
        /// decode only with the message type, and not together with `field`; `structure` as one OPC
        /// UA structure, which the DataSetMetaData describe; `field` may then select a nested
        /// message.
        r#as: AsEntry,
    }

    /// One of several fields, with its conversion.
    struct FieldEntry {
        /// The field, as in a binding with a single field.
        #[schemars(required)]
        field: String,
        /// As in a binding with a single field.
        scale: f64,
        /// As in a binding with a single field.
        offset: f64,
        /// As in a binding with a single field.
        invert: bool,
        /// As in a binding with a single field.
        out_of_range: OutOfRangeEntry,
    }
}

choice! {
    enum AsEntry {
        /// A value per field.
        Fields = "fields",
        /// The message as it is, one ByteString.
        Bytes = "bytes",
        /// The message as one structure.
        Structure = "structure",
    }

    enum OutOfRangeEntry {
        /// The value is dropped.
        Refuse = "refuse",
        /// The nearest value that fits.
        Clamp = "clamp",
    }
}

/// Several fields of a message.
#[derive(Clone, Debug)]
pub(crate) struct FieldList(pub(crate) Vec<Located<FieldEntry>>);

impl FromNode for FieldList {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let YamlKind::List(items) = &node.kind else {
            reader.wrong(node, "a list of fields such as `[linear.x, angular.z]`");
            return None;
        };
        let read = items.iter().map(|item| match &item.kind {
            YamlKind::Scalar(text) => Located {
                place: item.place,
                value: Some(FieldEntry {
                    field: Some(Located {
                        place: item.place,
                        value: Some(text.clone().into_owned()),
                    }),
                    ..FieldEntry::default()
                }),
            },
            YamlKind::Null | YamlKind::List(_) | YamlKind::Map(_) => reader.at(item),
        });
        Some(Self(read.collect()))
    }
}

inline_schema!(FieldList, generator => {
    let one = generator.subschema_for::<FieldEntry>();
    schemars::json_schema!({ "type": "array", "items": { "anyOf": [{ "type": "string" }, one] } })
});

/// A binding or a list of bindings.
#[derive(Clone, Debug)]
pub(crate) struct Bindings(pub(crate) Vec<Located<BindingEntry>>);

impl FromNode for Bindings {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let is_one = matches!(node.kind, YamlKind::Map(_));
        let wanted = "a binding such as `{topic: /a/b, type: std_msgs/Bool, field: data}`, or a list of them";
        reader.one_or_list(node, is_one, wanted).map(Self)
    }
}

inline_schema!(Bindings, generator => {
    let one = generator.subschema_for::<BindingEntry>();
    schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one }] })
});
