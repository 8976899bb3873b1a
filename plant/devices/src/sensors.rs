//! Sensors that measure a single value: a register of a Modbus device, or a part of the process
//! data of an IO-Link device.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use skills::yaml::{DocumentNode, YamlFindingCode, YamlReader};
use skills::{Builtin, Measured, SensorRead, SkillValue, UnknownValue, ValueSensor, ValueShape};

use crate::addresses::{read_address, read_alias, read_line, read_register, read_unit};
use crate::http_skill;
use crate::line::ModbusLine;
use crate::measuring::ticks;
use crate::modbus::Modbus;
use crate::schmalz::IoLinkPort;

/// A register of a Modbus device.
#[derive(Debug)]
struct Register {
    modbus: Arc<Modbus>,
    /// Whether it is a holding register; otherwise an input register.
    holding: bool,
    address: u16,
    number: Number,
}

#[async_trait]
impl ValueSensor for Register {
    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let mut ticks = ticks(period);
        let count = self.number.format.words();
        loop {
            ticks.tick().await;
            let words = match self.holding {
                true => self.modbus.holding(self.address, count).await,
                false => self.modbus.input(self.address, count).await,
            };
            let words = match words {
                Ok(words) => words,
                Err(fault) => return fault.to_string(),
            };
            let mut bytes: Vec<u8> = words.into_iter().flat_map(u16::to_be_bytes).collect();
            if self.number.swapped {
                bytes.rotate_left(2);
            }
            out.put_single(self.number.shown(&bytes));
        }
    }

    fn source(&self) -> String {
        format!("register {} of {:?}", self.address, self.modbus)
    }
}

/// A part of the process data of an IO-Link device.
#[derive(Debug)]
struct ProcessData {
    port: IoLinkPort,
    /// The number of the first byte.
    byte: usize,
    number: Number,
}

#[async_trait]
impl ValueSensor for ProcessData {
    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let mut ticks = ticks(period);
        loop {
            ticks.tick().await;
            let bytes = match self.port.process_data().await {
                Ok(bytes) => bytes,
                Err(why) => return why.to_string(),
            };
            let bytes = bytes.get(self.byte..).unwrap_or_default();
            out.put_single(self.number.shown(bytes));
        }
    }

    fn source(&self) -> String {
        self.port.to_string()
    }
}

/// The meaning of bytes, the high byte first.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Number {
    format: Format,
    /// Whether the low word is first.
    swapped: bool,
    /// The number of a bit of the integer, from 0 for the lowest: a Boolean.
    bit: Option<u8>,
    /// The factor and the offset of a measurement, which is a Double.
    scaled: Option<(f64, f64)>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    UInt8,
    Int8,
    UInt16,
    Int16,
    UInt32,
    Int32,
    Float32,
}

impl Format {
    const ALL: [(Self, &'static str, Builtin, usize); 7] = [
        (Self::UInt8, "uint8", Builtin::Byte, 1),
        (Self::Int8, "int8", Builtin::SByte, 1),
        (Self::UInt16, "uint16", Builtin::UInt16, 2),
        (Self::Int16, "int16", Builtin::Int16, 2),
        (Self::UInt32, "uint32", Builtin::UInt32, 4),
        (Self::Int32, "int32", Builtin::Int32, 4),
        (Self::Float32, "float32", Builtin::Float, 4),
    ];

    fn row(self) -> (Builtin, usize) {
        let row = Self::ALL.iter().find(|(format, ..)| *format == self);
        row.map_or((Builtin::UInt16, 2), |(_, _, builtin, bytes)| {
            (*builtin, *bytes)
        })
    }

    /// Returns the number of Modbus registers.
    fn words(self) -> u16 {
        match self.row() {
            (_, 4) => 2,
            _ => 1,
        }
    }
}

/// Data that are too short for a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the data have {found} bytes, and {needed} are needed")]
struct ShortData {
    found: usize,
    needed: usize,
}

impl Number {
    fn shape(self) -> ValueShape {
        ValueShape::scalar(match (self.bit, self.scaled) {
            (Some(_), _) => Builtin::Boolean,
            (None, Some(_)) => Builtin::Double,
            (None, None) => self.format.row().0,
        })
    }

    /// Returns the value at the front of some bytes, or the reason why clients get none.
    fn shown(self, bytes: &[u8]) -> Result<SkillValue, UnknownValue> {
        let value = self.of(bytes);
        value.map_err(|short| UnknownValue::Reported(short.to_string()))
    }

