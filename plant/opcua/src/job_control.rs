//! Job Control (OPC 10031-4, version 2): the structures of job orders and job responses, and the
//! part of the NodeSet that servers of jobs need.

use std::io::{Read, Write};
use std::sync::LazyLock;

use opcua::types::xml::{XmlEncodable, XmlStreamWriter, XmlType};
use opcua::types::{
    BinaryDecodable, BinaryEncodable, Context, ContextOwned, DateTime, EUInformation,
    EncodingResult, ExpandedMessageInfo, ExpandedNodeId, LocalizedText, RelativePath,
    StaticTypeLoader, TypeLoaderInstance, UAString, UaNullable, Variant, XmlEncodable, XmlType,
    binary_decode_to_enc,
};

/// The namespace of Job Control, version 2.
pub const NAMESPACE: &str = "http://opcfoundation.org/UA/ISA95-JOBCONTROL_V2/";
/// The NodeSet: the structures, the job order receiver and the job response provider.
pub const NODESET: &str = include_str!("job_control.xml");

/// Defines a structure with the identifiers of its DataType and of its binary encoding. A field
/// after `[optional]` may be missing.
macro_rules! structures {
    ($($(#[$doc:meta])* $name:ident = ($data_type:literal, $binary:literal) {
        $($(#[$field:meta])* $([$optional:ident])? $key:ident: $of:ty,)+
    })+) => {
        $(
            $(#[$doc])*
            #[derive(
                Debug, Clone, PartialEq, Default, BinaryEncodable, BinaryDecodable, XmlEncodable,
                XmlType, UaNullable,
            )]
            pub struct $name {
                $($(#[$field])* $(#[opcua($optional)])? pub $key: $of,)+
            }

            impl ExpandedMessageInfo for $name {
                fn full_type_id(&self) -> ExpandedNodeId {
                    ExpandedNodeId::new_with_namespace(NAMESPACE, $binary)
                }

                // Clients of this server use the binary encoding.
                fn full_json_type_id(&self) -> ExpandedNodeId {
                    self.full_type_id()
                }

                fn full_xml_type_id(&self) -> ExpandedNodeId {
                    self.full_type_id()
                }

                fn full_data_type_id(&self) -> ExpandedNodeId {
                    ExpandedNodeId::new_with_namespace(NAMESPACE, $data_type)
                }
            }
        )+

        fn types() -> TypeLoaderInstance {
            let mut types = TypeLoaderInstance::new();
            $(types.add_binary_type($data_type, $binary, binary_decode_to_enc::<$name>);)+
            types
        }
    };
}

structures! {
    /// ISA95PropertyDataType: a property of a resource.
    Property = (3002_u32, 5002_u32) {
        /// The ID.
        id: UAString,
        /// The value.
        value: Variant,
        /// The description.
        [optional] description: Option<OptionalArray<LocalizedText>>,
        /// The unit of the value.
        [optional] units: Option<EUInformation>,
        /// The properties of the property.
        [optional] parts: Option<OptionalArray<Property>>,
    }
    /// ISA95ParameterDataType: a named value.
    Parameter = (3003_u32, 5005_u32) {
        /// The ID.
        id: UAString,
        /// The value.
        value: Variant,
        /// The description.
        [optional] description: Option<OptionalArray<LocalizedText>>,
        /// The unit of the value.
        [optional] units: Option<EUInformation>,
        /// The parameters of the parameter.
        [optional] parts: Option<OptionalArray<Parameter>>,
    }
    /// ISA95EquipmentDataType: required or used equipment.
    Equipment = (3005_u32, 5008_u32) {
        /// The ID.
        id: UAString,
        /// The description.
        [optional] description: Option<OptionalArray<LocalizedText>>,
        /// The use of the equipment.
        [optional] usage: Option<UAString>,
        /// The quantity.
        [optional] quantity: Option<UAString>,
        /// The unit of the quantity.
        [optional] units: Option<EUInformation>,
        /// The properties.
        [optional] properties: Option<OptionalArray<Property>>,
    }
    /// ISA95StateDataType: a state of a job.
    State = (3006_u32, 5029_u32) {
        /// The path to a substate; empty for the main state.
        path: RelativePath,
        /// The name.
        text: LocalizedText,
        /// The number.
        number: u32,
    }
    /// ISA95WorkMasterDataType: the work that a job order does.
    WorkMaster = (3007_u32, 5011_u32) {
        /// The ID.
        id: UAString,
        /// The description.
        [optional] description: Option<LocalizedText>,
        /// The parameters.
        [optional] parameters: Option<OptionalArray<Parameter>>,
    }
    /// ISA95JobOrderDataType: a job order.
    JobOrder = (3008_u32, 5014_u32) {
        /// The ID, which the client chooses.
        id: UAString,
        /// The description.
        [optional] description: Option<OptionalArray<LocalizedText>>,
        /// The possible work.
        [optional] work_masters: Option<OptionalArray<WorkMaster>>,
        /// The proposed start.
        [optional] start: Option<DateTime>,
        /// The proposed end.
        [optional] end: Option<DateTime>,
        /// The priority; a higher number comes first.
        [optional] priority: Option<i16>,
        /// The parameters.
        [optional] parameters: Option<OptionalArray<Parameter>>,
        /// The required persons.
        [optional] personnel: Option<OptionalArray<Personnel>>,
        /// The required equipment.
        [optional] equipment: Option<OptionalArray<Equipment>>,
        /// The required assets.
        [optional] assets: Option<OptionalArray<Asset>>,
        /// The required material.
        [optional] material: Option<OptionalArray<Material>>,
    }
    /// ISA95MaterialDataType: required or used material.
    Material = (3010_u32, 5017_u32) {
        /// The ID of its class.
        [optional] class: Option<UAString>,
        /// The ID of its definition.
        [optional] definition: Option<UAString>,
        /// The ID of its lot.
        [optional] lot: Option<UAString>,
        /// The ID of its sublot.
        [optional] sublot: Option<UAString>,
        /// The description.
        [optional] description: Option<OptionalArray<LocalizedText>>,
        /// The use of the material.
        [optional] usage: Option<UAString>,
        /// The quantity.
        [optional] quantity: Option<UAString>,
        /// The unit of the quantity.
        [optional] units: Option<EUInformation>,
        /// The properties.
        [optional] properties: Option<OptionalArray<Property>>,
    }
    /// ISA95PersonnelDataType: required or working persons.
    Personnel = (3011_u32, 5020_u32) {
        /// The ID.
        id: UAString,
        /// The description.
        [optional] description: Option<OptionalArray<LocalizedText>>,
        /// The task of the persons.
        [optional] usage: Option<UAString>,
        /// The quantity.
        [optional] quantity: Option<UAString>,
        /// The unit of the quantity.
        [optional] units: Option<EUInformation>,
        /// The properties.
        [optional] properties: Option<OptionalArray<Property>>,
    }
    /// ISA95PhysicalAssetDataType: a required or used asset.
    Asset = (3012_u32, 5023_u32) {
        /// The ID.
        id: UAString,
        /// The description.
        [optional] description: Option<OptionalArray<LocalizedText>>,
        /// The use of the asset.
        [optional] usage: Option<UAString>,
        /// The quantity.
        [optional] quantity: Option<UAString>,
        /// The unit of the quantity.
        [optional] units: Option<EUInformation>,
        /// The properties.
        [optional] properties: Option<OptionalArray<Property>>,
    }
    /// ISA95JobResponseDataType: the execution of a job order.
    JobResponse = (3013_u32, 5026_u32) {
        /// The ID.
        id: UAString,
        /// The description.
        [optional] description: Option<LocalizedText>,
        /// The ID of the job order.
        order_id: UAString,
        /// The start.
        [optional] start: Option<DateTime>,
        /// The end.
        [optional] end: Option<DateTime>,
        /// The states, the main state first.
        states: Option<Vec<State>>,
        /// The results.
        [optional] data: Option<OptionalArray<Parameter>>,
        /// The persons.
        [optional] personnel: Option<OptionalArray<Personnel>>,
        /// The equipment.
        [optional] equipment: Option<OptionalArray<Equipment>>,
        /// The assets.
        [optional] assets: Option<OptionalArray<Asset>>,
        /// The material.
        [optional] material: Option<OptionalArray<Material>>,
    }
    /// ISA95JobOrderAndStateDataType: a job order with its states.
    JobOrderAndState = (3015_u32, 5032_u32) {
        /// The job order.
        order: JobOrder,
        /// The states, the main state first.
        states: Option<Vec<State>>,
    }
}

impl JobOrder {
    /// Returns the binary encoding, for storage.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        BinaryEncodable::encode_to_vec(self, &ContextOwned::default().context())
    }

    /// Decodes the binary encoding.
    ///
    /// # Errors
    /// The bytes are no job order.
    pub fn from_bytes(bytes: &[u8]) -> EncodingResult<Self> {
        let (mut from, context) = (bytes, ContextOwned::default());
        <Self as BinaryDecodable>::decode(&mut from, &context.context())
    }
}

/// An array that is an optional field. The depth of arrays in arrays is limited when they are
/// decoded.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct OptionalArray<T>(pub Vec<T>);

impl<T: BinaryEncodable> BinaryEncodable for OptionalArray<T> {
    fn byte_len(&self, ctx: &Context<'_>) -> usize {
        let parts = self.0.iter().map(|part| part.byte_len(ctx));
        parts.fold(4, usize::saturating_add)
    }

    fn encode<S: Write + ?Sized>(&self, stream: &mut S, ctx: &Context<'_>) -> EncodingResult<()> {
        let count = i32::try_from(self.0.len()).unwrap_or(i32::MAX);
        BinaryEncodable::encode(&count, stream, ctx)?;
        let mut parts = self.0.iter();
        parts.try_for_each(|part| BinaryEncodable::encode(part, stream, ctx))
    }
}

impl<T: BinaryDecodable> BinaryDecodable for OptionalArray<T> {
    fn decode<S: Read + ?Sized>(stream: &mut S, ctx: &Context<'_>) -> EncodingResult<Self> {
        let _depth = ctx.options().depth_lock()?;
        let parts: Option<Vec<T>> = BinaryDecodable::decode(stream, ctx)?;
        Ok(Self(parts.unwrap_or_default()))
    }
}

impl<T> UaNullable for OptionalArray<T> {
    fn is_ua_null(&self) -> bool {
        self.0.is_empty()
    }
}

impl<T> XmlType for OptionalArray<T> {
    const TAG: &'static str = "ListOfExtensionObject";
}

impl<T: XmlEncodable> XmlEncodable for OptionalArray<T> {
    fn encode(
        &self,
        stream: &mut XmlStreamWriter<&mut dyn Write>,
        ctx: &Context<'_>,
    ) -> EncodingResult<()> {
        self.0
            .iter()
            .try_for_each(|part| XmlEncodable::encode(part, stream, ctx))
    }
}

/// Decodes the structures that clients send.
pub struct JobTypes;

impl StaticTypeLoader for JobTypes {
    fn instance() -> &'static TypeLoaderInstance {
        static TYPES: LazyLock<TypeLoaderInstance> = LazyLock::new(types);
        &TYPES
    }

    fn namespace() -> &'static str {
        NAMESPACE
    }
}

