//! The components that runs use.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The runs that use components, by the IRIs of the components. A component has one run at a time.
#[derive(Debug, Default)]
pub(super) struct ComponentLeases(Mutex<BTreeMap<String, String>>);

/// The effect of a lease.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LeaseChange {
    /// Another run uses one of the components; nothing was changed.
    Refused,
    /// The run has the components, and has given back none.
    Taken,
    /// The run has the components, and has given back others.
    GaveBack,
}

impl ComponentLeases {
    /// Returns the components that a run uses.
    pub(super) fn used_by(&self, run: &str) -> Vec<String> {
        let leases = self.all();
        let own = leases.iter().filter(|(_, holder)| *holder == run);
        own.map(|(component, _)| component.clone()).collect()
    }

    /// Returns the components that other runs use, with these runs.
    pub(super) fn used_by_others(&self, run: &str) -> BTreeMap<String, String> {
        let leases = self.all();
        let others = leases.iter().filter(|(_, holder)| *holder != run);
        others
            .map(|(component, holder)| (component.clone(), holder.clone()))
            .collect()
    }

    /// Returns the run with a number, if it uses a component.
    pub(super) fn run(&self, number: u64) -> Option<String> {
        let end = format!("-{number}");
        let leases = self.all();
        let mut runs = leases.values();
        runs.find(|run| run.ends_with(&end)).cloned()
    }

    /// Leases components to a run, and ends its leases of all other components.
    pub(super) fn lease(&self, run: &str, components: &BTreeSet<String>) -> LeaseChange {
        let mut leases = self.all();
        let is_free = |component: &String| leases.get(component).is_none_or(|holder| holder == run);
        if !components.iter().all(is_free) {
            return LeaseChange::Refused;
        }
        let before = leases.len();
        leases.retain(|component, holder| holder != run || components.contains(component));
        let is_given_back = leases.len() < before;
        let taken = components.iter().map(|one| (one.clone(), run.to_owned()));
        leases.extend(taken);
        if is_given_back {
            LeaseChange::GaveBack
        } else {
            LeaseChange::Taken
        }
    }

    fn all(&self) -> MutexGuard<'_, BTreeMap<String, String>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_component_has_one_run_until_it_is_given_back() {
        let leases = ComponentLeases::default();
        let of = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        assert_eq!(
            leases.lease("run-1", &of(&["arm", "cup"])),
            LeaseChange::Taken
        );
        assert_eq!(
            leases.lease("run-12", &of(&["cup", "bin"])),
            LeaseChange::Refused
        );
        assert_eq!(leases.used_by("run-12"), Vec::<String>::new());
        assert_eq!(leases.lease("run-1", &of(&["arm"])), LeaseChange::GaveBack);
        assert_eq!(leases.lease("run-12", &of(&["cup"])), LeaseChange::Taken);
        let others = BTreeMap::from([("cup".to_owned(), "run-12".to_owned())]);
        assert_eq!(leases.used_by_others("run-1"), others);
        assert_eq!(leases.run(1).as_deref(), Some("run-1"));
        assert_eq!(leases.run(2), None, "12 is another number");
    }
}
