//! The components in the graph, and those that were lost.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use knowledge::ComponentFacts;
use serde::Serialize;
use skills::{FoundConfiguration, FoundSkill};

use super::facts::skill_facts;

/// The components in the graph, and the last ones that were lost.
#[derive(Default)]
pub(super) struct PresentComponents {
    /// The components by their IRIs.
    pub(super) components: BTreeMap<String, ListedComponent>,
    lost: VecDeque<LostComponent>,
}

/// The answer of a component to the query of its skills.
#[derive(Debug, Clone, Default)]
pub(crate) struct QueriedComponent {
    pub(crate) skills: Vec<FoundSkill>,
    /// Its fields that can be set. A component without skills has them.
    pub(crate) configuration: Option<FoundConfiguration>,
}

impl QueriedComponent {
    /// Returns the components by their ApplicationUris: the server itself, and the components
    /// behind a station.
    pub(crate) fn all(
        server: &str,
        (skills, configurations): (Vec<FoundSkill>, Vec<FoundConfiguration>),
    ) -> BTreeMap<String, Self> {
        let uri = |behind: &Option<String>| behind.as_deref().unwrap_or(server).to_owned();
        let mut components: BTreeMap<String, Self> = BTreeMap::new();
        for skill in skills {
            let of = components.entry(uri(&skill.behind)).or_default();
            of.skills.push(skill);
        }
        for found in configurations {
            let of = components.entry(uri(&found.behind)).or_default();
            of.configuration.get_or_insert(found);
        }
        components
    }

    /// Returns the name of the component and its number in the space.
    fn identity(&self) -> Option<(&str, Option<u16>)> {
        let of_skill = self.skills.first();
        let of_skill = of_skill.map(|skill| (skill.component.as_str(), skill.namespace));
        let of_fields = self.configuration.as_ref();
        of_skill.or_else(|| of_fields.map(|fields| (fields.component.as_str(), fields.namespace)))
    }

    /// Returns the endpoint of the component at a server.
    pub(crate) fn endpoint(&self, server: &str) -> String {
        let of_skill = self.skills.first().map(|skill| skill.endpoint(server));
        let of_fields = self.configuration.as_ref();
        of_skill
            .or_else(|| of_fields.map(|fields| fields.endpoint(server)))
            .unwrap_or_else(|| server.to_owned())
    }

    /// Returns the facts about the component for the graph; `None` without skills and fields.
    pub(super) fn facts(&self, application_uri: &str, endpoint: &str) -> Option<ComponentFacts> {
        let (name, namespace) = self.identity()?;
        Some(ComponentFacts {
            application_uri: application_uri.to_owned(),
            name: name.to_owned(),
            endpoint: endpoint.to_owned(),
            namespace,
            skills: self.skills.iter().filter_map(skill_facts).collect(),
        })
    }
}

/// A component in the graph.
#[derive(Debug, Clone, Serialize)]
pub(super) struct ListedComponent {
    pub(super) application_uri: String,
    pub(super) name: String,
    pub(super) endpoint: String,
    pub(super) namespace: Option<u16>,
    /// Times of the discovery, of the query of its skills, and of its entry into the graph; ms
    /// since 1970.
    pub(super) seen_ms: u64,
    pub(super) listed_ms: u64,
    pub(super) since_ms: u64,
    pub(super) skills: Vec<String>,
    /// The name of the server in discovery.
    #[serde(skip)]
    pub(super) discovered: String,
    /// The skills by their IRIs.
    #[serde(skip)]
    pub(super) found: BTreeMap<String, FoundSkill>,
    /// Its fields that can be set.
    #[serde(skip)]
    pub(super) configuration: Option<FoundConfiguration>,
    /// The ApplicationUris of the tools that its tool changers have shown.
    #[serde(skip)]
    pub(super) tools: BTreeSet<String>,
}

/// A component that was lost.
#[derive(Debug, Clone, Serialize)]
pub(super) struct LostComponent {
    pub(super) application_uri: String,
    pub(super) name: String,
    pub(super) at_ms: u64,
    pub(super) why: String,
}

impl PresentComponents {
    /// Adds a component, or replaces its description. The known tools remain.
    pub(super) fn put(&mut self, iri: &str, mut component: ListedComponent) {
        if let Some(before) = self.components.remove(iri) {
            component.tools = before.tools;
        }
        component.keep_tools();
        self.components.insert(iri.to_owned(), component);
    }

    /// Removes and returns the components for which `which` is true.
    pub(super) fn remove(
        &mut self,
        which: impl Fn(&ListedComponent) -> bool,
    ) -> Vec<ListedComponent> {
        let found = self.components.iter();
        let found = found.filter(|(_, component)| which(component));
        let iris: Vec<String> = found.map(|(iri, _)| iri.clone()).collect();
        iris.iter()
            .filter_map(|iri| self.components.remove(iri))
            .collect()
    }

    /// Notes a lost component. The oldest of many is forgotten.
    pub(super) fn lose(&mut self, lost: LostComponent) {
        self.lost.push_back(lost);
        if self.lost.len() > MOST_LOST {
            self.lost.pop_front();
        }
    }

    pub(super) fn lost(&self) -> &VecDeque<LostComponent> {
        &self.lost
    }
}

const MOST_LOST: usize = 100;
