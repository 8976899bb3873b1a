//! The nodes of the address space, computed from the mapping before the server is built.

use std::collections::{BTreeMap, HashSet};

use bridge_node::CallField;
use mappings::{History, Mapping, Meaning, NodeIdText, SpaceId, TopicId, Variable};
use messages::{ArrayRank, Leaf};
use opcua::types::{ByteString, DataTypeId, Identifier, NodeId, Variant, VariantTypeId};
use uadp::BuiltinType;

use crate::structures::{MappedTypes, Structure, VariableStructures};

/// The nodes of the mapped topics and their namespaces.
#[derive(Debug)]
pub(crate) struct Layout {
    /// The NamespaceArray. Index 0 is the namespace of OPC UA, index 1 the namespace of the
    /// application (OPC 10000-5, 6.3.1).
    pub(crate) namespaces: Vec<String>,
    pub(crate) topics: Vec<TopicNode>,
    /// The DataTypes of the topics' fields.
    pub(crate) structures: Vec<Structure>,
}

/// The nodes of a topic.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TopicNode {
    pub(crate) topic: TopicId,
    pub(crate) node: NodeId,
    pub(crate) name: String,
    /// The nodes of the fields of the DataSet. If the topic has a single field, the field has the
    /// node of the topic.
    pub(crate) fields: Vec<FieldNode>,
    /// True if the fields are component variables of the topic's variable. The value of that
    /// variable is a Variant array of all fields.
    pub(crate) compound: bool,
    /// Units, ranges and descriptions of the values.
    pub(crate) meaning: Meaning,
    /// True if the values come from another server or from the conditions of this server. Clients
    /// cannot write them.
    pub(crate) sourced: bool,
    /// True if the values are written to another server; its result answers the writes of clients.
    pub(crate) targeted: bool,
    /// True if past values are kept.
    pub(crate) historizing: bool,
}

/// The node of a field of a DataSet.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FieldNode {
    pub(crate) node: NodeId,
    pub(crate) name: String,
    pub(crate) shape: VariableShape,
    /// The DataType of the structure, or of the structures in its array, if it is known.
    pub(crate) structure: Option<NodeId>,
}

/// The builtin type of a variable's values and if they are arrays; `None` if the mapping leaves the
/// type open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct VariableShape(pub(crate) Option<(BuiltinType, bool)>);

/// The reason why a mapping cannot be served.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum LayoutError {
    #[error(
        "namespace index {index} is to be {wanted}, but in this server it is {actual}; \
         give {wanted} another index in the mapping"
    )]
    Index {
        index: u16,
        wanted: String,
        actual: String,
    },
    #[error("namespace {uri} is to have the indexes {first} and {second}: a server has a URI once")]
    Twice {
        uri: String,
        first: u16,
        second: u16,
    },
    #[error("the node {node} of {topic} is in namespace {index}, which the mapping gives no URI")]
    NoUri {
        topic: TopicId,
        node: NodeId,
        index: u16,
    },
    #[error("the node {node} of {topic} is the node of another variable already")]
    Duplicate { topic: TopicId, node: NodeId },
    #[error("namespace index {0} is higher than a server with {MOST_NAMESPACES} namespaces has")]
    TooHigh(u16),
}

impl Layout {
    /// Computes the nodes of `mapping`.
    ///
    /// # Errors
    /// Returns the errors of [`new`](Self::new).
    pub(crate) fn of(mapping: &Mapping, types: &mut MappedTypes) -> Result<Self, LayoutError> {
        let mut structures = VariableStructures::default();
        let topics = mapping.variables().iter();
        let history = mapping.server().history;
        let topics =
            topics.map(|variable| TopicNode::of(variable, history, (&mut *types, &mut structures)));
        let layout = Self::new(
            &mapping.server().application_uri,
            mapping.namespaces(),
            topics.collect(),
        )?;
        Ok(Self {
            structures: structures.into_vec(),
            ..layout
        })
    }

