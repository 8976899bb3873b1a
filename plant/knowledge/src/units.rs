//! Units of measurement: conversion of numbers between units of one quantity, in programs and in
//! queries.

use mtp::{Object, Triple, vocabulary as v};

/// Converts a number between two units, given by their symbols; `None` if they do not measure the
/// same quantity.
#[must_use]
pub fn convert(number: f64, from: &str, to: &str) -> Option<f64> {
    let (from, to) = (from.trim(), to.trim());
    if from == to {
        return Some(number);
    }
    let of = |symbol: &str| {
        let known = UNITS.iter().find(|unit| unit.0.contains(&symbol));
        known.map(|(_, quantity, factor, zero)| (*quantity, *factor, *zero))
    };
    let ((quantity, factor, zero), (wanted, by, from_zero)) = (of(from)?, of(to)?);
    (quantity == wanted).then(|| ((number * factor + zero) - from_zero) / by)
}

/// Returns whether numbers of a unit, given by its symbol, can be converted.
#[must_use]
pub fn is_known(symbol: &str) -> bool {
    UNITS.iter().any(|unit| unit.0.contains(&symbol.trim()))
}

/// Returns the units as statements, so that queries can convert numbers: a number times
/// `ua:factor` plus `ua:zero` is in the SI unit of the quantity.
#[must_use]
pub fn triples() -> Vec<Triple> {
    let mut all = Vec::new();
    for (number, (symbols, quantity, factor, zero)) in UNITS.iter().enumerate() {
        let subject = format!("urn:ua-bridge:unit:{number}");
        let mut say = |predicate: &str, object| {
            all.push(Triple {
                subject: subject.clone(),
                predicate: predicate.to_owned(),
                object,
            });
        };
        for symbol in *symbols {
            say(v::SYMBOL, Object::Text((*symbol).to_owned()));
        }
        say(v::QUANTITY, Object::Text(format!("{quantity:?}")));
        say(v::FACTOR, Object::Number(*factor));
        say(v::ZERO, Object::Number(*zero));
    }
    all
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Quantity {
    Acceleration,
    Angle,
    Force,
    Frequency,
    Length,
    Mass,
    Pressure,
    Ratio,
    Speed,
    Temperature,
    Time,
    Turning,
    Volume,
    Flow,
}

use Quantity::{
    Acceleration, Angle, Flow, Force, Frequency, Length, Mass, Pressure, Ratio, Speed, Temperature,
    Time, Turning, Volume,
};

/// Symbols of a unit, its quantity, and its size and zero in the SI unit of the quantity.
const UNITS: [(&[&str], Quantity, f64, f64); 40] = [
    (&["m"], Length, 1.0, 0.0),
    (&["dm"], Length, 0.1, 0.0),
    (&["cm"], Length, 0.01, 0.0),
    (&["mm"], Length, 0.001, 0.0),
    (&["µm", "μm", "um"], Length, 1e-6, 0.0),
    (&["in"], Length, 0.0254, 0.0),
    (&["kg"], Mass, 1.0, 0.0),
    (&["g"], Mass, 0.001, 0.0),
    (&["t"], Mass, 1000.0, 0.0),
    (&["s"], Time, 1.0, 0.0),
    (&["ms"], Time, 0.001, 0.0),
    (&["min"], Time, 60.0, 0.0),
    (&["h"], Time, 3600.0, 0.0),
    (&["N"], Force, 1.0, 0.0),
    (&["mN"], Force, 0.001, 0.0),
    (&["kN"], Force, 1000.0, 0.0),
    (&["Pa"], Pressure, 1.0, 0.0),
    (&["hPa", "mbar"], Pressure, 100.0, 0.0),
    (&["kPa"], Pressure, 1000.0, 0.0),
    (&["MPa"], Pressure, 1e6, 0.0),
    (&["bar"], Pressure, 1e5, 0.0),
    (&["rad"], Angle, 1.0, 0.0),
    (&["°", "deg"], Angle, std::f64::consts::PI / 180.0, 0.0),
    (&["m/s"], Speed, 1.0, 0.0),
    (&["mm/s"], Speed, 0.001, 0.0),
    (&["m/s²", "m/s2"], Acceleration, 1.0, 0.0),
    (&["mm/s²", "mm/s2"], Acceleration, 0.001, 0.0),
    (&["rad/s"], Turning, 1.0, 0.0),
    (
        &["°/s", "deg/s"],
        Turning,
        std::f64::consts::PI / 180.0,
        0.0,
    ),
    (&["K"], Temperature, 1.0, 0.0),
    (&["°C", "degC"], Temperature, 1.0, 273.15),
    (&["Hz"], Frequency, 1.0, 0.0),
    (&["kHz"], Frequency, 1000.0, 0.0),
    (&["1"], Ratio, 1.0, 0.0),
    (&["%"], Ratio, 0.01, 0.0),
    (&["m³", "m3"], Volume, 1.0, 0.0),
    (&["l", "L"], Volume, 0.001, 0.0),
    (&["ml", "mL"], Volume, 1e-6, 0.0),
    (&["m³/h", "m3/h"], Flow, 1.0 / 3600.0, 0.0),
    (&["l/min", "L/min"], Flow, 0.001 / 60.0, 0.0),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_converted_between_units_of_a_quantity() {
        for (number, from, to, expected) in [
            (31.0, "mm", "m", 0.031),
            (0.5, "kN", "N", 500.0),
            (20.0, "°C", "K", 293.15),
            (293.15, "K", "degC", 20.0),
            (180.0, "°", "rad", std::f64::consts::PI),
            (50.0, "%", "1", 0.5),
            (7.0, "pieces", "pieces", 7.0),
        ] {
            let converted = convert(number, from, to).unwrap();
            assert!(
                (converted - expected).abs() < 1e-9,
                "{from} {to} {converted}"
            );
        }
        assert!(is_known("l/min") && !is_known("Sekunde"));
        assert_eq!(convert(1.0, "mm", "N"), None);
        assert_eq!(convert(1.0, "furlong", "m"), None);
    }
}
