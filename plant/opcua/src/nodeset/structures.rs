//! Structures that NodeSets define: decodes values in the files by these definitions.

use std::collections::HashMap;
use std::io::{Read, Write};
use std::sync::{Arc, LazyLock};

use opcua::nodes::{ImportedItem, NodeBase as _, NodeSetImport as _, NodeType};
use opcua::server::address_space::CoreNamespace;
use opcua::sync::RwLock;
use opcua::types::custom::{
    DataTypeTree, DynamicStructure, DynamicTypeLoader, EncodingIds, ParentIds, StructTypeInfo,
    TypeInfo,
};
use opcua::types::xml::{XmlEncodable, XmlStreamReader, XmlStreamWriter, XmlType};
use opcua::types::{
    BinaryEncodable, Context, DataTypeDefinition, DynEncodable, EncodingResult, Error,
    ExpandedMessageInfo, ExpandedNodeId, NamespaceMap, NodeId, NodeSetNamespaceMapper,
    ReferenceTypeId, StructureDefinition, StructureField, StructureType, TypeLoader,
    TypeLoaderPriority, UaNullable, Variant, XmlBody,
};

use super::{BINARY, DEEPEST};

/// Decodes values of structures after [`define`](Self::define).
#[derive(Default)]
pub(super) struct Structures(RwLock<Option<DynamicTypeLoader>>);

impl Structures {
    /// Replaces the definitions by the definitions of the DataTypes among these nodes.
    pub(super) fn define(&self, items: &[ImportedItem]) {
        let own = types(items);
        let loader = (!own.is_empty()).then(|| DynamicTypeLoader::new(Arc::new(tree(own, items))));
        *self.0.write() = loader;
    }
}

impl TypeLoader for Structures {
    fn load_from_xml(
        &self,
        node_id: &NodeId,
        stream: &mut XmlStreamReader<&mut dyn Read>,
        ctx: &Context<'_>,
        name: &str,
    ) -> Option<EncodingResult<Box<dyn DynEncodable>>> {
        // The loader has the core DataTypes without their fields.
        if node_id.namespace == 0 {
            return None;
        }
        let loader = self.0.read();
        let read = loader.as_ref()?.load_from_xml(node_id, stream, ctx, name)?;
        Some(read.and_then(|read| {
            let structure = read.as_dyn_any().downcast::<DynamicStructure>();
            let structure = structure.map_err(|_| Error::decoding("it is not a structure"))?;
            Ok(Box::new(Exact(*structure)) as Box<dyn DynEncodable>)
        }))
    }

    fn load_from_binary(
        &self,
        _node_id: &NodeId,
        _stream: &mut dyn Read,
        _ctx: &Context<'_>,
        _length: Option<usize>,
    ) -> Option<EncodingResult<Box<dyn DynEncodable>>> {
        None
    }

    fn priority(&self) -> TypeLoaderPriority {
        TypeLoaderPriority::Dynamic(50)
    }
}

/// A structure with its exact encoded length. The library computes a wrong length for arrays of
/// structures in structures, and clients would continue to decode at a wrong offset.
#[derive(Debug, Clone, PartialEq)]
struct Exact(DynamicStructure);

impl BinaryEncodable for Exact {
    fn byte_len(&self, ctx: &Context<'_>) -> usize {
        let mut bytes = Vec::new();
        // The later encoding reports the same error.
        drop(BinaryEncodable::encode(&self.0, &mut bytes, ctx));
        bytes.len()
    }

    fn encode<S: Write + ?Sized>(&self, stream: &mut S, ctx: &Context<'_>) -> EncodingResult<()> {
        BinaryEncodable::encode(&self.0, stream, ctx)
    }
}

impl UaNullable for Exact {
    fn is_ua_null(&self) -> bool {
        self.0.is_ua_null()
    }
}

impl XmlType for Exact {
    const TAG: &'static str = DynamicStructure::TAG;

    fn tag(&self) -> &str {
        self.0.tag()
    }
}

impl XmlEncodable for Exact {
    fn encode(
        &self,
        stream: &mut XmlStreamWriter<&mut dyn Write>,
        ctx: &Context<'_>,
    ) -> EncodingResult<()> {
        XmlEncodable::encode(&self.0, stream, ctx)
    }
}

impl ExpandedMessageInfo for Exact {
    fn full_type_id(&self) -> ExpandedNodeId {
        self.0.full_type_id()
    }

    fn full_json_type_id(&self) -> ExpandedNodeId {
        self.0.full_json_type_id()
    }

    fn full_xml_type_id(&self) -> ExpandedNodeId {
        self.0.full_xml_type_id()
    }