    /// Computes the nodes of another mapping in a server that runs with these namespaces. Also
    /// returns the parts of the mapping that need a restart of the server, as text for the
    /// operator.
    ///
    /// # Errors
    /// Returns an error for a node that conflicts with other nodes.
    pub(crate) fn within(
        running: &[String],
        mapping: &Mapping,
        types: &mut MappedTypes,
    ) -> Result<(Self, Vec<String>), LayoutError> {
        let others = mapping
            .namespaces()
            .iter()
            .filter(|(index, uri)| running.get(usize::from(**index)) != Some(*uri));
        let others: Vec<u16> = others.map(|(index, _)| *index).collect();
        let mut structures = VariableStructures::default();
        let topics = mapping.variables().iter();
        let history = mapping.server().history;
        let topics =
            topics.map(|variable| TopicNode::of(variable, history, (&mut *types, &mut structures)));
        let is_here = |topic: &TopicNode| !others.contains(&topic.node.namespace);
        let layout = Self {
            namespaces: running.to_vec(),
            topics: topics.filter(is_here).collect(),
            structures: Vec::new(),
        };
        layout.check()?;
        let mut structures = structures.into_vec();
        structures.retain(|one| !others.contains(&one.namespace));
        let layout = Self {
            structures,
            ..layout
        };
        let restart = others
            .iter()
            .map(|index| format!("namespaces ({index} and its nodes)"));
        Ok((layout, restart.collect()))
    }

    /// Gives every namespace its index and checks that the nodes do not conflict.
    ///
    /// Indexes that the mapping skips are filled, because the NamespaceArray has no gaps.
    ///
    /// # Errors
    /// Returns an error for an index or a node that is not available.
    pub(crate) fn new(
        application_uri: &str,
        wanted: &BTreeMap<u16, String>,
        topics: Vec<TopicNode>,
    ) -> Result<Self, LayoutError> {
        let layout = Self {
            namespaces: namespace_array(application_uri, wanted)?,
            topics,
            structures: Vec::new(),
        };
        layout.check()?;
        Ok(layout)
    }

    /// Checks that the nodes do not conflict.
    fn check(&self) -> Result<(), LayoutError> {
        let mut taken = HashSet::new();
        for topic in &self.topics {
            let known = usize::from(topic.node.namespace) < self.namespaces.len();
            if topic.node.namespace == 0 || !known {
                return Err(LayoutError::NoUri {
                    topic: topic.topic,
                    node: topic.node.clone(),
                    index: topic.node.namespace,
                });
            }
            for node in topic.nodes() {
                if !taken.insert(node.clone()) {
                    return Err(LayoutError::Duplicate {
                        topic: topic.topic,
                        node: node.clone(),
                    });
                }
            }
        }
        Ok(())
    }
}

fn namespace_array(
    application_uri: &str,
    wanted: &BTreeMap<u16, String>,
) -> Result<Vec<String>, LayoutError> {
    let fixed = [OPC_UA_URI, application_uri];
    let highest = wanted
        .keys()
        .next_back()
        .copied()
        .unwrap_or_default()
        .max(1);
    if highest >= MOST_NAMESPACES {
        return Err(LayoutError::TooHigh(highest));
    }
    let mut array = Vec::new();
    for index in 0..=highest {
        let uri = match (fixed.get(usize::from(index)), wanted.get(&index)) {
            (Some(actual), Some(wanted)) if wanted != actual => {
                return Err(LayoutError::Index {
                    index,
                    wanted: wanted.clone(),
                    actual: (*actual).to_owned(),
                });
            }
            (Some(actual), _) => (*actual).to_owned(),
            (None, Some(wanted)) => wanted.clone(),
            (None, None) => format!("urn:ua-bridge:unused:{index}"),
        };
        if let Some(first) = array.iter().position(|earlier| *earlier == uri) {
            let first = u16::try_from(first).unwrap_or(u16::MAX);
            return Err(LayoutError::Twice {
                uri,
                first,
                second: index,
            });
        }
        array.push(uri);
    }
    Ok(array)
}

/// Returns the meaning of a variable. Without a description in the mapping, the description names
/// the topic and its ROS topics.
fn described(variable: &Variable) -> Meaning {
    let mut meaning = Meaning::clone(&variable.meaning);
    let ros = variable.ros_names();
    let ros: Vec<String> = ros
        .map(|(space, name)| format!("{name} in space {space}"))
        .collect();
    if meaning.description.is_none() && !ros.is_empty() {
        let (topic, ros) = (variable.topic, ros.join(", "));
        meaning.description = Some(format!("{topic}, in ROS {ros}"));
    }
    meaning
}

