//! Conversion of OPC UA structures that hold a few numbers into arrays of numbers. A frame
//! (ThreeDFrame) of a robot of the earlier system corresponds to the six numbers of a position in
//! this crate.

use plant_opcua::types::{
    Array, DataTypeId, ExtensionObject, NodeId, Range, ThreeDCartesianCoordinates, ThreeDFrame,
    ThreeDOrientation, ThreeDVector, Variant, VariantScalarTypeId,
};

use crate::value::{Builtin, SkillValue};

/// The structure that holds the numbers of a variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Packed {
    what: What,
    /// Whether the variable is an array of these structures.
    many: bool,
}

/// A structure (OPC 10000-5, 12.23 to 12.30; OPC 10000-8, 5.6.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum What {
    /// x, y, z
    Vector,
    /// x, y, z
    Coordinates,
    /// a, b, c
    Orientation,
    /// x, y, z, a, b, c
    Frame,
    /// low, high
    Range,
}

/// Returns the six numbers of a frame (3DFrame), or `None` for other values.
pub(crate) fn frame(value: &Variant) -> Option<SkillValue> {
    let frame = Packed {
        what: What::Frame,
        many: false,
    };
    frame.unpack(value)
}

impl Packed {
    /// Returns the structure of a variable of this data type, if it is supported.
    pub(super) fn of(data_type: &NodeId, many: bool) -> Option<Self> {
        let known = [
            (DataTypeId::ThreeDVector, What::Vector),
            (DataTypeId::ThreeDCartesianCoordinates, What::Coordinates),
            (DataTypeId::ThreeDOrientation, What::Orientation),
            (DataTypeId::ThreeDFrame, What::Frame),
            (DataTypeId::Range, What::Range),
        ];
        let id = (data_type.namespace == 0).then(|| data_type.as_u32())??;
        let (_, what) = known.into_iter().find(|(of, _)| *of as u32 == id)?;
        Some(Self { what, many })
    }

    /// Returns the number of numbers; `None` for an array.
    pub(super) const fn length(self) -> Option<u32> {
        if self.many {
            return None;
        }
        Some(match self.what {
            What::Vector | What::Coordinates | What::Orientation => 3,
            What::Frame => 6,
            What::Range => 2,
        })
    }

    /// Returns the numbers of a value; `None` if the value has another type.
    pub(super) fn unpack(self, shown: &Variant) -> Option<SkillValue> {
        let mut numbers = Vec::new();
        let mut take = |one: &Variant| {
            let Variant::ExtensionObject(object) = one else {
                return None;
            };
            numbers.extend(self.what.numbers(object)?);
            Some(())
        };
        match (self.many, shown) {
            (true, Variant::Array(array)) => array.values.iter().try_for_each(&mut take)?,
            _ => take(shown)?,
        }
        let numbers = numbers.into_iter().map(SkillValue::Double);
        Some(SkillValue::Array(Builtin::Double, numbers.collect()))
    }

    /// Returns the value to write to the variable.
    ///
    /// # Errors
    /// The value has another number of numbers.
    pub(super) fn pack(self, value: &SkillValue) -> Result<Variant, UnfitNumbers> {
        let numbers = value.as_f64s().unwrap_or_default();
        let each = self.what.names().len();
        let fits = match self.many {
            true => numbers.len().is_multiple_of(each),
            false => numbers.len() == each,
        };
        if !fits {
            return Err(UnfitNumbers {
                names: self.what.names(),
                many: self.many,
                given: numbers.len(),
            });
        }
        let structures = numbers
            .chunks(each)
            .map(|numbers| self.what.object(numbers));
        let mut structures = structures.map(Variant::ExtensionObject);
        if self.many {
            return Ok(Variant::Array(Box::new(Array {
                value_type: VariantScalarTypeId::ExtensionObject,
                values: structures.collect(),
                dimensions: None,
            })));
        }
        Ok(structures.next().unwrap_or(Variant::Empty))
    }
}

/// The numbers of a value do not fill a structure.
#[derive(Debug, thiserror::Error)]
#[error(
    "it is {}{}, and {given} numbers were given",
    if *many { "any number of times " } else { "" },
    names.join(", ")
)]
pub(super) struct UnfitNumbers {
    /// The fields of the structure.
    names: &'static [&'static str],
    /// Whether the value is an array of structures.
    many: bool,
    /// The number of given numbers.
    given: usize,
}

