//! Properties of every layout and payload of RawData. The tests encode the payloads independently
//! of the crate, from OPC 10000-14, 7.2.4.5.11 and OPC 10000-6, 5.2.5 to 5.2.8.

use proptest::collection::vec;
use proptest::prelude::*;
use uadp::{
    Array, BuiltinType, DecodeError, ExtensionBody, Matrix, NodeId, RawDialect, RawField,
    RawLayout, RawStructure, RawStructureType, RawValue, Scalar, Variant,
};

use RawDialect::{Open62541, Standard};

/// Choices that become 0 when they are used up: shrinking makes them few and small.
struct Tape {
    bytes: std::vec::IntoIter<u8>,
}

impl Tape {
    fn byte(&mut self) -> u8 {
        self.bytes.next().unwrap_or(0)
    }

    /// Returns a number below `n`.
    fn pick(&mut self, n: u8) -> u8 {
        self.byte() % n
    }
}

/// Form of a range of bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Form {
    Standard,
    Open62541,
    Plain,
}

impl Form {
    fn of(dialect: RawDialect) -> Self {
        if dialect == Standard {
            Self::Standard
        } else {
            Self::Open62541
        }
    }

    fn inside(self) -> Self {
        match self {
            Self::Standard => Self::Standard,
            Self::Open62541 | Self::Plain => Self::Plain,
        }
    }
}

#[derive(Debug, Clone)]
enum Tree {
    One(Leaf),
    Many {
        null: bool,
        dimensions: Vec<u32>,
        items: Vec<Leaf>,
    },
}

#[derive(Debug, Clone)]
enum Leaf {
    Fixed(Vec<u8>),
    Text(Option<Vec<u8>>),
    Structure {
        head: u32,
        fields: Vec<Option<Tree>>,
    },
}

const TYPES: [BuiltinType; 16] = [
    BuiltinType::Byte,
    BuiltinType::Boolean,
    BuiltinType::SByte,
    BuiltinType::Int16,
    BuiltinType::UInt16,
    BuiltinType::Int32,
    BuiltinType::UInt32,
    BuiltinType::Int64,
    BuiltinType::UInt64,
    BuiltinType::Float,
    BuiltinType::Double,
    BuiltinType::DateTime,
    BuiltinType::Guid,
    BuiltinType::StatusCode,
    BuiltinType::String,
    BuiltinType::ByteString,
];

fn layout(tape: &mut Tape) -> &'static [RawField<'static>] {
    let count = tape.pick(4) + 1;
    let fields: Vec<_> = (0..count).map(|_| field(tape, 3)).collect();
    fields.leak()
}

/// The field is leaked, because structures borrow their fields and are created during the test.
fn field(tape: &mut Tape, depth: u8) -> RawField<'static> {
    let kind = tape.pick(22);
    let field = match TYPES.get(usize::from(kind)) {
        Some(builtin) => RawField::new(*builtin),
        None if depth == 0 => RawField::new(BuiltinType::Byte),
        None => RawField::structure(structure(tape, depth - 1)),
    };
    let field = field.with_max_string_length(u32::from(tape.pick(4)));
    match tape.pick(6) {
        rank @ 1..=3 => {
            let dimensions: Vec<_> = (0..rank).map(|_| u32::from(tape.pick(4))).collect();
            let known = tape.pick(4) != 1;
            let field = field.with_dimensions(dimensions.leak());
            if known {
                field
            } else {
                RawField {
                    array_dimensions: &[],
                    ..field
                }
            }
        }
        _ => field,
    }
}

fn structure(tape: &mut Tape, depth: u8) -> &'static RawStructure<'static> {
    let structure_type = match tape.pick(3) {
        0 => RawStructureType::Structure,
        1 => RawStructureType::StructureWithOptionalFields,
        _ => RawStructureType::Union,
    };
    let count = tape.pick(3) + 1;
    let fields: Vec<_> = (0..count)
        .map(|_| {
            let field = field(tape, depth);
            let may = structure_type == RawStructureType::StructureWithOptionalFields;
            if may && tape.pick(2) == 1 {
                field.as_optional()
            } else {
                field
            }
        })
        .collect();
    let type_id = NodeId::numeric(2, tape.byte().into());
    let structure = RawStructure::new(type_id, structure_type, fields.leak()).unwrap();
    Box::leak(Box::new(structure))
}

