//! The part of a foreign DataSet that a topic uses.

use mappings::Variable;

/// The fields of foreign messages that a topic uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum UsedFields {
    /// All fields.
    #[default]
    All,
    /// A single field that the mapping does not name.
    One,
    /// The field that the mapping names.
    Named,
}

impl UsedFields {
    pub(crate) fn of(variable: Option<&Variable>) -> Self {
        match variable {
            Some(variable) if variable.ua_field.is_some() => Self::Named,
            Some(variable) if variable.value_type.is_some() => Self::One,
            Some(_) | None => Self::All,
        }
    }
}
