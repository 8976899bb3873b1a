//! The lease of a component and its only run, with the time as a parameter.

use std::time::Duration;

use program::Lease;
use tokio::time::Instant;

use super::SkillOwner;
use crate::refusal::{RefusalCode, SkillRefusal};

/// The lease of a component, its lock, and the skill that runs.
#[derive(Debug)]
pub(super) struct ComponentLease {
    lease: Lease<SkillOwner>,
    /// The name of the running skill.
    running: Option<String>,
    /// Time of the holder's last action or of the end of the last run.
    used: Instant,
    /// The lock of the holder.
    lock: Option<LeaseLock>,
}

/// A lock: the holder keeps the lease while idle, up to a time limit.
#[derive(Debug, Clone, Copy)]
struct LeaseLock {
    /// Idle time after which the lock ends.
    limit: Duration,
    until: Instant,
}

impl ComponentLease {
    /// Creates a lease without a holder.
    pub(super) fn free(now: Instant) -> Self {
        Self {
            lease: Lease::free(),
            running: None,
            used: now,
            lock: None,
        }
    }

    pub(super) fn holder(&self) -> Option<&SkillOwner> {
        self.lease.holder()
    }

    /// Acquires or renews the lease.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub(super) fn claim(&mut self, by: &SkillOwner, now: Instant) -> Result<(), SkillRefusal> {
        let claimed = self.lease.claim(by.clone());
        claimed.map_err(|held| locked(&held.by))?;
        self.used = now;
        Ok(())
    }

    /// Acquires or renews the lease, and keeps it until it is released or idle for `limit`.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub(super) fn lock(
        &mut self,
        by: &SkillOwner,
        limit: Duration,
        now: Instant,
    ) -> Result<(), SkillRefusal> {
        self.claim(by, now)?;
        let until = now + limit;
        self.lock = Some(LeaseLock { limit, until });
        Ok(())
    }

    /// Renews the lock of this owner. Returns false, and changes nothing, without such a lock.
    pub(super) fn renew(&mut self, by: &SkillOwner, limit: Duration, now: Instant) -> bool {
        self.is_locked_by(by) && self.lock(by, limit, now).is_ok()
    }

    /// Returns whether this owner holds the lock.
    pub(super) fn is_locked_by(&self, by: &SkillOwner) -> bool {
        self.lock.is_some() && self.lease.holder() == Some(by)
    }

    /// Returns the time of the next [`expire`](Self::expire); `None` without a lock.
    pub(super) fn locked_until(&self) -> Option<Instant> {
        Some(self.lock?.until)
    }

    /// Ends the lock if it is over. A run, and actions of the holder, extend it. Returns the
    /// previous holder.
    pub(super) fn expire(&mut self, now: Instant) -> Option<SkillOwner> {
        let lock = self.lock.filter(|lock| lock.until <= now)?;
        let idle = self.idle(now).unwrap_or_default();
        let left = lock.limit.saturating_sub(idle);
        if left.is_zero() {
            let holder = self.lease.holder().cloned()?;
            self.release(&holder);
            return Some(holder);
        }
        let until = now + left;
        self.lock = Some(LeaseLock { until, ..lock });
        None
    }

    /// Returns how long the component has been idle; `None` during a run.
    pub(super) fn idle(&self, now: Instant) -> Option<Duration> {
        let idle = now.saturating_duration_since(self.used);
        self.running.is_none().then_some(idle)
    }

    /// Releases the lease of a session that has been idle for `idle`, unless the lease is locked.
    /// Returns the previous holder.
    pub(super) fn release_idle(&mut self, idle: Duration, now: Instant) -> Option<SkillOwner> {
        let is_idle = self.lock.is_none() && self.idle(now).is_some_and(|since| since >= idle);
        let holder = self.lease.holder().filter(|holder| {
            // Other owners release the lease at the end of their run.
            is_idle && matches!(holder, SkillOwner::Session(_))
        });
        let holder = holder.cloned()?;
        self.lease.release(&holder);
        Some(holder)
    }

    /// Checks that the lease is free or held by this owner.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease.
    pub(super) fn allows(&self, by: &SkillOwner) -> Result<(), SkillRefusal> {
        match self.lease.holder() {
            Some(holder) if holder != by => Err(locked(holder)),
            Some(_) | None => Ok(()),
        }
    }

    /// Releases the lease and its lock. A run in progress continues.
    pub(super) fn release(&mut self, by: &SkillOwner) {
        if self.lease.release(by) {
            self.lock = None;
        }
    }

    /// Releases the lease of an owner that holds it during a run only, if no run is in progress.
    pub(super) fn settle(&mut self) {
        let is_passing = |holder: &&SkillOwner| !matches!(holder, SkillOwner::Session(_));
        let passing = self.lease.holder().filter(is_passing).cloned();
        if let Some(holder) = passing
            && self.running.is_none()
        {
            self.release(&holder);
        }
    }

    /// Records the start of a run of the skill.
    ///
    /// # Errors
    /// BadInvalidState while another skill of the component runs.
    pub(super) fn begin(&mut self, skill: &str) -> Result<(), SkillRefusal> {
        if let Some(running) = &self.running {
            let text = format!("{running} of this component runs, and it does one thing at a time");
            return Err(SkillRefusal::new(RefusalCode::InvalidState, text));
        }
        self.running = Some(skill.to_owned());
        Ok(())
    }

    /// Records the end of the run of the skill.
    pub(super) fn end(&mut self, skill: &str, now: Instant) {
        if self.running.as_deref() == Some(skill) {
            self.running = None;
            self.used = now;
        }
        self.settle();
    }

    /// Reserves the component for its end if no skill runs and no client holds the lease: later
    /// runs are refused. Returns whether it is reserved.
    pub(super) fn reserve(&mut self) -> bool {
        let is_free = self.running.is_none() && self.lease.holder().is_none();
        if is_free {
            self.running = Some("the restart".to_owned());
        }
        is_free
    }
}

