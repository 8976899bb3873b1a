//! What another version of a mapping says differently.

use crate::mapping::Mapping;
use crate::topic::TopicId;

/// The variables that two mappings do not have alike, in the order of their documents.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Difference {
    /// Only in the newer one.
    pub added: Vec<TopicId>,
    /// In both, with something about them that differs.
    pub changed: Vec<TopicId>,
    /// Only in the older one.
    pub removed: Vec<TopicId>,
    /// How many are the same in both.
    pub same: usize,
}

impl Mapping {
    /// How this mapping differs from an older one, variable by variable.
    #[must_use]
    pub fn difference(&self, older: &Self) -> Difference {
        let mut difference = Difference::default();
        for variable in self.variables() {
            match older.variable(variable.topic) {
                None => difference.added.push(variable.topic),
                Some(before) if before == variable => difference.same += 1,
                Some(_) => difference.changed.push(variable.topic),
            }
        }
        let gone = older.variables().iter().map(|variable| variable.topic);
        difference.removed = gone
            .filter(|topic| self.variable(*topic).is_none())
            .collect();
        difference
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(variables: &[(u16, &str)]) -> Mapping {
        let mut text = "spaces: [{id: 1}]\nnamespaces: {2: 'urn:test'}\nvariables:\n".to_owned();
        for (id, name) in variables {
            text += &format!("  - {{node: ns=2;i={id}, name: {name}, type: Double, origin: 1}}\n");
        }
        Mapping::from_yaml(&text, "test.yaml").mapping.unwrap()
    }

    #[test]
    fn variables_are_told_apart_by_their_topics() {
        let difference =
            of(&[(1, "A"), (3, "X"), (4, "D")]).difference(&of(&[(1, "A"), (2, "B"), (3, "C")]));
        let topic = |id: u16| TopicId::new(1, 2, id).unwrap();
        assert_eq!(
            difference,
            Difference {
                added: vec![topic(4)],
                changed: vec![topic(3)],
                removed: vec![topic(2)],
                same: 1,
            }
        );
    }
}
