//! A message type compiled for one wire format and selection.

mod conversion;
mod inside;
mod literal;
mod read;
mod several;
mod shaped;
mod write;

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use uadp::{BuiltinType, Scalar};

pub use conversion::{Conversion, is_lossless};
use literal::{GivenConstant, Typed};
pub use literal::{Literal, constant};
pub use several::Selected;
use several::Several;
pub use shaped::ArrayPart;
use shaped::Shaped;

use crate::definition::{Arity, Number, Primitive};
use crate::resolve::{MessageShape, ShapeKind};
use crate::{
    ArrayRank, Dialect, FieldSink, FieldSupplier, Leaf, MessageType, PlanError, ReadError,
    TypeName, WriteError,
};

/// The wire format of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Wire {
    /// The body of a ROS 1 message, without its 4 byte length. Read to its last byte.
    Ros1,
    /// The 4 byte encapsulation header and the CDR. Both byte orders are read; little endian is
    /// written, padded with zeros to a multiple of 4. Bytes after the last field are ignored, as in
    /// DDS readers.
    Cdr,
}

/// The fields of a message that are transferred.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Selection {
    /// All fields.
    Whole,
    /// The field of that path, or all fields of the message at that path.
    Field(String),
    /// The field of that path, which is not a message: converted, and for an array optionally a
    /// part of it.
    Value {
        /// The path.
        field: String,
        /// The part of an array; `None` for the whole field.
        part: Option<ArrayPart>,
        /// The conversion of each value.
        conversion: Conversion,
    },
    /// Several fields, in that order; all other fields of a written message are zero or empty.
    Fields(Vec<Selected>),
    /// The message, or the message at that path, as a structure.
    Structure(Option<String>),
    /// A message of constants, to be written: `fields` take the value; without `fields` no value is
    /// transferred. The fields of `rest` have the given constants, all others are zero or empty.
    /// Reading is as with [`Selection::Fields`].
    Template {
        /// The fields that hold the value; empty if the message is always the same.
        fields: Vec<Selected>,
        /// Values by path of the field.
        rest: BTreeMap<String, Literal>,
    },
    /// The message as on the wire, as one ByteString. No field is checked, so the writer is
    /// responsible for the content. For CDR the encapsulation header is part of it.
    Bytes,
}

/// Reads and writes the messages of one type in one wire format.
///
/// Compile once, then share: a plan keeps no state between messages.
#[derive(Clone, Debug)]
pub struct MessagePlan {
    wire: Wire,
    body: Body,
    leaves: Vec<Leaf>,
    /// Paths of all fields, for errors; `Op::leaf` is an index into it.
    paths: Vec<String>,
}

#[derive(Clone, Debug)]
enum Body {
    Steps(Vec<Op>),
    /// Selected fields, unless all are transferred unchanged and in message order.
    Several(Box<Several>),
    /// A message as a structure.
    Structure(TypeName, Vec<Op>),
    /// A field that is converted or of which a part is transferred.
    Shaped(Box<Shaped>),
    /// The message is transferred unchanged.
    Bytes,
}

/// A step. The steps of a message in an array follow its [`PlanStep::Messages`].
#[derive(Clone, Debug)]
struct Op {
    what: PlanStep,
    /// Whether the value is transferred; otherwise it is skipped when read and zero when written.
    carry: bool,
    /// The written constant of a field that is not transferred.
    constant: Option<Box<Typed>>,
    /// Index of the field in the flattened message.
    leaf: usize,
}

#[derive(Clone, Debug)]
enum PlanStep {
    One(Primitive),
    /// The given number of steps after this step are single numbers of that kind, and all are
    /// transferred: they may be moved at once.
    Run(Number, u16),
    /// Array of elements with the same format on the wire and in OPC UA.
    Packed(Number, Len),
    /// Array of `uint8`: a ByteString.
    Bytes(Len),
    /// Array of strings, times or durations.
    Many(Primitive, Len),
    /// Array of messages.
    Messages {
        of: TypeName,
        len: Len,
        steps: usize,
        least: usize,
    },
    /// Bytes without meaning: `seq`, the byte of an empty message, and on ROS 1 all unselected
    /// bytes.
    Skip {
        align: usize,
        bytes: usize,
    },
}