    /// Returns the value at the front of some bytes.
    fn of(self, bytes: &[u8]) -> Result<SkillValue, ShortData> {
        let (_, needed) = self.format.row();
        let found = bytes.len();
        let bytes = bytes.get(..needed).ok_or(ShortData { found, needed })?;
        let whole = bytes
            .iter()
            .fold(0_u32, |number, byte| number << 8 | u32::from(*byte));
        if let Some(bit) = self.bit {
            return Ok((whole >> bit & 1 == 1).into());
        }
        let [.., high, low] = whole.to_be_bytes();
        let word = u16::from_be_bytes([high, low]);
        let value = match self.format {
            Format::UInt8 => SkillValue::Byte(low),
            Format::Int8 => SkillValue::SByte(low.cast_signed()),
            Format::UInt16 => SkillValue::UInt16(word),
            Format::Int16 => SkillValue::Int16(word.cast_signed()),
            Format::UInt32 => SkillValue::UInt32(whole),
            Format::Int32 => SkillValue::Int32(whole.cast_signed()),
            Format::Float32 => SkillValue::Float(f32::from_bits(whole)),
        };
        match self.scaled {
            None => Ok(value),
            Some((scale, offset)) => {
                let number = value.as_f64().unwrap_or(f64::NAN);
                Ok((number * scale + offset).into())
            }
        }
    }
}

/// Reads the source `modbus`, `io_link` or `http` of a value.
pub(crate) fn read(
    kind: &str,
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<SensorRead> {
    match kind {
        "modbus" => read_modbus(node, reader),
        "io_link" => read_io_link(node, reader),
        "http" => http_skill::read_value(node, reader),
        _ => {
            let message = format!("this program knows no `{kind}`");
            reader.refuse(node, YamlFindingCode::Source, message)
        }
    }
}

fn read_modbus(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<SensorRead> {
    let keys = [
        "at",
        "unit",
        "holding",
        "input",
        "as",
        "bit",
        "scale",
        "offset",
        "low_word_first",
    ];
    let [at, unit, holding, input, number @ ..] = reader.map(node, keys)?;
    let line: Option<ModbusLine> = reader
        .needed(at, "at", node.place)
        .and_then(|node| read_line(node, reader));
    let unit = unit.map_or(Some(1), |node| read_unit(node, reader));
    let (is_holding, address) = match (holding, input) {
        (Some(node), None) => (true, read_register(node, reader)),
        (None, Some(node)) => (false, read_register(node, reader)),
        (None, None) | (Some(_), Some(_)) => {
            let message = "a register is either `holding` or `input`, with its number from 0";
            (
                false,
                reader.refuse(node, YamlFindingCode::Source, message.to_owned()),
            )
        }
    };
    let number = read_number(number, Format::UInt16, reader);
    if number.is_some_and(|number| number.format.row().1 < 2) {
        let message = "a register has 16 bits: uint16, int16, uint32, int32 or float32";
        return reader.refuse(node, YamlFindingCode::Source, message.to_owned());
    }
    let number = number?;
    let sensor = Register {
        modbus: Modbus::shared(&line?, unit?),
        holding: is_holding,
        address: address?,
        number,
    };
    Some(SensorRead {
        sensor: Arc::new(sensor),
        shape: number.shape(),
    })
}

fn read_io_link(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<SensorRead> {
    let keys = ["master", "alias", "byte", "as", "bit", "scale", "offset"];
    let [master, alias, byte, format, bit, scale, offset] = reader.map(node, keys)?;
    let master = reader
        .needed(master, "master", node.place)
        .and_then(|node| read_address(node, reader));
    let alias = match alias {
        Some(node) => read_alias(node, reader),
        None => Some("master1port1"),
    };
    let byte = match byte {
        None => Some(0),
        Some(node) => {
            let text = reader.text(node, "the number of a byte")?;
            let byte: Option<usize> = text.parse().ok().filter(|byte| *byte < LONGEST_DATA);
            byte.or_else(|| {
                let message = format!("expected a number from 0 to 31, found `{text}`");
                reader.refuse(node, YamlFindingCode::WrongValue, message)
            })
        }
    };
    let number = read_number([format, bit, scale, offset, None], Format::UInt8, reader)?;
    let sensor = ProcessData {
        port: IoLinkPort::new(master?, alias?),
        byte: byte?,
        number,
    };
    Some(SensorRead {
        sensor: Arc::new(sensor),
        shape: number.shape(),
    })
}

fn read_number(
    [format, bit, scale, offset, swapped]: [Option<&DocumentNode>; 5],
    usual: Format,
    reader: &mut YamlReader<'_>,
) -> Option<Number> {
    let format = match format {
        None => usual,
        Some(node) => read_format(node, reader)?,
    };
    let bit = match bit {
        None => None,
        Some(node) => {
            let text = reader.text(node, "the number of a bit")?;
            let bits = format.row().1 * 8;
            let bit: Option<u8> = text.parse().ok().filter(|bit| usize::from(*bit) < bits);
            let Some(bit) = bit else {
                let message = format!("expected the number of a bit below {bits}, found `{text}`");
                return reader.refuse(node, YamlFindingCode::WrongValue, message);
            };
            Some(bit)
        }
    };
    let mut number = |node: Option<&DocumentNode>, usual| match node {
        Some(node) => reader.number(node, (-1e12, 1e12)),
        None => Some(usual),
    };
    let scaled = match (scale, offset) {
        (None, None) => None,
        _ => Some((number(scale, 1.0)?, number(offset, 0.0)?)),
    };
    let swapped = match swapped {
        Some(node) => reader.boolean(node)?,
        None => false,
    };
    Some(Number {
        format,
        swapped: swapped && format.words() == 2,
        bit,
        scaled,
    })
}

fn read_format(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Format> {
    let text = reader.text(node, "the format of a number")?;
    let known = Format::ALL.iter().find(|(_, name, ..)| *name == text);
    known.map(|(format, ..)| *format).or_else(|| {
        let names: Vec<&str> = Format::ALL.iter().map(|(_, name, ..)| *name).collect();
        let message = format!("expected one of {}, found `{text}`", names.join(", "));
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}

/// Longest process data of IO-Link, in bytes.
const LONGEST_DATA: usize = 32;

#[cfg(test)]
pub(crate) mod tests;
