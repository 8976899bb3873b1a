//! Names of the space: `ua_<space>_<namespace>_<identifier>`, the UADP triple of PublisherId,
//! WriterGroupId and DataSetWriterId (OPC 10000-14, 7.2.4.4.2 and 7.2.4.5.2).

use std::fmt;
use std::num::NonZeroU16;
use std::str::FromStr;

/// Side that produces a value: 0 the OPC UA side, 1 ROS 1, 2..=232 a ROS 2 space.
///
/// 232 is the highest DDS domain id with ports that fit into 16 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SpaceId(u8);

impl SpaceId {
    /// The OPC UA side.
    pub const UA: Self = Self(0);
    /// The ROS 1 space.
    pub const ROS1: Self = Self(1);
    /// The highest id, 232.
    pub const MAX: Self = Self(232);

    /// Returns `None` above 232.
    #[must_use]
    pub fn new(id: u16) -> Option<Self> {
        let id = u8::try_from(id).ok()?;
        (id <= Self::MAX.0).then_some(Self(id))
    }

    /// Returns the number in the name.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }

    /// Returns `true` for a ROS 2 space (2..=232).
    #[must_use]
    pub const fn is_ros2(self) -> bool {
        self.0 >= 2
    }
}

impl From<SpaceId> for u16 {
    /// Returns the PublisherId of the space's values.
    fn from(space: SpaceId) -> Self {
        Self::from(space.0)
    }
}

impl TryFrom<u16> for SpaceId {
    type Error = TopicError;

    fn try_from(id: u16) -> Result<Self, TopicError> {
        Self::new(id).ok_or(TopicError::Range(NamePart::Space))
    }
}

impl fmt::Display for SpaceId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// Topic of the space. Its `space` produces the value; every other space reads it.
///
/// Ordered by space, then namespace, then identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicId {
    /// Space that produces the value; the PublisherId.
    pub space: SpaceId,
    /// Namespace index of the OPC UA node; the WriterGroupId, with the null value 0.
    pub namespace: NonZeroU16,
    /// Numeric identifier of the node or its alias; the DataSetWriterId, with the null value 0.
    pub identifier: NonZeroU16,
}

impl TopicId {
    /// Returns `None` if the space is above 232 or another number is 0.
    #[must_use]
    pub fn new(space: u16, namespace: u16, identifier: u16) -> Option<Self> {
        Some(Self {
            space: SpaceId::new(space)?,
            namespace: NonZeroU16::new(namespace)?,
            identifier: NonZeroU16::new(identifier)?,
        })
    }

    /// Returns (PublisherId, WriterGroupId, DataSetWriterId).
    #[must_use]
    pub fn triple(self) -> (u16, u16, u16) {
        (
            self.space.into(),
            self.namespace.get(),
            self.identifier.get(),
        )
    }
}

impl fmt::Display for TopicId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "ua_{}_{}_{}",
            self.space, self.namespace, self.identifier
        )
    }
}

impl FromStr for TopicId {
    type Err = TopicError;

    /// Reads exactly the text that `Display` prints. The caller strips a leading `/`. Never
    /// allocates.
    fn from_str(text: &str) -> Result<Self, TopicError> {
        let rest = text.strip_prefix("ua_").ok_or(TopicError::Prefix)?;
        let mut parts = rest.split('_');
        let (Some(space), Some(namespace), Some(identifier), None) =
            (parts.next(), parts.next(), parts.next(), parts.next())
        else {
            return Err(TopicError::Parts);
        };
        let space = decimal(NamePart::Space, space)?;
        let namespace = decimal(NamePart::Namespace, namespace)?;
        let identifier = decimal(NamePart::Identifier, identifier)?;
        Ok(Self {
            space: SpaceId::new(space).ok_or(TopicError::Range(NamePart::Space))?,
            namespace: NonZeroU16::new(namespace).ok_or(TopicError::Range(NamePart::Namespace))?,
            identifier: NonZeroU16::new(identifier)
                .ok_or(TopicError::Range(NamePart::Identifier))?,
        })
    }
}

/// Reads a number; each number has one spelling: digits only, no sign, no leading zero.
pub(crate) fn decimal(part: NamePart, text: &str) -> Result<u16, TopicError> {
    let canonical = !text.is_empty()
        && text.bytes().all(|b| b.is_ascii_digit())
        && (text == "0" || !text.starts_with('0'));
    if !canonical {
        return Err(TopicError::Number(part));
    }
    text.parse().map_err(|_| TopicError::Range(part))
}

/// Error of a text that is not a name of the space.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TopicError {
    /// The text does not begin with `ua_`.
    #[error("a name of the space begins with `ua_`")]
    Prefix,
    /// There are not three parts after `ua_`.
    #[error("a name of the space is `ua_<space>_<namespace>_<identifier>`")]
    Parts,
    /// A part is not a plain decimal number.
    #[error("the {0} is not a decimal number without sign and leading zeros")]
    Number(NamePart),
    /// A number is outside its range.
    #[error("the {0} is outside {range}", range = .0.range())]
    Range(NamePart),
}

