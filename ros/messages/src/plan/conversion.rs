//! Conversion of numbers and Booleans between a field and OPC UA.

use uadp::{BuiltinType, Scalar};

use crate::ValueFault;

/// The conversion of a value between its field and OPC UA: `value * scale + offset` towards OPC UA,
/// `(value - offset) / scale` back. The result is rounded to the nearest integer for integer types.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Conversion {
    /// `None` without scaling, so that whole numbers stay exact.
    linear: Option<(Real, Real)>,
    invert: bool,
    to: Option<BuiltinType>,
    clamp: bool,
}

/// A number by its bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Real(u64);

impl Real {
    const fn get(self) -> f64 {
        f64::from_bits(self.0)
    }
}

/// A number before it has a type.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Number {
    Whole(i128),
    Real(f64),
}

impl Conversion {
    /// Adds scaling and an offset. `scale` has to be finite and not 0, and `offset` finite;
    /// otherwise the way back would not exist.
    #[must_use]
    pub const fn scaled(mut self, scale: f64, offset: f64) -> Self {
        self.linear = Some((Real(scale.to_bits()), Real(offset.to_bits())));
        self
    }

    /// Inverts Booleans in both directions.
    #[must_use]
    pub const fn inverted(mut self) -> Self {
        self.invert = true;
        self
    }

    /// Sets the builtin type in OPC UA; the default is that of the field.
    #[must_use]
    pub const fn to(mut self, builtin: BuiltinType) -> Self {
        self.to = Some(builtin);
        self
    }

    /// Replaces values out of the range of the type by the nearest limit; by default they are
    /// refused.
    #[must_use]
    pub const fn clamped(mut self) -> Self {
        self.clamp = true;
        self
    }

    /// Returns whether every value is unchanged.
    #[must_use]
    pub const fn is_none(&self) -> bool {
        self.linear.is_none() && !self.invert && self.to.is_none()
    }

    /// Returns the OPC UA type of a field of that type, or the reason for which it cannot be
    /// converted.
    pub(super) fn outside(&self, field: BuiltinType) -> Result<BuiltinType, &'static str> {
        let to = self.to.unwrap_or(field);
        if self.is_none() {
            return Ok(field);
        }
        if self.invert && (field, to) != (BuiltinType::Boolean, BuiltinType::Boolean) {
            return Err("is not a Boolean, and `invert` needs a Boolean");
        }
        if self.linear.is_some() && !field.is_number() {
            return Err("is not a number, and `scale` and `offset` need a number");
        }
        if to != field && !(field.is_number() && to.is_number()) {
            return Err("cannot become that type: only numbers become other numbers");
        }
        Ok(to)
    }

    /// Converts from the field to OPC UA.
    pub(super) fn there(&self, value: Scalar<'_>) -> Result<Scalar<'static>, ValueFault> {
        let to = self.to.unwrap_or_else(|| value.builtin_type());
        self.apply(value, to, |value, scale, offset| value * scale + offset)
    }

    /// Converts from OPC UA to a field of that type.
    pub(super) fn back(
        &self,
        value: Scalar<'_>,
        field: BuiltinType,
    ) -> Result<Scalar<'static>, ValueFault> {
        self.apply(value, field, |value, scale, offset| {
            (value - offset) / scale
        })
    }

    fn apply(
        &self,
        value: Scalar<'_>,
        to: BuiltinType,
        linear: impl Fn(f64, f64, f64) -> f64,
    ) -> Result<Scalar<'static>, ValueFault> {
        if let Scalar::Boolean(value) = value {
            return Ok(Scalar::Boolean(value != self.invert));
        }
        let number = number_of(value).ok_or(ValueFault::NoNumber)?;
        let number = match self.linear {
            None => number,
            Some((scale, offset)) => {
                let moved = linear(number.real(), scale.get(), offset.get());
                // The infinity of an infinite value stays; any other infinity exceeds the range of
                // a Double.
                match moved.is_infinite() && number.real().is_finite() {
                    true if self.clamp => Number::Real(f64::MAX.copysign(moved)),
                    true => return Err(Number::Real(moved).out_of(to)),
                    false => Number::Real(moved),
                }
            }
        };
        number.fit(to, self.clamp)
    }
}

