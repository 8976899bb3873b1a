use std::time::Duration;

use async_trait::async_trait;
use knowledge::owl::OntologyValue;
use knowledge::{Knowledge, KnowledgeSource, SourceKind};
use plant_opcua::types::{
    DateTime, ExpandedNodeId, QualifiedName, ReferenceDescription, VariableId, VariableTypeId,
};

use super::*;

/// A node of a server in memory.
struct Served {
    class: NodeClass,
    name: &'static str,
    /// ReferenceType, whether forward, target.
    references: Vec<(NodeId, bool, NodeId)>,
    value: Option<Variant>,
}

#[derive(Default)]
struct InMemory {
    nodes: HashMap<NodeId, Served>,
}

impl InMemory {
    fn node(&mut self, id: NodeId, class: NodeClass, name: &'static str) {
        let served = Served {
            class,
            name,
            references: Vec::new(),
            value: None,
        };
        self.nodes.insert(id, served);
    }

    fn refers(&mut self, from: &NodeId, of_type: ReferenceTypeId, to: &NodeId) {
        let of_type: NodeId = of_type.into();
        for (one, other, is_forward) in [(from, to, true), (to, from, false)] {
            if let Some(node) = self.nodes.get_mut(one) {
                node.references
                    .push((of_type.clone(), is_forward, other.clone()));
            }
        }
    }

    fn described(
        &self,
        (of_type, is_forward, to): &(NodeId, bool, NodeId),
    ) -> ReferenceDescription {
        let target = self.nodes.get(to);
        ReferenceDescription {
            reference_type_id: of_type.clone(),
            is_forward: *is_forward,
            node_id: ExpandedNodeId::from(to.clone()),
            browse_name: QualifiedName::new(2, target.map_or("", |node| node.name)),
            display_name: LocalizedText::from(target.map_or("", |node| node.name)),
            node_class: target.map_or(NodeClass::Unspecified, |node| node.class),
            ..ReferenceDescription::default()
        }
    }
}

#[async_trait]
impl BrowsableServer for InMemory {
    async fn references(
        &self,
        nodes: &[NodeId],
        what: &Browse,
        most: usize,
    ) -> Result<Vec<BrowsedReferences>, ClientError> {
        let all = nodes.iter().map(|id| {
            let of = self.nodes.get(id).map_or(&[][..], |node| &node.references);
            let wanted = of.iter().filter(|(of_type, is_forward, _)| {
                *is_forward != what.inverse
                    && (what.reference == ReferenceTypeId::References || what.reference == *of_type)
            });
            BrowsedReferences {
                references: wanted.take(most).map(|one| self.described(one)).collect(),
                is_whole: true,
                status: StatusCode::Good,
            }
        });
        Ok(all.collect())
    }

    async fn attributes(
        &self,
        what: &[(NodeId, AttributeId)],
    ) -> Result<Vec<DataValue>, ClientError> {
        let all = what.iter().map(|(id, attribute)| {
            if *id == VariableId::Server_NamespaceArray {
                let uris = [OPC_UA, "urn:server", "urn:maker"];
                return DataValue::new_now(uris.map(str::to_owned).to_vec());
            }
            let value = self.nodes.get(id).and_then(|node| {
                let all = [
                    (
                        AttributeId::NodeClass,
                        Some(Variant::Int32(node.class as i32)),
                    ),
                    (
                        AttributeId::BrowseName,
                        Some(Variant::from(QualifiedName::new(2, node.name))),
                    ),
                    (
                        AttributeId::DisplayName,
                        Some(Variant::from(LocalizedText::from(node.name))),
                    ),
                    (AttributeId::AccessLevel, Some(Variant::Byte(1))),
                    (
                        AttributeId::DataType,
                        Some(Variant::from(NodeId::new(0, 11))),
                    ),
                    (AttributeId::Value, node.value.clone()),
                ];
                let mut all = all.into_iter();
                all.find(|(known, _)| known == attribute)?.1
            });
            DataValue {
                value,
                source_timestamp: Some(DateTime::ymd_hms(2026, 11, 27, 10, 0, 0)),
                ..DataValue::default()
            }
        });
        Ok(all.collect())
    }
}

fn own(id: u32) -> NodeId {
    NodeId::new(2, id)
}

fn name(id: u32) -> NodeName {
    NodeName {
        namespace: "urn:maker".to_owned(),
        identifier: format!("i={id}"),
    }
}

