//! The submodels of a process module.

use std::collections::BTreeMap;

use mtp::{Module, OpcUaNode, ParameterKind, ServiceParameter, ValueBound, unit_symbol};
use serde_json::{Value, json};

use super::elements::{ShortNames, collection, meaning, property, submodel, text};

/// A field of the nameplate.
pub(super) struct NameplateField {
    /// Its name in the submodel and in `--nameplate`.
    pub(super) name: &'static str,
    semantic_id: &'static str,
    kind: FieldKind,
    is_mandatory: bool,
    /// Whether it belongs to the address of the manufacturer.
    is_address: bool,
    /// The variable of the information of a module (MTP 2.0).
    pub(super) information: Option<&'static str>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum FieldKind {
    Property,
    /// A text with a language.
    Text,
}

const fn field(
    name: &'static str,
    semantic_id: &'static str,
    kind: FieldKind,
    is_mandatory: bool,
    information: Option<&'static str>,
) -> NameplateField {
    NameplateField {
        name,
        semantic_id,
        kind,
        is_mandatory,
        is_address: false,
        information,
    }
}

const fn address(name: &'static str, semantic_id: &'static str) -> NameplateField {
    NameplateField {
        is_address: true,
        ..field(name, semantic_id, FieldKind::Text, true, None)
    }
}

/// The fields of the digital nameplate 2.0 (IDTA 02006-2-0).
pub(super) const NAMEPLATE: [NameplateField; 14] = [
    field(
        "URIOfTheProduct",
        "0173-1#02-AAY811#001",
        FieldKind::Property,
        true,
        Some("ProductInstanceUri"),
    ),
    field(
        "ManufacturerName",
        "0173-1#02-AAO677#002",
        FieldKind::Text,
        true,
        Some("Manufacturer"),
    ),
    field(
        "ManufacturerProductDesignation",
        "0173-1#02-AAW338#001",
        FieldKind::Text,
        true,
        Some("DeviceClass"),
    ),
    address("Street", "0173-1#02-AAO128#002"),
    address("Zipcode", "0173-1#02-AAO129#002"),
    address("CityTown", "0173-1#02-AAO132#002"),
    address("NationalCode", "0173-1#02-AAO134#002"),
    field(
        "ManufacturerProductFamily",
        "0173-1#02-AAU731#001",
        FieldKind::Text,
        true,
        Some("Model"),
    ),
    field(
        "OrderCodeOfManufacturer",
        "0173-1#02-AAO227#002",
        FieldKind::Text,
        false,
        Some("ProductCode"),
    ),
    field(
        "SerialNumber",
        "0173-1#02-AAM556#002",
        FieldKind::Property,
        false,
        Some("SerialNumber"),
    ),
    field(
        "YearOfConstruction",
        "0173-1#02-AAP906#001",
        FieldKind::Property,
        true,
        None,
    ),
    field(
        "HardwareVersion",
        "0173-1#02-AAN270#002",
        FieldKind::Text,
        false,
        Some("HardwareRevision"),
    ),
    field(
        "FirmwareVersion",
        "0173-1#02-AAM985#002",
        FieldKind::Text,
        false,
        Some("DeviceRevision"),
    ),
    field(
        "SoftwareVersion",
        "0173-1#02-AAM737#002",
        FieldKind::Text,
        false,
        Some("SoftwareRevision"),
    ),
];

/// Returns the nameplate.
///
/// # Errors
/// The mandatory fields that are missing.
pub(super) fn nameplate(
    asset: &str,
    facts: &BTreeMap<&'static str, String>,
) -> Result<Value, Vec<&'static str>> {
    let missing = NAMEPLATE.iter().filter(|field| field.is_mandatory);
    let missing = missing.map(|field| field.name);
    let missing: Vec<_> = missing.filter(|name| !facts.contains_key(name)).collect();
    if !missing.is_empty() {
        return Err(missing);
    }
    let element = |field: &NameplateField| {
        let value = facts.get(field.name)?;
        let element = match field.kind {
            FieldKind::Property => property(field.name, "string", value),
            FieldKind::Text => text(field.name, value),
        };
        Some(meaning(element, field.semantic_id))
    };
    let (of_address, own): (Vec<&NameplateField>, Vec<&NameplateField>) =
        NAMEPLATE.iter().partition(|field| field.is_address);
    let contact = collection(
        "ContactInformation",
        of_address.into_iter().filter_map(element).collect(),
    );
    let contact = meaning(contact, CONTACT);
    let elements = own.into_iter().filter_map(element);
    let elements = elements.chain([contact]).collect();
    Ok(submodel((asset, "Nameplate"), NAMEPLATE_ID, elements))
}