impl What {
    const fn names(self) -> &'static [&'static str] {
        match self {
            Self::Vector | Self::Coordinates => &["x", "y", "z"],
            Self::Orientation => &["a", "b", "c"],
            Self::Frame => &["x", "y", "z", "a", "b", "c"],
            Self::Range => &["low", "high"],
        }
    }

    fn numbers(self, object: &ExtensionObject) -> Option<Vec<f64>> {
        Some(match self {
            Self::Vector => {
                let of: &ThreeDVector = object.inner_as()?;
                vec![of.x, of.y, of.z]
            }
            Self::Coordinates => {
                let of: &ThreeDCartesianCoordinates = object.inner_as()?;
                vec![of.x, of.y, of.z]
            }
            Self::Orientation => {
                let of: &ThreeDOrientation = object.inner_as()?;
                vec![of.a, of.b, of.c]
            }
            Self::Frame => {
                let of: &ThreeDFrame = object.inner_as()?;
                let (at, turned) = (&of.cartesian_coordinates, &of.orientation);
                vec![at.x, at.y, at.z, turned.a, turned.b, turned.c]
            }
            Self::Range => {
                let of: &Range = object.inner_as()?;
                vec![of.low, of.high]
            }
        })
    }

    /// Creates the structure from its numbers.
    fn object(self, numbers: &[f64]) -> ExtensionObject {
        let at = |place: usize| numbers.get(place).copied().unwrap_or_default();
        let [x, y, z] = [at(0), at(1), at(2)];
        let coordinates = || ThreeDCartesianCoordinates { x, y, z };
        match self {
            Self::Vector => ExtensionObject::from_message(ThreeDVector { x, y, z }),
            Self::Coordinates => ExtensionObject::from_message(coordinates()),
            Self::Orientation => {
                ExtensionObject::from_message(ThreeDOrientation { a: x, b: y, c: z })
            }
            Self::Frame => ExtensionObject::from_message(ThreeDFrame {
                cartesian_coordinates: coordinates(),
                orientation: ThreeDOrientation {
                    a: at(3),
                    b: at(4),
                    c: at(5),
                },
            }),
            Self::Range => ExtensionObject::from_message(Range { low: x, high: y }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn doubles(numbers: &[f64]) -> SkillValue {
        let numbers = numbers.iter().copied().map(SkillValue::Double);
        SkillValue::Array(Builtin::Double, numbers.collect())
    }

    #[test]
    fn what_is_packed_is_unpacked_as_it_was_and_has_its_length() {
        for (id, many, numbers) in [
            (DataTypeId::ThreeDVector, false, &[1.0, 2.0, 3.0][..]),
            (
                DataTypeId::ThreeDCartesianCoordinates,
                false,
                &[1.0, 2.0, 3.0],
            ),
            (DataTypeId::ThreeDOrientation, false, &[1.0, 2.0, 3.0]),
            (
                DataTypeId::ThreeDFrame,
                false,
                &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
            ),
            (DataTypeId::Range, false, &[-1.0, 1.0]),
            (DataTypeId::Range, true, &[-1.0, 1.0, -2.0, 2.0]),
            (DataTypeId::Range, true, &[]),
        ] {
            let packed = Packed::of(&id.into(), many).unwrap();
            let value = doubles(numbers);
            assert_eq!(packed.unpack(&packed.pack(&value).unwrap()), Some(value));
            let length = packed
                .length()
                .map(|length| usize::try_from(length).unwrap());
            assert_eq!(length, (!many).then_some(numbers.len()), "{id:?}");
        }
        assert_eq!(Packed::of(&DataTypeId::EUInformation.into(), false), None);
    }

    #[test]
    fn too_few_numbers_are_told_with_what_they_are() {
        let frame = Packed::of(&DataTypeId::ThreeDFrame.into(), false).unwrap();
        let fault = frame.pack(&doubles(&[1.0, 2.0, 3.0])).unwrap_err();
        assert_eq!(
            fault.to_string(),
            "it is x, y, z, a, b, c, and 3 numbers were given"
        );
        let bounds = Packed::of(&DataTypeId::Range.into(), true).unwrap();
        assert!(bounds.pack(&doubles(&[1.0])).is_err());
        assert_eq!(frame.unpack(&bounds.pack(&doubles(&[])).unwrap()), None);
    }
}
