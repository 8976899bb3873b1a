//! The Properties that describe the values of a variable (OPC 10000-8, 5.3.2, and OPC 10000-3,
//! 5.8.3).

use mappings::Unit;
use opcua::nodes::VariableBuilder;
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    DataTypeId, EUInformation, EnumValueType, ExtensionObject, LocalizedText, NodeId,
    QualifiedName, Range, VariableTypeId, Variant,
};

use crate::layout::{TopicNode, component};

/// Returns the Property nodes that a topic may have.
pub(crate) fn nodes(topic: &TopicNode) -> impl Iterator<Item = NodeId> {
    // Below a compound these are the names of fields.
    let names: &'static [&'static str] = if topic.compound { &[] } else { &NAMES };
    names.iter().map(move |name| component(&topic.node, name))
}

/// A Property of a variable.
pub(crate) struct Property {
    pub(crate) name: &'static str,
    data_type: DataTypeId,
    rank: i32,
    pub(crate) value: Variant,
}

impl Property {
    /// Adds the Property to a node.
    pub(crate) fn insert(self, address_space: &mut AddressSpace, node: &NodeId) {
        VariableBuilder::new(
            &component(node, self.name),
            QualifiedName::new(0, self.name),
            LocalizedText::from(self.name),
        )
        .data_type(self.data_type)
        .value_rank(self.rank)
        .value(self.value)
        .has_type_definition(VariableTypeId::PropertyType)
        .property_of(node.clone())
        .insert(address_space);
    }
}

/// Adds the Properties of a topic with a single value, as the mapping defines them.
pub(crate) fn add(address_space: &mut AddressSpace, topic: &TopicNode) {
    each(topic, &mut |property| {
        property.insert(address_space, &topic.node)
    });
}

/// Passes each Property of a topic to `with`, as the mapping defines them.
pub(crate) fn each(topic: &TopicNode, with: &mut dyn FnMut(Property)) {
    let meaning = &topic.meaning;
    let mut add = |name, data_type, rank, value| {
        with(Property {
            name,
            data_type,
            rank,
            value,
        });
    };
    if let Some(unit) = meaning.unit {
        let information = EUInformation {
            namespace_uri: Unit::NAMESPACE.into(),
            unit_id: unit.id(),
            display_name: LocalizedText::from(unit.symbol),
            description: LocalizedText::from(unit.name),
        };
        let value = ExtensionObject::from_message(information);
        add(
            ENGINEERING_UNITS,
            DataTypeId::EUInformation,
            -1,
            value.into(),
        );
    }
    if let Some((low, high)) = meaning.range() {
        let value = ExtensionObject::from_message(Range { low, high });
        add(EU_RANGE, DataTypeId::Range, -1, value.into());
    }
    if let Some(digits) = meaning.precision {
        let digits = f64::from(digits);
        add(VALUE_PRECISION, DataTypeId::Double, -1, digits.into());
    }
    let texts = &meaning.texts;
    if texts.is_empty() {
        return;
    }
    if (0..).zip(texts.keys()).all(|(at, number)| at == *number) {
        let names: Vec<LocalizedText> = texts
            .values()
            .map(|text| LocalizedText::from(text.as_str()))
            .collect();
        add(ENUM_STRINGS, DataTypeId::LocalizedText, 1, names.into());
    } else {
        let values: Vec<ExtensionObject> = texts
            .iter()
            .map(|(value, text)| {
                ExtensionObject::from_message(EnumValueType {
                    value: *value,
                    display_name: LocalizedText::from(text.as_str()),
                    description: LocalizedText::null(),
                })
            })
            .collect();
        add(ENUM_VALUES, DataTypeId::EnumValueType, 1, values.into());
    }
}

/// Returns true if the values are within the range that the mapping defines for the topic.
pub(crate) fn are_within(topic: &TopicNode, values: &[Variant]) -> bool {
    let Some((low, high)) = topic.meaning.range() else {
        return true;
    };
    values.iter().all(|value| {
        if let Variant::Array(array) = value {
            return array.values.iter().all(|one| is_within(one, (low, high)));
        }
        is_within(value, (low, high))
    })
}

/// Values that are not numbers are within every range.
fn is_within(value: &Variant, (low, high): (f64, f64)) -> bool {
    let number = value.as_f64();
    number.is_none_or(|number| (low..=high).contains(&number))
}

const ENGINEERING_UNITS: &str = "EngineeringUnits";
const EU_RANGE: &str = "EURange";
const ENUM_STRINGS: &str = "EnumStrings";
const ENUM_VALUES: &str = "EnumValues";
const VALUE_PRECISION: &str = "ValuePrecision";
const NAMES: [&str; 5] = [
    ENGINEERING_UNITS,
    EU_RANGE,
    ENUM_STRINGS,
    ENUM_VALUES,
    VALUE_PRECISION,
];

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use mappings::TopicId;
    use opcua::nodes::NodeType;
    use opcua::types::{DataEncoding, NumericRange, ReferenceTypeId, TimestampsToReturn};
    use uadp::BuiltinType;

    use super::*;
    use crate::layout::VariableShape;

    fn topic(number: i64, text: &str) -> TopicNode {
        let mut topic = TopicNode::new(
            TopicId::new(1, 2, 10).unwrap(),
            NodeId::new(2, 10),
            "x".to_owned(),
            vec![(
                "data".to_owned(),
                VariableShape(Some((BuiltinType::Int32, false))),
            )],
        );
        topic.meaning.texts = BTreeMap::from([(number, text.to_owned())]);
        topic
    }

    #[test]
    fn what_is_added_can_be_taken_out_by_its_nodes() {
        let mut space = AddressSpace::new();
        space.add_namespace("urn:cell", 2);
        let mut before = None;
        for (number, text, name) in [
            (0, "off", ENUM_STRINGS),
            (0, "idle", ENUM_STRINGS),
            (5, "on", ENUM_VALUES),
        ] {
            let topic = topic(number, text);
            add(&mut space, &topic);
            let there: Vec<NodeId> = nodes(&topic).filter(|id| space.node_exists(id)).collect();
            let [property] = there.as_slice() else {
                unreachable!("{there:?}");
            };
            assert_eq!(*property, component(&topic.node, name));
            assert!(space.has_reference(&topic.node, property, ReferenceTypeId::HasProperty));
            let Some(NodeType::Variable(variable)) = space.find(property) else {
                unreachable!("{property}");
            };
            let value = variable.value(
                TimestampsToReturn::Neither,
                &NumericRange::None,
                &DataEncoding::Binary,
                0.0,
            );
            assert!(value.value.is_some() && value.value != before, "{value:?}");
            before = value.value;
            drop(space.delete(property, true));
        }
    }
}
