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

/// Returns the symbol of a unit that is given by one of its symbols, or by its common code of
/// UN/ECE Recommendation 20, such as `KGM`.
#[must_use]
pub fn symbol(of: &str) -> Option<&'static str> {
    let known = UNITS.iter().find(|unit| unit.0.contains(&of.trim()));
    known.and_then(|unit| unit.0.first().copied())
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

/// Symbols of a unit with its common code of UN/ECE Recommendation 20, its quantity, and its size
/// and zero in the SI unit of the quantity.
const UNITS: [(&[&str], Quantity, f64, f64); 43] = [
    (&["m", "MTR"], Length, 1.0, 0.0),
    (&["dm", "DMT"], Length, 0.1, 0.0),
    (&["cm", "CMT"], Length, 0.01, 0.0),
    (&["mm", "MMT"], Length, 0.001, 0.0),
    (&["µm", "μm", "um", "4H"], Length, 1e-6, 0.0),
    (&["in", "INH"], Length, 0.0254, 0.0),
    (&["kg", "KGM"], Mass, 1.0, 0.0),
    (&["g", "GRM"], Mass, 0.001, 0.0),
    (&["mg", "MGM"], Mass, 1e-6, 0.0),
    (&["lb", "LBR"], Mass, 0.453_592_37, 0.0),
    (&["t", "TNE"], Mass, 1000.0, 0.0),
    (&["s", "SEC"], Time, 1.0, 0.0),
    (&["ms", "C26"], Time, 0.001, 0.0),
    (&["min", "MIN"], Time, 60.0, 0.0),
    (&["h", "HUR"], Time, 3600.0, 0.0),
    (&["N", "NEW"], Force, 1.0, 0.0),
    (&["mN", "C20"], Force, 0.001, 0.0),
    (&["kN", "B47"], Force, 1000.0, 0.0),
    (&["Pa", "PAL"], Pressure, 1.0, 0.0),
    (&["hPa", "A97"], Pressure, 100.0, 0.0),
    (&["mbar", "MBR"], Pressure, 100.0, 0.0),
    (&["kPa", "KPA"], Pressure, 1000.0, 0.0),
    (&["MPa", "MPA"], Pressure, 1e6, 0.0),
    (&["bar", "BAR"], Pressure, 1e5, 0.0),
    (&["rad", "C81"], Angle, 1.0, 0.0),
    (
        &["°", "deg", "DD"],
        Angle,
        std::f64::consts::PI / 180.0,
        0.0,
    ),
    (&["m/s", "MTS"], Speed, 1.0, 0.0),
    (&["mm/s", "C16"], Speed, 0.001, 0.0),
    (&["m/s²", "m/s2", "MSK"], Acceleration, 1.0, 0.0),
    (&["mm/s²", "mm/s2"], Acceleration, 0.001, 0.0),
    (&["rad/s", "2A"], Turning, 1.0, 0.0),
    (
        &["°/s", "deg/s", "E96"],
        Turning,
        std::f64::consts::PI / 180.0,
        0.0,
    ),
    (&["K", "KEL"], Temperature, 1.0, 0.0),
    (&["°C", "degC", "CEL"], Temperature, 1.0, 273.15),
    (&["Hz", "HTZ"], Frequency, 1.0, 0.0),
    (&["kHz", "KHZ"], Frequency, 1000.0, 0.0),
    (&["1", "C62"], Ratio, 1.0, 0.0),
    (&["%", "P1"], Ratio, 0.01, 0.0),
    (&["m³", "m3", "MTQ"], Volume, 1.0, 0.0),
    (&["l", "L", "LTR"], Volume, 0.001, 0.0),
    (&["ml", "mL", "MLT"], Volume, 1e-6, 0.0),
    (&["m³/h", "m3/h", "MQH"], Flow, 1.0 / 3600.0, 0.0),
    (&["l/min", "L/min", "L2"], Flow, 0.001 / 60.0, 0.0),
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
            (10.0, "lb", "g", 4535.9237),
            (3.0, "KGM", "kg", 3.0),
        ] {
            let converted = convert(number, from, to).unwrap();
            assert!(
                (converted - expected).abs() < 1e-9,
                "{from} {to} {converted}"
            );
        }
        assert!(is_known("l/min") && !is_known("Sekunde"));
        assert_eq!((symbol("GRM"), symbol("deg")), (Some("g"), Some("°")));
        assert_eq!(symbol("XYZ"), None);
        assert_eq!(convert(1.0, "mm", "N"), None);
        assert_eq!(convert(1.0, "furlong", "m"), None);
    }
}
