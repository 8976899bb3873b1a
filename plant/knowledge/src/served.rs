//! The address space of a running server as statements, with the terms of [`crate::owl`].
//!
//! Types, and the nodes that types declare, have the IRIs that NodeSets have for them, so that a
//! query for a class finds the instances of all servers. All other nodes have IRIs of their server:
//! two servers of one maker may have nodes with equal names in one namespace. The IRIs differ from
//! those of components and skills, so that named questions have each label of a skill once.

use std::collections::HashSet;

use mtp::escaped;
use oxigraph::model::Triple;

use crate::component::{ComponentFacts, NodeName, OPC_UA};
use crate::owl::terms::{OntologyWriter, iri, typed};
use crate::owl::{OntologyNode, OwlNodeClass};
use crate::vocabulary as v;

/// The nodes that were found in a server.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ServedSpace {
    /// The ApplicationUri of the server, or its endpoint if it has none.
    pub application_uri: String,
    /// The endpoint.
    pub endpoint: String,
    /// The time at which the nodes were read, as `xsd:dateTime`.
    pub browsed: String,
    /// Whether no nodes and no references are missing.
    pub is_complete: bool,
    /// The nodes at which the search began.
    pub start: Vec<NodeName>,
    /// All nodes, in the order in which they were found.
    pub nodes: Vec<ServedNode>,
    /// Types, and nodes that types declare, also those that are not among the nodes.
    pub shared: HashSet<NodeName>,
}

/// A node of a server.
#[derive(Debug, Clone, PartialEq)]
pub struct ServedNode {
    /// The node.
    pub node: OntologyNode,
    /// The time of its value according to the server, as `xsd:dateTime`.
    pub source_time: Option<String>,
    /// The status of its value, if that is not Good.
    pub status: Option<String>,
}

impl ServedSpace {
    /// Returns the IRI of the server.
    #[must_use]
    pub fn iri(&self) -> String {
        self.identity().iri()
    }

    /// Returns the statements. Types and declared nodes of namespaces that `is_known` accepts are
    /// left out, because their NodeSets are in the graph.
    #[must_use]
    pub fn triples(&self, is_known: &dyn Fn(&str) -> bool) -> Vec<Triple> {
        let server = self.identity();
        let found: HashSet<&NodeName> = self.nodes.iter().map(|served| &served.node.name).collect();
        let iri_of = |name: &NodeName| {
            // A node of the standard that was not browsed is a type or a rule, not an instance.
            let is_standard = name.namespace == OPC_UA && !found.contains(name);
            if is_standard || self.shared.contains(name) {
                name.iri()
            } else {
                server.skill_iri(name)
            }
        };
        let mut writer = OntologyWriter::new(&iri_of);
        if let Some(subject) = iri(&server.iri()) {
            writer.is_a(&subject, v::SERVER);
            writer.text(&subject, v::APPLICATION_URI, &self.application_uri);
            writer.text(&subject, v::ENDPOINT, &self.endpoint);
            writer.say(&subject, v::BROWSED, typed(&self.browsed, "dateTime"));
            let is_complete = typed(bool_text(self.is_complete), "boolean");
            writer.say(&subject, v::IS_COMPLETE, is_complete);
            for node in self.start.iter().filter_map(|name| iri(&iri_of(name))) {
                writer.say(&subject, v::HAS_NODE, node.into());
            }
        }
        for served in &self.nodes {
            let name = &served.node.name;
            if self.shared.contains(name) && is_known(&name.namespace) {
                continue;
            }
            writer.node(&served.node);
            let Some(subject) = iri(&iri_of(name)) else {
                continue;
            };
            if let Some(time) = &served.source_time {
                writer.say(&subject, v::SOURCE_TIMESTAMP, typed(time, "dateTime"));
            }
            if let Some(status) = &served.status {
                writer.text(&subject, v::STATUS_CODE, status);
            }
        }
        writer.triples
    }

    /// Returns the number of nodes that are instances of the server.
    #[must_use]
    pub fn instances(&self) -> usize {
        let is_own = |served: &&ServedNode| !self.shared.contains(&served.node.name);
        self.nodes.iter().filter(is_own).count()
    }

    /// Adds the class of a node to the nodes with shared IRIs if it is a type.
    pub fn share(&mut self, name: &NodeName, class: OwlNodeClass) {
        if class.is_type() {
            self.shared.insert(name.clone());
        }
    }

    /// Returns the server in the place of a component, whose nodes have IRIs below its own.
    fn identity(&self) -> ComponentFacts {
        let uri = escaped(&self.application_uri);
        ComponentFacts {
            application_uri: format!("urn:ua-bridge:server:{uri}"),
            ..ComponentFacts::default()
        }
    }
}

