//! Controls which client may command a component, and that only one skill of it runs at a time.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use program::Lease;
use tokio::sync::watch;
use tokio::time::Instant;

use crate::refusal::{RefusalCode, SkillRefusal};

/// A client that writes parameters and calls methods.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum SkillOwner {
    /// A session of the OPC UA server, by the server's number of the session. It holds the lease
    /// until it closes or is idle for the lease time.
    Session(u32),
    /// A space that sent a call. It holds the lease during the run that it started.
    Space(u16),
    /// A caller within this program. It holds the lease during the run that it started.
    Local(&'static str),
}

impl fmt::Display for SkillOwner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Session(number) => write!(f, "session {number}"),
            Self::Space(space) => write!(f, "space {space}"),
            Self::Local(name) => f.write_str(name),
        }
    }
}

/// The lease of a component, shared by its skills.
#[derive(Debug, Clone)]
pub struct Authority {
    inner: Arc<Mutex<Inner>>,
    holder: watch::Sender<Option<SkillOwner>>,
}

#[derive(Debug)]
struct Inner {
    lease: Lease<SkillOwner>,
    /// The name of the running skill.
    running: Option<String>,
    /// Time of the holder's last action or of the end of the last run.
    used: Instant,
    /// Whether the lease is locked: the holder keeps it while idle.
    locked: bool,
}

impl Authority {
    /// Creates the authority of a component without a holder of the lease.
    #[must_use]
    pub fn new() -> Self {
        let inner = Inner {
            lease: Lease::free(),
            running: None,
            used: Instant::now(),
            locked: false,
        };
        let (holder, _) = watch::channel(None);
        Self {
            inner: Arc::new(Mutex::new(inner)),
            holder,
        }
    }

    /// Acquires or renews the lease.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub fn claim(&self, by: &SkillOwner) -> Result<(), SkillRefusal> {
        let mut inner = self.lock();
        inner
            .lease
            .claim(by.clone())
            .map_err(|held| locked(&held.by))?;
        inner.used = Instant::now();
        self.show(&inner);
        Ok(())
    }

    /// Acquires or renews the lease, and keeps it while idle until it is released.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub fn lock_for(&self, by: &SkillOwner) -> Result<(), SkillRefusal> {
        self.claim(by)?;
        self.lock().locked = true;
        Ok(())
    }

    /// Returns how long the component has been idle; `None` during a run.
    #[must_use]
    pub fn idle(&self, now: Instant) -> Option<Duration> {
        let inner = self.lock();
        let idle = now.saturating_duration_since(inner.used);
        inner.running.is_none().then_some(idle)
    }

    /// Releases the lease of a session that has been idle for `idle`, unless the lease is locked.
    /// Returns the previous holder.
    pub fn release_idle(&self, idle: Duration, now: Instant) -> Option<SkillOwner> {
        let mut inner = self.lock();
        let since = now.saturating_duration_since(inner.used);
        let is_idle = inner.running.is_none() && !inner.locked && since >= idle;
        let holder = inner.lease.holder().filter(|holder| {
            // Other owners release the lease at the end of their run.
            is_idle && matches!(holder, SkillOwner::Session(_))
        });
        let holder = holder.cloned()?;
        inner.lease.release(&holder);
        self.show(&inner);
        Some(holder)
    }

    /// Checks that the lease is free or held by this owner.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub fn allows(&self, by: &SkillOwner) -> Result<(), SkillRefusal> {
        match self.lock().lease.holder() {
            Some(holder) if holder != by => Err(locked(holder)),
            Some(_) | None => Ok(()),
        }
    }

    /// Releases the lease, for example when a session closes. A run in progress continues.
    pub fn release(&self, by: &SkillOwner) {
        let mut inner = self.lock();
        if inner.lease.release(by) {
            inner.locked = false;
        }
        self.show(&inner);
    }

    /// Releases the lease of an owner that holds it during a run only, if no run is in progress.
    pub fn settle(&self) {
        let mut inner = self.lock();
        if inner.running.is_some() {
            return;
        }
        let passing = inner
            .lease
            .holder()
            .filter(|holder| !matches!(holder, SkillOwner::Session(_)))
            .cloned();
        if let Some(holder) = passing {
            inner.lease.release(&holder);
        }
        self.show(&inner);
    }

    /// Returns the holder of the lease and its changes.
    #[must_use]
    pub fn holder(&self) -> watch::Receiver<Option<SkillOwner>> {
        self.holder.subscribe()
    }

    /// Records the start of a run of the skill.
    ///
    /// # Errors
    /// BadInvalidState while another skill of the component runs.
    pub(crate) fn begin(&self, skill: &str) -> Result<(), SkillRefusal> {
        let mut inner = self.lock();
        if let Some(running) = &inner.running {
            let text = format!("{running} of this component runs, and it does one thing at a time");
            return Err(SkillRefusal::new(RefusalCode::InvalidState, text));
        }
        inner.running = Some(skill.to_owned());
        Ok(())
    }

    /// Reserves the component for its end if no skill runs and no client holds the lease: later
    /// runs are refused. Returns whether it is reserved.
    #[must_use]
    pub fn reserve(&self) -> bool {
        let mut inner = self.lock();
        let is_free = inner.running.is_none() && inner.lease.holder().is_none();
        if is_free {
            inner.running = Some("the restart".to_owned());
        }
        is_free
    }

    /// Records the end of the run of the skill.
    pub(crate) fn end(&self, skill: &str) {
        let mut inner = self.lock();
        if inner.running.as_deref() == Some(skill) {
            inner.running = None;
            inner.used = Instant::now();
        }
        drop(inner);
        self.settle();
    }

    fn show(&self, inner: &Inner) {
        self.holder.send_if_modified(|shown| {
            let holder = inner.lease.holder();
            let differs = shown.as_ref() != holder;
            if differs {
                *shown = holder.cloned();
            }
            differs
        });
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // Each change is complete before the mutex is released, so a poisoned mutex is usable.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn locked(holder: &SkillOwner) -> SkillRefusal {
    let text = format!("{holder} has the lease of this component");
    SkillRefusal::new(RefusalCode::Locked, text)
}

