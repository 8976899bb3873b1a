//! The namespaces that this program may not write at the moment, or only on trial.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::loop_rule::Owned;

/// The own namespaces that another program may write too.
#[derive(Debug, Default)]
pub(super) struct Claims {
    of: BTreeMap<u16, Claim>,
    /// Random bits that differ between programs.
    random: u32,
}

#[derive(Debug, Clone, Copy)]
enum Claim {
    /// The program waits until this time for messages of another writer.
    Listening { until: Instant, probes: Probes },
    /// The program writes, and leaves the namespace if it receives another writer until this time:
    /// the probes or the responses while it listened may have been lost, and a program that started
    /// at the same moment did not respond.
    Trial { until: Instant, probes: Probes },
    /// Another program writes the namespace.
    Taken { heard: Instant, rest: Duration },
}

/// The probes for other writers of a namespace that are still to be sent.
#[derive(Debug, Clone, Copy, Default)]
struct Probes {
    /// `None` for a claim without probes.
    since: Option<Instant>,
    sent: usize,
}

/// A claim that was decided.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FreeNamespace {
    pub(super) namespace: u16,
    /// Whether another program had taken the namespace.
    pub(super) was_taken: bool,
}

impl Claims {
    /// Sets random bits that differ between programs.
    pub(super) const fn set_random(&mut self, random: u32) {
        self.random = random;
    }

    /// Claims namespaces without probes, for a program that announces them. Nothing is sent in them
    /// until other writers had time to respond.
    pub(super) fn claim(&mut self, namespaces: impl IntoIterator<Item = u16>, now: Instant) {
        self.listen(namespaces, Probes::default(), now);
    }

    /// Claims namespaces as [`claim`](Self::claim), and probes for other writers of them.
    pub(super) fn claim_by_probes(
        &mut self,
        namespaces: impl IntoIterator<Item = u16>,
        now: Instant,
    ) {
        let probes = Probes {
            since: Some(now),
            sent: 0,
        };
        self.listen(namespaces, probes, now);
    }

    fn listen(&mut self, namespaces: impl IntoIterator<Item = u16>, probes: Probes, now: Instant) {
        let until = now + LISTEN;
        for namespace in namespaces {
            let claim = Claim::Listening { until, probes };
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
        let claim = self.of.get(&namespace);
        claim.is_some_and(|claim| !matches!(claim, Claim::Trial { .. }))
    }

    /// Returns whether another program has used the namespace before this program.
    pub(super) fn is_taken(&self, namespace: u16) -> bool {
        matches!(self.of.get(&namespace), Some(Claim::Taken { .. }))
    }

    /// Leaves a namespace to another program that started first. Returns whether that is new.
    pub(super) fn take(&mut self, namespace: u16, heard: Instant) -> bool {
        let rest = Duration::ZERO;
        let claim = Claim::Taken { heard, rest };
        let before = self.of.insert(namespace, claim);
        !matches!(before, Some(Claim::Taken { .. }))
    }

    /// Records a message of another program. Returns whether the claimed namespace was found to be
    /// taken. A namespace that this program used before the other program stays its own.
    pub(super) fn contend(&mut self, namespace: u16, now: Instant) -> bool {
        let random = self.random;
        let Some(claim) = self.of.get_mut(&namespace) else {
            return false;
        };
        let (rest, is_new) = match *claim {
            Claim::Taken { rest, .. } => (rest, false),
            Claim::Listening { .. } => (Duration::ZERO, true),
            // The other program may be on trial too, and leave: each returns at another time.
            Claim::Trial { .. } => (rest_of(random), true),
        };
        if is_new {
            self.random = random.rotate_left(11).wrapping_add(1);
        }
        *claim = Claim::Taken { heard: now, rest };
        is_new
    }

    /// Returns the earliest time at which a namespace may be free, or a probe is due.
    pub(super) fn due(&self, silence: Duration) -> Option<Instant> {
        let due = self.of.values();
        due.map(|claim| claim.due(silence)).min()
    }

    /// Returns the namespaces with a probe that is due.
    pub(super) fn take_probes(&mut self, now: Instant) -> Vec<u16> {
        let due = self.of.iter_mut().filter_map(|(namespace, claim)| {
            let probes = claim.probes()?;
            probes.take(now).then_some(*namespace)
        });
        due.collect()
    }

    /// Returns the namespaces that became free.
    pub(super) fn poll(&mut self, silence: Duration, now: Instant) -> Vec<FreeNamespace> {
        let mut free = Vec::new();
        self.of.retain(|namespace, claim| {
            if claim.ends(silence) > now {
                return true;
            }
            let probes = match *claim {
                Claim::Trial { .. } => return false,
                Claim::Listening { probes, .. } => probes,
                Claim::Taken { .. } => Probes::default(),
            };
            free.push(FreeNamespace {
                namespace: *namespace,
                was_taken: matches!(claim, Claim::Taken { .. }),
            });
            let until = now + TRIAL;
            *claim = Claim::Trial { until, probes };
            // A claim without probes is decided by announcements.
            probes.since.is_some() || free.last().is_some_and(|last| last.was_taken)
        });
        free
    }
}

impl Claim {
    fn ends(self, silence: Duration) -> Instant {
        match self {
            Self::Listening { until, .. } | Self::Trial { until, .. } => until,
            Self::Taken { heard, rest } => heard + silence + rest,
        }
    }

    const fn probes(&mut self) -> Option<&mut Probes> {
        match self {
            Self::Listening { probes, .. } | Self::Trial { probes, .. } => Some(probes),
            Self::Taken { .. } => None,
        }
    }

    fn due(mut self, silence: Duration) -> Instant {
        let ends = self.ends(silence);
        let next = self.probes().and_then(|probes| probes.next());
        next.map_or(ends, |next| next.min(ends))
    }
}

impl Probes {
    /// Returns the time of the next probe.
    fn next(&self) -> Option<Instant> {
        Some(self.since? + *PROBES.get(self.sent)?)
    }

    /// Returns whether a probe is due, and counts it as sent.
    fn take(&mut self, now: Instant) -> bool {
        let is_due = self.next().is_some_and(|next| next <= now);
        self.sent += usize::from(is_due);
        is_due
    }
}

/// Returns the time in addition to the silence before a program returns to a namespace.
fn rest_of(random: u32) -> Duration {
    Duration::from_millis(u64::from(random % MOST_REST))
}

/// The time to wait for other writers of a namespace, which respond within 100 ms.
const LISTEN: Duration = Duration::from_millis(300);
/// The time on trial: other writers repeat their values each second.
const TRIAL: Duration = Duration::from_secs(3);
/// The times of the probes since the claim. A writer responds again after 500 ms at the earliest
/// ([`AnnounceLimits`](uadp::discovery::AnnounceLimits)), so the last probes follow in the trial.
const PROBES: [Duration; 5] = [
    Duration::ZERO,
    Duration::from_millis(100),
    Duration::from_millis(200),
    Duration::from_millis(800),
    Duration::from_millis(1_500),
];
/// Upper bound of the rest, ms.
const MOST_REST: u32 = 1_000;
