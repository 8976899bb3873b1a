//! A field of a message in an array.

use std::convert::Infallible;

use uadp::{BuiltinType, Scalar};

use super::shaped::{NotPassed, ShapingSink, wide};
use super::{ArrayPart, MessagePlan, Op, read};
use crate::{ArrayRank, FieldSink, Leaf, MessageType, PlanError, ReadError, TypeName, ValueFault};

/// Selects a field of a message in an array.
#[derive(Clone, Debug)]
pub(super) struct Inside {
    which: Which,
    /// Number of values of the message before the field.
    target: usize,
    /// The field in its message.
    pub(super) leaf: Leaf,
    /// Path of the array, for errors.
    array: String,
}

#[derive(Clone, Debug)]
enum Which {
    At(usize),
    /// The message whose value with the index `by` is the text `name`.
    Named {
        by: usize,
        name: String,
    },
}

impl Inside {
    pub(super) fn compile(
        message: &MessageType,
        array: &str,
        (of, inner): (&ArrayPart, &str),
    ) -> Result<Self, PlanError> {
        let fault = |what: &'static str| PlanError::Shape {
            name: message.name().clone(),
            path: array.to_owned(),
            what,
        };
        let Some((name, leaves)) = message.element_leaves(array) else {
            return Err(fault(
                "is not an array of messages, so its elements have no fields",
            ));
        };
        let place = |path: &str| {
            let at = leaves.iter().position(|leaf| leaf.path == path);
            let found = at.and_then(|at| Some((at, leaves.get(at)?)));
            found.ok_or_else(|| PlanError::UnknownField {
                name: name.clone(),
                path: path.to_owned(),
                known: leaves.iter().map(|leaf| leaf.path.clone()).collect(),
            })
        };
        let (target, leaf) = place(inner)?;
        let mut last = target;
        let which = match of {
            ArrayPart::Element(at) => Which::At(wide(*at)),
            ArrayPart::Named { by, name } => {
                let (by, text) = place(by)?;
                if (text.builtin, text.rank) != (BuiltinType::String, ArrayRank::Scalar) {
                    return Err(fault("is selected by a field that is not a text"));
                }
                last = last.max(by);
                Which::Named {
                    by,
                    name: name.clone(),
                }
            }
            ArrayPart::Slice { .. } | ArrayPart::Inside { .. } => {
                return Err(fault("selects a field of a single message, not of several"));
            }
        };
        // The values of messages in the message would be counted among its own values.
        let mut before = leaves.iter().take(last + 1);
        if before.any(|leaf| leaf.builtin == BuiltinType::ExtensionObject) {
            return Err(fault("has an array of messages in each, before the field"));
        }
        Ok(Self {
            which,
            target,
            leaf: leaf.clone(),
            array: array.to_owned(),
        })
    }

    /// Returns the index of the message in this payload.
    pub(super) fn find<E>(
        &self,
        plan: &MessagePlan,
        ops: &[Op],
        payload: &[u8],
    ) -> Result<usize, ReadError<E>> {
        let (by, name) = match &self.which {
            Which::At(at) => return Ok(*at),
            Which::Named { by, name } => (*by, name),
        };
        let mut finder = Counting {
            wanted: by,
            at: 0,
            value: 0,
            taken: false,
            with: Finder { name, found: None },
        };
        read::read(plan, ops, payload, &mut finder).map_err(|error| match error {
            ReadError::Malformed { field, at, fault } => ReadError::Malformed { field, at, fault },
            ReadError::Value { field, fault } => ReadError::Value { field, fault },
            ReadError::Sink { source, .. } => match source {},
        })?;
        finder.with.found.ok_or_else(|| ReadError::Value {
            field: self.array.clone(),
            fault: ValueFault::NoName(name.clone()),
        })
    }

    /// Returns a sink that passes on only the field of that message.
    pub(super) fn picking<'p, 's, S: FieldSink>(
        &self,
        at: usize,
        sink: &'p mut ShapingSink<'s, S>,
    ) -> impl FieldSink<Error = NotPassed<S::Error>> + use<'p, 's, S> {
        Counting {
            wanted: self.target,
            at: 0,
            value: 0,
            taken: false,
            with: Picker { at, sink },
        }
    }
}

/// Counts messages and their values, and passes on one value of each message.
struct Counting<W> {
    /// Index of the value that is passed on.
    wanted: usize,
    /// Index of the message.
    at: usize,
    /// Index of the next value in the message.
    value: usize,
    /// Whether the next elements belong to the value that is passed on.
    taken: bool,
    with: W,
}

