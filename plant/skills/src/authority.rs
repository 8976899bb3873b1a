//! Who may have a component do something, and that it does one thing at a time.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use program::Lease;
use tokio::sync::watch;
use tokio::time::Instant;

use crate::refusal::{Code, Refusal};

/// Who writes parameters and calls methods.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Owner {
    /// A session of the OPC UA server, by the server's number for it. Holds the lease until it closes, or has had nothing done
    /// for a while.
    Session(u32),
    /// A space that asked for a call. Holds the lease while a run that it began goes on.
    Space(u16),
    /// Something in this program, likewise.
    Local(&'static str),
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Session(number) => write!(f, "session {number}"),
            Self::Space(space) => write!(f, "space {space}"),
            Self::Local(name) => f.write_str(name),
        }
    }
}

/// Shared by the skills of one component.
#[derive(Debug, Clone)]
pub struct Authority {
    inner: Arc<Mutex<Inner>>,
    holder: watch::Sender<Option<Owner>>,
}

#[derive(Debug)]
struct Inner {
    lease: Lease<Owner>,
    /// The skill whose run goes on.
    running: Option<String>,
    /// When its holder last had something done, or the last run ended.
    used: Instant,
    /// Whether the holder keeps it without having anything done: it is locked.
    locked: bool,
}

impl Authority {
    /// Of a component that nobody has used.
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

    /// Takes the lease, or keeps it.
    ///
    /// # Errors
    /// BadLocked when it is somebody else's.
    pub fn claim(&self, by: &Owner) -> Result<(), Refusal> {
        let mut inner = self.lock();
        inner
            .lease
            .claim(by.clone())
            .map_err(|held| locked(&held.by))?;
        inner.used = Instant::now();
        self.show(&inner);
        Ok(())
    }

    /// Takes the lease, or keeps it, and for as long as it is not given back even where nothing is done.
    ///
    /// # Errors
    /// BadLocked when it is somebody else's.
    pub fn lock_for(&self, by: &Owner) -> Result<(), Refusal> {
        self.claim(by)?;
        self.lock().locked = true;
        Ok(())
    }

    /// For how long its holder has had nothing done by now; `None` while a run goes on.
    #[must_use]
    pub fn idle(&self, now: Instant) -> Option<Duration> {
        let inner = self.lock();
        let idle = now.saturating_duration_since(inner.used);
        inner.running.is_none().then_some(idle)
    }

    /// Gives back the lease of a session that by now had nothing done for so long, unless it is locked. Says whose that was.
    pub fn release_idle(&self, idle: Duration, now: Instant) -> Option<Owner> {
        let mut inner = self.lock();
        let since = now.saturating_duration_since(inner.used);
        let is_idle = inner.running.is_none() && !inner.locked && since >= idle;
        let holder = inner.lease.holder().filter(|holder| {
            // Others give it back with the end of their run.
            is_idle && matches!(holder, Owner::Session(_))
        });
        let holder = holder.cloned()?;
        inner.lease.release(&holder);
        self.show(&inner);
        Some(holder)
    }

    /// Whether the lease is theirs, or nobody's.
    ///
    /// # Errors
    /// BadLocked when it is somebody else's.
    pub fn allows(&self, by: &Owner) -> Result<(), Refusal> {
        match self.lock().lease.holder() {
            Some(holder) if holder != by => Err(locked(holder)),
            Some(_) | None => Ok(()),
        }
    }

    /// Gives the lease back, as when a session closes. A run that goes on does so.
    pub fn release(&self, by: &Owner) {
        let mut inner = self.lock();
        if inner.lease.release(by) {
            inner.locked = false;
        }
        self.show(&inner);
    }

    /// Gives back the lease of who holds it for a run only, where none goes on.
    pub fn settle(&self) {
        let mut inner = self.lock();
        if inner.running.is_some() {
            return;
        }
        let passing = inner
            .lease
            .holder()
            .filter(|holder| !matches!(holder, Owner::Session(_)))
            .cloned();
        if let Some(holder) = passing {
            inner.lease.release(&holder);
        }
        self.show(&inner);
    }

    /// Who holds the lease, and each change of it.
    #[must_use]
    pub fn holder(&self) -> watch::Receiver<Option<Owner>> {
        self.holder.subscribe()
    }

    /// A run of the skill begins.
    ///
    /// # Errors
    /// BadInvalidState while one of another skill goes on: a component does one thing at a time.
    pub(crate) fn begin(&self, skill: &str) -> Result<(), Refusal> {
        let mut inner = self.lock();
        if let Some(running) = &inner.running {
            let text = format!("{running} of this component runs, and it does one thing at a time");
            return Err(Refusal::new(Code::InvalidState, text));
        }
        inner.running = Some(skill.to_owned());
        Ok(())
    }

    /// The run of the skill has ended.
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
        // Each change is whole before the lock is given back.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn locked(holder: &Owner) -> Refusal {
    let text = format!("{holder} has the lease of this component");
    Refusal::new(Code::Locked, text)
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
    const ME: Owner = Owner::Session(1);
    const OTHER: Owner = Owner::Session(2);

    #[test]
    fn a_lease_that_is_not_used_is_free_after_a_while_and_not_before() {
        let authority = Authority::new();
        let after = |seconds| {
            let now = Instant::now() + Duration::from_secs(seconds);
            authority.release_idle(IDLE, now)
        };
        authority.claim(&ME).unwrap();
        assert_eq!(after(59), None);
        assert_eq!(authority.claim(&OTHER).unwrap_err().code, Code::Locked);
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
        authority.claim(&Owner::Local("mes")).unwrap();
        assert_eq!(after(600), None, "not a session's");
    }
}