/// Limit of elements without bytes over all arrays of a message: their number cannot be checked
/// against the length of the message.
const MAX_WITHOUT_BYTES: usize = 65_536;

#[derive(Clone, Copy, Debug)]
enum Len {
    Fixed(u32),
    Counted { bound: u32 },
}

impl MessagePlan {
    /// Compiles a plan.
    ///
    /// # Errors
    /// A path that the type does not have, a constant that is not a value of its field, or the wire
    /// format of the other ROS version.
    pub fn compile(
        message: &Arc<MessageType>,
        selection: &Selection,
        wire: Wire,
    ) -> Result<Self, PlanError> {
        match (message.dialect(), wire) {
            (Dialect::Ros1, Wire::Ros1) | (Dialect::Ros2, Wire::Cdr) => {}
            _ => {
                return Err(PlanError::Wire {
                    name: message.name().clone(),
                });
            }
        }
        let paths: Vec<String> = message
            .leaves()
            .iter()
            .map(|leaf| leaf.path.clone())
            .collect();
        let (body, leaves) = match selection {
            Selection::Bytes => return Ok(Self::bytes(wire)),
            Selection::Value {
                field,
                part,
                conversion,
            } => {
                let steps =
                    |selection: &Selection| steps(message, selection, wire).map(|(ops, _)| ops);
                let (shaped, leaf) = Shaped::compile(message, (field, part, conversion), steps)?;
                (Body::Shaped(Box::new(shaped)), vec![leaf])
            }
            Selection::Fields(selected) => {
                several::compile(message, (selected, &BTreeMap::new()), wire)?
            }
            Selection::Template { fields, rest } => {
                several::compile(message, (fields, rest), wire)?
            }
            Selection::Structure(path) => {
                let at = path.as_deref().unwrap_or_default();
                let Some(of) = message.message_at(at) else {
                    range(message, at)?;
                    return Err(PlanError::Shape {
                        name: message.name().clone(),
                        path: at.to_owned(),
                        what: "is not a message, and only a message can be a structure",
                    });
                };
                let inner = match path {
                    Some(path) => Selection::Field(path.clone()),
                    None => Selection::Whole,
                };
                let (ops, _) = steps(message, &inner, wire)?;
                let leaf = Leaf {
                    path: at.to_owned(),
                    builtin: BuiltinType::ExtensionObject,
                    rank: ArrayRank::Scalar,
                };
                (Body::Structure(of.clone(), ops), vec![leaf])
            }
            Selection::Whole | Selection::Field(_) => {
                let (ops, leaves) = steps(message, selection, wire)?;
                (Body::Steps(ops), leaves)
            }
        };
        Ok(Self {
            wire,
            body,
            leaves,
            paths,
        })
    }

    fn bytes(wire: Wire) -> Self {
        Self {
            wire,
            body: Body::Bytes,
            leaves: vec![Leaf::bytes()],
            paths: Vec::new(),
        }
    }

    /// Returns the transferred fields in order.
    pub fn leaves(&self) -> &[Leaf] {
        &self.leaves
    }

    /// Reads a message and passes each field to `sink`.
    ///
    /// A length is used only after comparison with the remaining bytes. After an error the sink may
    /// have received some fields already.
    pub fn read<S: FieldSink>(
        &self,
        payload: &[u8],
        sink: &mut S,
    ) -> Result<(), ReadError<S::Error>> {
        match &self.body {
            Body::Steps(ops) => read::read(self, ops, payload, sink),
            Body::Several(several) => several.read(payload, sink),
            Body::Structure(of, ops) => read::structure(self, (of, ops), payload, sink),
            Body::Shaped(shaped) => shaped.read(self, payload, sink),
            Body::Bytes => sink
                .scalar(Scalar::ByteString(Some(payload)))
                .map_err(|source| ReadError::Sink {
                    field: String::new(),
                    source,
                }),
        }
    }

