//! Who may start what: one owner of a component at a time.

use thiserror::Error;

/// The right to have a component do something. Reading needs none.
///
/// Without it two clients that each write parameters and then call Start would run with each other's. `S` is what a client
/// is known by, as its session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lease<S> {
    holder: Option<S>,
}

/// Somebody else holds the lease; nothing has changed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("another client has the lease of this component")]
pub struct Held<S> {
    /// Who does.
    pub by: S,
}

impl<S: Clone + PartialEq> Lease<S> {
    /// A lease that nobody holds.
    #[must_use]
    pub fn free() -> Self {
        Self { holder: None }
    }

    /// Takes the lease, or keeps it.
    ///
    /// # Errors
    /// [`Held`] when it is somebody else's.
    pub fn claim(&mut self, by: S) -> Result<(), Held<S>> {
        match &self.holder {
            Some(holder) if *holder != by => Err(Held { by: holder.clone() }),
            _ => {
                self.holder = Some(by);
                Ok(())
            }
        }
    }

    /// Gives the lease back, as when the session of its holder ends. Says whether it was theirs.
    pub fn release(&mut self, by: &S) -> bool {
        let theirs = self.holder.as_ref() == Some(by);
        if theirs {
            self.holder = None;
        }
        theirs
    }

    /// Who holds it.
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
        assert_eq!(lease.claim("second"), Err(Held { by: "first" }));
        assert_eq!(lease.claim("first"), Ok(()), "it has it already");
        assert!(!lease.release(&"second"), "it is not theirs to give back");
        assert_eq!(lease.holder(), Some(&"first"));
        assert!(lease.release(&"first"));
        assert_eq!(lease.claim("second"), Ok(()));
    }
}
