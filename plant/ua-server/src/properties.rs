//! The Properties that say what the numbers of a variable mean (OPC 10000-8, 5.3.2, and OPC 10000-3, 5.8.3).

use mappings::Unit;
use opcua::nodes::VariableBuilder;
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    DataTypeId, EUInformation, EnumValueType, ExtensionObject, LocalizedText, QualifiedName, Range,
    VariableTypeId, Variant,
};

use crate::layout::{TopicNode, component};

/// Adds those that the mapping has of the one value of a topic.
pub(crate) fn add(address_space: &mut AddressSpace, topic: &TopicNode) {
    let meaning = &topic.meaning;
    let mut add = |name: &str, data_type: DataTypeId, rank: i32, value: Variant| {
        VariableBuilder::new(
            &component(&topic.node, name),
            QualifiedName::new(0, name),
            LocalizedText::from(name),
        )
        .data_type(data_type)
        .value_rank(rank)
        .value(value)
        .has_type_definition(VariableTypeId::PropertyType)
        .property_of(topic.node.clone())
        .insert(address_space);
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
            "EngineeringUnits",
            DataTypeId::EUInformation,
            -1,
            value.into(),
        );
    }
    if let Some((low, high)) = meaning.range() {
        let value = ExtensionObject::from_message(Range { low, high });
        add("EURange", DataTypeId::Range, -1, value.into());
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
        add("EnumStrings", DataTypeId::LocalizedText, 1, names.into());
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
        add("EnumValues", DataTypeId::EnumValueType, 1, values.into());
    }
}
