//! Changes of several fields at once.

use std::sync::{Arc, PoisonError};

use super::{ComponentConfiguration, FieldError, NotConfigured, Values, write};
use crate::value::SkillValue;

/// Fields with their new values, or with their values before a change. `None` is a field without a
/// configured value, which has its default.
pub type FieldChange = Vec<(String, Option<SkillValue>)>;

impl ComponentConfiguration {
    /// Sets some fields; other fields keep their values. Nothing is set if one of them is wrong or
    /// if the configuration cannot be stored.
    ///
    /// # Errors
    /// The first wrong field, with the reason.
    pub fn set(&self, given: Vec<(String, SkillValue)>) -> Result<(), NotConfigured> {
        let given = given.into_iter().map(|(name, value)| (name, Some(value)));
        self.change(given.collect()).map(drop)
    }

    /// Sets some fields, or removes their configured values. Returns the values of these fields
    /// before. Nothing is changed if one of them is wrong or if the configuration cannot be stored.
    ///
    /// # Errors
    /// The first wrong field, with the reason.
    pub fn change(&self, given: FieldChange) -> Result<FieldChange, NotConfigured> {
        let _setting = self.setting.lock().unwrap_or_else(PoisonError::into_inner);
        let (values, before) = self.checked(given)?;
        if let Some(store) = &self.store {
            write(store, &values).map_err(|reason| NotConfigured {
                field: String::new(),
                reason,
            })?;
        }
        self.values.send_replace(Arc::new(values));
        Ok(before)
    }

    /// Checks a change, and changes nothing. Returns the current values of the fields.
    ///
    /// # Errors
    /// The first wrong field, with the reason.
    pub fn check(&self, given: FieldChange) -> Result<FieldChange, NotConfigured> {
        self.checked(given).map(|(_, before)| before)
    }

    /// Returns the values after a change, and the values of its fields before.
    fn checked(&self, given: FieldChange) -> Result<(Values, FieldChange), NotConfigured> {
        let mut values = Values::clone(&self.values.borrow());
        let mut before = FieldChange::new();
        for (name, value) in given {
            let wrong = |reason| NotConfigured {
                field: name.clone(),
                reason,
            };
            let field = self.fields.iter().find(|field| field.facts.name == name);
            let Some(field) = field else {
                return Err(wrong(self.unknown(&name)));
            };
            if before.iter().any(|(known, _)| *known == name) {
                return Err(wrong(FieldError::Twice));
            }
            let replaced = match value.map(|value| field.take(value)).transpose() {
                Ok(Some(value)) => values.insert(name.clone(), value),
                Ok(None) => values.remove(&name),
                Err(reason) => return Err(wrong(reason)),
            };
            before.push((name, replaced));
        }
        Ok((values, before))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::component::Component;

    fn configuration() -> ComponentConfiguration {
        let text = "component: x\napplication_uri: urn:x\nnamespace: 1\nskills:\n  - {name: Grasp, type: GraspSkillType, driver: simulated}\n\
                    configurable:\n  - {name: Limit, limits: Force, range: [5, 50]}\n  - {name: Product, type: String, default: none}\n";
        let component = Component::from_yaml(text, std::path::Path::new(""));
        let component =
            component.unwrap_or_else(|findings| panic!("{}", findings.render("x", text)));
        ComponentConfiguration::new(component.configurable, None)
    }

    #[test]
    fn a_change_is_checked_made_and_taken_back_as_a_whole() {
        let configuration = configuration();
        let limit = |value: f64| ("Limit".to_owned(), Some(SkillValue::from(value)));
        let product = |text: &str| ("Product".to_owned(), Some(SkillValue::from(text)));
        let shown = || -> Vec<Option<SkillValue>> {
            let fields = configuration.fields().iter();
            fields.map(|field| configuration.value(field)).collect()
        };
        let first = shown();
        let new = vec![product("A"), limit(20.0)];
        let before = vec![("Product".to_owned(), None), ("Limit".to_owned(), None)];
        assert_eq!(configuration.check(new.clone()), Ok(before.clone()));
        assert_eq!(shown(), first, "a check changes nothing");
        let wrong = configuration
            .change(vec![product("B"), limit(70.0)])
            .unwrap_err();
        assert_eq!(wrong.field, "Limit");
        assert_eq!(shown(), first);
        assert_eq!(configuration.change(new), Ok(before.clone()));
        assert_eq!(shown(), [Some(20.0.into()), Some("A".into())]);
        let taken_back = configuration.change(before).unwrap();
        assert_eq!(taken_back, [product("A"), limit(20.0)]);
        assert_eq!(shown(), first);
        let twice = configuration
            .check(vec![limit(6.0), limit(7.0)])
            .unwrap_err();
        assert_eq!(twice.reason, FieldError::Twice);
    }
}
