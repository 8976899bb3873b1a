//! The units of parameters, results and values.

use super::table::TableUnit;

pub(super) const NEWTON: TableUnit = unit("N", "newton", b"NEW");
pub(super) const METRE: TableUnit = unit("m", "metre", b"MTR");
pub(super) const SPEED: TableUnit = unit("m/s", "metre per second", b"MTS");
pub(super) const ACCELERATION: TableUnit = unit("m/s\u{b2}", "metre per second squared", b"MSK");
pub(super) const KILOGRAM: TableUnit = unit("kg", "kilogram", b"KGM");
pub(super) const RADIAN: TableUnit = unit("rad", "radian", b"C81");
pub(super) const TURNING: TableUnit = unit("rad/s", "radian per second", b"2A");
pub(super) const TURNING_UP: TableUnit = unit("rad/s\u{b2}", "radian per second squared", b"2B");

/// The units that have a UNECE code here.
const UNITS: &[TableUnit] = &[
    NEWTON,
    METRE,
    SPEED,
    ACCELERATION,
    KILOGRAM,
    RADIAN,
    TURNING,
    TURNING_UP,
    unit("%", "percent", b"P1"),
    unit("mm", "millimetre", b"MMT"),
    unit("\u{b0}", "degree [unit of angle]", b"DD"),
    unit("s", "second [unit of time]", b"SEC"),
    unit("ms", "millisecond", b"C26"),
    unit("min", "minute [unit of time]", b"MIN"),
    unit("h", "hour", b"HUR"),
    unit("Hz", "hertz", b"HTZ"),
    unit("r/min", "revolutions per minute", b"RPM"),
    unit("g", "gram", b"GRM"),
    unit("l", "litre", b"LTR"),
    unit("l/min", "litre per minute", b"L2"),
    unit("N\u{b7}m", "newton metre", b"NU"),
    unit("Pa", "pascal", b"PAL"),
    unit("kPa", "kilopascal", b"KPA"),
    unit("bar", "bar [unit of pressure]", b"BAR"),
    unit("mbar", "millibar", b"MBR"),
    unit("K", "kelvin", b"KEL"),
    unit("\u{b0}C", "degree Celsius", b"CEL"),
    unit("A", "ampere", b"AMP"),
    unit("mA", "milliampere", b"4K"),
    unit("V", "volt", b"VLT"),
    unit("mV", "millivolt", b"2Z"),
    unit("W", "watt", b"WTT"),
    unit("kW", "kilowatt", b"KWT"),
    unit("kW\u{b7}h", "kilowatt hour", b"KWH"),
];

impl TableUnit {
    /// Returns the unit with this symbol.
    #[must_use]
    pub fn find(symbol: &str) -> Option<&'static Self> {
        UNITS.iter().find(|unit| unit.symbol == symbol)
    }
}

const fn unit(symbol: &'static str, name: &'static str, characters: &[u8]) -> TableUnit {
    TableUnit {
        symbol,
        name,
        id: code(characters),
    }
}

/// Converts a UNECE code of two or three characters to its number.
const fn code(characters: &[u8]) -> u32 {
    let mut code = 0;
    let mut rest = characters;
    while let [first, others @ ..] = rest {
        code = (code << 8) | *first as u32;
        rest = others;
    }
    code
}
