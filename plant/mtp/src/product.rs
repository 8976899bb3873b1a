//! The configuration of a product in AutomationML: the fields of the components that make it.
//!
//! Each element of the file with an attribute `ApplicationUri` is a component. Its other attributes
//! are the fields of its configuration. All other elements, such as the structure of the product,
//! group them only.

use std::collections::BTreeSet;

use thiserror::Error;

use crate::caex::{Attribute, CaexElement, ManifestError};

/// The fields of a component.
#[derive(Debug, Clone, PartialEq)]
pub struct ConfiguredComponent {
    /// Its ApplicationUri.
    pub application_uri: String,
    /// The name of its element.
    pub name: String,
    /// The line of its element, from 1.
    pub line: usize,
    /// The fields with their values, in the order of the file.
    pub fields: Vec<(String, ConfiguredValue)>,
    /// The units of the fields that have one in the file, with the names of the fields.
    pub units: Vec<(String, String)>,
}

/// The value of a field.
#[derive(Debug, Clone, PartialEq)]
pub enum ConfiguredValue {
    /// `xs:boolean`.
    Boolean(bool),
    /// A number of XML Schema with digits only.
    Integer(i64),
    /// Another number of XML Schema, and a number without AttributeDataType.
    Number(f64),
    /// Another text.
    Text(String),
}

/// The reason why a product configuration cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ProductFileFault {
    /// The file is no AutomationML.
    #[error(transparent)]
    Caex(#[from] ManifestError),
    /// No element names a component.
    #[error(
        "no element names a component; give its ApplicationUri as \
         <Attribute Name=\"ApplicationUri\"><Value>urn:..</Value></Attribute>"
    )]
    NoComponent,
    /// Two elements name one component.
    #[error("line {line}: {uri} is configured twice; put its fields into one element")]
    Twice {
        /// The ApplicationUri.
        uri: String,
        /// The line of the second element.
        line: usize,
    },
    /// The element of a component has no fields.
    #[error("line {line}: {uri} has no fields; give them as attributes of its element")]
    NoFields {
        /// The ApplicationUri.
        uri: String,
        /// The line of the element.
        line: usize,
    },
    /// Two attributes of an element have one name.
    #[error("line {line}: the field {field} of {uri} is given twice")]
    FieldTwice {
        /// The ApplicationUri.
        uri: String,
        /// The field.
        field: String,
        /// The line of the element.
        line: usize,
    },
    /// A value is not of its AttributeDataType.
    #[error("line {line}: the field {field} of {uri} is `{value}`, which is no {data_type}")]
    Value {
        /// The ApplicationUri.
        uri: String,
        /// The field.
        field: String,
        /// The start of the value.
        value: String,
        /// Its AttributeDataType.
        data_type: String,
        /// The line of the element.
        line: usize,
    },
}

/// Reads the configuration of a product from an AutomationML file.
///
/// # Errors
/// The first fault of the file.
pub fn product_configuration(file: &str) -> Result<Vec<ConfiguredComponent>, ProductFileFault> {
    let root = CaexElement::read(file)?;
    let mut components: Vec<ConfiguredComponent> = Vec::new();
    let mut uris = BTreeSet::new();
    for element in root.all().filter(|element| !element.is_interface) {
        let Some(uri) = element.value(&[APPLICATION_URI]) else {
            continue;
        };
        let (uri, line) = (uri.to_owned(), element.line);
        if !uris.insert(uri.clone()) {
            return Err(ProductFileFault::Twice { uri, line });
        }
        let given = element.attributes.iter();
        let given = given.filter(|attribute| attribute.name != APPLICATION_URI);
        let mut names = BTreeSet::new();
        let (mut fields, mut units) = (Vec::new(), Vec::new());
        for attribute in given {
            let field = attribute.name.trim().to_owned();
            if !names.insert(field.clone()) {
                return Err(ProductFileFault::FieldTwice { uri, field, line });
            }
            let value = value(attribute).ok_or_else(|| ProductFileFault::Value {
                uri: uri.clone(),
                field: field.clone(),
                value: attribute.value.chars().take(SHOWN).collect(),
                data_type: attribute.data_type.clone(),
                line,
            })?;
            let unit = attribute.unit.trim();
            if !unit.is_empty() {
                units.push((field.clone(), unit.to_owned()));
            }
            fields.push((field, value));
        }
        if fields.is_empty() {
            return Err(ProductFileFault::NoFields { uri, line });
        }
        components.push(ConfiguredComponent {
            application_uri: uri,
            name: element.name.clone(),
            line,
            fields,
            units,
        });
    }
    match components.is_empty() {
        true => Err(ProductFileFault::NoComponent),
        false => Ok(components),
    }
}

