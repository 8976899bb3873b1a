//! The components in the graph, and those that were lost.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use serde::Serialize;
use skills::FoundSkill;

/// The components in the graph, and the last ones that were lost.
#[derive(Default)]
pub(super) struct PresentComponents {
    /// The components by their IRIs.
    pub(super) components: BTreeMap<String, ListedComponent>,
    lost: VecDeque<LostComponent>,
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