    fn full_data_type_id(&self) -> ExpandedNodeId {
        self.0.full_data_type_id()
    }
}

/// Checks that a value can be encoded. Structures of unknown types remain XML, and a file may omit
/// a field that the structure requires.
///
/// # Errors
/// [`LeftOutValue`].
pub(super) fn check_sent(value: &Variant, context: &Context<'_>) -> Result<(), LeftOutValue> {
    if !is_known(value) {
        return Err(LeftOutValue::UnknownStructure);
    }
    BinaryEncodable::encode(value, &mut std::io::sink(), context)?;
    Ok(())
}

/// The reason why a value of a file is left out.
#[derive(Debug, thiserror::Error)]
pub(super) enum LeftOutValue {
    #[error("the type of its structure is unknown")]
    UnknownStructure,
    /// The value cannot be decoded from XML, or not be encoded.
    #[error(transparent)]
    Encoding(#[from] Error),
}

fn is_known(value: &Variant) -> bool {
    if let Variant::Array(array) = value {
        return array.values.iter().all(is_known);
    }
    if let Variant::Variant(inner) = value {
        return is_known(inner);
    }
    let Variant::ExtensionObject(object) = value else {
        return true;
    };
    let inner = object.inner_as::<Exact>();
    let is_inner_known = inner.is_none_or(|inner| inner.0.values().iter().all(is_known));
    is_inner_known && !object.inner_is::<XmlBody>()
}

/// A DataType and its encodings.
struct Type<'i> {
    item: &'i ImportedItem,
    encodings: EncodingIds,
}

/// Returns the DataTypes among nodes, with their encodings.
fn types(items: &[ImportedItem]) -> Vec<Type<'_>> {
    let mut encodings: HashMap<&NodeId, EncodingIds> = HashMap::new();
    let named: HashMap<&NodeId, &str> = items
        .iter()
        .map(|item| item.node.as_node())
        .map(|node| (node.node_id(), node.browse_name().name.as_ref()))
        .collect();
    for item in items {
        let id = item.node.as_node().node_id();
        for reference in &item.references {
            if reference.type_id != ReferenceTypeId::HasEncoding {
                continue;
            }
            let (data_type, encoding) = match reference.is_forward {
                true => (id, &reference.target_id),
                false => (&reference.target_id, id),
            };
            let all = encodings.entry(data_type).or_default();
            match named.get(encoding) {
                Some(&BINARY) => all.binary_id = encoding.clone(),
                Some(&XML) => all.xml_id = encoding.clone(),
                Some(&JSON) => all.json_id = encoding.clone(),
                Some(_) | None => {}
            }
        }
    }
    let data_types = items.iter().filter(|item| as_type(item).is_some());
    data_types
        .map(|item| Type {
            item,
            encodings: encodings
                .remove(item.node.as_node().node_id())
                .unwrap_or_default(),
        })
        .collect()
}

fn as_type(item: &ImportedItem) -> Option<&opcua::nodes::DataType> {
    match &item.node {
        NodeType::DataType(data_type) => Some(data_type),
        NodeType::Object(_)
        | NodeType::ObjectType(_)
        | NodeType::ReferenceType(_)
        | NodeType::Variable(_)
        | NodeType::VariableType(_)
        | NodeType::View(_)
        | NodeType::Method(_) => None,
    }
}

/// Adds inherited fields of structures in other files to each structure definition (OPC 10000-3,
/// 8.48). The library adds inherited fields of the same file only. Returns the changed definitions.
///
/// Structures of the core namespace have no definition here, so their fields are not added.
pub(super) fn inherit(items: &mut [ImportedItem]) -> HashMap<NodeId, DataTypeDefinition> {
    let mut known: HashMap<NodeId, StructureDefinition> = HashMap::new();
    for item in items.iter() {
        let Some(data_type) = as_type(item) else {
            continue;
        };
        if let Some(DataTypeDefinition::Structure(own)) = data_type.data_type_definition() {
            known.insert(data_type.node_id().clone(), own.clone());
        }
    }
    let mut others = HashMap::new();
    for item in items {
        let NodeType::DataType(data_type) = &mut item.node else {
            continue;
        };
        let Some(whole) = with_inherited(data_type.node_id(), &known) else {
            continue;
        };
        let whole = DataTypeDefinition::Structure(whole);
        data_type.set_data_type_definition(Some(whole.clone()));
        others.insert(data_type.node_id().clone(), whole);
    }
    others
}