/// Part of a name: one of its three numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NamePart {
    /// PublisherId.
    Space,
    /// WriterGroupId.
    Namespace,
    /// DataSetWriterId.
    Identifier,
}

impl NamePart {
    /// Returns the range of the number, as text.
    #[must_use]
    pub const fn range(self) -> &'static str {
        match self {
            Self::Space => "0..232",
            Self::Namespace | Self::Identifier => "1..65535",
        }
    }
}

impl fmt::Display for NamePart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Space => "space",
            Self::Namespace => "namespace index",
            Self::Identifier => "identifier",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse(text: &str) -> Result<TopicId, TopicError> {
        text.parse()
    }

    #[test]
    fn a_name_is_the_triple() {
        let topic = parse("ua_2_5_10").unwrap();
        assert_eq!(topic.triple(), (2, 5, 10));
        assert_eq!(topic, TopicId::new(2, 5, 10).unwrap());
        assert_eq!(topic.to_string(), "ua_2_5_10");
    }

    #[test]
    fn the_ends_of_each_range_are_names_and_their_neighbours_are_not() {
        assert_eq!(parse("ua_0_1_1").unwrap().triple(), (0, 1, 1));
        assert_eq!(
            parse("ua_232_65535_65535").unwrap().triple(),
            (232, 65535, 65535)
        );
        assert_eq!(parse("ua_233_1_1"), Err(TopicError::Range(NamePart::Space)));
        assert_eq!(
            parse("ua_65536_1_1"),
            Err(TopicError::Range(NamePart::Space))
        );
        assert_eq!(
            parse("ua_1_0_1"),
            Err(TopicError::Range(NamePart::Namespace))
        );
        assert_eq!(
            parse("ua_1_65536_1"),
            Err(TopicError::Range(NamePart::Namespace))
        );
        assert_eq!(
            parse("ua_1_1_0"),
            Err(TopicError::Range(NamePart::Identifier))
        );
        assert_eq!(
            parse("ua_1_1_99999999999999999999"),
            Err(TopicError::Range(NamePart::Identifier))
        );
    }

    #[test]
    fn a_number_has_one_spelling() {
        for text in [
            "ua_01_1_1",
            "ua_+1_1_1",
            "ua_-1_1_1",
            "ua_00_1_1",
            "ua_ 1_1_1",
            "ua_x_1_1",
        ] {
            assert_eq!(
                parse(text),
                Err(TopicError::Number(NamePart::Space)),
                "{text}"
            );
        }
        assert_eq!(
            parse("ua_1__1"),
            Err(TopicError::Number(NamePart::Namespace))
        );
        assert_eq!(
            parse("ua_1_1_"),
            Err(TopicError::Number(NamePart::Identifier))
        );
        // Digits of another script.
        assert_eq!(
            parse("ua_1_1_\u{661}"),
            Err(TopicError::Number(NamePart::Identifier))
        );
    }

    #[test]
    fn nothing_precedes_or_follows_the_three_parts() {
        for text in ["", "/ua_1_1_1", "UA_1_1_1", "conveyor", "ua", "xua_1_1_1"] {
            assert_eq!(parse(text), Err(TopicError::Prefix), "{text}");
        }
        for text in [
            "ua_",
            "ua_1",
            "ua_1_1",
            "ua_1_1_1_",
            "ua_1_1_1_1",
            "ua_1_1_1_x",
        ] {
            assert_eq!(parse(text), Err(TopicError::Parts), "{text}");
        }
        assert_eq!(
            parse("ua_1_1_1 "),
            Err(TopicError::Number(NamePart::Identifier))
        );
        assert_eq!(
            parse("ua_1_1_1/x"),
            Err(TopicError::Number(NamePart::Identifier))
        );
    }

    #[test]
    fn only_spaces_from_2_are_ros_2() {
        assert!(!SpaceId::UA.is_ros2() && !SpaceId::ROS1.is_ros2());
        assert!(SpaceId::new(2).unwrap().is_ros2() && SpaceId::MAX.is_ros2());
        assert_eq!(SpaceId::new(233), None);
        assert_eq!(
            SpaceId::try_from(300),
            Err(TopicError::Range(NamePart::Space))
        );
    }

    proptest! {
        #[test]
        fn every_triple_in_range_is_read_back_from_its_name(s in 0..=232u16, n in 1..=u16::MAX, i in 1..=u16::MAX) {
            let topic = TopicId::new(s, n, i).unwrap();
            prop_assert_eq!(topic.triple(), (s, n, i));
            prop_assert_eq!(parse(&topic.to_string()), Ok(topic));
        }

        #[test]
        fn whatever_is_read_prints_as_it_was_written(text in "(ua_)?[0-9_+ -]{0,18}|\\PC{0,20}") {
            if let Ok(topic) = parse(&text) {
                prop_assert_eq!(topic.to_string(), text);
            }
        }

        #[test]
        fn the_constructor_and_the_parser_take_the_same_numbers(s in 0..=500u16, n in 0..=3u16, i in 0..=3u16) {
            prop_assert_eq!(TopicId::new(s, n, i), parse(&format!("ua_{s}_{n}_{i}")).ok());
        }
    }
}
