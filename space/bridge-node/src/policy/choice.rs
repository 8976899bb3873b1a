//! In which type the values of a topic of another space are written.

use bridge_core::Described;
use messages::{MessageType, Selection, TypeName};

/// What is known of the type of one topic of another space: what the mapping says, what the writer
/// of the value says, and what the value is.
#[derive(Debug, Clone, Default)]
pub struct Choice {
    /// What the mapping ties it to; it decides alone.
    mapped: Option<(TypeName, Selection)>,
    // In Boxes, as a mapped value of which nothing was heard has none of these.
    /// What the writer of the value says of it.
    described: Option<Box<Described>>,
    /// The type it says, where it is known here and has those fields, and what of the message they
    /// are.
    learned: Option<Box<(TypeName, Selection)>>,
    /// The std_msgs type of the value, if it is one value and there is such a type.
    standard: Option<TypeName>,
}

/// What the Router heard of a value.
#[derive(Debug, Clone, Default)]
pub struct Word {
    /// What its writer says it is.
    pub described: Option<Described>,
    /// That type with what of it the value is, where both are known here.
    pub learned: Option<(TypeName, Selection)>,
    /// The type that carries such a value and nothing else.
    pub standard: Option<TypeName>,
}

/// What a port does about it.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// Nothing: what is open stays.
    Stay,
    /// Opens the topic, in the first of the [`candidates`](Choice::candidates) that is known.
    Open,
    /// Binds the topic anew in the type it has, of which this is the value.
    Select(Selection),
}

impl Choice {
    /// For a value that the mapping ties to a ROS topic, or, with `None`, to no topic.
    #[must_use]
    pub fn new(mapped: Option<(TypeName, Selection)>) -> Self {
        Self {
            mapped,
            ..Self::default()
        }
    }

    /// What the mapping ties it to.
    #[must_use]
    pub const fn mapped(&self) -> Option<&(TypeName, Selection)> {
        self.mapped.as_ref()
    }

    /// The types it could have, best first: the mapping's; what subscribers ask for; what its
    /// writer says; the standard type of the value.
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

    /// What of a message of that type the value is.
    #[must_use]
    pub fn selection(&self, name: &TypeName) -> Selection {
        let learned = self.learned.as_deref();
        let learned = learned.filter(|(learned, _)| learned == name);
        self.mapped
            .as_ref()
            .or(learned)
            .map_or(Selection::Whole, |(_, selection)| selection.clone())
    }

    /// Whether the stamp at the beginning of such messages is no part of the value.
    #[must_use]
    pub fn stamps(&self, message_type: &MessageType) -> bool {
        crate::wants_stamp(message_type, Some(&self.selection(message_type.name())))
    }

    /// Looks at what the writer of the value says again, with the definition that is written.
    pub fn learn_from(&mut self, message_type: &MessageType) {
        let name = message_type.name();
        let described = self.described.as_ref();
        if let Some(described) = described.filter(|described| described.message_type == *name) {
            let selection = described.selection(message_type);
            self.learned = selection.map(|selection| Box::new((name.clone(), selection)));
        }
    }

    /// Takes what was heard of the value. `open` is the type in which it is written by now, and
    /// whether somebody here subscribes to it: the type that somebody subscribed to stays, whatever
    /// of it the value is; without a word nothing changes.
    #[must_use]
    pub fn hear(&mut self, word: Word, open: Option<(&TypeName, bool)>) -> Step {
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
            return Step::Open;
        };
        let other_type = learned.as_deref().is_some_and(|(name, _)| name != written);
        if self.mapped.is_some() || (subscribed && other_type) || learned.is_none() {
            return Step::Stay;
        }
        let before = self.selection(written);
        self.learned = learned;
        let selection = self.selection(written);
        if other_type {
            Step::Open
        } else if selection != before {
            Step::Select(selection)
        } else {
            Step::Stay
        }
    }
}

#[cfg(test)]
mod tests {
    use messages::{Dialect, Registry};

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
        assert_eq!(choice.hear(heard, None), Step::Open);
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
        assert_eq!(choice.hear(heard(), None), Step::Open);
        let asked_for = [name("std_msgs/String")];
        assert_eq!(names(&choice.candidates(asked_for)), ["std_msgs/Bool"]);
        let open = name("std_msgs/Bool");
        assert_eq!(choice.hear(heard(), Some((&open, false))), Step::Stay);
    }

    #[test]
    fn what_is_open_changes_its_type_only_while_nobody_subscribes() {
        let mut choice = Choice::default();
        let open = name("std_msgs/Float64");
        let field = || Selection::Field("turns".to_owned());
        let other = || word(Some(("a_msgs/Turns", field())), None);
        let step = choice.hear(word(None, Some("std_msgs/Float64")), None);
        assert_eq!(step, Step::Open);
        assert_eq!(choice.hear(other(), Some((&open, true))), Step::Stay);
        assert_eq!(names(&choice.candidates([])), ["std_msgs/Float64"]);
        // Without a word nothing changes.
        assert_eq!(
            choice.hear(Word::default(), Some((&open, false))),
            Step::Stay
        );
        assert_eq!(choice.hear(other(), Some((&open, false))), Step::Open);
        // In the type it has, another part of it.
        let open = name("a_msgs/Turns");
        assert_eq!(choice.hear(other(), Some((&open, true))), Step::Stay);
        let whole = || word(Some(("a_msgs/Turns", Selection::Whole)), None);
        let step = choice.hear(whole(), Some((&open, true)));
        assert_eq!(step, Step::Select(Selection::Whole));
        assert_eq!(choice.hear(whole(), Some((&open, true))), Step::Stay);
    }

    #[test]
    fn a_message_of_one_field_gets_a_stamp_and_a_whole_one_keeps_its_own() {
        for dialect in [Dialect::Ros1, Dialect::Ros2] {
            let imu = Registry::bundle(dialect)
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