/// Returns the capabilities that the module offers: a container for each procedure, with its
/// parameters and its service.
pub(super) fn capabilities(asset: &str, module: &Module) -> Value {
    let mut names = ShortNames::default();
    let mut containers = Vec::new();
    for service in &module.services {
        for procedure in &service.procedures {
            let name = names.of(&format!("{}_{}", service.name, procedure.name));
            let mut properties = ShortNames::default();
            let parameters = service.parameters.iter().chain(&procedure.parameters);
            let parameters: Vec<Value> = parameters
                .map(|parameter| of_parameter(parameter, &mut properties))
                .collect();
            let mut elements = vec![
                json!({
                    "modelType": "Capability", "idShort": names_of(&procedure.name),
                    "qualifiers": [{
                        "type": "CapabilityRoleQualifier/Offered", "valueType": "xs:boolean",
                        "value": "true",
                    }],
                }),
                text(
                    "CapabilityComment",
                    &format!(
                        "procedure {} of the service {}",
                        procedure.name, service.name
                    ),
                ),
                property(
                    "RealizedBy",
                    "string",
                    &format!("{}/{}", service.name, procedure.name),
                ),
                property(
                    "ProcedureNumber",
                    "unsignedInt",
                    &procedure.number.to_string(),
                ),
            ];
            if !parameters.is_empty() {
                elements.push(collection("PropertySet", parameters));
            }
            containers.push(collection(&name, elements));
        }
    }
    let elements = if containers.is_empty() {
        vec![text("CapabilitySetComment", "the manifest has no services")]
    } else {
        vec![collection("CapabilitySet", containers)]
    };
    submodel((asset, "CapabilityDescription"), CAPABILITY_ID, elements)
}

fn names_of(name: &str) -> String {
    ShortNames::default().of(name)
}

/// Returns a parameter: a range if the file has its limits, else a property without a value.
fn of_parameter(parameter: &ServiceParameter, names: &mut ShortNames) -> Value {
    let id_short = names.of(&parameter.name);
    let kind = match parameter.kind {
        ParameterKind::Analog => "double",
        ParameterKind::Integer => "int",
        ParameterKind::Binary => "boolean",
        ParameterKind::Text => "string",
    };
    let number = |bound: &Option<ValueBound>| {
        let number = bound.as_ref()?.constant()?;
        let is_whole = kind == "int" && number.fract() != 0.0;
        (!is_whole).then(|| number.to_string())
    };
    let mut element = json!({ "idShort": id_short, "valueType": format!("xs:{kind}") });
    let limits = (number(&parameter.min), number(&parameter.max));
    let is_number = matches!(
        parameter.kind,
        ParameterKind::Analog | ParameterKind::Integer
    );
    if let Some(element) = element.as_object_mut() {
        let has_limits = is_number && (limits.0.is_some() || limits.1.is_some());
        let model = if has_limits { "Range" } else { "Property" };
        element.insert("modelType".to_owned(), model.into());
        for (key, limit) in [("min", limits.0), ("max", limits.1)] {
            if let Some(limit) = limit.filter(|_| has_limits) {
                element.insert(key.to_owned(), limit.into());
            }
        }
        let unit = parameter.unit.as_ref().and_then(ValueBound::constant);
        if let Some(unit) = unit.and_then(unit_symbol) {
            let qualifier = json!([{ "type": "Unit", "valueType": "xs:string", "value": unit }]);
            element.insert("qualifiers".to_owned(), qualifier);
        }
    }
    element
}