/// The use of the selected value of each message.
trait ValueUse {
    type Error;
    fn count(&mut self, _messages: usize) -> Result<(), Self::Error> {
        Ok(())
    }
    fn scalar(&mut self, at: usize, value: Scalar<'_>) -> Result<(), Self::Error>;
    fn packed_array(
        &mut self,
        at: usize,
        element: BuiltinType,
        packed: (usize, &[u8]),
    ) -> Result<(), Self::Error>;
    fn array(&mut self, at: usize, element: BuiltinType, count: usize) -> Result<(), Self::Error>;
    fn element(&mut self, at: usize, value: Scalar<'_>) -> Result<(), Self::Error>;
}

impl<W> Counting<W> {
    const fn step(&mut self) -> bool {
        let is_it = self.value == self.wanted;
        self.value += 1;
        is_it
    }
}

impl<W: ValueUse> FieldSink for Counting<W> {
    type Error = W::Error;

    fn scalar(&mut self, value: Scalar<'_>) -> Result<(), W::Error> {
        if self.step() {
            return self.with.scalar(self.at, value);
        }
        Ok(())
    }

    fn packed_array(
        &mut self,
        element: BuiltinType,
        count: usize,
        bytes: &[u8],
    ) -> Result<(), W::Error> {
        if self.step() {
            return self.with.packed_array(self.at, element, (count, bytes));
        }
        Ok(())
    }

    fn array(&mut self, element: BuiltinType, count: usize) -> Result<(), W::Error> {
        self.taken = self.step();
        if self.taken {
            return self.with.array(self.at, element, count);
        }
        Ok(())
    }

    fn element(&mut self, value: Scalar<'_>) -> Result<(), W::Error> {
        if self.taken {
            return self.with.element(self.at, value);
        }
        Ok(())
    }

    fn structures(&mut self, _: &TypeName, count: usize) -> Result<(), W::Error> {
        self.with.count(count)
    }

    fn begin_structure(&mut self, _: &TypeName) -> Result<(), W::Error> {
        (self.value, self.taken) = (0, false);
        Ok(())
    }

    fn end_structure(&mut self) -> Result<(), W::Error> {
        self.at += 1;
        Ok(())
    }
}

/// Finds the message with a text.
struct Finder<'n> {
    name: &'n str,
    found: Option<usize>,
}

impl ValueUse for Finder<'_> {
    type Error = Infallible;

    fn scalar(&mut self, at: usize, value: Scalar<'_>) -> Result<(), Infallible> {
        if self.found.is_none() && value == Scalar::String(Some(self.name)) {
            self.found = Some(at);
        }
        Ok(())
    }

    fn packed_array(
        &mut self,
        _: usize,
        _: BuiltinType,
        _: (usize, &[u8]),
    ) -> Result<(), Infallible> {
        Ok(())
    }

    fn array(&mut self, _: usize, _: BuiltinType, _: usize) -> Result<(), Infallible> {
        Ok(())
    }

    fn element(&mut self, _: usize, _: Scalar<'_>) -> Result<(), Infallible> {
        Ok(())
    }
}

/// Passes on the value of a message.
struct Picker<'p, 's, S> {
    at: usize,
    sink: &'p mut ShapingSink<'s, S>,
}

impl<S: FieldSink> ValueUse for Picker<'_, '_, S> {
    type Error = NotPassed<S::Error>;

    fn count(&mut self, messages: usize) -> Result<(), Self::Error> {
        if self.at < messages {
            return Ok(());
        }
        Err(NotPassed::Value(ValueFault::Absent {
            at: self.at,
            found: messages,
        }))
    }

    fn scalar(&mut self, at: usize, value: Scalar<'_>) -> Result<(), Self::Error> {
        if at == self.at {
            return self.sink.scalar(value);
        }
        Ok(())
    }

    fn packed_array(
        &mut self,
        at: usize,
        element: BuiltinType,
        (count, bytes): (usize, &[u8]),
    ) -> Result<(), Self::Error> {
        if at == self.at {
            return self.sink.packed_array(element, count, bytes);
        }
        Ok(())
    }

    fn array(&mut self, at: usize, element: BuiltinType, count: usize) -> Result<(), Self::Error> {
        if at == self.at {
            return self.sink.array(element, count);
        }
        Ok(())
    }

    fn element(&mut self, at: usize, value: Scalar<'_>) -> Result<(), Self::Error> {
        if at == self.at {
            return self.sink.element(value);
        }
        Ok(())
    }
}