/// Returns whether all values of the first type are values of the second type.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "numbers are told apart, and all else is none"
)]
#[must_use]
pub const fn is_lossless(from: BuiltinType, to: BuiltinType) -> bool {
    use BuiltinType as T;
    match from {
        T::SByte => matches!(
            to,
            T::SByte | T::Int16 | T::Int32 | T::Int64 | T::Float | T::Double
        ),
        T::Byte => matches!(
            to,
            T::Byte
                | T::Int16
                | T::UInt16
                | T::Int32
                | T::UInt32
                | T::Int64
                | T::UInt64
                | T::Float
                | T::Double
        ),
        T::Int16 => matches!(to, T::Int16 | T::Int32 | T::Int64 | T::Float | T::Double),
        T::UInt16 => matches!(
            to,
            T::UInt16 | T::Int32 | T::UInt32 | T::Int64 | T::UInt64 | T::Float | T::Double
        ),
        T::Int32 => matches!(to, T::Int32 | T::Int64 | T::Double),
        T::UInt32 => matches!(to, T::UInt32 | T::Int64 | T::UInt64 | T::Double),
        T::Int64 => matches!(to, T::Int64),
        T::UInt64 => matches!(to, T::UInt64),
        T::Float => matches!(to, T::Float | T::Double),
        T::Double => matches!(to, T::Double),
        _ => false,
    }
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "numbers are told apart, and all else is none"
)]
fn number_of(value: Scalar<'_>) -> Option<Number> {
    Some(match value {
        Scalar::SByte(value) => Number::Whole(value.into()),
        Scalar::Byte(value) => Number::Whole(value.into()),
        Scalar::Int16(value) => Number::Whole(value.into()),
        Scalar::UInt16(value) => Number::Whole(value.into()),
        Scalar::Int32(value) => Number::Whole(value.into()),
        Scalar::UInt32(value) => Number::Whole(value.into()),
        Scalar::Int64(value) => Number::Whole(value.into()),
        Scalar::UInt64(value) => Number::Whole(value.into()),
        Scalar::Float(value) => Number::Real(value.into()),
        Scalar::Double(value) => Number::Real(value),
        _ => return None,
    })
}

