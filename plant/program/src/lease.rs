//! The lease of a component: at most one client controls the component.

use thiserror::Error;

/// The right to control a component. Reading does not require the lease.
///
/// Without the lease, two clients that each write parameters and then call Start could start runs
/// with each other's parameters. `S` identifies a client, for example by its session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lease<S> {
    holder: Option<S>,
}

/// Another client holds the lease; nothing has changed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("another client has the lease of this component")]
pub struct LeaseHeld<S> {
    /// The holder.
    pub by: S,
}

impl<S: Clone + PartialEq> Lease<S> {
    /// Creates a lease without a holder.
    #[must_use]
    pub fn free() -> Self {
        Self { holder: None }
    }

    /// Acquires or renews the lease.
    ///
    /// # Errors
    /// [`LeaseHeld`] if another client holds the lease.
    pub fn claim(&mut self, by: S) -> Result<(), LeaseHeld<S>> {
        match &self.holder {
            Some(holder) if *holder != by => Err(LeaseHeld { by: holder.clone() }),
            _ => {
                self.holder = Some(by);
                Ok(())
            }
        }
    }

    /// Releases the lease, for example when the session of its holder ends. Returns whether this
    /// client held it.
    pub fn release(&mut self, by: &S) -> bool {
        let theirs = self.holder.as_ref() == Some(by);
        if theirs {
            self.holder = None;
        }
        theirs
    }

    /// Returns the holder.
    #[must_use]
    pub fn holder(&self) -> Option<&S> {
        self.holder.as_ref()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_clients_that_race_one_wins_and_the_other_is_told_of_it() {
        let mut lease = Lease::free();
        assert_eq!(lease.claim("first"), Ok(()));
        assert_eq!(lease.claim("second"), Err(LeaseHeld { by: "first" }));
        assert_eq!(lease.claim("first"), Ok(()), "it has it already");
        assert!(!lease.release(&"second"), "it is not theirs to give back");
        assert_eq!(lease.holder(), Some(&"first"));
        assert!(lease.release(&"first"));
        assert_eq!(lease.claim("second"), Ok(()));
    }
}
