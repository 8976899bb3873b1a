//! Parts of arrays, and conversion of values: `field`, `scale`, `offset`, `invert` and
//! `out_of_range`.

use messages::{
    ArrayPart, Conversion, Leaf, MessagePlan, MessageType, PlanError, Selection, Wire, is_lossless,
};
use uadp::BuiltinType;

use super::types::{self, ValueType};
use crate::code::Code;
use crate::document::{BindingEntry, FieldEntry, OutOfRangeEntry, PatternEntry};
use crate::findings::MappingFindings;
use crate::read::{OptionalKey, given, short};
use crate::tree::TextSpan;

/// Conversion keys of a binding with one value.
pub(super) struct Shaping {
    conversion: Conversion,
    /// Position of the first conversion key.
    place: Option<TextSpan>,
    scaled: bool,
    /// `out_of_range` is given.
    said: bool,
}

/// Keys that convert a value.
#[derive(Clone, Copy)]
pub(super) struct ConversionKeys<'k> {
    scale: &'k OptionalKey<f64>,
    offset: &'k OptionalKey<f64>,
    invert: &'k OptionalKey<bool>,
    out_of_range: &'k OptionalKey<OutOfRangeEntry>,
}

impl<'k> From<&'k BindingEntry> for ConversionKeys<'k> {
    fn from(entry: &'k BindingEntry) -> Self {
        Self {
            scale: &entry.scale,
            offset: &entry.offset,
            invert: &entry.invert,
            out_of_range: &entry.out_of_range,
        }
    }
}

impl<'k> From<&'k PatternEntry> for ConversionKeys<'k> {
    fn from(entry: &'k PatternEntry) -> Self {
        Self {
            scale: &entry.scale,
            offset: &entry.offset,
            invert: &entry.invert,
            out_of_range: &entry.out_of_range,
        }
    }
}

impl<'k> From<&'k FieldEntry> for ConversionKeys<'k> {
    fn from(entry: &'k FieldEntry) -> Self {
        Self {
            scale: &entry.scale,
            offset: &entry.offset,
            invert: &entry.invert,
            out_of_range: &entry.out_of_range,
        }
    }
}

/// Direction of the value, and its type in OPC UA.
#[derive(Clone, Copy)]
pub(super) struct ValueDirection {
    pub(super) reads: bool,
    pub(super) declared: Option<ValueType>,
    /// The value is the only value of its variable, so the variable may have a `type`.
    pub(super) alone: bool,
}

