//! The models of the NodeSets in the graph: their versions, and the models that they require.

use mtp::{Object, Triple, escaped};
use oxigraph::model::{NamedNodeRef, Term};

use crate::nodeset::{ModelVersion, NodeSetModel};
use crate::source::{KnowledgeSource, SourceKind};
use crate::store::Knowledge;
use crate::vocabulary as v;

impl Knowledge {
    /// Returns the version of the model of a NodeSet, as the graph has it; empty if it has none.
    pub fn model_version(&self, namespace: &str) -> ModelVersion {
        ModelGraph::of(self, namespace).version(&model_iri(namespace))
    }

    /// Returns the model of a NodeSet with the models that it requires, as the graph has them. A
    /// NodeSet that was stored by an earlier program may state no required models.
    pub fn node_set_model(&self, namespace: &str) -> NodeSetModel {
        let graph = ModelGraph::of(self, namespace);
        let model = model_iri(namespace);
        let required = graph.objects(&model, v::REQUIRES_MODEL).into_iter();
        let required = required.filter_map(|term| {
            let Term::NamedNode(required) = term else {
                return None;
            };
            let namespace = graph.text(required.as_str(), v::RDFS_LABEL)?;
            Some((namespace, graph.version(required.as_str())))
        });
        NodeSetModel {
            namespace: namespace.to_owned(),
            version: graph.version(&model),
            required: required.collect(),
        }
    }
}

/// The graph of a NodeSet.
struct ModelGraph<'k> {
    knowledge: &'k Knowledge,
    graph: String,
}

impl<'k> ModelGraph<'k> {
    fn of(knowledge: &'k Knowledge, namespace: &str) -> Self {
        let graph = KnowledgeSource::new(SourceKind::NodeSet, namespace).graph();
        Self { knowledge, graph }
    }

    fn objects(&self, subject: &str, predicate: &str) -> Vec<Term> {
        let quads = self.knowledge.store().quads_for_pattern(
            Some(NamedNodeRef::new_unchecked(subject).into()),
            Some(NamedNodeRef::new_unchecked(predicate)),
            None,
            Some(NamedNodeRef::new_unchecked(&self.graph).into()),
        );
        quads.flatten().map(|quad| quad.object).collect()
    }

    fn text(&self, subject: &str, predicate: &str) -> Option<String> {
        let mut objects = self.objects(subject, predicate).into_iter();
        objects.find_map(|object| match object {
            Term::Literal(text) => Some(text.value().to_owned()),
            Term::NamedNode(_) | Term::BlankNode(_) => None,
        })
    }

    fn version(&self, model: &str) -> ModelVersion {
        ModelVersion {
            version: self.text(model, v::MODEL_VERSION).unwrap_or_default(),
            publication_date: self.text(model, v::PUBLICATION_DATE).unwrap_or_default(),
        }
    }
}

/// Returns the statements of a model.
pub(crate) fn statements(model: &NodeSetModel) -> Vec<Triple> {
    let iri = model_iri(&model.namespace);
    let mut all = named(&iri, &model.namespace, &model.version);
    all.push(triple(
        &iri,
        v::RDF_TYPE,
        Object::Iri(v::NODE_SET.to_owned()),
    ));
    for (namespace, version) in &model.required {
        let required = format!("{iri}/requires/{}", escaped(namespace));
        all.push(triple(
            &iri,
            v::REQUIRES_MODEL,
            Object::Iri(required.clone()),
        ));
        all.extend(named(&required, namespace, version));
    }
    all
}

/// Returns the statements of the name and the version of a model.
fn named(iri: &str, namespace: &str, version: &ModelVersion) -> Vec<Triple> {
    let mut all = vec![triple(
        iri,
        v::RDFS_LABEL,
        Object::Text(namespace.to_owned()),
    )];
    if !version.version.is_empty() {
        let text = Object::Text(version.version.clone());
        all.push(triple(iri, v::MODEL_VERSION, text));
    }
    let date = version.publication_date.trim();
    if !date.is_empty() {
        let date = match date.contains('T') {
            true => Object::Time(date.to_owned()),
            false => Object::Text(date.to_owned()),
        };
        all.push(triple(iri, v::PUBLICATION_DATE, date));
    }
    all
}

fn triple(subject: &str, predicate: &str, object: Object) -> Triple {
    Triple {
        subject: subject.to_owned(),
        predicate: predicate.to_owned(),
        object,
    }
}

/// Returns the IRI of the model of a namespace.
fn model_iri(namespace: &str) -> String {
    format!("urn:ua-bridge:nodeset:{}", escaped(namespace))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SourceLifetime;
    use crate::nodeset;

    #[test]
    fn a_model_comes_back_from_the_graph_with_what_it_requires() {
        let text = "<UANodeSet><NamespaceUris><Uri>urn:a</Uri></NamespaceUris>\
            <Models><Model ModelUri=\"urn:a\" Version=\"1.2\" PublicationDate=\"2024-05-01\">\
            <RequiredModel ModelUri=\"urn:b#x\" PublicationDate=\"2022-11-03T00:00:00Z\"/>\
            <RequiredModel ModelUri=\"urn:c\" Version=\"3\"/></Model></Models></UANodeSet>";
        let read = nodeset::read(text).unwrap();
        let knowledge = Knowledge::new().unwrap();
        let source = KnowledgeSource::new(SourceKind::NodeSet, "urn:a");
        let at = (1, SourceLifetime::No);
        knowledge.replace_with(&source, &read.triples, at).unwrap();
        let mut found = knowledge.node_set_model("urn:a");
        found.required.sort_by(|a, b| a.0.cmp(&b.0));
        assert_eq!(found, read.model);
        assert_eq!(knowledge.model_version("urn:a"), read.model.version);
        let unknown = knowledge.node_set_model("urn:b#x");
        assert_eq!((unknown.version, unknown.required), Default::default());
    }
}