/// Returns the value of an attribute; `None` if it is not of its type.
fn value(attribute: &Attribute) -> Option<ConfiguredValue> {
    let text = attribute.value.trim();
    let number = || text.parse().ok().filter(|number: &f64| number.is_finite());
    let data_type = attribute.data_type.rsplit(':').next().unwrap_or_default();
    match data_type {
        "boolean" => match text {
            "true" | "1" => Some(ConfiguredValue::Boolean(true)),
            "false" | "0" => Some(ConfiguredValue::Boolean(false)),
            _ => None,
        },
        "double" | "float" | "decimal" => number().map(ConfiguredValue::Number),
        "" => Some(number().map_or_else(
            || ConfiguredValue::Text(text.to_owned()),
            ConfiguredValue::Number,
        )),
        name if INTEGERS.contains(&name) => text.parse().ok().map(ConfiguredValue::Integer),
        _ => Some(ConfiguredValue::Text(text.to_owned())),
    }
}

const APPLICATION_URI: &str = "ApplicationUri";
/// The whole numbers of XML Schema.
const INTEGERS: [&str; 10] = [
    "integer",
    "int",
    "long",
    "short",
    "byte",
    "nonNegativeInteger",
    "unsignedInt",
    "unsignedLong",
    "unsignedShort",
    "unsignedByte",
];
/// Characters of a value in a fault.
const SHOWN: usize = 40;

#[cfg(test)]
mod tests {
    use super::*;

    fn file(elements: &str) -> String {
        format!(
            "<?xml version=\"1.0\" encoding=\"utf-8\"?>\n<CAEXFile FileName=\"p.aml\" SchemaVersion=\"3.0\" \
             xmlns=\"http://www.dke.de/CAEX\">\n<InstanceHierarchy Name=\"Product\">\n{elements}\n</InstanceHierarchy>\n</CAEXFile>"
        )
    }

    fn attribute(name: &str, data_type: &str, value: &str) -> String {
        format!(
            "<Attribute Name=\"{name}\" AttributeDataType=\"{data_type}\"><Value>{value}</Value></Attribute>"
        )
    }

    fn element(uri: &str, attributes: &[String]) -> String {
        let uri = attribute("ApplicationUri", "xs:string", uri);
        let all = attributes.concat();
        format!("<InternalElement Name=\"part\" ID=\"1\">{uri}{all}</InternalElement>\n")
    }

    #[test]
    fn the_components_have_their_fields_with_their_types() {
        let gripper = element(
            "urn:gripper",
            &[
                attribute("Force", "xs:double", " 40.5 "),
                attribute("Retries", "xs:int", "3"),
                attribute("Soft", "xs:boolean", "true"),
                attribute("Product", "xs:string", "4711"),
                attribute("Width", "", "0.03"),
                attribute("Order", "", "A-1"),
            ],
        );
        let speed = attribute("Speed", "xs:float\" Unit=\"m/s", "0.5");
        let robot = element("urn:robot", &[speed]);
        let text = file(&format!(
            "<InternalElement Name=\"line\" ID=\"0\">{gripper}</InternalElement>{robot}"
        ));
        let read = product_configuration(&text).unwrap();
        let [first, second] = read.as_slice() else {
            panic!("{read:?}")
        };
        assert_eq!((&*first.application_uri, first.line), ("urn:gripper", 4));
        let field = |name: &str, value| (name.to_owned(), value);
        assert_eq!(
            first.fields,
            [
                field("Force", ConfiguredValue::Number(40.5)),
                field("Retries", ConfiguredValue::Integer(3)),
                field("Soft", ConfiguredValue::Boolean(true)),
                field("Product", ConfiguredValue::Text("4711".to_owned())),
                field("Width", ConfiguredValue::Number(0.03)),
                field("Order", ConfiguredValue::Text("A-1".to_owned())),
            ]
        );
        assert_eq!(
            second.fields,
            [field("Speed", ConfiguredValue::Number(0.5))]
        );
        let speed = ("Speed".to_owned(), "m/s".to_owned());
        assert_eq!((&first.units, &second.units), (&vec![], &vec![speed]));
    }

    #[test]
    fn each_fault_names_the_line_the_component_and_the_field() {
        let speed = || attribute("Speed", "xs:double", "0.5");
        for (elements, expected) in [
            (String::new(), "no element names a component"),
            (element("urn:a", &[]), "line 4: urn:a has no fields"),
            (
                [element("urn:a", &[speed()]), element("urn:a", &[speed()])].concat(),
                "line 5: urn:a is configured twice",
            ),
            (
                element("urn:a", &[speed(), speed()]),
                "line 4: the field Speed of urn:a is given twice",
            ),
            (
                element("urn:a", &[attribute("Speed", "xs:double", "fast")]),
                "line 4: the field Speed of urn:a is `fast`, which is no xs:double",
            ),
            (
                element("urn:a", &[attribute("Speed", "xs:double", "NaN")]),
                "which is no xs:double",
            ),
        ] {
            let told = product_configuration(&file(&elements)).unwrap_err();
            assert!(told.to_string().contains(expected), "{told}");
        }
        assert!(product_configuration("<CAEXFile>").is_err());
    }
}
