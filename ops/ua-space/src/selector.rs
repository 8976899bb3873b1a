//! Which datagrams an entry of a keys or metadata file is for.

use serde::Deserialize;
use serde_json::Value;

use crate::shape;

/// A PublisherId: with its type, or the number or text alone, which then may have any type.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub(crate) enum Publisher {
    Typed(shape::PublisherId),
    Any(Value),
}

impl Publisher {
    fn is(&self, id: &shape::PublisherId) -> bool {
        match self {
            Self::Typed(wanted) => {
                wanted.id_type == id.id_type && text(&wanted.value) == text(&id.value)
            }
            Self::Any(value) => text(value) == text(&id.value),
        }
    }
}

/// True where what is wanted is there, or nothing is.
pub(crate) fn publisher_fits(wanted: Option<&Publisher>, id: Option<&shape::PublisherId>) -> bool {
    match (wanted, id) {
        (None, _) => true,
        (Some(wanted), Some(id)) => wanted.is(id),
        (Some(_), None) => false,
    }
}

/// As [`publisher_fits`], of a WriterGroupId or DataSetWriterId.
pub(crate) fn number_fits(wanted: Option<u16>, id: Option<u16>) -> bool {
    wanted.is_none() || wanted == id
}

/// 64 bit numbers stand as text.
fn text(value: &Value) -> String {
    let text = value.as_str().map(str::to_owned);
    text.unwrap_or_else(|| value.to_string())
}