const fn bool_text(value: bool) -> &'static str {
    if value { "true" } else { "false" }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::owl::{OntologyReference, OntologyValue};
    use crate::{Knowledge, KnowledgeSource, SourceKind};

    fn name(namespace: &str, identifier: &str) -> NodeName {
        NodeName {
            namespace: namespace.to_owned(),
            identifier: identifier.to_owned(),
        }
    }

    fn node(class: OwlNodeClass, id: &str, references: &[(&str, NodeName)]) -> ServedNode {
        let references = references.iter().map(|(of, target)| OntologyReference {
            of_type: name(OPC_UA, of),
            is_forward: true,
            target: target.clone(),
        });
        ServedNode {
            node: OntologyNode {
                class,
                name: name("urn:maker", id),
                browse_name: id.to_owned(),
                texts: Vec::new(),
                data_type: None,
                attributes: Vec::new(),
                references: references.collect(),
                definition: None,
                value: (class == OwlNodeClass::Variable)
                    .then(|| OntologyValue::Typed("21.5".to_owned(), "double")),
            },
            source_time: (class == OwlNodeClass::Variable)
                .then(|| "2026-11-27T10:00:00Z".to_owned()),
            status: None,
        }
    }

    /// A pump of a type of the maker, with its speed.
    fn space(server: &str) -> ServedSpace {
        let own = |id: &str| name("urn:maker", id);
        let pump = [("i=40", own("i=1")), ("i=47", own("i=11"))];
        let speed = [("i=40", name(OPC_UA, "i=63"))];
        ServedSpace {
            application_uri: server.to_owned(),
            endpoint: "opc.tcp://h:4840".to_owned(),
            browsed: "2026-11-27T10:00:01Z".to_owned(),
            is_complete: true,
            start: vec![name(OPC_UA, "i=85")],
            nodes: vec![
                node(OwlNodeClass::ObjectType, "i=1", &[]),
                node(OwlNodeClass::Object, "i=10", &pump),
                node(OwlNodeClass::Variable, "i=11", &speed),
            ],
            shared: HashSet::from([own("i=1")]),
        }
    }

    fn quads(knowledge: &Knowledge) -> String {
        let mut quads = Vec::new();
        knowledge.write_quads(None, &mut quads).unwrap();
        String::from_utf8(quads).unwrap()
    }

    #[test]
    fn two_servers_of_a_maker_share_the_type_and_have_their_own_instances() {
        let knowledge = Knowledge::new().unwrap();
        for server in ["urn:left", "urn:right"] {
            let source = KnowledgeSource::new(SourceKind::Server, server);
            let triples = space(server).triples(&|_| false);
            knowledge.replace_ontology(&source, triples, 1).unwrap();
        }
        let quads = quads(&knowledge);
        let is_a = "<http://www.w3.org/1999/02/22-rdf-syntax-ns#type>";
        for line in [
            format!("<urn:ua-bridge:server:urn%3Aleft#urn%3Amaker;i=10> {is_a} <urn:maker#i=1>"),
            format!("<urn:ua-bridge:server:urn%3Aright#urn%3Amaker;i=10> {is_a} <urn:maker#i=1>"),
            "<urn:ua-bridge:server:urn%3Aleft#urn%3Amaker;i=10> <http://opcfoundation.org/UA/#i=47> \
             <urn:ua-bridge:server:urn%3Aleft#urn%3Amaker;i=11>"
                .to_owned(),
            "<urn:ua-bridge:server:urn%3Aright#urn%3Amaker;i=11> <urn:ua-bridge:plant#nodeId> \"nsu=urn:maker;i=11\""
                .to_owned(),
            format!("<urn:ua-bridge:server:urn%3Aleft#urn%3Amaker;i=11> {is_a} <http://opcfoundation.org/UA/#i=63>"),
            "<urn:ua-bridge:server:urn%3Aleft> <urn:ua-bridge:plant#hasNode> <http://opcfoundation.org/UA/#i=85>"
                .to_owned(),
        ] {
            assert!(quads.contains(&line), "{line}\n{quads}");
        }
        let times = quads
            .matches("<urn:ua-bridge:plant#sourceTimestamp>")
            .count();
        assert_eq!(times, 2, "a value of each server");
    }

    #[test]
    fn types_of_loaded_nodesets_are_not_written_again() {
        let all = space("urn:left").triples(&|_| false);
        let rest = space("urn:left").triples(&|namespace| namespace == "urn:maker");
        let about_type = |triples: &[Triple]| {
            let subjects = triples.iter().map(|triple| triple.subject.to_string());
            subjects.filter(|one| one == "<urn:maker#i=1>").count()
        };
        assert!(about_type(&all) > 0);
        assert_eq!(about_type(&rest), 0);
        assert_eq!(all.len() - rest.len(), about_type(&all), "instances stay");
        assert_eq!(space("urn:left").instances(), 2);
    }
}
