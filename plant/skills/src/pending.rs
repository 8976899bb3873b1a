//! The parameters of the next run.

use std::collections::BTreeMap;

use crate::authority::SkillOwner;
use crate::value::SkillValue;

/// The parameters that an owner has written for the next run. A write by another owner discards
/// them.
#[derive(Debug, Default)]
pub(crate) struct PendingParameters {
    by: Option<SkillOwner>,
    values: BTreeMap<String, SkillValue>,
}

impl PendingParameters {
    /// Returns the values of this owner; discards the values of another owner.
    fn of(&mut self, by: &SkillOwner) -> &mut BTreeMap<String, SkillValue> {
        if self.by.as_ref() != Some(by) {
            self.by = Some(by.clone());
            self.values.clear();
        }
        &mut self.values
    }

    pub(crate) fn given(&mut self, by: &SkillOwner) -> Vec<(String, SkillValue)> {
        self.of(by).clone().into_iter().collect()
    }

    pub(crate) fn write(&mut self, by: &SkillOwner, name: &str, value: SkillValue) {
        self.of(by).insert(name.to_owned(), value);
    }

    /// Discards the values of an owner. Returns whether the owner had written any.
    pub(crate) fn forget(&mut self, by: &SkillOwner) -> bool {
        let is_theirs = self.by.as_ref() == Some(by);
        if is_theirs {
            *self = Self::default();
        }
        is_theirs
    }

    pub(crate) fn kept(&mut self, by: &SkillOwner, values: &[(String, SkillValue)]) {
        *self.of(by) = values.iter().cloned().collect();
    }
}
