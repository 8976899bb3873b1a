//! Several fields of a message, each with an optional part and conversion.

use std::collections::BTreeMap;
use std::sync::Arc;

use uadp::{BuiltinType, Scalar};

use super::{
    ArrayPart, Conversion, Literal, MessagePlan, Op, PlanStep, Selection, Wire, given, ops, range,
    write,
};
use crate::definition::Primitive;
use crate::{
    FieldSink, FieldSupplier, Leaf, MessageType, PlanError, ReadError, SourceError, WriteError,
    WriteFault,
};

/// A selected field, of several.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Selected {
    /// The path of a field, or of a nested message.
    pub field: String,
    /// The part of an array; `None` for the whole field.
    pub part: Option<ArrayPart>,
    /// The conversion of each value.
    pub conversion: Conversion,
}

impl Selected {
    /// Selects a whole field without conversion.
    #[must_use]
    pub fn whole(field: &str) -> Self {
        Self {
            field: field.to_owned(),
            part: None,
            conversion: Conversion::default(),
        }
    }

    /// Returns whether the field is transferred unchanged.
    #[must_use]
    pub fn is_plain(&self) -> bool {
        self.part.is_none() && self.conversion.is_none()
    }

    fn selection(&self) -> Selection {
        if self.is_plain() {
            return Selection::Field(self.field.clone());
        }
        Selection::Value {
            field: self.field.clone(),
            part: self.part.clone(),
            conversion: self.conversion,
        }
    }
}

/// Fields that are read in the given order, independent of their order in the message.
#[derive(Clone, Debug)]
pub(super) struct Several {
    plans: Vec<MessagePlan>,
    /// The steps and conversions of the written fields, or the reason for which nothing can be
    /// written.
    write: Result<(Vec<Op>, Vec<Shaping>), WriteFault>,
}

/// The conversion of a field with its builtin type in OPC UA, if it is converted.
type Shaping = Option<(Conversion, BuiltinType)>;

/// Returns the body of a plan, and the transferred fields in the given order. In a written message
/// the fields of `rest` have these constants.
pub(super) fn compile(
    message: &Arc<MessageType>,
    (selected, rest): (&[Selected], &BTreeMap<String, Literal>),
    wire: Wire,
) -> Result<(super::Body, Vec<Leaf>), PlanError> {
    let mut plans = Vec::new();
    let mut leaves = Vec::new();
    let mut shapings = Vec::new();
    let mut ranges: Vec<std::ops::Range<usize>> = Vec::new();
    for one in selected {
        let plan = MessagePlan::compile(message, &one.selection(), wire)?;
        let converted = !one.conversion.is_none();
        shapings.extend(
            plan.leaves()
                .iter()
                .map(|leaf| converted.then_some((one.conversion, leaf.builtin))),
        );
        leaves.extend_from_slice(plan.leaves());
        ranges.push(range(message, &one.field)?);
        plans.push(plan);
    }
    let constants = given(message, (selected, rest))?;
    let in_order = ranges.is_sorted_by(|a, b| a.end <= b.start);
    let write = if selected.iter().any(|one| one.part.is_some()) {
        Err(WriteFault::Part)
    } else if !in_order {
        Err(WriteFault::Order)
    } else {
        Ok((ops(message, (ranges, constants), wire)?, shapings))
    };
    let plain = selected.iter().all(Selected::is_plain);
    let body = match write {
        Ok((ops, _)) if plain => super::Body::Steps(ops),
        Ok((mut ops, shapings)) => {
            convert(&mut ops, message, &leaves, &shapings);
            let write = Ok((ops, shapings));
            super::Body::Several(Box::new(Several { plans, write }))
        }
        write => super::Body::Several(Box::new(Several { plans, write })),
    };
    Ok((body, leaves))
}