/// Returns the field and its part; `None` for a faulty text, which is noted.
pub(super) fn part(
    text: &str,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<(String, Option<ArrayPart>)> {
    let split = ArrayPart::split(text);
    if split.is_none() {
        let message = format!("`{}` is not a part of an array field", short(text));
        findings
            .error(Code::FieldPart, place, message)
            .help("write an element such as position[2] or position[name=joint_3], several elements such as \
                   ranges[0:90]");
    }
    split.map(|(field, part)| (field.to_owned(), part))
}

/// Returns `None` for a faulty key, which is noted.
pub(super) fn shaping(keys: ConversionKeys<'_>, findings: &mut MappingFindings) -> Option<Shaping> {
    let mut sound = Some(());
    let mut conversion = Conversion::default();
    let (scale, offset) = (given(keys.scale), given(keys.offset));
    let scaled = keys.scale.is_some() || keys.offset.is_some();
    if let Some((scale, place)) = scale
        && (*scale == 0.0 || !scale.is_normal())
    {
        findings
            .error(
                Code::Conversion,
                place,
                format!("{scale} is not a valid scale"),
            )
            .help("give a number other than 0; use -1 to change the sign");
        sound = None;
    }
    if let Some((offset, place)) = offset
        && !offset.is_finite()
    {
        findings.error(
            Code::Conversion,
            place,
            format!("{offset} is not a valid offset"),
        );
        sound = None;
    }
    if scaled {
        let scale = scale.map_or(1.0, |(scale, _)| *scale);
        conversion = conversion.scaled(scale, offset.map_or(0.0, |(offset, _)| *offset));
    }
    if let Some((true, place)) = given(keys.invert) {
        conversion = conversion.inverted();
        let beside = [
            ("scale", keys.scale.as_ref().map(|at| at.place)),
            ("offset", keys.offset.as_ref().map(|at| at.place)),
            (
                "out_of_range",
                keys.out_of_range.as_ref().map(|at| at.place),
            ),
        ];
        let mut beside = beside
            .into_iter()
            .filter_map(|(key, place)| Some((key, place?)));
        if let Some((key, other)) = beside.next() {
            let message = format!("`{key}` requires a number, but `invert` a Boolean");
            let line = findings.line(place, other);
            findings
                .error(Code::Conversion, other, message)
                .label(format!("`invert` at {line}"))
                .help("remove one of them");
            sound = None;
        }
    }
    if let Some((OutOfRangeEntry::Clamp, _)) = given(keys.out_of_range) {
        conversion = conversion.clamped();
    }
    let places = [
        keys.scale.as_ref().map(|at| at.place),
        keys.offset.as_ref().map(|at| at.place),
        keys.invert.as_ref().map(|at| at.place),
        keys.out_of_range.as_ref().map(|at| at.place),
    ];
    sound.map(|()| Shaping {
        conversion,
        place: places.into_iter().flatten().next(),
        scaled,
        said: keys.out_of_range.is_some(),
    })
}

impl Shaping {
    /// Returns the selection of a field with its conversion, checked against the type if it is
    /// known. Returns `None` for a fault, which is noted.
    pub(super) fn select(
        self,
        (field, part): (String, Option<ArrayPart>),
        message_type: Option<&MessageType>,
        (place, way): (TextSpan, ValueDirection),
        findings: &mut MappingFindings,
    ) -> Option<Selection> {
        if part.is_some() && !way.reads {
            let note = findings.error(
                Code::PartWritten,
                place,
                "a part of an array can only be read, but this topic is written",
            );
            note.help("the rest of the array has no values: bind the whole field, or a field with a single value");
            return None;
        }
        let leaf = message_type.and_then(|message| message.leaf(&field));
        let element = match &part {
            // The type of a field inside of messages follows from the type of the messages.
            Some(inside @ ArrayPart::Inside { .. }) => message_type
                .and_then(|message| inner(message, &field, inside))
                .map(|leaf| leaf.builtin),
            Some(_) | None => leaf.map(|leaf| element(leaf, part.as_ref())),
        };
        let conversion = self.conversion(element, (place, way), findings)?;
        if part.is_none() && conversion.is_none() {
            return Some(Selection::Field(field));
        }
        Some(Selection::Value {
            field,
            part,
            conversion,
        })
    }

    /// Notes a conversion key beside `fields`: it belongs to one of the fields.
    pub(super) fn of_fields(&self, findings: &mut MappingFindings) -> Option<()> {
        self.misplaced(
            (
                Code::Fields,
                "the conversion of `fields` belongs to each field",
            ),
            "move it to the field: `fields: [{field: linear.x, scale: 1000}]`",
            findings,
        )
    }

    /// Notes a conversion key if no value crosses.
    pub(super) fn of_nothing(&self, findings: &mut MappingFindings) -> Option<()> {
        self.misplaced(
            (
                Code::Conversion,
                "the request contains no value, so nothing is converted",
            ),
            "give the field of the request that takes the value: `field: data`",
            findings,
        )
    }

    /// Notes a conversion key if a whole message crosses.
    pub(super) fn of_several(&self, findings: &mut MappingFindings) -> Option<()> {
        self.misplaced(
            (
                Code::Conversion,
                "only a single value can be converted, but this is a message",
            ),
            "select the value with `field`",
            findings,
        )
    }

    /// Notes a conversion key, if there is one, with a message and its remedy.
    fn misplaced(
        &self,
        (code, message): (Code, &str),
        help: &str,
        findings: &mut MappingFindings,
    ) -> Option<()> {
        let Some(place) = self.place else {
            return Some(());
        };
        findings.error(code, place, message).help(help);
        None
    }

    fn conversion(
        &self,
        element: Option<BuiltinType>,
        (place, way): (TextSpan, ValueDirection),
        findings: &mut MappingFindings,
    ) -> Option<Conversion> {
        let mut conversion = self.conversion;
        let declared = way.declared.map(|(builtin, _)| builtin);
        let to = declared.filter(|to| {
            to.is_number() && element.is_none_or(|from| from.is_number() && from != *to)
        });
        if let Some(to) = to {
            conversion = conversion.to(to);
        }
        let (Some(inside), Some(place)) = (element, self.place.or(Some(place))) else {
            return Some(conversion);
        };
        let outside = to.unwrap_or(inside);
        let (from, into) = if way.reads {
            (inside, outside)
        } else {
            (outside, inside)
        };
        let whole = !matches!(into, BuiltinType::Float | BuiltinType::Double);
        let lossy = (from.is_number() && !is_lossless(from, into))
            || (self.scaled && into.is_number() && whole);
        if lossy && !self.said {
            let message = if self.scaled && from == into {
                format!("scaled values do not fit {} without rounding", into.name())
            } else {
                format!("{} has values that do not fit {}", from.name(), into.name())
            };
            let help = if way.reads && self.scaled && way.alone && declared.is_none() {
                "give the variable `type: Double`, or choose how to treat a value that does not fit: \
                     `out_of_range: refuse` or `clamp`"
            } else {
                "choose how to treat a value that does not fit after rounding: `out_of_range: refuse` or `clamp`"
            };
            findings
                .error(Code::LossyConversion, place, message)
                .help(help);
            return None;
        }
        if self.said && conversion.is_none() {
            findings.error(
                Code::Conversion,
                place,
                "nothing is converted here, so every value fits",
            );
            return None;
        }
        Some(conversion)
    }
}

/// Returns the field of one message of an array.
fn inner(message_type: &MessageType, array: &str, part: &ArrayPart) -> Option<Leaf> {
    let ArrayPart::Inside { field, .. } = part else {
        return None;
    };
    message_type.leaf_inside(array, field)
}

/// Returns the builtin type of one element, or of the whole field.
fn element(leaf: &Leaf, part: Option<&ArrayPart>) -> BuiltinType {
    match (leaf.builtin, part) {
        (BuiltinType::ByteString, Some(ArrayPart::Element(_) | ArrayPart::Named { .. })) => {
            BuiltinType::Byte
        }
        (builtin, _) => builtin,
    }
}

/// Returns the fields of a selection with a part or conversion; `None` if the type lacks a field,
/// which is noted.
pub(super) fn leaves(
    message_type: &std::sync::Arc<MessageType>,
    selection: &Selection,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<Vec<Leaf>> {
    let (field, part) = match selection {
        Selection::Value { field, part, .. } => (field, part),
        Selection::Field(path) => {
            return types::field(message_type, path, place, findings);
        }
        Selection::Whole
        | Selection::Fields(_)
        | Selection::Structure(_)
        | Selection::Template { .. }
        | Selection::Bytes => return None,
    };
    let wire = match message_type.dialect() {
        messages::Dialect::Ros1 => Wire::Ros1,
        messages::Dialect::Ros2 => Wire::Cdr,
    };
    let alone = Selection::Value {
        field: field.clone(),
        part: part.clone(),
        conversion: Conversion::default(),
    };
    let code = match part {
        Some(_) => Code::FieldPart,
        None => Code::Conversion,
    };
    let found = MessagePlan::compile(message_type, &alone, wire)
        .map_err(|error| (code, error))
        .and_then(|_| {
            MessagePlan::compile(message_type, selection, wire)
                .map_err(|error| (Code::Conversion, error))
        });
    let (code, error) = match found {
        Ok(plan) => return Some(plan.leaves().to_vec()),
        Err((_, PlanError::UnknownField { name, path, .. })) if name == *message_type.name() => {
            types::field(message_type, &path, place, findings);
            return None;
        }
        Err(fault) => fault,
    };
    findings.error(code, place, error.to_string());
    None
}
