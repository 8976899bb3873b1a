//! Chooses the type in which the values of a topic of another space are written.

use bridge_core::TopicMetaData;
use messages::{MessageType, Selection, TypeName};

/// The known facts about the type of one topic of another space: from the mapping, from the writer
/// of the value, and from the value itself.
#[derive(Debug, Clone, Default)]
pub struct Choice {
    /// The type and selection that the mapping sets. It takes precedence over all others.
    mapped: Option<(TypeName, Selection)>,
    // Boxed, because a mapped value without a received description has neither.
    /// The description by the writer of the value.
    described: Option<Box<TopicMetaData>>,
    /// The described type, if it is known here and has the described fields, and the selection that
    /// the value is.
    learned: Option<Box<(TypeName, Selection)>>,
    /// The std_msgs type of the value, if the value is a single field and such a type exists.
    standard: Option<TypeName>,
}

/// The facts that the Router has received about a value.
#[derive(Debug, Clone, Default)]
pub struct Word {
    /// The description by the writer.
    pub described: Option<TopicMetaData>,
    /// The described type and the selection that the value is, if both are known here.
    pub learned: Option<(TypeName, Selection)>,
    /// The type that carries such a value and nothing else.
    pub standard: Option<TypeName>,
}

/// The action of a port after new facts.
#[derive(Debug, Clone, PartialEq)]
pub enum PortStep {
    /// No action: an open topic stays open.
    Stay,
    /// Opens the topic with the first known type of the [`candidates`](Choice::candidates).
    Open,
    /// Binds the topic again with the same type and this selection.
    Select(Selection),
}

impl Choice {
    /// Creates the choice for a value that the mapping ties to a ROS topic, or, with `None`, to no
    /// topic.
    #[must_use]
    pub fn new(mapped: Option<(TypeName, Selection)>) -> Self {
        Self {
            mapped,
            ..Self::default()
        }
    }

    /// Returns the type and selection that the mapping sets.
    #[must_use]
    pub const fn mapped(&self) -> Option<&(TypeName, Selection)> {
        self.mapped.as_ref()
    }

    /// Returns the possible types, best first: the type in the mapping; types that subscribers
    /// request; the type that the writer names; the standard type of the value.
    #[must_use]
    pub fn candidates(&self, asked_for: impl IntoIterator<Item = TypeName>) -> Vec<TypeName> {
        if let Some((message_type, _)) = &self.mapped {
            return vec![message_type.clone()];
        }
        let learned = self.learned.as_deref().map(|(name, _)| name.clone());
        let mut candidates: Vec<TypeName> = Vec::new();
        for name in asked_for
            .into_iter()
            .chain(learned)
            .chain(self.standard.clone())
        {
            if !candidates.contains(&name) {
                candidates.push(name);
            }
        }
        candidates
    }

    /// Returns the part of a message of a type that the value is.
    #[must_use]
    pub fn selection(&self, name: &TypeName) -> Selection {
        let learned = self.learned.as_deref();
        let learned = learned.filter(|(learned, _)| learned == name);
        self.mapped
            .as_ref()
            .or(learned)
            .map_or(Selection::Whole, |(_, selection)| selection.clone())
    }

    /// Returns whether the stamp at the beginning of such messages is not a part of the value.
    #[must_use]
    pub fn stamps(&self, message_type: &MessageType) -> bool {
        crate::wants_stamp(message_type, Some(&self.selection(message_type.name())))
    }

    /// Evaluates the description by the writer again, with the definition that is used for writing.
    pub fn learn_from(&mut self, message_type: &MessageType) {
        let name = message_type.name();
        let described = self.described.as_ref();
        if let Some(described) = described.filter(|described| described.message_type == *name) {
            let selection = described.selection(message_type);
            self.learned = selection.map(|selection| Box::new((name.clone(), selection)));
        }
    }

    /// Evaluates new facts about the value. `open` is the type in which the value is written, and
    /// whether it has a local subscriber. A type with a subscriber stays, even
    /// if the value is another part of it. Without facts nothing changes.
    #[must_use]
    pub fn hear(&mut self, word: Word, open: Option<(&TypeName, bool)>) -> PortStep {
        let Word {
            described,
            learned,
            standard,
        } = word;
        self.described = described.map(Box::new);
        let learned = learned.map(Box::new);
        let Some((written, subscribed)) = open else {
            self.standard = standard;
            self.learned = learned;
            return PortStep::Open;
        };
        let other_type = learned.as_deref().is_some_and(|(name, _)| name != written);
        if self.mapped.is_some() || (subscribed && other_type) || learned.is_none() {
            return PortStep::Stay;
        }
        let before = self.selection(written);
        self.learned = learned;
        let selection = self.selection(written);
        if other_type {
            PortStep::Open
        } else if selection != before {
            PortStep::Select(selection)
        } else {
            PortStep::Stay
        }
    }
}

