//! Applies the entries of a delta frame to the fields of a key frame (OPC 10000-14, 7.2.4.5.6).

/// Meaning of a delta frame entry with index 0 and a null Variant.
///
/// open62541 1.5.7 pads its delta frames with such entries up to the number of fields, even if
/// nothing changed, so they must not clear field 0. As a consequence, a change of field 0 to null
/// is visible only with the next key frame. In other fields, null is always a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum DeltaNull {
    /// The entry is filler and changes nothing.
    #[default]
    Filler,
    /// Field 0 became null, as in the tables of the standard.
    Value,
}

/// Result of applying a delta frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct MergedFrame {
    /// Entries that replaced a field.
    pub applied: usize,
    /// Entries ignored as filler.
    pub filler: usize,
    /// Entries behind the last known field: the DataSet has more fields in a newer minor version
    /// (OPC 10000-14, 6.2.3.2.6).
    pub unknown: usize,
}

impl DeltaNull {
    /// Returns true if a delta frame entry replaces the field of its index.
    #[must_use]
    pub const fn applies(self, index: u16, is_null: bool) -> bool {
        match self {
            Self::Filler => index != 0 || !is_null,
            Self::Value => true,
        }
    }

    /// Replaces the fields of the last key frame with the entries, each a FieldIndex and a value.
    /// `is_null` returns true for the null Variant.
    /// ```
    /// use uadp::{DeltaNull, MergedFrame, Scalar, Variant};
    ///
    /// let mut fields = [Variant::Scalar(Scalar::Boolean(true)), Variant::Scalar(Scalar::Int32(1))];
    /// let entries = [(1, Variant::Scalar(Scalar::Int32(2))), (0, Variant::Null)];
    /// let merged = DeltaNull::Filler.merge(&mut fields, entries, |value| *value == Variant::Null);
    /// assert_eq!(fields, [Scalar::Boolean(true), Scalar::Int32(2)].map(Variant::Scalar));
    /// assert_eq!(merged, MergedFrame { applied: 1, filler: 1, unknown: 0 });
    /// ```
    pub fn merge<T>(
        self,
        fields: &mut [T],
        entries: impl IntoIterator<Item = (u16, T)>,
        is_null: impl Fn(&T) -> bool,
    ) -> MergedFrame {
        let mut merged = MergedFrame::default();
        for (index, value) in entries {
            if !self.applies(index, is_null(&value)) {
                merged.filler += 1;
                continue;
            }
            match fields.get_mut(usize::from(index)) {
                Some(field) => {
                    *field = value;
                    merged.applied += 1;
                }
                None => merged.unknown += 1,
            }
        }
        merged
    }
}