/// Changes the steps of converted arrays, so that their elements are passed on individually.
fn convert(ops: &mut [Op], message: &MessageType, leaves: &[Leaf], shapings: &[Shaping]) {
    let converted: Vec<&str> = leaves
        .iter()
        .zip(shapings)
        .filter(|(_, shaping)| shaping.is_some())
        .map(|(leaf, _)| leaf.path.as_str())
        .collect();
    let is_converted = |leaf: usize| {
        let leaf = message.leaves().get(leaf);
        leaf.is_some_and(|leaf| converted.contains(&leaf.path.as_str()))
    };
    for op in ops {
        if let PlanStep::Packed(number, len) = op.what
            && op.carry
            && is_converted(op.leaf)
        {
            op.what = PlanStep::Many(Primitive::Number(number), len);
        }
    }
}

impl Several {
    pub(super) fn read<S: FieldSink>(
        &self,
        payload: &[u8],
        sink: &mut S,
    ) -> Result<(), ReadError<S::Error>> {
        self.plans
            .iter()
            .try_for_each(|plan| plan.read(payload, sink))
    }

    pub(super) fn write<'a, S: FieldSupplier<'a>>(
        &self,
        plan: &MessagePlan,
        source: &mut S,
        out: &mut Vec<u8>,
    ) -> Result<(), WriteError> {
        match &self.write {
            Ok((ops, shapings)) => {
                let mut converting = ConvertingSource {
                    source,
                    shapings: shapings.iter(),
                    now: None,
                    inside: false,
                };
                write::write(plan, ops, &mut converting, out)
            }
            Err(fault) => Err(WriteError {
                field: plan
                    .leaves()
                    .first()
                    .map(|leaf| leaf.path.clone())
                    .unwrap_or_default(),
                fault: fault.clone(),
            }),
        }
    }
}

/// A source that applies a separate conversion to each field.
struct ConvertingSource<'s, S> {
    source: &'s mut S,
    /// Conversions of the remaining fields.
    shapings: std::slice::Iter<'s, Shaping>,
    /// Conversion of the current field.
    now: Shaping,
    /// Whether the source is within a structure, in which nothing is converted.
    inside: bool,
}

impl<S> ConvertingSource<'_, S> {
    /// Advances to the next field, unless within a structure.
    fn step(&mut self) {
        if !self.inside {
            self.now = self.shapings.next().copied().flatten();
        }
    }

    fn outside(&self, expected: BuiltinType) -> BuiltinType {
        match self.now {
            Some((_, outside)) if !self.inside => outside,
            Some(_) | None => expected,
        }
    }

    fn back<'a>(&self, value: Scalar<'a>, field: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        match self.now {
            Some((conversion, _)) if !self.inside => {
                conversion.back(value, field).map_err(SourceError::Value)
            }
            Some(_) | None => Ok(value),
        }
    }
}

impl<'a, S: FieldSupplier<'a>> FieldSupplier<'a> for ConvertingSource<'_, S> {
    fn scalar(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        self.step();
        let value = self.source.scalar(self.outside(expected))?;
        self.back(value, expected)
    }

    fn packed_array(&mut self, expected: BuiltinType) -> Result<(usize, &'a [u8]), SourceError> {
        self.step();
        self.source.packed_array(expected)
    }

    fn array(&mut self, expected: BuiltinType) -> Result<usize, SourceError> {
        self.step();
        self.source.array(self.outside(expected))
    }

    fn element(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        let value = self.source.element(self.outside(expected))?;
        self.back(value, expected)
    }

    fn structures(&mut self) -> Result<usize, SourceError> {
        self.step();
        self.source.structures()
    }

    fn structure(&mut self) -> Result<(), SourceError> {
        self.step();
        self.inside = true;
        self.source.structure()
    }

    fn begin_structure(&mut self) -> Result<(), SourceError> {
        self.inside = true;
        self.source.begin_structure()
    }

    fn end_structure(&mut self) -> Result<(), SourceError> {
        self.inside = false;
        self.source.end_structure()
    }

    fn finish(&mut self) -> Result<(), SourceError> {
        self.source.finish()
    }
}