    /// Takes the fields from `source` and appends the message to `out`; on error `out` is
    /// unchanged.
    pub fn write<'a, S: FieldSupplier<'a>>(
        &self,
        source: &mut S,
        out: &mut Vec<u8>,
    ) -> Result<(), WriteError> {
        match &self.body {
            Body::Steps(ops) => write::write(self, ops, source, out),
            Body::Several(several) => several.write(self, source, out),
            Body::Structure(_, ops) => write::structure(self, ops, source, out),
            Body::Shaped(shaped) => shaped.write(self, source, out),
            Body::Bytes => write::bytes(source, out),
        }
    }

    fn path(&self, leaf: Option<usize>) -> String {
        leaf.and_then(|leaf| self.paths.get(leaf))
            .cloned()
            .unwrap_or_default()
    }
}

/// Returns the steps of the whole message or one field, and the transferred fields.
fn steps(
    message: &Arc<MessageType>,
    selection: &Selection,
    wire: Wire,
) -> Result<(Vec<Op>, Vec<Leaf>), PlanError> {
    let carried = match selection {
        Selection::Field(path) => range(message, path)?,
        Selection::Whole => 0..message.leaves().len(),
        Selection::Value { .. }
        | Selection::Fields(_)
        | Selection::Structure(_)
        | Selection::Template { .. }
        | Selection::Bytes => 0..0,
    };
    let ops = ops(message, (vec![carried.clone()], BTreeMap::new()), wire)?;
    let leaves = message.leaves().get(carried).unwrap_or_default().to_vec();
    Ok((ops, leaves))
}

/// Returns the steps of a message with transferred fields and constants.
fn ops(
    message: &MessageType,
    (carried, given): (Vec<Range<usize>>, BTreeMap<usize, GivenConstant<'_>>),
    wire: Wire,
) -> Result<Vec<Op>, PlanError> {
    let mut compiler = Compiler::new(wire, carried);
    compiler.given = given;
    compiler.message(&message.shape, false);
    if let Some(fault) = compiler.fault {
        return Err(fault);
    }
    let ops = coalesced(&compiler.ops);
    write::try_constants(wire, &ops).map_err(|(leaf, fault)| PlanError::ConstantFault {
        name: message.name().clone(),
        path: message
            .leaves()
            .get(leaf)
            .map(|leaf| leaf.path.clone())
            .unwrap_or_default(),
        fault,
    })?;
    Ok(ops)
}

/// Returns the fields of a path: one field, or the consecutive fields of a message.
fn range(message: &MessageType, path: &str) -> Result<Range<usize>, PlanError> {
    let leaves = message.leaves();
    let inside = |leaf: &Leaf| leaf.is_inside(path);
    match leaves.iter().position(inside) {
        Some(first) => {
            let rest = leaves.iter().skip(first);
            Ok(first..first + rest.take_while(|leaf| inside(leaf)).count())
        }
        None => index(message, path).map(|at| at..at + 1),
    }
}

fn index(message: &MessageType, path: &str) -> Result<usize, PlanError> {
    message
        .leaves()
        .iter()
        .position(|leaf| leaf.path == path)
        .ok_or_else(|| PlanError::UnknownField {
            name: message.name().clone(),
            path: path.to_owned(),
            known: message
                .leaves()
                .iter()
                .map(|leaf| leaf.path.clone())
                .collect(),
        })
}

/// Returns the constants by the index of their field.
fn given<'m>(
    message: &'m MessageType,
    (fields, rest): (&[Selected], &'m BTreeMap<String, Literal>),
) -> Result<BTreeMap<usize, GivenConstant<'m>>, PlanError> {
    let each = rest.iter().map(|(path, literal)| {
        let at = index(message, path)?;
        let leaf = message.leaves().get(at);
        let takes = |one: &Selected| {
            one.field == *path || leaf.is_some_and(|leaf| leaf.is_inside(&one.field))
        };
        if fields.iter().any(takes) {
            return Err(PlanError::ConstantOfField {
                name: message.name().clone(),
                path: path.clone(),
            });
        }
        // An array of messages is empty even without a constant.
        let is_open = leaf.is_some_and(|leaf| {
            leaf.builtin == BuiltinType::ExtensionObject
                && leaf.rank == ArrayRank::Array { fixed: None }
        });
        let is_empty = matches!(literal, Literal::List(texts) if texts.is_empty());
        Ok((!is_open || !is_empty).then(|| (at, GivenConstant::new(message, path, literal))))
    });
    each.filter_map(Result::transpose).collect()
}

