//! The service `get_type_description` of a node
//! (`type_description_interfaces/srv/GetTypeDescription`, REP-2016).

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use messages::{DescribedField, DescribedType, Dialect, TypeHash, TypeName, TypeRegistry};

use crate::cdr::{CdrReader, CdrWriter, Malformed};
use crate::domain::{Domain, DomainError};
use crate::service::{
    ServiceCounters, ServiceName, ServiceOptions, ServicePeers, ServiceRequest, ServiceServer,
    ServiceTypes,
};

/// The types of the node by their full names, such as `std_msgs/msg/Bool`.
type DescriptionTable = BTreeMap<(String, TypeHash), Description>;

/// A type with its referenced types, itself first.
#[derive(Debug)]
struct Description {
    types: Vec<DescribedType>,
    sources: Vec<TypeSource>,
}

/// The source of a type, in the format of `type_description_interfaces/msg/TypeSource`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TypeSource {
    /// The full name of the type.
    pub name: String,
    /// The extension of its file, or `implicit` for a type without its own file.
    pub encoding: &'static str,
    /// The contents of its file.
    pub text: String,
}

/// Serves the descriptions of the types that this node reads and writes. Dropping it withdraws the
/// service.
#[derive(Debug)]
pub struct TypeServer {
    known: Arc<Mutex<DescriptionTable>>,
    server: ServiceServer,
}

impl TypeServer {
    /// Opens the service of the domain's node. Call this on a tokio runtime.
    pub fn open(domain: &Domain, peers: &ServicePeers) -> Result<Self, DomainError> {
        let service = service(&domain.node_name());
        let hashes = TypeName::new(PACKAGE, SERVICE)
            .ok()
            .and_then(|name| definitions().service_type_hashes(&name).ok());
        if let Some(hashes) = hashes {
            service.announce(domain, &hashes);
        }
        let known = Arc::new(Mutex::new(DescriptionTable::new()));
        let asked = Arc::clone(&known);
        let handler = move |request: ServiceRequest| {
            let answer = read_request(&request.bytes).map(|request| {
                let known = asked.lock().unwrap_or_else(PoisonError::into_inner);
                answer(&known, &request)
            });
            async { answer.map_err(|Malformed| "a truncated request".to_owned()) }
        };
        let options = ServiceOptions::default();
        let server = ServiceServer::open(domain, peers, &service, options, handler)?;
        Ok(Self { known, server })
    }

    /// Adds a type that is read, written or served, with its referenced types.
    pub fn learn(&self, types: Vec<DescribedType>, sources: Vec<TypeSource>, hash: TypeHash) {
        let Some(first) = types.first() else {
            return;
        };
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let name = first.name.clone();
        known.insert((name, hash), Description { types, sources });
    }

    /// Returns whether the type is served already.
    #[must_use]
    pub fn tells(&self, full: &str, hash: TypeHash) -> bool {
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.contains_key(&(full.to_owned(), hash))
    }

    /// Returns the counters of the service.
    #[must_use]
    pub fn counters(&self) -> ServiceCounters {
        self.server.counters()
    }
}

/// Returns the service of a node.
#[must_use]
pub fn service(node: &str) -> ServiceName {
    let of = |half| format!("type_description_interfaces::srv::dds_::GetTypeDescription_{half}_");
    ServiceName {
        name: format!("{node}/get_type_description"),
        types: ServiceTypes {
            request: of("Request"),
            response: of("Response"),
        },
    }
}

/// Encodes a request for a type without its sources.
#[must_use]
pub fn request(name: &TypeName, hash: TypeHash) -> Bytes {
    let mut writer = CdrWriter::new();
    writer.string(&name.ros2());
    writer.string(&hash.to_string());
    writer.bool(false);
    writer.finish()
}

/// The reason why a node does not describe a type.
#[derive(Debug, thiserror::Error)]
pub enum NotDescribed {
    /// The response is not CDR of its type.
    #[error("its response is malformed")]
    Malformed,
    /// The node refuses the request, for this reason.
    #[error("it does not describe the type: {0}")]
    Refused(String),
}

impl From<Malformed> for NotDescribed {
    fn from(Malformed: Malformed) -> Self {
        Self::Malformed
    }
}

/// Decodes the type and its referenced types.
///
/// # Errors
/// The node does not describe the type.
pub fn read_answer(bytes: &[u8]) -> Result<Vec<DescribedType>, NotDescribed> {
    let mut reader = CdrReader::new(bytes)?;
    let successful = reader.bool()?;
    let reason = reader.string()?;
    if !successful {
        return Err(NotDescribed::Refused(reason));
    }
    let mut types = vec![read_type(&mut reader)?];
    types.extend(reader.sequence(read_type)?);
    Ok(types)
}

