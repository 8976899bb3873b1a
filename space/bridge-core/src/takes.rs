//! How much of a foreign DataSet a topic is.

use mappings::Variable;

/// What of the fields of foreign messages a topic takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Takes {
    /// All of them.
    #[default]
    All,
    /// One, and the mapping does not say which.
    One,
    /// The one the mapping names.
    Named,
}

impl Takes {
    pub(crate) fn of(variable: Option<&Variable>) -> Self {
        match variable {
            Some(variable) if variable.ua_field.is_some() => Self::Named,
            Some(variable) if variable.value_type.is_some() => Self::One,
            Some(_) | None => Self::All,
        }
    }
}
