//! The content of a received message for the local side.

use uadp::{Fields, Scalar, StatusCode, Timestamp, Variant};

use super::content::STATUS_BAD;
use crate::output::ValueRelation;

/// The content of a message for the local side.
pub(super) struct LocalSample<'a> {
    pub(super) fields: Fields<'a>,
    pub(super) source: Option<Timestamp>,
    pub(super) instance: Option<Timestamp>,
    pub(super) kept: ValueRelation,
    pub(super) lasting: bool,
    pub(super) status: u16,
    pub(super) arrived: Timestamp,
}

impl LocalSample<'_> {
    /// Returns the status of a sample whose source is lost, as text: a Bad StatusCode in the place
    /// of a value, or a null value of Bad status.
    pub(super) fn no_value(&self) -> Option<String> {
        let of_sample = StatusCode::from_status(self.status);
        let is_bad = |status: StatusCode| status.0 & STATUS_BAD != 0;
        let mut fields = self.fields.clone().filter_map(Result::ok);
        let status = fields.find_map(|field| match field {
            Variant::Scalar(Scalar::StatusCode(status)) => Some(status),
            Variant::Null => Some(of_sample),
            Variant::Scalar(_) | Variant::Array(_) | Variant::Matrix(_) => None,
        });
        let status = status.filter(|status| is_bad(*status))?;
        Some(format!("the status of the value is {:#010x}", status.0))
    }
}
