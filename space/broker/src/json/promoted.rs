//! Promoted fields: fields of a DataSet that are copied into the header of its messages, so that
//! tools can filter without decoding them (OPC 10000-14, 7.3.4.8).

use uadp::{NetworkMessage, Variant};

use super::Json;

/// Names and values of promoted fields. A value is in the verbose JSON encoding.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct PromotedTexts(Vec<(String, String)>);

impl PromotedTexts {
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        let fields = self.0.iter();
        fields.map(|(name, text)| (name.as_str(), text.as_str()))
    }

    /// Returns the size of the user properties in bytes.
    pub(crate) fn size(&self) -> usize {
        self.iter().map(|(name, text)| size(name, text)).sum()
    }

    /// Returns the fields that a header can carry, up to its limit.
    fn limited<'a>(fields: impl Iterator<Item = (&'a str, String)>) -> Self {
        let mut total = 0;
        let fits = fields.filter(|(name, text)| {
            name.len() + text.len() <= MOST && !name.chars().any(is_unwanted)
        });
        let limited = fits.take_while(|(name, text)| {
            total += size(name, text);
            total <= MOST_OF_MESSAGE
        });
        Self(
            limited
                .map(|(name, text)| (name.to_owned(), text))
                .collect(),
        )
    }
}

/// Returns the size of a user property in bytes: each text has a length of two bytes, and the
/// property an identifier.
const fn size(name: &str, text: &str) -> usize {
    name.len() + text.len() + 5
}

impl<'a> FromIterator<(&'a str, &'a str)> for PromotedTexts {
    fn from_iter<T: IntoIterator<Item = (&'a str, &'a str)>>(fields: T) -> Self {
        let owned = fields.into_iter();
        Self(
            owned
                .map(|(name, text)| (name.to_owned(), text.to_owned()))
                .collect(),
        )
    }
}

impl Json {
    /// Returns the promoted fields of a value, as its metadata marks them. A header is readable for
    /// everyone and belongs to one DataSetMessage, so sealed messages, chunks and messages of
    /// several writers have none. Left out are fields without a value, fields that no header can
    /// carry or that are longer than 1 KiB, and all fields after the first 8 KiB.
    pub(crate) fn promoted(&self, message: &NetworkMessage<'_>) -> PromotedTexts {
        self.promoted_fields(message).unwrap_or_default()
    }

    fn promoted_fields(&self, message: &NetworkMessage<'_>) -> Option<PromotedTexts> {
        if message.is_sealed() || message.is_chunk() {
            return None;
        }
        let publisher = crate::address::publisher(message)?;
        let group = message.group()?.writer_group_id?;
        let mut messages = message.messages();
        let data = messages.next()?.ok()?;
        if messages.next().is_some() {
            return None;
        }
        let described = self.own.of((publisher, group, data.writer_id?))?;
        if !described.iter().any(|field| field.promoted) {
            return None;
        }
        let promoted = data.values().ok()?.filter_map(|field| {
            let field = field.ok()?;
            let known = described.get(usize::from(field.index))?;
            let value = field.value.value.filter(|_| known.promoted)?;
            Some((known.name.as_str(), shown(&value)?))
        });
        Some(PromotedTexts::limited(promoted))
    }
}

/// Returns a value as JSON; `None` for a null, and for a value that cannot be shown.
fn shown(value: &Variant<'_>) -> Option<String> {
    let shown = json_values::show_variant(value).ok()?.value?;
    Some(escaped(&shown.to_string()))
}

/// Writes the characters of a JSON text as `\uXXXX` that MQTT does not want. They are in strings
/// only, as the control characters below U+0020 that JSON escapes anyway.
fn escaped(json: &str) -> String {
    let mut escaped = String::with_capacity(json.len());
    for character in json.chars() {
        if is_unwanted(character) {
            for unit in character.encode_utf16(&mut [0; 2]) {
                escaped.push_str(&format!("\\u{unit:04x}"));
            }
        } else {
            escaped.push(character);
        }
    }
    escaped
}

/// Returns whether a broker may end the connection if a text has this character: a control
/// character or a noncharacter of Unicode (MQTT 5.0, 1.5.4).
fn is_unwanted(character: char) -> bool {
    let code = u32::from(character);
    character.is_control() || (0xFDD0..=0xFDEF).contains(&code) || code & 0xFFFE == 0xFFFE
}

/// The longest promoted field in bytes, with its name.
const MOST: usize = 1024;
/// The longest promoted fields of a message in bytes, as [`PromotedTexts::size`].
const MOST_OF_MESSAGE: usize = 8 << 10;

#[cfg(test)]
mod tests {
    use uadp::Scalar;

    use super::*;

    #[test]
    fn characters_that_a_broker_refuses_are_escaped_in_texts() {
        for (character, wanted) in [
            ('\0', r#""\u0000""#),
            ('\u{1f}', r#""\u001f""#),
            ('\u{7f}', r#""\u007f""#),
            ('\u{9f}', r#""\u009f""#),
            ('\u{fdd0}', r#""\ufdd0""#),
            ('\u{fdef}', r#""\ufdef""#),
            ('\u{fffe}', r#""\ufffe""#),
            ('\u{1ffff}', r#""\ud83f\udfff""#),
            ('\u{10fffe}', r#""\udbff\udffe""#),
            ('\u{a0}', "\"\u{a0}\""),
            ('\u{fdf0}', "\"\u{fdf0}\""),
            ('\u{fffd}', "\"\u{fffd}\""),
        ] {
            let text = character.to_string();
            let json = shown(&Variant::Scalar(Scalar::String(Some(&text)))).unwrap();
            assert_eq!(json, wanted);
            let read: serde_json::Value = serde_json::from_str(&json).unwrap();
            assert_eq!(read.as_str(), Some(text.as_str()));
        }
    }

    #[test]
    fn fields_that_a_header_cannot_carry_are_left_out() {
        let long = "x".repeat(MOST);
        let fields = [
            ("a", "1"),
            ("b\0", "2"),
            ("c\u{85}", "3"),
            ("d\u{fdd0}", "4"),
            ("long", &long),
            ("e", "5"),
        ];
        let fields = fields.map(|(name, text)| (name, text.to_owned()));
        let limited = PromotedTexts::limited(fields.into_iter());
        assert_eq!(limited, [("a", "1"), ("e", "5")].into_iter().collect());
    }

    #[test]
    fn all_fields_of_a_message_have_a_limit_together() {
        let fields = (0..100).map(|_| ("name", "x".repeat(1000)));
        let limited = PromotedTexts::limited(fields);
        // Each has five more bytes for its lengths and its identifier.
        assert_eq!(limited.iter().count(), MOST_OF_MESSAGE / 1009);
        assert!(limited.size() <= MOST_OF_MESSAGE);
    }
}