impl TopicNode {
    fn of(
        variable: &Variable,
        history: History,
        (types, structures): (&mut MappedTypes, &mut VariableStructures),
    ) -> Self {
        let leaves = variable.fields.iter().map(|leaf| {
            let array = match leaf.rank {
                ArrayRank::Scalar => false,
                ArrayRank::Array { .. } => true,
            };
            (
                leaf.path.clone(),
                VariableShape(Some((leaf.builtin, array))),
            )
        });
        let fields = match variable.value_type {
            Some(shape) => vec![(variable.name.clone(), VariableShape(Some(shape)))],
            None => leaves.collect(),
        };
        let node = Self::new(
            variable.topic,
            node_id(&variable.node),
            variable.name.clone(),
            fields,
        );
        let mut node = Self {
            meaning: described(variable),
            sourced: variable.from.is_some() || variable.reports_alarms,
            targeted: variable.to.is_some(),
            historizing: variable.history.unwrap_or(history.values) > 0,
            ..node
        };
        let is_structure = |leaf: &Leaf| leaf.builtin == BuiltinType::ExtensionObject;
        if !variable.fields.iter().any(is_structure) {
            return node;
        }
        if let Some(message_type) = types.of(variable) {
            let namespace = variable.topic.namespace.get();
            for (field, leaf) in node.fields.iter_mut().zip(&variable.fields) {
                if is_structure(leaf) {
                    field.structure = structures.add(&message_type, &leaf.path, namespace);
                }
            }
        }
        node
    }

    /// Creates the nodes of a topic from the `fields` of its DataSet, each with its path in the
    /// message and its shape. Without fields, or with a single field, the topic is a single value.
    pub(crate) fn new(
        topic: TopicId,
        node: NodeId,
        name: String,
        fields: Vec<(String, VariableShape)>,
    ) -> Self {
        let compound = fields.len() > 1;
        let fields = if compound {
            fields
                .into_iter()
                .map(|(path, shape)| FieldNode {
                    node: component(&node, &path),
                    name: path,
                    shape,
                    structure: None,
                })
                .collect()
        } else {
            let shape = fields
                .first()
                .map_or(VariableShape(None), |(_, shape)| *shape);
            vec![FieldNode {
                node: node.clone(),
                name: name.clone(),
                shape,
                structure: None,
            }]
        };
        Self {
            topic,
            node,
            name,
            fields,
            compound,
            meaning: Meaning::default(),
            sourced: false,
            targeted: false,
            historizing: true,
        }
    }

    /// Returns the name of the topic in its folder, and the names of the folders, outermost first.
    pub(crate) fn parts(&self) -> (&str, Vec<&str>) {
        let mut parts: Vec<&str> = self
            .name
            .splitn(MOST_PARTS, '.')
            .map(str::trim)
            .filter(|part| !part.is_empty())
            .collect();
        (parts.pop().unwrap_or(&self.name), parts)
    }

    /// Returns true if clients may write the topic: the server produces its values. In space 0
    /// these are the mapped topics; the other topics belong to components.
    pub(crate) fn writable(&self) -> bool {
        let ours = self.topic.space == SpaceId::UA && self.node != unmapped_node(self.topic);
        ours && !self.sourced
    }

    /// Returns every node of the topic, its own node first.
    pub(crate) fn nodes(&self) -> impl Iterator<Item = &NodeId> {
        self.places().map(|(node, _)| node)
    }

    /// Returns every node of the topic, its own node first, with the index of the field.
    pub(crate) fn places(&self) -> impl Iterator<Item = (&NodeId, Option<usize>)> {
        let components = if self.compound {
            self.fields.as_slice()
        } else {
            &[]
        };
        let components = components.iter().enumerate();
        std::iter::once((&self.node, None))
            .chain(components.map(|(at, field)| (&field.node, Some(at))))
    }
}

pub(crate) fn node_id(text: &NodeIdText) -> NodeId {
    let identifier = match &text.identifier {
        mappings::Identifier::Numeric(number) => Identifier::Numeric(*number),
        mappings::Identifier::String(text) => Identifier::String(text.as_str().into()),
        // The mapping has validated both texts.
        mappings::Identifier::Guid(text) => Identifier::Guid(text.parse().unwrap_or_default()),
        mappings::Identifier::Opaque(text) => {
            Identifier::ByteString(ByteString::from_base64(text).unwrap_or_default())
        }
    };
    NodeId {
        namespace: text.namespace,
        identifier,
    }
}