/// Returns the interfaces of the module: an OPC UA server with its nodes as properties.
pub(super) fn interfaces(asset: &str, module: &Module) -> Value {
    let mut names = ShortNames::default();
    let mut interfaces = Vec::new();
    for server in &module.servers {
        let mut items = ShortNames::default();
        let of_server = module.items.iter();
        let of_server = of_server.filter(|item| item.node.endpoint == server.endpoint);
        let properties: Vec<Value> = of_server
            .map(|item| {
                let href = href(&item.node);
                let form = collection(
                    "forms",
                    vec![
                        property("href", "string", &href),
                        property("contentType", "string", "application/opcua+uadp"),
                    ],
                );
                let elements = vec![
                    property("key", "string", &item.name),
                    property("readOnly", "boolean", bool_of(!item.node.access.writes)),
                    property("writeOnly", "boolean", bool_of(!item.node.access.reads)),
                    form,
                ];
                collection(&items.of(&item.name), elements)
            })
            .collect();
        let base = match server.endpoint.as_str() {
            "" => "opc.tcp://",
            endpoint => endpoint,
        };
        let mut elements = vec![
            property("title", "string", &server.name),
            collection("EndpointMetadata", vec![property("base", "anyURI", base)]),
        ];
        if !properties.is_empty() {
            elements.push(collection(
                "InteractionMetadata",
                vec![collection("properties", properties)],
            ));
        }
        interfaces.push(collection(
            &names.of(&format!("Interface_{}", server.name)),
            elements,
        ));
    }
    if interfaces.is_empty() {
        interfaces.push(text("Comment", "the manifest has no OPC UA server"));
    }
    submodel(
        (asset, "AssetInterfacesDescription"),
        INTERFACES_ID,
        interfaces,
    )
}

const fn bool_of(value: bool) -> &'static str {
    if value { "true" } else { "false" }
}

/// Returns the address of a node: the endpoint of its server with its NodeId.
fn href(node: &OpcUaNode) -> String {
    format!("{}/?id={}", node.endpoint, node.id())
}

/// Returns the content type of a manifest by the name of its file.
pub(super) fn content_type(file: &str) -> &'static str {
    let is_container = [".mtp", ".amlx"]
        .iter()
        .any(|ending| file.ends_with(ending));
    if is_container {
        "application/automationml-amlx+zip"
    } else {
        "application/automationml-aml+xml"
    }
}

/// Returns the path of a manifest in a package.
pub(super) fn package_path(file: &str) -> String {
    let name = file.rsplit('/').next().unwrap_or(file);
    format!("/aasx/files/{}", mtp::escaped(name))
}

/// Returns the manifest itself, by the name of its file.
pub(super) fn module_type_package(asset: &str, file: &str, module: &Module) -> Value {
    let mut elements = vec![json!({
        "modelType": "File", "idShort": "MTPFile", "contentType": content_type(file),
        "value": package_path(file),
    })];
    if !module.version.is_empty() {
        elements.push(property("Version", "string", &module.version));
    }
    elements.push(property(
        "Edition",
        "string",
        match module.edition {
            mtp::Edition::V1 => "VDI/VDE/NAMUR 2658",
            mtp::Edition::V2 => "MTP 2.0",
        },
    ));
    submodel((asset, "ModuleTypePackage"), MTP_ID, elements)
}

const NAMEPLATE_ID: &str = "https://admin-shell.io/zvei/nameplate/2/0/Nameplate";
const CONTACT: &str =
    "https://admin-shell.io/zvei/nameplate/1/0/ContactInformations/ContactInformation";
const CAPABILITY_ID: &str = "https://admin-shell.io/idta/CapabilityDescription/1/0/Submodel";
const INTERFACES_ID: &str = "https://admin-shell.io/idta/AssetInterfacesDescription/1/0/Submodel";
const MTP_ID: &str = "https://admin-shell.io/vdi/2658/1/0/MTPSubmodel";