impl Number {
    #[expect(
        clippy::cast_precision_loss,
        reason = "the nearest Double of 64 bits is what scaling them means"
    )]
    const fn real(self) -> f64 {
        match self {
            Self::Whole(value) => value as f64,
            Self::Real(value) => value,
        }
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "numbers are told apart, and all else is none"
    )]
    fn fit(self, to: BuiltinType, clamp: bool) -> Result<Scalar<'static>, ValueFault> {
        macro_rules! whole {
            ($variant:ident, $type:ty) => {{
                let whole = self.whole(to, clamp, (<$type>::MIN.into(), <$type>::MAX.into()))?;
                <$type>::try_from(whole)
                    .map(Scalar::$variant)
                    .map_err(|_| self.out_of(to))
            }};
        }
        match to {
            BuiltinType::SByte => whole!(SByte, i8),
            BuiltinType::Byte => whole!(Byte, u8),
            BuiltinType::Int16 => whole!(Int16, i16),
            BuiltinType::UInt16 => whole!(UInt16, u16),
            BuiltinType::Int32 => whole!(Int32, i32),
            BuiltinType::UInt32 => whole!(UInt32, u32),
            BuiltinType::Int64 => whole!(Int64, i64),
            BuiltinType::UInt64 => whole!(UInt64, u64),
            BuiltinType::Float => self.float(clamp).map(Scalar::Float),
            BuiltinType::Double => Ok(Scalar::Double(self.real())),
            _ => Err(ValueFault::NoNumber),
        }
    }

    fn whole(
        self,
        to: BuiltinType,
        clamp: bool,
        (least, most): (i128, i128),
    ) -> Result<i128, ValueFault> {
        let value = match self {
            Self::Whole(value) => value,
            Self::Real(value) if value.is_nan() => return Err(self.out_of(to)),
            #[expect(
                clippy::cast_possible_truncation,
                reason = "`as` saturates, far beyond what any type of 64 bits holds"
            )]
            Self::Real(value) => value.round() as i128,
        };
        if !clamp && !(least..=most).contains(&value) {
            return Err(self.out_of(to));
        }
        Ok(value.clamp(least, most))
    }

    /// Converts to a Float. Infinity and NaN are valid values of a Float.
    fn float(self, clamp: bool) -> Result<f32, ValueFault> {
        let value = self.real();
        #[expect(
            clippy::cast_possible_truncation,
            reason = "the nearest Float is what is wanted, and too big a one is looked for below"
        )]
        let float = value as f32;
        match float.is_infinite() && value.is_finite() {
            true if clamp => Ok(f32::MAX.copysign(float)),
            true => Err(self.out_of(BuiltinType::Float)),
            false => Ok(float),
        }
    }

    fn out_of(self, to: BuiltinType) -> ValueFault {
        let value = match self {
            Self::Whole(value) => value.to_string(),
            Self::Real(value) => value.to_string(),
        };
        ValueFault::OutOfRange { value, to }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn out_of(value: &str, to: BuiltinType) -> Result<Scalar<'static>, ValueFault> {
        let value = value.to_owned();
        Err(ValueFault::OutOfRange { value, to })
    }

    #[test]
    fn what_does_not_fit_is_refused_or_becomes_the_nearest_and_never_wraps() {
        let byte = Conversion::default().to(BuiltinType::Byte);
        assert_eq!(byte.there(Scalar::Double(254.5)), Ok(Scalar::Byte(255)));
        assert_eq!(byte.there(Scalar::Double(-0.4)), Ok(Scalar::Byte(0)));
        for (value, text, nearest) in [
            (Scalar::Double(255.5), "255.5", 255),
            (Scalar::Int32(256), "256", 255),
            (Scalar::Int64(-1), "-1", 0),
            (Scalar::Double(f64::INFINITY), "inf", 255),
            (Scalar::Double(f64::NEG_INFINITY), "-inf", 0),
        ] {
            assert_eq!(byte.there(value), out_of(text, BuiltinType::Byte));
            assert_eq!(byte.clamped().there(value), Ok(Scalar::Byte(nearest)));
        }
        let nan = Scalar::Double(f64::NAN);
        assert_eq!(byte.clamped().there(nan), out_of("NaN", BuiltinType::Byte));
        let float = Conversion::default().to(BuiltinType::Float);
        assert_eq!(float.there(Scalar::Double(-1e300)).map_err(|_| ()), Err(()));
        let clamped = float.clamped().there(Scalar::Double(-1e300));
        assert_eq!(clamped, Ok(Scalar::Float(f32::MIN)));
    }

    #[test]
    fn what_scaling_makes_too_big_for_a_double_is_out_of_range_and_infinity_is_a_value() {
        let scaled = Conversion::default().scaled(1e10, 0.0);
        let double = scaled.there(Scalar::Double(-1e300));
        assert_eq!(double, out_of("-inf", BuiltinType::Double));
        let clamped = scaled.clamped().there(Scalar::Double(-1e300));
        assert_eq!(clamped, Ok(Scalar::Double(f64::MIN)));
        let back = Conversion::default().scaled(1e-10, 0.0);
        let value = Scalar::Double(1e300);
        assert_eq!(
            back.back(value, BuiltinType::Double),
            out_of("inf", BuiltinType::Double)
        );
        assert_eq!(
            back.clamped().back(value, BuiltinType::Double),
            Ok(Scalar::Double(f64::MAX))
        );
        // Through a Double to a Float, and to an integer.
        let float = scaled.to(BuiltinType::Float);
        assert_eq!(
            float.there(Scalar::Double(1e300)),
            out_of("inf", BuiltinType::Float)
        );
        let clamped = float.clamped().there(Scalar::Double(1e300));
        assert_eq!(clamped, Ok(Scalar::Float(f32::MAX)));
        let whole = scaled.to(BuiltinType::Int16).clamped();
        assert_eq!(
            whole.there(Scalar::Double(1e300)),
            Ok(Scalar::Int16(i16::MAX))
        );
        for infinite in [f64::INFINITY, f64::NEG_INFINITY] {
            let value = Scalar::Double(infinite);
            assert_eq!(scaled.there(value), Ok(value));
            assert_eq!(scaled.clamped().there(value), Ok(value));
        }
    }

    #[test]
    fn whole_numbers_that_are_not_scaled_stay_exact() {
        let wide = Conversion::default().to(BuiltinType::UInt64);
        assert_eq!(
            wide.there(Scalar::Int64(i64::MAX)),
            Ok(Scalar::UInt64(i64::MAX.cast_unsigned()))
        );
    }

    #[test]
    fn degrees_are_radians_scaled_and_come_back() {
        let degrees = Conversion::default().scaled(180.0 / std::f64::consts::PI, 90.0);
        let there = degrees.there(Scalar::Double(std::f64::consts::PI));
        assert_eq!(there, Ok(Scalar::Double(270.0)));
        let back = degrees.back(Scalar::Double(270.0), BuiltinType::Double);
        assert_eq!(back, Ok(Scalar::Double(std::f64::consts::PI)));
    }

    #[test]
    fn an_inverted_boolean_is_the_other_both_ways() {
        let inverted = Conversion::default().inverted();
        assert_eq!(
            inverted.there(Scalar::Boolean(true)),
            Ok(Scalar::Boolean(false))
        );
        let back = inverted.back(Scalar::Boolean(false), BuiltinType::Boolean);
        assert_eq!(back, Ok(Scalar::Boolean(true)));
    }

    const NUMBERS: [BuiltinType; 10] = [
        BuiltinType::SByte,
        BuiltinType::Byte,
        BuiltinType::Int16,
        BuiltinType::UInt16,
        BuiltinType::Int32,
        BuiltinType::UInt32,
        BuiltinType::Int64,
        BuiltinType::UInt64,
        BuiltinType::Float,
        BuiltinType::Double,
    ];

    proptest! {
        #[test]
        fn a_lossless_conversion_returns_every_value(value in any::<u64>(), from in 0usize..10, to in 0usize..10) {
            let (from, to) = (NUMBERS[from], NUMBERS[to]);
            prop_assume!(is_lossless(from, to));
            let clamp = Conversion::default().to(from).clamped();
            let value = clamp.there(Scalar::Int64(value.cast_signed())).unwrap();
            let conversion = Conversion::default().to(to);
            let there = conversion.there(value).unwrap();
            prop_assert_eq!(there.builtin_type(), to);
            prop_assert_eq!(conversion.back(there, from), Ok(value));
        }

        #[test]
        fn a_scaled_integer_returns(value in any::<i32>(), scale in 1i32..10_000, offset in any::<i16>()) {
            let conversion = Conversion::default().scaled(1.0 / f64::from(scale), offset.into()).to(BuiltinType::Double);
            let there = conversion.there(Scalar::Int32(value)).unwrap();
            prop_assert_eq!(conversion.back(there, BuiltinType::Int32), Ok(Scalar::Int32(value)));
        }
    }
}