impl Default for Authority {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const IDLE: Duration = Duration::from_secs(60);
    const ME: SkillOwner = SkillOwner::Session(1);
    const OTHER: SkillOwner = SkillOwner::Session(2);

    #[test]
    fn a_lease_that_is_not_used_is_free_after_a_while_and_not_before() {
        let authority = Authority::new();
        let after = |seconds| {
            let now = Instant::now() + Duration::from_secs(seconds);
            authority.release_idle(IDLE, now)
        };
        authority.claim(&ME).unwrap();
        assert_eq!(after(59), None);
        assert_eq!(
            authority.claim(&OTHER).unwrap_err().code,
            RefusalCode::Locked
        );
        authority.begin("Grasp").unwrap();
        assert_eq!(after(600), None, "a run goes on");
        authority.end("Grasp");
        assert_eq!(after(59), None, "it has only now ended");
        assert_eq!(after(61), Some(ME));
        assert_eq!(*authority.holder().borrow(), None);
        authority.lock_for(&OTHER).unwrap();
        assert_eq!(after(600), None, "it is locked");
        authority.release(&OTHER);
        authority.claim(&OTHER).unwrap();
        assert_eq!(after(61), Some(OTHER), "the lock has ended");
        authority.claim(&SkillOwner::Local("mes")).unwrap();
        assert_eq!(after(600), None, "not a session's");
    }
    #[test]
    fn a_component_is_reserved_only_while_nobody_uses_it_and_then_starts_nothing() {
        let authority = Authority::new();
        authority.claim(&ME).unwrap();
        assert!(!authority.reserve(), "a client has the lease");
        authority.begin("Grasp").unwrap();
        authority.release(&ME);
        assert!(!authority.reserve(), "a run goes on");
        authority.end("Grasp");
        assert!(authority.reserve());
        let refused = authority.begin("Grasp").unwrap_err();
        assert_eq!(refused.code, RefusalCode::InvalidState, "{refused}");
    }
}
