//! Events with the fields of BaseEventType and own fields.

/// Implements `Event` and `EventField` for a type with a field `base: BaseEventType`. The first
/// closure returns true for the types whose select clauses apply to the event. The second closure
/// returns the value of an own field at a path; `None` for the fields of the base type.
#[macro_export]
macro_rules! impl_event {
    ($event:ty, $is_of:expr, $own:expr) => {
        impl opcua::nodes::EventField for $event {
            fn get_value(
                &self,
                attribute_id: opcua::types::AttributeId,
                index_range: &opcua::types::NumericRange,
                remaining_path: &[opcua::types::QualifiedName],
            ) -> opcua::types::Variant {
                let own: fn(
                    &Self,
                    &[opcua::types::QualifiedName],
                ) -> Option<opcua::types::Variant> = $own;
                if attribute_id == opcua::types::AttributeId::Value
                    && let Some(value) = own(self, remaining_path)
                {
                    return value.range_of_owned(index_range).unwrap_or_default();
                }
                opcua::nodes::EventField::get_value(
                    &self.base,
                    attribute_id,
                    index_range,
                    remaining_path,
                )
            }
        }

        impl opcua::nodes::Event for $event {
            fn get_field(
                &self,
                type_definition_id: &opcua::types::NodeId,
                attribute_id: opcua::types::AttributeId,
                index_range: &opcua::types::NumericRange,
                browse_path: &[opcua::types::QualifiedName],
            ) -> opcua::types::Variant {
                let is_of: fn(&Self, &opcua::types::NodeId) -> bool = $is_of;
                if !is_of(self, type_definition_id) {
                    return opcua::types::Variant::Empty;
                }
                opcua::nodes::EventField::get_value(self, attribute_id, index_range, browse_path)
            }

            fn time(&self) -> &opcua::types::DateTime {
                &self.base.time
            }

            fn event_type_id(&self) -> &opcua::types::NodeId {
                &self.base.event_type
            }
        }
    };
}