/// A press of a type of the maker, with its force, whose component leads back to the folder.
fn press() -> InMemory {
    let mut server = InMemory::default();
    let objects: NodeId = ObjectId::ObjectsFolder.into();
    let server_object: NodeId = ObjectId::Server.into();
    let base: NodeId = NodeId::new(0, 58);
    let variable: NodeId = VariableTypeId::BaseDataVariableType.into();
    let references: NodeId = ReferenceTypeId::HierarchicalReferences.into();
    server.node(objects.clone(), NodeClass::Object, "Objects");
    server.node(server_object.clone(), NodeClass::Object, "Server");
    server.node(base.clone(), NodeClass::ObjectType, "BaseObjectType");
    server.node(
        variable.clone(),
        NodeClass::VariableType,
        "BaseDataVariableType",
    );
    server.node(own(1), NodeClass::ObjectType, "PressType");
    server.node(own(2), NodeClass::ObjectType, "ServoPressType");
    server.node(own(10), NodeClass::Object, "Press");
    server.node(own(11), NodeClass::Variable, "Force");
    server.node(own(12), NodeClass::Object, "Status");
    let all = [
        ReferenceTypeId::HierarchicalReferences,
        ReferenceTypeId::Organizes,
        ReferenceTypeId::HasComponent,
        ReferenceTypeId::HasSubtype,
        ReferenceTypeId::HasTypeDefinition,
    ];
    for of_type in all {
        server.node(of_type.into(), NodeClass::ReferenceType, "Reference");
    }
    for below in [ReferenceTypeId::Organizes, ReferenceTypeId::HasComponent] {
        server.refers(&references, ReferenceTypeId::HasSubtype, &below.into());
    }
    server.refers(&base, ReferenceTypeId::HasSubtype, &own(1));
    server.refers(&own(1), ReferenceTypeId::HasSubtype, &own(2));
    server.refers(&objects, ReferenceTypeId::Organizes, &own(10));
    server.refers(&objects, ReferenceTypeId::Organizes, &server_object);
    server.refers(&server_object, ReferenceTypeId::HasComponent, &own(12));
    server.refers(&own(10), ReferenceTypeId::HasTypeDefinition, &own(2));
    server.refers(&own(10), ReferenceTypeId::HasComponent, &own(11));
    server.refers(&own(11), ReferenceTypeId::HasTypeDefinition, &variable);
    server.refers(&own(11), ReferenceTypeId::HasComponent, &objects);
    if let Some(force) = server.nodes.get_mut(&own(11)) {
        force.value = Some(Variant::Double(12.5));
    }
    server
}

fn found<'s>(searched: &'s Searched, name: &NodeName) -> Option<&'s ServedNode> {
    let mut nodes = searched.space.nodes.iter();
    nodes.find(|served| served.node.name == *name)
}

async fn searched(server: &dyn BrowsableServer, limits: &SearchLimits) -> Searched {
    search(server, &[], limits, &|_| false).await.unwrap()
}

#[tokio::test]
async fn instances_have_values_and_their_types_are_classes() {
    let searched = searched(&press(), &SearchLimits::default()).await;
    assert_eq!(searched.findings, Vec::<String>::new());
    assert!(searched.space.is_complete, "a cycle is no limit");
    let force = found(&searched, &name(11)).unwrap();
    let value = OntologyValue::Typed("12.5".to_owned(), "double");
    assert_eq!(force.node.value, Some(value));
    assert_eq!(
        force.source_time.as_deref(),
        Some("2026-11-27T10:00:00.000Z")
    );
    for shared in [1, 2] {
        assert!(searched.space.shared.contains(&name(shared)), "{shared}");
        assert!(found(&searched, &name(shared)).is_some(), "{shared}");
    }
    assert!(!searched.space.shared.contains(&name(10)));
    assert!(
        found(&searched, &name(12)).is_none(),
        "the parts of the Server object are read on request"
    );
    let with_server = NodeName::parse("i=2253").unwrap();
    let start = [with_server, name(10)];
    let limits = SearchLimits::default();
    let more = search(&press(), &start, &limits, &|_| false).await.unwrap();
    assert!(found(&more, &name(12)).is_some());
}

/// The question of the documentation finds the press by the class above its type.
#[tokio::test]
async fn a_query_for_a_class_finds_the_instance_and_its_value() {
    let knowledge = Knowledge::new().unwrap();
    let mut space = searched(&press(), &SearchLimits::default()).await.space;
    space.application_uri = "urn:server".to_owned();
    let source = KnowledgeSource::new(SourceKind::Server, "urn:server");
    let triples = space.triples(&|_| false);
    knowledge.replace_ontology(&source, triples, 1).unwrap();
    let query = "SELECT ?press { ?press a/<http://www.w3.org/2000/01/rdf-schema#subClassOf>
        <urn:maker#i=1> ; <http://opcfoundation.org/UA/#i=47> ?force .
        ?force <urn:ua-bridge:plant#browseName> \"Force\" ; <urn:ua-bridge:plant#value> 12.5e0 }";
    let query = knowledge::ValueQuery::read(query).unwrap();
    let press = query.value(&std::sync::Arc::new(knowledge)).unwrap();
    assert_eq!(press, "urn:ua-bridge:server:urn%3Aserver#urn%3Amaker;i=10");
}