fn locked(holder: &SkillOwner) -> SkillRefusal {
    let text = format!("{holder} has the lease of this component");
    SkillRefusal::new(RefusalCode::Locked, text)
}

#[cfg(test)]
mod tests {
    use super::*;

    const IDLE: Duration = Duration::from_secs(60);
    const ME: SkillOwner = SkillOwner::Session(1);
    const OTHER: SkillOwner = SkillOwner::Session(2);

    /// A lease, and the time at a number of seconds after its creation.
    fn lease() -> (ComponentLease, impl Fn(u64) -> Instant) {
        let start = Instant::now();
        let at = move |seconds| start + Duration::from_secs(seconds);
        (ComponentLease::free(start), at)
    }

    #[test]
    fn an_idle_lease_is_free_after_its_time_and_not_before() {
        let (mut lease, at) = lease();
        lease.claim(&ME, at(0)).unwrap();
        assert_eq!(lease.release_idle(IDLE, at(59)), None);
        let refused = lease.claim(&OTHER, at(59)).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "BadLocked: session 1 has the lease of this component"
        );
        assert_eq!(lease.allows(&OTHER), Err(refused));
        assert_eq!(lease.release_idle(IDLE, at(60)), Some(ME));
        assert_eq!(lease.holder(), None);
        assert_eq!(lease.claim(&OTHER, at(60)), Ok(()));
    }

    #[test]
    fn a_run_keeps_an_idle_lease_and_its_end_starts_the_idle_time() {
        let (mut lease, at) = lease();
        lease.claim(&ME, at(0)).unwrap();
        lease.begin("Grasp").unwrap();
        assert_eq!(lease.idle(at(600)), None);
        assert_eq!(lease.release_idle(IDLE, at(600)), None);
        lease.end("Lift", at(600));
        assert_eq!(lease.idle(at(600)), None, "another skill has not run");
        lease.end("Grasp", at(600));
        assert_eq!(lease.release_idle(IDLE, at(659)), None);
        assert_eq!(lease.release_idle(IDLE, at(660)), Some(ME));
    }

    #[test]
    fn the_lease_of_a_caller_without_a_session_ends_with_its_run() {
        for by in [SkillOwner::Space(2), SkillOwner::Local("mes")] {
            let (mut lease, at) = lease();
            lease.claim(&by, at(0)).unwrap();
            lease.begin("Grasp").unwrap();
            lease.settle();
            assert_eq!(lease.holder(), Some(&by));
            assert_eq!(lease.release_idle(IDLE, at(600)), None);
            lease.end("Grasp", at(600));
            assert_eq!(lease.holder(), None);
        }
    }

    #[test]
    fn a_lock_outlasts_the_idle_time_and_ends_after_its_limit() {
        let (mut lease, at) = lease();
        let limit = Duration::from_secs(600);
        lease.lock(&ME, limit, at(0)).unwrap();
        assert!(lease.lock(&OTHER, limit, at(0)).is_err());
        assert!(lease.is_locked_by(&ME) && !lease.is_locked_by(&OTHER));
        assert_eq!(lease.release_idle(IDLE, at(599)), None);
        assert_eq!(lease.expire(at(599)), None);
        assert_eq!(lease.locked_until(), Some(at(600)));
        // An action of the holder extends the lock.
        lease.claim(&ME, at(599)).unwrap();
        assert_eq!(lease.expire(at(600)), None);
        assert_eq!(lease.locked_until(), Some(at(1_199)));
        assert_eq!(lease.expire(at(1_199)), Some(ME));
        assert_eq!((lease.locked_until(), lease.holder()), (None, None));
    }

    #[test]
    fn only_a_lock_that_its_owner_holds_is_renewed() {
        let (mut lease, at) = lease();
        let limit = Duration::from_secs(600);
        lease.claim(&ME, at(0)).unwrap();
        assert!(!lease.renew(&ME, limit, at(0)), "a lease without a lock");
        lease.lock(&ME, limit, at(0)).unwrap();
        assert!(lease.renew(&ME, limit, at(500)));
        assert!(!lease.renew(&OTHER, limit, at(501)));
        assert_eq!(lease.locked_until(), Some(at(1_100)));
        // The lock ends first, and then its owner renews it.
        assert_eq!(lease.expire(at(1_100)), Some(ME));
        assert!(!lease.renew(&ME, limit, at(1_100)));
        assert_eq!((lease.locked_until(), lease.holder()), (None, None));
    }

    #[test]
    fn a_lock_whose_time_ends_in_a_run_is_extended_and_the_run_is_not_touched() {
        let (mut lease, at) = lease();
        let limit = Duration::from_secs(600);
        lease.lock(&ME, limit, at(0)).unwrap();
        lease.begin("Grasp").unwrap();
        assert_eq!(lease.expire(at(600)), None);
        assert_eq!(lease.locked_until(), Some(at(1_200)));
        assert!(lease.begin("Lift").is_err(), "Grasp runs");
        lease.end("Grasp", at(1_000));
        assert_eq!(lease.expire(at(1_200)), None);
        assert_eq!(lease.expire(at(1_600)), Some(ME));
    }

    #[test]
    fn a_released_lease_has_no_lock() {
        let (mut lease, at) = lease();
        lease.lock(&ME, IDLE, at(0)).unwrap();
        lease.release(&OTHER);
        assert!(
            lease.is_locked_by(&ME),
            "only the holder releases the lease"
        );
        lease.release(&ME);
        assert_eq!(lease.locked_until(), None);
        lease.claim(&OTHER, at(1)).unwrap();
        assert!(!lease.is_locked_by(&OTHER));
        assert_eq!(lease.release_idle(IDLE, at(61)), Some(OTHER));
    }

    #[test]
    fn an_unused_component_is_reserved_and_then_starts_no_run() {
        let (mut lease, at) = lease();
        lease.claim(&ME, at(0)).unwrap();
        assert!(!lease.reserve(), "a client has the lease");
        lease.begin("Grasp").unwrap();
        lease.release(&ME);
        assert!(!lease.reserve(), "a run goes on");
        lease.end("Grasp", at(1));
        assert!(lease.reserve());
        let refused = lease.begin("Grasp").unwrap_err();
        assert_eq!(refused.code, RefusalCode::InvalidState, "{refused}");
    }
}
