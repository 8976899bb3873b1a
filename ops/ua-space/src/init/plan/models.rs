//! Plans the values of SysML models.

use std::collections::HashMap;

use mappings::{ExpandedNodeIdText, Identifier, NamespaceText, NodeIdText};

use super::{BoundTopic, Planner, ProposedVariable};
use crate::init::nodes::FreeIndexes;
use crate::init::topics::ValueForm;
use crate::survey::model::{ModelTopic, ModelValue, NodeModel};

impl Planner<'_> {
    /// Adds the values of the models that are not in the mapping.
    pub(super) fn models(&mut self, models: &[NodeModel], uri: &str) {
        let mut all = Vec::new();
        for model in models {
            for (space, domain) in &model.spaces {
                let is_planned = self.plan.spaces.iter().any(|(other, _)| other == space);
                if self.known.mapping.space(*space).is_none() && !is_planned {
                    self.plan.spaces.push((*space, *domain));
                }
            }
            let nodes = self.model_nodes(model);
            // Numbers that the models give are not assigned to other values.
            for node in nodes.values() {
                if let Some(number) = node.writer_id() {
                    self.known.use_number(node.namespace, number.get());
                }
            }
            let values = model.values.iter();
            all.extend(values.map(|value| {
                let node = value.node.as_ref();
                (value, node.and_then(|node| nodes.get(node)).cloned())
            }));
        }
        self.plan.spaces.sort_by_key(|(space, _)| *space);
        all.sort_by(|(one, _), (other, _)| one.within.cmp(&other.within));
        for (value, node) in all {
            self.model_value(value, node, uri);
        }
    }

    /// Returns the nodes of the model in the namespaces of the mapping.
    fn model_nodes(&mut self, model: &NodeModel) -> HashMap<ExpandedNodeIdText, NodeIdText> {
        let mut indexes = self.indexes();
        let mut free = FreeIndexes::default();
        let mut nodes = HashMap::new();
        for node in model.values.iter().filter_map(|value| value.node.as_ref()) {
            let (uri, wanted) = match &node.namespace {
                NamespaceText::Index(0) => (None, 0),
                NamespaceText::Index(index) => (model.namespaces.get(index), *index),
                NamespaceText::Uri(uri) => {
                    let mut all = model.namespaces.iter();
                    let same = all.find(|(_, other)| *other == uri);
                    (Some(uri), same.map_or(2, |(index, _)| *index))
                }
            };
            let namespace = match uri {
                Some(uri) => indexes.index_of(uri, wanted, &mut free),
                None if wanted == 0 => Some(0),
                None => None,
            };
            if let Some(namespace) = namespace {
                let identifier = node.identifier.clone();
                let id = NodeIdText {
                    namespace,
                    identifier,
                };
                nodes.insert(node.clone(), id);
            }
        }
        self.plan.namespaces.append(&mut indexes.given);
        nodes
    }

    fn model_value(&mut self, value: &ModelValue, node: Option<NodeIdText>, uri: &str) {
        let topics = value.topics.iter();
        let topics = topics.filter(|one| !self.known.mentions(&one.topic));
        let (bound, new): (Vec<&ModelTopic>, Vec<&ModelTopic>) =
            topics.partition(|one| self.known.bound(one.space, &one.topic, Some(&one.kind)));
        let is_known = match &node {
            Some(node) => self.known.has_node(node),
            None => value.topics.is_empty() && self.known.has_name(&value.name),
        };
        let (is_partly_bound, is_left_out) = (
            !bound.is_empty(),
            new.is_empty() && !value.topics.is_empty(),
        );
        for one in value.topics.iter().filter(|_| is_known || is_partly_bound) {
            if new.contains(&one) {
                self.plan.proposals.push(format!(
                    "{} is a topic of {} in the model, as {} in space {}",
                    one.topic, value.name, one.kind, one.space
                ));
            }
        }
        for one in &value.topics {
            self.modelled.insert((one.space, one.topic.clone()));
        }
        if is_known || is_partly_bound || is_left_out {
            return;
        }
        let bindings: Vec<BoundTopic> = new
            .into_iter()
            .map(|one| self.bound_of(one, value))
            .collect();
        let is_set_aside = bindings
            .iter()
            .any(|one| self.known.is_set_aside(&one.topic));
        let is_of_model = node.is_some();
        let Some(node) = node.or_else(|| {
            let namespace = self.namespace(uri)?;
            let number = self.known.next_number(namespace)?;
            let identifier = Identifier::Numeric(number.into());
            Some(NodeIdText {
                namespace,
                identifier,
            })
        }) else {
            return;
        };
        if is_of_model {
            let at = self.plan.entries.len();
            self.of_models.insert(node.clone(), at);
        }
        self.push(ProposedVariable {
            group: value.within.clone(),
            node,
            alias: None,
            name: value.name.clone(),
            value: value.value,
            origin: value.origin,
            bindings,
            source: None,
            notes: Vec::new(),
            guessed: false,
            faulty: None,
            is_set_aside,
        });
    }

    fn bound_of(&self, topic: &ModelTopic, value: &ModelValue) -> BoundTopic {
        let [ros1, ros2] = &self.registries;
        let registry = if topic.space.is_ros2() { ros2 } else { ros1 };
        let form = match &topic.field {
            Some(path) => ValueForm::Field(path.clone(), value.value),
            None => ValueForm::of(&topic.kind, registry),
        };
        BoundTopic {
            space: topic.space,
            topic: topic.topic.clone(),
            kind: topic.kind.clone(),
            form,
        }
    }
}