fn tree(tape: &mut Tape, field: &RawField<'_>, form: Form) -> Tree {
    if field.value_rank == -1 {
        return Tree::One(leaf(tape, field, form));
    }
    let rank = usize::try_from(field.value_rank).unwrap();
    if rank == 1 && form != Form::Open62541 && tape.pick(5) == 1 {
        return Tree::Many {
            null: true,
            dimensions: vec![0],
            items: Vec::new(),
        };
    }
    let padded = form == Form::Standard && full(field, form).is_some();
    let dimensions: Vec<u32> = (0..rank)
        .map(|index| match field.array_dimensions.get(index) {
            None | Some(0) => tape.pick(3).into(),
            Some(most) if form == Form::Open62541 => *most,
            Some(most) if padded && index > 0 => *most,
            Some(most) => u32::from(tape.byte()) % (most + 1),
        })
        .collect();
    let count = dimensions.iter().product::<u32>();
    Tree::Many {
        null: false,
        items: (0..count).map(|_| leaf(tape, field, form)).collect(),
        dimensions,
    }
}

fn leaf(tape: &mut Tape, field: &RawField<'_>, form: Form) -> Leaf {
    if let Some(structure) = field.structure {
        return inside(tape, structure, form.inside());
    }
    if let Some(size) = field.builtin.fixed_size() {
        let mut bytes: Vec<_> = (0..size).map(|_| tape.byte()).collect();
        if field.builtin == BuiltinType::Boolean {
            bytes[0] &= 1;
        }
        return Leaf::Fixed(bytes);
    }
    let most = match field.max_string_length {
        0 => 4,
        most => u8::try_from(most).unwrap(),
    };
    Leaf::Text(match tape.pick(4) {
        1 => None,
        _ => {
            let len = tape.pick(most + 1);
            Some((0..len).map(|_| b'a' + tape.pick(26)).collect())
        }
    })
}

fn inside(tape: &mut Tape, structure: &RawStructure<'_>, form: Form) -> Leaf {
    let fields = structure.fields();
    let mut head = 0;
    let fields = match structure.structure_type() {
        RawStructureType::Union => {
            head = u32::from(tape.byte()) % (u32::try_from(fields.len()).unwrap() + 1);
            fields
                .iter()
                .zip(1..)
                .map(|(field, index)| (index == head).then(|| tree(tape, field, form)))
                .collect()
        }
        RawStructureType::Structure | RawStructureType::StructureWithOptionalFields => {
            let mut bit = 1;
            let mut present = |field: &RawField<'_>, tape: &mut Tape| {
                if !field.optional {
                    return true;
                }
                let present = tape.pick(2) == 1;
                head |= bit * u32::from(present);
                bit <<= 1;
                present
            };
            fields
                .iter()
                .map(|field| present(field, tape).then(|| tree(tape, field, form)))
                .collect()
        }
    };
    Leaf::Structure { head, fields }
}

/// Returns the bytes of an element, or `None` if variable.
fn element_size(field: &RawField<'_>, form: Form) -> Option<usize> {
    let Some(structure) = field.structure else {
        return match (field.builtin.fixed_size(), field.max_string_length) {
            (Some(size), _) => Some(size),
            (None, 0) => None,
            (None, most) if form != Form::Plain => Some(4 + usize::try_from(most).unwrap()),
            (None, _) => None,
        };
    };
    let form = form.inside();
    let sizes: Option<Vec<usize>> = structure
        .fields()
        .iter()
        .map(|field| size(field, form))
        .collect();
    let sizes = sizes?;
    let varies = form == Form::Plain;
    match structure.structure_type() {
        RawStructureType::Structure => Some(sizes.iter().sum()),
        RawStructureType::Union if varies => None,
        RawStructureType::Union => Some(4 + sizes.iter().max().unwrap()),
        _ if varies && structure.fields().iter().any(|field| field.optional) => None,
        RawStructureType::StructureWithOptionalFields => Some(4 + sizes.iter().sum::<usize>()),
    }
}

/// Returns the bytes of the maximum number of elements.
fn full(field: &RawField<'_>, form: Form) -> Option<usize> {
    let dimensions = field.array_dimensions;
    if dimensions.is_empty() || dimensions.contains(&0) {
        return None;
    }
    let count = usize::try_from(dimensions.iter().product::<u32>()).unwrap();
    Some(count * element_size(field, form)?)
}

fn size(field: &RawField<'_>, form: Form) -> Option<usize> {
    let words = match (field.value_rank, form) {
        (-1, _) => return element_size(field, form),
        (_, Form::Plain) => return None,
        (1, _) => 1,
        (rank, Form::Open62541) => usize::try_from(rank).unwrap(),
        (rank, Form::Standard) => usize::try_from(rank).unwrap() + 1,
    };
    Some(4 * words + full(field, form)?)
}