/// Returns a definition with its inherited fields, the fields of the topmost supertype first;
/// `None` if it already has all fields.
fn with_inherited(
    id: &NodeId,
    known: &HashMap<NodeId, StructureDefinition>,
) -> Option<StructureDefinition> {
    let own = known.get(id)?;
    let mut line = vec![own];
    while line.len() < DEEPEST {
        let Some(above) = line.last().and_then(|at| known.get(&at.base_data_type)) else {
            break;
        };
        line.push(above);
    }
    let mut fields: Vec<StructureField> = Vec::new();
    for field in line
        .iter()
        .rev()
        .flat_map(|one| one.fields.iter().flatten())
    {
        if fields.iter().all(|there| there.name != field.name) {
            fields.push(field.clone());
        }
    }
    if own.fields.as_ref().map_or(0, Vec::len) == fields.len() {
        return None;
    }
    let has_optional = fields.iter().any(|field| field.is_optional);
    let structure_type = match own.structure_type == StructureType::Structure && has_optional {
        true => StructureType::StructureWithOptionalFields,
        false => own.structure_type,
    };
    Some(StructureDefinition {
        structure_type,
        fields: Some(fields),
        ..own.clone()
    })
}

/// Returns the type tree with which the library decodes values.
fn tree(own: Vec<Type<'_>>, items: &[ImportedItem]) -> DataTypeTree {
    let mut parents: HashMap<&NodeId, &NodeId> = HashMap::new();
    parents.extend(CORE_TYPES.iter().map(|one| (&one.id, &one.parent)));
    for item in items {
        let Some(data_type) = as_type(item) else {
            continue;
        };
        let supertype = item.references.iter().find(|reference| {
            reference.type_id == ReferenceTypeId::HasSubtype && !reference.is_forward
        });
        parents.extend(supertype.map(|one| (data_type.node_id(), &one.target_id)));
    }
    let mut known = ParentIds::new();
    for (id, parent) in &parents {
        // A cyclic type hierarchy would make the library loop forever.
        if (0..DEEPEST)
            .try_fold(*id, |at, _| parents.get(at).copied())
            .is_none()
        {
            known.add_type((*id).clone(), (*parent).clone());
        }
    }
    let mut tree = DataTypeTree::new(ParentIds::new());
    for core in CORE_TYPES.iter() {
        tree.add_type(core.id.clone(), core.info());
    }
    for one in own {
        let Some(data_type) = as_type(one.item) else {
            continue;
        };
        let (id, Some(definition)) = (data_type.node_id(), data_type.data_type_definition()) else {
            continue;
        };
        let name = data_type.browse_name().name.as_ref().to_owned();
        let info = TypeInfo::from_type_definition(
            definition.clone(),
            name,
            Some(one.encodings),
            data_type.is_abstract(),
            id,
            &known,
        );
        match info {
            // A structure without an encoding id cannot be encoded.
            Ok(TypeInfo::Struct(info))
                if info.encoding_ids.binary_id.is_null() && !info.is_abstract => {}
            Ok(info) => tree.add_type(id.clone(), info),
            Err(_) => {}
        }
    }
    *tree.parent_ids_mut() = known;
    tree
}

/// A DataType of the core namespace.
struct CoreType {
    id: NodeId,
    parent: NodeId,
    name: String,
    is_abstract: bool,
}

impl CoreType {
    /// Declares the DataType without its fields. The library decodes its values itself.
    fn info(&self) -> TypeInfo {
        TypeInfo::Struct(Arc::new(StructTypeInfo {
            structure_type: StructureType::Structure,
            fields: Vec::new(),
            index_by_name: HashMap::new(),
            encoding_ids: EncodingIds::default(),
            is_abstract: self.is_abstract,
            node_id: self.id.clone(),
            name: self.name.clone(),
        }))
    }
}

static CORE_TYPES: LazyLock<Vec<CoreType>> = LazyLock::new(|| {
    let mut namespaces = NamespaceMap::new();
    let mapper = NodeSetNamespaceMapper::new(&mut namespaces);
    let core = CoreNamespace.load(&mapper);
    core.filter_map(|item| {
        let data_type = as_type(&item)?;
        let supertype = item.references.iter().find(|reference| {
            reference.type_id == ReferenceTypeId::HasSubtype && !reference.is_forward
        })?;
        Some(CoreType {
            id: data_type.node_id().clone(),
            parent: supertype.target_id.clone(),
            name: data_type.browse_name().name.as_ref().to_owned(),
            is_abstract: data_type.is_abstract(),
        })
    })
    .collect()
});

const XML: &str = "Default XML";
const JSON: &str = "Default JSON";