/// Inserts a [`PlanStep::Run`] before steps that may be moved at once.
fn coalesced(mut ops: &[Op]) -> Vec<Op> {
    let mut all = Vec::with_capacity(ops.len());
    while let Some((op, after)) = ops.split_first() {
        ops = after;
        match &op.what {
            PlanStep::Messages { steps, .. } => {
                let (body, after) = ops.split_at_checked(*steps).unwrap_or((ops, &[]));
                ops = after;
                let body = coalesced(body);
                let mut head = op.clone();
                if let PlanStep::Messages { steps, .. } = &mut head.what {
                    *steps = body.len();
                }
                all.push(head);
                all.extend(body);
            }
            PlanStep::One(Primitive::Number(number)) if op.carry && *number != Number::Bool => {
                let more = ops.iter().take_while(|next| {
                    let same =
                        matches!(next.what, PlanStep::One(Primitive::Number(n)) if n == *number);
                    same && next.carry && next.constant.is_none()
                });
                let more = more.count().min(usize::from(u16::MAX - 1));
                let (run, after) = ops.split_at_checked(more).unwrap_or((ops, &[]));
                ops = after;
                if let Ok(count) = u16::try_from(more + 1) {
                    all.push(Op {
                        what: PlanStep::Run(*number, count),
                        ..op.clone()
                    });
                }
                all.push(op.clone());
                all.extend_from_slice(run);
            }
            PlanStep::One(_)
            | PlanStep::Run(..)
            | PlanStep::Packed(..)
            | PlanStep::Bytes(_)
            | PlanStep::Many(..)
            | PlanStep::Skip { .. } => all.push(op.clone()),
        }
    }
    all
}

struct Compiler<'m> {
    wire: Wire,
    /// Ranges of transferred fields.
    carried: Vec<Range<usize>>,
    given: BTreeMap<usize, GivenConstant<'m>>,
    leaf: usize,
    ops: Vec<Op>,
    /// Start of the steps of the innermost message in an array.
    body: usize,
    /// The first error.
    fault: Option<PlanError>,
}