fn lay_out(tree: &Tree, field: &RawField<'_>, form: Form, out: &mut Vec<u8>) {
    let (null, dimensions, items) = match tree {
        Tree::One(leaf) => return lay_out_leaf(leaf, field, form, out),
        Tree::Many {
            null,
            dimensions,
            items,
        } => (null, dimensions, items),
    };
    if dimensions.len() > 1 && form != Form::Open62541 {
        out.extend(u32::try_from(dimensions.len()).unwrap().to_le_bytes());
    }
    if *null {
        out.extend([0xFF; 4])
    } else {
        out.extend(dimensions.iter().flat_map(|size| size.to_le_bytes()))
    }
    let end = out.len() + full(field, form).unwrap_or(0);
    for leaf in items {
        lay_out_leaf(leaf, field, form, out);
    }
    if form == Form::Standard && out.len() < end {
        out.resize(end, 0);
    }
}

fn lay_out_leaf(leaf: &Leaf, field: &RawField<'_>, form: Form, out: &mut Vec<u8>) {
    match leaf {
        Leaf::Fixed(bytes) => out.extend(bytes),
        Leaf::Text(text) => {
            let end = out.len() + 4 + usize::try_from(field.max_string_length).unwrap();
            match text {
                None => out.extend([0xFF; 4]),
                Some(text) => {
                    out.extend(u32::try_from(text.len()).unwrap().to_le_bytes());
                    out.extend(text);
                }
            }
            if form != Form::Plain && out.len() < end {
                out.resize(end, 0);
            }
        }
        Leaf::Structure { head, fields } => {
            let structure = field.structure.unwrap();
            let form = form.inside();
            let end = element_size(field, form).map(|size| out.len() + size);
            if structure.structure_type() != RawStructureType::Structure {
                out.extend(head.to_le_bytes());
            }
            let union = structure.structure_type() == RawStructureType::Union;
            for (tree, field) in fields.iter().zip(structure.fields()) {
                match tree {
                    Some(tree) => lay_out(tree, field, form, out),
                    None if union || form == Form::Plain => {}
                    None => out.resize(out.len() + size(field, form).unwrap_or(0), 0),
                }
            }
            if union && form == Form::Standard && end.is_some_and(|end| out.len() < end) {
                out.resize(end.unwrap(), 0);
            }
        }
    }
}

fn said(tree: &Tree, field: &RawField<'_>) -> String {
    match tree {
        Tree::One(leaf) => said_leaf(leaf, field),
        Tree::Many { null: true, .. } => "null".to_owned(),
        Tree::Many {
            dimensions, items, ..
        } => {
            let items: Vec<_> = items.iter().map(|leaf| said_leaf(leaf, field)).collect();
            format!("{dimensions:?}{items:?}")
        }
    }
}

fn said_leaf(leaf: &Leaf, field: &RawField<'_>) -> String {
    match leaf {
        Leaf::Fixed(bytes) => {
            let one = Array::new(field.builtin, 1, bytes).unwrap();
            format!("{:?}", one.iter().next().unwrap())
        }
        Leaf::Text(text) => format!("{text:?}"),
        Leaf::Structure { fields, .. } => {
            let structure = field.structure.unwrap();
            let fields: Vec<_> = fields
                .iter()
                .zip(structure.fields())
                .enumerate()
                .filter_map(|(index, (tree, field))| Some((index, said(tree.as_ref()?, field))))
                .collect();
            format!("{fields:?}")
        }
    }
}

fn found(value: RawValue<'_>, field: &RawField<'_>, dialect: RawDialect) -> String {
    let items = |items: &mut dyn Iterator<Item = Scalar<'_>>| -> Vec<String> {
        items
            .map(|item| found_scalar(item, field, dialect))
            .collect()
    };
    let (null, mut dimensions, items) = match value {
        RawValue::Variant(Variant::Scalar(scalar)) => return found_scalar(scalar, field, dialect),
        RawValue::Variant(Variant::Array(array)) => {
            (array.is_null(), vec![], items(&mut array.iter()))
        }
        RawValue::Variant(Variant::Matrix(matrix)) => {
            let elements = matrix.elements();
            let dimensions = matrix.dimensions().collect();
            (false, dimensions, items(&mut elements.iter()))
        }
        RawValue::Variant(Variant::Null) => return "Null".to_owned(),
        RawValue::Array(array) => {
            let dimensions = array.dimensions().collect();
            assert_eq!(array.iter().count(), array.len());
            (array.is_null(), dimensions, items(&mut array.iter()))
        }
    };
    if null {
        return "null".to_owned();
    }
    if dimensions.is_empty() {
        dimensions.push(u32::try_from(items.len()).unwrap());
    }
    format!("{dimensions:?}{items:?}")
}