fn read_type(reader: &mut CdrReader<'_>) -> Result<DescribedType, Malformed> {
    Ok(DescribedType {
        name: reader.string()?,
        fields: reader.sequence(|reader| {
            let field = DescribedField {
                name: reader.string()?,
                type_id: reader.u8()?,
                capacity: reader.u64()?,
                string_capacity: reader.u64()?,
                nested: reader.string()?,
            };
            // The default value.
            reader.string()?;
            Ok(field)
        })?,
    })
}

/// A request of another node.
#[derive(Debug, PartialEq, Eq)]
struct TypeRequest {
    name: String,
    hash: String,
    /// Whether the sources are requested.
    sources: bool,
}

fn read_request(bytes: &[u8]) -> Result<TypeRequest, Malformed> {
    let mut reader = CdrReader::new(bytes)?;
    Ok(TypeRequest {
        name: reader.string()?,
        hash: reader.string()?,
        sources: reader.bool()?,
    })
}

/// Encodes the response to a request, for a known or an unknown type.
fn answer(known: &DescriptionTable, request: &TypeRequest) -> Bytes {
    let found = describe(known, &request.name, &request.hash);
    let mut writer = CdrWriter::new();
    writer.bool(found.is_ok());
    let reason = found.as_ref().err().map(ToString::to_string);
    writer.string(reason.as_deref().unwrap_or_default());
    let (described, sources) = match found {
        Ok(found) => (&found.types[..], &found.sources[..]),
        Err(_) => (&[][..], &[][..]),
    };
    let nothing = DescribedType {
        name: String::new(),
        fields: Vec::new(),
    };
    write_type(&mut writer, described.first().unwrap_or(&nothing));
    writer.sequence(described.get(1..).unwrap_or_default(), write_type);
    let sources = if request.sources { sources } else { &[] };
    writer.sequence(sources, |writer, source| {
        writer.string(&source.name);
        writer.string(source.encoding);
        writer.string(&source.text);
    });
    // No further information.
    writer.u32(0);
    writer.finish()
}

/// The reason why this node does not describe a type. The client gets its text.
#[derive(Debug, thiserror::Error)]
enum UnusedType {
    /// This node does not use the type with this name.
    #[error("this node does not use the type {0}")]
    Name(String),
    /// This node uses another version of the type.
    #[error("this node uses the type {name} with the hash {}", hashes.join(", "))]
    Hash {
        /// The name of the type.
        name: String,
        /// The hashes of the versions that this node uses.
        hashes: Vec<String>,
    },
}

fn describe<'k>(
    known: &'k DescriptionTable,
    name: &str,
    hash: &str,
) -> Result<&'k Description, UnusedType> {
    // For messages the short name suffices.
    let full = name.parse::<TypeName>();
    let full = full.map_or_else(|_| name.to_owned(), |name| name.ros2());
    let of_name = || known.iter().filter(|((of, _), _)| *of == full);
    // As in rcl, any hash matches if the request has an empty hash.
    let asked = of_name().find(|((_, ours), _)| hash.is_empty() || hash == ours.to_string());
    if let Some((_, described)) = asked {
        return Ok(described);
    }
    let hashes: Vec<String> = of_name().map(|((_, ours), _)| ours.to_string()).collect();
    if hashes.is_empty() {
        return Err(UnusedType::Name(name.to_owned()));
    }
    let name = name.to_owned();
    Err(UnusedType::Hash { name, hashes })
}

fn write_type(writer: &mut CdrWriter, described: &DescribedType) {
    writer.string(&described.name);
    writer.sequence(&described.fields, |writer, field| {
        writer.string(&field.name);
        writer.u8(field.type_id);
        writer.u64(field.capacity);
        writer.u64(field.string_capacity);
        writer.string(&field.nested);
        writer.string("");
    });
}

/// Returns the definitions of the service in `.srv` and `.msg` files, for the hashes that its
/// endpoints announce.
pub(crate) fn definitions() -> TypeRegistry {
    let mut registry = TypeRegistry::empty(Dialect::Ros2);
    for (name, text) in MESSAGES {
        if let Ok(name) = TypeName::new(PACKAGE, name) {
            // A test compares the hash of the complete definitions.
            let added = registry.add(&name, text);
            debug_assert!(added.is_ok(), "{name}");
        }
    }
    if let Ok(name) = TypeName::new(PACKAGE, SERVICE) {
        let added = registry.add_service(&name, SERVICE_TEXT);
        debug_assert!(added.is_ok(), "{name}");
    }
    registry
}

