//! Calls in the document: their executors, and the services and actions that offer them.

use super::alarm::AcknowledgesEntry;
use super::patterns::{DURATION, EXPANDED_NODE_ID};
use super::permissions::CallPermissionsEntry;
use super::request::{LeafForm, is_scalar};
use crate::call::Assigned;
use crate::read::{FromNode, Located, NodeReader, document, inline_schema};
use crate::tree::{TextSpan, YamlKind, YamlNode};

document! {
    /// A call that is executed in one space: a service or action of ROS, a Method of an OPC UA
    /// server, or a call of a component.
    struct CallEntry {
        /// The OPC UA Method, such as ns=2;i=61. An action takes five numbers: this number for its
        /// goal, the next four for its cancel, its result, its feedback and its status.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        node: String,
        /// Name of the Method; dots separate its folders, such as Conveyor.Switch.
        #[schemars(required, length(min = 1, max = 512))]
        name: String,
        /// Description for users.
        about: String,
        /// The space that executes it: 0 for the OPC UA side, otherwise an id of `spaces`.
        #[schemars(required, range(max = 232))]
        origin: u16,
        /// As with a variable.
        #[schemars(range(min = 1, max = 65535))]
        alias: u16,
        /// ROS services or actions, a single binding or a list, at most one per space. The binding
        /// of the origin executes the call; the bridge offers the bindings of other spaces there
        /// and requests the call. In a space without a binding the call has its own name, such as
        /// /ua_1_2_61.
        ros: CallBindings,
        /// With `origin: 0`: the Method of another OPC UA server that executes the call.
        opcua: MethodEntry,
        /// `alarms`, with `origin: 0` and without `opcua`: the server executes the call, and
        /// acknowledges an alarm. The request has the texts `event_id` and `comment`, the response
        /// `success` and `message`, as in ua_msgs/AcknowledgeAlarm. The event_id is that of a status
        /// of `reports: alarms`.
        acknowledges: AcknowledgesEntry,
        /// Whether requests from other hosts are executed. Default: only requests from a loopback
        /// address, because the sender of unsecured requests is unknown.
        open: bool,
        /// Time limit of the service or Method, and of the caller; default 30s. For an action: the
        /// time until a goal is accepted or rejected.
        #[schemars(regex(pattern = DURATION))]
        timeout: String,
        /// Roles that may call the Method at the server of the cell.
        permissions: CallPermissionsEntry,
    }

    /// A service or action of ROS that executes or requests a call: exactly one of `service` and
    /// `action`.
    #[schemars(extend("oneOf" = [{ "required": ["service"] }, { "required": ["action"] }]))]
    struct CallBindingEntry {
        /// Space of the service or action. Default: the origin of the call.
        #[schemars(range(min = 1, max = 232))]
        space: u16,
        /// Absolute name of the service, such as /conveyor/switch.
        #[schemars(regex(pattern = "^/"))]
        service: String,
        /// Absolute name of the action, such as /navigate_to_pose: in ROS 1 the name before /goal,
        /// /cancel and /result.
        #[schemars(regex(pattern = "^/"))]
        action: String,
        /// Type of the service or action, such as std_srvs/SetBool.
        #[schemars(required)]
        r#type: String,
        /// For a requesting service: the sources of the fields of the call's request, such as {id:
        /// 6, on: {field: data}}: a constant, or a field of the request here. A message includes
        /// all its fields. Fields without an entry come from the field of the same name.
        request: FieldMapEntry,
        /// For a requesting service: the sources of the fields of the response here, such as
        /// {success: true, message: {field: text}}: a constant, or a field of the call's response.
        response: FieldMapEntry,
        /// For a requesting action: the sources of the fields of the executed goal, like `request`:
        /// constants, or fields of the goal here.
        goal: FieldMapEntry,
        /// For a requesting action: the sources of the fields of the feedback here, like
        /// `response`: constants, or fields of the feedback of the executed action.
        feedback: FieldMapEntry,
        /// For a requesting action: the sources of the fields of the result here, like `response`:
        /// constants, or fields of the result of the executed action.
        result: FieldMapEntry,
    }

    /// A Method of an OPC UA server: of one of `servers`, or of the server at an endpoint.
    #[schemars(extend("oneOf" = [{ "required": ["server"] }, { "required": ["endpoint"] }]))]
    struct MethodEntry {
        /// The server, by its `name` among `servers`.
        server: String,
        /// The endpoint of the server, such as opc.tcp://127.0.0.1:4841, for anonymous users.
        #[schemars(regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// The Object of the Method, such as nsu=urn:plc;s=Line: its namespace by the URI, which
        /// stays valid if the indexes of the server change, or by the index there, such as
        /// ns=3;i=7.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        object: String,
        /// The Method, likewise.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        method: String,
    }
}

/// Sources of fields: path of the field, its position, and the source.
#[derive(Clone, Debug)]
pub(crate) struct FieldMapEntry(pub(crate) Vec<(String, TextSpan, Assigned)>);

impl FromNode for FieldMapEntry {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let form = LeafForm {
            map: "a map of field and value, or of field and {field: ..}",
            leaf: "a value, a list, or {field: name}",
            constant: Assigned::Constant,
            of_map: |node| {
                let YamlKind::Map(pairs) = &node.kind else {
                    return None;
                };
                match &pairs[..] {
                    [(key, value)] if is_scalar(key, "field") => match &value.kind {
                        YamlKind::Scalar(text) => Some(Assigned::Field(text.clone().into_owned())),
                        YamlKind::Null | YamlKind::List(_) | YamlKind::Map(_) => None,
                    },
                    _ => None,
                }
            },
        };
        form.read(node, reader).map(Self)
    }
}

inline_schema!(FieldMapEntry, _generator => schemars::json_schema!({ "type": "object" }));

/// A service or action of a call, or a list of them.
#[derive(Clone, Debug)]
pub(crate) struct CallBindings(pub(crate) Vec<Located<CallBindingEntry>>);

impl FromNode for CallBindings {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let is_one = matches!(node.kind, YamlKind::Map(_));
        let wanted =
            "a service such as `{service: /a/b, type: std_srvs/SetBool}`, or a list of them";
        reader.one_or_list(node, is_one, wanted).map(Self)
    }
}

inline_schema!(CallBindings, generator => {
    let one = generator.subschema_for::<CallBindingEntry>();
    schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one }] })
});
