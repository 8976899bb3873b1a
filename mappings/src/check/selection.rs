//! Fields of a message that cross: `field`, `fields`, `as` and the keys that convert, taken
//! together.

use std::sync::Arc;

use messages::{Leaf, MessageType, Selection};

use super::several;
use super::shaping::{self, ConversionKeys, ValueDirection};
use super::types;
use crate::code::Code;
use crate::document::{AsEntry, BindingEntry, FieldList, PatternEntry};
use crate::findings::MappingFindings;
use crate::read::{OptionalKey, given};
use crate::tree::TextSpan;

/// Keys of a binding or a pattern that select fields.
#[derive(Clone, Copy)]
pub(super) struct SelectionKeys<'e> {
    pub(super) field: &'e OptionalKey<String>,
    pub(super) fields: &'e OptionalKey<FieldList>,
    pub(super) r#as: &'e OptionalKey<AsEntry>,
    keys: ConversionKeys<'e>,
}

impl<'e> From<&'e BindingEntry> for SelectionKeys<'e> {
    fn from(entry: &'e BindingEntry) -> Self {
        Self {
            field: &entry.field,
            fields: &entry.fields,
            r#as: &entry.r#as,
            keys: entry.into(),
        }
    }
}

impl<'e> From<&'e PatternEntry> for SelectionKeys<'e> {
    fn from(entry: &'e PatternEntry) -> Self {
        Self {
            field: &entry.field,
            fields: &entry.fields,
            r#as: &entry.r#as,
            keys: entry.into(),
        }
    }
}

impl SelectionKeys<'_> {
    /// Returns the position of `field` or `fields`, or else of `as`.
    pub(super) fn place(&self) -> Option<TextSpan> {
        let field = self.field.as_ref().map(|at| at.place);
        let fields = self.fields.as_ref().map(|at| at.place);
        let r#as = self.r#as.as_ref().map(|at| at.place);
        field.or(fields).or(r#as)
    }

    /// Returns `true` if fields are named.
    pub(super) const fn names_fields(&self) -> bool {
        self.field.is_some() || self.fields.is_some()
    }

    /// Notes a conversion key if there is no value to convert.
    pub(super) fn converts_nothing(&self, findings: &mut MappingFindings) -> Option<()> {
        shaping::shaping(self.keys, findings)?.of_nothing(findings)
    }

    /// Checks that `fields` stands without `field` and `as`. A fault is noted.
    fn are_alone(&self, findings: &mut MappingFindings) -> Option<()> {
        let beside = [
            ("field", self.field.as_ref().map(|at| at.place)),
            ("as", self.r#as.as_ref().map(|at| at.place)),
        ];
        let mut beside = beside
            .into_iter()
            .filter_map(|(key, place)| Some((key, place?)));
        let Some((key, place)) = beside.next() else {
            return Some(());
        };
        let message = format!("`{key}` cannot be combined with `fields`");
        findings
            .error(Code::Fields, place, message)
            .help("remove one of them");
        None
    }

    /// Returns `None` for a faulty selection, which is noted.
    pub(super) fn selection(
        self,
        message_type: Option<&MessageType>,
        (place, way): (TextSpan, ValueDirection),
        findings: &mut MappingFindings,
    ) -> Option<Selection> {
        let shaping = shaping::shaping(self.keys, findings)?;
        if let Some(at) = self.fields {
            shaping.of_fields(findings)?;
            at.value.as_ref()?;
            self.are_alone(findings)?;
            return several::fields(at, message_type, way, findings);
        }
        let r#as = given(self.r#as).map_or(AsEntry::Fields, |(r#as, _)| *r#as);
        match (self.field, r#as) {
            (Some(at), AsEntry::Fields) => {
                let field = shaping::part(at.value.as_ref()?, at.place, findings)?;
                shaping.select(field, message_type, (place, way), findings)
            }
            (Some(at), AsEntry::Bytes) => {
                let message = "a message that is transferred as bytes has no fields";
                findings
                    .error(Code::FieldOfBytes, at.place, message)
                    .help("remove `field`, or `as: bytes`");
                None
            }
            (Some(at), AsEntry::Structure) => {
                shaping.of_several(findings)?;
                Some(Selection::Structure(Some(at.value.clone()?)))
            }
            (None, AsEntry::Structure) => {
                shaping.of_several(findings)?;
                Some(Selection::Structure(None))
            }
            (None, AsEntry::Bytes) => {
                shaping.of_several(findings)?;
                Some(Selection::Bytes)
            }
            (None, AsEntry::Fields) => {
                // A type with one field means this field.
                let Some([only]) = message_type.map(MessageType::leaves) else {
                    shaping.of_several(findings)?;
                    return Some(Selection::Whole);
                };
                let only = (only.path.clone(), None);
                let shaped = shaping.select(only, message_type, (place, way), findings)?;
                let alone = matches!(shaped, Selection::Field(_));
                Some(if alone { Selection::Whole } else { shaped })
            }
        }
    }
}

/// Returns the values of a selection; `None` if the type lacks a field, which is noted.
pub(super) fn leaves(
    message_type: &Arc<MessageType>,
    selection: &Selection,
    (place, way): (TextSpan, ValueDirection),
    findings: &mut MappingFindings,
) -> Option<Vec<Leaf>> {
    match selection {
        Selection::Bytes => Some(vec![Leaf::bytes()]),
        Selection::Fields(selected)
        | Selection::Template {
            fields: selected, ..
        } => several::leaves(message_type, selected, (place, way), findings),
        Selection::Structure(path) => {
            let path = path.as_deref().unwrap_or_default();
            several::structure(message_type, path, place, findings)
        }
        Selection::Value { .. } => shaping::leaves(message_type, selection, place, findings),
        Selection::Whole => Some(message_type.leaves().to_vec()),
        Selection::Field(path) => types::field(message_type, path, place, findings),
    }
}
