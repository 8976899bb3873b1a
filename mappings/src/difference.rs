//! Differences between two versions of a mapping.

use std::collections::BTreeMap;

use crate::call::Call;
use crate::mapping::Mapping;
use crate::topic::TopicId;

/// Variables, and after them calls, that differ between two mappings, in the order of their
/// documents.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Difference {
    /// Topics that only the newer mapping has.
    pub added: Vec<TopicId>,
    /// Topics of both mappings with different properties.
    pub changed: Vec<TopicId>,
    /// Topics that only the older mapping has.
    pub removed: Vec<TopicId>,
    /// Number of variables and calls that are equal in both.
    pub same: usize,
}

impl Mapping {
    /// Returns the differences from an older mapping, variable by variable and call by call.
    #[must_use]
    pub fn difference(&self, older: &Self) -> Difference {
        let mut difference = Difference::default();
        for variable in self.variables() {
            difference.add(variable.topic, older.variable(variable.topic), variable);
        }
        let gone = older.variables().iter().map(|variable| variable.topic);
        difference.removed = gone
            .filter(|topic| self.variable(*topic).is_none())
            .collect();
        let by_topic = |mapping: &'_ Self| -> BTreeMap<TopicId, Call> {
            let calls = mapping.calls().iter();
            calls.map(|call| (call.topic, call.clone())).collect()
        };
        let (before, after) = (by_topic(older), by_topic(self));
        for call in self.calls() {
            difference.add(call.topic, before.get(&call.topic), call);
        }
        let gone = older.calls().iter().map(|call| call.topic);
        let gone = gone.filter(|topic| !after.contains_key(topic));
        difference.removed.extend(gone);
        difference
    }
}

impl Difference {
    /// Adds a topic of the newer mapping.
    fn add<T: PartialEq>(&mut self, topic: TopicId, before: Option<&T>, now: &T) {
        match before {
            None => self.added.push(topic),
            Some(before) if before == now => self.same += 1,
            Some(_) => self.changed.push(topic),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variables(variables: &[(u16, &str)]) -> Mapping {
        let mut text = "spaces: [{id: 1}]\nnamespaces: {2: 'urn:test'}\nvariables:\n".to_owned();
        for (id, name) in variables {
            text += &format!("  - {{node: ns=2;i={id}, name: {name}, type: Double, origin: 1}}\n");
        }
        Mapping::from_yaml(&text, "test.yaml").mapping.unwrap()
    }

    fn calls(calls: &[(u16, &str)]) -> Mapping {
        let mut text = "spaces: [{id: 1}]\nnamespaces: {2: 'urn:test'}\ncalls:\n".to_owned();
        for (id, service) in calls {
            text += &format!(
                "  - {{node: ns=2;i={id}, name: C{id}, origin: 1, ros: {{service: /{service}, type: std_srvs/Empty}}}}\n"
            );
        }
        Mapping::from_yaml(&text, "test.yaml").mapping.unwrap()
    }

    #[test]
    fn variables_and_calls_are_told_apart_by_their_topics() {
        let newer = [(1, "A"), (3, "X"), (4, "D")];
        let older = [(1, "A"), (2, "B"), (3, "C")];
        let topic = |id: u16| TopicId::new(1, 2, id).unwrap();
        for of in [variables, calls] {
            assert_eq!(
                of(&newer).difference(&of(&older)),
                Difference {
                    added: vec![topic(4)],
                    changed: vec![topic(3)],
                    removed: vec![topic(2)],
                    same: 1,
                }
            );
        }
    }
}
