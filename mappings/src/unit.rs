//! Units of measure by their UNECE code (UN/ECE Recommendation 20), as OPC UA names them (OPC
//! 10000-8, 5.6.4.3).

use documents::nearest;

/// A unit of measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unit {
    /// Common code of UN/ECE Recommendation 20, one to three letters and digits: `MTS`.
    pub code: &'static str,
    /// Symbol, such as `m/s`.
    pub symbol: &'static str,
    /// Name, such as `metre per second`.
    pub name: &'static str,
}

impl Unit {
    /// URI of the units that UNECE codes name (OPC 10000-8, 5.6.4.3).
    pub const NAMESPACE: &'static str = "http://www.opcfoundation.org/UA/units/un/cefact";

    /// Returns the UnitId of the code in OPC UA: its letters as bytes, the last letter in the
    /// lowest byte.
    #[must_use]
    pub fn id(&self) -> i32 {
        self.code
            .bytes()
            .fold(0, |id, byte| (id << 8) | i32::from(byte))
    }

    /// Returns the unit of a symbol, also in its ASCII spelling, of a code, or of a name.
    #[must_use]
    pub fn find(text: &str) -> Option<&'static Self> {
        let spelt = ASCII.iter().find(|(ascii, _)| *ascii == text);
        let symbol = spelt.map_or(text, |(_, symbol)| symbol);
        let by = |is_it: &dyn Fn(&Self) -> bool| UNITS.iter().find(|unit| is_it(unit));
        by(&|unit| unit.symbol == symbol)
            .or_else(|| by(&|unit| unit.code == text))
            .or_else(|| by(&|unit| unit.name.eq_ignore_ascii_case(text)))
    }

    /// Returns the unit that an unknown text may mean.
    #[must_use]
    pub fn suggest(text: &str) -> Option<&'static Self> {
        let names = UNITS.iter().map(|unit| unit.name);
        let symbols = UNITS.iter().map(|unit| unit.symbol);
        let ascii = ASCII.iter().map(|(ascii, _)| *ascii);
        nearest(text, symbols.chain(ascii).chain(names)).and_then(Self::find)
    }
}

const fn unit(code: &'static str, symbol: &'static str, name: &'static str) -> Unit {
    Unit { code, symbol, name }
}

/// Units of machines and robots.
const UNITS: &[Unit] = &[
    unit("C62", "1", "one"),
    unit("P1", "%", "percent"),
    unit("59", "ppm", "part per million"),
    unit("2N", "dB", "decibel"),
    unit("KMT", "km", "kilometre"),
    unit("MTR", "m", "metre"),
    unit("CMT", "cm", "centimetre"),
    unit("MMT", "mm", "millimetre"),
    unit("4H", "µm", "micrometre"),
    unit("MTK", "m²", "square metre"),
    unit("CMK", "cm²", "square centimetre"),
    unit("MMK", "mm²", "square millimetre"),
    unit("MTQ", "m³", "cubic metre"),
    unit("CMQ", "cm³", "cubic centimetre"),
    unit("MMQ", "mm³", "cubic millimetre"),
    unit("LTR", "l", "litre"),
    unit("MLT", "ml", "millilitre"),
    unit("MTS", "m/s", "metre per second"),
    unit("C16", "mm/s", "millimetre per second"),
    unit("2M", "cm/s", "centimetre per second"),
    unit("2X", "m/min", "metre per minute"),
    unit("KMH", "km/h", "kilometre per hour"),
    unit("MSK", "m/s²", "metre per second squared"),
    unit("C81", "rad", "radian"),
    unit("DD", "°", "degree [unit of angle]"),
    unit("2A", "rad/s", "radian per second"),
    unit("E96", "°/s", "degree per second"),
    unit("2B", "rad/s²", "radian per second squared"),
    unit("RPM", "r/min", "revolutions per minute"),
    unit("RPS", "r/s", "revolutions per second"),
    unit("SEC", "s", "second [unit of time]"),
    unit("C26", "ms", "millisecond"),
    unit("B98", "µs", "microsecond"),
    unit("C47", "ns", "nanosecond"),
    unit("MIN", "min", "minute [unit of time]"),
    unit("HUR", "h", "hour"),
    unit("DAY", "d", "day"),
    unit("HTZ", "Hz", "hertz"),
    unit("KHZ", "kHz", "kilohertz"),
    unit("MHZ", "MHz", "megahertz"),
    unit("A86", "GHz", "gigahertz"),
    unit("TNE", "t", "tonne (metric ton)"),
    unit("KGM", "kg", "kilogram"),
    unit("GRM", "g", "gram"),
    unit("MGM", "mg", "milligram"),
    unit("KMQ", "kg/m³", "kilogram per cubic metre"),
    unit("KGS", "kg/s", "kilogram per second"),
    unit("MQS", "m³/s", "cubic metre per second"),
    unit("MQH", "m³/h", "cubic metre per hour"),
    unit("L2", "l/min", "litre per minute"),
    unit("NEW", "N", "newton"),
    unit("B47", "kN", "kilonewton"),
    unit("NU", "N·m", "newton metre"),
    unit("PAL", "Pa", "pascal"),
    unit("A97", "hPa", "hectopascal"),
    unit("KPA", "kPa", "kilopascal"),
    unit("MPA", "MPa", "megapascal"),
    unit("BAR", "bar", "bar [unit of pressure]"),
    unit("MBR", "mbar", "millibar"),
    unit("KEL", "K", "kelvin"),
    unit("CEL", "°C", "degree Celsius"),
    unit("FAH", "°F", "degree Fahrenheit"),
    unit("AMP", "A", "ampere"),
    unit("4K", "mA", "milliampere"),
    unit("B84", "µA", "microampere"),
    unit("VLT", "V", "volt"),
    unit("2Z", "mV", "millivolt"),
    unit("KVT", "kV", "kilovolt"),
    unit("OHM", "Ω", "ohm"),
    unit("B49", "kΩ", "kiloohm"),
    unit("FAR", "F", "farad"),
    unit("81", "H", "henry"),
    unit("COU", "C", "coulomb"),
    unit("AMH", "A·h", "ampere hour"),
    unit("E09", "mA·h", "milliampere hour"),
    unit("D33", "T", "tesla"),
    unit("C29", "mT", "millitesla"),
    unit("D81", "µT", "microtesla"),
    unit("WTT", "W", "watt"),
    unit("C31", "mW", "milliwatt"),
    unit("KWT", "kW", "kilowatt"),
    unit("MAW", "MW", "megawatt"),
    unit("JOU", "J", "joule"),
    unit("KJO", "kJ", "kilojoule"),
    unit("WHR", "W·h", "watt hour"),
    unit("KWH", "kW·h", "kilowatt hour"),
    unit("LUX", "lx", "lux"),
    unit("LUM", "lm", "lumen"),
    unit("CDL", "cd", "candela"),
    unit("A99", "bit", "bit"),
    unit("AD", "byte", "byte"),
    unit("2P", "kbyte", "kilobyte"),
    unit("4L", "Mbyte", "megabyte"),
];

