//! The namespaces that this program may not write at the moment.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::loop_rule::Owned;

/// The own namespaces in which nothing is sent at the moment.
#[derive(Debug, Default)]
pub(super) struct Claims {
    of: BTreeMap<u16, Claim>,
}

#[derive(Debug, Clone, Copy)]
enum Claim {
    /// The program waits until this time for messages of another writer.
    Listening { until: Instant },
    /// Another program writes the namespace.
    Taken { heard: Instant },
}

impl Claims {
    /// Claims namespaces. Nothing is sent in them until other writers had time to respond.
    pub(super) fn claim(&mut self, namespaces: impl IntoIterator<Item = u16>, now: Instant) {
        let until = now + LISTEN;
        for namespace in namespaces {
            let claim = Claim::Listening { until };
            self.of.entry(namespace).or_insert(claim);
        }
    }

    /// Removes the claims of namespaces that are not owned any more.
    pub(super) fn retain(&mut self, owned: &Owned) {
        self.of.retain(|namespace, _| owned.has(*namespace));
    }

    pub(super) fn is_empty(&self) -> bool {
        self.of.is_empty()
    }

    /// Returns whether nothing may be sent in the namespace.
    pub(super) fn withholds(&self, namespace: u16) -> bool {
        self.of.contains_key(&namespace)
    }

    /// Returns whether another program has used the namespace before this program.
    pub(super) fn is_taken(&self, namespace: u16) -> bool {
        matches!(self.of.get(&namespace), Some(Claim::Taken { .. }))
    }

    /// Leaves a namespace to another program that started first. Returns whether that is new.
    pub(super) fn take(&mut self, namespace: u16, heard: Instant) -> bool {
        let claim = Claim::Taken { heard };
        let before = self.of.insert(namespace, claim);
        !matches!(before, Some(Claim::Taken { .. }))
    }

    /// Records a message of another program. Returns whether the claimed namespace was found to be
    /// taken. A namespace that this program used before the other program stays its own.
    pub(super) fn contend(&mut self, namespace: u16, now: Instant) -> bool {
        let Some(claim) = self.of.get_mut(&namespace) else {
            return false;
        };
        let before = std::mem::replace(claim, Claim::Taken { heard: now });
        matches!(before, Claim::Listening { .. })
    }

    /// Returns the earliest time at which a namespace may be free.
    pub(super) fn due(&self, silence: Duration) -> Option<Instant> {
        let due = self.of.values().map(|claim| claim.ends(silence));
        due.min()
    }

    /// Removes the free namespaces, and returns each with whether another program had taken it.
    pub(super) fn poll(&mut self, silence: Duration, now: Instant) -> Vec<(u16, bool)> {
        let is_free = |claim: &Claim| claim.ends(silence) <= now;
        let free = self.of.iter().filter(|(_, claim)| is_free(claim));
        let free = free.map(|(of, claim)| (*of, matches!(claim, Claim::Taken { .. })));
        let free: Vec<(u16, bool)> = free.collect();
        self.of.retain(|_, claim| !is_free(claim));
        free
    }
}

impl Claim {
    fn ends(self, silence: Duration) -> Instant {
        match self {
            Self::Listening { until } => until,
            Self::Taken { heard } => heard + silence,
        }
    }
}

/// The time to wait for other writers of a namespace, which respond within 100 ms.
const LISTEN: Duration = Duration::from_millis(300);