fn found_scalar(scalar: Scalar<'_>, field: &RawField<'_>, dialect: RawDialect) -> String {
    if let Scalar::String(text) = scalar {
        return format!("{:?}", text.map(str::as_bytes));
    }
    if let Scalar::ByteString(bytes) = scalar {
        return format!("{bytes:?}");
    }
    let Scalar::ExtensionObject(object) = scalar else {
        return format!("{scalar:?}");
    };
    let structure = field.structure.unwrap();
    assert_eq!(object.type_id, structure.type_id());
    let ExtensionBody::Binary(body) = object.body else {
        return "no body".to_owned();
    };
    let fields: Vec<_> = structure
        .members(body, dialect)
        .unwrap()
        .map(|member| {
            let (index, value) = member.unwrap();
            (index, found(value, &structure.fields()[index], dialect))
        })
        .collect();
    format!("{fields:?}")
}

/// A layout, a payload, and its values.
#[derive(Debug)]
struct Sample {
    fields: &'static [RawField<'static>],
    dialect: RawDialect,
    trees: Vec<Tree>,
    payload: Vec<u8>,
}

impl Sample {
    fn new(bytes: Vec<u8>, dialect: RawDialect) -> Self {
        let mut tape = Tape {
            bytes: bytes.into_iter(),
        };
        let fields = layout(&mut tape);
        let form = Form::of(dialect);
        let mut payload = Vec::new();
        let trees = fields
            .iter()
            .map(|field| {
                let tree = tree(&mut tape, field, form);
                lay_out(&tree, field, form, &mut payload);
                tree
            })
            .collect();
        Self {
            fields,
            dialect,
            trees,
            payload,
        }
    }

    fn layout(&self) -> RawLayout<'static> {
        RawLayout::new(self.fields).unwrap()
    }

    fn read<'p>(&self, payload: &'p [u8]) -> Result<Vec<RawValue<'p>>, DecodeError> {
        self.layout().read(payload, self.dialect).collect()
    }

    fn found(&self, values: &[RawValue<'_>]) -> Vec<String> {
        values
            .iter()
            .zip(self.fields)
            .map(|(value, field)| found(*value, field, self.dialect))
            .collect()
    }
}

fn samples() -> impl Strategy<Value = Sample> {
    let dialect = prop_oneof![Just(Standard), Just(Open62541)];
    (vec(any::<u8>(), 0..160), dialect).prop_map(|(bytes, dialect)| Sample::new(bytes, dialect))
}