pub(crate) const PACKAGE: &str = "type_description_interfaces";
pub(crate) const SERVICE: &str = "GetTypeDescription";
const SERVICE_TEXT: &str = "string type_name\nstring type_hash\nbool include_type_sources true\n---\nbool successful\n\
    string failure_reason\nTypeDescription type_description\nTypeSource[] type_sources\nKeyValue[] extra_information\n";
const MESSAGES: [(&str, &str); 6] = [
    (
        "FieldType",
        "uint8 type_id 0\nuint64 capacity\nuint64 string_capacity\nstring<=255 nested_type_name\n",
    ),
    (
        "Field",
        "string name\nFieldType type\nstring default_value\n",
    ),
    (
        "IndividualTypeDescription",
        "string<=255 type_name\nField[] fields\n",
    ),
    (
        "TypeDescription",
        "IndividualTypeDescription type_description\nIndividualTypeDescription[] referenced_type_descriptions\n",
    ),
    (
        "TypeSource",
        "string type_name\nstring encoding\nstring raw_file_contents\n",
    ),
    ("KeyValue", "string key\nstring value\n"),
];

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> TypeName {
        text.parse().unwrap()
    }

    /// Returns a node that has only this type of the bundle.
    fn known(name: &TypeName) -> (DescriptionTable, TypeHash) {
        let registry = TypeRegistry::bundle(Dialect::Ros2);
        let hash = registry.type_hash(name).unwrap();
        let types = registry.describe(name).unwrap();
        let source = |described: &DescribedType| TypeSource {
            name: described.name.clone(),
            encoding: "msg",
            text: format!("text of {}", described.name),
        };
        let sources = types.iter().map(source).collect();
        let description = Description { types, sources };
        (
            DescriptionTable::from([((name.ros2(), hash), description)]),
            hash,
        )
    }

    fn asked(name: &str, hash: &str, sources: bool) -> TypeRequest {
        TypeRequest {
            name: name.to_owned(),
            hash: hash.to_owned(),
            sources,
        }
    }

    #[test]
    fn what_is_answered_is_read_as_the_type_it_is() {
        let wanted = name("sensor_msgs/JointState");
        let (known, hash) = known(&wanted);
        let request = read_request(&request(&wanted, hash)).unwrap();
        let expected = asked("sensor_msgs/msg/JointState", &hash.to_string(), false);
        assert_eq!(request, expected);
        let types = read_answer(&answer(&known, &request)).unwrap();
        assert_eq!(types, known[&(wanted.ros2(), hash)].types);
        for (type_name, type_hash) in [("x/msg/Y", ""), ("sensor_msgs/msg/JointState", "RIHS01_0")]
        {
            let request = asked(type_name, type_hash, true);
            let refused = read_answer(&answer(&known, &request))
                .unwrap_err()
                .to_string();
            assert!(
                refused.contains("it does not describe the type: "),
                "{refused}"
            );
        }
    }

    #[test]
    fn an_answer_that_is_cut_anywhere_is_malformed() {
        let (known, _) = known(&name("geometry_msgs/Twist"));
        let whole = answer(&known, &asked("geometry_msgs/msg/Twist", "", false));
        // The types are followed by two counts that are not read, and their padding.
        for length in 0..whole.len() - 11 {
            assert!(read_answer(&whole[..length]).is_err(), "{length}");
        }
    }

    #[test]
    fn the_sources_are_told_to_a_node_that_asks_for_them() {
        let (known, _) = known(&name("geometry_msgs/Twist"));
        let answered = answer(&known, &asked("geometry_msgs/msg/Twist", "", true));
        let text = String::from_utf8_lossy(&answered);
        for of in ["Twist", "Vector3"] {
            assert!(
                text.contains(&format!("text of geometry_msgs/msg/{of}")),
                "{text}"
            );
        }
        assert!(read_answer(&answered).is_ok());
        let without = answer(&known, &asked("geometry_msgs/msg/Twist", "", false));
        assert!(!String::from_utf8_lossy(&without).contains("text of"));
    }

    /// Compares the hash of `type_description_interfaces/msg/TypeDescription` with the hash that
    /// ROS 2 publishes.
    #[test]
    fn the_messages_have_the_hash_of_ros() {
        let hash = definitions().type_hash(&name("type_description_interfaces/TypeDescription"));
        let published = "RIHS01_739f2508c9fa3a6f330913ff5b9d25fb74159a077da71e1087f51a60c12a080b";
        assert_eq!(hash.unwrap().to_string(), published);
        assert!(
            definitions()
                .service_type_hashes(&name("type_description_interfaces/GetTypeDescription"))
                .is_ok()
        );
    }
}