#[cfg(test)]
mod tests {
    use opcua::types::ContextOwned;

    use super::*;

    #[test]
    fn optional_fields_have_a_mask_and_come_back() {
        let master = WorkMaster {
            id: "urn:p".into(),
            ..WorkMaster::default()
        };
        let order = JobOrder {
            id: "one".into(),
            work_masters: Some(OptionalArray(vec![master])),
            priority: Some(3),
            ..JobOrder::default()
        };
        let context = ContextOwned::default();
        let context = context.context();
        let bytes = order.encode_to_vec(&context);
        // The second and the fifth of the optional fields.
        assert_eq!(bytes.get(..4), Some(&[0b1_0010, 0, 0, 0][..]));
        assert_eq!(bytes.len(), order.byte_len(&context));
        let read = JobOrder::decode(&mut bytes.as_slice(), &context).unwrap();
        assert_eq!(read, order);
    }

    #[test]
    fn parameters_are_not_decoded_to_any_depth() {
        let nested = |depth: usize| {
            (0..depth).fold(Parameter::default(), |inner, _| Parameter {
                parts: Some(OptionalArray(vec![inner])),
                ..Parameter::default()
            })
        };
        let context = ContextOwned::default();
        let context = context.context();
        let bytes = nested(5).encode_to_vec(&context);
        let read = Parameter::decode(&mut bytes.as_slice(), &context);
        assert_eq!(read.unwrap(), nested(5));
        let bytes = nested(500).encode_to_vec(&context);
        assert!(Parameter::decode(&mut bytes.as_slice(), &context).is_err());
    }
}