/// Returns the elements of a tree in the encoding of an array of the crate, and their number.
fn packed(tree: &Tree, field: &RawField<'_>, form: Form) -> Option<(Vec<u8>, usize)> {
    let Tree::Many { items, .. } = tree else {
        return None;
    };
    let mut bytes = Vec::new();
    for leaf in items {
        match field.structure {
            None => lay_out_leaf(leaf, field, Form::Plain, &mut bytes),
            Some(structure) => {
                let uadp::NodeIdValue::Numeric(id) = structure.type_id().identifier else {
                    return None;
                };
                let [a, b, c, d] = id.to_le_bytes();
                bytes.extend([2, 2, 0, a, b, c, d, 1]);
                let mut body = Vec::new();
                lay_out_leaf(leaf, field, form, &mut body);
                bytes.extend(u32::try_from(body.len()).unwrap().to_le_bytes());
                bytes.extend(body);
            }
        }
    }
    Some((bytes, items.len()))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1024))]

    #[test]
    fn a_payload_is_read_as_what_was_laid_out_and_written_back(sample in samples()) {
        let values = sample.read(&sample.payload).unwrap();
        let said: Vec<_> = sample.trees.iter().zip(sample.fields).map(|(tree, field)| said(tree, field)).collect();
        prop_assert_eq!(sample.found(&values), said);
        let mut written = vec![0xA5];
        sample.layout().write(&mut written, sample.dialect, values).unwrap();
        prop_assert_eq!(&written[1..], &sample.payload);
    }

    #[test]
    fn a_fixed_layout_has_the_size_and_offsets_it_says(sample in samples()) {
        let form = Form::of(sample.dialect);
        let layout = sample.layout();
        let mut at = Some(0);
        for (index, field) in sample.fields.iter().enumerate() {
            prop_assert_eq!(layout.field_offset(index, sample.dialect), at);
            at = at.zip(size(field, form)).map(|(at, size)| at + size);
        }
        prop_assert_eq!(layout.fixed_size(sample.dialect), at);
        if let Some(size) = at {
            prop_assert_eq!(sample.payload.len(), size);
        }
    }

    #[test]
    fn a_payload_cut_short_does_not_pass_for_a_whole_one(sample in samples()) {
        for len in 1..sample.payload.len() {
            let result = sample.read(&sample.payload[..len]);
            prop_assert!(result.is_err(), "{} of {} bytes: {:?}", len, sample.payload.len(), result);
        }
    }

    #[test]
    fn zero_behind_a_payload_is_padding_and_anything_else_is_noticed(sample in samples(), tail in 1..=255u8) {
        let mut payload = sample.payload.clone();
        payload.push(0);
        let padded = sample.read(&payload).map(|values| sample.found(&values));
        let values = sample.read(&sample.payload).map(|values| sample.found(&values));
        prop_assert_eq!(padded, values);
        payload.push(tail);
        prop_assert_eq!(sample.read(&payload), Err(DecodeError::TrailingBytes(2)));
    }

    #[test]
    fn arrays_made_elsewhere_are_written_as_those_that_were_read(sample in samples()) {
        let form = Form::of(sample.dialect);
        let read = sample.read(&sample.payload).unwrap();
        let arrays: Vec<_> = sample.trees.iter().zip(sample.fields).map(|(tree, field)| packed(tree, field, form)).collect();
        let dimensions: Vec<Vec<[u8; 4]>> = sample.trees.iter().map(|tree| match tree {
            Tree::Many { dimensions, .. } => dimensions.iter().map(|size| size.to_le_bytes()).collect(),
            Tree::One(_) => Vec::new(),
        }).collect();
        let mut values = Vec::new();
        for (index, (array, tree)) in arrays.iter().zip(&sample.trees).enumerate() {
            let builtin = sample.fields[index].builtin;
            values.push(match (array, tree) {
                (Some((bytes, len)), Tree::Many { null: false, .. }) => {
                    let array = Array::new(builtin, *len, bytes).unwrap();
                    match dimensions[index].len() {
                        1 => Variant::Array(array).into(),
                        _ => Variant::Matrix(Matrix::new(array, &dimensions[index]).unwrap()).into(),
                    }
                }
                (_, Tree::Many { null: true, .. }) => Variant::Array(Array::null(builtin)).into(),
                _ => read[index],
            });
        }
        let mut written = Vec::new();
        sample.layout().write(&mut written, sample.dialect, values).unwrap();
        prop_assert_eq!(&written, &sample.payload);
    }

    #[test]
    fn a_structure_becomes_its_plain_body_and_back(sample in samples()) {
        let form = Form::of(sample.dialect);
        for (tree, field) in sample.trees.iter().zip(sample.fields) {
            let (Tree::One(leaf), Some(structure)) = (tree, field.structure) else { continue };
            let mut raw = Vec::new();
            lay_out_leaf(leaf, field, form, &mut raw);
            let mut plain = Vec::new();
            lay_out_leaf(leaf, field, Form::Plain, &mut plain);
            let mut out = Vec::new();
            structure.to_plain(&raw, sample.dialect, &mut out).unwrap();
            prop_assert_eq!(&out, &plain);
            out.clear();
            structure.from_plain(&plain, sample.dialect, &mut out).unwrap();
            prop_assert_eq!(&out, &raw);
        }
    }

    #[test]
    fn random_bytes_do_not_panic(sample in samples(), payload in vec(any::<u8>(), 0..120)) {
        if let Ok(values) = sample.read(&payload) {
            sample.found(&values);
        }
    }

    #[test]
    fn what_is_read_of_changed_bytes_is_written_so_that_it_is_read_again(
        sample in samples(),
        changes in vec((any::<proptest::sample::Index>(), any::<u8>()), 1..4),
    ) {
        let mut payload = sample.payload.clone();
        for (at, byte) in changes {
            if !payload.is_empty() {
                let at = at.index(payload.len());
                payload[at] = byte;
            }
        }
        let Ok(values) = sample.read(&payload) else { return Ok(()) };
        let expected = sample.found(&values);
        let mut written = Vec::new();
        match sample.layout().write(&mut written, sample.dialect, values) {
            Ok(()) => prop_assert_eq!(sample.found(&sample.read(&written).unwrap()), expected),
            // A short array is decoded, but not encoded.
            Err(error) => prop_assert!(sample.dialect == Open62541, "{}", error),
        }
    }
}