impl Compiler<'_> {
    const fn new(wire: Wire, carried: Vec<Range<usize>>) -> Self {
        Self {
            wire,
            carried,
            given: BTreeMap::new(),
            leaf: 0,
            ops: Vec::new(),
            body: 0,
            fault: None,
        }
    }

    /// Adds the steps of a message and returns its minimum length in bytes. `element`: whether the
    /// message is an element of an array.
    fn message(&mut self, shape: &MessageShape, element: bool) -> usize {
        if shape.fields.is_empty() && self.wire == Wire::Cdr {
            self.push(PlanStep::Skip { align: 1, bytes: 1 });
            return 1;
        }
        let mut least = 0;
        for field in &shape.fields {
            least += match &field.kind {
                ShapeKind::Sequence => {
                    self.push(PlanStep::Skip { align: 4, bytes: 4 });
                    4
                }
                ShapeKind::Primitive(primitive) => {
                    let bytes = self.primitive(*primitive, field.arity);
                    self.leaf += usize::from(!element);
                    bytes
                }
                ShapeKind::Message(inner) => match length(field.arity) {
                    None => self.message(inner, element),
                    Some(len) => {
                        let bytes = self.messages(inner, len);
                        self.leaf += usize::from(!element);
                        bytes
                    }
                },
            };
        }
        least
    }

    fn messages(&mut self, inner: &MessageShape, len: Len) -> usize {
        let head = self.ops.len();
        self.push(PlanStep::Messages {
            of: inner.name.clone(),
            len,
            steps: 0,
            least: 0,
        });
        let outer = std::mem::replace(&mut self.body, head + 1);
        let each = self.message(inner, true);
        // The following steps are not part of the element, so no skip of the element may be
        // extended.
        self.body = outer.max(self.ops.len());
        let all = self.ops.len() - head - 1;
        if let Some(Op {
            what: PlanStep::Messages { steps, least, .. },
            ..
        }) = self.ops.get_mut(head)
        {
            (*steps, *least) = (all, each);
        }
        match len {
            Len::Fixed(count) => each.saturating_mul(usize::try_from(count).unwrap_or(usize::MAX)),
            Len::Counted { .. } => 4,
        }
    }

    fn primitive(&mut self, primitive: Primitive, arity: Arity) -> usize {
        let text = matches!(primitive, Primitive::Text(_));
        let size = primitive.size();
        let Some(len) = length(arity) else {
            self.push(PlanStep::One(primitive));
            if !text {
                self.shorten(size);
            }
            return size;
        };
        self.push(match primitive {
            Primitive::Number(Number::UInt8) => PlanStep::Bytes(len),
            Primitive::Number(number) => PlanStep::Packed(number, len),
            Primitive::Clock(_) | Primitive::Text(_) => PlanStep::Many(primitive, len),
        });
        match len {
            Len::Fixed(count) => {
                let bytes = size.saturating_mul(usize::try_from(count).unwrap_or(usize::MAX));
                if !text {
                    self.shorten(bytes);
                }
                bytes
            }
            Len::Counted { .. } => 4,
        }
    }

    fn push(&mut self, what: PlanStep) {
        let carry = self.carried.iter().any(|range| range.contains(&self.leaf));
        let skip = matches!(what, PlanStep::Skip { .. });
        let constant = match self.given.get(&self.leaf).filter(|_| !skip) {
            Some(given) => match given.typed(&what) {
                Ok(typed) => Some(Box::new(typed)),
                Err(error) => {
                    self.fault.get_or_insert(error);
                    None
                }
            },
            None => None,
        };
        self.ops.push(Op {
            what,
            carry,
            constant,
            leaf: self.leaf,
        });
        if let Some(Op {
            what: PlanStep::Skip { bytes, .. },
            ..
        }) = self.ops.last()
        {
            self.shorten(*bytes);
        }
    }

    /// On ROS 1, which has no alignment, joins the last step, of `bytes` bytes, with the previous
    /// skip.
    fn shorten(&mut self, bytes: usize) {
        let skips = |op: &Op| {
            let passed = !op.carry && op.constant.is_none();
            passed || matches!(op.what, PlanStep::Skip { .. })
        };
        if self.wire != Wire::Ros1 || !self.ops.last().is_some_and(skips) {
            return;
        }
        let last = self.ops.pop();
        let mergeable = self.ops.len() > self.body;
        let joined = match self.ops.last_mut() {
            Some(Op {
                what: PlanStep::Skip { bytes: before, .. },
                ..
            }) if mergeable => {
                *before += bytes;
                true
            }
            _ => false,
        };
        if let Some(mut op) = last.filter(|_| !joined) {
            op.what = PlanStep::Skip { align: 1, bytes };
            self.ops.push(op);
        }
    }
}

fn length(arity: Arity) -> Option<Len> {
    match arity {
        Arity::One => None,
        Arity::Fixed(count) => Some(Len::Fixed(count)),
        Arity::Sequence { bound } => Some(Len::Counted {
            bound: bound.unwrap_or(u32::MAX),
        }),
    }
}

impl Primitive {
    /// Returns the alignment of a value in CDR.
    const fn align(self) -> usize {
        match self {
            Self::Number(number) => number.size(),
            Self::Clock(_) | Self::Text(_) => 4,
        }
    }
}
