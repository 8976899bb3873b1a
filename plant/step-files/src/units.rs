//! The units of a context.

use std::f64::consts::FRAC_PI_2;

use crate::fault::ShapeFault;
use crate::part21::ExchangeFile;
use crate::records::{AtEntity, EntityArguments, FaultAt};

/// The units of a context.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Units {
    /// Millimetres.
    pub(crate) length: f64,
    /// Radians; `None` without a unit.
    pub(crate) angle: Option<f64>,
}

impl Units {
    /// Reads the units of the context of a representation.
    pub(crate) fn of(file: &ExchangeFile, context: u64) -> Result<Self, FaultAt> {
        let assigned = file.one_of(context, &["GLOBAL_UNIT_ASSIGNED_CONTEXT"])?;
        // In a simple instance, the identifier and the type of the context are first.
        let at = if file.is_simple(context) { 2 } else { 0 };
        let (mut lengths, mut angles) = (Vec::new(), Vec::new());
        for unit in assigned.references(at)? {
            if file.is(unit, "LENGTH_UNIT") {
                lengths.push(factor(file, unit, ("METRE", 0))?);
            } else if file.is(unit, "PLANE_ANGLE_UNIT") {
                angles.push(factor(file, unit, ("RADIAN", 0))?);
            }
        }
        let [metres] = lengths.as_slice() else {
            return Err(ShapeFault::Units(lengths.len())).at(context);
        };
        let angle = match angles.as_slice() {
            [] => None,
            [angle] => Some(*angle),
            several => return Err(ShapeFault::Units(several.len())).at(context),
        };
        Ok(Self {
            length: metres * 1000.0,
            angle,
        })
    }
}

/// Returns the size of a unit in a unit of the SI.
fn factor(file: &ExchangeFile, unit: u64, (base, depth): (&str, u32)) -> Result<f64, FaultAt> {
    if depth > DEEPEST {
        return Err(ShapeFault::Unit).at(unit);
    }
    if let Some(si) = file.find(unit, "SI_UNIT") {
        return prefixed(&si, base).ok_or(ShapeFault::Unit).at(unit);
    }
    let converted = file.one_of(unit, &["CONVERSION_BASED_UNIT"])?;
    let measure = converted.reference(1)?;
    let names = [
        "LENGTH_MEASURE_WITH_UNIT",
        "PLANE_ANGLE_MEASURE_WITH_UNIT",
        "MEASURE_WITH_UNIT",
    ];
    let mut measure = file.one_of(measure, &names)?;
    if measure.len() == 0 {
        measure = file.one_of(measure.id, &["MEASURE_WITH_UNIT"])?;
    }
    let (times, of) = (measure.number(0)?, measure.reference(1)?);
    let size = times * factor(file, of, (base, depth + 1))?;
    let most = if base == "RADIAN" { FRAC_PI_2 } else { 1e3 };
    if size > 1e-10 && size <= most {
        Ok(size)
    } else {
        Err(ShapeFault::Unit).at(unit)
    }
}

/// Returns the factor of the prefix of a unit of the SI, in its base unit.
fn prefixed(si: &EntityArguments<'_>, base: &str) -> Option<f64> {
    // The dimensions are derived, and not written in a complex instance.
    let first = si.len().checked_sub(2)?;
    if si.enumeration(first + 1)? != base {
        return None;
    }
    if si.is_omitted(first) {
        return Some(1.0);
    }
    let prefixes = [
        ("KILO", 1e3),
        ("HECTO", 1e2),
        ("DECA", 1e1),
        ("DECI", 1e-1),
        ("CENTI", 1e-2),
        ("MILLI", 1e-3),
        ("MICRO", 1e-6),
        ("NANO", 1e-9),
    ];
    let prefix = si.enumeration(first)?;
    let found = prefixes.iter().find(|(name, _)| *name == prefix);
    found.map(|(_, factor)| *factor)
}

/// Maximum number of conversions of a unit.
const DEEPEST: u32 = 8;