pub(crate) fn component(parent: &NodeId, path: &str) -> NodeId {
    let identifier = match &parent.identifier {
        Identifier::Numeric(number) => number.to_string(),
        Identifier::String(text) => text.to_string(),
        Identifier::Guid(guid) => guid.to_string(),
        Identifier::ByteString(bytes) => bytes.as_base64(),
    };
    NodeId::new(parent.namespace, format!("{identifier}.{path}"))
}

impl FieldNode {
    /// Returns the DataType attribute.
    pub(crate) fn data_type(&self) -> NodeId {
        let structure = self.structure.clone();
        structure.unwrap_or_else(|| self.shape.data_type())
    }
}

impl VariableShape {
    /// Returns the shape of a field of a call.
    pub(crate) fn of(field: &CallField) -> Self {
        Self(Some((
            field.builtin,
            matches!(field.rank, ArrayRank::Array { .. }),
        )))
    }

    /// Returns the DataType attribute. The builtin types have the numbers of their encoding ids
    /// (OPC 10000-6, 5.1.2).
    pub(crate) fn data_type(self) -> NodeId {
        match self.0 {
            Some((builtin, _)) => NodeId::new(0, u32::from(builtin.id())),
            None => DataTypeId::BaseDataType.into(),
        }
    }

    /// Returns the ValueRank attribute: -1 scalar, 1 array of one dimension, -2 any (OPC 10000-3,
    /// 8.6).
    pub(crate) fn value_rank(self) -> i32 {
        match self.0 {
            Some((_, false)) => -1,
            Some((_, true)) => 1,
            None => -2,
        }
    }

    /// Returns true if a variable of this shape may have this value of a DataSet.
    pub(crate) fn fits(self, value: &uadp::Variant<'_>) -> bool {
        let Some(wanted) = self.0 else {
            return true;
        };
        match value {
            uadp::Variant::Null | uadp::Variant::Matrix(_) => false,
            uadp::Variant::Scalar(scalar) => wanted == (scalar.builtin_type(), false),
            uadp::Variant::Array(array) => wanted == (array.element(), true),
        }
    }

    /// Returns true if a variable of this shape may have this value.
    pub(crate) fn accepts(self, value: &Variant) -> bool {
        let Some((builtin, array)) = self.0 else {
            return true;
        };
        match value.type_id() {
            VariantTypeId::Empty => false,
            VariantTypeId::Scalar(scalar) => !array && scalar.encoding_mask() == builtin.id(),
            VariantTypeId::Array(element, dimensions) => {
                // The published library gives an array without elements an empty list of
                // dimensions.
                array
                    && dimensions.is_none_or(|d| d.len() <= 1)
                    && element.encoding_mask() == builtin.id()
            }
        }
    }
}

/// Returns the node of a topic that the mapping does not name.
pub(crate) fn unmapped_node(topic: TopicId) -> NodeId {
    NodeId::new(APPLICATION, topic.to_string())
}

/// Largest number of folders around a variable, plus its own name.
const MOST_PARTS: usize = 9;
/// The namespace index of the application's own URI.
pub(crate) const APPLICATION: u16 = 1;
pub(crate) const OPC_UA_URI: &str = "http://opcfoundation.org/UA/";
/// Limit of namespace indexes. A higher index in a mapping is a typing error.
const MOST_NAMESPACES: u16 = 1_000;

#[cfg(test)]
mod tests {
    use opcua::types::{Array, VariantScalarTypeId};

    use super::*;

    #[test]
    fn dots_part_folders_and_what_is_between_none_is_none() {
        let named = |name: &str| {
            let topic = TopicId::new(1, 2, 10).unwrap();
            TopicNode::new(topic, NodeId::new(2, 10), name.to_owned(), Vec::new())
        };
        assert_eq!(named("speed").parts(), ("speed", Vec::new()));
        assert_eq!(
            named("Line.Conveyor.Speed").parts(),
            ("Speed", vec!["Line", "Conveyor"])
        );
        assert_eq!(named("Line..Speed.").parts(), ("Speed", vec!["Line"]));
        assert_eq!(named("...").parts(), ("...", Vec::new()));
        let deep = named("a.b.c.d.e.f.g.h.i.j");
        assert_eq!((deep.parts().0, deep.parts().1.len()), ("i.j", 8));
    }

    fn topic(space: u16, namespace: u16, identifier: u16) -> TopicNode {
        TopicNode::new(
            TopicId::new(space, namespace, identifier).unwrap(),
            NodeId::new(namespace, u32::from(identifier)),
            "x".to_owned(),
            vec![(
                "data".to_owned(),
                VariableShape(Some((BuiltinType::Double, false))),
            )],
        )
    }

