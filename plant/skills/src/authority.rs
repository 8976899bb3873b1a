//! Controls which client may command a component, and that only one skill of it runs at a time.

mod lease;

use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::watch;
use tokio::time::Instant;

use self::lease::ComponentLease;
use crate::lock::lock;
use crate::refusal::SkillRefusal;

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
    lease: Arc<Mutex<ComponentLease>>,
    holder: watch::Sender<Option<SkillOwner>>,
}

impl Authority {
    /// Creates the authority of a component without a holder of the lease.
    #[must_use]
    pub fn new() -> Self {
        let (holder, _) = watch::channel(None);
        Self {
            lease: Arc::new(Mutex::new(ComponentLease::free(Instant::now()))),
            holder,
        }
    }

    /// Acquires or renews the lease.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub fn claim(&self, by: &SkillOwner) -> Result<(), SkillRefusal> {
        self.claim_at(by, Instant::now())
    }

    /// Acquires or renews the lease at this time.
    ///
    /// # Errors
    /// As [`claim`](Self::claim).
    pub(crate) fn claim_at(&self, by: &SkillOwner, now: Instant) -> Result<(), SkillRefusal> {
        self.change(|lease| lease.claim(by, now))
    }

    /// Acquires or renews the lease, and keeps it until it is released or idle for `limit`.
    /// [`expire_lock`](Self::expire_lock) ends the lock.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub fn lock_for(&self, by: &SkillOwner, limit: Duration) -> Result<(), SkillRefusal> {
        self.change(|lease| lease.lock(by, limit, Instant::now()))
    }

    /// Renews the lock of this owner: it ends after `limit` without an action of the owner.
    /// Returns false, and changes nothing, if the owner has no lock.
    pub(crate) fn renew_lock(&self, by: &SkillOwner, limit: Duration) -> bool {
        self.change(|lease| lease.renew(by, limit, Instant::now()))
    }

    /// Returns whether this owner has locked the lease.
    #[must_use]
    pub fn is_locked_by(&self, by: &SkillOwner) -> bool {
        lock(&self.lease).is_locked_by(by)
    }

    /// Returns the time of the next [`expire_lock`](Self::expire_lock); `None` without a lock.
    #[must_use]
    pub fn locked_until(&self) -> Option<Instant> {
        lock(&self.lease).locked_until()
    }

    /// Ends the lock if it is over. A run, and actions of the holder, extend it. Returns the
    /// previous holder.
    pub fn expire_lock(&self, now: Instant) -> Option<SkillOwner> {
        self.change(|lease| lease.expire(now))
    }

    /// Returns how long the component has been idle; `None` during a run.
    #[must_use]
    pub fn idle(&self, now: Instant) -> Option<Duration> {
        lock(&self.lease).idle(now)
    }

    /// Releases the lease of a session that has been idle for `idle`, unless the lease is locked.
    /// Returns the previous holder.
    pub fn release_idle(&self, idle: Duration, now: Instant) -> Option<SkillOwner> {
        self.change(|lease| lease.release_idle(idle, now))
    }

    /// Checks that the lease is free or held by this owner.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub fn allows(&self, by: &SkillOwner) -> Result<(), SkillRefusal> {
        lock(&self.lease).allows(by)
    }

    /// Releases the lease, for example when a session closes. A run in progress continues.
    pub fn release(&self, by: &SkillOwner) {
        self.change(|lease| lease.release(by));
    }

    /// Releases the lease of an owner that holds it during a run only, if no run is in progress.
    pub fn settle(&self) {
        self.change(ComponentLease::settle);
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
        lock(&self.lease).begin(skill)
    }

    /// Reserves the component for its end if no skill runs and no client holds the lease: later
    /// runs are refused. Returns whether it is reserved.
    #[must_use]
    pub fn reserve(&self) -> bool {
        lock(&self.lease).reserve()
    }

    /// Records the end of the run of the skill at this time.
    pub(crate) fn end(&self, skill: &str, now: Instant) {
        self.change(|lease| lease.end(skill, now));
    }

    /// Changes the lease, and shows its holder before the next change.
    fn change<T>(&self, change: impl FnOnce(&mut ComponentLease) -> T) -> T {
        let mut lease = lock(&self.lease);
        let result = change(&mut lease);
        self.holder.send_if_modified(|shown| {
            let holder = lease.holder();
            let differs = shown.as_ref() != holder;
            if differs {
                *shown = holder.cloned();
            }
            differs
        });
        result
    }
}

impl Default for Authority {
    fn default() -> Self {
        Self::new()
    }
}