/// ASCII spellings of symbols with other letters.
const ASCII: &[(&str, &str)] = &[
    ("um", "µm"),
    ("us", "µs"),
    ("uA", "µA"),
    ("uT", "µT"),
    ("m2", "m²"),
    ("m^2", "m²"),
    ("cm^2", "cm²"),
    ("mm^2", "mm²"),
    ("m3", "m³"),
    ("m^3", "m³"),
    ("cm^3", "cm³"),
    ("mm^3", "mm³"),
    ("L", "l"),
    ("mL", "ml"),
    ("L/min", "l/min"),
    ("m/s2", "m/s²"),
    ("m/s^2", "m/s²"),
    ("rad/s2", "rad/s²"),
    ("rad/s^2", "rad/s²"),
    ("deg", "°"),
    ("deg/s", "°/s"),
    ("degC", "°C"),
    ("degF", "°F"),
    ("rpm", "r/min"),
    ("1/min", "r/min"),
    ("Nm", "N·m"),
    ("N*m", "N·m"),
    ("N m", "N·m"),
    ("ohm", "Ω"),
    ("kohm", "kΩ"),
    ("Ah", "A·h"),
    ("mAh", "mA·h"),
    ("Wh", "W·h"),
    ("kWh", "kW·h"),
    ("m^3/s", "m³/s"),
    ("m^3/h", "m³/h"),
    ("kg/m^3", "kg/m³"),
    ("kB", "kbyte"),
    ("MB", "Mbyte"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_unit_is_found_by_symbol_code_and_name_and_has_the_number_of_its_code() {
        for text in ["m/s", "MTS", "metre per second", "Metre per Second"] {
            assert_eq!(Unit::find(text).unwrap().code, "MTS", "{text}");
        }
        // The bytes of "MTR" and of "C81".
        assert_eq!(Unit::find("m").unwrap().id(), 5_067_858);
        assert_eq!(Unit::find("rad").unwrap().id(), 4_405_297);
        assert_eq!(Unit::find("m/s^2"), Unit::find("m/s²"));
        assert_eq!(Unit::find("furlong"), None);
        assert_eq!(Unit::suggest("metre per secnd").unwrap().code, "MTS");
        assert_eq!(Unit::suggest("degc").unwrap().code, "CEL");
    }

    #[test]
    fn every_code_and_symbol_is_there_once_and_every_spelling_means_one() {
        for unit in UNITS {
            let same = |other: &&Unit| {
                other.code == unit.code || other.symbol == unit.symbol || other.name == unit.name
            };
            assert_eq!(UNITS.iter().filter(same).count(), 1, "{unit:?}");
        }
        for (ascii, symbol) in ASCII {
            assert!(UNITS.iter().any(|unit| unit.symbol == *symbol), "{symbol}");
            assert!(UNITS.iter().all(|unit| unit.symbol != *ascii), "{ascii}");
        }
    }
}
