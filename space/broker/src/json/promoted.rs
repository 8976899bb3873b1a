//! Promoted fields: fields of a DataSet that are copied into the header of its messages, so that
//! tools can filter without decoding them (OPC 10000-14, 7.3.4.8).

use uadp::NetworkMessage;

use super::Json;

/// Names and values of promoted fields. A value is in the verbose JSON encoding.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct PromotedTexts(Vec<(String, String)>);

impl PromotedTexts {
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        let fields = self.0.iter();
        fields.map(|(name, text)| (name.as_str(), text.as_str()))
    }

    /// Returns the size of the user properties in bytes: each text has a length of two bytes, and
    /// each property an identifier.
    pub(crate) fn size(&self) -> usize {
        let sizes = self.iter().map(|(name, text)| name.len() + text.len() + 5);
        sizes.sum()
    }
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
    /// several writers have none. Fields without a value, and longer than 1 KiB, are left out.
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
        let mut texts = Vec::new();
        for field in data.values().ok()? {
            let field = field.ok()?;
            let Some(known) = described.get(usize::from(field.index)) else {
                continue;
            };
            let Some(value) = field.value.value.filter(|_| known.promoted) else {
                continue;
            };
            let Some(shown) = json_values::show_variant(&value).ok()?.value else {
                continue;
            };
            let text = shown.to_string();
            if text.len() + known.name.len() <= MOST {
                texts.push((known.name.clone(), text));
            }
        }
        Some(PromotedTexts(texts))
    }
}

/// The longest promoted field in bytes, with its name.
const MOST: usize = 1024;
