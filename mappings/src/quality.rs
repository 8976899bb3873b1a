//! How old a value may become.

use std::time::Duration;

/// When the cell's server no longer shows a value as good, because no newer one comes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ages {
    /// It is uncertain when no newer one has come for this long; `None` while its writer is heard.
    pub uncertain_after: Option<Duration>,
    /// It is bad when it has been uncertain for this long; `None` never.
    pub bad_after: Option<Duration>,
}

impl Ages {
    /// The same, with the default for what is not said.
    #[must_use]
    pub fn or(self, bad_after: Option<Duration>) -> Self {
        Self {
            bad_after: self.bad_after.or(bad_after),
            ..self
        }
    }
}
