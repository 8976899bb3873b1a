//! Selects the datagrams to which an entry of a key or metadata file applies.

use serde::Deserialize;
use serde_json::Value;

use crate::shape;

/// A PublisherId: with its type, or a number or text alone, which matches any type.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub(crate) enum PublisherSelector {
    Typed(shape::PublisherIdJson),
    Any(Value),
}

impl PublisherSelector {
    fn is(&self, id: &shape::PublisherIdJson) -> bool {
        match self {
            Self::Typed(wanted) => {
                wanted.id_type == id.id_type && text(&wanted.value) == text(&id.value)
            }
            Self::Any(value) => text(value) == text(&id.value),
        }
    }
}

/// Returns true if the ids are equal or `wanted` is `None`.
pub(crate) fn publisher_fits(
    wanted: Option<&PublisherSelector>,
    id: Option<&shape::PublisherIdJson>,
) -> bool {
    match (wanted, id) {
        (None, _) => true,
        (Some(wanted), Some(id)) => wanted.is(id),
        (Some(_), None) => false,
    }
}

/// Like [`publisher_fits`], for a WriterGroupId or DataSetWriterId.
pub(crate) fn number_fits(wanted: Option<u16>, id: Option<u16>) -> bool {
    wanted.is_none() || wanted == id
}

/// Returns the text of a value; 64-bit numbers are stored as text.
fn text(value: &Value) -> String {
    let text = value.as_str().map(str::to_owned);
    text.unwrap_or_else(|| value.to_string())
}
