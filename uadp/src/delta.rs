//! Putting the entries of a delta frame over the fields of a key frame (OPC 10000-14, 7.2.4.5.6).

/// What an entry of a delta frame with index 0 and a null Variant means.
///
/// open62541 1.5.7 fills its delta frames up to the number of fields with such entries, also when nothing changed,
/// so that none of them may wipe field 0. The price is that with such publishers about, a field 0 that really became
/// null shows with the next key frame only. Null in other fields is a value either way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum DeltaNull {
    /// Nothing: it is filler.
    #[default]
    Filler,
    /// Field 0 became null, as the tables of the standard have it.
    Value,
}

/// What became of the entries of a delta frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Merged {
    /// Entries that replaced a field.
    pub applied: usize,
    /// Entries taken as filler.
    pub filler: usize,
    /// Entries past the last field known: the DataSet has more fields in a newer minor version
    /// (OPC 10000-14, 6.2.3.2.6).
    pub unknown: usize,
}

impl DeltaNull {
    /// True when an entry of a delta frame replaces the field of its index.
    #[must_use]
    pub const fn applies(self, index: u16, is_null: bool) -> bool {
        match self {
            Self::Filler => index != 0 || !is_null,
            Self::Value => true,
        }
    }

    /// Replaces the fields of the last key frame by the entries, each a FieldIndex and a value. `is_null` tells the
    /// null Variant from other values.
    /// ```
    /// use uadp::{DeltaNull, Merged, Scalar, Variant};
    ///
    /// let mut fields = [Variant::Scalar(Scalar::Boolean(true)), Variant::Scalar(Scalar::Int32(1))];
    /// let entries = [(1, Variant::Scalar(Scalar::Int32(2))), (0, Variant::Null)];
    /// let merged = DeltaNull::Filler.merge(&mut fields, entries, |value| *value == Variant::Null);
    /// assert_eq!(fields, [Scalar::Boolean(true), Scalar::Int32(2)].map(Variant::Scalar));
    /// assert_eq!(merged, Merged { applied: 1, filler: 1, unknown: 0 });
    /// ```
    pub fn merge<T>(
        self,
        fields: &mut [T],
        entries: impl IntoIterator<Item = (u16, T)>,
        is_null: impl Fn(&T) -> bool,
    ) -> Merged {
        let mut merged = Merged::default();
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