#[tokio::test]
async fn types_of_known_nodesets_are_not_searched() {
    let limits = SearchLimits::default();
    let is_known = |namespace: &str| namespace == "urn:maker";
    let searched = search(&press(), &[], &limits, &is_known).await.unwrap();
    assert!(found(&searched, &name(2)).is_none());
    assert!(
        searched.space.shared.contains(&name(2)),
        "its IRI is that of the NodeSet"
    );
}

/// A server whose nodes have ten new components each, without end.
struct Endless;

#[async_trait]
impl BrowsableServer for Endless {
    async fn references(
        &self,
        nodes: &[NodeId],
        what: &Browse,
        most: usize,
    ) -> Result<Vec<BrowsedReferences>, ClientError> {
        let is_search = what.reference == ReferenceTypeId::References;
        let hierarchical: NodeId = ReferenceTypeId::HierarchicalReferences.into();
        let all = nodes.iter().map(|id| {
            let below = (0..10)
                .filter(|_| is_search)
                .map(|number| ReferenceDescription {
                    reference_type_id: hierarchical.clone(),
                    is_forward: true,
                    node_id: NodeId::new(2, format!("{}.{number}", id.identifier)).into(),
                    browse_name: QualifiedName::new(2, "x".repeat(5000)),
                    display_name: LocalizedText::from("y".repeat(100_000).as_str()),
                    node_class: NodeClass::Object,
                    ..ReferenceDescription::default()
                });
            BrowsedReferences {
                references: below.take(most).collect(),
                is_whole: true,
                status: StatusCode::Good,
            }
        });
        Ok(all.collect())
    }

    async fn attributes(
        &self,
        what: &[(NodeId, AttributeId)],
    ) -> Result<Vec<DataValue>, ClientError> {
        press().attributes(what).await
    }
}

#[tokio::test]
async fn a_server_without_an_end_is_read_up_to_the_limits() {
    let limits = SearchLimits {
        nodes: 500,
        ..SearchLimits::default()
    };
    let many = searched(&Endless, &limits).await;
    assert!(!many.space.is_complete);
    let walked = many.space.instances();
    assert_eq!(walked, 500);
    let wanted = "the graph is incomplete: it has more than 500 nodes (`nodes`)";
    assert!(
        many.findings.iter().any(|what| what == wanted),
        "{:?}",
        many.findings
    );
    let longest = many
        .space
        .nodes
        .iter()
        .map(|one| one.node.browse_name.len());
    assert_eq!(longest.max(), Some(512));
    assert!(
        many.space
            .nodes
            .iter()
            .skip(1)
            .all(|one| one.node.texts.is_empty())
    );

    let limits = SearchLimits {
        depth: 2,
        ..SearchLimits::default()
    };
    let deep = searched(&Endless, &limits).await;
    assert_eq!(deep.space.instances(), 1 + 10 + 100);
    let wanted = "the graph is incomplete: it has nodes more than 2 deep (`depth`)";
    assert_eq!(deep.findings, [wanted]);

    let limits = SearchLimits {
        within: Duration::ZERO,
        ..SearchLimits::default()
    };
    let late = searched(&Endless, &limits).await;
    assert_eq!(late.space.instances(), 1);
    assert!(late.findings.iter().all(|what| what.contains("too slowly")));
    assert!(!late.findings.is_empty());
}

#[tokio::test]
async fn nodes_that_the_server_does_not_have_are_findings() {
    let mut server = press();
    server.refers(&own(10), ReferenceTypeId::HasComponent, &NodeId::new(9, 1));
    let start = [
        name(10),
        name(77),
        NodeName::parse("nsu=urn:other;i=1").unwrap(),
    ];
    let limits = SearchLimits::default();
    let searched = search(&server, &start, &limits, &|_| false).await.unwrap();
    assert_eq!(searched.space.start, [name(10)]);
    let [other, missing, left_out] = searched.findings.as_slice() else {
        panic!("{:?}", searched.findings)
    };
    assert!(other.contains("`nsu=urn:other;i=1`"), "{other}");
    assert!(missing.contains("`nsu=urn:maker;i=77`"), "{missing}");
    assert!(
        left_out.starts_with("1 references are left out"),
        "{left_out}"
    );
    assert!(
        found(&searched, &name(11)).is_some(),
        "all other nodes are read"
    );
}