#[cfg(test)]
mod tests {
    use messages::{Dialect, TypeRegistry};

    use super::*;

    fn name(text: &str) -> TypeName {
        text.parse().unwrap()
    }

    fn names(candidates: &[TypeName]) -> Vec<String> {
        candidates.iter().map(ToString::to_string).collect()
    }

    fn word(learned: Option<(&str, Selection)>, standard: Option<&str>) -> Word {
        Word {
            described: None,
            learned: learned.map(|(text, selection)| (name(text), selection)),
            standard: standard.map(name),
        }
    }

    #[test]
    fn a_subscriber_decides_before_the_writer_and_the_writer_before_the_standard_type() {
        let mut choice = Choice::default();
        let heard = word(
            Some(("a_msgs/Turns", Selection::Whole)),
            Some("std_msgs/Float64"),
        );
        assert_eq!(choice.hear(heard, None), PortStep::Open);
        assert_eq!(
            names(&choice.candidates([])),
            ["a_msgs/Turns", "std_msgs/Float64"]
        );
        let asked_for = [name("std_msgs/Float32"), name("std_msgs/Float64")];
        assert_eq!(
            names(&choice.candidates(asked_for)),
            ["std_msgs/Float32", "std_msgs/Float64", "a_msgs/Turns"]
        );
    }

    #[test]
    fn the_mapping_decides_before_everybody() {
        let mut choice = Choice::new(Some((name("std_msgs/Bool"), Selection::Whole)));
        let heard = || word(Some(("a_msgs/Turns", Selection::Whole)), None);
        assert_eq!(choice.hear(heard(), None), PortStep::Open);
        let asked_for = [name("std_msgs/String")];
        assert_eq!(names(&choice.candidates(asked_for)), ["std_msgs/Bool"]);
        let open = name("std_msgs/Bool");
        assert_eq!(choice.hear(heard(), Some((&open, false))), PortStep::Stay);
    }

    #[test]
    fn what_is_open_changes_its_type_only_while_nobody_subscribes() {
        let mut choice = Choice::default();
        let open = name("std_msgs/Float64");
        let field = || Selection::Field("turns".to_owned());
        let other = || word(Some(("a_msgs/Turns", field())), None);
        let step = choice.hear(word(None, Some("std_msgs/Float64")), None);
        assert_eq!(step, PortStep::Open);
        assert_eq!(choice.hear(other(), Some((&open, true))), PortStep::Stay);
        assert_eq!(names(&choice.candidates([])), ["std_msgs/Float64"]);
        // Without facts nothing changes.
        assert_eq!(
            choice.hear(Word::default(), Some((&open, false))),
            PortStep::Stay
        );
        assert_eq!(choice.hear(other(), Some((&open, false))), PortStep::Open);
        // The same type with another selection.
        let open = name("a_msgs/Turns");
        assert_eq!(choice.hear(other(), Some((&open, true))), PortStep::Stay);
        let whole = || word(Some(("a_msgs/Turns", Selection::Whole)), None);
        let step = choice.hear(whole(), Some((&open, true)));
        assert_eq!(step, PortStep::Select(Selection::Whole));
        assert_eq!(choice.hear(whole(), Some((&open, true))), PortStep::Stay);
    }

    #[test]
    fn a_message_of_one_field_gets_a_stamp_and_a_whole_one_keeps_its_own() {
        for dialect in [Dialect::Ros1, Dialect::Ros2] {
            let imu = TypeRegistry::bundle(dialect)
                .get(&name("sensor_msgs/Imu"))
                .unwrap();
            let stamps = |selection: Selection| {
                Choice::new(Some((imu.name().clone(), selection))).stamps(&imu)
            };
            assert!(stamps(Selection::Field("angular_velocity.z".to_owned())));
            assert!(!stamps(Selection::Field("header.stamp".to_owned())));
            assert!(!stamps(Selection::Whole));
            assert!(!stamps(Selection::Bytes));
        }
    }
}