    fn uris(pairs: &[(u16, &str)]) -> BTreeMap<u16, String> {
        pairs
            .iter()
            .map(|(index, uri)| (*index, (*uri).to_owned()))
            .collect()
    }

    #[test]
    fn each_uri_has_the_index_of_the_mapping() {
        let layout = Layout::new(
            "urn:app",
            &uris(&[(2, "urn:two"), (5, "urn:five")]),
            vec![topic(1, 5, 10)],
        )
        .unwrap();
        assert_eq!(layout.namespaces.len(), 6);
        assert_eq!(layout.namespaces[0], OPC_UA_URI);
        assert_eq!(layout.namespaces[1], "urn:app");
        assert_eq!(layout.namespaces[2], "urn:two");
        assert_eq!(layout.namespaces[5], "urn:five");
    }

    #[test]
    fn an_index_that_cannot_be_had_is_refused_with_both_uris() {
        let error = Layout::new("urn:app", &uris(&[(1, "urn:mine")]), vec![]).unwrap_err();
        let message = error.to_string();
        assert!(
            message.contains("urn:mine") && message.contains("urn:app"),
            "{message}"
        );
        assert!(Layout::new("urn:app", &uris(&[(1, "urn:app")]), vec![]).is_ok());
    }

    #[test]
    fn a_uri_with_two_indexes_is_refused() {
        let error =
            Layout::new("urn:app", &uris(&[(2, "urn:x"), (4, "urn:x")]), vec![]).unwrap_err();
        assert_eq!(
            error,
            LayoutError::Twice {
                uri: "urn:x".to_owned(),
                first: 2,
                second: 4
            }
        );
    }

    #[test]
    fn a_node_in_a_namespace_without_uri_and_a_node_twice_are_refused() {
        let none = Layout::new("urn:app", &uris(&[]), vec![topic(1, 5, 10)]).unwrap_err();
        assert!(
            matches!(none, LayoutError::NoUri { index: 5, .. }),
            "{none}"
        );
        let twice = Layout::new(
            "urn:app",
            &uris(&[(5, "urn:x")]),
            vec![topic(1, 5, 10), topic(2, 5, 10)],
        )
        .unwrap_err();
        assert!(matches!(twice, LayoutError::Duplicate { .. }), "{twice}");
    }

    #[test]
    fn the_fields_of_a_message_are_components_named_by_their_path() {
        let fields = [
            ("pose.x", BuiltinType::Double),
            ("name", BuiltinType::String),
        ]
        .map(|(path, builtin)| (path.to_owned(), VariableShape(Some((builtin, false)))));
        let topic = TopicNode::new(
            TopicId::new(1, 5, 10).unwrap(),
            NodeId::new(5, 10),
            "pose".to_owned(),
            fields.to_vec(),
        );
        let nodes: Vec<String> = topic.nodes().map(ToString::to_string).collect();
        assert_eq!(nodes, ["ns=5;i=10", "ns=5;s=10.pose.x", "ns=5;s=10.name"]);
    }

    #[test]
    fn a_shape_accepts_its_own_type_and_rank_only() {
        let scalar = VariableShape(Some((BuiltinType::Int32, false)));
        let array = VariableShape(Some((BuiltinType::Int32, true)));
        assert!(scalar.accepts(&Variant::from(1i32)));
        assert!(!scalar.accepts(&Variant::from(true)));
        assert!(!scalar.accepts(&Variant::from(vec![1i32])));
        assert!(!scalar.accepts(&Variant::Empty));
        assert!(array.accepts(&Variant::from(vec![1i32])));
        assert!(!array.accepts(&Variant::from(vec![1.0f64])));
        assert!(!array.accepts(&Variant::from(1i32)));
        let empty = |dimensions: Option<Vec<u32>>| {
            Variant::from(Array {
                value_type: VariantScalarTypeId::Int32,
                values: Vec::new(),
                dimensions,
            })
        };
        assert!(array.accepts(&empty(None)));
        assert!(array.accepts(&empty(Some(Vec::new()))));
        assert!(!array.accepts(&empty(Some(vec![0, 3]))));
        assert!(!scalar.accepts(&empty(None)));
        assert!(VariableShape(None).accepts(&Variant::from("anything")));
    }
}
