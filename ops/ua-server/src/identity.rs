//! The identity of the server: its build and its namespaces (OPC 10000-5, 6.3).
//!
//! The library leaves these nodes empty, or does not have them.

use opcua::nodes::{ObjectBuilder, VariableBuilder};
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    BuildInfo, DataTypeId, DateTime, LocalizedText, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    UAString, VariableTypeId, Variant,
};

use crate::value;

/// The ApplicationName of the server.
pub(crate) const APPLICATION_NAME: &str = "UA bridge server";
/// The ProductUri of the server.
pub(crate) const PRODUCT_URI: &str = "urn:ua-bridge:server";

/// Returns the BuildInfo of the program.
pub(crate) fn build_info() -> BuildInfo {
    BuildInfo {
        product_uri: UAString::from(PRODUCT_URI),
        manufacturer_name: UAString::from(MANUFACTURER),
        product_name: UAString::from(APPLICATION_NAME),
        software_version: UAString::from(env!("CARGO_PKG_VERSION")),
        build_number: UAString::from(build_info::version()),
        build_date: built(),
    }
}

/// Returns the modification time of the program file, which packages preserve. The time is null if
/// the system does not report it.
fn built() -> DateTime {
    let file = std::env::current_exe().and_then(std::fs::metadata);
    let modified = file.and_then(|file| file.modified()).ok();
    let since = modified.and_then(|time| time.duration_since(std::time::UNIX_EPOCH).ok());
    let nanos = since.and_then(|since| i128::try_from(since.as_nanos()).ok());
    let time = nanos.map(uadp::Timestamp::from_unix_nanos);
    time.map_or_else(DateTime::null, |time| value::date_time(time.time))
}

/// Adds an object below Namespaces for each own namespace. Their nodes differ between servers, so
/// no node is static.
pub(crate) fn add_namespaces<'a>(
    namespaces: impl Iterator<Item = (u16, &'a str)>,
    address_space: &mut AddressSpace,
) {
    for (index, uri) in namespaces {
        let object = NodeId::new(APPLICATION, format!("Namespaces.{index}"));
        ObjectBuilder::new(
            &object,
            QualifiedName::new(index, uri),
            LocalizedText::from(uri),
        )
        .has_type_definition(ObjectTypeId::NamespaceMetadataType)
        .component_of(ObjectId::Server_Namespaces)
        .insert(address_space);
        let mut add = |name: &str, data_type: DataTypeId, rank: i32, value: Variant| {
            VariableBuilder::new(
                &NodeId::new(APPLICATION, format!("Namespaces.{index}.{name}")),
                QualifiedName::new(0, name),
                LocalizedText::from(name),
            )
            .data_type(data_type)
            .value_rank(rank)
            .value(value)
            .has_type_definition(VariableTypeId::PropertyType)
            .property_of(object.clone())
            .insert(address_space);
        };
        let text = |text: &str| Variant::from(UAString::from(text));
        let none: Vec<i32> = Vec::new();
        let no_ranges: Vec<UAString> = Vec::new();
        add("NamespaceUri", DataTypeId::String, -1, text(uri));
        add("NamespaceVersion", DataTypeId::String, -1, text(""));
        let published = Variant::from(DateTime::null());
        add(
            "NamespacePublicationDate",
            DataTypeId::DateTime,
            -1,
            published,
        );
        add("IsNamespaceSubset", DataTypeId::Boolean, -1, false.into());
        add("StaticNodeIdTypes", DataTypeId::IdType, 1, none.into());
        add(
            "StaticNumericNodeIdRange",
            DataTypeId::NumericRange,
            1,
            no_ranges.into(),
        );
        add(
            "StaticStringNodeIdPattern",
            DataTypeId::String,
            -1,
            text(""),
        );
    }
}

/// ManufacturerName of the program.
const MANUFACTURER: &str = "UA bridge";
/// The namespace index of the application's own URI.
const APPLICATION: u16 = 1;
